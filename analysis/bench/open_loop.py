"""How fast the open loop runs: `python -m analysis.bench.open_loop`. Full tallies, all engines side by side in one run.

Repetitions of the engines take turns, so that a busy machine slows all of them alike; medians with the least and the
most; the first call (compilation) apart. Before anything is timed, the engines' tallies must be equal count for count.
Options: `--skip-large` leaves out the 256x256 world with 64 robots (its plan is kept in the cache folder).
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console

from analysis.bench.baselines import NumpyOpenLoop, naive_rollouts
from analysis.kit.tables import make_table
from mrac_jax.engine import Engine, open_loop_engine
from mrac_jax.names import EngineName
from mrac_jax.open_loop.compiled import CompiledPlan, Mode, compile_plan
from mrac_jax.open_loop.counts import available_cores
from mrac_jax.open_loop.engine import OpenLoop
from planner.errors import MracError
from planner.jit import cache_folder
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.plan_file import load_plan
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

REPETITIONS = 7
ROLLOUT_SECONDS = 0.25
"""About so long does one repetition of one engine take."""
CHECKED = 3 * 4096 + 5
"""Rollouts whose tallies are compared first."""
SEED = 1
NAIVE_BATCH = 2048


@dataclass(eq=False)
class Contender:
    """One engine on one plan: `run(count)` rolls out and returns how many rollouts that were."""

    name: str
    run: Callable[[int], int]
    compile_seconds: float = 0.0
    count: int = 0
    rates: list[float] = field(default_factory=list)


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


def engine_contender(name: str, make: Callable[[], Engine]) -> Contender:
    """An engine that makes full tallies; its first call is timed apart."""
    clock = time.perf_counter()
    engine = make()
    engine.tally(0, 1)
    compile_seconds = time.perf_counter() - clock
    return Contender(name, lambda count: engine.tally(0, count).rollouts, compile_seconds)


def naive_contender(case: Case, compiled: CompiledPlan) -> Contender:
    """The naive program, batch after batch; `jax.random` is used here and nowhere else."""
    import jax

    paths = [robot.path[: compiled.last_step + 1] for robot in case.plan.robots]
    sums = naive_rollouts(paths, case.world.threat.reshape(-1), NAIVE_BATCH)
    clock = time.perf_counter()
    jax.block_until_ready(sums(jax.random.key(0)))
    compile_seconds = time.perf_counter() - clock

    def run(count: int) -> int:
        batches = -(-count // NAIVE_BATCH)
        for batch in range(batches):
            single, _ = jax.block_until_ready(sums(jax.random.key(batch)))
            for values in single:
                np.bincount(np.asarray(values))
        return batches * NAIVE_BATCH

    return Contender("naive vmap(scan), jax.random", run, compile_seconds)


def contenders(case: Case, compiled: CompiledPlan, mode: Mode) -> list[Contender]:
    """All engines of a case; tables are made before, so that compilation is compilation alone."""
    compiled.tables(mode)
    cores = available_cores()
    found = [
        engine_contender(f"NumPy, {cores} threads", lambda: OpenLoop(compiled, SEED, mode, "numpy", NumpyOpenLoop)),
        engine_contender("Numba", lambda: open_loop_engine(compiled, SEED, mode, "numba")),
        engine_contender("JAX", lambda: open_loop_engine(compiled, SEED, mode, "jax")),
    ]
    if case.naive and mode == "step":
        found.insert(0, naive_contender(case, compiled))
    return found


def check_equal(compiled: CompiledPlan, mode: Mode) -> None:
    """Raises MracError unless all engines count the same."""
    expected = OpenLoop(compiled, SEED, mode, "numpy", NumpyOpenLoop).tally(7, CHECKED)
    names: tuple[EngineName, ...] = ("numba", "jax")
    for name in names:
        if open_loop_engine(compiled, SEED, mode, name).tally(7, CHECKED) != expected:
            raise MracError(f"{name} and NumPy count differently")


def race(found: list[Contender]) -> None:
    """Fills in the rates, rollouts a second: the contenders take turns."""
    for one in found:
        one.count, took = 256, 0.0
        while took < ROLLOUT_SECONDS / 4 and one.count < 2**26:
            one.count *= 4
            clock = time.perf_counter()
            one.run(one.count)
            took = time.perf_counter() - clock
        one.count = max(1, int(one.count * ROLLOUT_SECONDS / took))
    for _ in range(REPETITIONS):
        for one in found:
            clock = time.perf_counter()
            done = one.run(one.count)
            one.rates.append(done / (time.perf_counter() - clock))


def yardstick() -> list[tuple[int, float]]:
    """(threads, blocks of Threefry a second) of the Numba generator alone."""
    from mrac_jax.open_loop.numba_draws import random_words

    tile, rounds = 1024, 10_000
    rates = []
    for threads in sorted({1, available_cores()}):
        room = [np.empty(tile, dtype=np.uint32) for _ in range(threads)]

        def work(words: np.ndarray) -> None:
            for first in range(0, rounds * tile, 100 * tile):
                random_words(np.uint32(1), np.uint32(0), np.uint32(first), np.uint32(100), np.uint32(7), words)

        work(room[0])
        best = 0.0
        for _ in range(REPETITIONS):
            with ThreadPoolExecutor(threads) as pool:
                clock = time.perf_counter()
                list(pool.map(work, room))
                best = max(best, threads * rounds * tile / (time.perf_counter() - clock))
        rates.append((threads, best))
    return rates


def report(console: Console, title: str, found: list[Contender]) -> None:
    """One table: rates, and how many times the NumPy engine's and Numba's each is."""
    columns = ("engine", "rollouts/s", "least", "most", "x NumPy", "x Numba", "first call s")
    table = make_table(columns, title, left=("engine",))
    medians = {one.name.split(",")[0]: statistics.median(one.rates) for one in found}
    for one in found:
        median = statistics.median(one.rates)
        table.add_row(
            one.name,
            *(f"{rate:,.0f}" for rate in (median, min(one.rates), max(one.rates))),
            *(f"{median / medians[base]:.2f}" for base in ("NumPy", "Numba")),
            f"{one.compile_seconds:.2f}",
        )
    console.print(table)


def main() -> None:
    """Run everything and print the tables."""
    console = Console(width=110)
    for threads, rate in yardstick():
        console.print(f"yardstick: {rate / 1e6:,.0f} M Threefry blocks/s in Numba on {threads} thread(s)")
    for case in cases(large="--skip-large" not in sys.argv):
        compiled = compile_plan(case.plan, case.world)
        for mode in case.modes:
            found = contenders(case, compiled, mode)
            check_equal(compiled, mode)
            race(found)
            events = compiled.tables(mode).events.count
            report(console, f"{case.name}, {mode} mode, full tally ({events} joint events)", found)


if __name__ == "__main__":
    main()
