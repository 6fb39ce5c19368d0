"""The commands about a map and a team: `evaluate`, `compare`, `front`, `size`, `studio`, `starts`, `threats`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from analysis.cli.console import DONE, check_files, check_folder, deliver, load_or_make_plan, may_replace, show
from analysis.cli.options import (
    ANY_POLICY,
    COMPARED,
    EARLY,
    INPUT,
    ONE_PLAN,
    PLANNING,
    SECOND,
    TAKING_OVER,
    THE_TEAM,
    WITHOUT_POLICY,
    Given,
    command,
    of,
    option,
    verbatim,
)
from analysis.utils.notes import say
from planner.arguments import is_whole
from planner.errors import InputError, UsageError
from planner.settings import BEST, GOAL, OPTIONS, OUTPUT, ROLLOUTS

if TYPE_CHECKING:
    from analysis.comparison import Side
    from analysis.evaluation.evaluate import Evaluation
    from analysis.inputs import Task
    from analysis.report.model import Report
    from analysis.report.result import Result
    from planner.world.world import World

ANSWER, PLACE = "Answer", "Place"


@command(
    ANSWER, THE_TEAM, PLANNING, "plan state", ONE_PLAN, "seconds",
    policy=ANY_POLICY,
    deadline=EARLY,
    rollouts="Number of rollouts (default: as many as --precision needs).",
    precision="Stop at this half-width of the 95 % interval of mean coverage (default: 0.001, a tenth of a point).",
    threat_scale=option(
        ROLLOUTS, 'Also evaluate the same plan with all threats multiplied by these factors: "0.5,1,2".', "text",
        rare=True,
    ),
    sensor_range=of(
        "sensor_range", group=ROLLOUTS, form="text",
        help='Also evaluate robots without a known map at these sensor ranges, in cells: "0,1,2,inf".',
    ),
    bound=OPTIONS["bound"],
    theory=option(OUTPUT, "List the paper's formulas, each with a verdict.", "flag", default=False, rare=True),
    advice=option(
        OUTPUT, "Coverage and losses of other settings (a few seconds; compiles on the first run).", "switch",
        default=True, rare=True,
    ),
    out="Write the page, pictures, plan and JSON to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def evaluate(source: INPUT, /, given: Given) -> int:
    """Coverage and losses of a team, with intervals: exact values, rollouts and bounds."""
    from analysis.evaluation.evaluate import check_asked
    from analysis.evaluation.evaluate import evaluate as evaluate_plan
    from analysis.evaluation.outputs.information import parse_ranges
    from analysis.evaluation.outputs.what_if import parse_scales
    from analysis.evaluation.report import report
    from analysis.utils.progress import show_progress

    scales, ranges = parse_scales(given.threat_scale), parse_ranges(given.sensor_range)
    if given.plan is None:
        given.enough(given.plan_for == "open_loop", None)
    check_folder(given.out)
    wanted = replace(given.asked(source), sensor_range=None)
    asked: dict[str, Any] = {"threat_scale": scales} | ({"knowledge": ranges} if ranges else {})
    sought = given.seconds if given.policy == BEST else None
    shown_notes: list[str] = []

    def first(world: World) -> None:
        """Print the notes of the map's reader before the work starts."""
        check_asked(world, **asked)
        shown_notes.extend(world.notes)
        say(shown_notes)

    world, made, notes = load_or_make_plan(wanted, given.plan, given.state, first=first, seconds=sought)
    notes = tuple(note for note in notes if note not in shown_notes)
    choices = given.enough(made.is_external, None)
    earlier: Report | None = None

    def show_soon(found: Evaluation) -> None:
        nonlocal earlier
        so_far = report(found, given.theory, bounds=False)
        with progress.paused(), suppress(BrokenPipeError):  # a closed pipe is reported at the end of the command
            show(so_far, as_json=False, earlier=earlier)
        earlier = so_far

    with show_progress() as progress:
        answer = evaluate_plan(
            world, made, choices, progress=progress, doing=progress.doing, bound=given.bound or None,
            band=given.out is not None, advice=given.advice, show=None if given.json else show_soon, **asked,
        )  # fmt: skip
    return deliver(
        answer, report(answer, given.theory), out=given.out, as_json=given.json, notes=notes, source=source,
        also_read=(given.plan, given.state), earlier=earlier,
    )  # fmt: skip


