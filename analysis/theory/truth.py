"""What formulas are held against: exact values, or means of rollouts with intervals that hold together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.intervals import ALPHA, chance_interval, mean_interval
from analysis.theory.exact import OpenLoopExact
from planner.plans.plan import Plan, is_certain
from planner.tally import Outcome, Tally
from planner.worlds.world import World

FIGURES = 3
"""Figures of a closed loop that are sampled with an interval: visited, survived, the chance that a robot is left."""


@dataclass(frozen=True)
class Truth:
    """A value and the interval it is in.

    Attributes:
        value, low, high: low <= value <= high; equal where it is known.
        how: "exact" (by a formula), "tree" (all that can happen, or as much as matters: then low < high) or "sampled".
    """

    value: float
    low: float
    high: float
    how: str = "exact"

    @staticmethod
    def known(value: float, how: str = "exact") -> Truth:
        """An exact value."""
        return Truth(float(value), float(value), float(value), how)


@dataclass(frozen=True)
class ClosedTruth:
    """The closed loop's figures.

    Attributes:
        visited, survived: expected cells. some_left: chance that a robot is alive at the end.
        as_stated: share of the runs that end as Theorem 2 says, complete or with every robot lost that could reach
            the rest; None where runs may end before (`_is_cut_off`).
        rollouts: behind the sampled ones; 0 where all is exact.
        alive, time: expected robots alive at the end, and steps; None: not known exactly.
    """

    visited: Truth
    survived: Truth
    some_left: Truth
    as_stated: Truth | None
    rollouts: int
    alive: float | None = None
    time: float | None = None

    @property
    def further(self) -> dict[str, Any]:
        """What else is known, as JSON has it."""
        return {}


def exact_truth(plan: Plan, world: World, exact: OpenLoopExact, first_only: bool = False) -> ClosedTruth | None:
    """The closed loop where formulas are all of it, because it is the open loop; None elsewhere.

    So it is of a plan of ours with one robot (every visit checked, nothing learned), and where no path has danger.
    """
    alone = len(plan.robots) == 1 and not (first_only or plan.is_foreign or world.is_learned)
    if not (alone and exact.is_known) and not is_certain(world, plan):
        return None
    stated = None if _is_cut_off(plan) else Truth.known(1.0)
    left, alive = Truth.known(exact.some_left), float(exact.survival.sum())
    # else it waits before it gives up, which is known of one among movers alone
    ends = world.movers is not None or (plan.state is None and plan.outcome == Outcome.COMPLETE.name.lower())
    time = exact.mean_time if ends else None
    return ClosedTruth(Truth.known(exact.visited), Truth.known(exact.survived), left, stated, 0, alive, time)


def sampled_truth(plan: Plan, world: World, tally: Tally, doubt: float) -> ClosedTruth:
    """The closed loop from a tally; each figure's interval misses it with chance <= `doubt`.

    Means: the empirical Bernstein bound; the chance: Clopper & Pearson (`analysis.design.rules`).
    """
    n = tally.rollouts
    stated = as_stated(plan, world, tally.outcomes / n, "sampled")
    alive = n - int(tally.alive[0])
    low, high = chance_interval(alive, n, doubt)
    left = Truth(alive / n, low, high, "sampled")
    return ClosedTruth(_mean(tally.visited, doubt), _mean(tally.survived, doubt), left, stated, n)


def doubt_of_each(figures: int) -> float:
    """The chance of error of one of so many sampled figures: ALPHA shared by Bonferroni."""
    return ALPHA / max(figures, 1)


def _mean(counts: NDArray[np.int64], doubt: float) -> Truth:
    low, high = mean_interval(counts, doubt)
    mean = float(counts @ np.arange(len(counts))) / float(counts.sum())
    return Truth(mean, min(low, mean), max(high, mean), "sampled")


def as_stated(plan: Plan, world: World, outcomes: NDArray[np.float64], how: str) -> Truth | None:
    """The share of runs that end as Theorem 2 says; None where they may end before (`_is_cut_off`).

    A run that ends stuck is as stated only if the robots left cannot reach the rest: never on a map of one part.

    Args:
        outcomes: the chance of each, by `Outcome`; runs that were not followed to their end, as those that were not
            sampled, count as stated.
    """
    if _is_cut_off(plan):
        return None
    starts, (stuck, timeout) = plan.starts, outcomes[[Outcome.STUCK, Outcome.TIMEOUT]].tolist()
    parts = len(np.unique(world.components[starts[:, 0], starts[:, 1]]))
    unknown = stuck if parts > 1 else 0.0
    high = 1.0 - timeout - (stuck - unknown)
    return Truth(high, high - unknown, high, how)


def _is_cut_off(plan: Plan) -> bool:
    """True if runs may end before all is covered or lost (cut off, called off, out of range), or began mid-mission."""
    settings = plan.settings
    return (
        plan.state is not None
        or settings is None
        or any(limit is not None for limit in (settings.last_step, settings.worth, settings.range))
    )
