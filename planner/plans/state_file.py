"""Reading state files against a world: every number is checked, every error says what is wrong and what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import is_real
from planner.errors import StateError
from planner.files import Json, read_json
from planner.limits import MAX_PLAN_BYTES, MAX_STEP
from planner.none import NO_AREA, NO_ROBOT
from planner.plans.state import (
    AREA_STATES,
    FORMAT,
    NAT,
    ON_ITS_WAY,
    STATUSES,
    VERSION,
    AreaState,
    MissionState,
    RobotState,
)
from planner.worlds.world import MAX_ROBOTS, World

MOST_NATS = 1e6
ANEW = "write it with `record --state-at`, or leave areas, ahead and to_do out: areas are then allocated anew"


def load_state(path: str | Path, world: World) -> MissionState:
    """The state in a JSON file, checked against `world` (SPEC section 12). Raises StateError."""
    return parse_state(read_json(Path(path), MAX_PLAN_BYTES, StateError, "a state file (JSON)"), world, str(path))


def parse_state(data: object, world: World, source: str) -> MissionState:
    """`load_state` of a file's JSON; `source` names it in errors. Raises StateError."""
    return _Reader(world, source).state(data)


def check_state(state: MissionState, world: World, source: str) -> None:
    """Raise StateError for a state that cannot be one of a mission on `world` that goes on."""
    reader = _Reader(world, source)
    reader.check_cover(state)
    reader.check_areas(state)


