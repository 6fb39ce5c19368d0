"""The one way to roll out: an `Engine`, bound to a plan, its world, a loop and a seed; and runs without losses."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from planner.arguments import BLOCK, MOST_ROLLOUTS
from planner.errors import UsageError, WorldError
from planner.plan.plan import Plan, is_certain
from planner.rollouts import closed_loop
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.names import ENGINES, EngineName, check_jax, of_jax
from planner.rollouts.open_loop import CompiledPlan, OpenLoop, compile_plan
from planner.rollouts.open_loop_numba import NumbaOpenLoop
from planner.rollouts.single_run import PythonLoop
from planner.rollouts.tables import AllPairs
from planner.rollouts.threshold_classes import sums_by_luck
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults, Tally, Trace
from planner.world.world import World

# The closed loop of a plan in which no robot can be lost: every rollout is the nominal run, which the plan holds.


def is_nominal(plan: Plan, world: World) -> bool:
    """Whether every closed-loop rollout is the nominal run, and the plan's paths alone say how that is counted.

    Paths do not say it of a mission under way, nor which robots have returned to a base.
    """
    return plan.state is None and not plan.comes_home and is_certain(world, plan)


class NominalRun:
    """Counts the nominal run as often as it is asked for (see `planner.rollouts.engine.Engine`).

    The paths are counted with NumPy, so that nothing is compiled: on a large map without threats the compilation takes
    a minute, and the answer a second. How areas were shared (`RolloutResults.bisected` and `divided`) is left out.
    """

    name = "nominal run"
    least = BLOCK

    def __init__(self, world: World, plan: Plan, loop: ClosedLoop, seed: int, make_full: Callable[[], Any]) -> None:
        """`plan`: one that `is_nominal` in this world; `loop`: the same, compiled to arrays.

        `make_full`: makes the `Engine` that rolls it out under other threats, or with other counts.
        """
        self.world, self.plan, self.loop, self.seed, self.accessible = world, plan, loop, seed, loop.accessible
        self._make_full = make_full

    @cached_property
    def _full(self) -> Any:
        return self._make_full()

    @cached_property
    def _once(self) -> Tally:
        """The nominal run, counted once, as rollout 0."""
        end, size = min(self.plan.time, self.loop.max_steps), self.plan.shape[0] * self.plan.shape[1]
        first, visits = np.full(size, end + 1), np.zeros(size, dtype=np.int64)
        for robot in self.plan.robots:
            steps = robot.entered[robot.entered <= end]
            np.minimum.at(first, robot.path[steps], steps)
            visits += np.bincount(robot.path[steps], minlength=size)
        new = np.bincount(first[visits > 0], minlength=end + 1)
        covered = int(new.sum())
        ended = Outcome[self.plan.outcome.upper()]
        # Counts hold one code for the deadline and the step limit.
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

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        names = ("visited", "survived", "time", "alive", "outcomes")
        columns = (np.full(count, np.argmax(getattr(self._once, name)), dtype=np.int32) for name in names)
        visited, survived, time, alive, outcome = columns
        return RolloutResults(start, visited, survived, time, alive, outcome.astype(np.int8))

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """Both of them."""
        return self.tally(start, count), self.results(start, count)

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given."""
        if self.loop.max_steps < self.plan.time:
            return self._full.traces(rollouts)
        once = PythonLoop(self.plan, self.world).trace(self.seed, 0)
        return (replace(once, rollout=rollout) for rollout in rollouts)

    def until(self, step: int) -> NominalRun:
        """The same rollouts cut off at the end of `step`."""
        return NominalRun(self.world, self.plan, self.loop.until(step), self.seed, lambda: self._full.until(step))

    def under(self, truth: World) -> Any:
        """The same decisions under the threats of `truth`."""
        return self._full.under(truth)

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> Any:
        """The same rollouts, survived visits counted."""
        return self._full.weighing(covered, found)


# The one way to roll out: an `Engine`, bound to a plan, its world, a loop and a seed, whichever loop and back end.
#
# A rollout is a pure function of (plan, seed, id): chunk size, engine, threads and devices cannot change a count.
# This is the only place that asks "open or closed?" and "Numba or JAX?"; a new back end is one class and one line in
# `OPEN_LOOP` or `CLOSED_LOOP` (and its name in `planner.rollouts.names`). Those of `mrac_jax`, which stands above,
# are looked up by name when they are asked for.

# Ranges of rollout ids to run one after the other, each as many as take about half a second.

