"""How fast the closed loop runs: `python -m analysis.bench_closed_loop`. Full tallies, compilation and tables apart.

The readable simulator beside the compiled one on one thread and on two, on worlds of the paper's kind.
"""

from __future__ import annotations

import time

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from planner.closed_loop import ClosedLoop, compile_closed_loop, run_range
from planner.generate import Kind, ThreatPattern, random_world
from planner.plan import Plan
from planner.planner import make_plan, prepare
from planner.simulate import simulate
from planner.starts import place_starts
from planner.threefry import uniform
from planner.world import World

SIDES, RATIOS = (20, 32, 64), (0.05, 0.25)
ROBOTS, SEED = 8, 1
KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
COMPILED, READABLE = 8192, 20
REPETITIONS = 3


def compiled_rate(loop: ClosedLoop, threads: int) -> float:
    """Best rollouts a second of a few repetitions."""
    rates = []
    for _ in range(REPETITIONS):
        clock = time.perf_counter()
        run_range(loop, SEED, 0, COMPILED, threads=threads)
        rates.append(COMPILED / (time.perf_counter() - clock))
    return max(rates)


def readable_rate(world: World, plan: Plan) -> float:
    """Rollouts a second of `planner.simulate`."""
    assert plan.settings is not None
    problem, threat = prepare(world, plan.starts, plan.settings), world.threat.ravel()
    clock = time.perf_counter()
    for rollout in range(READABLE):

        def hit(robot: int, step: int, cell: int, rollout: int = rollout) -> bool:
            return bool(threat[cell] > 0 and uniform(SEED, rollout, step, robot) < threat[cell])

        simulate(world.shape, problem.paths, plan.areas, problem.starts, max_steps=problem.max_steps, hit=hit)
    return READABLE / (time.perf_counter() - clock)


def main() -> None:
    """Print the table."""
    table = Table(title=f"Closed loop, {ROBOTS} robots, rollouts/s", box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("world", "threats", "moves", "readable", "compiled", "compiled, 2 threads"):
        table.add_column(column, justify="left" if column == "world" else "right")
    for side in SIDES:
        for ratio in RATIOS:
            for kind in KINDS:
                world = random_world(side, side, ThreatPattern(kind), threats=ratio)
                plan = make_plan(world, place_starts(world, ROBOTS)[0])
                loop = compile_closed_loop(plan, world)
                tally, _ = run_range(loop, SEED, 0, 64)
                one, two = (compiled_rate(loop, threads) for threads in (1, 2))
                moves = int(np.sum(tally.visits)) / tally.rollouts
                row = (f"{moves:.0f}", f"{readable_rate(world, plan):,.0f}", f"{one:,.0f}", f"{two:,.0f}")
                table.add_row(f"{side}x{side} {kind}", f"{ratio:.0%}", *row)
    Console().print(table)


if __name__ == "__main__":
    main()
