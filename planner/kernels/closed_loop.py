"""The classical simulator at scale: closed-loop rollouts of `planner.kernels.rollouts`, on all cores, as tallies."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.kernels import rollouts as simulate_fast
from planner.kernels import state as fast_state
from planner.kernels.tables import AllPairs, hit_bounds, make_tables
from planner.kernels.trace import FRAME_AREA, FRAME_CELL, FRAME_DOING, FRAME_ROWS
from planner.mrac.problem import prepare
from planner.plans.plan import Plan
from planner.policies import DEFAULT
from planner.tally import Outcome, RolloutResults, Tally, tally_key
from planner.threefry import key_of
from planner.trace import NO_AREA, EventKind, Trace
from planner.worlds.world import World

Result = TypeVar("Result")
MOST_TABLED = 10_000
"""Most accessible cells for which all-pairs tables are made (0.6 GB); beyond, distances are searched for on demand."""


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plan's closed loop, ready to roll out. Axis `A` = accessible cells.

    Attributes:
        identity: hash of everything that its rollouts depend on besides the seed.
        shape: (H, W). cells: int64 `[A]`, index of each accessible cell.
        tables: what every rollout reads. max_steps: T_max. first_only: `threat_checks="first_visit"`.
        stay_inside: `transit="area"`.
    """

    identity: str
    shape: tuple[int, int]
    cells: NDArray[np.int64]
    tables: fast_state.Tables
    max_steps: int
    first_only: bool
    stay_inside: bool

    @property
    def robots(self) -> int:
        """K."""
        return len(self.tables.starts)

    @property
    def tabled(self) -> bool:
        """True if distances come from all-pairs tables."""
        return self.tables.cost_to is not None

    def empty_tally(self, seed: int) -> Tally:
        """The tally of no rollouts."""
        key = tally_key(self.identity, "closed", "step", seed)
        return Tally.empty(key, self.shape, self.robots, len(self.cells))

    def until(self, step: int) -> ClosedLoop:
        """The same closed loop cut off at the end of `step`: its rollouts cover what the whole one's have by then."""
        cut = min(step, self.max_steps)
        return replace(self, identity=f"{self.identity}@{cut}", max_steps=cut)

    def under(self, world: World) -> ClosedLoop:
        """The same decisions, but robots are stopped by the threats of `world`, a map of the same cells."""
        tables = self.tables._replace(bound=hit_bounds(world, self.cells))
        return replace(self, identity=f"{self.identity}~{world.sha256}", tables=tables)


def compile_closed_loop(
    plan: Plan,
    world: World,
    *,
    first_only: bool = False,
    tabled: bool | None = None,
    kept: AllPairs | None = None,
) -> ClosedLoop:
    """The closed loop from the plan's allocation. Raises PlanError for the plan of another planner or another map.

    `tabled`: distances from all-pairs tables, or searched for on demand; None: tables up to MOST_TABLED cells. No
    rollout depends on it. `kept`: where all-pairs tables are kept for other teams on the same map.
    """
    settings = plan.require(world, areas=True)
    if settings.policy != DEFAULT or settings.own_words:
        raise PlanError(
            f"the compiled engines do not follow {settings.own_words or f'policy {settings.policy}'} yet",
            expected=f"policy {DEFAULT}, cells in the planner's own order",
            fix="roll it out open loop, or with planner.mrac.reference.ReferenceLoop",
        )
    problem = prepare(world, plan.starts, settings)
    cells = np.flatnonzero(problem.levels.accessible)
    return ClosedLoop(
        identity=_identity(plan, world, problem.max_steps, first_only),
        shape=world.shape,
        cells=cells,
        tables=make_tables(problem, cells, plan.areas, len(cells) <= MOST_TABLED if tabled is None else tabled, kept),
        max_steps=problem.max_steps,
        first_only=first_only,
        stay_inside=settings.transit == "area",
    )