OF_B: dict[str, Any] = {
    f"b_{name}": of(name, group=SECOND, default=None, rare=name not in ("robots", "starts", "policy", "plan", "loop"))
    for name in ("robots", "starts", "sensor_range", *PLANNING.split(), "plan", "loop", "threat_checks")
}


@command(
    ANSWER, THE_TEAM, "sensor_range", PLANNING, "plan", ONE_PLAN, "seconds",
    plan="Plan file of A.",
    deadline=EARLY,
    rollouts="Number of rollouts of each side (default: 100000).",
    precision="Stop at this half-width of the 95 % interval of the difference.",
    **OF_B,
    out="Write the page and JSON to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def compare(
    a: Annotated[str, Parameter(name="A", converter=verbatim, help="As INPUT of `evaluate`.")],
    b: Annotated[
        str | None,
        Parameter(
            name="B", converter=verbatim, help="Another INPUT, or a plan file (.json) for A's map (default: A's map)."
        ),
    ] = None,
    /,
    given: Given = None,  # type: ignore[assignment]
) -> int:
    """Difference between two plans, settings, teams or maps, on common random numbers.

    Options apply to both sides; those that begin with --b. apply to B: `compare MAP --robots 4 --b.robots 6`.
    """
    from analysis.comparison import compare as compare_sides
    from analysis.inputs import input_path
    from analysis.utils.progress import show_progress

    check_folder(given.out)
    second = given.over("b_")
    source_b, plan_b = a if b is None else b, second.plan
    if b is not None and b.endswith(".json"):
        if given.b_plan is not None:
            raise UsageError("B is a plan file, and --b.plan is given", expected="one of them")
        source_b, plan_b = a, Path(b)
    if given.plan is None:
        given.enough(given.plan_for == "open_loop", 100_000)
    first, notes = _side("A", a, given.plan, given)
    other, more = _side("B", source_b, plan_b, second)
    say(notes if notes == more else [*(f"A: {note}" for note in notes), *(f"B: {note}" for note in more)])
    with show_progress() as progress:
        answer = compare_sides(first, other, progress=progress)
    files = (given.plan, plan_b, input_path(source_b))
    return deliver(answer, out=given.out, as_json=given.json, source=a, also_read=files)


def _side(name: str, source: str, plan: Path | None, given: Given) -> tuple[Side, tuple[str, ...]]:
    """One side of `compare`, and notes; errors name the side."""
    from analysis.comparison import make_side

    try:
        world, made, notes = load_or_make_plan(given.asked(source), plan)
        return make_side(world, made, given.enough(made.is_external, 100_000)), notes
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _task(given: Given, source: str) -> Task:
    """The map, team and settings of a search; their notes are printed."""
    from analysis.inputs import load_task

    task = load_task(given.asked(source))
    say(task.notes)
    return task


def _found(search: Callable[..., Result]) -> Any:
    """The result of a search, with a progress display."""
    from analysis.utils.progress import show_progress

    with show_progress() as progress:
        return search(progress=progress, doing=progress.doing)


