"""The closed loop under one contract, (plan, seed, rollout ids) -> tally, results, traces, for both engines."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Protocol

from mrac_jax.blocks import BLOCK, check_range, run_ranges
from mrac_jax.open_loop.batch import ENGINES, Chunk, Engine, choose_engine
from planner.errors import UsageError
from planner.kernels import closed_loop
from planner.kernels.closed_loop import ClosedLoop
from planner.tally import RolloutResults, Tally
from planner.trace import Trace


class ClosedLoopEngine(Protocol):
    """An engine bound to one closed loop and seed. A rollout is a function of those and its id alone."""

    name: str
    least: int
    """Rollouts that are worth a call; whole blocks where a rollout takes less than a block's time."""

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        ...

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        ...

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """Both of them, in one pass."""
        ...

    def traces(self, rollouts: Iterable[int]) -> list[Trace]:
        """Those rollouts in full, in the order given."""
        ...


class NumbaClosedLoop:
    """The compiled classical simulator (`planner.kernels.closed_loop`) as an engine."""

    name = "numba"

    def __init__(self, loop: ClosedLoop, seed: int, *, threads: int | None = None) -> None:
        """`threads`: None for all cores; no count depends on it."""
        self.loop, self.seed, self._threads = loop, seed, threads
        self.least = BLOCK if loop.tabled else 1

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads)[0]

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        return self.run(start, count)[1]

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the single results of those rollouts: one pass gives both."""
        tally, results = closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads, singles=True)
        assert results is not None
        return tally, results

    def traces(self, rollouts: Iterable[int]) -> list[Trace]:
        """Those rollouts in full, in the order given."""
        return closed_loop.trace_rollouts(self.loop, self.seed, rollouts)


def make_closed_loop_engine(loop: ClosedLoop, seed: int, engine: Engine = "auto") -> ClosedLoopEngine:
    """The engine for this closed loop. JAX is imported only for `engine="jax"`; "auto": see `choose_engine`.

    Raises UsageError for an engine or seed that is none, InputError for a world that JAX's lanes have no room for.
    """
    if engine not in ENGINES:
        raise UsageError(f"engine is {engine!r}", expected=" or ".join(ENGINES))
    check_range(0, 0, None, seed)
    if choose_engine(engine) == "jax":
        from mrac_jax.closed_loop.jax_engine import JaxClosedLoop

        return JaxClosedLoop(loop, seed)
    return NumbaClosedLoop(loop, seed)


def run_closed_chunks(
    loop: ClosedLoop,
    *,
    seed: int,
    count: int,
    start: int = 0,
    engine: Engine = "auto",
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    results: bool = False,
) -> Iterator[Chunk]:
    """Roll out ids `start .. start + count - 1`; after every chunk, where the run stands.

    The arguments are those of `mrac_jax.open_loop.batch.run_chunks`. Where distances are searched for on demand a
    rollout may
    take a second: there a chunk may be less than a block.
    """
    check_range(start, count, chunk, seed)
    clock = time.perf_counter()
    runner = make_closed_loop_engine(loop, seed, engine)
    runner.tally(start, min(count, 1))
    compile_seconds = time.perf_counter() - clock
    tally, seconds = loop.empty_tally(seed), 0.0
    work = runner.run if results else lambda start, count: (runner.tally(start, count), None)
    ranges = run_ranges(work, start, count, chunk=chunk, checkpoints=checkpoints, unit=runner.least)
    for _, _, (part, singles), took in ranges:
        tally, seconds = tally + part, seconds + took
        yield Chunk(tally, singles, runner.name, seconds, compile_seconds)
