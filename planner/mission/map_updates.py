"""Map updates of a driven mission: observed cells, closed cells, phases and hazard estimates; and mission files.

The effects are those in a simulated run: `planner.simulator.map_belief`, SPEC section 15.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import MAX_PLAN_BYTES, Numbers, whole
from planner.errors import StateError, WorldError
from planner.files import Json, read_json, write_json
from planner.make_plan import areas_of, make_plan
from planner.mission.team_control import Fleet, Reports, whole_numbers
from planner.mrac.areas import connected_parts
from planner.mrac.problem import Problem, Unknown, prepare
from planner.plan.plan import Plan, RobotPlan
from planner.plan.reading import at, check_map
from planner.plan.state import FORMAT, NO_CELLS, ON_ITS_WAY, VERSION, AreaState, MissionState, RobotState
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.single_run import SingleRun, state_of
from planner.settings import SETTINGS, Settings
from planner.simulator.codes import ALWAYS, NO_AREA, NO_ROBOT, Doing, Outcome
from planner.tally import WORDS_OF_0_3
from planner.world.keys import PROBABILITY, Key
from planner.world.levels import NO_LEVEL, find_levels
from planner.world.map_knowledge import Knowledge, Sensor, added
from planner.world.moving_threats import Phases
from planner.world.uncertain_maps import Hazard
from planner.world.world import MAX_CELLS, World

Seen = dict[int, float | None]
"""p of each cell, by index; None: an obstacle."""
ANOTHER = NO_LEVEL - 1
"""Level of a cell whose update is still to come: neither a level nor an obstacle."""
EXPECTED = "[[row, col, p], ...], p = null for an obstacle"


def seen_by(given: Any, fleet: Fleet, reported: Mapping[int, int]) -> Seen:
    """Observed cells, checked.

    Args:
        given: `[[row, col, p], ...]`.
        fleet: the team.
        reported: cells that robots reported in this step.

    Raises:
        StateError: they cannot be true, or robots cannot react to them.
    """
    if (fleet.raw.robots["doing"] == Doing.FOLLOWING).any() or fleet.problem.stay_inside:
        problem = "robots on external paths, or whose legs stay in their area, cannot react to observed cells"
        raise StateError(problem, expected='a plan with areas, and `transit="grid"`')
    (height, width), where = fleet.problem.world.shape, {*fleet.places.values(), *reported.values()}
    rows, cols, found = whole(0, height - 1), whole(0, width - 1), dict[int, float | None]()
    listed = (
        [list(one) if isinstance(one, tuple) else one for one in given] if isinstance(given, list | tuple) else given
    )
    for one in Key(listed, "seen", "", StateError).items(EXPECTED, least=0):
        row, col, p = one.items(EXPECTED, exactly=3)
        cell = row.number(rows) * width + col.number(cols)
        if p.value is None and cell in where:
            problem = f"[{row.value}, {col.value}] is reported as an obstacle, but a robot is there"
            raise StateError(problem, expected="one of the two")
        expected = f"{PROBABILITY.expected}, or null for an obstacle"
        found[cell] = None if p.value is None else p.number(PROBABILITY, expected)
    return found


def seen_world(world: World, seen: Seen, given: World | None = None) -> World:
    """The world with observed cells.

    Args:
        world: the map.
        seen: p by cell.
        given: the initial map, which has the values of all cells.
    """
    threat = world.threat.copy()
    for cell, p in seen.items():
        threat.flat[cell] = np.nan if p is None else p
    values = (given or world).value
    value = None if values is None else np.where(np.isnan(threat), 0.0, values)
    return replace(world, threat=threat, starts=None, value=value)


def map_changes(world: World, seen: Seen) -> NDArray[np.int64]:
    """The observed cells that differ from the map, int64, increasing.

    Args:
        world: the map.
        seen: p by cell.
    """
    was, now = world.threat.ravel(), seen_world(world, seen).threat.ravel()
    return np.flatnonzero((was != now) & ~(np.isnan(was) & np.isnan(now)))


def learned_state(
    state: MissionState, world: World, changed: NDArray[np.int64], settings: Settings
) -> tuple[MissionState, bool]:
    """The state on an updated map: rules (2) to (5) of SPEC section 15.

    Levels are those of the new map. If they are quantised, a cell whose level differs from most of its area's counts as
    changed too.

    Args:
        state: on the old map.
        world: the new map.
        changed: int64, changed cells, increasing.
        settings: of the plan.

    Returns:
        (state, whether some robot got an area).
    """
    state = _without_completed(_on_free_cells(state, world))
    problem = prepare(world, state.starts, settings, homes=state.homes(settings.return_to))
    levels, updated = problem.levels.of_cell, np.zeros(world.free.size, dtype=np.bool_)
    updated[changed] = True
    areas = []
    for area in state.areas:
        known = levels[area.cells[~updated[area.cells]]]
        known = known[known != NO_LEVEL]
        level = int(np.bincount(known).argmax()) if len(known) else 0
        updated[area.cells] |= (levels[area.cells] != level) & (levels[area.cells] != NO_LEVEL)
        areas.append(replace(area, level=level))
    state = replace(state, areas=tuple(areas))
    state, got = _believing(problem, state, updated)
    seen = np.zeros(len(updated), dtype=np.bool_)
    seen[state.visited] = True
    state, left = _without_completed(state), problem.levels.accessible.copy()
    for area in state.areas:
        left[area.cells] = False
    visited, survived = (cells[levels[cells] != NO_LEVEL] for cells in (state.visited, state.survived))
    areas = [*state.areas, *_unheld(world, left, levels, seen)]
    return replace(state, visited=visited, survived=survived, areas=tuple(areas)), got


def _on_free_cells(state: MissionState, world: World) -> MissionState:
    """The state with lost robots on obstacles moved to a living one's cell: starts have to be free cells."""
    free, here = world.free.ravel(), next(robot.cell for robot in state.robots if robot.alive)
    robots = (robot if free[robot.cell] else replace(robot, cell=here) for robot in state.robots)
    return replace(state, robots=tuple(robots))


