"""The command line `mrac-jax`. Heavy imports happen inside the commands, so that `--help` is quick.

Results go to standard output, progress and notes to standard error. Exit status: 0 done; 1 a check failed; 2 bad input
or usage, one line on standard error beginning `error:`; 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, CycloptsError, Group, Parameter

from planner.errors import InputError, UsageError

if TYPE_CHECKING:
    from analysis.evaluate import RolloutChoices
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
)

_TEAM = Group("Team", sort_key=1)
_PLANNING = Group("Planning", sort_key=2)
_ROLLOUTS = Group("Rollouts", sort_key=3)
_OUTPUT = Group("Output", sort_key=4)

Input = Annotated[
    str,
    Parameter(
        name="INPUT",
        help="Scenario .yaml, ROS map .yaml, MovingAI .map, image, world .npz, .npy, .csv, GeoTIFF, or example:NAME "
        "(terrain, building, paper).",
    ),
]


@Parameter(name="*")
@dataclass
class Team:
    """Who drives.

    Attributes:
        robots: How many robots (default: as many as the input's starts, else its count, else 1).
        starts: Where they start, "row,col;row,col;..." (default: the input's starts, else upper-left).
    """

    robots: Annotated[int | None, Parameter(group=_TEAM)] = None
    starts: Annotated[str | None, Parameter(group=_TEAM)] = None


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

    levels: Annotated[int | None, Parameter(group=_PLANNING)] = None
    density: Annotated[float | None, Parameter(group=_PLANNING)] = None
    risk: Annotated[Literal["paper", "log"] | None, Parameter(group=_PLANNING)] = None
    transit: Annotated[Literal["grid", "area"] | None, Parameter(group=_PLANNING)] = None
    max_steps: Annotated[int | None, Parameter(group=_PLANNING)] = None

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
        rollouts: How many (default: 100000).
        precision: Instead of a number: stop when the half-width of the 95 % interval of mean coverage is below this.
        deadline: Report coverage by the end of this step too.
        seed: Of the rollouts; never changes the world or the plan.
        engine: Which engine; the counts are the same.
        threat_checks: Every visit can stop a robot, or only the first visit of a cell by anybody.
    """

    loop: Annotated[Literal["closed", "open"] | None, Parameter(group=_ROLLOUTS)] = None
    mode: Annotated[Literal["fast", "step"] | None, Parameter(group=_ROLLOUTS)] = None
    rollouts: Annotated[int | None, Parameter(group=_ROLLOUTS)] = None
    precision: Annotated[float | None, Parameter(group=_ROLLOUTS)] = None
    deadline: Annotated[int | None, Parameter(group=_ROLLOUTS)] = None
    seed: Annotated[int, Parameter(group=_ROLLOUTS)] = 0
    engine: Annotated[Literal["auto", "jax", "numba"], Parameter(group=_ROLLOUTS)] = "auto"
    threat_checks: Annotated[Literal["every_visit", "first_visit"], Parameter(group=_ROLLOUTS)] = "every_visit"

    def choices(self, foreign: bool) -> RolloutChoices:
        """The same as a plain type, checked; `foreign`: for the plan of another planner, which runs open loop."""
        from analysis.evaluate import RolloutChoices

        if self.rollouts is not None and self.precision is not None:
            raise UsageError("both --rollouts and --precision are given", expected="one of them")
        if foreign and self.loop == "closed":
            raise UsageError(
                "--loop closed needs areas, which the plan of another planner lacks", fix="use --loop open"
            )
        loop = self.loop or ("open" if foreign else "closed")
        if loop == "closed" and self.mode == "fast":
            raise UsageError("--mode fast is for the open loop", fix="leave it out, or use --loop open")
        choices = RolloutChoices(
            loop=loop,
            rollouts=100_000 if self.rollouts is None else self.rollouts,
            precision=self.precision,
            mode=self.mode or "fast",
            engine=self.engine,
            seed=self.seed,
            deadline=self.deadline,
            first_only=self.threat_checks == "first_visit",
        )
        choices.check()
        return choices


_JSON = Annotated[bool, Parameter(group=_OUTPUT, negative="", help="Print one JSON object and nothing else.")]
_CACHE = Annotated[bool, Parameter(group=_OUTPUT, negative="", help="Keep no compiled code on disk.")]


@app.command
def evaluate(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: Planning | None = None,
    what: Rollouts | None = None,
    plan: Annotated[
        Path | None, Parameter(group=_PLANNING, help="Evaluate this plan file instead of planning.")
    ] = None,
    out: Annotated[Path | None, Parameter(group=_OUTPUT, help="Write pictures, plan and JSON to this folder.")] = None,
    as_json: Annotated[_JSON, Parameter(name="--json")] = False,
    no_cache: _CACHE = False,
) -> int:
    """Plan, then estimate how much the team covers: exact values, rollouts, and the paper's bounds."""
    from analysis.evaluate import evaluate as evaluate_plan
    from analysis.inputs import load_or_make_plan
    from analysis.progress import show_progress
    from analysis.report import to_json

    team, planning, what = team or Team(), planning or Planning(), what or Rollouts()
    what.choices(foreign=False)
    _check_folder(out)
    world, made, notes = load_or_make_plan(source, plan, team.robots, team.starts, planning.choices())
    choices = what.choices(made.is_foreign)
    _say(notes)
    with show_progress() as progress:
        answer = evaluate_plan(world, made, choices, progress=progress, band=out is not None)
    if as_json:
        print(json.dumps(to_json(answer), allow_nan=False))  # noqa: T201
    else:
        from rich.console import Console

        from analysis.table import print_evaluation

        print_evaluation(answer, Console(width=None if sys.stdout.isatty() else 110))
    if out is not None:
        from analysis.folder import save_folder

        _say([f"wrote {path}" for path in save_folder(answer, out)])
    return INTERRUPTED if answer.partial else DONE


@app.command(name="plan")
def plan_command(
    source: Input,
    /,
    *,
    team: Team | None = None,
    planning: Planning | None = None,
    out: Annotated[Path | None, Parameter(group=_OUTPUT, help="Write the plan file (JSON) here.")] = None,
    waypoints: Annotated[
        Path | None, Parameter(group=_OUTPUT, help="Write robot, step, x, y, yaw (map frame, metres) here as CSV.")
    ] = None,
    as_json: Annotated[_JSON, Parameter(name="--json", help="Print the plan file's JSON object.")] = False,
    no_cache: _CACHE = False,
) -> int:
    """Plan alone: print what the plan is, and write it as a file or as waypoints to drive."""
    from analysis.inputs import load_or_make_plan
    from planner.waypoints import write_waypoints

    team, planning = team or Team(), planning or Planning()
    for path in (out, waypoints):
        _check_file(path)
    world, made, notes = load_or_make_plan(source, None, team.robots, team.starts, planning.choices())
    _say(notes)
    if out is not None:
        made.save(out)
    if waypoints is not None:
        write_waypoints(made, world, waypoints)
    if as_json:
        print(json.dumps(made.to_json(), allow_nan=False))  # noqa: T201
    else:
        _print_plan(made, world)
    _say([f"wrote {path}" for path in (out, waypoints) if path is not None])
    return DONE


def _print_plan(made: Plan, world: World) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from planner.plan import entries

    console = Console()
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
    out: Annotated[Path, Parameter(name="OUT", help="World file (.npz) to write.")],
    /,
    *,
    on: Annotated[str | None, Parameter(name="--map", help="Put the threats on the free cells of this INPUT.")] = None,
    kind: Literal["contiguous", "scattered"] = "contiguous",
    size: Annotated[str, Parameter(help="HxW in cells.")] = "20x20",
    obstacles: Annotated[float, Parameter(help="Fraction of the cells that are obstacles.")] = 0.25,
    ratio: Annotated[
        float, Parameter(help="Fraction of the cells that are dangerous (--map: of its free cells).")
    ] = 0.25,
    areas: Annotated[int, Parameter(help="Contiguous areas of threats.")] = 10,
    levels: Annotated[str, Parameter(help="Threat levels, in turn.")] = "0.04,0.08,0.12,0.16,0.20",
    seed: Annotated[int, Parameter(help="Of the world.")] = 0,
    robots: Annotated[int | None, Parameter(help="Also store this many starts, upper-left.")] = None,
    no_cache: _CACHE = False,
) -> int:
    """Make one of the paper's random worlds, or put such threats on a map."""
    from analysis.inputs import generate_world

    _check_file(out, ".npz")
    world, notes = generate_world(on, kind, size, obstacles, ratio, areas, levels, seed, robots)
    world.save(out)
    _say([*notes, f"wrote {out}"])
    return DONE


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        print(line, file=sys.stderr)  # noqa: T201


def _check_folder(out: Path | None) -> None:
    """Refuse an output folder that cannot be one before any work is done."""
    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is a file", expected="a folder, new or not")


def _check_file(out: Path | None, suffix: str = "") -> None:
    """Refuse an output file that cannot be written before any work is done."""
    if out is None:
        return
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"{out} cannot be written", expected="a file in a folder that exists")
    if suffix and out.suffix != suffix:
        raise UsageError(f"{out} does not end in {suffix}", expected=f"a {suffix} file")


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if "--no-cache" in words:
        os.environ[NO_CACHE] = "1"
    try:
        status: Any = app(words, exit_on_error=False, print_error=False)
        return status if isinstance(status, int) else DONE
    except (InputError, CycloptsError) as error:
        line = " ".join(str(error).split())
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
        return DONE
    except KeyboardInterrupt:
        _say(["interrupted"])
        return INTERRUPTED
    except MemoryError:
        line = "out of memory; expected a map that fits; coarsen it with cell_size"
    _say([f"error: {line}"])
    return BAD_INPUT


def main() -> None:
    """Entry point of the console command."""
    sys.exit(run())
