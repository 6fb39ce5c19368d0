"""Cells that become obstacles while a mission is under way: its world, and its state, without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import StateError
from planner.missions.reports import Reports, whole_numbers
from planner.missions.seeing import seen_world
from planner.mrac.areas import connected_parts
from planner.none import NO_AREA, NO_ROBOT
from planner.plans.reading import at
from planner.plans.state import NO_CELLS, ON_ITS_WAY, AreaState, MissionState, RobotState
from planner.worlds.levels import find_levels
from planner.worlds.world import World


def closed_by(given: ArrayLike, reports: Reports) -> tuple[NDArray[np.int64], World]:
    """Cells, `[[row, col], ...]`, as rising indices, and the world of the fleet without them.

    Raises StateError where a robot is on one of them, or has reported so; where they would lie between a robot and what
    it reported in this step; and for what is no cell of the map.
    """
    fleet, found = reports.fleet, whole_numbers(given)
    world, (height, width) = fleet.problem.world, fleet.problem.world.shape
    if found.ndim != 2 or found.shape[1] != 2 or not len(found):
        raise StateError(f"cells to close are {given!r:.60}", expected="[[row, col], ...]")
    if not ((found >= 0) & (found < (height, width))).all():
        raise StateError("cells to close lie off the map", expected=f"row 0..{height - 1} and col 0..{width - 1}")
    if not any(robot.alive for robot in fleet.robots):
        raise StateError("every robot is lost", expected="a robot that goes on")
    cells = np.unique(found.astype(np.int64) @ (width, 1))
    reported = [(number, report.cell) for number, report in reports.now.items()]
    for number, cell in sorted({(robot.number, robot.cell) for robot in fleet.robots if robot.alive} | {*reported}):
        if cell in cells:
            problem = f"robot {number} is at {at(cell, world)}, which is to be closed"
            raise StateError(problem, expected="cells where no robot is", fix="close it when the robot has left it")
    without = closed_world(world, cells)
    part = without.components.ravel()
    for number, cell in reported:
        if part[cell] != part[fleet.robots[number].cell]:
            problem = f"what is to be closed cuts robot {number} off from {at(cell, world)}"
            raise StateError(problem, expected="cells to close once the step in which it went there is over")
    return cells, without


def closed_world(world: World, cells: NDArray[np.int64]) -> World:
    """The world with these cells, int64, as obstacles."""
    return seen_world(world, dict.fromkeys(cells.tolist()))


def closed_state(state: MissionState, world: World, levels: int) -> MissionState:
    """The state as one of `world`, in which some cells that were free are closed; no robot alive stands on one.

    Areas lose cells that are closed or out of reach, and fall apart where these are not connected, or of several
    levels now (they are quantised by what is in reach). A robot keeps the part with most to do that it can reach; the
    others nobody has. A robot whose way, or what it has to cover on it, is not as it was has nothing ahead: it is to
    set out anew. `levels`: most threat levels.
    """
    here = next(robot.cell for robot in state.robots if robot.alive)
    free = world.free.ravel()
    # a lost robot in a closed zone is told to lie beside a live one: it does nothing, and a start is a free cell
    state = replace(state, robots=tuple(r if free[r.cell] else replace(r, cell=here) for r in state.robots))
    kept = world.accessible(state.starts).ravel()
    level_of, labels = find_levels(world, kept.reshape(world.shape), levels).of_cell, world.components.ravel()
    visited = np.zeros(kept.size, dtype=np.bool_)
    visited[state.visited] = True

    def left_in(cells: NDArray[np.int64]) -> int:
        return int(np.count_nonzero(~visited[cells]))

    areas: list[AreaState] = []
    own: dict[int, int] = {}
    for area in state.areas:
        left, mine = area.cells[kept[area.cells]], NO_CELLS
        levels_of = np.unique(level_of[left])
        parts = [part for level in levels_of for part in connected_parts(world.shape, left[level_of[left] == level])]
        if area.robot != NO_ROBOT:
            here = labels[state.robots[area.robot].cell]
            mine = max((part for part in parts if labels[part[0]] == here), key=left_in, default=mine)
        has_it = left_in(mine) > 0
        for part in parts:
            robot, what = NO_ROBOT, "unassigned" if left_in(part) else "completed"
            if has_it and part is mine:
                robot, what = area.robot, "assigned"
                own[robot] = len(areas)
            areas.append(AreaState(int(level_of[part[0]]), robot, what, part))
    robots = tuple(_still(robot, own.get(number, NO_AREA), areas, kept) for number, robot in enumerate(state.robots))
    return replace(
        state,
        sha256=world.sha256,
        visited=state.visited[kept[state.visited]],
        survived=state.survived[kept[state.survived]],
        robots=robots,
        areas=tuple(areas),
        quiet=0,
    )


def _still(robot: RobotState, area: int, areas: list[AreaState], kept: NDArray[np.bool_]) -> RobotState:
    """The robot with what it is still about; with nothing ahead where its way, or what is to do on it, is another."""
    if robot.status not in ON_ITS_WAY:
        return robot
    if area == NO_AREA:
        return robot.at_rest
    if kept[robot.ahead].all() and np.isin([*robot.to_do, robot.ahead[-1]], areas[area].cells).all():
        return replace(robot, area=area)
    return replace(robot, area=area, status="traveling", ahead=NO_CELLS, to_do=NO_CELLS)
