"""The open loop in Numba: draws and scores tiles of rollouts, one thread a part of the ids.

Per tile: random words for every slot (in vector registers), then every group's row, then one pass that ORs the rows'
event bits, adds their counts and enters the histograms. Axis letters as in `mrac_jax.compiled`; `L` rollouts of a tile.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrac_jax.caches import threaded
from mrac_jax.compiled import CompiledPlan, Mode, ModeTables
from mrac_jax.counts import RangeCounts, outcomes_of
from mrac_jax.kernels import popcount, threefry, wide_vectors
from planner.tally import RolloutResults
from planner.threefry import FAST_COUNTER, key_of

TILE = 1024
"""Rollouts that are drawn and scored together: their words and rows stay in a core's first cache."""
LANES = 16
"""Words in the widest vector register."""
VISITED, SURVIVED, TIME, ALIVE, FIELDS = range(5)
"""Columns of the row table before its event words."""
NIBBLES = np.uint32(0x11111111)


@dataclass(frozen=True, eq=False)
class Scoring:
    """What `_score` reads. `table`: uint32 `[R, FIELDS + W]`; the planes: uint32 `[bits, W]`, bit p of the weights."""

    table: NDArray[np.uint32]
    visited_planes: NDArray[np.uint32]
    survived_planes: NDArray[np.uint32]


