"""Cells that become obstacles while a mission is under way: its world, and its state, without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from planner.mrac.areas import connected_parts
from planner.none import NO_AREA, NO_ROBOT
from planner.plans.state import ON_ITS_WAY, AreaState, MissionState, RobotState
from planner.worlds.levels import find_levels
from planner.worlds.world import World

NOTHING = np.zeros(0, dtype=np.int64)


def closed_world(world: World, cells: NDArray[np.int64]) -> World:
    """The world with these cells, int64, as obstacles."""
    threat = world.threat.copy()
    threat.flat[cells] = np.nan
    value = None if world.value is None else np.where(np.isnan(threat), 0.0, world.value)
    return replace(world, threat=threat, starts=None, value=value)


def closed_state(state: MissionState, world: World, levels: int) -> MissionState:
    """The state as one of `world`, in which some cells that were free are closed; no robot alive stands on one.

    Areas lose cells that are closed or out of reach. What of an area its robot cannot reach any more, or what nobody
    has, becomes areas of connected cells that nobody has. A robot whose way, or what it has to cover on it, is not as
    it was has nothing ahead: it is to set out anew. `levels`: most threat levels.
    """
    here = next(robot.cell for robot in state.robots if robot.alive)
    free = world.free.ravel()
    # a lost robot in a closed zone is told to lie beside a live one: it does nothing, and a start is a free cell
    state = replace(state, robots=tuple(r if free[r.cell] else replace(r, cell=here) for r in state.robots))
    kept = world.accessible(state.starts).ravel()
    level_of, labels = find_levels(world, kept.reshape(world.shape), levels).of_cell, world.components().ravel()
    visited = np.zeros(kept.size, dtype=np.bool_)
    visited[state.visited] = True

    def left_in(cells: NDArray[np.int64]) -> int:
        return int(np.count_nonzero(~visited[cells]))

    areas: list[AreaState] = []
    own: dict[int, int] = {}
    for area in state.areas:
        left, mine = area.cells[kept[area.cells]], NOTHING
        parts = [left] if len(left) == len(area.cells) else connected_parts(world.shape, left)
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
        return replace(robot, status="idle", area=NO_AREA, ahead=NOTHING, to_do=NOTHING)
    if kept[robot.ahead].all() and np.isin([*robot.to_do, robot.ahead[-1]], areas[area].cells).all():
        return replace(robot, area=area)
    return replace(robot, area=area, status="traveling", ahead=NOTHING, to_do=NOTHING)