def _believing(problem: Problem, state: MissionState, updated: NDArray[np.bool_]) -> tuple[MissionState, bool]:
    """The state after robots have updated the cells `updated` `[N]`; and whether one got an area.

    For the simulator the new map is that of an announced phase that begins with the next step.
    """
    levels, within = problem.levels.of_cell, problem.levels.accessible.copy()
    for cells in (state.visited, problem.starts, *(area.cells for area in state.areas)):
        within[cells] = True
    belief = np.where(updated, ANOTHER, levels).astype(np.int16)
    begins = np.array([0, state.step + 1])
    known, phases = Knowledge(problem.world.threat, Sensor()), Phases(begins, np.stack([problem.world.threat] * 2))
    unknown = Unknown(
        known, problem.levels.values, problem.levels.quantised, belief, np.stack([belief, levels]), within,
        problem.levels.accessible, phases=phases,
    )  # fmt: skip
    learning = replace(problem, unknown=unknown)
    robots = tuple(RobotPlan(cell) for cell in problem.starts[:, None])
    world = problem.world
    plan = Plan(world.shape, world.sha256, problem.settings, robots, areas_of(state), state=state)
    loop = compile_closed_loop(plan, world, problem=learning, interpreted=True)
    if not loop.learns:  # no changed cell is reachable
        return state, False
    run = SingleRun(replace(loop, tables=loop.tables._replace(phases=begins)))
    got = run.learn()
    return state_of(run, problem, state.exposures), got


def _without_completed(state: MissionState) -> MissionState:
    """The state without areas that have nothing to do, except those in which robots still drive."""
    kept = [number for number, area in enumerate(state.areas) if area.state != "completed" or area.robot != NO_ROBOT]
    place = {number: index for index, number in enumerate(kept)}
    robots = (replace(r, area=place[r.area]) if r.status in ON_ITS_WAY else r for r in state.robots)
    return replace(state, robots=tuple(robots), areas=tuple(state.areas[number] for number in kept))


