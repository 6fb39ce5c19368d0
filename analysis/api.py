"""The public Python functions, `import mrac_jax as mrac`: one function per task of the command line.

They take plain arguments and return the results of `analysis` and `planner`. Coverage is a fraction of the accessible
cells. Cells are `[row, col]`, row 0 at the top. Every error is an `InputError`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, wraps
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from analysis.evaluation.evaluate import Evaluation
from analysis.inputs import check_mode, load_world, plan_from_state
from analysis.sampling import Exactness, RolloutChoices, how_much
from analysis.utils.notes import Doing, ProgressCallback, UnknownArgument, say
from analysis.utils.progress import Found, OnInterrupt, ask
from planner.arguments import argument, as_whole, check_word
from planner.errors import UsageError
from planner.files import check_new
from planner.mission.mission import PATIENCE
from planner.plan.plan import Plan
from planner.plan.state import MissionState
from planner.plan.state_file import read_state
from planner.plan_team import plan_team, read_plan_on
from planner.policies.rules import InAreaOrder
from planner.rollouts.names import EngineName
from planner.settings import BEST, OPTIONS, SETTINGS, Choices, Policy, Settings
from planner.world.scenario import with_route
from planner.world.start_rule import starts_of
from planner.world.world import World, check_starts

if TYPE_CHECKING:
    from distributed import Client

    from analysis.checking.check import MapCheck, Survey
    from analysis.comparison import Comparison
    from analysis.experiments.reproduction import Reproduction
    from analysis.mission_protocol import DrivenMission
    from analysis.policy_evaluation.leaderboard import Suite
    from analysis.policy_evaluation.policy_evaluation import PolicyEvaluation
    from analysis.recording.contents import RecordedOutcomes, RecordedRollout
    from analysis.recording.record import Pick, Recorded
    from analysis.search.pareto import Front
    from analysis.search.start_positions import Starts
    from analysis.search.team_size import TeamSize
    from analysis.search.threats import Attack, Clearing
    from analysis.sweeps.results import Results
    from analysis.sweeps.sweep import Sweep


# Options that several functions share. A function that takes them is written `def f(..., **options: Unpack[Some])` and
# decorated with `takes`: its signature names each option with the default of `planner.settings.OPTIONS`, its docstring
# gains their help, and other names are refused.

Loop = Literal["closed", "open"]
PlanFor = Literal["closed_loop", "open_loop"]
ThreatChecks = Literal["every_visit", "first_visit"]
PlanSource = Plan | str | Path | int | None
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


class PlanOptions(PolicyOptions, total=False):
    """Every setting of `plan`."""

    plan_for: PlanFor | None
    effort: int | None
    deadline: int | str | None


class CallOptions(TypedDict, total=False):
    """Progress and interruption, of every function that takes time."""

    progress: ProgressCallback | bool | None
    on_interrupt: OnInterrupt


class RolledOptions(CallOptions, total=False):
    """Options of the rollouts, without their number."""

    seed: int
    deadline: int | str | None
    threat_checks: ThreatChecks
    engine: EngineName
    exact: Exactness


class OnePlanOptions(RolledOptions, total=False):
    """Options of the rollouts of one plan."""

    loop: Loop | None
    rollouts: int | None
    precision: float | None
    seconds: float | None


class FrontOptions(PlannerOptions, RolledOptions, total=False):
    """Options of `front`, which varies the policy."""


class SearchOptions(PolicyOptions, RolledOptions, total=False):
    """Options of `starts` and `threats`."""


class SizeOptions(SearchOptions, total=False):
    """Options of `size`, which also plans for the open loop."""

    plan_for: PlanFor | None
    effort: int | None


class RecordOptions(CallOptions, total=False):
    """Options of `record`."""

    loop: Loop | None
    seed: int
    threat_checks: ThreatChecks
    engine: EngineName


class MapsOptions(CallOptions, total=False):
    """Options of work on many maps: processes, and a dask.distributed scheduler (its address or an open Client)."""

    processes: int | None
    scheduler: str | Client | None


OF_CALLS = {
    "progress": "None: a bar on a terminal, a line in a notebook; True: lines on a pipe too; False: none; or a "
    "function called with (done, total, seconds) after every chunk.",
    "on_interrupt": '"raise": Ctrl-C raises a KeyboardInterrupt with the answer so far as `partial`; "return": that '
    "answer is returned, `answer.partial` true.",
}
"""Help of the arguments that are not options of a command."""
REPORTED = 'Also report coverage at this step or time, as 450 or "45min".'
"""Help of a deadline that does not end the mission."""
Function = TypeVar("Function", bound=Callable[..., Any])


def takes(options: type, **help: str) -> Callable[[Function], Function]:
    """A decorator that replaces `**options` by named keyword-only arguments with defaults.

    Args:
        options: the TypedDict of the arguments. The function receives all of them.
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
        known = [*(one.name for one in first), *more]
        own_help = OF_CALLS | help
        helps = {name: own_help.get(name) or _in_python(OPTIONS[name].help) for name in more}

        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            for name in given.keys() - set(known):
                raise UnknownArgument.of(function, name, given[name], known)
            return function(*args, **{name: one.default for name, one in more.items()} | given)

        call.__signature__ = own.replace(parameters=[*first, *more.values()])  # type: ignore[attr-defined]
        lines = "".join(f"\n    {name}: {text}" for name, text in helps.items())
        call.__doc__ = f"{cleandoc(function.__doc__ or '')}\n\nKeyword Args:{lines}\n"
        return call  # type: ignore[return-value]

    return named


