"""What an evaluation holds: the plan, its exact values and bounds, and the tally of its rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import Controlled
from analysis.statistics.estimate import Estimate, exactly, mean_estimate
from analysis.theory.bounds import Bounds
from analysis.theory.exact import OpenLoopExact
from analysis.theory.truth import ClosedTruth
from planner.plans.plan import Plan
from planner.tally import Tally
from planner.worlds.world import World


def tighter(tally: Tally, control: tuple[Controlled, Controlled] | None) -> Estimate:
    """Visited coverage, a fraction: of the rollouts as they are, or controlled where that interval is narrower."""
    plain = mean_estimate(tally.visited, 1.0 / tally.accessible)
    return plain if control is None else min(plain, control[0].estimate, key=lambda estimate: estimate.half_width)


@dataclass(frozen=True, eq=False)
class Deadline:
    """Coverage by the end of step `steps`. `tally` counts the rollouts of the plan cut off there."""

    steps: int
    tally: Tally


@dataclass(frozen=True, eq=False)
class Band:
    """Quantiles of coverage (visited, cells) over time, of sampled rollouts. Axis `G` = steps looked at.

    Attributes:
        steps: int64 `[G]`. low, median, high: int64 `[G]`, the 5 %, 50 % and 95 % quantiles.
        rollouts: how many were sampled at each step.
    """

    steps: NDArray[np.int64]
    low: NDArray[np.int64]
    median: NDArray[np.int64]
    high: NDArray[np.int64]
    rollouts: int


@dataclass(frozen=True, eq=False)
class Scaled:
    """The same plan and luck, under threats that are `scale` times the map's.

    Attributes:
        scale: times the map's p. tally: of as many rollouts as the evaluation's, the same ids.
        exact: the open loop's closed form under those threats.
        certain: nothing can happen under them, so that one rollout is every run.
    """

    scale: float
    tally: Tally
    exact: OpenLoopExact
    certain: bool = False


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected values of the loop that was evaluated, for tables and pictures: exact ones where there are any.

    Attributes:
        how: "open loop, exact" or "closed loop, sampled".
        visited, survived: expected cells covered. losses: expected robots lost.
        visited_by_cell: float64 `[N]`, chance that each cell is visited. stops_by_cell: robots lost there.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
        alive_chance: float64 `[K + 1]`, chance that so many robots are alive at the end.
    """

    how: str
    visited: float
    survived: float
    losses: float
    visited_by_cell: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]
    alive_chance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One evaluated plan.

    Attributes:
        world, plan: what was evaluated. exact: the open loop's closed form. bounds: the paper's formulas.
        loop: "open" or "closed". mode: "fast" or "step" (closed: "step"). engine: "jax" or "numba".
        seed: of the rollouts.
        tally: the counts. deadline: coverage by a deadline, if asked. band: coverage over time, if asked.
        closed: the closed loop's expected values where they are known exactly, else None.
        control: visited and survived coverage (fractions) with the open loop as a control variate, if asked.
        scaled: the same under other threats, if asked.
        seconds: spent on rollouts, compilation left out. compile_seconds: spent on that.
        partial: True if it was interrupted; the tally holds what was done.
        notes: what a user should know.
        certain: no robot's way leads through danger: every run is the one rollout of the tally, in both loops.
    """

    world: World
    plan: Plan
    exact: OpenLoopExact
    bounds: Bounds
    loop: str
    mode: str
    engine: str
    seed: int
    tally: Tally
    seconds: float
    compile_seconds: float
    closed: ClosedTruth | None = None
    control: tuple[Controlled, Controlled] | None = None
    scaled: tuple[Scaled, ...] = ()
    deadline: Deadline | None = None
    band: Band | None = None
    partial: bool = False
    notes: tuple[str, ...] = ()
    certain: bool = False

    @property
    def visited(self) -> Estimate:
        """Expected visited coverage, a fraction of the accessible cells: exact where it is known, a point then.

        Else the tighter of the rollouts' interval and the one with the control variate.
        """
        cells = self.tally.accessible
        known = (
            self.exact.visited if self.loop == "open" else None if self.closed is None else self.closed.visited.value
        )
        if known is not None:
            return exactly(known / cells)
        return tighter(self.tally, self.control)

    @property
    def expected(self) -> Expected:
        """What to expect of the evaluated loop: the open loop's closed form, or means of the closed loop's rollouts."""
        if self.loop == "open":
            exact = self.exact
            return Expected(
                "open loop, exact",
                exact.visited,
                exact.survived,
                exact.expected_losses,
                exact.visited_by_cell,
                exact.stops_by_cell,
                exact.visited_curve,
                exact.survived_curve,
                exact.alive_chance,
            )
        tally, n = self.tally, self.tally.rollouts
        return Expected(
            "closed loop, sampled",
            float(tally.new_visited.sum() / n),
            float(tally.new_survived.sum() / n),
            float(tally.stops.sum() / n),
            tally.covered_visited / n,
            tally.stops / n,
            np.cumsum(tally.new_visited) / n,
            np.cumsum(tally.new_survived) / n,
            tally.alive / n,
        )
