"""The public Python functions, `import mrac_jax as mrac`: one function per task of the command line.

They take plain arguments and return the results of `analysis` and `planner`. Coverage is a fraction of the accessible
cells. Cells are `[row, col]`, row 0 at the top. Every error is an `InputError`.

The commands are made from these functions (`analysis.cli.options`): names and types of their options from the
signatures, help from the `Args` of the docstrings. So that `--help` is quick, all slow imports are in the functions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, wraps
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar, Unpack, cast, overload

from analysis.utils.notes import UnknownArgument, say
from planner.arguments import COMMAND_LINE, argument, as_whole, check_word, whole
from planner.errors import InputError, UsageError
from planner.settings import OPTIONS, SETTINGS, Choices, Policy, Settings

if TYPE_CHECKING:
    from distributed import Client
    from numpy.typing import ArrayLike

    from analysis.checking.check import MapCheck, Survey
    from analysis.comparison import Comparison, Side
    from analysis.debrief import Debrief
    from analysis.evaluation.evaluate import Evaluation
    from analysis.mission_protocol import DrivenMission
    from analysis.policy_evaluation.leaderboard import Suite
    from analysis.policy_evaluation.policy_evaluation import PolicyEvaluation
    from analysis.recording.container import Recovered
    from analysis.recording.contents import RecordedOutcomes, RecordedRollout
    from analysis.recording.record import Pick, Recorded
    from analysis.recording.replay import Inspection, Replayed
    from analysis.reproduction import Reproduction
    from analysis.sampling import Exactness, RolloutChoices
    from analysis.search.pareto import Front
    from analysis.search.start_positions import Starts
    from analysis.search.team_size import TeamSize
    from analysis.search.threats import Attack, Clearing
    from analysis.sweeps.results import Results
    from analysis.sweeps.sweep import Sweep
    from analysis.utils.notes import Doing, ProgressCallback
    from analysis.utils.progress import Found, OnInterrupt
    from planner.plan.plan import Plan
    from planner.plan.state import MissionState
    from planner.policies.rules import InAreaOrder
    from planner.rollouts.names import EngineName
    from planner.world.world import World


# Options that several functions share. A function that takes them is written `def f(..., **options: Unpack[Some])` and
# decorated with `takes`: its signature names each option with the default of `planner.settings.OPTIONS`, its docstring
# gains their help, and other names are refused.

Loop = Literal["closed", "open"]
PlanFor = Literal["closed_loop", "open_loop"]
ThreatChecks = Literal["every_visit", "first_visit"]
PlanSource: TypeAlias = "Plan | str | Path | int | None"
"""A Plan, a plan file, the number of robots to plan for, or None: the world's own team."""
ReturnTo = str | Sequence[Sequence[int]] | None
"""Bases that robots return to: "home", "nearest", cells `[[row, col], ...]`; None: robots do not return."""


class PlannerOptions(TypedDict, total=False):
    """Settings of `plan` that apply to every policy."""

    levels: int | None
    density: float | None
    risk: Literal["paper", "log"] | None
    transit: Literal["grid", "area"] | None
    max_steps: int | None
    range: int | Sequence[int] | None
    weibull_shape: float | None
    hazard_multiplier: float | Sequence[float] | None
    return_to: ReturnTo
    wrecks: Literal["ignore", "block"] | None
    deliver_every: int | Literal["auto"] | None
    deliver_value: float | None
    recharge: int | None
    types: str | Sequence[str] | None
    steps_per_move: int | Sequence[int] | None
    radio: float | None
    in_area: InAreaOrder | None


class PolicyOptions(PlannerOptions, total=False):
    """Settings of `plan` for the closed loop, where survivors take over work."""

    policy: Policy | None
    risk_cap: float | None
    robot_value: float | None


class LoopOptions(PolicyOptions, total=False):
    """Settings of `plan` for either loop."""

    plan_for: PlanFor | None
    effort: int | None


class PlanOptions(LoopOptions, total=False):
    """Every setting of `plan`."""

    deadline: int | str | None


class CallOptions(TypedDict, total=False):
    """Progress and interruption, of every function that takes time."""

    progress: ProgressCallback | bool | None
    on_interrupt: OnInterrupt


class SeedOptions(CallOptions, total=False):
    """Options of the rollouts that a recording or a check of formulas has too."""

    seed: int
    threat_checks: ThreatChecks
    engine: EngineName


class RolledOptions(SeedOptions, total=False):
    """Options of the rollouts, without their number."""

    deadline: int | str | None
    exact: Exactness


class OnePlanOptions(RolledOptions, total=False):
    """Options of the rollouts of one plan."""

    loop: Loop | None
    rollouts: int | None
    precision: float | None
    seconds: float | None


class MetricOptions(TypedDict, total=False):
    """The coverage that teams are compared by."""

    metric: Literal["visited", "survived", "delivered"]


class CompareOptions(OnePlanOptions, MetricOptions, total=False):
    """Options of `compare`."""


class FrontOptions(PlannerOptions, RolledOptions, MetricOptions, total=False):
    """Options of `front`, which varies the policy."""


class SearchOptions(PolicyOptions, RolledOptions, total=False):
    """Options of `threats`."""

    loop: Loop | None


class StartsOptions(SearchOptions, MetricOptions, total=False):
    """Options of `starts`."""


class SizeOptions(LoopOptions, RolledOptions, MetricOptions, total=False):
    """Options of `size`, which also plans for the open loop."""


class RecordOptions(SeedOptions, total=False):
    """Options of `record`."""

    loop: Loop | None


class MapsOptions(CallOptions, total=False):
    """Options of work on many maps: processes, and a dask.distributed scheduler (its address or an open Client)."""

    processes: int | None
    scheduler: str | Client | None


class CheckOptions(LoopOptions, SeedOptions, MapsOptions, total=False):
    """Options of `check`; the settings are those of random maps."""


OF_CALLS = {
    "progress": "None: a bar on a terminal, a line in a notebook; True: lines on a pipe too; False: none; or a "
    "function called with (done, total, seconds) after every chunk.",
    "on_interrupt": '"raise": Ctrl-C raises a KeyboardInterrupt with the answer so far as `partial`; "return": that '
    "answer is returned, `answer.partial` true.",
}
"""Help of the arguments that are not options of a command."""
REPORTED = "Also report coverage at this step or time: 450, 45min, 1h30min, 90s."
"""Help of a deadline that does not end the mission."""
Function = TypeVar("Function", bound=Callable[..., Any])


