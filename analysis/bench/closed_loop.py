"""How fast the closed loop runs: `python -m analysis.bench.closed_loop`. Full tallies, engines side by side in one run.

Repetitions of the engines take turns, so that a busy machine slows all of them alike; medians, with the first call
(compilation) apart. Before anything is timed, the engines' tallies must be equal count for count. Options: `--growth`
adds how the cost grows with cells, robots and lanes; `--jax` leaves the readable simulator out and runs JAX alone where
Numba has nothing to say (a machine with a GPU), with the operations and bytes that its program moves.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from rich.console import Console

from analysis.bench.open_loop import yardstick
from analysis.kit.tables import make_table
from mrac_jax.closed_loop.jax_engine import JaxClosedLoop
from mrac_jax.closed_loop.program import hand_over
from mrac_jax.closed_loop.steps import micro_step
from planner.errors import MracError
from planner.kernels.closed_loop import ClosedLoop, compile_closed_loop, run_range
from planner.mrac.make_plan import make_plan
from planner.mrac.reference import ReferenceLoop
from planner.plans.plan import Plan
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

SIDES, RATIOS = (20, 32, 64), (0.05, 0.25)
KINDS: tuple[Kind, ...] = ("contiguous", "scattered")
ROBOTS, SEED = 8, 1
REPETITIONS = 5
ROLLOUT_SECONDS = 0.8
"""About so long does one repetition of one engine take."""
SLOW = 8.0
"""A repetition that takes so many times as long is the only one."""
CHECKED = 500
GROWTH_SIDES, GROWTH_ROBOTS, GROWTH_LANES = (10, 20, 32, 48, 64, 96), (1, 2, 4, 8, 16, 32, 64), (64, 256, 1024, 4096)


@dataclass(eq=False)
class Contender:
    """One engine on one closed loop: `run(count)` rolls out so many rollouts, with its full tally.

    One that is `slow` to run the least that is worth a call has done so once, and takes no turns.
    """

    name: str
    run: Callable[[int], object]
    count: int = 4
    compile_seconds: float = 0.0
    slow: bool = False
    rates: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Median rollouts a second."""
        return statistics.median(self.rates)


def planned(kind: Kind, side: int, ratio: float, robots: int) -> tuple[World, Plan, ClosedLoop]:
    """A random square world of the paper's kind, its plan and closed loop."""
    world = random_world(side, side, ThreatPattern(kind), threats=ratio)
    plan = make_plan(world, place_starts(world, robots)[0])
    return world, plan, compile_closed_loop(plan, world)


def contenders(world: World, plan: Plan, loop: ClosedLoop, slow: bool) -> list[Contender]:
    """The engines; `slow`: the readable simulator among them."""
    reference, engine = ReferenceLoop(plan, world), JaxClosedLoop(loop, SEED)
    readable = Contender("readable", lambda count: [reference.run(SEED, one) for one in range(count)])
    numba = [numba_contender(loop, threads) for threads in (1, 2)]
    return [*([readable] if slow else []), *numba, jax_contender(engine)]


def numba_contender(loop: ClosedLoop, threads: int) -> Contender:
    """The compiled simulator on so many threads."""
    return Contender(f"Numba, {threads}", lambda count: run_range(loop, SEED, 0, count, threads=threads))


def jax_contender(engine: JaxClosedLoop) -> Contender:
    """The JAX engine, with as many rollouts a call as are worth one."""
    return Contender("JAX", lambda count: engine.run(0, count), count=engine.least)


def race(found: Iterable[Contender], seconds: float = ROLLOUT_SECONDS, repetitions: int = REPETITIONS) -> None:
    """Compile each, find how many rollouts take about so long, then let them take turns."""
    found = list(found)
    for one in found:
        clock = time.perf_counter()
        one.run(1)
        one.compile_seconds, took = time.perf_counter() - clock, 0.0
        while took < seconds / 2:
            one.count = int(one.count * min(seconds / took, 64.0)) if took else one.count
            clock = time.perf_counter()
            one.run(one.count)
            took = time.perf_counter() - clock
        if took > SLOW * seconds:
            one.slow, one.rates = True, [one.count / took]
    for _ in range(repetitions):
        for one in (one for one in found if not one.slow):
            clock = time.perf_counter()
            one.run(one.count)
            one.rates.append(one.count / (time.perf_counter() - clock))


def check_equal(loop: ClosedLoop) -> None:
    """Raise MracError if the engines' tallies differ."""
    if JaxClosedLoop(loop, SEED).tally(0, CHECKED) != run_range(loop, SEED, 0, CHECKED)[0]:
        raise MracError("the engines' tallies differ")


