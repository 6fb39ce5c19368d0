"""Reading plan files, the project's own (`mrac-plan`) and the bare paths of any other planner, against a world.

Nothing that a file claims is believed: every number is checked before an engine sees it, and every error says which
robot, step or area is wrong, what was expected, and what to do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.files import Json, read_json
from planner.limits import MAX_PLAN_BYTES, MAX_STEP
from planner.none import NO_ROBOT
from planner.plans.plan import FORMAT, VERSION, Area, Leg, Plan, RobotPlan
from planner.plans.state_file import parse_state
from planner.settings import BEARING, POLICY, SETTINGS, Settings
from planner.worlds.world import MAX_CELLS, MAX_ROBOTS, World

OUTCOMES = ("complete", "stuck", "timeout", "called_off")
NOTHING: Mapping[str, Any] = {}
REMAKE = "make the plan anew with `mrac-jax plan`"


def load_plan(path: str | Path, world: World) -> Plan:
    """The plan in a JSON file, checked against `world`: SPEC's plan file, or `{"paths": [[[row, col], ...], ...]}`.

    The second form, which may be the bare list of paths, is the plan of another planner: `settings` None, no areas,
    outcome "paths", time = makespan; cells that it leaves out are counted in `notes`. Unknown keys are ignored.

    Raises:
        PlanError: the file cannot be read, is no plan, belongs to another map, or its paths cannot be driven.

    Source: SPEC section 9. Cost: linear in the file and the map.
    """
    return parse_plan(read_json(Path(path), MAX_PLAN_BYTES, PlanError, "a plan file (JSON)"), world, str(path))


def parse_plan(data: object, world: World, source: str) -> Plan:
    """`load_plan` of a file's JSON; `source` names it in errors. Raises PlanError."""
    if isinstance(data, list) and data:
        return _bare_paths(data, world, source)
    if not isinstance(data, dict):
        raise PlanError(f"holds {_show(data)}", source=source, expected="a JSON object, or a list of paths", fix=REMAKE)
    if data.get("format") == FORMAT:
        return _own_plan(data, world, source)
    if "paths" in data:
        for key in POLICY:
            if data.get(key) is not None:
                problem = f'"{key}" beside the paths of another planner'
                raise PlanError(problem, source=source, expected="paths alone", fix="leave it out: paths are followed")
        return _foreign_plan(data["paths"], world, source, '"paths"', data)
    raise PlanError(
        f'"format" is {_show(data.get("format"))} and there is no "paths"',
        source=source,
        expected=f'"format": "{FORMAT}", or "paths": [[[row, col], ...], ...] of another planner',
    )


def _bare_paths(data: list[Any], world: World, source: str) -> Plan:
    """The plan of another planner as a bare list, one path a robot; PlanError with the right hint for a lone path."""
    if all(isinstance(cell, list) and len(cell) == 2 and all(type(n) is int for n in cell) for cell in data):
        problem = f"holds one path, {_show(data)}"
        fix = "put it in a list: [[[row, col], ...]]"
        raise PlanError(problem, source=source, expected="a list of paths, one a robot", fix=fix)
    return _foreign_plan(data, world, source, "the list")


def _foreign_plan(paths: Any, world: World, source: str, key: str, data: Mapping[str, Any] = NOTHING) -> Plan:
    """The plan of another planner, with a note that counts the accessible cells on no path.

    What its robots bear is as the file says, else as the world does.
    """
    _check_team(paths, source, key)
    robots = tuple(RobotPlan(_path(path, robot, world, source)) for robot, path in enumerate(paths))
    plan = Plan(world.shape, world.sha256, None, robots, outcome="paths")
    missed = _unvisited(plan, world)
    notes: tuple[str, ...] = ()
    if len(missed):
        notes = (f"accessible cells on no path: {len(missed)} (the first: {_cell(missed[0], world)})",)
    told = {name: (data if name in data else world.team.settings)[name] for name in BEARING if _told(name, data, world)}
    settings = _settings(told, source)
    bears = settings.bearing()
    bears.check(len(robots), source)
    return replace(plan, time=plan.makespan, notes=notes, bears=bears)


