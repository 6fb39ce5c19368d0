"""Cells that robots saw to be other than the map says, in a mission under way: its world, and its state, with them.

What follows from it is what follows in a simulated run: `planner.mrac.believe`, SPEC section 15.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import is_whole
from planner.errors import StateError
from planner.missions.fleet import Fleet
from planner.mrac.areas import connected_parts
from planner.mrac.believe import Learning
from planner.mrac.problem import prepare
from planner.mrac.resume import areas_of, state_of
from planner.none import NO_ROBOT
from planner.plans.state import ON_ITS_WAY, AreaState, MissionState
from planner.settings import Settings
from planner.trace import Doing
from planner.worlds.levels import NO_LEVEL
from planner.worlds.quantities import PROBABILITY
from planner.worlds.world import World

Seen = dict[int, float | None]
"""p of each cell, by index; None: an obstacle."""
ANOTHER = NO_LEVEL - 1
"""What is believed of a cell that is about to surprise: no level, and no obstacle either."""
EXPECTED = "[[row, col, p], ...], p = null for an obstacle"


def seen_by(given: Any, fleet: Fleet, reported: Mapping[int, int]) -> Seen:
    """What was seen, `[[row, col, p], ...]`. Raises StateError for what cannot be, or nobody could act on.

    `reported`: where robots said that they are in this step.
    """
    if any(robot.status is Doing.FOLLOWING for robot in fleet.robots) or fleet.problem.stay_inside:
        problem = (
            "robots that follow another planner's paths, or whose legs stay in their area, cannot act on what is seen"
        )
        raise StateError(problem, expected='a plan with areas, and `transit="grid"`')
    world, found = fleet.problem.world, dict[int, float | None]()
    (height, width), where = world.shape, {robot.cell for robot in fleet.robots if robot.alive} | {*reported.values()}
    if not isinstance(given, list | tuple):
        raise StateError(f"seen is {given!r:.60}", expected=EXPECTED)
    for one in given:
        if not isinstance(one, list | tuple) or len(one) != 3:
            raise StateError(f"seen holds {one!r:.60}", expected=EXPECTED)
        row, col, p = one
        if not (is_whole(row, 0, height - 1) and is_whole(col, 0, width - 1)):
            expected = f"row 0..{height - 1} and col 0..{width - 1}"
            raise StateError(f"seen holds [{row!r}, {col!r}], no cell of the map", expected=expected)
        if p is not None and not PROBABILITY.accepts(p):
            raise StateError(
                f"p of [{row}, {col}] is {p!r}", expected=f"{PROBABILITY.expected}, or null for an obstacle"
            )
        cell = int(row) * width + int(col)
        if p is None and cell in where:
            raise StateError(
                f"[{row}, {col}] is said to be an obstacle, and a robot is there", expected="one of the two"
            )
        found[cell] = None if p is None else float(p)
    return found


def seen_world(world: World, seen: Seen, given: World | None = None) -> World:
    """The world as it is known now. `given`: as it was before anything was seen, for what cells are worth."""
    threat = world.threat.copy()
    for cell, p in seen.items():
        threat.flat[cell] = np.nan if p is None else p
    worth = (given or world).value
    value = None if worth is None else np.where(np.isnan(threat), 0.0, worth)
    return replace(world, threat=threat, starts=None, value=value)


def surprises(world: World, seen: Seen) -> NDArray[np.int64]:
    """Those of the cells that are not as the world has them, rising."""
    was, now = world.threat.ravel(), seen_world(world, seen).threat.ravel()
    return np.flatnonzero((was != now) & ~(np.isnan(was) & np.isnan(now)))


def learned_state(
    state: MissionState, world: World, changed: NDArray[np.int64], settings: Settings
) -> tuple[MissionState, bool]:
    """The state as one of `world`, in which the `changed` cells, rising, are not as they were: rules (2) to (5).

    And whether somebody got an area.

    Levels are those of the new map. Where there are so many that they are quantised, a cell whose level is another
    than most of its area has now surprises too.
    """
    free = world.free.ravel()
    here = next(robot.cell for robot in state.robots if robot.alive)
    # a lost robot on an obstacle is told to lie beside a live one, as where a zone is closed
    robots = tuple(robot if free[robot.cell] else replace(robot, cell=here) for robot in state.robots)
    state = _without_completed(replace(state, robots=robots))
    problem = prepare(world, state.starts, settings, homes=state.homes(settings.return_to))
    levels, news = problem.levels.of_cell, np.zeros(free.size, dtype=np.bool_)
    news[changed] = True
    areas = []
    for area in state.areas:
        known = levels[area.cells[~news[area.cells]]]
        known = known[known != NO_LEVEL]
        level = int(np.bincount(known).argmax()) if len(known) else 0
        news[area.cells] |= (levels[area.cells] != level) & (levels[area.cells] != NO_LEVEL)
        areas.append(replace(area, level=level))
    state = replace(state, areas=tuple(areas))
    team = Learning(problem, areas_of(state), state=state)
    team.belief[news] = ANOTHER
    found = np.flatnonzero(news)
    team.believe(found, levels[found])
    state, left = _without_completed(state_of(team, state.exposures)), problem.levels.accessible.copy()
    for area in state.areas:
        left[area.cells] = False
    visited, survived = (cells[levels[cells] != NO_LEVEL] for cells in (state.visited, state.survived))
    areas = [*state.areas, *_unheld(world, left, levels, team.visited)]
    return replace(state, visited=visited, survived=survived, areas=tuple(areas)), team.progress


def _without_completed(state: MissionState) -> MissionState:
    """The state without areas in which nothing is to be done, but those of robots that still drive in them."""
    kept = [number for number, area in enumerate(state.areas) if area.state != "completed" or area.robot != NO_ROBOT]
    place = {number: index for index, number in enumerate(kept)}
    robots = (replace(r, area=place[r.area]) if r.status in ON_ITS_WAY else r for r in state.robots)
    return replace(state, robots=tuple(robots), areas=tuple(state.areas[number] for number in kept))


def _unheld(
    world: World, left: NDArray[np.bool_], levels: NDArray[np.int16], visited: NDArray[np.bool_]
) -> Iterator[AreaState]:
    """Areas of the cells that are left, bool `[N]`, of which there is nothing to do, or that nobody can reach."""
    for of, what in ((left & visited, "completed"), (left & ~visited, "unassigned")):
        for level in np.unique(levels[of]):
            for part in connected_parts(world.shape, np.flatnonzero(of & (levels == level))):
                yield AreaState(int(level), NO_ROBOT, what, part)
