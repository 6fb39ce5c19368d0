"""A map of a million cells: `python -m analysis.bench.large [ROLLOUTS]`, compilation apart.

A generated 1000x1000 with 5 % of threats, 16 robots: seconds for the plan, then, if asked for, a closed-loop rollout
on one thread; elapsed and CPU seconds (elapsed ones count what else the machine does), and the memory at most.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from typing import TypeVar

from rich.console import Console

from planner.kernels.closed_loop import compile_closed_loop, run_range
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.worlds.generate import ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

SIDE, ROBOTS = 1000, 16
CONSOLE = Console(highlight=False)
Made = TypeVar("Made")


def timed(what: str, work: Callable[[], Made]) -> Made:
    """Do the work and print how long it took, and the most memory that the process has had so far."""
    clock, cpu = time.perf_counter(), time.process_time()
    made = work()
    elapsed, cpu = time.perf_counter() - clock, time.process_time() - cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    CONSOLE.print(f"{what}: {elapsed:,.1f} s, {cpu:,.1f} s of CPU; memory at most {memory:.2f} GB")
    return made


def planned(side: int) -> tuple[World, Plan]:
    """The map of this side, and its plan."""
    pattern = ThreatPattern(seed=1)
    world = timed(f"map of {side}x{side}", lambda: random_world(side, side, pattern, threats=0.05, obstacles=0.1))
    starts, _ = place_starts(world, ROBOTS)
    return world, timed(f"plan of {side}x{side}", lambda: make_plan(world, starts))


def main() -> None:
    """Plan, and roll out as often as the command line says."""
    world, plan = planned(100)
    run_range(compile_closed_loop(plan, world, tabled=False), 0, 0, 1, threads=1)
    world, plan = planned(SIDE)
    CONSOLE.print(f"{int(world.accessible(plan.starts).sum()):,} accessible cells, makespan {plan.makespan:,}")
    if rollouts := int(sys.argv[1]) if len(sys.argv) > 1 else 0:
        loop = timed("tables", lambda: compile_closed_loop(plan, world))
        timed(f"{rollouts} rollouts", lambda: run_range(loop, 0, 0, rollouts, threads=1))


if __name__ == "__main__":
    main()