def takes(options: type, *, beyond: bool = False, **help: str) -> Callable[[Function], Function]:
    """A decorator that replaces `**options` by named keyword-only arguments with defaults.

    Args:
        options: the TypedDict of the arguments. The function receives all of them.
        beyond: the function receives other names too, which it checks.
        help: texts that replace the usual help of some arguments.

    Raises:
        UnknownArgument: on a call with another name.
    """
    default = {name: one.default for name, one in OPTIONS.items() if name not in SETTINGS} | {"on_interrupt": "raise"}
    more = {
        name: Parameter(name, Parameter.KEYWORD_ONLY, default=default.get(name), annotation=kind.__forward_arg__)
        for name, kind in options.__annotations__.items()
    }

    def named(function: Function) -> Function:
        own = signature(function)
        first = [one for one in own.parameters.values() if one.kind is not Parameter.VAR_KEYWORD]
        names, own_help = [one.name for one in first], OF_CALLS | help
        shared = {name: one for name, one in more.items() if name not in names}
        known, usual = [*names, *shared], {name: one.default for name, one in shared.items()}
        helps = {name: own_help.get(name) or _in_python(OPTIONS[name].help) for name in shared}

        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            for name in () if beyond else given.keys() - set(known):
                raise UnknownArgument.of(function, name, given[name], known)
            return function(*args, **usual | given)

        rest = [one for one in own.parameters.values() if beyond and one.kind is Parameter.VAR_KEYWORD]
        call.__signature__ = own.replace(parameters=[*first, *shared.values(), *rest])  # type: ignore[attr-defined]
        lines = "".join(f"\n    {name}: {text}" for name, text in helps.items())
        call.__doc__ = f"{cleandoc(function.__doc__ or '')}\n\nKeyword Args:{lines}\n"
        return call  # type: ignore[return-value]

    return named


def _in_python(text: str) -> str:
    """The help of an option as the help of an argument: `plan_for` instead of --plan-for."""
    return re.sub(r"--([a-z][a-z-]+)", lambda found: f"`{found[1].replace('-', '_')}`", text)


Answered = TypeVar("Answered", bound="Found")


def _ask(
    work: Callable[[ProgressCallback, Doing], Answered], options: Mapping[str, Any], things: str = "rollouts"
) -> Answered:
    """The result of `work`, with the progress reports and the handling of interrupts of the options."""
    from analysis.utils.progress import ask

    return ask(work, options["progress"], options["on_interrupt"], things)


def _first_only(options: Mapping[str, Any]) -> bool:
    """Whether only first visits can destroy a robot. Raises UsageError for an unknown word."""
    check_word("threat_checks", options["threat_checks"], OPTIONS["threat_checks"].words)
    return bool(options["threat_checks"] == "first_visit")


def _rollouts(options: Mapping[str, Any], **how: Any) -> RolloutChoices:
    """The rollouts among the options; `how` replaces some. Raises UsageError."""
    from analysis.sampling import RolloutChoices

    given = {name: options[name] for name in ("seed", "engine", "deadline", "exact", "metric") if name in options}
    given["loop"] = options.get("loop") or "closed"
    return RolloutChoices(first_only=_first_only(options), **{**given, **how})


# Worlds and plans: the inputs of every other function.


def load(
    source: str | Path | ArrayLike,
    *,
    cell_size: float | None = None,
    step_seconds: float | None = None,
    speed: float | None = None,
    turn: float | None = None,
    value: ArrayLike | None = None,
    detect: ArrayLike | None = None,
    route: ArrayLike | None = None,
) -> World:
    """The world in a file, in a shipped example, or in an array.

    Args:
        source: any INPUT of the command line ("depot.yaml", a scenario, "example:paper", ...), or an array `[H, W]` of
            the probability that one visit destroys a robot, NaN (or masked) = obstacle.
        cell_size: side of a cell in metres. It coarsens a map; for an array it is the size of its cells (default 1).
        step_seconds: seconds a step, or `speed`, metres a second: times are then also reported in minutes, and
            deadlines may be times, as "45min". Both replace the values of the source.
        turn: steps that a quarter turn costs: `evaluate` and `plan` also report the duration with turns.
        value, detect: value of each cell, and probability that a visit which the robot survives detects its target:
            `[H, W]` or one number. They replace the values of the source (default: 1 each).
        route: `[row, col]` of the corners of the route to make safe.

    Returns:
        The world. `plan(world)` uses the robots of a scenario. `world.notes` lists the changes made while loading.
    """
    from analysis.inputs import load_world
    from planner.world.scenario import with_route
    from planner.world.world import World

    if isinstance(source, str | Path):
        world = load_world(str(source), cell_size)
        _say_if_large(world)
    else:
        world = World.create(source, cell_size=1.0 if cell_size is None else cell_size, source="array")
        world = replace(world, measured=cell_size is not None)
    world = world.with_pace(step_seconds, speed, turn)
    if value is not None or detect is not None:
        world = world.with_values(world.value if value is None else value, world.detect if detect is None else detect)
    return world if route is None else with_route(world, route)


def _say_if_large(world: World) -> None:
    """Print the note about a large map without a cell size before the work starts."""
    from planner.world.scenario import MANY_CELLS, ROBOT_IS

    if world.threat.size > MANY_CELLS:
        say([f"{world.source}: {note}" for note in world.notes if ROBOT_IS in note])


@takes(PlanOptions)
def plan(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    state: MissionState | str | Path | None = None,
    seconds: float | None = None,
    **options: Unpack[PlanOptions],
) -> Plan:
    """The plan of a team (Algorithms 1 to 3): its areas, and every robot's path without losses.

    Args:
        robots: number of robots, placed by the world's start rule unless it has as many starts (default: the world's
            team, else 1).
        starts: their cells `[[row, col], ...]`, one per robot.
        state: state of a mission under way, or its file (a state, tracks, visited cells, a mask, an OccupancyGrid).
            The plan covers the rest. Its robots are those of the state, or at `starts` if the file has no positions.
        seconds: end the search of `plan_for="open_loop"`, `policy="best"` or `deliver_every="auto"` after this many
            seconds (10).

    A `policy` may also be a `planner.policies.rules.Rule`, or a function of an `Offer` that orders areas, least first;
    an `in_area` order a function of a `CellOffer`. Such a plan cannot be saved. "best" selects the policy with the
    highest coverage of a dozen settings, on separate random numbers, and then improves the order of the areas;
    `deliver_every="auto"` the number of cells with which most is delivered. In a world with a step length a `deadline`
    may be a time, "45min".
    """
    from analysis.estimators.racing import plan_best
    from analysis.inputs import plan_from_state
    from planner.open_loop import plan_team
    from planner.plan.state import MissionState
    from planner.plan.state_file import read_state
    from planner.world.start_rule import starts_of

    check_world(world)
    asked = _choices(options)
    settings = asked.before_search().settings(world.team.settings, world.pace, by=world.source)
    if state is not None:
        asked.require_no_search("a state")
        if robots is not None or (starts is not None and isinstance(state, MissionState)):
            problem = "a state and robots or starts"
            raise UsageError(problem, expected="one of them: the state says where its robots are")
        found, notes = (state, ()) if isinstance(state, MissionState) else read_state(Path(state), world, starts)
        made = plan_from_state(world, found, settings)
        return replace(made, notes=(*made.notes, *notes))
    make: Callable[..., Plan] = plan_best if asked.searched else plan_team
    return make(world, starts_of(world, robots, starts), settings, seconds, *asked.searched)


