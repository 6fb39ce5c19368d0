"""The command line `mrac-jax`. Heavy imports happen inside the commands, so that `--help` is quick.

Results go to standard output, progress and notes to standard error. Exit status: 0 done; 1 a check failed; 2 bad input
or usage, one line on standard error beginning `error:`; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, CycloptsError, MissingArgumentError, Parameter, UnknownOptionError

from analysis.cli.console import (
    BAD_INPUT,
    COMMAND,
    DONE,
    INTERRUPTED,
    check_files,
    check_folder,
    check_streams,
    deliver,
    may_replace,
    output_console,
    print_json,
    show,
)
from analysis.cli.decisions import Altitude, attack, clear, drive, export, starts, studio
from analysis.cli.options import (
    OUTPUT,
    PLANNING,
    ROLLOUTS,
    Bound,
    Checking,
    Force,
    Input,
    Json,
    Kind,
    Metrics,
    Number,
    OfAnyPolicy,
    OutPath,
    Planning,
    PlanningToTheEnd,
    Rollouts,
    Second,
    SeeingTeam,
    Sought,
    StateFile,
    Team,
    Text,
    Timed,
    Traded,
    Wanted,
    Whole,
    path,
    verbatim,
)
from analysis.cli.stored import inspect, record, recover, replay, reproduce, results, suite, sweep
from analysis.utils.notes import elsewhere, say
from planner.arguments import COMMAND_LINE
from planner.errors import PER_VISIT, InputError, UsageError
from planner.renamed import RENAMED, RenamedWarning, warn_renamed
from planner.settings import BEST

if TYPE_CHECKING:
    from analysis.comparison import Side
    from analysis.evaluation.evaluate import Evaluation
    from analysis.report.model import Report
    from planner.world.world import World

NO_CACHE_OPTION = "--no-cache"
"""Of every command, and of nothing that a command knows of."""
app = App(
    name="mrac-jax",
    help="How much of a dangerous area will a team of robots cover before it is lost, and how sure are we?",
    help_epilogue=f"With {NO_CACHE_OPTION} a command keeps no compiled code on disk.",
    version=lambda: version("mrac-jax"),
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


@app.command
def evaluate(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: Sought | None = None,
    what: Timed | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    state: StateFile = None,
    threat_scale: Annotated[Text, Parameter(group=ROLLOUTS)] = None,
    sensor_range: Annotated[Text, Parameter(group=ROLLOUTS)] = None,
    metrics: Annotated[Metrics | None, Parameter(group=OUTPUT)] = None,
    bound: Bound = False,
    theory: Annotated[bool, Parameter(group=OUTPUT, negative="")] = False,
    advice: Annotated[bool, Parameter(group=OUTPUT)] = True,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Plan, then estimate how much the team covers: exact values, rollouts, and the paper's bounds.

    Args:
        plan: Evaluate this plan file instead of planning.
        threat_scale: Also if all threats are so many times the map's, the plan as it is: "0.5,1,2".
        sensor_range: Also with sensors of these ranges in cells, common random numbers: "0,1,2,inf".
        metrics: What is found and left of what cells are worth, in the words of this field.
        bound: Also compute the upper bound where that is expensive, above 1,000 dangerous cells; as sharp as it gets
            above 500 accessible ones.
        theory: Also list the paper's formulas, each with a verdict.
        advice: Also what other settings cover and lose: a few seconds more, and on a first run a compilation.
        out: Write the page, pictures, plan and JSON to this folder.
    """
    from analysis.cli.console import load_or_make_plan
    from analysis.evaluation.evaluate import check_asked
    from analysis.evaluation.evaluate import evaluate as evaluate_plan
    from analysis.evaluation.outputs.information import parse_ranges
    from analysis.evaluation.outputs.what_if import parse_scales
    from analysis.evaluation.report import report
    from analysis.utils.progress import show_progress

    team, planning, what = team or Team(), planning or Sought(), what or Timed()
    scales, ranges = parse_scales(threat_scale), parse_ranges(sensor_range)
    if plan is None:
        what.choices(planning.plan_for == "open_loop", None)
    check_folder(out)
    wanted = team.asked(source, planning.choices())
    asked: dict[str, Any] = {"threat_scale": scales} | ({} if metrics is None else {"value": metrics})
    asked |= {"knowledge": ranges} if ranges else {}
    sought = what.seconds if planning.policy == BEST else None
    told: list[str] = []

    def first(world: World) -> None:
        """What the map's reader noted is said before anything takes long."""
        check_asked(world, **asked)
        told.extend(world.notes)
        say(told)

    world, made, notes = load_or_make_plan(wanted, plan, state, first=first, seconds=sought)
    notes = tuple(note for note in notes if note not in told)
    choices = what.choices(made.is_foreign, None)
    earlier: Report | None = None

    def show_soon(found: Evaluation) -> None:
        nonlocal earlier
        so_far = report(found, theory, bounds=False)
        with progress.paused(), suppress(BrokenPipeError):  # the end of the command says that nobody reads it
            show(so_far, as_json=False, earlier=earlier)
        earlier = so_far

    with show_progress() as progress:
        answer = evaluate_plan(
            world, made, choices, progress=progress, doing=progress.doing, bound=bound or None,
            band=out is not None, advice=advice, show=None if as_json else show_soon, **asked,
        )  # fmt: skip
    return deliver(
        answer, report(answer, theory), out=out, as_json=as_json, notes=notes, source=source, beside=(plan, state),
        earlier=earlier,
    )  # fmt: skip


