"""How fast the closed loop runs: `python -m analysis.bench.closed_loop`. Full tallies, engines side by side in one run.

Before anything is timed, the engines' tallies must be equal count for count. A row is printed as soon as it is there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rich.console import Console

from analysis.bench.race import Contender, engine_contender, planned, print_row, race
from planner.kernels.closed_loop import compile_closed_loop
from planner.kernels.loop import ClosedLoop
from planner.mrac.reference import ReferenceLoop
from planner.plans.plan import Plan
from planner.rollouts.engine import Engine, closed_loop_engine
from planner.rollouts.numba_closed_loop import NumbaClosedLoop
from planner.worlds.generate import Kind
from planner.worlds.world import World

CASES: tuple[tuple[int, Kind, float], ...] = (
    (20, "contiguous", 0.05), (20, "scattered", 0.05), (20, "contiguous", 0.25), (20, "scattered", 0.25),
    (64, "contiguous", 0.05), (64, "contiguous", 0.25),
)  # fmt: skip
SEED, REPETITIONS = 1, 3
CHECKED = 256
COLUMNS = ("threats", "moves", "readable", "Numba, 1", "Numba, 2", "JAX", "its first call, s")


def readable(world: World, plan: Plan) -> Contender:
    """The readable simulator."""
    loop = ReferenceLoop(plan, world)
    return Contender("readable", lambda: (lambda count: len([loop.run(SEED, one) for one in range(count)]), 1, None))


def engines(loop: ClosedLoop) -> list[Contender]:
    """The compiled ones."""
    one, two = (partial(NumbaClosedLoop, loop, SEED, threads=threads) for threads in (1, 2))
    made: tuple[tuple[str, Callable[[], Engine]], ...] = (
        ("Numba, 1", one), ("Numba, 2", two), ("JAX", lambda: closed_loop_engine(loop, SEED, "jax")),
    )  # fmt: skip
    return [engine_contender(name, make, CHECKED) for name, make in made]


def main() -> None:
    """Print the table, row by row."""
    console = Console(highlight=False)
    console.print("Closed loop, 8 robots, full tally, rollouts/s; Numba on 1 thread and 2")
    print_row(console, "", COLUMNS)
    for side, kind, ratio in CASES:
        world, plan = planned(kind, side, ratio)
        loop = compile_closed_loop(plan, world, luck="tolerance")
        found = [readable(world, plan), *engines(loop)]
        race(found, REPETITIONS)
        tally = NumbaClosedLoop(loop, SEED).tally(0, CHECKED)
        cells = [f"{ratio:.0%}", f"{tally.visits.sum() / CHECKED:,.0f}", *(f"{one.rate:,.0f}" for one in found)]
        print_row(console, f"{side}x{side} {kind}", [*cells, f"{found[-1].compile_seconds:.1f}"])


if __name__ == "__main__":
    main()