def _told(name: str, data: Mapping[str, Any], world: World) -> bool:
    return name in data or name in world.team.settings


def _own_plan(data: Json, world: World, source: str) -> Plan:
    """A plan in the project's own format: version, map, settings, paths with legs, areas, nominal outcome."""
    version = _get(data, "version", int, source)
    if version != VERSION:
        newer = "update mrac-jax" if version > VERSION else REMAKE
        raise PlanError(f"plan version {_show(version)}", source=source, expected=f"version {VERSION}", fix=newer)
    _check_map(_get(data, "world", dict, source), world, source)
    given = _get(data, "robots", list, source)
    _check_team(given, source, '"robots"')
    for robot, entry in enumerate(given):
        if not isinstance(entry, dict):
            raise PlanError(f"robot {robot} is {_show(entry)}", source=source, expected='{"path", "legs"}', fix=REMAKE)
    if data.get("settings") is None:
        return _saved_foreign_plan(data, given, world, source)
    settings = _settings(_get(data, "settings", dict, source), source)
    paths = [_path(entry.get("path"), robot, world, source) for robot, entry in enumerate(given)]
    reader = partial(_area, robots=len(given), levels=settings.levels, world=world, source=source)
    areas = tuple(reader(*item) for item in enumerate(_get(data, "areas", list, source)))
    added = tuple(reader(*item) for item in enumerate(_get(data, "areas_added", list, source), start=len(areas)))
    levels = [area.level for area in areas + added]
    robots = tuple(RobotPlan(path, _legs(given[r], r, len(path), levels, source)) for r, path in enumerate(paths))
    state = None if data.get("state") is None else parse_state(data["state"], world, f'{source}: "state"')
    plan = Plan(world.shape, world.sha256, settings, robots, areas, added, notes=_notes(data, source), state=state)
    _check_partition(plan, world, source)
    outcome, time, shares = _nominal(data, plan, world, source)
    return replace(plan, outcome=outcome, time=time, shares=shares)


def _saved_foreign_plan(data: Json, given: list[Json], world: World, source: str) -> Plan:
    """Another planner's plan that was saved in our format: paths alone, without settings, areas and legs."""
    if data.get("areas") or data.get("areas_added") or any(entry.get("legs") for entry in given):
        raise PlanError('areas or legs, but "settings" is null', source=source, expected="both or neither", fix=REMAKE)
    paths = [_get(entry, "path", list, source, f"robot {robot}: ") for robot, entry in enumerate(given)]
    plan = _foreign_plan(paths, world, source, '"robots"', data)
    if data.get("plan_for") is None:
        return plan
    if data["plan_for"] != "open":
        problem = f'"plan_for" is {_show(data["plan_for"])}, but "settings" is null'
        raise PlanError(problem, source=source, expected='"open", or left out', fix=REMAKE)
    return replace(plan, for_open_loop=True, notes=tuple(dict.fromkeys(_notes(data, source) + plan.notes)))


def _check_team(given: object, source: str, key: str) -> None:
    if not isinstance(given, list) or not given:
        raise PlanError(f"{key} is {_show(given)}", source=source, expected="a list with one entry a robot")
    if len(given) > MAX_ROBOTS:
        raise PlanError(f"{len(given)} robots in {key}", source=source, expected=f"at most {MAX_ROBOTS}")


def _check_map(given: Json, world: World, source: str) -> None:
    """PlanError "plan for another map" unless shape and hash are those of `world`."""
    shape, sha256 = _get(given, "shape", list, source, '"world": '), _get(given, "sha256", str, source, '"world": ')
    fix = f"give the map that it was made for, or {REMAKE}"
    if shape != list(world.shape):
        problem = f"plan for another map: {_show(shape)} cells"
        raise PlanError(problem, source=source, expected=f"{list(world.shape)} as {world.source}", fix=fix)
    if sha256 != world.sha256:
        problem = f"plan for another map: sha256 {_show(sha256[:12])}..."
        raise PlanError(problem, source=source, expected=f"{world.sha256[:12]}... as {world.source}", fix=fix)


