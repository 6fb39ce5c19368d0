"""Rolling out: an `Engine` for a plan, its world, a loop and a seed; and plans without losses."""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from planner.arguments import BLOCK, MOST_ROLLOUTS
from planner.errors import UsageError, WorldError
from planner.plan.plan import Plan, is_certain
from planner.rollouts import closed_loop
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.names import ENGINES, EngineName, check_jax, of_jax
from planner.rollouts.open_loop import CompiledPlan, MakeKernel, compile_plan, tally_of
from planner.rollouts.open_loop_events import open_loop_trace
from planner.rollouts.open_loop_numba import NumbaOpenLoop
from planner.rollouts.single_run import PythonLoop
from planner.rollouts.tables import AllPairs
from planner.rollouts.threshold_classes import sums_by_threshold
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults, Tally, Trace
from planner.world.world import World


class Engine(ABC):
    """Rolls out one plan. Ids are whole numbers below 2**32.

    Attributes:
        name: "jax", "numba" or, where no robot can be lost, "nominal run".
        loop: the compiled plan: a `ClosedLoop` or a `CompiledPlan`.
        least: rollouts that a call should have: a block or several, on large maps a part of one.
        accessible: number of cells that count for coverage.
    """

    name: str
    loop: Any
    least: int
    accessible: int

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return self.run(start, count)[0]

    def results(self, start: int, count: int) -> RolloutResults:
        """The results of each of these rollouts."""
        return self.run(start, count)[1]

    @abstractmethod
    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the results."""

    @abstractmethod
    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Traces of these rollouts, in the order given."""

    @abstractmethod
    def rolling(self, loop: Any) -> Engine:
        """The engine of another loop, with the same seed and back end."""

    def truncated_at(self, step: int) -> Engine:
        """The same rollouts truncated at the end of `step`."""
        return self.rolling(self.loop.truncated_at(step))

    def with_threat(self, truth: World) -> Engine:
        """The same decisions under the threats of `truth`, a map of the same cells."""
        return self.rolling(self.loop.with_threat(truth))

    def with_cell_weights(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> Engine:
        """The same closed-loop rollouts with survived visits counted and values summed up.

        Raises:
            UsageError: an open loop, whose values are exact.
        """
        return self.rolling(self.loop.with_cell_weights(covered, found))


# A closed loop in which no robot can be lost: every rollout is the nominal run, which the plan holds.


def is_nominal(plan: Plan, world: World) -> bool:
    """Whether every closed-loop rollout is the nominal run and the plan's paths determine its counts.

    They do not for a resumed mission, nor do they tell which robots have returned to a base.
    """
    return plan.state is None and not plan.comes_home and is_certain(world, plan)


class NominalRun(Engine):
    """An engine that counts the nominal run as often as needed.

    The paths are counted with NumPy, so nothing is compiled: on a large map without threats a compilation takes a
    minute, and the result a second. The counts of shared areas (`RolloutResults.bisected`, `divided`) are left out.
    """

    name = "nominal run"
    least = BLOCK

    def __init__(
        self, world: World, plan: Plan, loop: ClosedLoop, seed: int, make_full: Callable[[ClosedLoop], Engine]
    ) -> None:
        """Bind the run.

        Args:
            world: the map.
            plan: with `is_nominal` in this world.
            loop: the plan, compiled to arrays.
            seed: of the random numbers, which affect nothing.
            make_full: makes the engine for other threats or other counts.
        """
        self.world, self.plan, self.loop, self.seed, self.accessible = world, plan, loop, seed, loop.accessible
        self._make_full = make_full

    def rolling(self, loop: ClosedLoop) -> Engine:
        """The full engine of another loop."""
        return self._make_full(loop)

    @cached_property
    def _once(self) -> Tally:
        """The tally of the nominal run as rollout 0."""
        end, size = min(self.plan.time, self.loop.max_steps), self.plan.shape[0] * self.plan.shape[1]
        first, visits = np.full(size, end + 1), np.zeros(size, dtype=np.int64)
        for robot in self.plan.robots:
            steps = robot.entered[robot.entered <= end]
            np.minimum.at(first, robot.path[steps], steps)
            visits += np.bincount(robot.path[steps], minlength=size)
        new = np.bincount(first[visits > 0], minlength=end + 1)
        covered = int(new.sum())
        ended = Outcome[self.plan.outcome.upper()]
        # Counts have one code for the deadline and the step limit.
        over = Outcome.STEP_LIMIT if ended is Outcome.DEADLINE or self.plan.time != end else ended
        once = {"visited": covered, "survived": covered, "time": end, "alive": len(self.plan.robots), "outcomes": over}
        none = self.loop.empty_tally(self.seed)
        counts: dict[str, Any] = {
            name: np.zeros(max(len(getattr(none, name)), at + 1), dtype=np.int64) for name, at in once.items()
        }
        for name, at in once.items():
            counts[name][at] = 1
        seen = (visits > 0).astype(np.int64)
        cells: dict[str, Any] = {"visits": visits, "covered_visited": seen, "covered_survived": seen}
        return replace(none, ids=((0, 1),), new_visited=new, new_survived=new, **counts, **cells)

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        if count == 0:
            return self.loop.empty_tally(self.seed)
        times: dict[str, Any] = {name: values * count for name, values in self._once.counts().items()}
        return replace(self._once, ids=((start, start + count),), **times)

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the results."""
        names = ("visited", "survived", "time", "alive", "outcomes")
        columns = (np.full(count, np.argmax(getattr(self._once, name)), dtype=np.int32) for name in names)
        visited, survived, time, alive, outcome = columns
        results = RolloutResults(start, visited, survived, time, alive, outcome.astype(np.int8))
        return self.tally(start, count), results

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Traces of these rollouts, in the order given."""
        # A truncated loop ends before the plan does: its trace has to be simulated.
        if self.loop.max_steps < self.plan.time:
            return self.rolling(self.loop).traces(rollouts)
        once = PythonLoop(self.plan, self.world).trace(self.seed, 0)
        return (replace(once, rollout=rollout) for rollout in rollouts)

    def truncated_at(self, step: int) -> NominalRun:
        """The same rollouts truncated at the end of `step`."""
        return NominalRun(self.world, self.plan, self.loop.truncated_at(step), self.seed, self._make_full)


# A rollout is a pure function of (plan, seed, id): chunk size, engine, threads and devices cannot change a count.
# This is the only place that chooses between open and closed loop, and between Numba and JAX. A new back end is one
# class and one line in `OPEN_LOOP` or `CLOSED_LOOP` (and its name in `planner.rollouts.names`). `mrac_jax` imports this
# package, so its back ends are looked up by name.

# Ranges of rollout ids to run one after the other, of about half a second each.

MOST_SEED = 2**64
CHUNK_SECONDS, MOST_CHUNK = 0.5, 2**21
"""Approximate duration of a range, and its most ids, for memory."""
CELLS_A_CALL = 2**21
"""Approximate cells that rollouts cover in a call large enough to pay: 4,096 rollouts of 500 cells."""
Result = TypeVar("Result")


def rollouts_per_call(cells: int) -> int:
    """Closed-loop rollouts that a call should have: a block, on large maps an aligned part of one.

    Args:
        cells: accessible cells.
    """
    return max(1, min(BLOCK, 1 << (CELLS_A_CALL // cells).bit_length() - 1))


def check_range(start: int, count: int, chunk: int | None, seed: int) -> None:
    """Check ids, chunk and seed.

    Raises:
        UsageError: one of them is out of range.
    """
    if start < 0 or count < 0 or start + count > MOST_ROLLOUTS:
        raise UsageError(f"rollouts {start} .. {start + count}", expected="ids 0 <= id < 2**32")
    if chunk is not None and chunk < 1:
        raise UsageError(f"chunk is {chunk}", expected="at least 1 rollout")
    if not 0 <= seed < MOST_SEED:
        raise UsageError(f"seed is {seed}", expected="0 <= seed < 2**64")


def run_ranges(
    work: Callable[[int, int], Result],
    start: int,
    count: int,
    *,
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    unit: int = BLOCK,
) -> Iterator[tuple[int, int, Result, float]]:
    """Run `work(start, count)` for one range of ids after the other.

    A caller that stops iterating, or is interrupted, loses at most the range in progress.

    Args:
        work: runs a range. start, count: the ids.
        chunk: ids per range, rounded up to whole units; None: one unit, then about CHUNK_SECONDS worth, at most
            MOST_CHUNK.
        checkpoints: numbers of ids (counted from `start`) at which a range has to end, for stopping rules.
        unit: ranges end at its multiples.

    Yields:
        (start, count, result of `work`, seconds).
    """
    ends = sorted({start + mark for mark in checkpoints if 0 < mark < count} | {start + count})
    size, position = chunk or unit, start
    while position < start + count:
        boundary = next(end for end in ends if end > position)
        stop = min(boundary, (position + size + unit - 1) // unit * unit)
        clock = time.perf_counter()
        result = work(position, stop - position)
        took = time.perf_counter() - clock
        yield position, stop - position, result, took
        if chunk is None:
            # A range never shrinks, so one slow range (another program, a compilation) does not slow down the rest.
            size = max(size, min(int((stop - position) * CHUNK_SECONDS / max(took, 1e-9)), MOST_CHUNK))
        position = stop


# The compiled simulator (`planner.rollouts.closed_loop`) as an engine, and the kernels of the open loop.

TRACED = 8
"""Rollouts traced at a time."""


class NumbaClosedLoop(Engine):
    """The engine of a closed loop and a seed on Numba."""

    name = "numba"

    def __init__(self, loop: ClosedLoop, seed: int, *, threads: int | None = None) -> None:
        """Args: `threads`: None for all cores; no count depends on it."""
        self.loop, self.seed, self._threads = loop, seed, threads
        self.accessible = loop.accessible
        self.least = rollouts_per_call(self.accessible) if loop.tabled else 1

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads)[0]

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the results, from one pass."""
        tally, results = closed_loop.run_range(self.loop, self.seed, start, count, threads=self._threads, singles=True)
        assert results is not None
        return tally, results

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Traces of these rollouts, in the order given, made a few at a time."""
        waiting = iter(rollouts)
        while few := list(itertools.islice(waiting, TRACED)):
            yield from closed_loop.trace_rollouts(self.loop, self.seed, few)

    def rolling(self, loop: ClosedLoop) -> NumbaClosedLoop:
        """The engine of another loop, with the same seed and threads."""
        return NumbaClosedLoop(loop, self.seed, threads=self._threads)


class OpenLoop(Engine):
    """The engine of one compiled plan's open loop and a seed, on the kernel of either back end."""

    least = BLOCK

    def __init__(self, loop: CompiledPlan, seed: int, name: str, make_kernel: MakeKernel) -> None:
        """Args: `make_kernel`: makes the kernel; `name`: of the back end. No count depends on either."""
        self.loop, self.seed, self.name = loop, seed, name
        self.accessible, self._make_kernel = loop.accessible, make_kernel
        self._kernel = make_kernel(loop, seed)

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return tally_of(self.loop, self.seed, start, self._kernel.counts(start, count))

    def results(self, start: int, count: int) -> RolloutResults:
        """The results of each of these rollouts."""
        return self._kernel.results(start, count)

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the results."""
        return self.tally(start, count), self.results(start, count)

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Traces of these rollouts, in the order given."""
        return (open_loop_trace(self.loop.plan, self.loop.world, self.seed, one) for one in rollouts)

    def rolling(self, loop: CompiledPlan) -> OpenLoop:
        """The engine of another plan, with the same seed and back end."""
        return OpenLoop(loop, self.seed, self.name, self._make_kernel)

    def with_cell_weights(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> OpenLoop:
        """Not supported: `analysis.theory.exact` has the exact value.

        Raises:
            UsageError: always.
        """
        raise UsageError("survived visits are only counted in the closed loop", expected="exact values")


@dataclass(frozen=True)
class Rolling:
    """Kind of rollouts.

    Attributes:
        loop: "open": robots follow the plan until they are lost; "closed": areas are reallocated and shared.
        first_only: closed loop: only the first visit of a cell by any robot is checked.
        seed: 0 <= seed < 2**64.
    """

    loop: Literal["open", "closed"] = "closed"
    first_only: bool = False
    seed: int = 0


class Chosen(NamedTuple):
    """A back end, and why it was chosen."""

    name: EngineName
    why: str


def make_engine(
    plan: Plan, world: World, how: Rolling, engine: EngineName = "auto", kept: AllPairs | None = None
) -> Engine:
    """The engine for a plan. JAX is imported only if requested, or if it is installed with an accelerator.

    Args:
        plan: for this world.
        world: the map.
        how: kind of rollouts.
        engine: "numba", "jax", or "auto".
        kept: where all-pairs tables of the closed loop are kept for other teams on the same map.

    Raises:
        InputError: the plan cannot be rolled out this way.
        UsageError: an unknown engine, or a seed out of range.
    """
    if how.loop == "open":
        return open_loop_engine(compile_plan(plan, world), how.seed, engine)
    loop = compile_closed_loop(plan, world, first_only=how.first_only, kept=kept)
    make = partial(closed_loop_engine, seed=how.seed, engine=engine)
    return NominalRun(world, plan, loop, how.seed, make) if engine == "auto" and is_nominal(plan, world) else make(loop)


def open_loop_engine(
    compiled: CompiledPlan, seed: int, engine: EngineName = "auto", threads: int | None = None
) -> Engine:
    """The engine of a compiled plan's open loop.

    Args:
        compiled: the plan's path arrays.
        seed: of the random numbers.
        engine: "auto" is Numba where JAX does not support the uncertain map.
        threads: of Numba, None for all cores.

    Raises:
        UsageError: as in `make_engine`.
    """
    check_range(0, 0, None, seed)
    return _first_that_can(OPEN_LOOP, engine, compiled, seed, threads)


def closed_loop_engine(loop: ClosedLoop, seed: int, engine: EngineName = "auto", threads: int | None = None) -> Engine:
    """The engine of a closed loop.

    Args:
        loop: the closed loop.
        seed: of the random numbers.
        engine: "auto" is Numba where JAX does not support the world.
        threads: of Numba, None for all cores.

    Raises:
        UsageError, WorldError: as in `make_engine`.
    """
    check_range(0, 0, None, seed)
    return _first_that_can(CLOSED_LOOP, engine, loop, seed, threads)


def _first_that_can(makers: Mapping[str, Callable[..., Engine]], engine: EngineName, *given: Any) -> Engine:
    """The engine of this name; for "auto" Numba's if the other does not support the world."""
    try:
        return makers[choose_engine(engine).name](*given)
    except (UsageError, WorldError):
        if engine != "auto":
            raise
    return makers["numba"](*given)


OPEN_LOOP: dict[str, Callable[[CompiledPlan, int, int | None], Engine]] = {
    "jax": lambda plan, seed, threads: OpenLoop(plan, seed, "jax", of_jax("open loop")),
    "numba": lambda plan, seed, threads: OpenLoop(plan, seed, "numba", partial(NumbaOpenLoop, threads=threads)),
}
CLOSED_LOOP: dict[str, Callable[[ClosedLoop, int, int | None], Engine]] = {
    "jax": lambda loop, seed, threads: of_jax("closed loop")(loop, seed),
    "numba": lambda loop, seed, threads: NumbaClosedLoop(loop, seed, threads=threads),
}
"""The back ends of each loop: they make an engine from a compiled plan, a seed and a number of threads."""


def choose_engine(engine: EngineName) -> Chosen:
    """The back end of a name: "auto" is JAX if it has an accelerator, else Numba.

    Numba is faster on CPUs (`docs/speed.md`). The search for an accelerator does not import JAX.

    Raises:
        UsageError: an unknown name, or JAX is not installed.
    """
    if engine not in ENGINES:
        raise UsageError(f"engine is {engine!r}", expected=" or ".join(ENGINES))
    if engine == "jax":
        check_jax()
    if engine != "auto":
        return Chosen(engine, "asked for")
    platform = of_jax("accelerator")()
    if platform is None:
        return Chosen("numba", "the fastest on a CPU")
    return Chosen("jax", f"it has a {platform}")


@dataclass(frozen=True, eq=False)
class Chunk:
    """State of a run after a chunk.

    Attributes:
        tally: of all rollouts so far.
        results: of this chunk's rollouts if requested, else None.
        seconds: so far, without compile_seconds: those of the first call, compilation included.
    """

    tally: Tally
    results: RolloutResults | None
    seconds: float
    compile_seconds: float


def run_with_threshold_sums(engine: Engine, seed: int, start: int, count: int) -> tuple[Tally, RolloutResults]:
    """`engine.run`, with the sums by class of total threshold in the tally (`sums_by_threshold`).

    Args:
        engine: of these rollouts.
        seed: of their random numbers.
        start: first id.
        count: rollouts.
    """
    tally, results = engine.run(start, count)
    return replace(tally, by_threshold=sums_by_threshold(results, seed, tally.robots)), results


def run_chunks(
    engine: Engine,
    count: int,
    *,
    start: int = 0,
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    results: bool = False,
    by_threshold: int | None = None,
) -> Iterator[Chunk]:
    """Roll out ids `start .. start + count - 1` by chunks. Memory is constant.

    A caller that stops iterating, or is interrupted, loses at most the chunk in progress.

    Args:
        engine: of the rollouts.
        count: rollouts, ids at most 2**32 - 1.
        start: first id.
        chunk: rollouts per chunk, rounded up to `engine.least`; None: about half a second's worth. No count depends on
            it.
        checkpoints: numbers of rollouts (counted from `start`) at which a chunk has to end, for stopping rules.
        results: whether chunks hold the results of single rollouts.
        by_threshold: the seed, if the tally gets the sums by class of total threshold (`run_with_threshold_sums`).

    Raises:
        UsageError: ids or a chunk out of range.
    """

    def work(first: int, size: int) -> tuple[Tally, RolloutResults | None]:
        if by_threshold is not None:
            return run_with_threshold_sums(engine, by_threshold, first, size)
        return engine.run(first, size) if results else (engine.tally(first, size), None)

    check_range(start, count, chunk, 0)
    clock = time.perf_counter()
    # The first call compiles, so it is not timed; its rollouts are counted once, below. Two rollouts if they are cheap:
    # columns of a single rollout are contiguous, those of several are not, and Numba compiles for each case.
    work(start, min(count, engine.least, 2))
    compile_seconds = time.perf_counter() - clock
    tally, seconds = None, 0.0

    ranges = run_ranges(work, start, count, chunk=chunk, checkpoints=checkpoints, unit=engine.least)
    for _, _, (part, singles), took in ranges:
        tally, seconds = part if tally is None else tally + part, seconds + took
        yield Chunk(tally, singles, seconds, compile_seconds)
