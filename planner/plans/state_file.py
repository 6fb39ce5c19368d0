"""Reading state files against a world: every number is checked, every error says what is wrong and what to do."""

from __future__ import annotations

import reprlib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from planner.arguments import Numbers, whole
from planner.errors import StateError
from planner.files import read_json
from planner.limits import MAX_PLAN_BYTES, MAX_STEP
from planner.none import NO_AREA, NO_ROBOT
from planner.plans.reading import at, check_map, check_partition, read_cell, read_cells, read_path
from planner.plans.state import (
    AREA_STATES,
    FORMAT,
    NAT,
    ON_ITS_WAY,
    RETURNING,
    STATUSES,
    VERSION,
    AreaState,
    MissionState,
    RobotState,
)
from planner.tally import OF_CLOSED_LOOP, WORDS_OF_0_3, Outcome
from planner.worlds.keys import Key
from planner.worlds.world import MAX_ROBOTS, World

OVER = tuple(one.word for one in OF_CLOSED_LOOP if one not in (Outcome.STEP_LIMIT, Outcome.DEADLINE))
"""How a mission may be over while robots are on their way home."""
NATS = Numbers(0, 1e6, "nats")
Fault = tuple[str, ...]
"""What is wrong, what was expected, and the fix if that does not say it."""
ANEW = "write it with `record --state-at`, or leave areas, ahead and to_do out: areas are then allocated anew"
DEFAULTS = {"world": {}, "step": 0, "survived": None, "areas": [], "to_do": None, "held": [], "quiet": 0}
DEFAULTS |= {"over": None}
OF_ROBOTS = {"status": "idle", "area": NO_AREA, "ahead": [], "moves": 0, "exposure": None, "home": None}
OF_ROBOTS |= {"turned": False}
"""What a state, and each of its robots, may leave out."""


def load_state(path: str | Path, world: World) -> MissionState:
    """The state in a JSON file, checked against `world` (SPEC section 12). Raises StateError."""
    return parse_state(read_json(Path(path), MAX_PLAN_BYTES, StateError, "a state file (JSON)"), world, str(path))


def parse_state(data: object, world: World, source: str, before: World | None = None) -> MissionState:
    """`load_state` of a file's JSON; `source` names it in errors. Raises StateError.

    `before`: the world as it was when the robots set out, if cells were closed since; one may be a robot's home.
    """
    top = Key(data, "", source, StateError)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StateError("is no state of a mission", source=source, expected=f'an object with "format": "{FORMAT}"')
    if data.get("version") != VERSION:
        problem = f"state version {reprlib.repr(data.get('version'))}"
        raise StateError(problem, source=source, expected=f"version {VERSION}")
    if data.get("begun") is False:
        problem, fix = "holds a mission whose first step is not over", "leave it out: nothing is done yet"
        raise StateError(problem, source=source, expected="a mission under way", fix=fix)
    keys = top.mapping(("robots", "visited"), defaults=DEFAULTS, strict=False)
    check_map(keys["world"], world, "state of", "give the map that the mission is on")
    given = keys["robots"].items("a list of robots")
    if len(given) > MAX_ROBOTS:
        raise keys["robots"].fault(f"has {len(given)} robots", f"1 to {MAX_ROBOTS}")
    held = [one.number(whole(0, len(given) - 1)) for one in keys["held"].items("a list of numbers of robots", least=0)]
    to_do = [Key([], "", source)] * len(given)
    if keys["to_do"].value is not None:
        to_do = keys["to_do"].items(f"{len(given)} lists of cells, one a robot", exactly=len(given))
    before = before or world
    robots = tuple(_robot(one, to_do[number], number in held, world, before) for number, one in enumerate(given))
    areas = tuple(_area(one, world) for one in keys["areas"].items("a list of areas", least=0))
    visited = np.union1d(read_cells(keys["visited"], world), [robot.cell for robot in robots])
    survived = visited
    if keys["survived"].value is not None:
        standing = np.array([robot.cell for robot in robots if robot.alive], dtype=np.int64)
        survived = np.union1d(read_cells(keys["survived"], world), standing)
    step, quiet = keys["step"].number(whole(0, MAX_STEP)), keys["quiet"].number(whole(0, 1))
    over = None if keys["over"].value is None else keys["over"].choice(OVER, WORDS_OF_0_3)
    found = MissionState(world.shape, world.sha256, step, visited, survived, robots, areas, quiet, over)
    check_state(found, world, source)
    return found


