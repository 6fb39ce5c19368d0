"""What stops robots on their paths where hazards are there or not, or the map is one of several (SPEC section 13).

Given what is true the robots of an open loop are independent. So its exact values are those of a few *ways* that the
world may be, weighted: each is a chance for every entry of every path, given that it is made. Axis `E` = entries.

One robot alone needs no ways. With m earlier entries of its own, survived, into a cell with the chances q and h, the
hazard is there with q (1 - h)**m / (1 - q + q (1 - h)**m): the entry stops it with h times that.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.plans.plan import Plan, RobotPlan
from planner.worlds.doubt import Hazard, Uncertain
from planner.worlds.movers import Movers
from planner.worlds.phases import Phases
from planner.worlds.world import World

MOST_SHARED = 10
"""Dangerous cells on the ways of several robots up to which every pattern of hazards is looked at."""


@dataclass(frozen=True, eq=False)
class Way:
    """One way that the world may be: its chance, and per robot float64 `[E]`, what each entry stops it with."""

    chance: float
    threats: list[NDArray[np.float64]]


def ways(plan: Plan, world: World) -> Iterator[Way] | None:
    """Every way that matters for the plan; None where there are too many, or robots are not independent given one.

    The map is one of M: M ways. Hazards: the patterns of those that several robots meet, if these are few; `consumed`,
    none of them may be, and by level there may be one robot. Threats that move or change: none.
    """
    doubt = world.doubt
    if isinstance(doubt, Movers | Phases):
        return None
    if doubt is None or world.draws is None or not any(world.draws.bound[robot.path].any() for robot in plan.robots):
        return iter([Way(1.0, [_entered(world.met, robot) for robot in plan.robots])])
    if isinstance(doubt, Uncertain):
        if doubt.whole:
            maps = map(doubt.threat_at, range(doubt.count))
            return (Way(1.0 / doubt.count, [_entered(threat, robot) for robot in plan.robots]) for threat in maps)
        return iter([Way(1.0, alone(plan, world))]) if len(plan.robots) == 1 else None
    shared = _shared(plan, doubt)
    if len(shared) > (MOST_SHARED if doubt.kind == "persistent" else 0):
        return None
    return _patterns(plan, doubt, shared)


def alone(plan: Plan, world: World) -> list[NDArray[np.float64]]:
    """Of each robot, as if there were no other, float64 `[E]`: what each entry stops it with, given that it is made."""
    doubt = world.doubt
    if isinstance(doubt, Uncertain):
        return [_by_level(robot, doubt) for robot in plan.robots]
    if isinstance(doubt, Hazard):
        return [_by_hazard(robot, doubt.q, doubt.h) for robot in plan.robots]
    return [_entered(world.met, robot) for robot in plan.robots]


def _entered(values: NDArray[np.float32], robot: RobotPlan) -> NDArray[np.float64]:
    """float64 `[E]`: the value of each cell entered."""
    return values.ravel()[robot.path[robot.entered]].astype(np.float64)


def _by_hazard(robot: RobotPlan, q: NDArray[np.float32], h: NDArray[np.float32]) -> NDArray[np.float64]:
    """See the module's docstring."""
    cells, there, hit = robot.path[robot.entered], _entered(q, robot), _entered(h, robot)
    order = np.argsort(cells, kind="stable")
    begins = np.concatenate([[True], cells[order][1:] != cells[order][:-1]])
    place = np.arange(len(cells))
    before = np.empty(len(cells), dtype=np.int64)
    before[order] = place - np.maximum.accumulate(np.where(begins, place, 0))
    still = there * (1 - hit) ** before
    left = 1 - there + still
    return hit * np.divide(still, left, out=np.zeros_like(still), where=left > 0)


def _by_level(robot: RobotPlan, doubt: Uncertain) -> NDArray[np.float64]:
    """The levels' maps are drawn apart, so a robot's chance to get so far is a product of means over each level's."""
    cells = robot.path[robot.entered]
    number, column = doubt.number.ravel()[cells], doubt.column.ravel()[cells]
    reach = np.ones(len(cells) + 1)
    for one in np.unique(number):
        passed = np.where(number == one, 1.0 - doubt.chances[:, column].astype(np.float64), 1.0)
        reach[1:] *= np.cumprod(passed, axis=1).mean(axis=0)
    return 1.0 - reach[1:] / reach[:-1]


def _shared(plan: Plan, hazard: Hazard) -> NDArray[np.int64]:
    """Cells in which several robots may meet a hazard that may or may not be there, int64."""
    mine = [np.unique(robot.path[robot.entered]) for robot in plan.robots]
    cells, robots = np.unique(np.concatenate(mine), return_counts=True)
    doubtful = hazard.q.ravel()[cells] < 1  # else every visit of a persistent one is drawn for itself
    return cells[(robots > 1) & (hazard.threat.ravel()[cells] > 0) & (doubtful | (hazard.kind == "consumed"))]


def _patterns(plan: Plan, hazard: Hazard, shared: NDArray[np.int64]) -> Iterator[Way]:
    """The hazards of the shared cells there or not, in every pattern."""
    chances = hazard.q.ravel()[shared].astype(np.float64)
    for pattern in itertools.product((False, True), repeat=len(shared)):
        there = np.array(pattern, dtype=bool)
        q = hazard.q.copy()
        q.ravel()[shared] = there
        threats = [_by_hazard(robot, q, hazard.h) for robot in plan.robots]
        yield Way(float(np.where(there, chances, 1 - chances).prod()), threats)
