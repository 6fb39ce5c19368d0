"""Speed: `python tests/bench.py [ENGINE ...]`, and `... plans [INPUT ...]` for that of planning.

Full tallies, measured side by side.

For both loops of every world: a naive JAX program (open loop), the simulator as Python (closed loop), Numba, and JAX on
its device; with arguments only the named ones. Before timing, the engines' tallies must be equal. Rows are printed as
they are measured: median, least and most.
"""

import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from analysis.utils.tables import make_table
from planner.errors import MracError
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.engine import Engine, closed_loop_engine, open_loop_engine
from planner.rollouts.names import EngineName
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.single_run import PythonLoop
from planner.tally import Tally
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# Timing: repetitions of all engines alternate, so that a busy machine slows all of them equally.

REPETITIONS = 5
SECONDS = 0.25
"""Approximate duration of one repetition; each trial has at most MOST_TIMES as many rollouts as the one before."""
MOST_TIMES = 16
SLOW = 8.0
"""An engine whose repetition takes this many times as long is run once."""

Run = Callable[[int], int]
"""Runs the given number of rollouts, or a few more; returns the number."""


@dataclass(eq=False)
class Contender:
    """One engine on one plan: `make()` returns `run`, the least useful number of rollouts, and a tally to compare."""

    name: str
    make: Callable[[], tuple[Run, int, Tally | None]]
    compile_seconds: float = 0.0
    rates: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Median rollouts per second."""
        return statistics.median(self.rates)


def engine_contender(name: str, make: Callable[[], Engine], checked: int) -> Contender:
    """An engine with full tallies; `checked`: rollouts of the tally to compare."""

    def ready() -> tuple[Run, int, Tally]:
        engine = make()
        return lambda count: engine.tally(0, count).rollouts, engine.least, engine.tally(7, checked)

    return Contender(name, ready)


def race(found: Iterable[Contender]) -> float:
    """Measure the rates: set up each contender, find the number of rollouts for one repetition, then alternate.

    Returns the moves of a rollout, from the first tally. Raises MracError if the tallies differ.
    """
    turns, expected = [], None
    for one in found:
        clock = time.perf_counter()
        run, count, tally = one.make()
        one.compile_seconds = time.perf_counter() - clock
        # Without equal tallies the rates would compare different work.
        expected = expected or tally
        if tally is not None and tally != expected:
            raise MracError(f"{one.name} counts differently")
        while (took := _seconds(run, count)) < SECONDS / 2 and count < 2**26:
            count = int(count * min(max(SECONDS / took, 2.0), MOST_TIMES))
        if took > SLOW * SECONDS:
            one.rates = [count / took]
        else:
            turns.append((one, run, max(1, int(count * min(SECONDS / took, 1.0)))))
    for _ in range(REPETITIONS):
        for one, run, count in turns:
            clock = time.perf_counter()
            done = run(count)
            one.rates.append(done / (time.perf_counter() - clock))
    return 0.0 if expected is None else float(expected.visits.sum()) / expected.rollouts


def _seconds(run: Run, count: int) -> float:
    clock = time.perf_counter()
    run(count)
    return time.perf_counter() - clock


def planned(kind: Kind, side: int, ratio: float, robots: int) -> tuple[World, Plan]:
    """A random square world of the paper's kind, and its plan."""
    world = random_world(side, side, ThreatPattern(kind), threats=ratio)
    return world, make_plan(world, place_starts(world, robots)[0])


def print_row(console: Console, name: str, cells: Iterable[str]) -> None:
    """Print a row of a table."""
    console.print(f"{name:24}{''.join(f'{cell:>19}' for cell in cells)}", soft_wrap=True)


TERRAIN = Path(__file__).parents[1] / "examples" / "terrain.yaml"
CASES: tuple[tuple[int, Kind, float, int], ...] = (
    (20, "contiguous", 0.05, 8), (20, "scattered", 0.05, 8), (20, "contiguous", 0.25, 8), (20, "scattered", 0.25, 8),
    (64, "contiguous", 0.05, 8), (64, "contiguous", 0.25, 8), (256, "contiguous", 0.25, 64),
)  # fmt: skip
"""Side, kind, share of cells with a threat, robots."""
LARGE = 2**14
"""Cells above which only the compiled engines and the open loop are timed."""
LOOPS = ("open", "closed")
SEED, CHECKED, NAIVE_BATCH = 1, 4096 + 5, 2048
ENGINES: tuple[tuple[str, EngineName, int | None], ...] = (
    ("numba, 1 thread", "numba", 1), ("numba", "numba", None), ("jax", "jax", None),
)  # fmt: skip
COLUMNS = ("engine", "rollouts/s", "least", "most", "agent-moves/s", "first call, s")


def cases() -> Iterator[tuple[str, World, Plan]]:
    """The worlds and their plans."""
    for side, kind, ratio, robots in CASES:
        yield f"{side}x{side} {kind}, {ratio:.0%}", *planned(kind, side, ratio, robots)
    terrain = load_input(TERRAIN)
    yield "terrain", terrain, make_plan(terrain, place_starts(terrain, 8)[0])