def _unheld(
    world: World, left: NDArray[np.bool_], levels: NDArray[np.int16], visited: NDArray[np.bool_]
) -> Iterator[AreaState]:
    """Areas of the remaining cells, bool `[N]`: with nothing to do, or out of every robot's reach."""
    for of, what in ((left & visited, "completed"), (left & ~visited, "unassigned")):
        for level in np.unique(levels[of]):
            for part in connected_parts(world.shape, np.flatnonzero(of & (levels == level))):
                yield AreaState(int(level), NO_ROBOT, what, part)


# Cells that are closed during a mission: its world and its state without them.


def closed_by(given: ArrayLike, reports: Reports) -> tuple[NDArray[np.int64], World]:
    """Cells to close, checked, and the world of the fleet without them.

    Args:
        given: `[[row, col], ...]`.
        reports: of the current step.

    Returns:
        (indices int64, increasing; world).

    Raises:
        StateError: a robot is on one of them, or has reported so; they separate a robot from the cell that it reported
            in this step; or they are not on the map.
    """
    fleet, found = reports.fleet, whole_numbers(given)
    world, (height, width) = fleet.problem.world, fleet.problem.world.shape
    if found.ndim != 2 or found.shape[1] != 2 or not len(found):
        raise StateError(f"cells to close are {given!r:.60}", expected="[[row, col], ...]")
    if not ((found >= 0) & (found < (height, width))).all():
        raise StateError("cells to close lie off the map", expected=f"row 0..{height - 1} and col 0..{width - 1}")
    if not fleet.alive.any():
        raise StateError("every robot is lost", expected="a robot that goes on")
    cells = np.unique(found.astype(np.int64) @ (width, 1))
    reported = [(number, report.cell) for number, report in reports.now.items()]
    for number, cell in sorted({*fleet.places.items(), *reported}):
        if cell in cells:
            problem = f"robot {number} is at {at(cell, world)}, which is to be closed"
            raise StateError(problem, expected="cells without a robot", fix="close it when the robot has left it")
    without = seen_world(world, dict.fromkeys(cells.tolist()))
    part = without.components.ravel()
    for number, cell in reported:
        if part[cell] != part[fleet.cell(number)]:
            problem = f"closing these cells cuts robot {number} off from {at(cell, world)}"
            raise StateError(problem, expected="cells to close once the step in which it went there is over")
    return cells, without


def closed_state(state: MissionState, world: World, levels: int) -> MissionState:
    """The state after cells were closed; no robot alive is on one.

    Areas lose cells that are closed or out of reach, and are split if these leave them disconnected or with several
    levels (levels are quantised over reachable cells). A robot keeps the reachable part with most to do; the others are
    unassigned. A robot whose path or cells to cover have changed has nothing ahead: it starts again.

    Args:
        state: before.
        world: with the closed cells.
        levels: most threat levels.
    """
    state = _on_free_cells(state, world)
    kept = world.accessible(state.starts).ravel()
    level_of, labels = find_levels(world.threat, kept.reshape(world.shape), levels).of_cell, world.components.ravel()
    seen = np.zeros(kept.size, dtype=np.bool_)
    seen[state.visited] = True

    def left_in(cells: NDArray[np.int64]) -> int:
        return int(np.count_nonzero(~seen[cells]))

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
    visited, survived = (cells[kept[cells]] for cells in (state.visited, state.survived))
    covered: dict[str, Any] = {"visited": visited, "survived": survived, "areas": tuple(areas)}
    return replace(state, sha256=world.sha256, robots=robots, quiet=0, **covered)


