"""Worlds, teams and plans from the INPUT and the options of a command line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from planner.arguments import FRACTION, MAX_PLAN_BYTES, argument, did_you_mean
from planner.errors import InputError, PlanError, StateError, UsageError
from planner.files import read_json, why_no_file
from planner.formatting import counted
from planner.plan.plan import FORMAT, Plan
from planner.plan.state import MissionState
from planner.settings import BEARING, KEPT, Choices, Settings
from planner.world.keys import named_files, read_yaml
from planner.world.map_files import YAML
from planner.world.world import EXAMPLE, World, check_starts

if TYPE_CHECKING:
    from planner.world.generate import ThreatPattern

REACHED = 0.5
"""A note reports the reachable fraction of the free cells if it is at most this."""


@dataclass(frozen=True, eq=False)
class Task:
    """A world with its team: `starts`, int64 `[K, 2]`, and the `settings` of its plan."""

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    notes: tuple[str, ...]


def input_path(name: str) -> Path:
    """The file that an INPUT names: a path, or `example:NAME` for a shipped example. Raises UsageError."""
    if not name:
        raise UsageError("INPUT ''", expected="a file, or example:NAME")
    if not name.startswith(EXAMPLE):
        return Path(name)
    folder = Path(str(files("analysis.examples")))
    known = {path.stem: path for path in sorted(folder.iterdir()) if path.stem in ("terrain", "building", "paper")}
    wanted = name.removeprefix(EXAMPLE)
    if wanted not in known:
        expected = " or ".join(EXAMPLE + one for one in known)
        raise UsageError(f"no example {wanted!r}", source=name, expected=expected, fix=did_you_mean(wanted, known))
    return known[wanted]


def studio_scenario(name: str, out: str | Path | None) -> Path:
    """The scenario that a studio for this INPUT saves."""
    return Path(f"{input_path(name).stem}-studio.yaml") if out is None else Path(out)


def read_files(name: str | None, *others: Path | None) -> list[Path]:
    """Input files: that of an INPUT, `others`, and the files that scenarios and ROS maps among them name."""
    found = [*([input_path(name)] if name else []), *(one for one in others if one is not None)]
    for file in found:  # the list grows in the loop
        with suppress(InputError):  # the reader reports its errors later
            if file.suffix.lower() in YAML:
                found += [one for one in named_files(read_yaml(file).value, file.parent) if one not in found]
    return found


def load_world(name: str, cell_size: float | None = None) -> World:
    """The world of an INPUT. Raises InputError."""
    from planner.world.scenario import load_input

    world = load_input(input_path(name), cell_size)
    return replace(world, source=name) if name.startswith(EXAMPLE) else world


@dataclass(frozen=True)
class Asked:
    """A request for a plan: the input, the team and the settings.

    Attributes:
        source: an INPUT. choices: the planner's settings that the user gave.
        robots: their number. starts: their cells, (row, col) each. cell_size: of a bare map, in metres.
        step_seconds, speed, turn: as of `World.with_pace`.
        sensor_range: sensor range in cells of robots without a known map.
    """

    source: str
    choices: Choices
    robots: int | None = None
    starts: Sequence[Sequence[int]] | None = None
    cell_size: float | None = None
    step_seconds: float | None = None
    speed: float | None = None
    turn: float | None = None
    sensor_range: float | None = None

    def load(self) -> World:
        """The world of the INPUT. Raises InputError."""
        world = load_world(self.source, self.cell_size).with_pace(self.step_seconds, self.speed, self.turn)
        return world if self.sensor_range is None else world.with_range(self.sensor_range)


def load_task(asked: Asked) -> Task:
    """The world, the robots' starts and the settings of an INPUT and the options.

    Robots come from `--starts`, else from the input's starts, else `--robots` (else the input's count, else 1) placed
    by the start rule. Raises InputError when they contradict each other.
    """
    from planner.world.start_rule import check_robots, check_same_team, place_starts

    robots, starts = asked.robots, asked.starts
    check_robots(robots)
    world = asked.load()
    notes, team = world.notes, world.team
    if starts is not None:
        world = world.with_starts(check_starts(starts, world.met, argument("starts")))
    if world.starts is not None:
        check_same_team(robots, world.starts, asked.source if starts is None else argument("starts"))
        placed = world.starts
    else:
        count = robots if robots is not None else (team.robots or 1)
        placed, more = place_starts(world, count, team.start)
        notes += more
    settings = asked.choices.settings(team.settings, world.pace, by=world.source)
    notes += _cut_off(world, placed)
    if world.moving_threats is None and not (world.by_phase > 0).any():
        notes += ("no cell is dangerous, so every robot survives: put threats on the map (a scenario's `threats`)",)
    return Task(world, placed, settings, notes)


def _cut_off(world: World, starts: NDArray[np.int64]) -> tuple[str, ...]:
    """A note if most of the map cannot be reached: the file may not be a map."""
    free, near = int(world.free.sum()), int(world.accessible(starts).sum())
    if near > REACHED * free:
        return ()
    far = 100 * (1 - near / free)
    return (f"{near:,} of {free:,} free cells can be reached from the starts: obstacles cut {far:.0f} % off",)


Found = tuple[World, Plan, tuple[str, ...]]
"""A world, a plan for it, and notes."""


def load_or_make_plan(
    asked: Asked,
    plan_file: Path | None = None,
    state: Path | None = None,
    *,
    find_best: Callable[..., Plan],
    doing: Callable[[str], None] | None = None,
    seconds: float | None = None,
    first: Callable[[World], None] | None = None,
) -> Found:
    """The plan in `plan_file`, that of the INPUT, or a new one. Raises InputError.

    `find_best`: the search for the best policy (`analysis.estimators.racing.plan_best`). `seconds`: time limit of this
    search, or of the search for an open-loop plan. `state`: state file of a mission; the plan covers its rest.
    `first`: check of the world before planning; it raises InputError. `doing`: receives the name of the activity.
    """
    from planner.open_loop import plan_team

    searched = asked.choices.searched
    if state is not None or plan_file is not None:
        asked.choices.require_no_search(argument("plan" if state is None else "state"))
    if state is None and plan_file is None and asked.source.endswith(".json"):
        asked, plan_file = _on_its_map(asked)
    if seconds is not None and (state is not None or plan_file is not None):
        raise UsageError(f"{argument('seconds', seconds)} where nothing is searched for", fix="leave it out")
    if state is not None:
        return _plan_the_rest(asked, state, plan_file)
    if plan_file is not None:
        return _load_plan(asked, plan_file)
    task = load_task(replace(asked, choices=asked.choices.before_search()))
    if first is not None:
        first(task.world)
    if doing is not None:
        doing("the best policy" if searched else "planning")
    make = find_best if searched else plan_team
    made = make(task.world, task.starts, task.settings, seconds, *searched)
    return task.world, made, task.notes + made.notes


def _on_its_map(asked: Asked) -> tuple[Asked, Path | None]:
    """For a plan file as INPUT: the same with its map as source, and the file. Raises PlanError without the map."""
    path, expected = Path(asked.source), "a plan file (JSON) that names its map"
    data = read_json(path, MAX_PLAN_BYTES, PlanError, expected)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        return asked, None
    named = data["world"].get("source") if isinstance(data.get("world"), dict) else None
    fix = f"name the map, and this file with {argument('plan')}"
    if not isinstance(named, str):
        raise PlanError("holds no map, and does not say where it is", source=path, expected=expected, fix=fix)
    source = named if named.startswith(EXAMPLE) else str(path.parent / named)
    if named.startswith(EXAMPLE) or not (problem := why_no_file(Path(source))):
        return replace(asked, source=source), path
    raise PlanError(f"its map is not at {source!r}: {problem}", source=path, expected="the map there", fix=fix)


def check_team(asked: Asked, robots: int, file: Path) -> None:
    """Raise UsageError for an option with another number of robots than `file` has."""
    if asked.robots is not None and asked.robots != robots:
        problem = f"{argument('robots', asked.robots)} contradicts the {counted(robots, 'robot')} of {file}"
        raise UsageError(problem, fix="leave it out")


def _plan_the_rest(asked: Asked, file: Path, plan_file: Path | None) -> Found:
    """The plan of the rest of a mission whose state is in `file`; options that contradict it are errors."""
    from planner.plan.state_file import read_state

    if plan_file is not None:
        other = argument("plan")
        raise UsageError(f"both {argument('state')} and {other}", expected="one of them", fix=f"leave {other} out")
    world = asked.load()
    state, notes = read_state(file, world, asked.starts)
    check_team(asked, len(state.robots), file)
    made = plan_from_state(
        world, state, asked.choices.settings(world.team.settings, world.pace, by=world.source), str(file)
    )
    return world.with_starts(state.starts), made, world.notes + notes


def plan_from_state(world: World, state: MissionState, settings: Settings, source: str = "state") -> Plan:
    """The plan of the rest of a mission; errors name `source`. Raises InputError."""
    from planner.make_plan import make_plan

    if settings.plan_for != "closed_loop":
        raise UsageError(f"{argument('plan_for', settings.plan_for)} for the rest of a mission", expected="closed_loop")
    try:
        return make_plan(world, state.starts, settings, state=state)
    except StateError as error:
        raise StateError(error.problem, source=source, expected=error.expected, fix=error.fix) from error


def _load_plan(asked: Asked, plan_file: Path) -> Found:
    """A saved plan, confirmed; options that contradict it are errors."""
    from planner.make_plan import read_plan_on

    world, plan = read_plan_on(plan_file, asked.load())
    check_team(asked, len(plan.robots), plan_file)
    if asked.starts is not None and not np.array_equal(asked.starts, plan.starts):
        raise UsageError(f"{argument('starts')} contradicts the starts of {plan_file}", fix="leave it out")
    given = asked.choices.given()
    given |= {name: world.pace.last_step(name, given[name]) for name in given.keys() & {"deadline"}}
    what = {name: given.pop(name) for name in BEARING if name in given}
    plan = plan.of_robots(**what) if what else plan
    for option, value in given.items():
        if option == "plan_for" and value == plan.plan_for:
            continue
        if plan.settings is None or getattr(plan.settings, option) != value:
            was = f"the {plan.origin}"
            if plan.settings is not None:
                was = f"made with {getattr(plan.settings, option)!r}"
            problem = f"{argument(option, value)} contradicts {plan_file}, {was}"
            raise UsageError(problem, fix="leave it out, or plan anew")
    return world.with_starts(plan.starts), plan, world.notes + plan.notes + _other(world, plan, plan_file)


def _other(world: World, plan: Plan, plan_file: Path) -> tuple[str, ...]:
    """A note if the failure model or the limits of the world's team differ from those of its plan."""
    if plan.settings is None:
        return ()
    said = Choices().settings(world.team.settings, world.pace, by=world.source)
    named = (name for name in (*BEARING, "types", *KEPT) if name in world.team.settings)
    other = " and ".join(name for name in named if getattr(said, name) != getattr(plan.settings, name))
    return (f"{plan_file} was made for another {other} than {world.source} says: its own count",) if other else ()


