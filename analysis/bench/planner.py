"""Time of planning without compilation: `python -m analysis.bench.planner [INPUT ...]`.

Worlds of the paper's kinds at three sizes, contiguous and scattered, and every INPUT with 16 robots. Medians of several
plans, so that plans with a compilation do not count; an INPUT is planned once, after them.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time

from rich.console import Console

from analysis.utils.tables import make_table
from planner.make_plan import make_plan
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

SIZES = ((20, 20, 8, 9), (64, 64, 8, 5), (256, 256, 16, 3))
"""(H, W, robots, repetitions)."""


def timed_plan(world: World, robots: int, repetitions: int) -> tuple[float, int, int, int]:
    """(median seconds, areas, makespan, accessible cells) of planning this world."""
    starts, _ = place_starts(world, robots)
    took = []
    for _ in range(repetitions):
        clock = time.perf_counter()
        plan = make_plan(world, starts)
        took.append(time.perf_counter() - clock)
    return statistics.median(took), len(plan.areas), plan.makespan, int(world.accessible(starts).sum())


def main() -> None:
    """Print the table."""
    columns = ("world", "robots", "accessible", "areas", "makespan", "seconds")
    table = make_table(columns, "Planning, compilation apart", left=("world",))
    kinds: tuple[Kind, ...] = ("contiguous", "scattered")
    worlds = [
        (random_world(height, width, ThreatPattern(kind, 10 * height * width // 400)), robots, times)
        for height, width, robots, times in SIZES
        for kind in kinds
    ]
    worlds += [(load_input(name), 16, 1) for name in sys.argv[1:]]
    for world, robots, times in worlds:
        seconds, areas, makespan, accessible = timed_plan(world, robots, times)
        row = (world.source, str(robots), str(accessible), str(areas), str(makespan), f"{seconds:.4f}")
        table.add_row(*row)
    console = Console()
    console.print(table)
    console.print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:,.0f} MB")


if __name__ == "__main__":
    main()
