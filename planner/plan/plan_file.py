"""Reading plan files, `mrac-plan` and external plans (bare paths), against a world.

Every number is checked before an engine uses it; every error names robot, step or area, the expectation, and the fix.
"""

from __future__ import annotations

import reprlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_PLAN_BYTES, MAX_STEP, whole
from planner.errors import LOOPS, PlanError
from planner.files import read_json
from planner.plan.plan import FORMAT, VERSION, Area, Leg, Plan, RobotPlan
from planner.plan.reading import at, check_map, check_moves, check_partition, read_cells, read_path
from planner.plan.state_file import parse_state
from planner.settings import BEARING, KEPT, POLICY, SETTINGS, Settings
from planner.simulator.codes import NO_ROBOT, Outcome
from planner.tally import OF_CLOSED_LOOP, WORDS_OF_0_3
from planner.world.keys import Key
from planner.world.start_rule import as_planned
from planner.world.world import MAX_CELLS, MAX_ROBOTS, World

OUTCOMES = tuple(outcome.word for outcome in OF_CLOSED_LOOP if outcome is not Outcome.ALL_ROBOTS_LOST)
REMAKE = "make the plan again with `mrac-jax plan`"
PARTS = ("areas", "areas_added")
LATER = ("nominal", "notes", "plan_for", "state")
"""Keys added since version 1 of the format, which a file may lack."""
FAILURE_KEYS = (*BEARING, "types")
"""Keys of an external plan: its failure model."""


def read_plan_json(path: str | Path) -> object:
    """The JSON of a plan file.

    Raises:
        PlanError: it cannot be read.
    """
    return read_json(Path(path), MAX_PLAN_BYTES, PlanError, "a plan file (JSON)")


def parse_plan(data: object, world: World, source: str) -> Plan:
    """The plan in a file's JSON, checked against a world: `mrac-plan`, or `{"paths": [[[row, col], ...], ...]}`.

    The second form, which may be the bare list of paths, is an external plan: `settings` None, no areas, outcome
    "end_of_paths", time = makespan; cells on no path are counted in `notes`. Unknown keys are ignored.

    Args:
        data: the JSON.
        world: the map.
        source: names the file in errors.

    Raises:
        PlanError: it is no plan, is for another map, or its paths cannot be driven.

    Source: SPEC section 9. Cost: linear in the file and the map.
    """
    top = Key(data, "", source, PlanError, REMAKE)
    # An empty list falls through to the error for a value of the wrong kind.
    if isinstance(data, list) and data:
        if all(isinstance(cell, list) and len(cell) == 2 and all(type(n) is int for n in cell) for cell in data):
            raise top.fault("holds one path", "a list of paths, one a robot", "put it in a list: [[[row, col], ...]]")
        return _external_plan(top, {}, world)
    if not isinstance(data, dict):
        raise top.wrong("a JSON object, or a list of paths")
    # Without the name of our format, a file counts as the output of another planner.
    if data.get("format") == FORMAT:
        return _own_plan(top, world)
    if "paths" not in data:
        problem = f"has the format {reprlib.repr(data['format'])}, and no paths" if "format" in data else "has no paths"
        raise top.fault(problem, f'"format": "{FORMAT}", or "paths": [[[row, col], ...], ...] of another planner')
    keys = top.mapping(("paths",), (*POLICY, *FAILURE_KEYS), strict=False)
    for name in POLICY:
        if name in keys and keys[name].value is not None:
            raise keys[name].wrong("paths only", "leave it out: paths have no areas to decide on")
    return _external_plan(keys["paths"], keys, world)