def _path(given: object, robot: int, world: World, source: str) -> NDArray[np.int64]:
    """One robot's path as cell indices, int64 `[steps + 1]`: every cell on the map and free, every move one cell."""
    if not isinstance(given, list) or not given:
        problem = f"robot {robot}: its path is {_show(given)}"
        raise PlanError(problem, source=source, expected="at least the start: [[row, col], ...]")
    if len(given) - 1 > MAX_STEP:
        raise PlanError(f"robot {robot}: {len(given) - 1} steps", source=source, expected=f"at most {MAX_STEP}")
    cells = _cells_of(given)
    if cells is None or not ((cells >= 0) & (cells < world.shape)).all():
        _refuse_entry(given, robot, world, source)
    assert cells is not None
    _check_drivable(cells, robot, world, source)
    return cells[:, 0] * world.shape[1] + cells[:, 1]


def _cells_of(given: list[Any]) -> NDArray[np.int64] | None:
    """Pairs of whole numbers as int64 `[entries, 2]`, or None if something else is among them."""
    if set(map(type, given)) != {list} or set(map(len, given)) != {2}:
        return None
    flat = list(chain.from_iterable(given))
    if set(map(type, flat)) != {int}:
        return None
    try:
        return np.array(flat, dtype=np.int64).reshape(-1, 2)
    except OverflowError:
        return None


def _refuse_entry(given: list[Any], robot: int, world: World, source: str) -> None:
    """PlanError for the first entry of a path that is no cell of the map."""
    height, width = world.shape
    for step, cell in enumerate(given):
        if not (type(cell) is list and len(cell) == 2 and type(cell[0]) is int and type(cell[1]) is int):
            problem = f"robot {robot}, step {step}: {_show(cell)}"
            raise PlanError(problem, source=source, expected="[row, col], two whole numbers")
        if not (0 <= cell[0] < height and 0 <= cell[1] < width):
            raise PlanError(
                f"robot {robot}, step {step}: cell {_show(cell)} is off the map",
                source=source,
                expected=f"row 0..{height - 1} and col 0..{width - 1}",
                fix="cells are [row, col] from 0, row 0 at the top, not [x, y]",
            )


def _check_drivable(cells: NDArray[np.int64], robot: int, world: World, source: str) -> None:
    """PlanError at the first obstacle on a path of (row, col), int64 `[steps + 1, 2]`, or at its first jump."""
    blocked = np.flatnonzero(np.isnan(world.threat[cells[:, 0], cells[:, 1]]))
    if len(blocked):
        step = int(blocked[0])
        raise PlanError(
            f"robot {robot}, step {step}: cell {cells[step].tolist()} is an obstacle ({len(blocked)} such steps)",
            source=source,
            expected="free cells",
            fix="cells are [row, col] from 0, row 0 at the top: check that the plan is for this map",
        )
    jumps = np.flatnonzero(np.abs(np.diff(cells, axis=0)).sum(axis=1) > 1)
    if len(jumps):
        step = int(jumps[0]) + 1
        raise PlanError(
            f"robot {robot}, step {step}: a jump from {cells[step - 1].tolist()} to cell {cells[step].tolist()} "
            f"({len(jumps)} such steps)",
            source=source,
            expected="one cell north, south, east or west, or waiting",
            fix="write every cell on the way",
        )


def _legs(given: Json, robot: int, entries: int, levels: list[int], source: str) -> tuple[Leg, ...]:
    """A robot's legs on its path of `entries` entries; `levels`: the level of every area by id."""
    legs = _get(given, "legs", list, source, f"robot {robot}: ")
    return tuple(
        _leg(leg, f"robot {robot}, leg {number}: ", entries, levels, source) for number, leg in enumerate(legs)
    )


