"""The classical simulator at scale: closed-loop rollouts of `planner.simulate_fast`, on all cores, as tallies."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planner import fast_areas, simulate_fast
from planner.costs import BLOCKED, NOWHERE, first_hops, neighbour_table, search
from planner.errors import PlanError, WorldError
from planner.jit import threaded
from planner.plan import Plan, Settings
from planner.planner import Problem, prepare
from planner.tally import Outcome, RolloutResults, Tally, tally_key
from planner.threefry import key_of
from planner.world import World

BLOCK = 4096
"""Rollout ids per aligned block (SPEC section 9)."""
MOST_TABLED = 10_000
"""Most accessible cells for which the all-pairs tables are made (0.6 GB)."""
CHUNK_SECONDS = 0.5


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plan's closed loop, ready to roll out. Axis `A` = accessible cells.

    Attributes:
        identity: hash of everything that its rollouts depend on besides the seed.
        shape: (H, W). cells: int64 `[A]`, index of each accessible cell.
        tables: what every rollout reads. max_steps: T_max. first_only: `threat_checks="first_visit"`.
    """

    identity: str
    shape: tuple[int, int]
    cells: NDArray[np.int64]
    tables: fast_areas.Tables
    max_steps: int
    first_only: bool

    @property
    def robots(self) -> int:
        """K."""
        return len(self.tables.starts)

    def empty_tally(self, seed: int) -> Tally:
        """The tally of no rollouts."""
        key = tally_key(self.identity, "closed", "step", seed)
        return Tally.empty(key, self.shape, self.robots, len(self.cells))

    def until(self, step: int) -> ClosedLoop:
        """The same closed loop cut off at the end of `step`: its rollouts cover what the whole one's have by then."""
        cut = min(step, self.max_steps)
        return replace(self, identity=f"{self.identity}@{cut}", max_steps=cut)


def check_supported(world: World, accessible: int, settings: Settings) -> None:
    """Raise PlanError for `transit="area"`, which this simulator does not drive, WorldError for too many cells."""
    if settings.transit != "grid":
        raise PlanError(
            f"transit {settings.transit!r} in the closed loop",
            source=world.source,
            expected="transit 'grid' in this release",
            fix="use --loop open, or plan with --transit grid",
        )
    if accessible > MOST_TABLED:
        raise WorldError(
            f"{accessible} accessible cells",
            source=world.source,
            expected=f"at most {MOST_TABLED} for the closed loop in this release",
            fix="coarser cells (--cell-size METRES, or cell_size in a scenario), or --loop open",
        )


def compile_closed_loop(plan: Plan, world: World, *, first_only: bool = False) -> ClosedLoop:
    """The closed loop from the plan's allocation. Raises PlanError for the plan of another planner or another map."""
    if plan.settings is None:
        raise PlanError("a plan of another planner has no areas to reallocate", fix="use --loop open")
    if plan.sha256 != world.sha256 or plan.shape != world.shape:
        raise PlanError("plan for another map", expected="the world that it was made for")
    problem = prepare(world, plan.starts, plan.settings)
    cells = np.flatnonzero(problem.levels.accessible)
    check_supported(world, len(cells), plan.settings)
    compact = np.full(world.threat.size, NOWHERE, dtype=np.int32)
    compact[cells] = np.arange(len(cells), dtype=np.int32)
    areas = plan.areas
    sizes = [len(area.cells) for area in areas]
    neighbours, cost, hop, ranked = _all_pairs(problem, cells, compact)
    order = np.concatenate([compact[area.cells] for area in areas])
    begin = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    area_cost, area_entry = _area_tables(cost, hop.dtype, order, begin)
    threat = world.threat.ravel()[cells].astype(np.float64)
    tables = fast_areas.Tables(
        near=neighbours,
        cost_to=cost,
        hop_to=hop,
        ranked=ranked,
        bound=np.ceil(threat * 2.0**24).astype(np.uint32),
        area_cost=area_cost,
        area_entry=area_entry,
        starts=compact[problem.starts],
        order=order,
        begin=begin,
        level=np.array([area.level for area in areas], dtype=np.int32),
        owner=np.array([area.robot for area in areas], dtype=np.int32),
    )
    identity = _identity(plan, world, problem.max_steps, first_only)
    return ClosedLoop(identity, world.shape, cells, tables, problem.max_steps, first_only)


