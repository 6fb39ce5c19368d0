"""How fast the open loop runs: `python -m analysis.bench.open_loop`. Full tallies, all engines side by side in one run.

Repetitions of the engines take turns, so that a busy machine slows all of them alike; medians with the least and the
most; the first call (compilation) apart. Before anything is timed, the engines' tallies must be equal count for count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from analysis.bench.baselines import NumpyOpenLoop, naive_rollouts
from analysis.bench.race import Contender, engine_contender, planned, race
from analysis.kit.tables import make_table
from planner.plans.plan import Plan
from planner.rollouts.engine import Engine, open_loop_engine
from planner.rollouts.open_loop.compiled import CompiledPlan, Mode, compile_plan
from planner.rollouts.open_loop.counts import available_cores
from planner.rollouts.open_loop.engine import OpenLoop
from planner.worlds.generate import Kind
from planner.worlds.world import World

REPETITIONS = 7
CHECKED = 3 * 4096 + 5
"""Rollouts whose tallies are compared first."""
SEED = 1
NAIVE_BATCH = 2048
KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
MODE: Mode = "tolerance"


@dataclass(frozen=True, eq=False)
class Case:
    """A world, its plan, and whether the naive program is timed on it."""

    name: str
    world: World
    plan: Plan
    naive: bool


def cases() -> list[Case]:
    """The worlds of the benchmark, planned by this project's planner."""
    small = [Case(f"20x20 {kind}, 8 robots", *planned(kind, 20), naive=True) for kind in KINDS]
    return [*small, Case("256x256 contiguous, 64 robots", *planned("contiguous", 256, robots=64), naive=False)]


def naive_contender(case: Case, compiled: CompiledPlan) -> Contender:
    """The naive program, batch after batch; `jax.random` is used here and nowhere else."""
    import jax

    paths = [robot.path[: compiled.last_step + 1] for robot in case.plan.robots]
    sums = naive_rollouts(paths, case.world.threat.reshape(-1), NAIVE_BATCH)

    def run(count: int) -> int:
        batches = -(-count // NAIVE_BATCH)
        for batch in range(batches):
            single, _ = jax.block_until_ready(sums(jax.random.key(batch)))
            for values in single:
                np.bincount(np.asarray(values))
        return batches * NAIVE_BATCH

    return Contender("naive vmap(scan), jax.random", lambda: (run, run(1), None))


def contenders(case: Case, compiled: CompiledPlan) -> list[Contender]:
    """All engines of a case; tables are made before, so that compilation is compilation alone."""
    compiled.tables(MODE)
    cores = available_cores()
    made: tuple[tuple[str, Callable[[], Engine]], ...] = (
        (f"NumPy, {cores} threads", lambda: OpenLoop(compiled, SEED, MODE, "numpy", NumpyOpenLoop)),
        ("Numba", lambda: open_loop_engine(compiled, SEED, MODE, "numba")),
        ("JAX", lambda: open_loop_engine(compiled, SEED, MODE, "jax")),
    )
    found = [engine_contender(name, make, CHECKED) for name, make in made]
    if case.naive:
        found.insert(0, naive_contender(case, compiled))
    return found


def report(console: Console, title: str, found: list[Contender]) -> None:
    """One table: rates, and how many times the NumPy engine's and Numba's each is."""
    columns = ("engine", "rollouts/s", "least", "most", "x NumPy", "x Numba", "first call s")
    table = make_table(columns, title, left=("engine",))
    medians = {one.name.split(",")[0]: one.rate for one in found}
    for one in found:
        table.add_row(
            one.name,
            *(f"{rate:,.0f}" for rate in (one.rate, min(one.rates), max(one.rates))),
            *(f"{one.rate / medians[base]:.2f}" for base in ("NumPy", "Numba")),
            f"{one.compile_seconds:.2f}",
        )
    console.print(table)


def main() -> None:
    """Run everything and print the tables."""
    console = Console(width=110)
    for case in cases():
        compiled = compile_plan(case.plan, case.world)
        found = contenders(case, compiled)
        race(found, REPETITIONS)
        report(console, f"{case.name}, full tally ({compiled.tables(MODE).events.count} joint events)", found)


if __name__ == "__main__":
    main()
