"""The command line `mrac-jax`. Heavy imports happen inside the commands, so that `--help` is quick.

Results go to standard output, progress and notes to standard error. Exit status: 0 done; 1 a check failed; 2 bad input
or usage, one line on standard error beginning `error:`; 130 interrupted.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, CycloptsError, Parameter

from analysis.console import check_files, check_folder, check_streams, output_console, say
from analysis.options import (
    GOAL,
    PLANNING,
    ROLLOUTS,
    TEAM,
    Checks,
    EngineName,
    Input,
    Json,
    Kind,
    Loop,
    Meaning,
    Mode,
    NoCache,
    Number,
    OutPath,
    Risk,
    Text,
    Transit,
    Whole,
    path,
)
from planner.errors import InputError, UsageError

if TYPE_CHECKING:
    from analysis.evaluate import RolloutChoices
    from analysis.evaluation import Evaluation
    from analysis.inputs import Choices
    from planner.plan import Plan
    from planner.world import World

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
NO_CACHE = "MRAC_JAX_NO_CACHE"

app = App(
    name="mrac-jax",
    help="How much of a dangerous area will a team of robots cover before it is lost, and how sure are we?",
    version=lambda: version("mrac-jax"),
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


@Parameter(name="*")
@dataclass
class Team:
    """Who drives.

    Attributes:
        robots: How many robots (default: as many as the input's starts, else its count, else 1).
        starts: Where they start, "row,col;row,col;..." (default: the input's starts, else upper-left).
        cell_size: Cells of a bare map in metres, the robot's footprint: the map is coarsened (default: its pixels).
    """

    robots: Annotated[Whole, Parameter(group=TEAM)] = None
    starts: Annotated[Text, Parameter(group=TEAM)] = None
    cell_size: Annotated[Number, Parameter(group=TEAM)] = None


@Parameter(name="*")
@dataclass
class Wanted:
    """When a team is enough.

    Attributes:
        target: Fraction of the accessible cells to cover, above 0, at most 1.
        confidence: The chance to cover that much is to reach this (default: the expected coverage is to reach the
            target; with --complete: 0.95).
        complete: The target is every accessible cell: --target 1 with a confidence.
        meaning: A cell counts once a robot entered it (visited) or left it alive (survived) (default: visited).
        most: Robots of the largest team to look at (default: 64; never more than there are starts).
        starts: Where they start, "row,col;row,col;...": a team takes the first of them (default: the input's starts,
            else upper-left).
        cell_size: Cells of a bare map in metres, the robot's footprint: the map is coarsened (default: its pixels).
    """

    target: Annotated[Number, Parameter(group=GOAL)] = None
    confidence: Annotated[Number, Parameter(group=GOAL)] = None
    complete: Annotated[bool, Parameter(group=GOAL, negative="")] = False
    meaning: Annotated[Meaning, Parameter(group=GOAL)] = "visited"
    most: Annotated[Whole, Parameter(group=GOAL)] = None
    starts: Annotated[Text, Parameter(group=TEAM)] = None
    cell_size: Annotated[Number, Parameter(group=TEAM)] = None


@Parameter(name="*")
@dataclass
class Planning:
    """How they plan.

    Attributes:
        levels: Most threat levels, safe counted; a map with more is quantised (default: the input's, else 16).
        density: Least cells a robot of a safe area is to have, d (default: 4).
        risk: Cost of a dangerous cell: as in the paper, or by log-survival (default: paper).
        transit: Legs inside an area may cross others (grid) or not (area) (default: grid).
        max_steps: End an unfinished run at this step (default: 8 * levels * accessible cells + 64).
    """

    levels: Annotated[Whole, Parameter(group=PLANNING)] = None
    density: Annotated[Number, Parameter(group=PLANNING)] = None
    risk: Annotated[Risk, Parameter(group=PLANNING)] = None
    transit: Annotated[Transit, Parameter(group=PLANNING)] = None
    max_steps: Annotated[Whole, Parameter(group=PLANNING)] = None

    def choices(self) -> Choices:
        """The same as the planner's plain type."""
        from analysis.inputs import Choices

        return Choices(self.levels, self.density, self.risk, self.transit, self.max_steps)


@Parameter(name="*")
@dataclass
class Rollouts:
    """What is rolled out.

    Attributes:
        loop: Reallocate and share at run time (closed, the default), or follow the plan until stopped (open).
        mode: Open loop: one draw a robot (fast, the default), or one a dangerous entry, as in the closed loop (step).
        rollouts: How many; `size`: at most, for each team (default: 100000).
        precision: Instead of a number: stop when the half-width of the 95 % interval of mean coverage is below this.
        deadline: Report coverage by the end of this step too; `size`: go by it.
        seed: Of the rollouts; never changes the world or the plan.
        engine: Open loop: which engine; the counts are the same (default: auto, numba on a CPU).
        threat_checks: Every visit can stop a robot, or only the first visit of a cell by anybody.
    """

    loop: Annotated[Loop, Parameter(group=ROLLOUTS)] = None
    mode: Annotated[Mode, Parameter(group=ROLLOUTS)] = None
    rollouts: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    precision: Annotated[Number, Parameter(group=ROLLOUTS)] = None
    deadline: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    seed: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    engine: Annotated[EngineName, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Annotated[Checks, Parameter(group=ROLLOUTS)] = "every_visit"

    def choices(self, foreign: bool) -> RolloutChoices:
        """The same as a plain type, checked; `foreign`: for the plan of another planner, which runs open loop."""
        from analysis.evaluate import RolloutChoices

        if self.rollouts is not None and self.precision is not None:
            raise UsageError("both --rollouts and --precision are given", expected="one of them")
        if foreign and self.loop == "closed":
            raise UsageError("--loop closed needs areas; the plan of another planner has none", fix="use --loop open")
        if foreign and self.threat_checks == "first_visit":
            raise UsageError("--threat-checks first_visit needs areas; the plan of another planner has none")
        loop = self.loop or ("open" if foreign else "closed")
        if loop == "closed" and self.mode == "fast":
            raise UsageError("--mode fast is for the open loop", fix="leave it out, or use --loop open")
        choices = RolloutChoices(
            loop=loop,
            rollouts=100_000 if self.rollouts is None else self.rollouts,
            precision=self.precision,
            mode=self.mode or "fast",
            engine=self.engine,
            seed=self.seed or 0,
            deadline=self.deadline,
            first_only=self.threat_checks == "first_visit",
        )
        choices.check()
        return choices


@app.command
def evaluate(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: Planning | None = None,
    what: Rollouts | None = None,
    plan: Annotated[
        Path | None, Parameter(group=PLANNING, converter=path, help="Evaluate this plan file instead of planning.")
    ] = None,
    out: Annotated[OutPath, Parameter(help="Write pictures, plan and JSON to this folder.")] = None,
    as_json: Json = False,
    no_cache: NoCache = False,
) -> int:
    """Plan, then estimate how much the team covers: exact values, rollouts, and the paper's bounds."""
    from analysis.evaluate import evaluate as evaluate_plan
    from analysis.inputs import load_or_make_plan
    from analysis.progress import show_progress

    team, planning, what = team or Team(), planning or Planning(), what or Rollouts()
    if plan is None:
        what.choices(foreign=False)
    check_folder(out)
    settings = planning.choices()
    world, made, notes = load_or_make_plan(source, plan, team.robots, team.starts, settings, team.cell_size)
    choices = what.choices(made.is_foreign)
    say(notes)
    with show_progress() as progress:
        answer = evaluate_plan(world, made, choices, progress=progress, band=out is not None)
    if out is not None:
        from analysis.folder import save_folder

        say([f"wrote {written}" for written in save_folder(answer, out)])
    _print_evaluation(answer, as_json)
    return INTERRUPTED if answer.partial else DONE


def _print_evaluation(answer: Evaluation, as_json: bool) -> None:
    if as_json:
        from analysis.report import to_json

        print(json.dumps(to_json(answer), allow_nan=False), flush=True)  # noqa: T201
        return
    from analysis.table import print_evaluation

    print_evaluation(answer, output_console())


@app.command
def size(
    source: Input,
    /,
    *,
    wanted: Wanted | None = None,
    planning: Planning | None = None,
    what: Rollouts | None = None,
    out: Annotated[OutPath, Parameter(help="Write the picture of the curve and the JSON to this folder.")] = None,
    as_json: Json = False,
    no_cache: NoCache = False,
) -> int:
    """The smallest team whose expected coverage, or whose chance of it, reaches a target; with the curve.

    A team is enough when the whole interval lies at or above what is wanted, not enough when it lies below, else it is
    rolled out further, and undecided at the end. That no team is enough is an answer too, with exit status 0.
    """
    from analysis.inputs import load_task
    from analysis.progress import show_team_progress
    from analysis.size import find_size, make_goal
    from analysis.size_report import print_size, save_size, size_json

    wanted, planning, what = wanted or Wanted(), planning or Planning(), what or Rollouts()
    goal = make_goal(wanted.target, wanted.confidence, wanted.complete, wanted.meaning, wanted.most)
    choices = what.choices(foreign=False)
    check_folder(out)
    task = load_task(source, None, wanted.starts, planning.choices(), wanted.cell_size)
    say(task.notes)
    with show_team_progress() as progress:
        answer = find_size(task.world, task.settings, goal, choices, progress=progress)
    if out is not None:
        say([f"wrote {written}" for written in save_size(answer, out)])
    if as_json:
        print(json.dumps(size_json(answer), allow_nan=False), flush=True)  # noqa: T201
    else:
        print_size(answer, output_console())
    return INTERRUPTED if answer.partial else DONE


@app.command(name="plan")
def plan_command(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: Planning | None = None,
    out: Annotated[OutPath, Parameter(help="Write the plan file (JSON) here.")] = None,
    waypoints: Annotated[OutPath, Parameter(help="Write robot, step, x, y, yaw (map frame, metres) as CSV.")] = None,
    as_json: Annotated[Json, Parameter(help="Print the plan file's JSON object.")] = False,
    no_cache: NoCache = False,
) -> int:
    """Plan alone: print what the plan is, and write it as a file or as waypoints to drive."""
    from analysis.inputs import load_or_make_plan
    from planner.waypoints import write_waypoints

    team, planning = team or Team(), planning or Planning()
    check_files(source, out, waypoints)
    choices = planning.choices()
    world, made, notes = load_or_make_plan(source, None, team.robots, team.starts, choices, team.cell_size)
    say(notes)
    if out is not None:
        made.save(out)
    if waypoints is not None:
        write_waypoints(made, world, waypoints)
    if as_json:
        print(json.dumps(made.to_json(), allow_nan=False), flush=True)  # noqa: T201
    else:
        _print_plan(made, world)
    say([f"wrote {written}" for written in (out, waypoints) if written is not None])
    return DONE


def _print_plan(made: Plan, world: World) -> None:
    from rich import box
    from rich.table import Table

    from planner.plan import entries

    console = output_console()
    console.print(
        f"{len(made.robots)} robots, {len(made.areas)} areas, nominal run {made.outcome}, makespan {made.makespan} "
        f"steps, {made.shares} areas shared",
        highlight=False,
    )
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("robot", "start", "moves", "areas covered", "survives its path, %"):
        table.add_column(column, justify="right")
    from analysis.exact import robot_chances

    for number, robot in enumerate(made.robots):
        start = divmod(int(robot.path[0]), made.shape[1])
        covered = sum(leg.kind == "cover" for leg in robot.legs)
        moves, survival = len(entries(robot.path)) - 1, robot_chances(robot, world).survival
        table.add_row(str(number), str(list(start)), str(moves), str(covered), f"{100 * survival:.2f}")
    console.print(table)


@app.command
def generate(
    out: Annotated[Path, Parameter(name="OUT", converter=path, help="World file (.npz) to write.")],
    /,
    *,
    on: Annotated[Text, Parameter(name="--map", help="Put the threats on the free cells of this INPUT.")] = None,
    kind: Kind = "contiguous",
    size: Annotated[Text, Parameter(help="HxW in cells (default: 20x20).")] = None,
    obstacles: Annotated[Number, Parameter(help="Fraction of the cells that are obstacles (default: 0.25).")] = None,
    ratio: Annotated[
        Number,
        Parameter(help="Fraction of cells that are dangerous; with --map, of its free cells (default: 0.25)."),
    ] = None,
    areas: Annotated[Whole, Parameter(help="Contiguous areas of threats (default: 10).")] = None,
    levels: Annotated[Text, Parameter(help="Threat levels, in turn (default: 0.04,0.08,0.12,0.16,0.20).")] = None,
    seed: Annotated[Whole, Parameter(help="Of the world (default: 0).")] = None,
    robots: Annotated[Whole, Parameter(help="Also store this many starts, upper-left.")] = None,
    no_cache: NoCache = False,
) -> int:
    """Make one of the paper's random worlds, or put such threats on a map."""
    from analysis.inputs import generate_world

    check_files(on or "", out, suffix=".npz")
    world, notes = generate_world(on, kind, size, obstacles, ratio, areas, levels, seed, robots)
    world.save(out)
    say([*notes, f"wrote {out}"])
    return DONE


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if any(word == "--no-cache" or word in ("--no-cache=true", "--no-cache=True") for word in words):
        os.environ[NO_CACHE] = "1"
    try:
        check_streams()
        status: Any = app(words, exit_on_error=False, print_error=False, console=output_console())
        return status if isinstance(status, int) else DONE
    except (InputError, CycloptsError) as error:
        line = " ".join(str(error).split())
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
    except pickle.UnpicklingError:
        line = "compiled code in the cache folder is damaged; remove ~/.cache/mrac-jax, or use --no-cache"
    say([f"error: {line}"])
    return BAD_INPUT


def main() -> None:
    """Entry point of the console command."""
    sys.exit(run())


if __name__ == "__main__":
    main()