def settings_of(world: World, **given: Any) -> Settings:
    """The settings of the world, with those in `given` replaced. Raises InputError."""
    return _choices(given).settings(world.team.settings, world.pace, by=world.source)


def _choices(given: Mapping[str, Any]) -> Choices:
    return Choices(**{name: _of_tuples(name, value) for name, value in given.items()})


def _of_tuples(name: str, given: Any) -> Any:
    """The value of a setting; a list (one value a robot, or cells) becomes a tuple."""
    if not isinstance(given, Iterable) or isinstance(given, str):
        return given
    return tuple(map(tuple, given)) if SETTINGS[name].places else tuple(given)


def check_world(world: object) -> None:
    """Raise UsageError for an object that is not a World, such as the name of an INPUT or an array."""
    from planner.world.world import World

    if not isinstance(world, World):
        raise UsageError(argument("world", world), expected="a World", fix="give mrac_jax.load(...) of the map")


def plan_of(world: World, given: PlanSource) -> tuple[World, Plan]:
    """The world and the plan of a PlanSource: the plan itself, one read from a file (`read_plan_on`), or a new one."""
    from planner.make_plan import read_plan_on
    from planner.plan.plan import Plan

    check_world(world)
    if isinstance(given, Plan):
        given.require(world)
        return world, given
    return read_plan_on(given, world) if isinstance(given, str | Path) else (world, plan(world, given))


# Files for viewers, ground stations and GIS, and recordings read back.

PICKS = ("worst", "median", "best")


@takes(RecordOptions)
def record(
    world: World,
    plan: PlanSource,
    path: str | Path,
    *,
    pick: Iterable[str] = (),
    ids: Iterable[int] = (),
    rollouts: int | None = None,
    outcomes: bool = False,
    step_seconds: float | None = None,
    made: bool | None = None,
    state_at: int | None = None,
    force: bool = False,
    **options: Unpack[RecordOptions],
) -> Recorded:
    """Rollouts in full as an MCAP file, for Foxglove, Lichtblick and Rerun; read back with `read_rollouts`.

    Args:
        plan: as of `evaluate`. path: the file (.mcap); a layout for Foxglove and Lichtblick is written next to it.
        ids: rollouts to record; or `pick`: some of the evaluated ones, of "worst", "median", "best", ... (default:
            those three). rollouts: number of evaluated rollouts (default: 10000; with `ids` and without `outcomes`
            none).
        outcomes: Keep the outcome of every evaluated rollout.
        step_seconds: duration of a step in the viewer; None: the world's, or 1.
        made: whether a replay plans again; else it confirms the plan. None: unless `plan` is a file, external, or
            continues a mission.
        state_at: With one of `ids`: write its state after this step to NAME.state.json.
        force: replace existing files; without it an existing file is an InputError.
    """
    from analysis.recording.names import check_names, layout_name, state_name
    from analysis.recording.record import Request, parse_picks, scenario_text, state_of_rollout
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.viewers.topics import write_layout
    from planner.files import check_new

    path = Path(path)
    check_names(path)
    check_new(path, layout_name(path), *([] if state_at is None else [state_name(path)]), force=force)
    chosen, names = tuple(ids), tuple(pick)
    if chosen and names:
        raise UsageError(f"both {argument('ids')} and {argument('pick')} are given", expected="one of them")
    OPTIONS["rollouts"].numbers.check("rollouts", rollouts, optional=True)
    picks: tuple[Pick, ...] = () if chosen else parse_picks(",".join(names or PICKS))
    usual = 10_000 if picks or outcomes else 0

    def work(tell: ProgressCallback, doing: Doing) -> Recorded:
        of, given = plan_of(world, plan)
        own = not (isinstance(plan, str | Path) or given.is_external or given.state) if made is None else made
        how: Any = {"loop": options["loop"] or given.usual_loop, "outcomes": outcomes, "made": own}
        how |= {name: options[name] for name in ("seed", "engine")} | {"first_only": _first_only(options)}
        how["scenario"] = scenario_text(of.source)
        how["step_seconds"] = of.with_pace(step_seconds).pace.seconds or 1.0
        how["evaluated"] = usual if rollouts is None else as_whole(rollouts)
        request = Request(ids=chosen, picks=picks, **how)
        state = None if state_at is None else state_of_rollout(of, given, request, state_at)
        done = record_rollouts(of, given, request, path, progress=tell, doing=doing)
        done.files = [done.path, layout_name(done.path)]
        write_layout(done.files[1], of, len(given.robots))
        if state is not None:
            done.files.append(state_name(done.path))
            state.save(done.files[2], force=True)
        return done

    return _ask(work, options)


def inspect(
    file: str | Path,
    *,
    replay: bool = False,
    engine: EngineName = "auto",
    all: bool = False,
    repair: str | Path | None = None,
    progress: ProgressCallback | None = None,
) -> Inspection | Replayed | Recovered:
    """Contents of a recording: topics, attachments, and a timeline of each rollout; or its replay, or its repair.

    Args:
        file: a recording (.mcap).
        replay: Run the recorded rollouts again, and report whether every event is the same (exit status 1 if not).
        engine: With `replay`: simulator to use (default: auto).
        all: With `replay`: run every evaluated rollout.
        repair: Save the intact part of a recording to this file (exit status 1 if some is lost).
        progress: of the replay; called with (done, total, seconds).
    """
    from analysis.recording import replay as logs
    from analysis.recording.container import recover
    from analysis.recording.names import SUFFIX, check_name

    if repair is not None and replay:
        raise UsageError(f"both {argument('replay')} and {argument('repair')} are given", expected="one of them")
    for name, given in (("engine", engine != "auto"), ("all", all)):
        if given and not replay:
            problem = f"{argument(name)} without {argument('replay')}"
            raise UsageError(problem, fix=f"add {argument('replay')}, or leave it out")
    if replay:
        return logs.replay(file, engine, everything=all, progress=progress)
    if repair is None:
        return logs.inspect(file)
    check_name(Path(repair), SUFFIX)
    return recover(Path(file), Path(repair))


def read_rollouts(path: str | Path) -> Iterator[RecordedRollout]:
    """The rollouts of a recording, one after the other; one is held at a time.

    Incomplete rollouts of a partial or recovered recording are skipped.
    """

    from analysis.recording import contents as rollouts

    return rollouts.read_rollouts(path)