def _external_plan(paths: Key, keys: dict[str, Key], world: World) -> Plan:
    """An external plan, with a note that counts the accessible cells on no path.

    Its failure model is that of the file, else that of the world.
    """
    source = str(paths.source)
    robots = tuple(RobotPlan(_path(item, world)) for item in _team(paths))
    plan = Plan(world.shape, world.sha256, None, robots, outcome=Outcome.END_OF_PATHS.word, source=world.source)
    missed = _unvisited(plan, world)
    notes: tuple[str, ...] = ()
    if len(missed):
        notes = (f"accessible cells on no path: {len(missed)} (the first: {at(missed[0], world)})",)
    # The file's own failure model, if it has one, replaces that of the world key by key.
    settings = {name: value for name, value in world.team.settings.items() if name in FAILURE_KEYS}
    kept = [name for name in KEPT if name in world.team.settings]
    if kept and ("plan_for" not in keys or keys["plan_for"].value is None):
        notes += (f"robots follow external paths to their end; ignored from {world.source}: {' and '.join(kept)}",)
    settings |= {name: keys[name].setting(SETTINGS[name]) for name in FAILURE_KEYS if name in keys}
    failures = Settings(**settings).failure_model()
    # The number of robots is only known from the paths: settings with a value for each robot are checked here.
    failures.check(len(robots), source)
    world.of_robots(failures.types, len(robots))
    return replace(plan, time=plan.makespan, notes=notes, failures=failures)


def _team(key: Key) -> list[Key]:
    items = key.items("a list with one entry a robot")
    if len(items) > MAX_ROBOTS:
        raise key.fault(f"has {len(items)} robots", f"at most {MAX_ROBOTS}")
    return items


def _own_plan(top: Key, world: World) -> Plan:
    """A plan in the `mrac-plan` format: version, map, settings, paths with legs, areas, nominal outcome."""
    keys = top.mapping(("version", "world", "robots"), ("settings", *PARTS, *LATER, *FAILURE_KEYS), strict=False)
    version = keys["version"].number(whole(1))
    # Older versions lack keys, which have defaults; a newer one may hold keys that change the meaning of others.
    if version > VERSION:
        raise keys["version"].wrong(f"version 1 to {VERSION}", "update mrac-jax")
    check_map(keys["world"], world, "plan for", f"give the map that it was made for, or {REMAKE}")
    entries = [robot.mapping(("path",), ("legs",), strict=False) for robot in _team(keys["robots"])]
    if "settings" not in keys or keys["settings"].value is None:
        return _saved_external_plan(keys, entries, world)
    # A plan with settings must list its areas; one without settings cannot have any.
    top.mapping(PARTS, strict=False)
    given = keys["settings"].mapping(optional=SETTINGS)
    settings = Settings(**{name: key.setting(SETTINGS[name]) for name, key in given.items()})
    settings.check(str(top.source))
    paths = [_path(entry["path"], world) for entry in entries]
    areas, added = (
        tuple(_area(item, len(paths), settings.levels, world) for item in keys[name].items("a list of areas", least=0))
        for name in PARTS
    )
    # Legs refer to areas by their position in the concatenated lists.
    levels = [area.level for area in areas + added]
    robots = tuple(RobotPlan(path, _legs(entry, len(path), levels)) for entry, path in zip(entries, paths, strict=True))
    state = None
    if "state" in keys and keys["state"].value is not None:
        state = parse_state(keys["state"].value, world, f'{top.source}: "state"')
    plan = Plan(
        world.shape, world.sha256, settings, robots, areas, added, notes=_notes(keys), state=state, source=world.source
    )
    # Engines rely on this without a check of their own: each accessible cell is in exactly one area.
    check_partition(areas, as_planned(world, plan.starts), plan.starts, PlanError, str(top.source), REMAKE)
    outcome, time, shares = _nominal(keys, plan, world)
    return replace(plan, outcome=outcome, time=time, shares=shares)


def _saved_external_plan(keys: dict[str, Key], entries: list[dict[str, Key]], world: World) -> Plan:
    """An external plan saved in the `mrac-plan` format: paths without settings, areas and legs."""
    for part in (*(keys[name] for name in PARTS if name in keys), *(one["legs"] for one in entries if "legs" in one)):
        if part.value:
            raise part.wrong("none, as there are no settings")
    robots = keys["robots"]
    paths = Key([entry["path"].value for entry in entries], "robots", robots.source, robots.error, robots.fix)
    plan = _external_plan(paths, keys, world)
    if "plan_for" not in keys or keys["plan_for"].value is None:
        return plan
    keys["plan_for"].choice(("open_loop",), LOOPS)
    return replace(plan, for_open_loop=True, notes=tuple(dict.fromkeys(_notes(keys) + plan.notes)))