def _still(robot: RobotState, area: int, areas: list[AreaState], kept: NDArray[np.bool_]) -> RobotState:
    """The robot with its remaining work; with nothing ahead if its path or its cells to cover have changed."""
    if robot.status not in ON_ITS_WAY:
        return robot
    if area == NO_AREA:
        return robot.at_rest
    if kept[robot.ahead].all() and np.isin([*robot.to_do, robot.ahead[-1]], areas[area].cells).all():
        return replace(robot, area=area)
    return replace(robot, area=area, status="traveling", ahead=NO_CELLS, to_do=NO_CELLS)


# Phases and hazard estimates of a driven mission.
#
# They update the map at the end of a step as observed cells do: plans use the current p.


class HazardUpdates:
    """Phases and hazard estimates of one mission.

    Attributes:
        phases: of its threats, or None. evidence: of its hazards, or None.
        odds: int64 `[N]`, log odds of a hazard in each cell; empty without evidence.
        wrecks: cells of lost robots that become obstacles once no live robot is there, by robot; None: none does.
    """

    def __init__(self, world: World, plan: Plan) -> None:
        """Raises WorldError for a combination that driven missions do not support."""
        hazard = world.uncertainty if isinstance(world.uncertainty, Hazard) and world.uncertainty.learn else None
        self.phases = world.phases
        self.evidence = None if hazard is None else hazard.evidence
        if hazard is not None and hazard.detector is not None:
            problem = f"a mission that is driven reads no detector; here: {hazard.description}"
            fix = "leave out `sensor_range`, and report its readings by `seen`"
            raise WorldError(problem, source=world.source, fix=fix)
        if self.evidence is None and world.phases is None:
            world.require_known_map("a mission that is driven")
        elif plan.is_external or (plan.settings is not None and plan.settings.transit == "area"):
            world.require_known_map("a mission on external paths, or whose legs stay in their area,")
        self.odds = np.zeros(0, dtype=np.int64) if self.evidence is None else self.evidence.prior.copy()
        self._happened: set[int] = set()
        self.wrecks: dict[int, int] | None = {} if plan.settings is not None and plan.settings.blocks else None

    def __bool__(self) -> bool:
        return self.evidence is not None or self.phases is not None

    def learn(self, robot: int, cell: int, *, stopped: bool) -> None:
        """Update the estimate, and the wrecks, after a visit.

        Args:
            robot, cell: indices.
            stopped: whether the robot is lost in it.
        """
        if stopped and self.wrecks is not None:
            self.wrecks[robot] = cell
        if self.evidence is not None:
            at = np.array([cell])
            self.odds[at] = self.evidence.stop if stopped else added(self.odds[at], -self.evidence.survival[at])
            self._happened.add(cell)

    def new_wrecks(self, places: Mapping[int, int]) -> set[int]:
        """Cells of lost robots that become obstacles at the end of a step.

        Args:
            places: the cell of each robot that is not lost. A robot that was found again is no wreck.
        """
        wrecks = {robot: cell for robot, cell in (self.wrecks or {}).items() if robot not in places}
        if self.wrecks:
            self.wrecks = {robot: cell for robot, cell in wrecks.items() if cell in places.values()}
        return {*wrecks.values()} - {*places.values()}

    def last_update(self, accessible: NDArray[np.bool_]) -> int:
        """Begin of the last announced phase that changes p of an accessible cell `[N]`; 0: none."""
        if self.phases is None or not self.phases.are_announced:
            return 0
        maps = self.phases.threats.reshape(len(self.phases.begins), -1)[:, accessible]
        return int(self.phases.begins[1:][(maps[1:] != maps[:-1]).any(axis=1)].max(initial=0))

    def at_end(self, step: int, world: World, held: Iterable[int]) -> Seen:
        """p of changed cells at the end of a step; no obstacles in robots' cells.

        Args:
            step: that ends.
            world: the map.
            held: cells of robots.
        """
        updates: Seen = {}
        if self.phases is not None and self.phases.are_announced and (self.phases.begins == step + 1).any():
            before, now = (self.phases.threats[int(self.phases.number_at(at))].ravel() for at in (step, step + 1))
            changed = np.flatnonzero((before != now) & world.free.ravel())
            updates = dict(zip(changed.tolist(), now[changed].tolist(), strict=True))
        cells = np.array(sorted(self._happened), dtype=np.int64)
        self._happened.clear()
        if self.evidence is not None and len(cells):
            p = self.evidence.chances[self.evidence.class_of(self.odds, cells), cells]
            found = {cell: None if np.isnan(one) else float(one) for cell, one in zip(cells.tolist(), p, strict=True)}
            updates |= {cell: one for cell, one in found.items() if one is not None or cell not in {*held}}
        return updates

    def met(self, step: int, world: World) -> NDArray[np.float32]:
        """float32 `[H, W]`: p of visits in the step, as known now."""
        if self.phases is None or self.phases.are_announced:
            return world.threat
        return self.phases.threats[int(self.phases.number_at(step))]

    def to_json(self) -> list[list[int]]:
        """Content of a file: [cell, odds] of each cell whose odds differ from the prior."""
        if self.evidence is None:
            return []
        other = np.flatnonzero(self.odds != self.evidence.prior)
        return np.stack([other, self.odds[other]], axis=1).tolist()

    def read(self, key: Key) -> None:
        """Restore `to_json`.

        Raises:
            StateError: the content is invalid.
        """
        for cell, odds in read_pairs(key, "[cell, odds]", whole(0, len(self.odds) - 1), whole(-ALWAYS, ALWAYS)).items():
            self.odds[cell] = odds