@command(
    ANSWER, THE_TEAM, WITHOUT_POLICY, COMPARED,
    losses=option(GOAL, "Select the setting with the highest coverage at this mean number of lost robots.", "number"),
    target=of("target", help="Select the setting with the fewest lost robots at this mean coverage, a fraction."),
    robot_values=option(
        "Planning", 'Values of --robot-value to evaluate: "5,10,20" (default: a doubling series).', "text"
    ),
    risk_caps=option(
        "Planning", "Values of --risk-cap to evaluate (default: 0.1,0.25,0.5 up to 1,000 accessible cells).", "text"
    ),
    rollouts="Number of rollouts of each setting (default: 4096; fewer above 2,048 accessible cells).",
    deadline=of("deadline", group=ROLLOUTS),
    plan_out=option(OUTPUT, "Write the plan of the selected setting (JSON) to this file.", "path"),
    out="Write the page, the picture, the selected plan and JSON to this folder.",
    force=OPTIONS["force"],
    json=OPTIONS["json"],
)  # fmt: skip
def front(source: INPUT, /, given: Given) -> int:
    """Coverage against lost robots: the Pareto front of policies, risk caps and robot values.

    With --losses or --target one setting is selected, confirmed by other rollouts, and printed as a command.
    """
    from analysis.search.pareto import Ladders, find_front, make_goal, parse_numbers, usual_rollouts

    goal, plan_out, out = make_goal(given.losses, given.target), given.plan_out, given.out
    given.rolled()  # raises UsageError for an invalid value
    ladders = Ladders(parse_numbers("risk_caps", given.risk_caps), parse_numbers("robot_values", given.robot_values))
    if plan_out is not None and not goal:
        raise UsageError(f"--plan-out {plan_out} without a pick", fix="add --losses or --target")
    check_files(source, plan_out)
    check_folder(out)
    if not may_replace(plan_out, given.force):
        return DONE
    task = _task(given, source)
    choices = given.rolled(usual_rollouts(task.world, task.starts))
    search = partial(find_front, task.world, task.starts, task.settings, choices, goal=goal, ladders=ladders)
    answer = _found(partial(search, words=given.arguments(source)))
    if plan_out is not None and answer.picked is not None:
        answer.plan_of(answer.picked).save(plan_out, force=True)
        answer = replace(answer, plan_file=str(plan_out))
        say([f"wrote {plan_out}"])
    elif plan_out is not None:
        say([f"{plan_out} is not written: no setting is picked"])
    elif out is not None and answer.picked is not None:
        answer = replace(answer, plan_file=str(out / "plan.json"))
    return deliver(answer, out=out, as_json=given.json, source=source)