def _identity(plan: Plan, world: World, max_steps: int, first_only: bool) -> str:
    said = {
        "world": world.sha256,
        "settings": plan.settings.to_json() if plan.settings else None,
        "areas": [[area.level, area.robot, area.cells.tolist()] for area in plan.areas],
        "starts": plan.starts.tolist(),
        "max_steps": max_steps,
        "first_only": first_only,
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def run_range(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None, singles: bool = False
) -> tuple[Tally, RolloutResults | None]:
    """Rollouts `start .. start + count - 1` on `threads` threads (None: all cores); the single results if asked."""
    table = np.zeros((count if singles else 0, fast_state.SINGLES), dtype=np.int32)
    ranges, parts = _on_threads(lambda part: _count(loop, seed, start, part, table), count, threads)
    tally = loop.empty_tally(seed)
    for (at, size), counts in zip(ranges, parts, strict=True):
        tally = tally + _tally(loop, seed, start + at, size, counts)
    if not singles:
        return tally, None
    visited, survived, times, alive, outcome, bisected, divided = table.T
    return tally, RolloutResults(start, visited, survived, times, alive, outcome.astype(np.int8), bisected, divided)


def new_cells(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None
) -> list[NDArray[np.int64]]:
    """Of each rollout `start .. start + count - 1`, int64 `[time + 1]`: cells visited for the first time, by step.

    They are the rollouts that `run_range` counts, run one at a time by the same compiled program.
    """
    _, parts = _on_threads(lambda part: _new_cells(loop, seed, start, part), count, threads)
    return [curve for curves in parts for curve in curves]


def _on_threads(
    work: Callable[[tuple[int, int]], Result], count: int, threads: int | None
) -> tuple[list[tuple[int, int]], list[Result]]:
    """The numbers 0 .. count - 1 shared out as (first, how many), and what `work` made of each share."""
    workers = threads or os.cpu_count() or 1
    share = -(-count // workers)
    ranges = [(at, min(share, count - at)) for at in range(0, count, share)] if count else []
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return ranges, list(pool.map(work, ranges))


def _new_cells(loop: ClosedLoop, seed: int, start: int, part: tuple[int, int]) -> list[NDArray[np.int64]]:
    """One thread's curves: the counts are cleared after each rollout as far as it went."""
    at, count = part
    room, single, curves = _room(loop), np.zeros((1, fast_state.SINGLES), dtype=np.int32), []
    state = fast_state.make_state(loop.tables, room)
    counts = fast_state.make_counts(len(loop.cells), loop.robots, loop.max_steps)
    for rollout in range(start + at, start + at + count):
        while not _run(loop, seed, rollout, 1, counts, state, single):
            room *= 4
            state = fast_state.make_state(loop.tables, room)
            counts = fast_state.make_counts(len(loop.cells), loop.robots, loop.max_steps)
        steps = counts.by_step[:, : int(single[0, 2]) + 1]
        curves.append(steps[fast_state.NEW_VISITED].copy())
        steps[:] = 0
    return curves


def _count(
    loop: ClosedLoop, seed: int, start: int, part: tuple[int, int], table: NDArray[np.int32]
) -> fast_state.Counts:
    """One thread's rollouts; with room for more areas each time that it proves too small."""
    at, count = part
    single, room = table[at : at + count] if len(table) else table, _room(loop)
    while True:
        state = fast_state.make_state(loop.tables, room)
        counts = fast_state.make_counts(len(loop.cells), loop.robots, loop.max_steps)
        if _run(loop, seed, start + at, count, counts, state, single):
            return counts
        room *= 4


def _room(loop: ClosedLoop) -> int:
    """Areas that a rollout hardly ever exceeds."""
    return len(loop.tables.level) + 4 * len(loop.cells)


def _run(
    loop: ClosedLoop,
    seed: int,
    start: int,
    count: int,
    counts: fast_state.Counts,
    state: fast_state.State,
    single: NDArray[np.int32],
    events: NDArray[np.int32] | None = None,
    frames: NDArray[np.int32] | None = None,
) -> bool:
    """`simulate_fast.run_rollouts`."""
    key0, key1 = key_of(seed)
    fits: bool = simulate_fast.run_rollouts(
        *loop.tables, *counts, *state, single, events, frames, start, count, np.uint32(key0), np.uint32(key1),
        loop.max_steps, loop.first_only, fast_state.INSIDE if loop.stay_inside else fast_state.EVERYWHERE,
    )  # fmt: skip
    return fits


def trace_rollouts(loop: ClosedLoop, seed: int, ids: Iterable[int]) -> list[Trace]:
    """Chosen rollouts in full, in the order of `ids` (each below 2**32), on one thread.

    They are the rollouts that `run_range` counts. Memory: 12 bytes a step and robot, and the state of one rollout.
    """
    room, steps, happenings = _room(loop), 4 * len(loop.cells) + 64, 4 * len(loop.cells) + 64
    state = fast_state.make_state(loop.tables, room)
    traces = []
    for rollout in ids:
        while True:
            counts = fast_state.make_counts(len(loop.cells), loop.robots, loop.max_steps)
            events = np.zeros((happenings + 1, 5), dtype=np.int32)
            frames = np.zeros((steps, FRAME_ROWS, loop.robots), dtype=np.int32)
            single = np.zeros((1, fast_state.SINGLES), dtype=np.int32)
            if not _run(loop, seed, rollout, 1, counts, state, single, events, frames):
                room *= 4
                state = fast_state.make_state(loop.tables, room)
                continue
            last = int(single[0, 2])
            if last < steps and events[0, 0] <= happenings:
                break
            steps, happenings = max(steps, last + 1), max(happenings, int(events[0, 0]))
        outcome = Outcome(int(single[0, 4]))
        area_of = state.cells[fast_state.AREA_OF]
        traces.append(_trace(loop, rollout, frames[: last + 1], events[1 : events[0, 0] + 1], area_of, outcome))
    return traces


def _trace(
    loop: ClosedLoop,
    rollout: int,
    frames: NDArray[np.int32],
    events: NDArray[np.int32],
    area_of: NDArray[np.int32],
    outcome: Outcome,
) -> Trace:
    """What the kernels wrote down, in cells of the grid."""
    grid = np.full(loop.shape[0] * loop.shape[1], NO_AREA, dtype=np.int32)
    grid[loop.cells] = area_of
    happened = events.copy()
    tells_cell = ~np.isin(happened[:, 2], (EventKind.REALLOCATED, EventKind.SHARED))
    happened[tells_cell, 4] = loop.cells[happened[tells_cell, 4]]
    return Trace(
        rollout=rollout,
        cells=loop.cells[frames[:, FRAME_CELL]].astype(np.int32),
        doing=frames[:, FRAME_DOING].astype(np.int8),
        areas=frames[:, FRAME_AREA].copy(),
        events=happened,
        area_of=grid,
        outcome=outcome,
    )


def _tally(loop: ClosedLoop, seed: int, start: int, count: int, counts: fast_state.Counts) -> Tally:
    def on_grid(values: NDArray[np.int64]) -> NDArray[np.int64]:
        out = np.zeros(loop.shape[0] * loop.shape[1], dtype=np.int64)
        out[loop.cells] = values
        return out

    last = int(np.flatnonzero(counts.by_step[fast_state.TIME]).max()) + 1
    return Tally(
        key=tally_key(loop.identity, "closed", "step", seed),
        shape=loop.shape,
        ids=((start, start + count),),
        visited=counts.visited,
        survived=counts.survived,
        time=counts.by_step[fast_state.TIME, :last],
        alive=counts.alive,
        outcomes=np.pad(counts.outcomes, (0, len(Outcome) - len(counts.outcomes))),
        new_visited=counts.by_step[fast_state.NEW_VISITED, :last],
        new_survived=counts.by_step[fast_state.NEW_SURVIVED, :last],
        visits=on_grid(counts.by_cell[fast_state.VISITS]),
        stops=on_grid(counts.by_cell[fast_state.STOPS]),
        covered_visited=on_grid(counts.by_cell[fast_state.COVERED]),
        covered_survived=on_grid(counts.by_cell[fast_state.SAFELY]),
    )