# Mission files, written atomically and to the disk before orders are given, so that a mission survives its process.
#
# A mission file is a state file (SPEC section 12) with the reports of the current step, the last step that each robot
# reported of, its steps without a move, observed and closed cells, reported ranges, robots without progress, and the
# outcome. Before step 0 has ended there is no state, and only the rest is kept.

DEFAULTS: dict[str, Any] = {"world": {}, "begun": True, "range": None, "ended": None, "over": None}
DEFAULTS |= {name: [] for name in ("closed", "seen", "sees", "odds", "aside", "reports", "heard", "waits")}
DEFAULTS |= {"wrecks": [], "cut_off": []}
"""Optional keys of a file in addition to a state, or without one."""
FLAGS = ("stopped", "found")
OF_REPORTS: dict[str, Any] = dict.fromkeys(("cell", "moves_left", "step", "seen")) | dict.fromkeys(FLAGS, False)
"""Optional keys of a report."""
ON_ITS_MAP = "give the map that the mission is on"
OF_END = ("outcome", "step", "covered", "lost")
"""Keys of a mission that is over."""


def write_mission(path: str | Path, world: World, state: Json | None, more: Json) -> None:
    """Write a mission file; it is on the disk before this returns.

    Args:
        path: the file.
        world: the map.
        state: None before there is one.
        more: further keys.

    Raises:
        StateError: it would be too large to be read again.
    """
    where = state or {"world": {"shape": list(world.shape), "sha256": world.sha256}}
    known = {"format": FORMAT, "version": VERSION, "begun": state is not None}
    write_json(Path(path), known | where | more, MAX_PLAN_BYTES, StateError, sync=True)


def read_rest(path: str | Path, world: World, plan: Plan) -> tuple[World, Plan, dict[str, Key]]:
    """Read a mission file.

    Args:
        path: the file.
        world: the initial map.
        plan: whose settings apply.

    Returns:
        (the world with observed and closed cells, the plan of the rest, further keys).

    Raises:
        StateError: the file is invalid.
    """
    source, (data, keys) = str(path), _read(path)
    given, (world, changed) = world, _as_known(world, keys)
    settings = replace(plan.settings or Settings(), wrecks="ignore")
    if "range" in data:  # reported ranges, which hand-written states lack
        settings = replace(settings, range=keys["range"].setting(SETTINGS["range"]))
    if keys["begun"].value is False:
        check_map(keys["world"], world, "state of", ON_ITS_MAP)
        same = not changed and settings == plan.settings
        return world, plan if same else make_plan(world, plan.starts, settings), keys
    # Where wrecks cut cells off, a mission is not over yet when all cells in reach are visited.
    state = parse_state(data, world, source, given, waits=bool(keys["cut_off"].value))
    if state.over is not None:
        state = replace(state, over=_outcome(keys["over"], settings))
    return world, make_plan(replace(world, uncertainty=None), state.starts, settings, state=state), keys


