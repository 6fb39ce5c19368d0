"""The commands about a map and a team: `evaluate`, `compare`, `front`, `size`, `studio`, `starts`, `threats`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from analysis import api
from analysis.cli.console import DONE, check_files, check_folder, deliver, load_or_make_plan, may_replace, show
from analysis.cli.options import (
    ANY_POLICY,
    COMPARED,
    INPUT,
    ONE_PLAN,
    PLANNING,
    SECOND,
    TAKING_OVER,
    THE_TEAM,
    VERBATIM,
    WITHOUT_POLICY,
    Given,
    command,
    of,
    option,
)
from analysis.utils.notes import say
from planner.errors import InputError, UsageError
from planner.settings import OUTPUT

if TYPE_CHECKING:
    from analysis.evaluation.evaluate import Evaluation
    from analysis.report.model import Report
    from planner.plan.plan import Plan
    from planner.world.world import World

ANSWER, PLACE = "Answer", "Place"


@command(
    ANSWER, api.evaluate, THE_TEAM, PLANNING, "plan state", ONE_PLAN, "seconds",
    "Rollouts: threat_scale? sensor_range?",
    "bound theory", "Output: advice? marginal_risk?", "out json",
    policy=ANY_POLICY,
    theory=option(OUTPUT, "List the paper's formulas, each with a verdict.", "flag", default=False, rare=True),
    out="Write the page, pictures, plan and JSON to this folder.",
)  # fmt: skip
def evaluate(source: INPUT, /, given: Given) -> int:
    """Coverage and losses of a team, with intervals: exact values, rollouts and bounds."""
    from analysis.evaluation.evaluate import check_asked
    from analysis.evaluation.report import report
    from analysis.utils.progress import show_progress

    check_folder(given.out)
    asked = replace(given.asked(source), sensor_range=None)
    early = list[str]()

    def first(world: World) -> None:
        """Print the notes of the map's reader before the work starts."""
        check_asked(
            world, threat_scale=given.threat_scale, knowledge=given.sensor_range, marginal_risk=given.marginal_risk
        )
        early.extend(world.notes)
        say(early)

    seconds = given.seconds if asked.choices.searched else None
    world, made, notes = load_or_make_plan(asked, given.plan, given.state, first=first, seconds=seconds)
    earlier: Report | None = None

    def show_soon(found: Evaluation) -> None:
        nonlocal earlier
        so_far = report(found, given.theory, bounds=False)
        with progress.paused(), suppress(BrokenPipeError):  # a closed pipe is reported at the end of the command
            show(so_far, as_json=False, earlier=earlier)
        earlier = so_far

    own = {"policy": None, "plan": None, "state": None, "bound": given.bound or None, "band": given.out is not None}
    with show_progress() as progress:
        soon = None if given.json else show_soon
        answer = given.call(api.evaluate, world, made, progress=progress, show=soon, **own)
    return deliver(
        answer, report(answer, given.theory), out=given.out, as_json=given.json, source=source,
        notes=[note for note in notes if note not in early], also_read=(given.plan, given.state), earlier=earlier,
    )  # fmt: skip


OF_B: dict[str, Any] = {
    f"b_{name}": of(name, group=SECOND, default=None, rare=name not in ("robots", "starts", "policy", "plan", "loop"))
    for name in ("robots", "starts", "sensor_range", *PLANNING.split(), "plan", "loop", "threat_checks")
}


@command(
    ANSWER, api.compare, THE_TEAM, "sensor_range", PLANNING, "plan", ONE_PLAN, "seconds", "metric", *OF_B, "out json",
    plan="Plan file of A.",
    rollouts="Number of rollouts of each side (default: 100000).",
    precision="Stop at this half-width of the 95 % interval of the difference.",
    **OF_B,
    out="Write the page and JSON to this folder.",
)  # fmt: skip
def compare(
    a: Annotated[str, Parameter(name="A", converter=VERBATIM, help="As INPUT of `evaluate`.")],
    b: Annotated[
        str | None,
        Parameter(
            name="B", converter=VERBATIM, help="Another INPUT, or a plan file (.json) for A's map (default: A's map)."
        ),
    ] = None,
    /,
    given: Given = None,  # type: ignore[assignment]
) -> int:
    """Difference between two plans, settings, teams or maps, on common random numbers.

    Options apply to both sides; those that begin with --b. apply to B: `compare MAP --robots 4 --b.robots 6`.
    """
    from analysis.inputs import input_path

    check_folder(given.out)
    second = given.over("b_")
    source_b, plan_b = a if b is None else b, second.plan
    if b is not None and b.endswith(".json"):
        if given.b_plan is not None:
            raise UsageError("B is a plan file, and --b.plan is given", expected="one of them")
        source_b, plan_b = a, Path(b)
    *first, notes = _side("A", a, given.plan, given)
    *other, more = _side("B", source_b, plan_b, second)
    say(notes if notes == more else [*(f"A: {note}" for note in notes), *(f"B: {note}" for note in more)])
    own = {"loop_b": second.loop, "threat_checks_b": second.threat_checks}
    answer = given.call(api.compare, tuple(first), tuple(other), **own)
    files = (given.plan, plan_b, input_path(source_b))
    return deliver(answer, out=given.out, as_json=given.json, source=a, also_read=files)