MOST_SEED = 2**64
CHUNK_SECONDS, MOST_CHUNK = 0.5, 2**21
"""A range takes about so long, and has at most so many ids, for memory."""
CELLS_A_CALL = 2**21
"""Cells that rollouts cover, about, in a call that is worth while: 4,096 rollouts of 500 cells."""
Result = TypeVar("Result")


def worth_a_call(cells: int) -> int:
    """Rollouts of the closed loop that a call is worth while for: a block, on large maps an aligned part of one."""
    return max(1, min(BLOCK, 1 << (CELLS_A_CALL // cells).bit_length() - 1))


def check_range(start: int, count: int, chunk: int | None, seed: int) -> None:
    """Raise UsageError for ids, a chunk or a seed that are none."""
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
    """`work(start, count)` for range after range of ids: (start, count, what it returned, seconds it took).

    Whoever stops iterating (or is interrupted) loses at most the range in flight.

    Args:
        work: runs a range. start, count: the ids.
        chunk: ids a range, rounded up to whole units; None = one unit, then as many as take about
            CHUNK_SECONDS, MOST_CHUNK at most.
        checkpoints: numbers of ids (counted from `start`) at which a range must end, for stopping rules.
        unit: ranges end at its multiples.
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
            size = max(size, min(int((stop - position) * CHUNK_SECONDS / max(took, 1e-9)), MOST_CHUNK))
        position = stop


# The compiled classical simulator (`planner.rollouts.closed_loop`) as an engine.

TRACED = 8
"""Rollouts traced at a time."""


class NumbaClosedLoop:
    """One closed loop and seed, rolled out by Numba (see `planner.rollouts.engine.Engine`)."""

    name = "numba"

    def __init__(self, loop: ClosedLoop, seed: int, *, threads: int | None = None) -> None:
        """`threads`: None for all cores; no count depends on it."""
        self.loop, self.seed, self._threads = loop, seed, threads
        self.accessible = loop.accessible
        self.least = worth_a_call(self.accessible) if loop.tabled else 1

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

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given, a few at a time."""
        waiting = iter(rollouts)
        while few := list(itertools.islice(waiting, TRACED)):
            yield from closed_loop.trace_rollouts(self.loop, self.seed, few)

    def until(self, step: int) -> NumbaClosedLoop:
        """The same rollouts cut off at the end of `step`."""
        return NumbaClosedLoop(self.loop.until(step), self.seed, threads=self._threads)

    def under(self, truth: World) -> NumbaClosedLoop:
        """The same decisions under the threats of `truth`."""
        return NumbaClosedLoop(self.loop.under(truth), self.seed, threads=self._threads)

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> NumbaClosedLoop:
        """The same rollouts, survived visits counted: `ClosedLoop.weighing`."""
        return NumbaClosedLoop(self.loop.weighing(covered, found), self.seed, threads=self._threads)


class Engine(Protocol):
    """What rolls out. Ids are whole numbers below 2**32."""

    @property
    def name(self) -> str:
        """ "jax", "numba" or, where no robot can be lost, "nominal run"."""
        ...

    @property
    def least(self) -> int:
        """Rollouts that are worth a call: a block or several, on large maps a part of one."""
        ...

    @property
    def accessible(self) -> int:
        """Cells that count."""
        ...

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        ...

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        ...

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """Both of them."""
        ...

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given."""
        ...

    def until(self, step: int) -> Engine:
        """The same rollouts cut off at the end of `step`."""
        ...

    def under(self, truth: World) -> Engine:
        """The same decisions, but robots are stopped by the threats of `truth`, a map of the same cells."""
        ...

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> Engine:
        """The same rollouts of the closed loop, survived visits counted and summed up by cell: `ClosedLoop.weighing`.

        Raises UsageError in the open loop, whose figures are exact.
        """
        ...


@dataclass(frozen=True)
class Rolling:
    """What a rollout is, besides its plan and id.

    Attributes:
        loop: "open": follow the plan until stopped; "closed": reallocate and share at run time.
        first_only: closed loop: only the first visit of a cell by anybody can stop a robot.
        seed: 0 <= seed < 2**64.
    """

    loop: Literal["open", "closed"] = "closed"
    first_only: bool = False
    seed: int = 0


class Chosen(NamedTuple):
    """A back end, and why it was taken."""

    name: EngineName
    why: str


def make_engine(
    plan: Plan, world: World, how: Rolling, engine: EngineName = "auto", kept: AllPairs | None = None
) -> Engine:
    """The engine for this plan. JAX is imported only if it is asked for, or installed with an accelerator.

    `kept`: where the closed loop's all-pairs tables are kept for other teams on the same map.
    Raises InputError for a plan that cannot be rolled out so, UsageError for an engine or seed that is none.
    """
    if how.loop == "open":
        return open_loop_engine(compile_plan(plan, world), how.seed, engine)
    loop = compile_closed_loop(plan, world, first_only=how.first_only, kept=kept)
    make = partial(closed_loop_engine, loop, how.seed, engine)
    return NominalRun(world, plan, loop, how.seed, make) if engine == "auto" and is_nominal(plan, world) else make()


def open_loop_engine(
    compiled: CompiledPlan, seed: int, engine: EngineName = "auto", threads: int | None = None
) -> Engine:
    """The engine of a compiled plan's open loop; `threads`: of Numba, None for all cores.

    More maps in doubt than JAX has numbers for are an error for `engine="jax"`, and Numba's for "auto".
    """
    check_range(0, 0, None, seed)
    return _first_that_can(OPEN_LOOP, engine, compiled, seed, threads)


def closed_loop_engine(loop: ClosedLoop, seed: int, engine: EngineName = "auto", threads: int | None = None) -> Engine:
    """The engine of a closed loop; `threads`: of Numba, None for all cores.

    A world that JAX's lanes have no room for is an error for `engine="jax"`, and Numba's for "auto".
    """
    check_range(0, 0, None, seed)
    return _first_that_can(CLOSED_LOOP, engine, loop, seed, threads)


def _first_that_can(makers: Mapping[str, Callable[..., Engine]], engine: EngineName, *given: Any) -> Engine:
    """The engine that a name means; for "auto" Numba's where that one has no room for the world."""
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
"""The back ends of each loop: what makes the engine of a compiled plan, a seed and so many threads (None: all)."""


def choose_engine(engine: EngineName) -> Chosen:
    """The back end that a name means: "auto" is JAX where it has an accelerator, else Numba.

    Numba is the faster one on CPUs (`docs/speed.md`). JAX is not imported to find out that there is nothing to find.
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
    """Where a run stands after a chunk.

    Attributes:
        tally: everything so far. results: this chunk's single rollouts if they were asked for, else None.
        seconds: running so far; compile_seconds: of the first call, compilation included, apart from that.
    """

    tally: Tally
    results: RolloutResults | None
    seconds: float
    compile_seconds: float


def run_by_luck(engine: Engine, seed: int, start: int, count: int) -> tuple[Tally, RolloutResults]:
    """What `engine.run` says of rollouts, in the tally their sums by luck too."""
    tally, results = engine.run(start, count)
    return replace(tally, by_luck=sums_by_luck(results, seed, tally.robots)), results


def run_chunks(
    engine: Engine,
    count: int,
    *,
    start: int = 0,
    chunk: int | None = None,
    checkpoints: Iterable[int] = (),
    results: bool = False,
    by_luck: int | None = None,
) -> Iterator[Chunk]:
    """Roll out ids `start .. start + count - 1`, 2**32 at most; after every chunk, where the run stands.

    Whoever stops iterating (or is interrupted) loses at most the chunk in flight. Memory is constant.

    Args:
        chunk: rollouts a chunk, rounded up to `engine.least`; None = about half a second's worth. No count depends on
            it.
        checkpoints: numbers of rollouts (counted from `start`) at which a chunk must end, for stopping rules.
        results: also hand over every single rollout.
        by_luck: the seed of the rollouts, whose sums by luck the tally is to have too (`run_by_luck`).

    Raises UsageError for ids or a chunk that are none.
    """

    def work(first: int, size: int) -> tuple[Tally, RolloutResults | None]:
        if by_luck is not None:
            return run_by_luck(engine, by_luck, first, size)
        return engine.run(first, size) if results else (engine.tally(first, size), None)

    check_range(start, count, chunk, 0)
    clock = time.perf_counter()
    # Compiles, apart from what is timed; asking for it again changes no count. Two rollouts where they are cheap: the
    # columns of a single one are contiguous, those of more are not, and Numba would compile for either.
    work(start, min(count, engine.least, 2))
    compile_seconds = time.perf_counter() - clock
    tally, seconds = None, 0.0

    ranges = run_ranges(work, start, count, chunk=chunk, checkpoints=checkpoints, unit=engine.least)
    for _, _, (part, singles), took in ranges:
        tally, seconds = part if tally is None else tally + part, seconds + took
        yield Chunk(tally, singles, seconds, compile_seconds)