def read_outcomes(path: str | Path) -> RecordedOutcomes:
    """Every outcome that `record --outcomes` wrote, none if it did not."""

    from analysis.recording import contents as rollouts

    return rollouts.read_outcomes(path)


def export(
    world: World,
    plan: PlanSource,
    out: str | Path,
    *,
    to: Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff", "wpml", "cot", "nav2_route"] | None = None,
    altitude: float | None = None,
    speed: float | None = None,
    terrain: str | Path | None = None,
    battery: float | None = None,
    force: bool = False,
) -> list[Path]:
    """The plan for ground stations, DJI drones, TAK, nav2 and GIS; returns the files.

    Args:
        plan: as of `evaluate`. out: a file or a folder.
        to: Format (default: by the suffix of `out`).
        altitude: qgc, wpml: metres above take-off, 0 for ground robots (default: 20).
        speed: metres a second (default: as the world says, or 3).
        terrain: Raster of heights (.tif, .asc): altitudes are above this ground (qgc, wpml, csv).
        battery: wpml: minutes of flight with one battery; longer paths become several files.
        force: replace existing files; without it an existing file is an InputError, and nothing is written.
    """
    from analysis.exporting import choose_format
    from analysis.exporting import export as write
    from analysis.exporting.mission import make_mission

    form, ground = choose_format(Path(out), to), None if terrain is None else Path(terrain)
    mission = make_mission(*plan_of(world, plan), altitude, speed, ground, battery)
    return write(mission, Path(out), form, force=force)[0]


# Mission execution.


def drive(
    world: World,
    plan: PlanSource = None,
    *,
    state: MissionState | str | Path | None = None,
    patience: int | None = 20,
    gain: float = 1.0,
) -> DrivenMission:
    """A mission that gives orders and takes reports step by step, and resumes after a crash.

    Args:
        plan: a Plan, a plan file, the number of robots to plan for, or None: the world's own team.
        state: the state to start from: a file of `Mission.save`, or any state that `plan` takes.
        patience: Steps without progress before a robot's work is reassigned (default: 20).
        gain: Smallest share of the way that a change of target must save (default: 1, never).

    Without a `patience` (None) no work is reassigned. A robot changes its target to work that became free, or to a
    nearer cell of its area after a push.
    """
    from analysis.inputs import plan_from_state
    from analysis.mission_protocol import DrivenMission
    from planner.plan.state import MissionState
    from planner.plan.state_file import read_state

    world, made = plan_of(world, plan)
    if isinstance(state, str | Path) and Path(state).suffix == ".json":
        return DrivenMission.resume(state, world, made, patience=patience, gain=gain)
    if state is not None:
        found = state if isinstance(state, MissionState) else read_state(state, world)[0]
        made = plan_from_state(world, found, made.require(world))
    return DrivenMission(world, made, patience=patience, gain=gain)


def debrief(
    world: World,
    tracks: str | Path,
    plan: Plan | str | Path | None = None,
    *,
    lost: Sequence[int | str] | int | str = (),
) -> Debrief:
    """Tracks compared with the map and the plan: coverage, gaps, observed loss rate, and a plan for the rest.

    Args:
        tracks: CSV (robot, a time or step, and row, col, or x, y, or lon, lat), GPX, GeoJSON lines with `coordTimes`,
            MCAP poses, or a recording of one rollout.
        plan: the plan that was to be flown, a Plan or its file.
        lost: robots that were lost, in addition to those that the tracks say are lost.
    """
    from analysis.debrief import make_debrief

    check_world(world)
    made = None
    if plan is not None:
        world, made = plan_of(world, plan)
    settings = settings_of(world) if made is None or made.settings is None else made.settings
    names = {str(name) for name in ([lost] if isinstance(lost, int | str) else lost)}
    return make_debrief(world, Path(tracks), made, settings, names)


# Many maps: sweeps, the results in a store, random worlds.


@takes(MapsOptions)
def sweep(
    spec: str | Path, store: str | Path | None = None, *, precision: float | None = None, **options: Unpack[MapsOptions]
) -> Sweep:
    """A scenario with lists of settings, on many maps; stored results are reused.

    Every setting is run on the same maps and the same random numbers.

    Args:
        spec: the sweep file (YAML).
        store: Keep results in this file, and reuse those that it has (default: NAME.store).
        precision: Add maps until every 95 % interval of mean coverage is this narrow.
    """
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store import Store
    from analysis.sweeps.sweep import check_precision, run_sweep
    from analysis.utils.progress import compiling_elsewhere

    asked = read_spec(Path(spec))
    check_precision(precision)

    def work(tell: ProgressCallback, doing: Doing) -> Sweep:
        where, watch = _where(options), cast("Any", tell)  # which takes what is counted too
        with Store.open(Path(store or f"{asked.source.stem}.store")) as opened, compiling_elsewhere(asked.policies):
            return run_sweep(asked, opened, watch=watch, precision=precision, **where)

    return _ask(work, options, "jobs")


def _where(options: Mapping[str, Any]) -> dict[str, Any]:
    """The processes or the scheduler of work on many maps. Raises UsageError for both."""
    from analysis.sweeps.engine import check_where

    where = {name: options[name] for name in ("processes", "scheduler")}
    check_where(**where)
    return where


def results(
    store: str | Path,
    *,
    by: str | Sequence[str] = (),
    where: Mapping[str, Any] | None = None,
    merge: Iterable[str | Path] = (),
    csv: str | Path | None = None,
    parquet: str | Path | None = None,
    plot: str | Path | None = None,
    figure: str = "visited",
) -> Results:
    """Contents of a store as rows, a mean over maps for each setting; export, and union with other stores.

    Args:
        by: labels to group by, also as "robots,kind" (default: all that vary).
        where: values of labels to select, one or several each.
        merge: First copy the intact results of this store into STORE; may be repeated.
        csv: Write one line per run (.csv).
        parquet: Write one row per run (.parquet).
        plot: Write a picture (.png) of the figure over the first numeric label.
        figure: of the picture: one of `analysis.sweeps.results.FIGURES`.
    """
    from analysis.sweeps.report import write_chart
    from analysis.sweeps.results import collect, write_csv, write_parquet
    from analysis.sweeps.store import Store, merge_stores

    def texts(value: object) -> tuple[str, ...]:
        several = [value] if isinstance(value, str) or not isinstance(value, Iterable) else value
        return tuple(str(one) for one in several)

    names = [name for name in by.split(",") if name] if isinstance(by, str) else list(by)
    if isinstance(by, str) and not names:
        raise UsageError(f"{argument('by')} {by!r}", expected='names of labels, "robots,kind"')
    wanted = {name: texts(value) for name, value in (where or {}).items()}
    merge_stores(Path(store), [Path(other) for other in merge])
    with Store.open(Path(store), write=False) as opened:
        found = collect(opened, wanted, names)
        for out, write in ((csv, write_csv), (parquet, write_parquet)):
            if out is not None:
                write(opened, wanted, Path(out))
    if plot is not None:
        write_chart(found.rows, figure, Path(plot))
    return found


