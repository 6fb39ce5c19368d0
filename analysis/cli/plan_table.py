"""What `mrac-jax plan` prints of a plan: it in a line, and a row for each robot."""

from __future__ import annotations

from rich.console import Console

from analysis.kit.tables import make_table
from analysis.theory.exact import robot_chances
from planner.plans.plan import Plan, entries
from planner.worlds.world import World


def print_plan(made: Plan, world: World, console: Console) -> None:
    """Print it; what a robot survives is its nominal path."""
    console.print(
        f"{len(made.robots)} robots, {len(made.areas)} areas, nominal run {made.outcome}, makespan {made.makespan} "
        f"steps, {made.shares} areas shared",
        highlight=False,
    )
    table = make_table(("robot", "start", "moves", "areas covered", "survives its path, %"))
    for number, robot in enumerate(made.robots):
        start = divmod(int(robot.path[0]), made.shape[1])
        covered = sum(leg.kind == "cover" for leg in robot.legs)
        moves, survival = len(entries(robot.path)) - 1, robot_chances(robot, world).survival
        table.add_row(str(number), str(list(start)), str(moves), str(covered), f"{100 * survival:.2f}")
    console.print(table)
