"""The open loop in Numba: tiles of rollouts, one thread a part of the ids.

A tile goes through passes, each a loop over its rollouts that the compiler turns into vector instructions: random words
and the row of every group (`numba_draws`), then scores, event counts and histograms (`numba_scores`).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.jit import program
from planner.rollouts.open_loop import numba_draws, numba_scores
from planner.rollouts.open_loop.compiled import WORD, CompiledPlan, Mode, ModeTables, luck_of, words_of
from planner.rollouts.open_loop.counts import RangeCounts, available_cores, outcomes_of, share_out
from planner.rollouts.open_loop.numba_scores import SCORES, make_scoring, work_arrays
from planner.tally import RolloutResults
from planner.threefry import own_key
from planner.tolerance import key_of_luck


class NumbaOpenLoop:
    """The Numba engine for one plan, seed and mode (see `planner.rollouts.open_loop.counts.OpenLoopKernel`)."""

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode, threads: int | None = None) -> None:
        self.compiled, self.mode = compiled, mode
        self.tables = compiled.tables(mode)
        self.threads = threads or available_cores()
        self._key = tuple(np.uint32(half) for half in key_of_luck(seed, luck_of(mode)))
        self._scoring = make_scoring(self.tables)
        self._draw = draw_arguments(self.tables)
        draws = compiled.world.draws
        self._own = tuple(np.uint32(half) for half in own_key(seed, 0 if draws is None else draws.purpose))

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        parts = share_out(start, count, self.threads, self._scoring.tile)
        if len(parts) == 1:
            done = [self._part(*parts[0])]
        else:
            with ThreadPoolExecutor(len(parts)) as pool:
                done = list(pool.map(lambda part: self._part(*part), parts))
        rows, events, visited, survived, time, alive, complete_dead = (
            sum(arrays[1:], start=arrays[0]) for arrays in zip(*done, strict=True)
        )
        events = self._scoring.event_counts(events)[: self.tables.events.count]
        return RangeCounts(count, rows, events, visited, survived, time, alive, int(complete_dead[0]))

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        singles = np.zeros((SCORES, count), dtype=np.uint32)
        if count:
            self._part(start, count, singles)
        visited, survived, time, alive = singles.astype(np.int32)
        outcome = outcomes_of(visited, alive, self.compiled.accessible)
        return RolloutResults(start, visited, survived, time, alive, outcome)

    def _part(self, start: int, count: int, singles: NDArray[np.uint32] | None = None) -> tuple[NDArray[np.int64], ...]:
        """One thread's counts; `singles`, uint32 `[SCORES, count]`, is filled in if given."""
        compiled, scoring = self.compiled, self._scoring
        cells = compiled.accessible + 1
        sizes = (self.tables.groups.row_count, scoring.words * 32, cells, cells, compiled.last_step + 1)
        sums = tuple(np.zeros(size, dtype=np.int64) for size in (*sizes, compiled.robots + 1, 1))
        keep = np.zeros((SCORES, 0), dtype=np.uint32) if singles is None else singles
        groups, joint, tile = self.tables.groups, self.tables.joint, scoring.tile
        rows = np.empty((groups.count, tile), dtype=np.int32)
        score = (scoring.arguments, work_arrays(tile, scoring.words), keep, sums)
        if joint is not None:
            slots = len(groups.slot_robot)
            room = np.zeros(slots, bool), np.zeros(slots, np.int64), np.zeros(joint.spots, bool)
            _count_joint(self._key, self._own, start, count, self._draw, *room, rows, *score)
            return sums
        words = np.empty(tile, dtype=np.uint32)
        _count_drawn_once(self._key, start, count, self._draw, words, rows, *score)
        return sums


def draw_arguments(tables: ModeTables) -> tuple[Any, ...]:
    """What `numba_draws.drawn_once_rows` or `joint_rows` reads."""
    groups = tables.groups
    place = (groups.members, groups.first_row.astype(np.int32), groups.stride.astype(np.int32))
    if tables.joint is not None:
        *entry, table, exposure, doses, robot, nodes, times, last, _ = tables.joint
        return (*place, tuple(entry), table, exposure, doses, (robot, nodes, times), last)
    counter, second = words_of(groups, tables.mode)
    guide = tables.guide
    assert guide is not None  # there is one of the two
    return (
        *place,
        counter,
        np.uint32(WORD - 1 if second else 0),
        guide.mantissa,
        guide.bisections,
        guide.table,
        guide.threshold,
    )


@program
def _count_drawn_once(key, start, count, draw, words, rows, scoring, work, singles, sums):  # type: ignore[no-untyped-def]
    tile = rows.shape[1]
    for done in range(0, count, tile):
        numba_draws.drawn_once_rows(key, np.uint32(start + done), draw, words, rows)
        numba_scores.score_tile(rows, min(tile, count - done), scoring, work, done, singles, sums)


@program
def _count_joint(key, own, start, count, draw, alive, borne, spent, rows, scoring, work, singles, sums):  # type: ignore[no-untyped-def]
    tile = rows.shape[1]
    for done in range(0, count, tile):
        size = min(tile, count - done)
        numba_draws.joint_rows(key, own, np.uint32(start + done), size, draw, alive, borne, spent, rows)
        numba_scores.score_tile(rows, size, scoring, work, done, singles, sums)