def generate_world(
    on: str | None,
    pattern: ThreatPattern,
    size: str | None,
    obstacles: float | None,
    share: float,
    robots: int | None,
    cell_size: float | None = None,
) -> tuple[World, tuple[str, ...]]:
    """(world, notes): a random world of SPEC section 8, or the INPUT `on` with random threats on its free cells."""
    from planner.world.generate import check_pattern, random_threats, random_world
    from planner.world.robot_types import independent
    from planner.world.start_rule import check_robots, place_starts

    if on is not None and (size is not None or obstacles is not None):
        problem = f"{argument('size')} and {argument('obstacles')} are those of the map"
        raise UsageError(problem, fix=f"leave them out, or leave {argument('map')} out")
    if on is None and cell_size is not None:
        problem = (
            f"{argument('cell_size', cell_size)} is for a map that is coarsened; cells of a generated world have 1 m"
        )
        raise UsageError(problem, fix=f"leave it out, or name a map with {argument('map')}")
    FRACTION.check("ratio", share)
    check_robots(robots)
    check_pattern(pattern)
    notes: tuple[str, ...] = ()
    if on is None:
        height, width = map_size(size or "20x20")
        world = random_world(height, width, pattern, obstacles=0.25 if obstacles is None else obstacles, threats=share)
    else:
        base = load_world(on, cell_size)
        base.require_certain_map("putting random threats on a map")
        notes = base.notes + _left_out(base, robots)
        threat = random_threats(base.free, round(share * int(base.free.sum())), pattern)
        combined = independent(base.threat.astype(np.float64), threat.astype(np.float64))
        cells = np.where(base.free, combined, np.nan)
        place = base.cell_size, base.origin, base.source, (), base.georeference
        world = World.create(cells, base.starts, *place, base.value, base.detect)
    if robots is not None:
        placed, more = place_starts(world, robots)
        return world.with_starts(placed), notes + more
    return world, notes


def _left_out(world: World, robots: int | None) -> tuple[str, ...]:
    """A note that names the keys of an input that a world file does not keep."""
    team, pace = world.team, world.pace
    keys = ["robots.count"] * (team.robots is not None and robots is None) + list(team.settings)
    keys += [name for name, given in (("step", pace.seconds), ("turn", pace.turn)) if given]
    keys += ["route"] * (team.route is not None)
    return (f"left out, since a world file holds the map alone: {', '.join(keys)}",) if keys else ()


def map_size(text: str) -> tuple[int, int]:
    """`"HxW"` as (H, W); raises UsageError."""
    try:
        height, width = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise UsageError(f"{argument('size')} {text!r}", expected="HxW in cells, as 20x30") from None
    return height, width