def ended(path: str | Path, world: World, plan: Plan) -> Json | None:
    """The end of the mission in a file, as `drive` reports it: outcome, step, covered, lost; None: it goes on.

    Args:
        path: the file.
        world: the initial map.
        plan: of the mission.

    Raises:
        StateError: the file is invalid.
    """
    keys = _read(path)[1]
    if keys["ended"].value is None:
        return None
    check_map(keys["world"], _as_known(world, keys)[0], "state of", ON_ITS_MAP)
    known, settings = keys["ended"].mapping(OF_END), plan.settings or Settings()
    return {name: key.value for name, key in known.items()} | {"outcome": _outcome(known["outcome"], settings)}


def _outcome(key: Key, settings: Settings) -> str:
    """The outcome in a file.

    Up to release 0.3 files did not tell an operator's end from the rule's, or a deadline from the step limit: the
    settings decide. A mission with a `robot_value` that ended during the return to base counts as ended by the rule.
    """
    if key.value == "called_off" and settings.robot_value is None:
        return Outcome.ENDED_BY_OPERATOR.word
    word = key.choice((outcome.word for outcome in Outcome), WORDS_OF_0_3)
    return Outcome[word.upper()].by_deadline(settings.ends_by_deadline).word


def _as_known(world: World, keys: dict[str, Key]) -> tuple[World, bool]:
    """The world with observed and closed cells, and whether it differs."""
    cell = whole(0, world.threat.size - 1, what="the index of a cell")
    closed = [one.number(cell) for one in keys["closed"].items("a list of cells", least=0)]
    seen = read_seen(keys["seen"])
    for one in seen:
        cell.check("seen", one, StateError, str(keys["seen"].source))
    changes = seen | dict.fromkeys(closed)
    return (seen_world(world, changes) if changes else world), bool(changes)


def read_seen(key: Key) -> Seen:
    """p by cell, None for an obstacle, from `[[cell, p], ...]`.

    Raises:
        StateError: the content is invalid.
    """
    return read_pairs(key, "[cell, p]", whole(0, MAX_CELLS), PROBABILITY, optional=True)


def read_pairs(key: Key, expected: str, first: Numbers, second: Numbers, *, optional: bool = False) -> dict[int, Any]:
    """The second number by the first, from a list of pairs; `optional`: the second may be null.

    Raises:
        StateError: the content is invalid.
    """
    pairs = (item.items(expected, exactly=2) for item in key.items(f"a list of {expected}", least=0))
    return {one.number(first): None if optional and two.value is None else two.number(second) for one, two in pairs}


def _read(path: str | Path) -> tuple[Json, dict[str, Key]]:
    """The content of a file, and its keys."""
    data = read_json(Path(path), MAX_PLAN_BYTES, StateError, "a state file (JSON)")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StateError("is no state of a mission", source=path, expected=f'an object with "format": "{FORMAT}"')
    return data, Key(data, "", str(path), StateError).mapping(defaults=DEFAULTS, strict=False)


def hand_on(report: Callable[..., None], key: Key) -> None:
    """Call `Mission.report` with the content of a file, or of a line of `drive`.

    Raises:
        StateError: the content is invalid.
    """
    keys = key.mapping(("robot",), defaults=OF_REPORTS)
    for name in FLAGS:
        if not isinstance(keys[name].value, bool):
            raise keys[name].wrong("true or false")
    report(**{name: key.value for name, key in keys.items()})