def _in_python(text: str) -> str:
    """The help of an option as the help of an argument: `plan_for` instead of --plan-for."""
    return re.sub(r"--([a-z][a-z-]+)", lambda found: f"`{found[1].replace('-', '_')}`", text)


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
        seconds: end the search of `plan_for="open_loop"` or `policy="best"` after this many seconds (10).

    A `policy` may also be a `planner.policies.rule.Rule`, or a function of an `Offer` that orders areas, least first;
    an `in_area` order a function of a `CellOffer`. Such a plan cannot be saved. "best" selects the policy with the
    highest coverage of a dozen settings, on separate random numbers, and then improves the order of the areas. In a
    world with a step length a `deadline` may be a time, "45min".
    """
    from analysis.estimators.racing import BASE, plan_best

    check_world(world)
    given, sought = dict(options), options["policy"] == BEST
    settings = settings_of(world, **given | ({"policy": BASE} if sought else {}))
    if sought and state is not None:
        raise UsageError(f"both {argument('policy', BEST)} and a state", expected="one of them")
    if state is not None:
        if robots is not None or (starts is not None and isinstance(state, MissionState)):
            problem = "a state and robots or starts"
            raise UsageError(problem, expected="one of them: the state says where its robots are")
        found, notes = (state, ()) if isinstance(state, MissionState) else read_state(Path(state), world, starts)
        made = plan_from_state(world, found, settings)
        return replace(made, notes=(*made.notes, *notes))
    return (plan_best if sought else plan_team)(world, starts_of(world, robots, starts), settings, seconds)


def settings_of(world: World, **given: Any) -> Settings:
    """The settings of the world, with those in `given` replaced. Raises InputError."""
    asked = Choices(**{name: _of_tuples(name, value) for name, value in given.items()})
    return asked.settings(world.team.settings, world.pace, by=world.source)


def _of_tuples(name: str, given: Any) -> Any:
    """The value of a setting; a list (one value a robot, or cells) becomes a tuple."""
    if not isinstance(given, Iterable) or isinstance(given, str):
        return given
    return tuple(map(tuple, given)) if SETTINGS[name].places else tuple(given)


def check_world(world: object) -> None:
    """Raise UsageError for an object that is not a World, such as the name of an INPUT or an array."""
    if not isinstance(world, World):
        raise UsageError(argument("world", world), expected="a World, as mrac_jax.load makes one")


def plan_of(world: World, given: PlanSource) -> tuple[World, Plan]:
    """The world and the plan of a PlanSource: the plan itself, one read from a file (`read_plan_on`), or a new one."""
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
    rollouts: int = 10_000,
    outcomes: bool = False,
    step_seconds: float | None = None,
    force: bool = False,
    **options: Unpack[RecordOptions],
) -> Recorded:
    """Rollouts in full as an MCAP file, for Foxglove, Lichtblick and Rerun; read back with `read_rollouts`.

    Args:
        plan: as of `evaluate`. path: the file (.mcap); a layout for Foxglove and Lichtblick is written next to it.
        ids: rollouts to record; or `pick`: some of `rollouts` evaluated ones, of "worst", "median", "best", ...
            (default: those three). outcomes: store the result of each of the `rollouts` (`read_outcomes`).
        step_seconds: duration of a step in the viewer; None: the world's, or 1.
        force: replace an existing recording or layout; without it an existing file is an InputError.
    """
    from analysis.recording.names import SUFFIX, check_name, layout_name
    from analysis.recording.record import Request, parse_picks
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.viewers.topics import write_layout

    check_name(Path(path), SUFFIX)
    check_new(path, layout_name(Path(path)), force=force)
    chosen, names = tuple(ids), tuple(pick)
    picks: tuple[Pick, ...] = () if chosen and not names else tuple(parse_picks(",".join(names or PICKS)))
    count = as_whole(rollouts) if picks or outcomes else 0

    def work(tell: ProgressCallback, doing: Doing) -> Recorded:
        of, given = plan_of(world, plan)
        made = not given.is_external
        seconds = of.with_pace(step_seconds).pace.seconds or 1.0
        how: Any = {"loop": options["loop"] or given.usual_loop, "step_seconds": seconds, "made": made}
        how |= {"outcomes": outcomes} | {name: options[name] for name in ("seed", "engine")}
        how["first_only"] = _first_only(options)
        request = Request(chosen, picks, count, **how)
        done = record_rollouts(of, given, request, path, progress=tell, doing=doing)
        write_layout(layout_name(done.path), of, len(given.robots))
        return done

    return ask(work, options["progress"], options["on_interrupt"])


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
    to: Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff"] | None = None,
    altitude: float | None = None,
    speed: float | None = None,
    force: bool = False,
) -> list[Path]:
    """The plan for ground stations, nav2 and GIS; returns the files.

    Args:
        plan: as of `evaluate`. out: a file or a folder. to: the format; None: by the suffix of `out`.
        altitude: QGroundControl: metres above take-off (default 20), 0 for robots on the ground. speed: metres a
            second (default: as the world says, or 3).
        force: replace existing files; without it an existing file is an InputError, and nothing is written.
    """
    from analysis.exporting import choose_format, make_mission
    from analysis.exporting import export as write

    form = choose_format(Path(out), to)
    return write(make_mission(*plan_of(world, plan), altitude, speed), Path(out), form, force=force)


# Mission execution.


def drive(
    world: World,
    plan: PlanSource = None,
    *,
    state: MissionState | str | Path | None = None,
    patience: int | None = PATIENCE,
    gain: float = 1.0,
) -> DrivenMission:
    """A mission that gives orders and takes reports step by step, and resumes after a crash.

    Args:
        plan: a Plan, a plan file, the number of robots to plan for, or None: the world's own team.
        state: the state to start from: a file of `Mission.save`, or any state that `plan` takes.
        patience: steps without progress before a robot's work is reassigned. None: never.
        gain: a robot changes its target, to work that became free or to a nearer cell of its area after a push, if
            that saves more than this fraction of the cost of its path. 1: it never does.
    """
    from analysis.mission_protocol import DrivenMission

    world, made = plan_of(world, plan)
    if isinstance(state, str | Path) and Path(state).suffix == ".json":
        return DrivenMission.resume(state, world, made, patience=patience, gain=gain)
    if state is not None:
        found = state if isinstance(state, MissionState) else read_state(state, world)[0]
        made = plan_from_state(world, found, made.require(world))
    return DrivenMission(world, made, patience=patience, gain=gain)


# Many maps: sweeps, the paper's experiments, the results in a store.


@takes(MapsOptions)
def sweep(
    spec: str | Path,
    store: str | Path | None = None,
    *,
    precision: float | None = None,
    **options: Unpack[MapsOptions],
) -> Sweep:
    """Run a sweep file on all cores.

    Args:
        store: file of the results; a run resumes from it (default: NAME.store in the current folder).
        precision: add maps until the half-width of every interval of mean coverage is at most this.
    """
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store import Store
    from analysis.sweeps.sweep import check_precision, run_sweep

    asked = read_spec(Path(spec))
    check_precision(precision)

    def work(tell: ProgressCallback, doing: Doing) -> Sweep:
        where = _where(options)
        with Store.open(Path(f"{asked.source.stem}.store") if store is None else Path(store)) as opened:
            return run_sweep(asked, opened, watch=lambda *now: tell(*now[:3]), precision=precision, **where)

    return ask(work, options["progress"], options["on_interrupt"], "jobs")


def _where(options: Mapping[str, Any]) -> dict[str, Any]:
    """The processes or the scheduler of work on many maps. Raises UsageError for both."""
    from analysis.sweeps.engine import check_where

    where = {name: options[name] for name in ("processes", "scheduler")}
    check_where(**where)
    return where


def results(store: str | Path, *, by: Sequence[str] = (), where: dict[str, Any] | None = None) -> Results:
    """The results in a store as rows: a mean over maps for each setting.

    Args:
        by: labels to group by (default: all that vary). where: values of labels to select, one or several each.
    """
    from analysis.sweeps.results import collect
    from analysis.sweeps.store import Store

    def texts(value: object) -> tuple[str, ...]:
        several = value if isinstance(value, list | tuple | set | np.ndarray) else [value]
        return tuple(str(one) for one in several)

    wanted = {name: texts(value) for name, value in (where or {}).items()}
    with Store.open(Path(store), write=False) as opened:
        return collect(opened, wanted, list(by))


def generate(
    map: str | Path | None = None,
    *,
    kind: Literal["contiguous", "scattered"] = "contiguous",
    size: str | None = None,
    obstacles: float | None = None,
    ratio: float | None = None,
    areas: int | None = None,
    levels: Sequence[float] | None = None,
    seed: int = 0,
    robots: int | None = None,
    cell_size: float | None = None,
) -> World:
    """A random world of the paper, or a map with random threats.

    Args:
        map: an INPUT whose free cells get the threats; cell_size: side of its cells in metres.
        kind: of the threats; areas: number of contiguous areas (10); levels: their p, in turn (0.04, ..., 0.20).
        size: "HxW" in cells ("20x20"); obstacles, ratio: fractions of obstacles and of dangerous cells (0.25 each).
        seed: of the world. robots: also place the starts of this many robots.
    """
    from analysis.inputs import generate_world

    given = None if levels is None else ",".join(f"{level:.17g}" for level in levels)
    on = None if map is None else str(map)
    world, notes = generate_world(on, kind, size, obstacles, ratio, areas, given, seed, robots, cell_size)
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
    from planner.rollouts.names import of_jax

    check_world(world)
    if not callable(policy):
        raise UsageError(argument("policy", policy), expected="a function of the robots' observations")
    given: dict[str, Any] = {"starts": starts, "actions": actions, "view": view, "rule": rule, "offers": offers}
    env = of_jax("environment")(world, robots, **given, max_steps=max_steps)
    choices = RolloutChoices(rollouts=rollouts, seed=seed)

    def work(tell: ProgressCallback, doing: Doing) -> PolicyEvaluation:
        return judge_policy(world, policy, env, choices, against, processes, tell)

    return ask(work, progress, on_interrupt)


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
def evaluate(
    world: World,
    plan: PlanSource = None,
    *,
    policy: Callable[..., Any] | None = None,
    state: MissionState | str | Path | None = None,
    loop: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    seconds: float | None = None,
    exact: Exactness = "auto",
    engine: EngineName = "auto",
    seed: int = 0,
    deadline: int | str | None = None,
    threat_checks: ThreatChecks = "every_visit",
    threat_scale: Sequence[float] = (),
    sensor_range: Sequence[float] = (),
    bound: bool | None = None,
    band: bool = True,
    advice: bool = True,
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
    **asked: Any,
) -> Evaluation | PolicyEvaluation:
    """Coverage of a plan, with confidence intervals.

    Args:
        plan: a Plan, a plan file, the number of robots to plan for, or None: the world's own team.
        policy: a function of the robots' observations instead of a plan. The call is then one of `judge`: it accepts
            the arguments of `judge` only, and `plan` is the number of robots.
        state: state of a mission under way, or its file, instead of a plan: the rest is planned and rolled out.
        loop: "closed": survivors take over; "open": every robot follows its path until it is destroyed. None: open for
            plans of paths only, else closed.
        rollouts: their number; or `precision`: half-width of the 95 % interval of mean coverage to reach. Neither:
            a half-width of 0.001, or 10 seconds of rollouts.
        seconds: limit of the time for rollouts.
        exact: search for the closed loop's exact values, which small teams have: "auto" for about 2 s, "never", or for
            about this many seconds. The limit counts work, not time, so that no answer depends on the machine.
        engine: "auto" takes JAX where it has an accelerator, else Numba. seed: of the rollouts.
        deadline: a step at which coverage is also reported; robots that return to a base are there by then.
        threat_checks: "first_visit": only the first visit of a cell by any robot can destroy a robot.
        threat_scale: also evaluate with all threats multiplied by these factors.
        sensor_range: also evaluate with sensors of these ranges, in cells, on common random numbers; 0: no sensor.
        bound: compute the upper bound that holds for every strategy; None: on up to 500 accessible cells.
        band: also sample how coverage grows over time, for `plots`.
        advice: also compute a quick front: coverage and losses of other settings.
        asked: any further output of `analysis.evaluation.outputs`, by its key.
        progress: None: a bar on a terminal, a line in a notebook; True: lines on a pipe too; False: none; or a
            function called with (done, total, seconds) after every chunk.
        on_interrupt: "raise": Ctrl-C raises a KeyboardInterrupt with the answer so far as `partial`; "return": that
            answer is returned, `answer.partial` true.
    """
    if policy is not None:
        return _judged(**locals())
    from analysis.evaluation.evaluate import check_asked
    from analysis.evaluation.evaluate import evaluate as evaluate_plan

    if state is not None and plan is not None:
        raise UsageError("both a plan and a state", expected="one of them")
    check_world(world)
    _check_outputs(asked)
    asked |= {"threat_scale": tuple(threat_scale)}
    asked |= {"knowledge": tuple(sensor_range)} if len(sensor_range) else {}
    check_asked(world, **asked)
    asked |= {"band": band, "advice": advice}
    amount = how_much(rollouts, precision, seconds)

    def work(tell: ProgressCallback, doing: Doing) -> Evaluation:
        doing("planning")
        of, made = plan_of(world, plan) if state is None else (world, _rest(world, state))
        choices = RolloutChoices(
            loop=loop or made.usual_loop, **amount, exact=exact, engine=engine, seed=seed, deadline=deadline,
            first_only=_first_only({"threat_checks": threat_checks}),
        )  # fmt: skip
        return evaluate_plan(of, made, choices, bound=bound, progress=tell, doing=doing, **asked)

    return ask(work, progress, on_interrupt)


def _check_outputs(asked: Mapping[str, Any]) -> None:
    """Raise UsageError for a keyword of `evaluate` that is neither an argument nor an output."""
    from analysis.evaluation.evaluate import OUTPUTS

    known = [name for name, one in signature(evaluate).parameters.items() if one.kind is one.KEYWORD_ONLY]
    for name in asked.keys() - OUTPUTS.keys():
        raise UnknownArgument.of(evaluate, name, asked[name], known)


def _judged(
    world: World, plan: Any, policy: Callable[..., Any], asked: dict[str, Any], **rest: Any
) -> PolicyEvaluation:
    """`evaluate` of a policy: a call of `judge`. Raises UsageError for arguments that only a plan has."""
    parameters = signature(evaluate).parameters
    given = asked | {name: value for name, value in rest.items() if value is not parameters[name].default}
    known = [name for name in signature(judge).parameters if name not in ("world", "policy", "robots")]
    for name in given.keys() - known:
        problem = f"evaluate has no argument {name!r} for a policy"
        raise UsageError(problem, expected=f"one of {', '.join(known)}", fix="give it to `evaluate` of a plan")
    if isinstance(plan, Plan | str | Path):
        raise UsageError("both a plan and a policy", expected="one of them; with a policy, a number of robots")
    return judge(world, policy, plan, **given)


def _rest(world: World, state: MissionState | str | Path) -> Plan:
    return plan(world, state=state)


@takes(OnePlanOptions, deadline=REPORTED)
def compare(
    a: tuple[World, PlanSource],
    b: tuple[World, PlanSource],
    *,
    loop_b: Loop | None = None,
    threat_checks_b: ThreatChecks | None = None,
    **options: Unpack[OnePlanOptions],
) -> Comparison:
    """The difference between two plans, teams or maps, on common random numbers.

    Args:
        a, b: a world and a plan for it: a Plan, a plan file, the number of robots, or None, as of `evaluate`.
        loop_b, threat_checks_b: of b; None: as of a.

    Without `rollouts` and `precision` (of the difference) it runs 100,000 rollouts, or fewer if 10 seconds are over.
    """
    from analysis.comparison import Side, make_side
    from analysis.comparison import compare as compare_sides

    amount = how_much(options["rollouts"], options["precision"], options["seconds"], usual=100_000)
    for name, side in (("a", a), ("b", b)):
        if not (isinstance(side, tuple) and len(side) == 2 and isinstance(side[0], World)):
            raise UsageError(argument(name, side), expected="(world, plan), a World and a plan for it")

    def make(side: tuple[World, PlanSource], loop: Loop | None, threat_checks: ThreatChecks) -> Side:
        world, plan = plan_of(*side)
        how = dict(options) | {"threat_checks": threat_checks}
        return make_side(world, plan, _rollouts(how, loop=loop or plan.usual_loop, **amount))

    def work(tell: ProgressCallback, doing: Doing) -> Comparison:
        doing("planning")
        first = make(a, options["loop"], options["threat_checks"])
        other = make(b, loop_b or options["loop"], threat_checks_b or options["threat_checks"])
        return compare_sides(first, other, progress=tell)

    return ask(work, options["progress"], options["on_interrupt"])


@overload
def check(world: World, plan: PlanSource = None, **how: Any) -> MapCheck: ...
@overload
def check(*, worlds: int, **how: Any) -> Survey: ...
@overload
def check(*, paper: Literal["fig4", "fig5", "fig6", "fig7", "all"], **how: Any) -> Reproduction: ...
def check(  # type: ignore[misc]
    world: World | None = None,
    plan: PlanSource = None,
    *,
    rollouts: int | None = None,
    seed: int = 0,
    engine: EngineName = "auto",
    threat_checks: ThreatChecks = "every_visit",
    bound: bool | None = None,
    theory: Literal["main", "all"] = "main",
    worlds: int | None = None,
    robots: Sequence[int] | None = None,
    kind: Literal["contiguous", "scattered"] | None = None,
    size: str | None = None,
    paper: Literal["fig4", "fig5", "fig6", "fig7", "all"] | None = None,
    maps: int | None = None,
    store: str | Path | None = None,
    processes: int | None = None,
    scheduler: str | Client | None = None,
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> MapCheck | Survey | Reproduction:
    """Check of the paper's formulas for a plan, on random maps (`worlds`), or of its experiments (`paper`).

    Args:
        world, plan: as of `evaluate`.
        rollouts: of the closed loop where it is not known exactly (20,000; 4,096 a team with `worlds`; 20 a map with
            `paper`). seed, engine, threat_checks, bound, progress, on_interrupt: as of `evaluate`.
        theory: rows of its table: "main", one per formula; "all", every reading and meaning of each.
        worlds: number of random maps; `kind` of their threats, "contiguous" or "scattered"; `size` of a map, "20x20";
            robots: team sizes, (1, 2, 4, 8, 20).
        paper: a figure of the paper, or "all"; maps: per setting (500); store: keep results in this file.
        processes, scheduler: as of `sweep`.
    """
    check_word("theory", theory, ("main", "all"))
    mode = check_mode({name: value for name, value in locals().items() if name in signature(check).parameters})
    if mode == "world" and robots is not None:
        known = [name for name in signature(check).parameters if name != "robots"]
        raise UnknownArgument.of(check, "robots", robots, known)
    if mode == "paper":
        return _paper(paper or "all", maps, rollouts, seed, store, locals())
    from analysis.checking.check import check_input, make_survey, run_survey

    first_only = _first_only({"threat_checks": threat_checks})
    count = rollouts or (20_000 if mode == "world" else 4096)
    choices = RolloutChoices(rollouts=count, seed=seed, engine=engine, first_only=first_only)
    if mode == "world":
        given = plan_of(world, plan)  # type: ignore[arg-type]
        return ask(lambda tell, doing: check_input(*given, choices, tell, bound, theory), progress, on_interrupt)
    sizes = (1, 2, 4, 8, 20) if robots is None else tuple(sorted(set(robots)))
    survey = make_survey(worlds or 0, kind, size, sizes, Choices(), bool(bound))
    return ask(
        lambda tell, doing: run_survey(survey, choices, processes=processes, progress=tell),
        progress,
        on_interrupt,
        "worlds",
    )


def _paper(
    figure: str, maps: int | None, rollouts: int | None, seed: int, store: str | Path | None, options: Mapping[str, Any]
) -> Reproduction:
    from analysis.experiments.reproduction import reproduce
    from analysis.sweeps.cases import check_maps
    from analysis.sweeps.store import Store

    count = {"maps": 500 if maps is None else maps, "rollouts": 20 if rollouts is None else rollouts, "seed": seed}
    check_maps(count["maps"], seed)

    def work(tell: ProgressCallback, doing: Doing) -> Reproduction:
        where = _where(options)
        with nullcontext() if store is None else Store.open(Path(store)) as kept:
            return reproduce(figure, **count, **where, store=kept, progress=tell)  # type: ignore[arg-type]

    return ask(work, options["progress"], options["on_interrupt"], "jobs")


# Searches: team sizes, trade-offs, start positions, threats to remove or to add.

Answered = TypeVar("Answered", bound=Found)


def _settings(world: World, options: Mapping[str, Any]) -> Settings:
    """The settings among the options. Raises InputError."""
    check_world(world)
    return settings_of(world, **{name: options[name] for name in SETTINGS if name in options and name != "deadline"})


def _rollouts(options: Mapping[str, Any], **how: Any) -> RolloutChoices:
    """The rollouts among the options; `how` replaces some. Raises UsageError."""
    given = {name: options[name] for name in ("seed", "engine", "deadline", "exact")}
    return RolloutChoices(first_only=_first_only(options), **{**given, **how})


def _first_only(options: Mapping[str, Any]) -> bool:
    """Whether only first visits can destroy a robot. Raises UsageError for an unknown word."""
    check_word("threat_checks", options["threat_checks"], OPTIONS["threat_checks"].words)
    return bool(options["threat_checks"] == "first_visit")


def _ask(search: Callable[..., Answered], options: Mapping[str, Any]) -> Answered:
    """The result of a search, with progress reports."""
    work = lambda tell, doing: search(progress=tell, doing=doing)  # noqa: E731
    return ask(work, options["progress"], options["on_interrupt"])


@takes(SizeOptions, deadline=REPORTED)
def size(
    world: World,
    *,
    target: float | None = None,
    confidence: float | None = None,
    complete: bool = False,
    meaning: Literal["visited", "survived"] = "visited",
    most: int = 64,
    starts: ArrayLike | None = None,
    loop: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    **options: Unpack[SizeOptions],
) -> TeamSize:
    """The smallest team that covers `target` on average, or with probability `confidence`; `complete`: every cell.

    Args:
        meaning: of "covered". most: largest team to try.
        starts: `[[row, col], ...]`, of which a team takes the first; default: the world's own, else its start rule.
        loop: as of `evaluate`. rollouts: of each team, at most (default: 100,000); or `precision`.
    """
    from analysis.search.team_size import find_size, make_goal

    settings = _settings(world, options)
    goal = make_goal(target, confidence, complete, meaning, most)
    amount = how_much(rollouts, precision, None, usual=100_000) | {"seconds": None}
    loop = loop or ("open" if settings.plan_for == "open_loop" else "closed")
    choices = _rollouts(options, loop=loop, **amount)
    if starts is not None:
        world = world.with_starts(check_starts(starts, world.met, "starts"))

    search = partial(find_size, world, settings, goal, choices)
    return _ask(search, options)


@takes(FrontOptions)
def front(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    losses: float | None = None,
    target: float | None = None,
    risk_caps: Sequence[float] | None = None,
    robot_values: Sequence[float] | None = None,
    rollouts: int | None = None,
    **options: Unpack[FrontOptions],
) -> Front:
    """Coverage against losses: policies, early ends, risk caps and robot values on common random numbers.

    Args:
        robots, starts: the team, as of `plan`.
        losses: pick the setting with the highest coverage that loses at most this many robots on average; or `target`:
            the one with the fewest losses that covers this much. `answer.plan_of(answer.picked)` is its plan.
        risk_caps, robot_values: values to try (default: derived from the map).
        rollouts: of each setting, the same for all; None: 4,096, fewer above 2,048 accessible cells.
    """
    from analysis.search.pareto import Ladders, find_front, make_goal, usual_rollouts

    settings, goal = _settings(world, options), make_goal(losses, target)
    ladders = Ladders(
        None if risk_caps is None else tuple(risk_caps), None if robot_values is None else tuple(robot_values)
    )
    placed = np.asarray(starts_of(world, robots, starts))
    choices = _rollouts(options, rollouts=usual_rollouts(world, placed) if rollouts is None else rollouts)

    search = partial(find_front, world, placed, settings, choices, goal=goal, ladders=ladders)
    return _ask(search, options)


@takes(SearchOptions)
def starts(
    world: World,
    robots: int | None = None,
    *,
    depot: bool = False,
    candidates: ArrayLike = "border",
    rollouts: int = 4096,
    **options: Unpack[SearchOptions],
) -> Starts:
    """The best starts of a team, one each or (`depot`) one for all: `answer.starts`, `answer.world_with_starts`.

    Args:
        robots: their number (default: that of the world's own team).
        candidates: "border", the safe cells on the border of the map; a mask `[H, W]`; or cells `[[row, col], ...]`.
        rollouts: of each of the last two candidates.
    """
    from analysis.search.start_positions import find_starts, team_size

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    size = team_size(world, robots)

    search = partial(find_starts, world, size, settings, choices, depot=depot, candidates=candidates)
    return _ask(search, options)


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

    Args:
        remove: number of threats to remove, one after the other: `answer.picks`, `answer.gain`.
        add: number of new threats: `answer.known`, `answer.hidden`, and the worlds with them.
        unit: of `remove`: the connected "areas" of danger, or the "sources", the polygons, points and sites of a
            scenario's threats; None: sources where there are several.
        p: of `add`: probability that a visit destroys a robot, in addition to the other threats (0.2).
        robots, starts: the team, as of `plan`.
        rollouts: of each of the last two candidates.
    """
    from analysis.search.threats import threats_search

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    search: Any = threats_search(remove, add, unit, p)
    placed = np.asarray(starts_of(world, robots, starts))
    return _ask(partial(search, world, placed, settings, choices), options)


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
    "check", "compare", "drive", "evaluate", "export", "front", "generate", "judge", "load", "plan", "read_outcomes",
    "read_rollouts", "record", "results", "size", "starts", "suite", "sweep", "threats",
]  # fmt: skip
