"""How the benchmarks time engines: repetitions take turns, so that a busy machine slows all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from rich.console import Console

from planner.errors import MracError
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.rollouts.engine import Engine
from planner.tally import Tally
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

REPETITIONS = 5
SECONDS = 0.25
"""About so long does one repetition of one engine take, at most MOST_TIMES as many rollouts as the one before."""
MOST_TIMES = 16
SLOW = 8.0
"""A repetition that takes so many times as long is the only one."""

Run = Callable[[int], int]
"""Rolls out so many rollouts, or a few more; returns how many."""


@dataclass(eq=False)
class Contender:
    """One engine on one plan: `make()` sets it up: `run`, how many rollouts are worth a call, the tally of a few."""

    name: str
    make: Callable[[], tuple[Run, int, Tally | None]]
    compile_seconds: float = 0.0
    rates: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Median rollouts a second."""
        return statistics.median(self.rates)


def engine_contender(name: str, make: Callable[[], Engine], checked: int) -> Contender:
    """An engine that makes full tallies, `checked`: first that of so many rollouts."""

    def ready() -> tuple[Run, int, Tally]:
        engine = make()
        return lambda count: engine.tally(0, count).rollouts, engine.least, engine.tally(7, checked)

    return Contender(name, ready)


def race(found: Iterable[Contender]) -> float:
    """Fill in the rates: set each up, find how many rollouts take about so long, then let them take turns.

    Returns the moves of a rollout, by their first tallies. Raises MracError if these differ.
    """
    turns, expected = [], None
    for one in found:
        clock = time.perf_counter()
        run, count, tally = one.make()
        one.compile_seconds = time.perf_counter() - clock
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
    """A row of a table that is printed while it is made."""
    console.print(f"{name:24}{''.join(f'{cell:>19}' for cell in cells)}", soft_wrap=True)
