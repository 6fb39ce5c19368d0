"""What `mrac-jax plan` prints of a plan: it in a line, and a row for each robot."""

from __future__ import annotations

from rich.console import Console

from analysis.kit.tables import make_table
from analysis.kit.words import bearing_words, plan_words, span_words
from analysis.theory.exact import open_loop_exact
from planner.plans.plan import Plan
from planner.plans.turns import drive_of
from planner.shown import counted, in_percent
from planner.worlds.world import World


def print_plan(made: Plan, world: World, console: Console) -> None:
    """Print it; what a robot survives is its nominal path."""
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
