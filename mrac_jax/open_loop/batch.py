"""Runs rollout ids in chunks of whole aligned blocks, in constant memory, and adds up tallies.

The result is a pure function of (plan, seed, ids, mode): chunk size, engine, threads and devices cannot change it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from mrac_jax.blocks import check_range, run_ranges
from mrac_jax.open_loop.compiled import MODES, CompiledPlan, Mode
from mrac_jax.open_loop.counts import OpenLoopEngine, tally_of
from planner.errors import UsageError
from planner.tally import RolloutResults, Tally, tally_key

Engine = Literal["auto", "jax", "numba"]
ENGINES: tuple[Engine, ...] = ("auto", "jax", "numba")
Progress = Callable[[int, int, float], None]
"""Called after every chunk with (rollouts done, rollouts asked for, seconds of running, compilation left out)."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Where a run stands after a chunk.

    Attributes:
        tally: everything so far.
        results: this chunk's single rollouts if they were asked for, else None.
        engine: "jax" or "numba".
        seconds: running so far; compile_seconds: first call, compilation included, apart from that.
    """

    tally: Tally
    results: RolloutResults | None
    engine: str
    seconds: float
    compile_seconds: float

    @property
    def rollouts_per_second(self) -> float:
        """Rate so far, compilation left out."""
        return self.tally.rollouts / self.seconds if self.seconds > 0 else 0.0


def empty_tally(compiled: CompiledPlan, mode: Mode, seed: int) -> Tally:
    """The tally of no rollouts of this plan."""
    key = tally_key(compiled.identity, "open", mode, seed)
    return Tally.empty(key, compiled.shape, compiled.robots, compiled.accessible, compiled.last_step)


def make_engine(compiled: CompiledPlan, *, seed: int, mode: Mode = "fast", engine: Engine = "auto") -> OpenLoopEngine:
    """The engine for this plan. JAX is imported only for `engine="jax"`; see `choose_engine` for "auto"."""
    if mode not in MODES:
        raise UsageError(f"mode is {mode!r}", expected=" or ".join(MODES))
    if engine not in ENGINES:
        raise UsageError(f"engine is {engine!r}", expected=" or ".join(ENGINES))
    check_range(0, 0, None, seed)
    if choose_engine(engine) == "jax":
        from mrac_jax.open_loop.jax_engine import JaxOpenLoop

        return JaxOpenLoop(compiled, seed, mode)
    from mrac_jax.open_loop.numba_engine import NumbaOpenLoop

    return NumbaOpenLoop(compiled, seed, mode)


def choose_engine(engine: Engine) -> Literal["jax", "numba"]:
    """The engine that is used: "auto" is Numba, measured the faster one on CPUs (`python -m analysis.bench.open_loop`).

    Ask for "jax" where it has a GPU: finding that out would mean importing it, a second before anything runs.
    """
    return "jax" if engine == "jax" else "numba"


def run_chunks(
    compiled: CompiledPlan,
    *,
    seed: int,
    count: int,
    start: int = 0,
    mode: Mode = "fast",
    engine: Engine = "auto",
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    results: bool = False,
) -> Iterator[Chunk]:
    """Roll out ids `start .. start + count - 1`; after every chunk, where the run stands.

    Whoever stops iterating (or is interrupted) loses at most the chunk in flight.

    Args:
        compiled: the plan.
        seed: 0 <= seed < 2**64.
        count, start: the ids; at most 2**32.
        mode: "fast" (one draw a robot) or "step" (one draw a dangerous entry).
        engine: "jax", "numba" or "auto".
        chunk: rollouts a chunk, rounded up to blocks; None = about half a second's worth. No count depends on it.
        checkpoints: numbers of rollouts (counted from `start`) at which a chunk must end, for stopping rules.
        results: also hand over every single rollout.

    Raises:
        UsageError: a mode, engine, seed, range or chunk that is none.
    """
    check_range(start, count, chunk, seed)
    clock = time.perf_counter()
    runner = make_engine(compiled, seed=seed, mode=mode, engine=engine)
    runner.counts(start, min(count, 1))
    compile_seconds = time.perf_counter() - clock
    tally, seconds = empty_tally(compiled, mode, seed), 0.0
    for begin, size, counts, took in run_ranges(runner.counts, start, count, chunk=chunk, checkpoints=checkpoints):
        tally, seconds = tally + tally_of(compiled, mode, seed, begin, counts), seconds + took
        singles = runner.results(begin, size) if results else None
        yield Chunk(tally, singles, runner.name, seconds, compile_seconds)


def rollouts(
    compiled: CompiledPlan,
    *,
    seed: int,
    count: int,
    start: int = 0,
    mode: Mode = "fast",
    engine: Engine = "auto",
    chunk: int | None = None,
    progress: Progress | None = None,
) -> Tally:
    """The tally of rollouts `start .. start + count - 1`; the arguments are those of `run_chunks`."""
    tally = empty_tally(compiled, mode, seed)
    for done in run_chunks(compiled, seed=seed, count=count, start=start, mode=mode, engine=engine, chunk=chunk):
        tally = done.tally
        if progress is not None:
            progress(tally.rollouts, count, done.seconds)
    return tally


def rollout_results(
    compiled: CompiledPlan,
    *,
    seed: int,
    count: int,
    start: int = 0,
    mode: Mode = "fast",
    engine: Engine = "auto",
) -> RolloutResults:
    """Every single rollout `start .. start + count - 1`."""
    return make_engine(compiled, seed=seed, mode=mode, engine=engine).results(start, count)