class NumbaOpenLoop:
    """The Numba engine for one plan, seed and mode (see `mrac_jax.counts.OpenLoopEngine`)."""

    name = "numba"

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode, threads: int | None = None) -> None:
        self.compiled, self.mode = compiled, mode
        self.tables = compiled.tables(mode)
        self.key = tuple(np.uint32(half) for half in key_of(seed))
        self.threads = threads or len(os.sched_getaffinity(0))
        self._scoring = _make_scoring(self.tables)
        self._draw = _draw_arguments(self.tables)

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        parts = self._split(start, count)
        if len(parts) == 1:
            done = [self._part(*parts[0])]
        else:
            with ThreadPoolExecutor(len(parts)) as pool:
                done = list(pool.map(lambda part: self._part(*part), parts))
        totals = [sum(arrays[1:], start=arrays[0]) for arrays in zip(*done, strict=True)]
        return RangeCounts(count, *totals[:-1], complete_dead=int(totals[-1][0]))

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        singles = np.zeros((FIELDS, count), dtype=np.uint32)
        for first, size in self._split(start, count):
            self._part(first, size, singles[:, first - start : first - start + size])
        visited, survived, time, alive = singles.astype(np.int32)
        outcome = outcomes_of(visited, alive, self.compiled.accessible)
        return RolloutResults(start, visited, survived, time, alive, outcome)

    def _split(self, start: int, count: int) -> list[tuple[int, int]]:
        """(first id, number) of each thread's part: whole tiles but for the last."""
        share = max(1, -(-count // (self.threads * TILE))) * TILE
        return [(start + at, min(share, count - at)) for at in range(0, count, share)]

    def _part(
        self, start: int, count: int, singles: NDArray[np.uint32] | None = None
    ) -> tuple[NDArray[np.int64], ...]:
        compiled, tables, scoring = self.compiled, self.tables, self._scoring
        sizes = (
            tables.groups.row_count,
            tables.events.bits.shape[1] * 32,
            compiled.accessible + 1,
            compiled.accessible + 1,
            compiled.last_step + 1,
            compiled.robots + 1,
            1,
        )
        sums = tuple(np.zeros(size, dtype=np.int64) for size in sizes)
        keep = np.zeros((FIELDS, 0), dtype=np.uint32) if singles is None else singles
        kernel = _count_fast if self.mode == "fast" else _count_step
        with np.errstate(over="ignore"):
            kernel(*self.key, start, count, *self._draw, *vars(scoring).values(), keep, *sums)
        return sums[0], sums[1][: tables.events.count], *sums[2:]


def _make_scoring(tables: ModeTables) -> Scoring:
    events = tables.events
    fields = np.stack([events.own_visited, events.own_survived, tables.time, tables.alive], axis=1)
    planes = [weight_planes(weight, events.bits.shape[1]) for weight in (events.visited_weight, events.survived_weight)]
    return Scoring(np.ascontiguousarray(np.concatenate([fields, events.bits], axis=1)), *planes)


def weight_planes(weight: NDArray[np.int64], words: int) -> NDArray[np.uint32]:
    """uint32 `[bits, W]`: bit e % 32 of word e // 32 of plane p = bit p of the weight of event e."""
    bits = max(1, int(weight.max(initial=0)).bit_length())
    padded = np.zeros(words * 32, dtype=np.int64)
    padded[: len(weight)] = weight
    planes = (padded[None, :] >> np.arange(bits)[:, None]) & 1
    packed = (planes.reshape(bits, words, 32) << np.arange(32)).sum(axis=2)
    return packed.astype(np.uint32)


def _draw_arguments(tables: ModeTables) -> tuple:
    """The arguments of `_fast_rows` or `_step_rows` after the ids."""
    groups = tables.groups
    place = (groups.members, groups.first_row.astype(np.int32), groups.stride.astype(np.int32))
    if tables.guide is None:
        return (*place, tables.step_base, tables.step_bound)
    counter = np.where(groups.slot_robot >= 0, FAST_COUNTER - groups.slot_robot, 0).astype(np.uint32)
    guide = tables.guide
    return (*place, counter, guide.shift, guide.offset, guide.steps, guide.least, guide.threshold)


@threaded
def _fast_rows(key0, key1, first, place, draw, words, floats, rows):  # type: ignore[no-untyped-def]
    """Rows `[G, L]` of the rollouts from `first` on, by inverse survival of one word a slot."""
    wide_vectors()
    members, first_row, stride = place
    counter, shift, offset, steps, least, threshold = draw
    bits = floats.view(np.uint32)
    size = words.shape[0]
    for group in range(first_row.shape[0]):
        for lane in range(size):
            rows[group, lane] = first_row[group]
        for member in range(members):
            slot = group * members + member
            step = stride[group, member]
            for lane in range(size):
                words[lane] = threefry(key0, key1, np.uint32(first + np.uint32(lane)), counter[slot])[1]
            for lane in range(size):
                floats[lane] = np.float32(words[lane])
            for lane in range(size):
                bucket = max(np.int32(bits[lane] >> np.uint32(shift)) - np.int32(offset), np.int32(0))
                outcome = least[slot, bucket]
                half = 1 << (steps - 1)
                while half > 0:
                    outcome += np.int32(half) if words[lane] < threshold[slot, outcome + half] else np.int32(0)
                    half >>= 1
                rows[group, lane] += outcome * step


@threaded
def _step_rows(key0, key1, first, place, draw, words, active, rows):  # type: ignore[no-untyped-def]
    """Rows `[G, L]` of the rollouts from `first` on, one draw a dangerous entry, for those still going."""
    wide_vectors()
    members, first_row, stride = place
    base, bound = draw
    for group in range(first_row.shape[0]):
        for lane in range(rows.shape[1]):
            rows[group, lane] = first_row[group]
        for member in range(members):
            slot = group * members + member
            for lane in range(rows.shape[1]):
                active[lane] = lane
            left = rows.shape[1]
            entry = 0
            while left > 0:
                filled = (left + LANES - 1) // LANES * LANES
                for lane in range(filled):
                    rollout = np.uint32(first + np.uint32(active[lane]))
                    words[lane] = threefry(key0, key1, rollout, base[slot, entry])[0] >> np.uint32(8)
                kept = 0
                for lane in range(left):
                    goes_on = words[lane] >= bound[slot, entry]
                    rows[group, active[lane]] += stride[group, member] * np.int32(goes_on)
                    active[kept] = active[lane]
                    kept += goes_on
                left = kept
                entry += 1


@threaded
def _count_fast(  # type: ignore[no-untyped-def]
    key0, key1, start, count, members, first_row, stride, counter, shift, offset, steps, least, threshold,
    table, visited_planes, survived_planes, singles, row_sum, event_sum, visited, survived, time, alive, complete_dead,
):  # fmt: skip
    words, floats = np.empty(TILE, np.uint32), np.empty(TILE, np.float32)
    rows = np.empty((first_row.shape[0], TILE), np.int32)
    scores = np.empty((FIELDS, TILE), np.uint32)
    place, draw = (members, first_row, stride), (counter, shift, offset, steps, least, threshold)
    for done in range(0, count, TILE):
        size = min(TILE, count - done)
        _fast_rows(key0, key1, np.uint32(start + done), place, draw, words, floats, rows)
        _score(rows, size, table, visited_planes, survived_planes, row_sum, event_sum, scores)
        _enter(scores, size, done, singles, visited, survived, time, alive, complete_dead)


@threaded
def _count_step(  # type: ignore[no-untyped-def]
    key0, key1, start, count, members, first_row, stride, base, bound,
    table, visited_planes, survived_planes, singles, row_sum, event_sum, visited, survived, time, alive, complete_dead,
):  # fmt: skip
    words, active = np.empty(TILE, np.uint32), np.zeros(TILE, np.int32)
    rows = np.empty((first_row.shape[0], TILE), np.int32)
    scores = np.empty((FIELDS, TILE), np.uint32)
    for done in range(0, count, TILE):
        size = min(TILE, count - done)
        first = np.uint32(start + done)
        _step_rows(key0, key1, first, (members, first_row, stride), (base, bound), words, active, rows[:, :size])
        _score(rows, size, table, visited_planes, survived_planes, row_sum, event_sum, scores)
        _enter(scores, size, done, singles, visited, survived, time, alive, complete_dead)


@threaded
def _score(rows, size, table, visited_planes, survived_planes, row_sum, event_sum, scores):  # type: ignore[no-untyped-def]
    """Scores `[FIELDS, L]` of the rollouts in these rows; enters the counts by row and by joint event."""
    wide_vectors()
    count = table.shape[1] - FIELDS
    union = np.empty(count, np.uint32)
    nibbles = np.zeros((4, count), np.uint32)
    for lane in range(size):
        union[:] = 0
        visited, survived, time, alive = np.uint32(0), np.uint32(0), np.uint32(0), np.uint32(0)
        for group in range(rows.shape[0]):
            row = rows[group, lane]
            row_sum[row] += 1
            visited = np.uint32(visited + table[row, VISITED])
            survived = np.uint32(survived + table[row, SURVIVED])
            time = max(time, table[row, TIME])
            alive = np.uint32(alive + table[row, ALIVE])
            for word in range(count):
                union[word] |= table[row, FIELDS + word]
        for plane in range(visited_planes.shape[0]):
            bits = np.uint32(0)
            for word in range(count):
                bits = np.uint32(bits + popcount(union[word] & visited_planes[plane, word]))
            visited = np.uint32(visited + (bits << np.uint32(plane)))
        for plane in range(survived_planes.shape[0]):
            bits = np.uint32(0)
            for word in range(count):
                bits = np.uint32(bits + popcount(union[word] & survived_planes[plane, word]))
            survived = np.uint32(survived + (bits << np.uint32(plane)))
        scores[VISITED, lane], scores[SURVIVED, lane] = visited, survived
        scores[TIME, lane], scores[ALIVE, lane] = time, alive
        for place in range(4):
            for word in range(count):
                nibbles[place, word] += np.uint32(union[word] >> np.uint32(place)) & NIBBLES
        if lane % 15 == 14 or lane == size - 1:
            _spill(nibbles, event_sum)


@threaded
def _spill(nibbles, event_sum):  # type: ignore[no-untyped-def]
    """Adds the counters of at most 15 rollouts, four bits an event, to the events' counts and clears them."""
    for word in range(nibbles.shape[1]):
        for bit in range(32):
            event_sum[32 * word + bit] += (nibbles[bit % 4, word] >> np.uint32(bit // 4 * 4)) & np.uint32(15)
    nibbles[:] = 0


@threaded
def _enter(scores, size, done, singles, visited, survived, time, alive, complete_dead):  # type: ignore[no-untyped-def]
    """Enters a tile's scores in the histograms, and keeps them if single rollouts are wanted."""
    for lane in range(size):
        visited[scores[VISITED, lane]] += 1
        survived[scores[SURVIVED, lane]] += 1
        time[scores[TIME, lane]] += 1
        alive[scores[ALIVE, lane]] += 1
        if scores[ALIVE, lane] == 0 and scores[VISITED, lane] == visited.shape[0] - 1:
            complete_dead[0] += 1
    if singles.shape[1] > 0:
        singles[:, done : done + size] = scores[:, :size]
