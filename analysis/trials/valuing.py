"""Value covered, rollout by rollout, in whole numbers that add up exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import estimate_of
from analysis.statistics.differences import CommonLuck
from analysis.statistics.estimate import Estimate, mean_of
from analysis.theory.value import Worth
from planner.kernels.state import MOST_PASSES
from planner.worlds.world import World

if TYPE_CHECKING:
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


def mean_value(
    column: NDArray[np.int64], total: float, cells: int, certain: bool, luck: CommonLuck | None = None
) -> Estimate:
    """The mean of units `[B]`, as a value of the `total` of so many cells; `certain`: every run is the same.

    `luck`: of the rollouts, by which it is put right (`analysis.statistics.control`).
    """
    values, often = np.unique(column, return_counts=True)
    unit, most = total / UNITS, most_units(cells)
    if luck is None or certain:
        found = mean_of(values, often, unit, most, certain)
    else:
        found = estimate_of(values, often, luck.by_class, luck.x.astype(np.float64), luck.robots, unit, most)
    rounding = 0.0 if certain else cells / 2 * unit  # of each cell's units
    mean = min(found.mean, total)
    return Estimate(mean, found.se, (max(found.ci95[0] - rounding, 0.0), min(found.ci95[1] + rounding, total)))