def _leg(given: object, where: str, entries: int, levels: list[int], source: str) -> Leg:
    """One leg: its kind known, its area one of those in `levels` and of that level, its range inside the path."""
    if not isinstance(given, dict):
        raise PlanError(f"{where}{_show(given)}", source=source, expected="an object", fix=REMAKE)
    kind = _get(given, "kind", str, source, where)
    if kind not in ("travel", "cover"):
        raise PlanError(f"{where}kind {_show(kind)}", source=source, expected='"travel" or "cover"', fix=REMAKE)
    area, level, start, stop = (_get(given, key, int, source, where) for key in ("area", "level", "start", "stop"))
    if not 0 <= area < len(levels):
        expected = f"an area id 0..{len(levels) - 1}"
        raise PlanError(f"{where}area {_show(area)}", source=source, expected=expected, fix=REMAKE)
    if level != levels[area]:
        expected = f"{levels[area]}, that of area {area}"
        raise PlanError(f"{where}level {_show(level)}", source=source, expected=expected, fix=REMAKE)
    if not 0 <= start < stop <= entries:
        problem = f"{where}steps {_show([start, stop])} out of range"
        raise PlanError(problem, source=source, expected=f"0 <= start < stop <= {entries}", fix=REMAKE)
    return Leg("travel" if kind == "travel" else "cover", area, level, start, stop)


def _area(number: int, given: object, *, robots: int, levels: int, world: World, source: str) -> Area:
    """One area, with level, owner and cells in range; `levels`: the settings' most levels."""
    where = f"area {number}: "
    if not isinstance(given, dict):
        raise PlanError(f"{where}{_show(given)}", source=source, expected="an object", fix=REMAKE)
    level, robot = _get(given, "level", int, source, where), _get(given, "robot", int, source, where)
    if not 0 <= level < levels:
        expected = f"0..{levels - 1} (the plan's setting levels is {levels})"
        raise PlanError(f"{where}level {_show(level)}", source=source, expected=expected, fix=REMAKE)
    if not NO_ROBOT <= robot < robots:
        expected = f"a robot 0..{robots - 1}, or {NO_ROBOT} for none"
        raise PlanError(f"{where}robot {_show(robot)}", source=source, expected=expected, fix=REMAKE)
    return Area(level, robot, _area_cells(_get(given, "cells", list, source, where), where, world, source))


def _area_cells(given: list[Any], where: str, world: World, source: str) -> NDArray[np.int64]:
    """Cells of an area, increasing: int64 `[cells]`, each free, on the map and named once."""
    height, width = world.shape
    last = height * width - 1
    for cell in given:
        if type(cell) is not int or not 0 <= cell <= last:
            problem = f"{where}cell {_show(cell)} is no cell of the map"
            raise PlanError(problem, source=source, expected=f"an index row * {width} + col, 0..{last}", fix=REMAKE)
    cells = np.sort(np.array(given, dtype=np.int64))
    if not len(cells):
        raise PlanError(f"{where}no cells", source=source, expected="at least one", fix=REMAKE)
    repeated = cells[1:][cells[1:] == cells[:-1]]
    if len(repeated):
        raise PlanError(f"{where}cell {_cell(repeated[0], world)} twice", source=source, expected="once", fix=REMAKE)
    blocked = cells[np.isnan(world.threat.ravel()[cells])]
    if len(blocked):
        problem = f"{where}cell {_cell(blocked[0], world)} is an obstacle"
        raise PlanError(problem, source=source, expected="free cells", fix=REMAKE)
    return cells


def _check_partition(plan: Plan, world: World, source: str) -> None:
    """PlanError unless every accessible cell is in exactly one area at t = 0: the engines rely on it."""
    holders = np.zeros(world.shape[0] * world.shape[1], dtype=np.int64)
    for area in plan.areas:
        holders[area.cells] += 1
    wrong = np.flatnonzero(holders != world.accessible(plan.starts).ravel())
    if len(wrong):
        problem = f"cell {_cell(wrong[0], world)} is in {holders[wrong[0]]} areas ({len(wrong)} such cells)"
        expected = "every cell that a robot can reach in one area, no other cell in any"
        raise PlanError(problem, source=source, expected=expected, fix=REMAKE)


def _settings(given: Json, source: str) -> Settings:
    """Settings; keys left out take their default, an unknown key is an error: it would be a choice not followed."""
    given = {key: tuple(value) if isinstance(value, list) else value for key, value in given.items()}
    for key, value in given.items():
        if key not in SETTINGS:
            raise PlanError(f"unknown setting {_show(key)}", source=source, expected=", ".join(SETTINGS), fix=REMAKE)
        if not SETTINGS[key].accepts(value):
            expected = SETTINGS[key].expected("null")
            raise PlanError(f"setting {key} is {_show(value)}", source=source, expected=expected, fix=REMAKE)
    settings = Settings(**{key: SETTINGS[key].plain(value) for key, value in given.items()})
    settings.check(source)
    return settings