def _identity(plan: Plan, world: World, max_steps: int, first_only: bool) -> str:
    said = {
        "world": world.sha256,
        "settings": asdict(plan.settings) if plan.settings else None,
        "areas": [[area.level, area.robot, area.cells.tolist()] for area in plan.areas],
        "starts": plan.starts.tolist(),
        "max_steps": max_steps,
        "first_only": first_only,
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _all_pairs(
    problem: Problem, cells: NDArray[np.int64], compact: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray, NDArray, NDArray]:
    """(neighbours `[A, 4]`, cost `[A, A]`, first hop `[A, A]`, ranked `[A, RANKED]`), in the narrowest types."""
    grid = neighbour_table(problem.world.shape, problem.costs != BLOCKED)[cells]
    neighbours = np.where(grid == NOWHERE, NOWHERE, compact[grid]).astype(np.int32)
    entry = problem.costs[cells]
    size = len(cells)
    cost = np.full((size, size), NOWHERE, dtype=np.int32 if entry.sum() < 2**31 else np.int64)
    hop = np.full((size, size), NOWHERE, dtype=np.int16 if size < 2**15 else np.int32)
    ranked = np.full((size, min(size, fast_areas.RANKED)), NOWHERE, dtype=hop.dtype)
    threads = os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda part: _fill(part, threads, neighbours, entry, cost, hop, ranked), range(threads)))
    return neighbours, cost, hop, ranked


@threaded
def _fill(first, stride, neighbours, entry, cost, hop, ranked):  # type: ignore[no-untyped-def]
    """Rows `first, first + stride, ...` of the all-pairs tables."""
    size = len(entry)
    rank, inside = np.full(size, -1, dtype=np.int32), np.ones(size, dtype=np.bool_)
    distance, seen = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
    queue, heap_cell, heap_cost = np.zeros(size, np.int32), np.zeros(size, np.int32), np.zeros(size, np.int64)
    hops, row = np.zeros(size, dtype=np.int32), np.zeros(size, dtype=np.int64)
    for source in range(first, size, stride):
        search(source, rank, inside, neighbours, entry, distance, seen, source + 1, queue, heap_cost, heap_cell)
        for cell in range(size):
            row[cell] = distance[cell] if seen[cell] == source + 1 else -1
        hops[:] = -1
        by_cost = np.argsort(row, kind="mergesort")
        first_hops(source, row, by_cost, neighbours, entry, hops)
        place = 0
        for cell in by_cost:
            if row[cell] >= 0 and place < ranked.shape[1]:
                ranked[source, place] = cell
                place += 1
        for cell in range(size):
            cost[source, cell] = row[cell]
            hop[source, cell] = hops[cell]


def _area_tables(
    cost: NDArray, narrow: np.dtype, order: NDArray[np.int32], begin: NDArray[np.int32]
) -> tuple[NDArray, NDArray]:
    """(cost, entry) `[A, M]` from each cell to each area of t = 0, whose cells `order[begin[m]:begin[m + 1]]` rise."""
    area_cost = np.empty((len(cost), len(begin) - 1), dtype=cost.dtype)
    area_entry = np.empty(area_cost.shape, dtype=narrow)
    for area in range(len(begin) - 1):
        members = order[begin[area] : begin[area + 1]]
        nearest = cost[:, members].argmin(axis=1)
        area_entry[:, area] = members[nearest]
        area_cost[:, area] = cost[np.arange(len(cost)), members[nearest]]
    return area_cost, area_entry