@command(
    ANSWER, "target", "starts cell_size step_seconds speed", PLANNING, ONE_PLAN,
    target="Fraction of the accessible cells to cover, above 0, at most 1.",
    confidence=option(
        GOAL, "Required chance of covering the target (default: expected coverage decides; with --complete: 0.95).",
        "number",
    ),
    complete=option(GOAL, "Cover every accessible cell: --target 1 with a confidence.", "flag", default=False),
    meaning=option(
        GOAL, "A cell counts when a robot enters it (visited) or leaves it alive (survived) (default: visited).", "",
        "visited", "survived", default="visited",
    ),
    most=option(GOAL, "Largest team to evaluate (default: 64; at most the number of starts).", "whole"),
    starts='Start cells, "row,col;row,col;..."; a team takes the first (default: the input\'s, else upper left).',
    deadline=EARLY,
    rollouts="Largest number of rollouts of each team (default: 100000).",
    out="Write the page, the picture and JSON to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def size(source: INPUT, /, given: Given) -> int:
    """The smallest team with a given expected coverage, or a given probability of it.

    A team is enough if the whole interval is at or above the target, and not enough if it is below. With --deadline the
    coverage at that step decides. The exit status is 0 if no team is enough.
    """
    from analysis.search.team_size import find_size, make_goal

    goal = make_goal(given.target, given.confidence, given.complete, given.meaning, given.most)
    check_folder(given.out)
    task = _task(given, source)
    choices = given.enough(task.settings.plan_for == "open_loop", 100_000)
    answer = _found(partial(find_size, task.world, task.settings, goal, choices))
    return deliver(answer, out=given.out, as_json=given.json, source=source)


SUFFIX = ".yaml"


@command(
    ANSWER, THE_TEAM, "seed",
    port=option(OUTPUT, "Port of the page (default: a free one).", "whole"),
    out="Scenario file (.yaml) that Save writes (default: INPUT-studio.yaml).",
)  # fmt: skip
def studio(source: INPUT, /, given: Given) -> int:
    """A local page to draw threats, obstacles and starts, with the answer; Ctrl-C ends it.

    The page is served on this machine only, at the printed address (needs the extra `studio`).
    """
    try:
        import tornado  # noqa: F401
    except ImportError:
        raise UsageError("tornado is not installed", fix='pip install "mrac-jax[studio]"') from None
    from analysis.inputs import input_path
    from analysis.sampling import RolloutChoices
    from analysis.studio.server import Sketch, Studio, raster_of, serve
    from analysis.utils.progress import ANNOUNCER, lines_now_and_then, notice_compiling, run_loop

    port, seed = given.port, given.seed or 0
    if port is not None and not is_whole(port, 1, 65535):
        raise UsageError(f"--port {port}", expected="a port, 1 to 65535")
    RolloutChoices(seed=seed)  # raises UsageError for an invalid seed
    target = Path(f"{input_path(source).stem}-studio{SUFFIX}") if given.out is None else given.out
    check_files(source, target, suffix=SUFFIX)
    check_files(source, raster_of(target))
    task = _task(given, source)
    first = Sketch.of(task.world, len(task.starts), task.settings)
    room = Studio(first, PurePath(source).name, target, seed)
    notice_compiling()
    try:
        with lines_now_and_then(lambda _: ANNOUNCER.line()):
            run_loop(serve(room, port or 0, lambda address: say([f"open {address}", "Ctrl-C ends it"])))
    except KeyboardInterrupt:
        say(["studio ended"])
    return DONE


@command(
    PLACE, "robots cell_size step_seconds speed", COMPARED, TAKING_OVER,
    depot=option(GOAL, "One start for all robots instead of one each.", "flag", default=False),
    candidates=option(
        GOAL, "Cells to start from: border, the safe cells on the border of the map; or a file, a mask or rows of "
        "row,col as .npy or .csv (default: border).", "text",
    ),
    robots="Number of robots (default: as in the input, else 1).",
    rollouts="Number of rollouts of each candidate (default: 4096).",
    deadline=of("deadline", group=ROLLOUTS),
    scenario_out=option(OUTPUT, "Write the scenario with the best starts (.yaml) to this file.", "path"),
    out="Write the page, the picture, the plan and JSON to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def starts(source: INPUT, /, given: Given) -> int:
    """The best start cells: one for each robot, or one for all.

    Candidates are screened by a bound; the best are simulated on common random numbers, and the winner is compared with
    the present starts on other rollouts. If it is not significantly better, the answer is to stay.
    """
    from analysis.inputs import input_path
    from analysis.search.start_positions import BORDER, find_starts, read_candidates, team_size
    from planner.world.scenario import write_scenario

    choices, scenario_out, out = given.rolled(), given.scenario_out, given.out
    named = None if given.candidates in (None, BORDER) else Path(str(given.candidates))
    check_files(source, scenario_out, suffix=".yaml", also_read=(named,))
    check_folder(out)
    candidates, notes = (BORDER, ()) if named is None else read_candidates(named)
    asked = replace(given.asked(source), robots=None)
    world = asked.load()
    settings = asked.choices.settings(world.team.settings, world.pace, by=world.source)
    say((*world.notes, *(f"{named}: {note}" for note in notes)))
    given.values["robots"], robots = None, given.robots
    search = partial(find_starts, world, team_size(world, robots), settings, choices, depot=given.depot)
    answer = _found(partial(search, candidates=candidates, source=named or "", words=given.arguments(source)))
    if scenario_out is not None:
        write_scenario(scenario_out, input_path(source), answer.starts, settings, world.pace, given.cell_size)
        say([f"wrote {scenario_out}"])
    return deliver(answer, out=out, as_json=given.json, source=source, also_read=(named,))


@command(
    PLACE, THE_TEAM, COMPARED, TAKING_OVER,
    remove=option(GOAL, "Find this many threats to remove, one after the other (default: 1).", "whole"),
    add=option(GOAL, "Find this many cells for new threats, the most harmful ones (default: 1).", "whole"),
    unit=option(
        GOAL, "A threat to remove: a connected area of danger (areas), or a polygon, point or site of the scenario "
        "(sources) (default: sources if there are several).", "", "areas", "sources",
    ),
    p=option(GOAL, "With --add: p of a new threat (default: 0.2).", "number"),
    rollouts="Number of rollouts of each candidate (default: 4096).",
    deadline=of("deadline", group=ROLLOUTS),
    out="Write the page, pictures, JSON and, with --add, both maps (known.yaml, hidden.npz) to this folder.",
    json=OPTIONS["json"],
)  # fmt: skip
def threats(source: INPUT, /, given: Given) -> int:
    """The threats to remove first (--remove), or the worst cells for new ones (--add).

    --remove gives the gain with a new plan and with the old one. --add gives the cost if the robots know the new
    threats and if they do not. Candidates are compared on common random numbers and confirmed by other rollouts.
    """
    from analysis.search.threats import threats_search

    search: Any = threats_search(given.remove, given.add, given.unit, given.p)
    choices = given.rolled()
    check_folder(given.out)
    task = _task(given, source)
    answer = _found(partial(search, task.world, task.starts, task.settings, choices))
    return deliver(answer, out=given.out, as_json=given.json, source=source)
