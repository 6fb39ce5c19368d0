"""Value covered, rollout by rollout, in whole numbers that add up exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices, make_engine_for
from analysis.statistics.estimate import Estimate, mean_of
from analysis.theory.value import Worth
from planner.kernels.state import MOST_PASSES
from planner.plans.plan import Plan
from planner.worlds.world import World

if TYPE_CHECKING:
    from planner.kernels.tables import AllPairs
    from planner.rollouts.engine import Engine

UNITS = 2**40
"""The value of all cells in whole numbers: rounding is a millionth of a millionth of it a cell."""


def units_of(worth: Worth) -> NDArray[np.float64]:
    """What each cell adds to the sums of a rollout, not yet rounded, float64 `[N]`."""
    share: NDArray[np.float64] = worth.value / worth.total * UNITS
    return share


def most_units(cells: int) -> int:
    """The largest sum of so many cells, each rounded."""
    return UNITS + cells


def weigh(engine: Engine, world: World) -> Engine:
    """The same rollouts; where a closed loop's world has values, they sum up that of visited cells: `worth_covered`."""
    if world.value is None:
        return engine
    covered = np.rint(units_of(Worth.of(world))).astype(np.int64)
    return engine.weighing(covered, np.zeros((len(covered), MOST_PASSES + 1), dtype=np.int64))


def engine_of(world: World, plan: Plan, choices: RolloutChoices, kept: AllPairs | None = None) -> Engine:
    """What rolls a plan out, to the deadline of the choices; with what is visited of values, where cells have any."""
    engine = weigh(make_engine_for(world, plan, choices, kept=kept), world)
    return engine if choices.deadline is None else engine.until(choices.deadline)


def mean_value(column: NDArray[np.int64], total: float, cells: int, certain: bool) -> Estimate:
    """The mean of units `[B]`, as a value of the `total` of so many cells; `certain`: every run is the same."""
    values, often = np.unique(column, return_counts=True)
    most = most_units(cells)
    found = mean_of(values, often, total / UNITS, most, certain)
    rounding = 0.0 if certain else cells / 2 * total / UNITS  # of each cell's units
    mean = min(found.mean, total)
    return Estimate(mean, found.se, (max(found.ci95[0] - rounding, 0.0), min(found.ci95[1] + rounding, total)))


def share_of(column: NDArray[np.int64], world: World, certain: bool) -> Estimate | None:
    """The mean of units `[B]` as a fraction of what all free cells are worth; None where nobody said that."""
    return None if world.value is None else mean_value(column, 1.0, world.threat.size, certain)
