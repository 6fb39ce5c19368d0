"""What the commands say while they work, each of what it counts; how that is shown: `analysis.utils.progress`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from analysis.inputs import Asked
    from analysis.utils.progress import Watch
    from planner.plan.plan import Plan
    from planner.world.world import World
    from planner.settings import Policy


@contextmanager
def show_pool_progress(things: str, policies: Iterable[Policy]) -> Iterator[Watch]:
    """What processes do that roll out by these policies; `things`: what is counted."""
    from analysis.utils.progress import compiling_elsewhere, show_progress

    with compiling_elsewhere(policies), show_progress(things) as watch:
        yield watch


def load_or_make_plan(
    asked: Asked, plan_file: Path | None = None, state: Path | None = None, **how: Any
) -> tuple[World, Plan, tuple[str, ...]]:
    """`analysis.inputs.load_or_make_plan`, watched."""
    from analysis.estimators.racing import plan_best
    from analysis.inputs import load_or_make_plan as load
    from analysis.utils.progress import show_progress

    with show_progress() as watch:
        watch.doing("the map")
        return load(asked, plan_file, state, find_best=plan_best, doing=watch.doing, **how)


# What `mrac-jax plan` prints of a plan: it in a line, and a row for each robot.


def print_plan(made: Plan, world: World, console: Console) -> None:
    """Print it; what a robot survives is its nominal path."""
    from analysis.theory.exact import open_loop_exact
    from analysis.utils.tables import bearing_words, make_table, plan_words, span_words
    from planner.formatting import counted, in_percent
    from planner.plan.plan import drive_of

    said = made.origin
    if not made.is_foreign:
        said = plan_words(made)
    lost = 0 if made.state is None else made.state.lost
    team = f"{counted(len(made.robots), 'robot')}{f' ({lost} lost before)' if lost else ''}"
    console.print(f"{team}, {said}, {span_words(made, world.pace)}", highlight=False)
    if made.settings is not None and made.settings.deadline is not None:
        console.print(
            f"The mission ends at {world.pace.step(made.settings.deadline)}, whatever is left.", highlight=False
        )
    if means := bearing_words(made, world):
        console.print(f"Robots: {means}.", highlight=False)
    drive = drive_of(robot.path for robot in made.robots)
    table = make_table(("robot", "start", "moves", "quarter turns", "areas covered", "survives its path, %"))
    for number, (robot, chance) in enumerate(zip(made.robots, open_loop_exact(made, world).survival, strict=True)):
        start = divmod(int(robot.path[0]), made.shape[1])
        covered = "" if made.is_foreign else str(sum(leg.kind == "cover" for leg in robot.legs))
        survival = in_percent(chance, 2)
        table.add_row(
            str(number), str(list(start)), str(drive.moves[number]), str(drive.turns[number]), covered, survival
        )
    console.print(table)