def _robot(key: Key, to_do: Key, held: bool, world: World, before: World) -> RobotState:
    keys = key.mapping(("cell",), defaults=OF_ROBOTS, strict=False)
    status, cell = keys["status"].choice(STATUSES), read_cell(keys["cell"], world)
    area = keys["area"].number(whole(NO_AREA, said=f"the id of an area, or {NO_AREA}"))
    ahead, moves = read_path(keys["ahead"], world), keys["moves"].number(whole(0, MAX_STEP))
    if status not in ON_ITS_WAY and (area != NO_AREA or len(ahead)):
        what = "both lost and moving" if status == "dead" else f"{status}, and has an area or a path"
        raise key.fault(f"is {what}", "no area and nothing ahead", "leave area and ahead out")
    rows, cols = np.divmod(np.array([cell, *ahead]), world.shape[1])
    if (np.abs(np.diff(rows)) + np.abs(np.diff(cols)) != 1).any():
        raise keys["ahead"].fault("jumps", "one cell north, south, east or west at a time")
    exposure = None if keys["exposure"].value is None else round(keys["exposure"].number(NATS) * NAT)
    home = None if keys["home"].value is None else read_cell(keys["home"], before)
    if not isinstance(keys["turned"].value, bool):
        raise keys["turned"].wrong("true or false")
    turned = keys["turned"].value or status == RETURNING
    return RobotState(cell, status, area, ahead, read_cells(to_do, world), moves, held, exposure, home, turned)


def _area(key: Key, world: World) -> AreaState:
    key = Key(key.value, key.path, key.source, key.error, ANEW)
    keys = key.mapping(("level", "robot", "state", "cells"), strict=False)
    level = keys["level"].number(whole(0, what="the index of a level"))
    robot = keys["robot"].number(whole(NO_ROBOT, said=f"a robot, or {NO_ROBOT}"))
    state, cells = keys["state"].choice(AREA_STATES), read_cells(keys["cells"], world)
    if not len(cells):
        raise keys["cells"].wrong("at least one cell")
    return AreaState(level, robot, state, cells)


def check_state(state: MissionState, world: World, source: str) -> None:
    """Raise StateError for a state that cannot be one of a mission on `world` that goes on."""
    for problem, expected, *fix in chain(_of_cover(state, world), _of_areas(state, world, source)):
        raise StateError(problem, source=source, expected=expected, fix="".join(fix))


def _of_cover(state: MissionState, world: World) -> Iterator[Fault]:
    """Visited cells in reach, survived ones among them, something left to do and a robot to do it."""
    accessible = world.accessible(state.starts).ravel()
    for name, cells in (("visited", state.visited), ("survived", state.survived)):
        for wrong in cells[~accessible[cells]]:
            yield f"{name}: no robot can have reached cell {at(wrong, world)}", "cells in its reach"
    for extra in np.setdiff1d(state.survived, state.visited):
        yield f"survived: cell {at(extra, world)} is not visited", "some of the visited cells"
    if not any(robot.alive for robot in state.robots):
        yield "every robot is dead", "a robot that goes on"
    if len(state.visited) == int(accessible.sum()) and not any(robot.status == RETURNING for robot in state.robots):
        yield "every cell in reach is visited", "something left to do"


def _of_areas(state: MissionState, world: World, source: str) -> Iterator[Fault]:
    """Every cell in one area, robots and areas as each says of the other."""
    moving = [(number, robot) for number, robot in enumerate(state.robots) if robot.status in ON_ITS_WAY]
    if not state.areas:
        for number, robot in moving:
            yield f"robot {number} is {robot.status}, and there are no areas", "idle, done or dead", ANEW
        return
    check_partition(state.areas, world, state.starts, StateError, source, ANEW)
    for number, area in enumerate(state.areas):
        unvisited = area.cells[~np.isin(area.cells, state.visited)]
        if area.state == "completed" and len(unvisited):
            cell = at(unvisited[0], world)
            yield f"area {number} is completed, and its cell {cell} is not visited", "visited ones", ANEW
        if area.state == "unassigned" and not len(unvisited):
            yield f"area {number} is unassigned, and holds visited cells alone", "completed", ANEW
        holders = [one for one, robot in enumerate(state.robots) if one == area.robot and robot.area == number]
        if area.state == "assigned" and not holders:
            problem = f"area {number} is assigned to robot {area.robot}, which has another or none"
            yield problem, "its own robot", ANEW
    for number, robot in moving:
        own = state.areas[robot.area] if NO_AREA < robot.area < len(state.areas) else None
        if own is None or own.robot != number or own.state == "unassigned":
            yield f"robot {number} is {robot.status}, but area {robot.area} is not its own", "its area", ANEW
        elif not len(robot.ahead):
            yield f"robot {number} is {robot.status}, and nothing is ahead", "the cells of its path", ANEW
        elif len(np.setdiff1d(robot.to_do, own.cells)) or (robot.status == "traveling" and len(robot.to_do)):
            yield f"robot {number}: to_do is not of its area", "what it has still to cover", ANEW