def _path(key: Key, world: World) -> NDArray[np.int64]:
    """One robot's path as cell indices, int64 `[steps + 1]`, checked: every cell free, every move one cell."""
    path = read_path(key, world, planned=True)
    check_moves(key, path, world, waits=True)
    return path


def _legs(entry: dict[str, Key], entries: int, levels: list[int]) -> tuple[Leg, ...]:
    """A robot's legs on its path of `entries` entries; `levels`: the level of every area by id."""
    if "legs" not in entry:
        raise entry["path"].fault("has no legs", "a list, [] where they are not known")
    return tuple(_leg(item, entries, levels) for item in entry["legs"].items("a list of legs", least=0))


def _leg(key: Key, entries: int, levels: list[int]) -> Leg:
    """One leg, checked: known kind, an area in `levels` with its level, a range inside the path."""
    keys = key.mapping(("kind", "area", "level", "start", "stop"), strict=False)
    kind: Any = keys["kind"].choice(("travel", "cover"))
    area = keys["area"].number(whole(0, len(levels) - 1, "the id of an area"))
    # A leg repeats its area's level; a different one means that the file was edited by hand.
    level = keys["level"].number(whole(levels[area], levels[area], text=f"{levels[area]}, that of area {area}"))
    start = keys["start"].number(whole(0, entries - 1, "a step of the path"))
    return Leg(kind, area, level, start, keys["stop"].number(whole(start + 1, entries, "a step after its start")))


def _area(key: Key, robots: int, levels: int, world: World) -> Area:
    """One area, with level, owner and cells in range; `levels`: the settings' number of levels."""
    keys = key.mapping(("level", "robot", "cells"), strict=False)
    said = f"0..{levels - 1} (the plan's setting levels is {levels})"
    level = keys["level"].number(whole(0, levels - 1, text=said))
    robot = keys["robot"].number(whole(NO_ROBOT, robots - 1, text=f"a robot 0..{robots - 1}, or {NO_ROBOT} for none"))
    cells = read_cells(keys["cells"], world)
    # An empty area would never be completed by a visit.
    if not len(cells):
        raise keys["cells"].wrong("at least one cell")
    return Area(level, robot, cells)


def _nominal(keys: dict[str, Key], plan: Plan, world: World) -> tuple[str, int, int]:
    """(outcome, time, shares) of the nominal run, as saved, or computed if the file lacks them."""
    if "nominal" not in keys:
        # Files of version 1 have no nominal outcome: the paths tell it, and `confirm_plan` counts shared areas.
        complete = not len(_unvisited(plan, world))
        ended = Outcome.COMPLETE if complete else plan.ending(Outcome.STEP_LIMIT)
        return ended.word, plan.makespan, 0
    given = keys["nominal"].mapping(("outcome", "time", "shares"), strict=False)
    time = given["time"].number(whole(plan.makespan, MAX_STEP, "the step of the last move or a later one"))
    word = given["outcome"].choice(OUTCOMES, WORDS_OF_0_3)
    return plan.ending(Outcome[word.upper()]).word, time, given["shares"].number(whole(0, MAX_CELLS))


def _unvisited(plan: Plan, world: World) -> NDArray[np.int64]:
    """Accessible cells on no path, int64 indices in increasing order."""
    visited = np.zeros(world.shape[0] * world.shape[1], dtype=bool)
    for robot in plan.robots:
        visited[robot.path] = True
    return np.flatnonzero(as_planned(world, plan.starts).accessible(plan.starts).ravel() & ~visited)


def _notes(keys: dict[str, Key]) -> tuple[str, ...]:
    items = keys["notes"].items("a list of strings", least=0) if "notes" in keys else []
    return tuple(item.text("a string") for item in items)