def _nominal(data: Json, plan: Plan, world: World, source: str) -> tuple[str, int, int]:
    """How the nominal run ended: (outcome, time, shares), as saved, or worked out when the file leaves it out."""
    if "nominal" not in data:
        complete = not len(_unvisited(plan, world))
        return "complete" if complete else "timeout", plan.makespan, count_shares(plan)
    where = '"nominal": '
    given = _get(data, "nominal", dict, source)
    outcome = _get(given, "outcome", str, source, where)
    if outcome not in OUTCOMES:
        raise PlanError(f"{where}outcome {_show(outcome)}", source=source, expected=" or ".join(OUTCOMES), fix=REMAKE)
    time, shares = _get(given, "time", int, source, where), _get(given, "shares", int, source, where)
    if not plan.makespan <= time <= MAX_STEP:
        expected = f"{plan.makespan} (the last move) or later, at most {MAX_STEP}"
        raise PlanError(f"{where}time {_show(time)}", source=source, expected=expected, fix=REMAKE)
    if not 0 <= shares <= MAX_CELLS:
        raise PlanError(f"{where}shares {_show(shares)}", source=source, expected="0 or more", fix=REMAKE)
    return outcome, time, shares


def count_shares(plan: Plan) -> int:
    """How often the nominal run shared an area: the areas that `areas_added` were cut from, each cut once at most."""
    holder: dict[int, int] = {int(cell): number for number, area in enumerate(plan.areas) for cell in area.cells}
    parents = []
    for number, area in enumerate(plan.areas_added, start=len(plan.areas)):
        parents.append(holder.get(int(area.cells[0]), number))
        holder.update((int(cell), number) for cell in area.cells)
    return sum(before != after for before, after in pairwise([-1, *parents]))


def _unvisited(plan: Plan, world: World) -> NDArray[np.int64]:
    """Accessible cells that are on no path, int64 indices in increasing order."""
    visited = np.zeros(world.shape[0] * world.shape[1], dtype=bool)
    for robot in plan.robots:
        visited[robot.path] = True
    return np.flatnonzero(world.accessible(plan.starts).ravel() & ~visited)


def _notes(data: Json, source: str) -> tuple[str, ...]:
    notes = data.get("notes", [])
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise PlanError(f'"notes" is {_show(notes)}', source=source, expected="a list of strings", fix=REMAKE)
    return tuple(notes)


def _get(data: Json, key: str, kind: type, source: str, where: str = "") -> Any:
    """`data[key]`, of exactly this JSON type (true is no integer, 2.0 is none either); else PlanError."""
    if key not in data:
        raise PlanError(f'{where}no "{key}"', source=source, expected=f"a plan of version {VERSION}", fix=REMAKE)
    if type(data[key]) is not kind:
        expected = {int: "a whole number", str: "a string", list: "a list", dict: "an object"}[kind]
        raise PlanError(f'{where}"{key}" is {_show(data[key])}', source=source, expected=expected, fix=REMAKE)
    return data[key]


def _cell(index: int | np.integer, world: World) -> str:
    row, col = divmod(int(index), world.shape[1])
    return f"[{row}, {col}]"


def _show(value: object) -> str:
    """A value from a file for a message, as JSON, cut to a readable length without writing all of it out."""
    if isinstance(value, list | dict) and len(value) > 4:
        return f"a{' list' if isinstance(value, list) else 'n object'} of {len(value)}"
    if isinstance(value, int) and abs(value) >= 10**20:
        return f"a number of {value.bit_length()} bits"
    if isinstance(value, list):
        return f"[{', '.join(_show(item) if not isinstance(item, list) else '[...]' for item in value)}]"
    if isinstance(value, dict):
        return f"an object with {', '.join(_show(key) for key in value) or 'nothing'}"
    return _short(json.dumps(value))


def _short(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