def compare_engines(console: Console, slow: bool) -> None:
    """Rates of every engine on the paper's worlds."""
    columns = ("world", "threats", "moves", "readable", "Numba, 1 thread", "Numba, 2 threads", "JAX", "JAX / Numba, 2")
    title = f"Closed loop, {ROBOTS} robots, full tally, rollouts/s"
    table = make_table((*columns, "JAX compiles, s"), title, left=("world",))
    for side in SIDES:
        for ratio in RATIOS:
            for kind in KINDS:
                world, plan, loop = planned(kind, side, ratio, ROBOTS)
                check_equal(loop)
                found = contenders(world, plan, loop, slow)
                race(found)
                tally, _ = run_range(loop, SEED, 0, 256)
                rates = [f"{one.rate:,.0f}" for one in found]
                table.add_row(
                    f"{side}x{side} {kind}", f"{ratio:.0%}", f"{tally.visits.sum() / 256:,.0f}",
                    *(rates if slow else ["", *rates]), f"{found[-1].rate / found[-2].rate:.2f}",
                    f"{found[-1].compile_seconds:.1f}",
                )  # fmt: skip
    console.print(table)


def grow(console: Console) -> None:
    """How the cost grows with cells, robots and lanes."""
    columns = ("world", "robots", "lanes", "Numba, 2 threads", "JAX", "bytes a lane", "JAX compiles, s")
    table = make_table(columns, "How cost grows (contiguous 25 %, rollouts/s)", left=("world",))
    cases = [(side, ROBOTS, None) for side in GROWTH_SIDES]
    cases += [(20, robots, None) for robots in GROWTH_ROBOTS]
    for side, robots, lanes in cases + [(20, ROBOTS, lanes) for lanes in GROWTH_LANES]:
        _, _, loop = planned("contiguous", side, 0.25, robots)
        engine = JaxClosedLoop(loop, SEED, lanes=lanes)
        found = [numba_contender(loop, 2), jax_contender(engine)]
        race(found, repetitions=3)
        cells = (f"{one.rate:,.0f}" for one in found)
        compiles = f"{found[1].compile_seconds:.1f}"
        table.add_row(f"{side}x{side}", str(robots), str(engine.lanes), *cells, f"{engine.bytes_a_lane:,}", compiles)
    console.print(table)


def floor(console: Console) -> None:
    """Operations and bytes of the JAX program's parts a lane, as XLA counts them, and rounds a rollout."""
    _, _, loop = planned("contiguous", 20, 0.25, ROBOTS)
    engine = JaxClosedLoop(loop, SEED)
    tables, snapshots, lanes, sums, key = jax.device_put(engine.one_device())
    nobody = jnp.zeros(1, dtype=jnp.int32)
    parts = {
        "two actions and a look": lambda lanes, sums: micro_step(tables, lanes, sums, key, engine.pace.look),
        "results and the next rollout": lambda lanes, sums: hand_over(
            tables, snapshots, lanes, sums, nobody.astype(jnp.uint32), nobody, jnp.int32(1), engine.pace.begin
        ),
    }
    table = make_table(
        ("part", "operations a lane", "bytes a lane"),
        f"JAX, 20x20, {ROBOTS} robots, {engine.lanes} lanes",
        left=("part",),
    )
    for name, part in parts.items():
        cost = jax.jit(part).lower(lanes, sums).compile().cost_analysis() or {}
        per_lane = (cost.get("flops", 0.0) / engine.lanes, cost.get("bytes accessed", 0.0) / engine.lanes)
        table.add_row(name, *(f"{value:,.0f}" for value in per_lane))
    console.print(table)
    count = engine.least * 4
    engine.run(0, count)
    before, clock = engine.rounds, time.perf_counter()
    engine.run(0, count)
    rate = count / (time.perf_counter() - clock)
    rounds = (engine.rounds - before) * engine.lanes / count
    console.print(
        f"{rounds:.1f} rounds of a lane a rollout, {engine.pace.micro_steps} micro-steps each; {rate:,.0f} rollouts/s"
    )


def main() -> None:
    """Print the tables."""
    console = Console(width=130)
    console.print(f"devices: {', '.join(str(device) for device in jax.local_devices())}")
    for threads, rate in yardstick():
        console.print(f"yardstick: {rate / 1e6:,.0f} M Threefry blocks/s in Numba on {threads} thread(s)")
    compare_engines(console, slow="--jax" not in sys.argv)
    if "--growth" in sys.argv:
        grow(console)
    floor(console)


if __name__ == "__main__":
    main()