class _Reader:
    """One file and the world that it is to be of."""

    def __init__(self, world: World, source: str) -> None:
        self.world, self.source = world, source
        self.free = ~np.isnan(world.threat.ravel())

    def wrong(self, problem: str, expected: str, fix: str = "") -> StateError:
        return StateError(problem, source=self.source, expected=expected, fix=fix)

    def state(self, data: object) -> MissionState:
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise self.wrong("is no state of a mission", f'an object with "format": "{FORMAT}"')
        if data.get("version") != VERSION:
            raise self.wrong(f"state version {_show(data.get('version'))}", f"version {VERSION}")
        self._check_map(self._get(data, "world", dict, {}))
        step = self._whole(data.get("step", 0), "step", MAX_STEP)
        given = self._get(data, "robots", list)
        if not 1 <= len(given) <= MAX_ROBOTS:
            raise self.wrong(f"{len(given)} robots", f"1 to {MAX_ROBOTS}")
        to_do = data.get("to_do", [[]] * len(given))
        held = data.get("held", [])
        if not isinstance(to_do, list) or len(to_do) != len(given):
            raise self.wrong('"to_do" is not one list a robot', f"{len(given)} lists of cells")
        if not isinstance(held, list) or not all(type(one) is int and 0 <= one < len(given) for one in held):
            raise self.wrong(f'"held" is {_show(held)}', f"numbers of robots, 0..{len(given) - 1}")
        robots = tuple(self._robot(number, one, to_do[number], number in held) for number, one in enumerate(given))
        areas = tuple(self._area(number, one) for number, one in enumerate(self._get(data, "areas", list, [])))
        at = [robot.cell for robot in robots]
        visited = np.union1d(self._cells(self._get(data, "visited", list), "visited"), at)
        survived = visited
        if "survived" in data:
            survived = self._cells(self._get(data, "survived", list), "survived")
            standing = np.array([robot.cell for robot in robots if robot.alive], dtype=np.int64)
            survived = np.union1d(survived, standing)
        quiet = self._whole(data.get("quiet", 0), "quiet", 1)
        found = MissionState(self.world.shape, self.world.sha256, step, visited, survived, robots, areas, quiet)
        self.check_cover(found)
        self.check_areas(found)
        return found

    def _check_map(self, given: Json) -> None:
        known_as = {"shape": list(self.world.shape), "sha256": self.world.sha256}
        if any(given.get(key, value) != value for key, value in known_as.items()):
            shown = f"{_show(given.get('shape'))} cells, sha256 {_show(str(given.get('sha256'))[:12])}..."
            known = f"{list(self.world.shape)}, {self.world.sha256[:12]}... as {self.world.source}"
            raise self.wrong(f"state of another map: {shown}", known, "give the map that the mission is on")

    def check_cover(self, found: MissionState) -> None:
        """Visited cells in reach, survived ones among them, something left to do and a robot to do it."""
        accessible = self.world.accessible(found.starts).ravel()
        for name, cells in (("visited", found.visited), ("survived", found.survived)):
            wrong = cells[~accessible[cells]]
            if len(wrong):
                raise self.wrong(f"{name}: no robot can have reached cell {self._at(wrong[0])}", "cells in its reach")
        extra = np.setdiff1d(found.survived, found.visited)
        if len(extra):
            raise self.wrong(f"survived: cell {self._at(extra[0])} is not visited", "some of the visited cells")
        if not any(robot.alive for robot in found.robots):
            raise self.wrong("every robot is dead", "a robot that goes on")
        if len(found.visited) == int(accessible.sum()):
            raise self.wrong("every cell in reach is visited", "something left to do")

    # --- robots ---

    def _robot(self, number: int, given: Any, to_do: Any, held: bool) -> RobotState:
        where = f"robot {number}"
        if not isinstance(given, dict):
            raise self.wrong(f"{where} is {_show(given)}", '{"cell", "status", ...}')
        if "cell" not in given:
            raise self.wrong(f'{where}: no "cell"', "the cell where it is, an index or [row, col]")
        status = given.get("status", "idle")
        if status not in STATUSES:
            raise self.wrong(f"{where}: status {_show(status)}", " or ".join(STATUSES))
        cell = self._cell(given["cell"], where)
        area, moves = given.get("area", NO_AREA), self._whole(given.get("moves", 0), f"{where}: moves", MAX_STEP)
        ahead = [self._cell(one, f"{where}: ahead") for one in self._listed(given.get("ahead", []), f"{where}: ahead")]
        if type(area) is not int or area < NO_AREA:
            raise self.wrong(f"{where}: area {_show(area)}", f"the id of an area, or {NO_AREA}")
        if status not in ON_ITS_WAY and (area != NO_AREA or ahead):
            what = "both lost and moving" if status == "dead" else f"{status}, and has an area or a path"
            raise self.wrong(f"{where} is {what}", "no area and nothing ahead", "leave area and ahead out")
        rows, cols = np.divmod(np.array([cell, *ahead]), self.world.shape[1])
        if (np.abs(np.diff(rows)) + np.abs(np.diff(cols)) != 1).any():
            raise self.wrong(f"{where}: ahead jumps", "one cell north, south, east or west at a time")
        cells = self._cells(self._listed(to_do, f"{where}: to_do"), f"{where}: to_do")
        exposure = self._exposure(given.get("exposure"), where)
        return RobotState(cell, status, area, np.array(ahead, dtype=np.int64), cells, moves, held, exposure)

    def _exposure(self, given: Any, where: str) -> int | None:
        if given is not None and not (is_real(given) and 0 <= given <= MOST_NATS):
            raise self.wrong(f"{where}: exposure {_show(given)}", f"nats, 0 to {MOST_NATS:,}")
        return None if given is None else round(given * NAT)

    # --- areas ---

    def _area(self, number: int, given: object) -> AreaState:
        where = f"area {number}"
        if not isinstance(given, dict):
            raise self.wrong(f"{where} is {_show(given)}", '{"level", "robot", "state", "cells"}', ANEW)
        level, robot, state = (given.get(key) for key in ("level", "robot", "state"))
        if type(level) is not int or level < 0:
            raise self.wrong(f"{where}: level {_show(level)}", "the index of a level, 0 or more", ANEW)
        if type(robot) is not int or robot < NO_ROBOT:
            raise self.wrong(f"{where}: robot {_show(robot)}", f"a robot, or {NO_ROBOT}", ANEW)
        if state not in AREA_STATES:
            raise self.wrong(f"{where}: state {_show(state)}", " or ".join(AREA_STATES), ANEW)
        cells = self._cells(self._listed(given.get("cells"), f"{where}: cells"), where)
        if not len(cells):
            raise self.wrong(f"{where}: no cells", "at least one", ANEW)
        return AreaState(level, robot, str(state), cells)

    def check_areas(self, found: MissionState) -> None:
        """Every cell in one area, robots and areas as each says of the other."""
        if not found.areas:
            busy = [number for number, robot in enumerate(found.robots) if robot.status in ON_ITS_WAY]
            if busy:
                status = found.robots[busy[0]].status
                raise self.wrong(f"robot {busy[0]} is {status}, and there are no areas", "idle, done or dead", ANEW)
            return
        held = np.zeros(len(self.free), dtype=np.int64)
        for area in found.areas:
            held[area.cells] += 1
        accessible = self.world.accessible(found.starts).ravel()
        wrong = np.flatnonzero(held != accessible)
        if len(wrong):
            problem = f"cell {self._at(wrong[0])} is in {held[wrong[0]]} areas"
            raise self.wrong(problem, "every cell in reach in one area, no other cell in any", ANEW)
        for number, area in enumerate(found.areas):
            unvisited = ~np.isin(area.cells, found.visited)
            if area.state == "completed" and unvisited.any():
                cell = self._at(area.cells[unvisited][0])
                raise self.wrong(
                    f"area {number} is completed, and its cell {cell} is not visited", "visited ones", ANEW
                )
            if area.state == "unassigned" and not unvisited.any():
                raise self.wrong(f"area {number} is unassigned, and holds visited cells alone", "completed", ANEW)
        for number, robot in enumerate(found.robots):
            self._check_its_area(found, number, robot)
        self._check_owners(found)

    def _check_its_area(self, found: MissionState, number: int, robot: RobotState) -> None:
        if robot.status not in ON_ITS_WAY:
            return
        known = robot.area < len(found.areas) and robot.area != NO_AREA
        if not known or found.areas[robot.area].robot != number or found.areas[robot.area].state == "unassigned":
            raise self.wrong(
                f"robot {number} is {robot.status}, but area {robot.area} is not its own", "its area", ANEW
            )
        if not len(robot.ahead):
            raise self.wrong(f"robot {number} is {robot.status}, and nothing is ahead", "the cells of its path", ANEW)
        strange = np.setdiff1d(robot.to_do, found.areas[robot.area].cells)
        if len(strange) or (robot.status == "traveling" and len(robot.to_do)):
            raise self.wrong(f"robot {number}: to_do is not of its area", "what it has still to cover", ANEW)

    def _check_owners(self, found: MissionState) -> None:
        for number, area in enumerate(found.areas):
            if area.state != "assigned":
                continue
            owner = found.robots[area.robot] if 0 <= area.robot < len(found.robots) else None
            if owner is None or owner.area != number:
                problem = f"area {number} is assigned to robot {area.robot}, which has another or none"
                raise self.wrong(problem, "its own robot", ANEW)

    # --- values ---

    def _get(self, data: Json, key: str, kind: type, default: Any = None) -> Any:
        if key not in data and default is not None:
            return default
        if type(data.get(key)) is not kind:
            problem = f'no "{key}"' if key not in data else f'"{key}" is {_show(data[key])}'
            raise self.wrong(problem, "a list" if kind is list else "an object")
        return data[key]

    def _whole(self, value: object, name: str, most: int) -> int:
        if type(value) is not int or not 0 <= value <= most:
            raise self.wrong(f"{name} is {_show(value)}", f"a whole number, 0 to {most}")
        return value

    def _listed(self, value: object, name: str) -> list[Any]:
        if not isinstance(value, list):
            raise self.wrong(f"{name} is {_show(value)}", "a list of cells")
        return value

    def _cells(self, given: list[Any], name: str) -> NDArray[np.int64]:
        cells = np.array(sorted(self._cell(one, name) for one in given), dtype=np.int64)
        if (np.diff(cells) == 0).any():
            raise self.wrong(f"{name}: cell {self._at(cells[:-1][np.diff(cells) == 0][0])} twice", "once")
        return cells

    def _cell(self, given: Any, name: str) -> int:
        height, width = self.world.shape
        pair = isinstance(given, list) and len(given) == 2 and all(type(one) is int for one in given)
        if pair and 0 <= given[0] < height and 0 <= given[1] < width:
            given = given[0] * width + given[1]
        if type(given) is not int or not 0 <= given < height * width:
            expected = f"an index row * {width} + col, 0..{height * width - 1}, or [row, col]"
            raise self.wrong(f"{name}: cell {_show(given)} is no cell of the map", expected)
        if not self.free[given]:
            raise self.wrong(f"{name}: cell {self._at(given)} is an obstacle", "a free cell")
        return given

    def _at(self, cell: int | np.integer) -> str:
        return str(list(divmod(int(cell), self.world.shape[1])))


def _show(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