@app.command
def size(
    source: Input,
    /,
    *,
    wanted: Wanted | None = None,
    planning: Planning | None = None,
    what: Rollouts | None = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """The smallest team whose expected coverage, or whose chance of it, reaches a target; with the curve.

    A team is enough when the whole interval lies at or above what is wanted, not enough when it lies below, else it is
    rolled out further, up to --rollouts, and undecided at the end. With --deadline it goes by coverage at that step.
    That no team is enough is an answer too, with exit status 0.

    Args:
        out: Write the page, the picture of the curve and JSON to this folder.
    """
    from analysis.inputs import load_task
    from analysis.search.team_size import find_size, make_goal
    from analysis.utils.progress import show_progress

    wanted, planning, what = wanted or Wanted(), planning or Planning(), what or Rollouts()
    goal = make_goal(wanted.target, wanted.confidence, wanted.complete, wanted.meaning, wanted.most)
    check_folder(out)
    task = load_task(wanted.team().asked(source, planning.choices()))
    choices = what.choices(task.settings.plan_for == "open_loop")
    say(task.notes)
    with show_progress() as progress:
        answer = find_size(task.world, task.settings, goal, choices, progress=progress, doing=progress.doing)
    return deliver(answer, out=out, as_json=as_json, source=source)


@app.command
def front(
    source: Input,
    /,
    *,
    team: Team | None = None,
    what: Traded | None = None,
    planning: OfAnyPolicy | None = None,
    plan_out: OutPath = None,
    out: OutPath = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """What more coverage costs in robots: policies, missions ended early, reserves and worths on common random numbers.

    With --losses or --target one of them is picked, checked on other rollouts, and named as a command.

    Args:
        plan_out: Write the plan of the pick (JSON) here.
        out: Write the page, the picture, the pick's plan and JSON to this folder.
    """
    from analysis.inputs import load_task
    from analysis.search.pareto import Ladders, find_front, make_goal, parse_numbers, usual_rollouts
    from analysis.utils.progress import show_progress

    team, what, planning = team or Team(), what or Traded(), planning or OfAnyPolicy()
    goal, settings = make_goal(what.losses, what.target), planning.choices()
    what.choices()
    ladders = Ladders(parse_numbers("risk_caps", what.risk_caps), parse_numbers("robot_values", what.robot_values))
    if plan_out is not None and not goal:
        raise UsageError(f"--plan-out {plan_out} without a pick", fix="add --losses or --target")
    check_files(source, plan_out)
    check_folder(out)
    if not may_replace(plan_out, force):
        return DONE
    task = load_task(team.asked(source, settings))
    say(task.notes)
    choices = what.choices(usual_rollouts(task.world, task.starts))
    with show_progress() as progress:
        answer = find_front(
            task.world, task.starts, task.settings, choices, goal=goal, ladders=ladders,
            words=what.words(source, team, planning), progress=progress, doing=progress.doing,
        )  # fmt: skip
    if plan_out is not None and answer.picked is not None:
        answer.plan_of(answer.picked).save(plan_out, force=True)
        answer = replace(answer, plan_file=str(plan_out))
        say([f"wrote {plan_out}"])
    elif plan_out is not None:
        say([f"{plan_out} is not written: no setting is picked"])
    elif out is not None and answer.picked is not None:
        answer = replace(answer, plan_file=str(out / "plan.json"))
    return deliver(answer, out=out, as_json=as_json, source=source)


@app.command
def check(
    source: Annotated[Input | None, Parameter(name="INPUT")] = None,
    /,
    *,
    what: Checking | None = None,
    planning: Planning | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Which of the paper's formulas, and of ours, hold on this map, or on many random ones?

    The open loop's expected values are exact; the closed loop's are exact where that is cheap, else sampled, with
    intervals that hold together with 95 % confidence. Exit status 1: a formula that is marked as proven fails.

    Args:
        plan: Check on this plan file instead of planning.
        out: Write pictures, JSON, and the worst worlds to this folder.
    """
    what, planning = what or Checking(), planning or Planning()
    what.refuse(source, plan)
    check_folder(out)
    if source is None:
        return _check_worlds(what, planning, out, as_json)
    return _check_input(source, what, planning, plan, out, as_json)


def _check_input(
    source: str, what: Checking, planning: Planning, plan: Path | None, out: Path | None, as_json: bool
) -> int:
    from analysis.checking.check import check_input, check_world
    from analysis.cli.console import load_or_make_plan
    from analysis.utils.progress import show_progress

    choices = what.rolled(20_000)
    asked = what.team().asked(source, planning.choices())
    world, made, notes = load_or_make_plan(asked, plan, first=check_world)
    say(notes)
    with show_progress() as progress:
        answer = check_input(world, made, choices, progress, what.bound or None, what.theory)
    return deliver(answer, out=out, as_json=as_json, source=source, beside=(plan,))


def _check_worlds(what: Checking, planning: Planning, out: Path | None, as_json: bool) -> int:
    from analysis.checking.check import make_survey, run_survey
    from analysis.cli.console import show_pool_progress

    choices = make_survey(what.worlds or 0, what.kind, what.size, what.team_sizes(), planning.choices(), what.bound)
    rollouts = what.rolled(4096)
    with show_pool_progress("worlds", [choices.settings.policy]) as progress:
        answer = run_survey(choices, rollouts, processes=what.processes, progress=progress)
    return deliver(answer, out=out, as_json=as_json)


@app.command(name="plan")
def plan_command(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: PlanningToTheEnd | None = None,
    state: StateFile = None,
    out: OutPath = None,
    waypoints: OutPath = None,
    altitude: Altitude = None,
    seconds: Annotated[Number, Parameter(group=PLANNING)] = None,
    force: Force = False,
    as_json: Annotated[Json, Parameter(help="Print the plan file's JSON object.")] = False,
) -> int:
    """Plan alone: print what the plan is, and write it as a file or as waypoints to drive.

    Args:
        out: Write the plan file (JSON) here.
        waypoints: Write paths to drive: .csv .plan .yaml .geojson .kml .gpx .tif, as of `export`.
        seconds: With plan-for open or policy best: end the search after so many.
    """
    from analysis.cli.console import load_or_make_plan, print_plan
    from analysis.exporting import choose_format, export, make_mission
    from analysis.inputs import read_files

    team, planning = team or Team(), planning or PlanningToTheEnd()
    if altitude is not None and waypoints is None:
        raise UsageError("--altitude without --waypoints", fix="add --waypoints")
    check_files(source, out, waypoints, beside=(state,))
    if not may_replace(out, force):
        return DONE
    form = None if waypoints is None else choose_format(waypoints, None, "waypoints")
    asked = team.asked(source, planning.choices())
    check = None if form is None else form.check
    world, made, notes = load_or_make_plan(asked, state=state, seconds=seconds, first=check)
    say(notes)
    written = [] if out is None else [out]
    if waypoints is not None and form is not None:
        mission = make_mission(world, made, altitude, team.speed)
        written += export(mission, waypoints, form, spare=read_files(source, state, out))
        say(mission.unknown(form.figures))
    if out is not None:
        made.save(out, force=True)
    if as_json:
        print_json(made.to_json())
    else:
        print_plan(made, world, output_console())
    say([f"wrote {file}" for file in written])
    return DONE


@app.command
def compare(
    a: Annotated[str, Parameter(name="A", converter=verbatim)],
    b: Annotated[Text, Parameter(name="B")] = None,
    /,
    *,
    team: SeeingTeam | None = None,
    planning: Planning | None = None,
    what: Timed | None = None,
    second: Second | None = None,
    plan: Annotated[Path | None, Parameter(group=PLANNING, converter=path)] = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Two plans, settings, teams or maps on common random numbers, with the interval of the difference.

    Options are for both sides; those that begin with --b. are B's own: `compare MAP --robots 4 --b.robots 6`.

    Args:
        a: As INPUT of `evaluate`.
        b: Another INPUT, or a plan file (.json) for A's map (default: A's map again).
        plan: Plan file of A.
        out: Write the page and JSON to this folder.
    """
    from analysis.comparison import compare as compare_sides
    from analysis.inputs import input_path
    from analysis.utils.progress import show_progress

    check_folder(out)
    options, second = (team or SeeingTeam(), planning or Planning(), what or Timed()), second or Second()
    source_b, plan_b = a if b is None else b, plan if second.plan is None else second.plan
    if b is not None and b.endswith(".json"):
        if second.plan is not None:
            raise UsageError("B is a plan file, and --b.plan is given", expected="one of them")
        source_b, plan_b = a, Path(b)
    if plan is None:
        options[2].choices(options[1].plan_for == "open_loop")
    first, notes = _side("A", a, plan, *options)
    other, more = _side("B", source_b, plan_b, *second.over(*options))
    say(notes if notes == more else [*(f"A: {note}" for note in notes), *(f"B: {note}" for note in more)])
    with show_progress() as progress:
        answer = compare_sides(first, other, progress=progress)
    return deliver(answer, out=out, as_json=as_json, source=a, beside=(plan, plan_b, input_path(source_b)))


def _side(
    name: str, source: str, plan: Path | None, team: Team, planning: Planning, what: Timed
) -> tuple[Side, tuple[str, ...]]:
    """One of the two of `compare`, and notes; errors say which."""
    from analysis.cli.console import load_or_make_plan
    from analysis.comparison import make_side

    try:
        world, made, notes = load_or_make_plan(team.asked(source, planning.choices()), plan)
        return make_side(world, made, what.choices(made.is_foreign)), notes
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


@app.command
def generate(
    out: Annotated[Path, Parameter(name="OUT", converter=path)],
    /,
    *,
    on: Annotated[Text, Parameter(name="--map")] = None,
    kind: Kind = "contiguous",
    size: Text = None,
    obstacles: Number = None,
    ratio: Number = None,
    areas: Whole = None,
    levels: Text = None,
    seed: Whole = None,
    robots: Whole = None,
    cell_size: Number = None,
) -> int:
    """Make one of the paper's random worlds, or put such threats on a map.

    Args:
        out: World file (.npz) to write.
        on: Put the threats on the free cells of this INPUT.
        size: HxW in cells (default: 20x20).
        obstacles: Fraction of the cells that are obstacles (default: 0.25).
        ratio: Fraction of cells that are dangerous; with --map, of its free cells (default: 0.25).
        areas: Contiguous areas of threats (default: 10).
        levels: Threat levels, in turn (default: 0.04,0.08,0.12,0.16,0.20).
        seed: Of the world (default: 0).
        robots: Also store this many starts, upper-left.
        cell_size: With --map: cells in metres, the map is coarsened.
    """
    from analysis.inputs import generate_world

    check_files(on, out, suffix=".npz")
    world, notes = generate_world(on, kind, size, obstacles, ratio, areas, levels, seed, robots, cell_size)
    world.save(out, force=True)
    say([*notes, f"wrote {out}"])
    return DONE


PLANS, MISSIONS = (
    (attack, clear, starts, studio, suite, sweep),
    (drive, export, inspect, record, recover, replay),
)
for command in (*PLANS, *MISSIONS, reproduce, results):
    app.command(command)


LEFT = {"graph": "orienteering on graphs left with release 0.4; use release 0.3"}
LEFT |= dict.fromkeys(("--luck", "--mode"), PER_VISIT)
"""Commands and options of older releases, and where they are."""


def _missing(error: MissingArgumentError) -> str:
    """What a command needs, in words: something to work on, or the value of an option."""
    name, command = error.argument.name if error.argument else "", " ".join(error.command_chain or ("mrac-jax",))
    wanted = {"INPUT": "an INPUT, e.g. example:paper", "A": "A, an INPUT, e.g. example:paper"}.get(name, name)
    return f"{command} needs {wanted if name.isupper() else f'a value after {error.keyword or name}'}"


def _unknown(error: UnknownOptionError) -> str:
    """The line for an option that a command does not have: what is meant, if need be another command's option."""
    given, command = (error.token.keyword or error.token.value).split("=")[0], " ".join(error.command_chain or ())
    if given in LEFT:
        return f"{given}: {LEFT[given]}"
    options = {
        name: [one for argument in app[name].assemble_argument_collection() for one in argument.names if one[:1] == "-"]
        for name in app
        if name[:1] != "-"
    }
    own = options.pop(command, [])
    fix = elsewhere(given, own, options, "option") or f"`mrac-jax {command} --help` lists its options"
    return f"Unknown option: {given}; {fix}"


def _new_option(word: str) -> str:
    """A word of the command line, an option of release 0.3 under today's name, with one line that gives it."""
    name, *value = word.split("=", 1)
    start, last = ("--b.", name[4:]) if name.startswith("--b.") else ("--", name[2:])
    new = RENAMED.get(last.replace("-", "_")) if name.startswith("--") else None
    if new is None or last in ("truth", "prior", "movers", "hazard", "uncertain"):
        return word
    option = start + new.replace("_", "-")
    warn_renamed(name, option)
    return "=".join([option, *value])


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit status. A name of release 0.3 is one line on standard error."""
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show_warning(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, RenamedWarning):
                say([f"note: {message}"])
            else:
                usual(message, category, *where, **more)

        warnings.showwarning = show_warning
        warnings.simplefilter("default", RenamedWarning)
        return _run(arguments)


def _run(arguments: Sequence[str] | None) -> int:
    words = list(sys.argv[1:] if arguments is None else arguments)
    if NO_CACHE_OPTION in words:
        words = [word for word in words if word != NO_CACHE_OPTION]
        from planner.simulator.jit import NO_CACHE

        os.environ[NO_CACHE] = "1"
    if words and words[0] in LEFT:
        say([f"error: {words[0]}: {LEFT[words[0]]}"])
        return BAD_INPUT
    told, named = COMMAND.set(tuple(words)), COMMAND_LINE.set(True)
    try:
        words = [_new_option(word) for word in words]
        check_streams()
        status: Any = app(words, exit_on_error=False, print_error=False, console=output_console())
        return status if isinstance(status, int) else DONE
    except MissingArgumentError as error:
        line = _missing(error)
    except UnknownOptionError as error:
        line = _unknown(error)
    except CycloptsError as error:  # which wraps the InputError of an option's converter, a ValueError
        line = " ".join(str(error.__cause__ if isinstance(error.__cause__, InputError) else error).split())
    except InputError as error:
        line = str(error)
    except BrokenPipeError:  # the reader has gone, as `head` does: nothing more to say
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115
        return DONE
    except KeyboardInterrupt:
        say(["interrupted"])
        return INTERRUPTED
    except MemoryError:
        line = "out of memory; expected a map that fits; coarsen it with cell_size"
    except OSError as error:
        line = f"{error.filename or 'output'}: {error.strerror}; expected a file or folder that can be used"
    finally:
        COMMAND.reset(told)
        COMMAND_LINE.reset(named)
    say([f"error: {line}"])
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(run())