def contenders(world: World, plan: Plan, loop: str) -> Iterator[Contender]:
    """All contenders on one world."""
    make: Callable[[EngineName, int | None], Engine]
    if loop == "open":
        compiled = compile_plan(plan, world)
        make = lambda engine, threads: open_loop_engine(compiled, SEED, engine, threads)  # noqa: E731
        slow = naive([robot.path[: compiled.last_step + 1] for robot in plan.robots], world.threat.reshape(-1))
    else:
        closed = compile_closed_loop(plan, world)
        make = lambda engine, threads: closed_loop_engine(closed, SEED, engine, threads)  # noqa: E731
        slow = as_python(world, plan)
    if world.threat.size <= LARGE:
        yield slow
    for name, engine, threads in ENGINES:
        yield engine_contender(name, partial(make, engine, threads), CHECKED)


def as_python(world: World, plan: Plan) -> Contender:
    """The simulator as Python."""
    loop = PythonLoop(plan, world)
    return Contender("python", lambda: (lambda count: len([loop.run(SEED, one) for one in range(count)]), 1, None))


def naive(paths: list[NDArray[np.int64]], threat: NDArray[np.float32]) -> Contender:
    """A straightforward JAX program; only this one uses `jax.random`."""
    sums = naive_rollouts(paths, threat, NAIVE_BATCH)

    def run(count: int) -> int:
        batches = -(-count // NAIVE_BATCH)
        for batch in range(batches):
            single, _ = jax.block_until_ready(sums(jax.random.key(batch)))
            for values in single:
                np.bincount(np.asarray(values))
        return batches * NAIVE_BATCH

    return Contender("naive", lambda: (run, run(1), None))


def naive_rollouts(paths: list[NDArray[np.int64]], threat: NDArray[np.float32], batch: int):  # type: ignore[no-untyped-def]
    """A jitted function of a `jax.random` key: the tally's sums over `batch` rollouts by `vmap(scan)`, step by step."""
    steps = max(len(path) for path in paths)
    cell = jnp.array([np.pad(path, (0, steps - len(path)), mode="edge") for path in paths], dtype=jnp.int32).T
    enters = jnp.concatenate([jnp.ones((1, cell.shape[1]), bool), cell[1:] != cell[:-1]])
    chance = jnp.array(threat, dtype=jnp.float32)[cell]

    def rollout(key):  # type: ignore[no-untyped-def]
        def step(state, now):  # type: ignore[no-untyped-def]
            alive, visited, survived, time = state
            cells, entering, threats, number, draw = now
            moves = entering & alive
            stopped = moves & jax.random.bernoulli(draw, threats)
            seen = visited.at[cells].max(moves)
            passed = survived.at[cells].max(moves & ~stopped)
            info = (moves, stopped, seen.sum() - visited.sum(), passed.sum() - survived.sum())
            return (alive & ~stopped, seen, passed, jnp.where(moves.any(), number, time)), info

        nowhere = jnp.zeros(len(threat), dtype=bool)
        start = (jnp.ones(cell.shape[1], dtype=bool), nowhere, nowhere, jnp.int32(0))
        inputs = (cell, enters, chance, jnp.arange(steps, dtype=jnp.int32), jax.random.split(key, steps))
        (alive, visited, survived, time), (moves, stops, *new) = jax.lax.scan(step, start, inputs)
        return (visited.sum(), survived.sum(), time, alive.sum()), (moves, stops, *new, visited, survived)

    def sums(key):  # type: ignore[no-untyped-def]
        single, counted = jax.vmap(rollout)(jax.random.split(key, batch))
        return single, jax.tree.map(lambda leaf: leaf.sum(axis=0, dtype=jnp.int32), counted)

    return jax.jit(sums)


# Planning.

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


def print_plans(inputs: Sequence[str]) -> None:
    """Print the time of planning, without compilation: the paper's kinds at three sizes, and inputs with 16 robots.

    Medians of several plans, so that plans with a compilation do not count; an input is planned once, after them.
    """
    columns = ("world", "robots", "accessible", "areas", "makespan", "seconds")
    table = make_table(columns, "Planning, compilation apart", left=("world",))
    kinds: tuple[Kind, ...] = ("contiguous", "scattered")
    worlds = [
        (random_world(height, width, ThreatPattern(kind, 10 * height * width // 400)), robots, times)
        for height, width, robots, times in SIZES
        for kind in kinds
    ]
    worlds += [(load_input(name), 16, 1) for name in inputs]
    for world, robots, times in worlds:
        seconds, areas, makespan, accessible = timed_plan(world, robots, times)
        row = (world.source, str(robots), str(accessible), str(areas), str(makespan), f"{seconds:.4f}")
        table.add_row(*row)
    console = Console()
    console.print(table)
    console.print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:,.0f} MB")


def main() -> None:
    """Print a line for every world, loop and engine."""
    console, asked = Console(highlight=False), sys.argv[1:]
    if asked[:1] == ["plans"]:
        print_plans(asked[1:])
        return
    console.print(f"JAX on {', '.join(device.device_kind for device in jax.local_devices())}")
    print_row(console, "", COLUMNS)
    for title, world, plan in cases():
        for loop in LOOPS if world.threat.size <= LARGE else LOOPS[:1]:
            found = [one for one in contenders(world, plan, loop) if not asked or one.name.split(",")[0] in asked]
            moves = race(found)
            for one in found:
                rates = (one.rate, min(one.rates), max(one.rates), one.rate * moves)
                figures = (*(f"{rate:,.0f}" if rate else "-" for rate in rates), f"{one.compile_seconds:.1f}")
                print_row(console, title, (f"{loop}, {one.name}", *figures))


if __name__ == "__main__":
    main()