def generate(
    map: str | Path | None = None,
    *,
    kind: Literal["contiguous", "scattered"] = "contiguous",
    size: str | None = None,
    obstacles: float | None = None,
    ratio: float = 0.25,
    areas: int | None = None,
    levels: Sequence[float] | None = None,
    seed: int = 0,
    robots: int | None = None,
    cell_size: float | None = None,
) -> World:
    """A random world of the paper, or a map with random threats.

    Args:
        map: Put the threats on the free cells of this INPUT.
        kind: Pattern of the threats (default: contiguous).
        size: Size of a map, HxW in cells (default: 20x20).
        obstacles: Fraction of the cells that are obstacles (default: 0.25).
        ratio: Fraction of dangerous cells; with `map`, of its free cells (default: 0.25).
        areas: Number of contiguous areas of threats (default: 10).
        levels: Threat levels, in turn (default: 0.04,0.08,0.12,0.16,0.20).
        seed: Seed of the map (default: 0).
        robots: Also store the starts of this many robots, upper left.
        cell_size: With `map`: side of a cell in metres; the map is coarsened.
    """
    from analysis.inputs import generate_world
    from planner.world.generate import PAPER_LEVELS, ThreatPattern

    if kind == "scattered" and areas is not None:
        fix = f"leave it out, or use {argument('kind', 'contiguous')}"
        raise UsageError(f"{argument('areas')} is for contiguous threats", fix=fix)
    chosen = PAPER_LEVELS if levels is None else tuple(levels)
    pattern = ThreatPattern(kind, 10 if areas is None else areas, chosen, seed)
    world, notes = generate_world(None if map is None else str(map), pattern, size, obstacles, ratio, robots, cell_size)
    return replace(world, notes=(*world.notes, *notes))


# User-defined policies, and the worlds to evaluate them on.


