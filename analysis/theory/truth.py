"""What formulas are held against: exact values, or means of rollouts with intervals that hold together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.intervals import ALPHA, chance_interval, mean_interval
from analysis.theory.exact import OpenLoopExact, robot_chances
from analysis.theory.tree import closed_loop_exact
from planner.plans.plan import Plan, is_certain
from planner.tally import Outcome, Tally
from planner.worlds.world import World

FIGURES = 3
"""Figures of a closed loop that are sampled with an interval: visited, survived, the chance that a robot is left."""
EFFORT = 5e6
"""Branches of the tree of hits times cells of the map that are worth an exact value: some seconds' work."""
PATTERNS_A_BRANCH = 2.5
"""Patterns of hits that the nominal run's dangerous entries allow for, for each branch played (k = 2, 20 x 20)."""


@dataclass(frozen=True)
class Truth:
    """A value and the interval it is in.

    Attributes:
        value, low, high: low <= value <= high; equal where it is known.
        how: "exact", "enumerated" (every pattern of hits was run), "tree" (as many as matter) or "sampled".
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
        further: what else is known, as JSON has it.
    """

    visited: Truth
    survived: Truth
    some_left: Truth
    as_stated: Truth | None
    rollouts: int
    alive: float | None = None
    time: float | None = None
    further: dict[str, Any] = field(default_factory=dict)


def exact_truth(
    plan: Plan,
    world: World,
    exact: OpenLoopExact,
    first_only: bool = False,
    effort: float = EFFORT,
    between: Callable[[], None] | None = None,
) -> ClosedTruth | None:
    """The closed loop without rollouts, where there is a way that is worth `effort` at most; None elsewhere.

    Of a plan of ours one robot (every visit checked), or no danger on any path: it is the open loop. Few patterns of
    hits: all are run, and what `between` raises ends it.
    """
    accessible = world.accessible(plan.starts)
    alone = len(plan.robots) == 1 and not first_only and not plan.is_foreign
    if alone or is_certain(world, plan):
        stated = None if _is_cut_off(plan) else Truth.known(1.0)
        left, alive = Truth.known(1.0 - float(exact.alive_chance[0])), float(exact.survival.sum())
        ends = plan.state is None and plan.outcome == Outcome.COMPLETE.name.lower()  # else it waits before it gives up
        time = exact.mean_time if ends else None
        return ClosedTruth(Truth.known(exact.visited), Truth.known(exact.survived), left, stated, 0, alive, time)
    if world.doubt is not None:
        return None
    if not plan.bearing.is_plain:
        return None
    dangerous = sum(int((robot_chances(robot, world).threat > 0).sum()) for robot in plan.robots)
    branches = effort / max(int(accessible.sum()), 1)
    if len(plan.robots) * math.log1p(dangerous) > math.log(max(PATTERNS_A_BRANCH * branches, 1)):
        return None
    found = closed_loop_exact(plan, world, most_branches=int(branches), first_only=first_only, between=between)
    if found is None:
        return None
    how = "enumerated"
    stated = None
    if not _is_cut_off(plan):
        stated = _as_stated(found.stuck, found.timeout, _parts(plan, world), how)
    covered = (Truth.known(found.visited, how), Truth.known(found.survived, how))
    left = Truth.known(1.0 - float(found.alive_chance[0]), how)
    return ClosedTruth(*covered, left, stated, 0, found.alive, found.time)


def sampled_truth(plan: Plan, world: World, tally: Tally, doubt: float) -> ClosedTruth:
    """The closed loop from a tally; each figure's interval misses it with chance <= `doubt`.

    Means: the empirical Bernstein bound; the chance: Clopper & Pearson (`analysis.design.rules`).
    """
    n = tally.rollouts
    stated = None
    if not _is_cut_off(plan):
        stuck, timeout = (float(tally.outcomes[o]) / n for o in (Outcome.STUCK, Outcome.TIMEOUT))
        stated = _as_stated(stuck, timeout, _parts(plan, world), "sampled")
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


def _as_stated(stuck: float, timeout: float, parts: int, how: str) -> Truth:
    """A run that ends stuck is as stated only if the robots left cannot reach the rest: never on a map of one part."""
    unknown = stuck if parts > 1 else 0.0
    high = 1.0 - timeout - (stuck - unknown)
    return Truth(high, high - unknown, high, how)


def _parts(plan: Plan, world: World) -> int:
    """Parts of the map in which there are robots."""
    starts = plan.starts
    return len(np.unique(world.components()[starts[:, 0], starts[:, 1]]))


def _is_cut_off(plan: Plan) -> bool:
    """True if runs may end before all is covered or lost (cut off, called off, out of range), or began mid-mission."""
    settings = plan.settings
    return (
        plan.state is not None
        or settings is None
        or any(limit is not None for limit in (settings.last_step, settings.worth, settings.range))
    )