def run_range(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None, singles: bool = False
) -> tuple[Tally, RolloutResults | None]:
    """Rollouts `start .. start + count - 1` on `threads` threads (None: all cores); the single results if asked."""
    table = np.zeros((count if singles else 0, 5), dtype=np.int32)
    workers = threads or os.cpu_count() or 1
    share = -(-count // workers)
    ranges = [(at, min(share, count - at)) for at in range(0, count, share)] if count else []
    with ThreadPoolExecutor(max_workers=workers) as pool:
        parts = list(pool.map(lambda part: _count(loop, seed, start, part, table), ranges))
    tally = loop.empty_tally(seed)
    for (at, size), counts in zip(ranges, parts, strict=True):
        tally = tally + _tally(loop, seed, start + at, size, counts)
    if not singles:
        return tally, None
    visited, survived, time, alive, outcome = table.T
    return tally, RolloutResults(start, visited, survived, time, alive, outcome.astype(np.int8))


def _count(
    loop: ClosedLoop, seed: int, start: int, part: tuple[int, int], table: NDArray[np.int32]
) -> simulate_fast.Counts:
    """One thread's rollouts; with room for more areas each time that it proves too small."""
    at, count = part
    key0, key1 = key_of(seed)
    size, room = len(loop.cells), len(loop.tables.level) + 4 * len(loop.cells)
    single = table[at : at + count] if len(table) else table
    while True:
        counts = simulate_fast.make_counts(size, loop.robots, loop.max_steps)
        if simulate_fast.run_rollouts(
            *loop.tables, *counts, single, start + at, count, room,
            np.uint32(key0), np.uint32(key1), loop.max_steps, loop.first_only,
        ):  # fmt: skip
            return counts
        room *= 4


def _tally(loop: ClosedLoop, seed: int, start: int, count: int, counts: simulate_fast.Counts) -> Tally:
    def on_grid(values: NDArray[np.int64]) -> NDArray[np.int64]:
        out = np.zeros(loop.shape[0] * loop.shape[1], dtype=np.int64)
        out[loop.cells] = values
        return out

    last = int(np.flatnonzero(counts.by_step[fast_areas.TIME]).max()) + 1
    return Tally(
        key=tally_key(loop.identity, "closed", "step", seed),
        shape=loop.shape,
        ids=((start, start + count),),
        visited=counts.visited,
        survived=counts.survived,
        time=counts.by_step[fast_areas.TIME, :last],
        alive=counts.alive,
        outcomes=np.pad(counts.outcomes, (0, len(Outcome) - len(counts.outcomes))),
        new_visited=counts.by_step[fast_areas.NEW_VISITED, :last],
        new_survived=counts.by_step[fast_areas.NEW_SURVIVED, :last],
        visits=on_grid(counts.by_cell[fast_areas.VISITS]),
        stops=on_grid(counts.by_cell[fast_areas.STOPS]),
        covered_visited=on_grid(counts.by_cell[fast_areas.COVERED]),
        covered_survived=on_grid(counts.by_cell[fast_areas.SAFELY]),
    )


def run_chunks(
    loop: ClosedLoop, *, seed: int, count: int, checkpoints: Iterable[int] = (), chunk: int | None = None
) -> Iterator[tuple[Tally, float]]:
    """(tally so far, seconds of running) after every chunk of rollouts `0 .. count - 1`.

    Args:
        loop: what to roll out.
        seed: 0 <= seed < 2**64.
        count: at most 2**32.
        checkpoints: numbers of rollouts at which a chunk must end.
        chunk: rollouts a chunk, whole blocks; None = about half a second's worth. No count depends on it.
    """
    run_range(loop, seed, 0, 0 if count == 0 else 1)  # compiles
    ends = sorted({mark for mark in checkpoints if 0 < mark < count} | {count})
    tally, seconds, position, size = loop.empty_tally(seed), 0.0, 0, chunk or BLOCK
    while position < count:
        boundary = next(end for end in ends if end > position)
        stop = min(boundary, (position + max(size, BLOCK)) // BLOCK * BLOCK)
        clock = time.perf_counter()
        tally = tally + run_range(loop, seed, position, stop - position)[0]
        took = time.perf_counter() - clock
        seconds += took
        yield tally, seconds
        position = stop
        if chunk is None and took < CHUNK_SECONDS / 2:
            size *= 2
