"""How fast the open loop runs: `python -m analysis.bench.open_loop`. Full tallies, all engines side by side in one run.

Repetitions of the engines take turns, so that a busy machine slows all of them alike; medians with the least and the
most; the first call (compilation) apart. Before anything is timed, the engines' tallies must be equal count for count.
Options: `--skip-large` leaves out the 256x256 world with 64 robots (its plan is kept in the cache folder).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from analysis.bench.baselines import NumpyOpenLoop, naive_rollouts
from analysis.bench.race import Contender, engine_contender, print_yardstick, race
from analysis.kit.tables import make_table
from planner.errors import MracError
from planner.jit import cache_folder
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.plan_file import load_plan
from planner.rollouts.engine import Engine, open_loop_engine
from planner.rollouts.open_loop.compiled import CompiledPlan, Mode, compile_plan
from planner.rollouts.open_loop.counts import available_cores
from planner.rollouts.open_loop.engine import OpenLoop
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

REPETITIONS = 7
CHECKED = 3 * 4096 + 5
"""Rollouts whose tallies are compared first."""
SEED = 1
NAIVE_BATCH = 2048


@dataclass(frozen=True, eq=False)
class Case:
    """A world, its plan, and the modes that are timed on it."""

    name: str
    world: World
    plan: Plan
    modes: tuple[Mode, ...]
    naive: bool


def cases(large: bool) -> list[Case]:
    """The worlds of the benchmark, planned by this project's planner."""
    found = []
    for kind in ("contiguous", "scattered"):
        world, plan = planned(kind, 20, 8)
        found.append(Case(f"20x20 {kind}, 8 robots", world, plan, ("fast", "step"), naive=True))
    if large:
        world, plan = planned("contiguous", 256, 64)
        found.append(Case("256x256 contiguous, 64 robots", world, plan, ("fast", "step"), naive=False))
    return found


def planned(kind: Kind, size: int, robots: int) -> tuple[World, Plan]:
    """A random square world and its plan, from the cache folder if it was made before."""
    world = random_world(size, size, ThreatPattern(kind=kind))
    folder = cache_folder("bench")
    file = None if folder is None else folder / f"{kind}-{size}-{robots}-{world.sha256[:12]}.json"
    if file is not None and file.is_file():
        try:
            return world, load_plan(file, world)
        except MracError:
            pass  # kept by an older version: make it anew
    plan = make_plan(world, place_starts(world, robots)[0])
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        plan.save(file)
    return world, plan


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


def contenders(case: Case, compiled: CompiledPlan, mode: Mode) -> list[Contender]:
    """All engines of a case; tables are made before, so that compilation is compilation alone."""
    compiled.tables(mode)
    cores = available_cores()
    made: tuple[tuple[str, Callable[[], Engine]], ...] = (
        (f"NumPy, {cores} threads", lambda: OpenLoop(compiled, SEED, mode, "numpy", NumpyOpenLoop)),
        ("Numba", lambda: open_loop_engine(compiled, SEED, mode, "numba")),
        ("JAX", lambda: open_loop_engine(compiled, SEED, mode, "jax")),
    )
    found = [engine_contender(name, make, CHECKED) for name, make in made]
    if case.naive and mode == "step":
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
    print_yardstick(console)
    for case in cases(large="--skip-large" not in sys.argv):
        compiled = compile_plan(case.plan, case.world)
        for mode in case.modes:
            found = contenders(case, compiled, mode)
            race(found, REPETITIONS)
            events = compiled.tables(mode).events.count
            report(console, f"{case.name}, {mode} mode, full tally ({events} joint events)", found)


if __name__ == "__main__":
    main()