def _side(name: str, source: str, plan: Path | None, given: Given) -> tuple[World, Plan, tuple[str, ...]]:
    """One side of `compare`, and notes; errors name the side."""
    try:
        return load_or_make_plan(given.asked(source), plan)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


@command(
    ANSWER, api.front, THE_TEAM, WITHOUT_POLICY, COMPARED, "Goal: losses target metric",
    "Planning: robot_values risk_caps", "plan_out out force json",
    plan_out=option(OUTPUT, "Write the plan of the selected setting (JSON) to this file.", "path"),
    out="Write the page, the picture, the selected plan and JSON to this folder.",
)  # fmt: skip
def front(source: INPUT, /, given: Given) -> int:
    """Coverage against lost robots: the Pareto front of policies, risk caps and robot values.

    With --losses or --target one setting is selected, confirmed by other rollouts, and printed as a command.
    """
    plan_out, out = given.plan_out, given.out
    if plan_out is not None and given.losses is None and given.target is None:
        raise UsageError(f"--plan-out {plan_out} without a pick", fix="add --losses or --target")
    check_files(source, plan_out)
    check_folder(out)
    if not may_replace(plan_out, given.force):
        return DONE
    task = given.task(source)
    answer = given.call(api.front, task.world, robots=None, starts=task.starts)
    answer = replace(answer, words=tuple(given.arguments(source)))
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
    ANSWER, api.size, "target", "starts cell_size step_seconds speed", PLANNING, ONE_PLAN,
    "Goal: confidence complete metric most", "out json",
    starts='Start cells, "row,col;row,col;..."; a team takes the first (default: the input\'s, else upper left).',
    out="Write the page, the picture and JSON to this folder.",
)  # fmt: skip
def size(source: INPUT, /, given: Given) -> int:
    """The smallest team with a given expected coverage, or a given probability of it.

    A team is enough if the whole interval is at or above the target, and not enough if it is below. With --deadline the
    coverage at that step decides. The exit status is 0 if no team is enough.
    """
    check_folder(given.out)
    answer = given.call(api.size, given.task(source).world, starts=None)
    return deliver(answer, out=given.out, as_json=given.json, source=source)


@command(
    ANSWER, api.studio, THE_TEAM, "seed", "Output: port",
    out="Scenario file (.yaml) that Save writes (default: INPUT-studio.yaml).",
)  # fmt: skip
def studio(source: INPUT, /, given: Given) -> int:
    """A local page to draw threats, obstacles and starts, with live results; Ctrl-C ends it.

    The page is served on this machine only, at the printed address (needs the extra `studio`).
    """
    from analysis.inputs import studio_scenario

    target = studio_scenario(source, given.out)
    check_files(source, target, suffix=".yaml")
    check_files(source, target.with_suffix(".npz"))
    task = given.task(source)
    given.call(api.studio, task.world, robots=len(task.starts), starts=task.world.starts, out=target)
    return DONE


@command(
    PLACE, api.starts, "robots cell_size step_seconds speed", "Rollouts: loop?", COMPARED, TAKING_OVER,
    "Goal: depot candidates metric", "scenario_out out json",
    scenario_out=option(OUTPUT, "Write the scenario with the best starts (.yaml) to this file.", "path"),
    out="Write the page, the picture, the plan and JSON to this folder.",
)  # fmt: skip
def starts(source: INPUT, /, given: Given) -> int:
    """The best start cells: one for each robot, or one for all.

    Candidates are screened by a bound; the best are simulated on common random numbers, and the winner is compared with
    the present starts on other rollouts. If it is not significantly better, the answer is to stay.
    """
    from analysis.inputs import input_path
    from planner.world.scenario import write_scenario

    scenario_out, out = given.scenario_out, given.out
    named = None if given.candidates in (None, "border") else Path(str(given.candidates))
    check_files(source, scenario_out, suffix=".yaml", also_read=(named,))
    check_folder(out)
    world = replace(given.asked(source), robots=None).load()
    say(world.notes)
    answer = given.call(api.starts, world)
    given.values["robots"] = None
    answer = replace(answer, words=tuple(given.arguments(source)))
    if scenario_out is not None:
        write_scenario(scenario_out, input_path(source), answer.starts, answer.settings, world.pace, given.cell_size)
        say([f"wrote {scenario_out}"])
    return deliver(answer, out=out, as_json=given.json, source=source, also_read=(named,))


@command(
    PLACE, api.threats, THE_TEAM, "Rollouts: loop?", COMPARED, TAKING_OVER, "Goal: remove add unit p", "out json",
    out="Write the page, pictures, JSON and, with --add, both maps (known.yaml, hidden.npz) to this folder.",
)  # fmt: skip
def threats(source: INPUT, /, given: Given) -> int:
    """The threats to remove first (--remove), or the worst cells for new ones (--add).

    --remove gives the gain with a new plan and with the old one. --add gives the cost if the robots know the new
    threats and if they do not. Candidates are compared on common random numbers and confirmed by other rollouts.
    """
    from analysis.search.threats import threats_search

    threats_search(given.remove, given.add, given.unit, given.p)  # raises UsageError
    check_folder(given.out)
    task = given.task(source)
    answer = given.call(api.threats, task.world, robots=None, starts=task.starts)
    return deliver(answer, out=given.out, as_json=given.json, source=source)