def judge(
    world: World,
    policy: Callable[..., Any],
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    actions: Literal["moves", "areas"] = "moves",
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
    max_steps: int | None = None,
    rollouts: int = 1000,
    seed: int = 0,
    against: Sequence[str] = ("mrac", "per_cell"),
    processes: int | None = None,
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> PolicyEvaluation:
    """Evaluate a user-defined policy: its coverage, and its score between a random walk and the proven bound.

    Args:
        policy: a function of the observations of all robots, float32 `[K, 6, h, w]`, or of areas `[K, offers, 8]`
            (`env`), that returns one action per robot. A second argument receives a random key (a NumPy generator) of
            the rollout. Under `jax.jit` it runs inside the compiled rollouts, if its actions are moves.
            It must be stateless: calls of many rollouts alternate.
        robots, starts, actions, view, rule, offers, max_steps: as of `env`.
        rollouts, seed: rollout r of a seed uses the same random numbers as in `evaluate`.
        against: policies of the planner to compare with: common random numbers, the same last step.
        processes: number of processes that call a policy in Python; it changes no figure. None: one a core, if the
            policy can be imported.
        progress, on_interrupt: as of `evaluate`.
    """
    from analysis.policy_evaluation.policy_evaluation import judge as judge_policy
    from analysis.sampling import RolloutChoices
    from planner.rollouts.names import of_jax

    check_world(world)
    if not callable(policy):
        raise UsageError(argument("policy", policy), expected="a function of the robots' observations")
    given: dict[str, Any] = {"starts": starts, "actions": actions, "view": view, "rule": rule, "offers": offers}
    env = of_jax("environment")(world, robots, **given, max_steps=max_steps)
    choices = RolloutChoices(rollouts=rollouts, seed=seed)
    options = {"progress": progress, "on_interrupt": on_interrupt}

    def work(tell: ProgressCallback, doing: Doing) -> PolicyEvaluation:
        return judge_policy(world, policy, env, choices, against, processes, tell)

    return _ask(work, options)


def suite(only: str | Sequence[str] | None = None) -> Suite:
    """Thirty fixed, named worlds as a mapping from names to worlds; `.judge(policy)` evaluates a policy on them.

    Args:
        only: names, or patterns as ``contiguous-10-*``; None: all.
    """
    from analysis.policy_evaluation.leaderboard import Suite

    return Suite(only)


# Evaluation of a plan, comparison of two plans, and checks of the formulas.


@overload
def evaluate(world: World, plan: int | None = None, *, policy: Callable[..., Any], **how: Any) -> PolicyEvaluation: ...
@overload
def evaluate(world: World, plan: PlanSource = None, **how: Any) -> Evaluation: ...
@takes(OnePlanOptions, beyond=True, deadline=REPORTED)
def evaluate(
    world: World,
    plan: PlanSource = None,
    *,
    policy: Callable[..., Any] | None = None,
    state: MissionState | str | Path | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    threat_scale: Sequence[float] = (),
    sensor_range: Sequence[float] = (),
    bound: bool | None = None,
    band: bool = True,
    advice: bool = True,
    marginal_risk: bool = False,
    show: Callable[[Evaluation], None] | None = None,
    **options: Any,
) -> Evaluation | PolicyEvaluation:
    """Coverage and losses of a team, with intervals: exact values, rollouts and bounds.

    Args:
        plan: a Plan, a plan file, the number of robots to plan for, or None: the world's own team.
        policy: a function of the robots' observations instead of a plan. The call is then one of `judge`: it accepts
            the arguments of `judge` only, and `plan` is the number of robots.
        state: state of a mission under way, or its file, instead of a plan: the rest is planned and rolled out.
        rollouts: Number of rollouts (default: as many as `precision` needs).
        precision: Stop at this half-width of the 95 % interval of mean coverage (default: 0.001, a tenth of a point).
        threat_scale: Also evaluate the same plan with all threats multiplied by these factors: "0.5,1,2".
        sensor_range: Also evaluate robots without a known map at these sensor ranges, in cells: "0,1,2,inf".
        bound: Compute the sharpest upper bound, on maps with over 1,000 dangerous cells too.
        band: also sample how coverage grows over time, for `plots`.
        advice: Coverage and losses of other settings (a few seconds; compiles on the first run).
        marginal_risk: Cells lost for one more percent of threat in each cell, with the plan as it is (takes about 1.5
            times as long as the rollouts).
        show: called with the evaluation so far, before the results that take longer.
        options: any further output of `analysis.evaluation.outputs`, by its key.

    A limit of the time for exact values counts work, not time, so that no answer depends on the machine. A plan of
    paths only is evaluated in the open loop unless `loop` is given.
    """
    given = locals()
    given |= given.pop("options")
    if policy is not None:
        return _judged(given)
    from analysis.evaluation.evaluate import OUTPUTS, check_asked
    from analysis.evaluation.evaluate import evaluate as evaluate_plan
    from analysis.sampling import how_much

    if state is not None and plan is not None:
        raise UsageError("both a plan and a state", expected="one of them")
    check_world(world)
    asked = {name: value for name, value in options.items() if name not in OnePlanOptions.__annotations__}
    for name in asked.keys() - OUTPUTS.keys():
        known = [name for name, one in signature(evaluate).parameters.items() if one.kind is one.KEYWORD_ONLY]
        raise UnknownArgument.of(evaluate, name, asked[name], known)
    asked |= {"threat_scale": tuple(threat_scale), "marginal_risk": marginal_risk}
    asked |= {"knowledge": tuple(sensor_range)} if len(sensor_range) else {}
    check_asked(world, **asked)
    asked |= {"band": band, "advice": advice}
    amount = how_much(rollouts, precision, options["seconds"])

    def work(tell: ProgressCallback, doing: Doing) -> Evaluation:
        doing("planning")
        of, made = plan_of(world, plan) if state is None else (world, _rest(world, state))
        choices = _rollouts(options, loop=options["loop"] or made.usual_loop, **amount)
        return evaluate_plan(of, made, choices, bound=bound, progress=tell, doing=doing, show=show, **asked)

    return _ask(work, options)


def _judged(given: dict[str, Any]) -> PolicyEvaluation:
    """`evaluate` of a policy: a call of `judge`. Raises UsageError for arguments that only a plan has."""
    from planner.plan.plan import Plan

    usual = {name: one.default for name, one in signature(evaluate).parameters.items()}
    world, plan, policy = (given.pop(name) for name in ("world", "plan", "policy"))
    given = {name: value for name, value in given.items() if name not in usual or value is not usual[name]}
    known = [name for name in signature(judge).parameters if name not in ("world", "policy", "robots")]
    for name in given.keys() - known:
        problem = f"evaluate has no argument {name!r} for a policy"
        raise UsageError(problem, expected=f"one of {', '.join(known)}", fix="give it to `evaluate` of a plan")
    if isinstance(plan, Plan | str | Path):
        raise UsageError("both a plan and a policy", expected="one of them; with a policy, a number of robots")
    return judge(world, policy, plan, **given)


def _rest(world: World, state: MissionState | str | Path) -> Plan:
    return plan(world, state=state)


@takes(CompareOptions, deadline=REPORTED)
def compare(
    a: tuple[World, PlanSource],
    b: tuple[World, PlanSource],
    *,
    loop_b: Loop | None = None,
    threat_checks_b: ThreatChecks | None = None,
    **options: Unpack[CompareOptions],
) -> Comparison:
    """Difference between two plans, settings, teams or maps, on common random numbers.

    Args:
        a, b: a world and a plan for it: a Plan, a plan file, the number of robots, or None, as of `evaluate`.
        loop_b, threat_checks_b: of b; None: as of a.

    Without `rollouts` and `precision` (of the difference) it runs 100,000 rollouts, or fewer if 10 seconds are over.
    """
    from analysis.comparison import compare as compare_sides
    from analysis.comparison import make_side
    from analysis.sampling import how_much
    from planner.world.world import World

    amount = how_much(options["rollouts"], options["precision"], options["seconds"], usual=100_000)
    for name, side in (("a", a), ("b", b)):
        if not (isinstance(side, tuple) and len(side) == 2 and isinstance(side[0], World)):
            raise UsageError(argument(name, side), expected="(world, plan), a World and a plan for it")

    def make(name: str, side: tuple[World, PlanSource], loop: Loop | None, threat_checks: ThreatChecks) -> Side:
        try:
            world, plan = plan_of(*side)
            how = dict(options) | {"threat_checks": threat_checks}
            return make_side(world, plan, _rollouts(how, loop=loop or plan.usual_loop, **amount))
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    def work(tell: ProgressCallback, doing: Doing) -> Comparison:
        doing("planning")
        first = make("A", a, options["loop"], options["threat_checks"])
        other = make("B", b, loop_b or options["loop"], threat_checks_b or options["threat_checks"])
        return compare_sides(first, other, progress=tell)

    return _ask(work, options)


@overload
def check(world: World, plan: PlanSource = None, **how: Any) -> MapCheck: ...
@overload
def check(*, worlds: int, **how: Any) -> Survey: ...
@overload
def check(*, paper: Literal["fig4", "fig5", "fig6", "fig7", "all"], **how: Any) -> Reproduction: ...
@takes(CheckOptions)  # type: ignore[misc]
def check(
    world: World | None = None,
    plan: PlanSource = None,
    *,
    rollouts: int | None = None,
    worlds: int | None = None,
    robots: Sequence[int] | None = None,
    kind: Literal["contiguous", "scattered"] | None = None,
    size: str | None = None,
    paper: Literal["fig4", "fig5", "fig6", "fig7", "all"] | None = None,
    maps: int | None = None,
    store: str | Path | None = None,
    bound: bool | None = None,
    theory: Literal["main", "all"] = "main",
    **options: Unpack[CheckOptions],
) -> MapCheck | Survey | Reproduction:
    """Check the paper's formulas on one map or on random maps, or its experiments.

    Expected values of the open loop are exact. Those of the closed loop are exact where that is cheap, else sampled,
    with simultaneous 95 % intervals.

    Args:
        world, plan: as of `evaluate`.
        rollouts: Number of closed-loop rollouts (default: 20000; 4096 a team with `worlds`; 20 a map with `paper`).
        worlds: Check this many random maps instead of an INPUT.
        robots: team sizes of random maps (default: (1, 2, 4, 8, 20)).
        kind: Pattern of the threats (default: contiguous).
        size: Size of a map, HxW in cells (default: 20x20).
        paper: Check the statements of the paper's experiments on random maps.
        maps: With `paper`: random maps per setting (default: 500, as in the paper).
        store: Keep results in this file, and reuse those that it has.
        bound: Compute the sharpest upper bound, on maps with over 1,000 dangerous cells too.
        theory: Table of an INPUT: main, a row per formula, or all readings and meanings (default: main).
    """
    check_word("theory", theory, ("main", "all"))
    given = {name: value for name, value in locals().items() if name in signature(check).parameters} | options
    mode = check_mode(given)
    settings = Choices(**{name: options[name] for name in SETTINGS if name in options})  # type: ignore[literal-required]
    if mode == "world":
        for name in {"robots": robots, **settings.given()}.keys() - ({"robots"} if robots is None else set()):
            known = [one for one in signature(check).parameters if one != name]
            raise UnknownArgument.of(check, name, given[name], known)
    if mode == "paper":
        return _reproduction(given)
    from analysis.checking.check import check_input, make_survey, run_survey
    from analysis.utils.progress import compiling_elsewhere

    usual = 20_000 if mode == "world" else 4096
    choices = _rollouts({**options, "deadline": None}, rollouts=usual if rollouts is None else rollouts)
    if mode == "world":
        of = plan_of(world, plan)  # type: ignore[arg-type]
        return _ask(lambda tell, doing: check_input(*of, choices, tell, bound, theory), options)
    sizes = (1, 2, 4, 8, 20) if robots is None else tuple(sorted({robots} if isinstance(robots, int) else set(robots)))
    for count in sizes or (0,):
        whole(1, 1024).check("robots", count)
    survey = make_survey(worlds or 0, kind, size, sizes, settings, bool(bound))

    def work(tell: ProgressCallback, doing: Doing) -> Survey:
        with compiling_elsewhere([survey.settings.policy]):
            return run_survey(survey, choices, processes=options["processes"], progress=tell)

    return _ask(work, options, "worlds")


def _reproduction(given: Mapping[str, Any]) -> Reproduction:
    """The paper's experiments. Raises InputError."""
    from analysis.reproduction import reproduce
    from analysis.sweeps.cases import check_maps
    from analysis.sweeps.store import Store
    from analysis.utils.progress import compiling_elsewhere
    from planner.policies import DEFAULT

    usual = {"maps": 500, "rollouts": 20, "seed": 0}
    count = {name: value if given[name] is None else given[name] for name, value in usual.items()}
    OPTIONS["rollouts"].numbers.check("rollouts", count["rollouts"])
    check_maps(count["maps"], count["seed"])
    where, store = _where(given), given["store"]

    def work(tell: ProgressCallback, doing: Doing) -> Reproduction:
        with nullcontext() if store is None else Store.open(Path(store)) as kept, compiling_elsewhere([DEFAULT]):
            return reproduce(given["paper"], **count, **where, store=kept, progress=tell)

    return _ask(work, given, "jobs")


# Modes of `check`.

OF_ONE_MAP = ("plan", "starts", "cell_size", "theory")
OF_WORLDS = ("worlds", "kind", "size", "processes")
OF_THE_PAPER = ("paper", "maps", "store", "processes", "scheduler")
WITH_THE_PAPER = ("rollouts", "seed", "out", "json", "progress", "on_interrupt")


def check_mode(given: Mapping[str, Any]) -> Literal["world", "worlds", "paper"]:
    """The mode of `check`; `given`: its arguments by name. Raises UsageError for arguments of another mode."""
    modes = [name for name in ("world", "worlds", "paper") if given.get(name) is not None]
    words = {"world": "an INPUT" if COMMAND_LINE.get() else "a world", "worlds": argument("worlds")}
    words |= {"paper": argument("paper")}
    if not modes:
        raise UsageError("nothing to check", expected=f"{words['world']}, {words['worlds']} or {words['paper']}")
    if len(modes) > 1:
        raise UsageError(f"both {words[modes[0]]} and {words[modes[1]]} are given", expected="one of them")
    (mode,) = modes
    if mode != "world" and given["engine"] == "jax":
        raise UsageError(f"{argument('engine', 'jax')} is for {words['world']}", fix="leave it out")
    owners = {"world": OF_ONE_MAP, "worlds": OF_WORLDS, "paper": OF_THE_PAPER}
    usual = {"theory": "main"} | {name: one.default for name, one in OPTIONS.items()}
    said = [name for name, value in given.items() if value is not None and value != usual.get(name)]
    if mode == "paper":
        wrong = [name for name in said if name not in (*OF_THE_PAPER, *WITH_THE_PAPER)]
    else:
        wrong = [name for name in said if name in sum(owners.values(), ()) and name not in owners[mode]]
    if wrong:
        owner = next((words[one] for one, names in owners.items() if wrong[0] in names), "the others")
        named, one = " and ".join(map(argument, wrong)), len(wrong) == 1
        raise UsageError(f"{named} {'is' if one else 'are'} for {owner}", fix=f"leave {'it' if one else 'them'} out")
    return mode  # type: ignore[return-value]


# Searches: team sizes, trade-offs, start positions, threats to remove or to add.


def _settings(world: World, options: Mapping[str, Any]) -> Settings:
    """The settings among the options. Raises InputError."""
    check_world(world)
    return settings_of(world, **{name: options[name] for name in SETTINGS if name in options and name != "deadline"})


def _found(search: Callable[..., Answered], options: Mapping[str, Any]) -> Answered:
    """The result of a search, with progress reports."""
    return _ask(lambda tell, doing: search(progress=tell, doing=doing), options)


@takes(SizeOptions, deadline=REPORTED)
def size(
    world: World,
    *,
    target: float | None = None,
    confidence: float | None = None,
    complete: bool = False,
    most: int | None = None,
    starts: ArrayLike | None = None,
    loop: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    **options: Unpack[SizeOptions],
) -> TeamSize:
    """The smallest team with a given expected coverage, or a given probability of it.

    A team is enough if the whole interval is at or above the target, and not enough if it is below. With a deadline the
    coverage at that step decides.

    Args:
        target: Fraction of the accessible cells to cover, above 0, at most 1.
        confidence: Required chance of covering the target (default: expected coverage decides; with `complete`: 0.95).
        complete: Cover every accessible cell: `target` 1 with a confidence.
        most: Largest team to evaluate (default: 64; at most the number of starts).
        starts: `[[row, col], ...]`, of which a team takes the first; default: the world's own, else its start rule.
        loop: closed: survivors take over the work of lost robots (default); open: fixed paths.
        rollouts: Largest number of rollouts of each team (default: 100000).
        precision: Stop at this half-width of the 95 % interval of mean coverage, a fraction.
    """
    from analysis.sampling import how_much
    from analysis.search.team_size import find_size, make_goal
    from planner.world.world import check_starts

    settings = _settings(world, options)
    goal = make_goal(target, confidence, complete, options["metric"], most)
    amount = how_much(rollouts, precision, None, usual=100_000) | {"seconds": None}
    loop = loop or ("open" if settings.plan_for == "open_loop" else "closed")
    choices = _rollouts(options, loop=loop, **amount)
    if starts is not None:
        world = world.with_starts(check_starts(starts, world.met, "starts"))
    return _found(partial(find_size, world, settings, goal, choices), options)


@takes(FrontOptions)
def front(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    losses: float | None = None,
    target: float | None = None,
    robot_values: Sequence[float] | None = None,
    risk_caps: Sequence[float] | None = None,
    rollouts: int | None = None,
    **options: Unpack[FrontOptions],
) -> Front:
    """Coverage against lost robots: the Pareto front of policies, risk caps and robot values.

    With `losses` or `target` one setting is selected and confirmed by other rollouts; `answer.plan_of(answer.picked)`
    is its plan.

    Args:
        robots, starts: the team, as of `plan`.
        losses: Select the setting with the highest coverage at this mean number of lost robots.
        target: Select the setting with the fewest lost robots at this mean coverage, a fraction.
        robot_values: Values of `robot_value` to evaluate: "5,10,20" (default: a doubling series).
        risk_caps: Values of `risk_cap` to evaluate (default: 0.1,0.25,0.5 up to 1,000 accessible cells).
        rollouts: Number of rollouts of each setting (default: 4096; fewer above 2,048 accessible cells).
    """
    import numpy as np

    from analysis.search.pareto import Ladders, find_front, make_goal, usual_rollouts
    from planner.world.start_rule import starts_of

    settings, goal = _settings(world, options), make_goal(losses, target)
    caps, values = (None if given is None else tuple(given) for given in (risk_caps, robot_values))
    ladders = Ladders(caps, values)
    placed = np.asarray(starts_of(world, robots, starts))
    choices = _rollouts(options, rollouts=usual_rollouts(world, placed) if rollouts is None else rollouts)
    return _found(partial(find_front, world, placed, settings, choices, goal=goal, ladders=ladders), options)


@takes(StartsOptions)
def starts(
    world: World,
    robots: int | None = None,
    *,
    depot: bool = False,
    candidates: ArrayLike | str | Path = "border",
    rollouts: int = 4096,
    **options: Unpack[StartsOptions],
) -> Starts:
    """The best start cells: one for each robot, or one for all.

    Candidates are screened by a bound; the best are simulated on common random numbers, and the winner is compared with
    the present starts on other rollouts. If it is not significantly better, the answer is to stay. `candidates` may
    also be an array: a mask `[H, W]`, or cells `[[row, col], ...]`.

    Args:
        robots: Number of robots (default: as in the input, else 1).
        depot: One start for all robots instead of one each.
        candidates: Cells to start from: border, the safe cells on the border of the map; or a file, a mask or rows of
            row,col as .npy or .csv (default: border).
        rollouts: Number of rollouts of each candidate (default: 4096).
    """
    from analysis.search.start_positions import BORDER, find_starts, read_candidates, team_size

    settings, choices, source = _settings(world, options), _rollouts(options, rollouts=rollouts), ""
    if isinstance(candidates, str | Path) and candidates != BORDER:
        source = str(candidates)
        candidates, notes = read_candidates(Path(source))
        say([f"{source}: {note}" for note in notes])
    search = partial(find_starts, world, team_size(world, robots), settings, choices, depot=depot)
    return _found(partial(search, candidates=candidates, source=source), options)


@overload
def threats(world: World, robots: int | None = None, *, remove: int, **how: Any) -> Clearing: ...
@overload
def threats(world: World, robots: int | None = None, *, add: int, **how: Any) -> Attack: ...
@takes(SearchOptions)  # type: ignore[misc]
def threats(
    world: World,
    robots: int | None = None,
    *,
    remove: int | None = None,
    add: int | None = None,
    unit: Literal["areas", "sources"] | None = None,
    p: float | None = None,
    starts: ArrayLike | None = None,
    rollouts: int = 4096,
    **options: Unpack[SearchOptions],
) -> Clearing | Attack:
    """The threats to remove first (`remove`), or the worst cells for new ones (`add`).

    `remove` gives the gain with a new plan and with the old one. `add` gives the cost if the robots know the new
    threats and if they do not. Candidates are compared on common random numbers and confirmed by other rollouts.

    Args:
        remove: Find this many threats to remove, one after the other (default: 1).
        add: Find this many cells for new threats, the most harmful ones (default: 1).
        unit: A threat to remove: a connected area of danger (areas), or a polygon, point or site of the scenario
            (sources) (default: sources if there are several).
        p: With `add`: p of a new threat (default: 0.2).
        robots, starts: the team, as of `plan`.
        rollouts: Number of rollouts of each candidate (default: 4096).
    """
    import numpy as np

    from analysis.search.threats import threats_search
    from planner.world.start_rule import starts_of

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    search: Any = threats_search(remove, add, unit, p)
    placed = np.asarray(starts_of(world, robots, starts))
    return _found(partial(search, world, placed, settings, choices), options)


def studio(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    seed: int = 0,
    port: int | None = None,
    out: str | Path | None = None,
) -> None:
    """A local page to draw threats, obstacles and starts, with live results; Ctrl-C ends it.

    The page is served on this machine only, at the printed address (needs the extra `studio`).

    Args:
        robots, starts: the team, as of `plan`.
        seed: of the rollouts.
        port: Port of the page (default: a free one).
        out: Scenario file (.yaml) that Save writes (default: INPUT-studio.yaml).
    """
    from analysis.inputs import studio_scenario
    from analysis.sampling import RolloutChoices
    from analysis.utils.progress import ANNOUNCER, lines_now_and_then, notice_compiling, run_loop
    from planner.world.start_rule import starts_of

    try:
        import tornado  # noqa: F401

        from analysis.studio.server import Sketch, Studio, serve
    except ImportError:
        raise UsageError("tornado is not installed", fix='pip install "mrac-jax[studio]"') from None
    check_world(world)
    whole(1, 65535, "a port").check("port", port, optional=True)
    RolloutChoices(seed=seed)  # raises UsageError for an invalid seed
    first = Sketch.of(world, len(starts_of(world, robots, starts)), settings_of(world))
    room = Studio(first, Path(world.source).name, studio_scenario(world.source, out), seed)
    notice_compiling()
    try:
        with lines_now_and_then(lambda _: ANNOUNCER.line()):
            run_loop(serve(room, port or 0, lambda address: say([f"open {address}", "Ctrl-C ends it"])))
    except KeyboardInterrupt:
        say(["studio ended"])


# Names of release 0.3, for one release.


def _clear(world: World, robots: int | None = None, *, count: int = 1, remove: Any = None, **how: Any) -> Clearing:
    return threats(world, robots, remove=count, unit=remove, **how)


def _attack(world: World, robots: int | None = None, *, count: int = 1, **how: Any) -> Attack:
    return threats(world, robots, add=count, **how)


def _reproduce(figure: Any = "all", **how: Any) -> Reproduction:
    return check(paper=figure, **how)


OF_0_3: dict[str, Callable[..., Any]] = {
    "attack": _attack, "clear": _clear, "mission": drive, "reproduce": _reproduce,
}  # fmt: skip
"""Functions of release 0.3, with their old arguments (`mrac_jax.OF_0_3`)."""
__all__ = [
    "check", "compare", "drive", "evaluate", "export", "front", "generate", "inspect", "judge", "load", "plan",
    "read_outcomes", "read_rollouts", "record", "results", "size", "starts", "studio", "suite", "sweep", "threats",
]  # fmt: skip
