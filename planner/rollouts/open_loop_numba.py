"""The open loop in Numba: draws, scores and counts of tiles of rollouts, in wide vectors."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from planner.failure_model import own_key, threshold_key
from planner.rollouts.open_loop import (
    CompiledPlan,
    OpenLoopTables,
    RangeCounts,
    available_cores,
    outcomes_of,
    plane_count,
    share_out,
    weight_planes,
    words_of,
)
from planner.simulator.failure_sampling import exp1_threshold, hazard_in_state, threefry
from planner.simulator.jit import program, rare_kernel
from planner.simulator.state import leading_zeros, popcount
from planner.simulator.thresholds import exp1_hazard
from planner.tally import RolloutResults

WIDEST = '"prefer-vector-width"="512"'


@intrinsic
def wide_vectors(typing_context: Any) -> Any:
    """Let LLVM use 512-bit vectors in the calling function (its default is 256 bits); to be called first.

    The function is not inlined, since its callers lack the attribute. Gives 1.5 times the random words per second with
    AVX-512; no effect on other machines.
    """

    def add_attribute(_context: Any, builder: Any, _signature: Any, _args: Any) -> Any:
        set.add(builder.function.attributes, WIDEST)
        builder.function.attributes.add("noinline")
        return _context.get_dummy_value()

    return types.none(), add_attribute


@intrinsic
def or_words(typing_context: Any, into: Any, into_at: Any, of: Any, of_at: Any, block: Any) -> Any:
    """`into[into_at + j] |= of[of_at + j]` for j below the length of the tuple `block`, as one vector operation.

    `into` and `of` are flat contiguous uint32 arrays; indices are not checked. A loop would stay scalar: LLVM cannot
    know that the arrays do not overlap.
    """
    words = len(block)

    def combine(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.IntType(32), words)

        def pointer(place: int) -> Any:
            data = context.make_array(signature.args[place])(context, builder, args[place]).data
            return builder.bitcast(builder.gep(data, [args[place + 1]]), vector.as_pointer())

        target = pointer(0)
        joined = builder.or_(builder.load(target, align=4), builder.load(pointer(2), align=4))
        builder.store(joined, target, align=4)
        return context.get_dummy_value()

    return types.none(into, types.int64, of, types.int64, block), combine


# Draws: the row of every group of robots in every rollout of a tile.


@rare_kernel
def drawn_once_rows(key, first, draw, words, rows):  # type: ignore[no-untyped-def]
    """Rows of the rollouts from id `first` on, by inverse survival of one word per slot.

    Args:
        key: two uint32 halves.
        first: uint32, first id.
        draw: of `draw_arguments`.
        words: uint32 `[L]`, scratch.
        rows: int32 `[G, L]`, the result.
    """
    members, first_row, stride, counter, mantissa, bisections, table, threshold = draw
    for group in range(rows.shape[0]):
        rows[group, :] = first_row[group]
        for member in range(members):
            slot = group * members + member
            _words(key[0], key[1], first, counter[slot], words)
            step = np.int32(stride[group, member])
            if bisections == 0:
                _add_packed(words, table[slot], np.uint32(31 - mantissa), step, rows[group])
            else:
                _add_bisected(
                    words, table[slot], threshold[slot], np.uint32(31 - mantissa), bisections, step, rows[group]
                )


@rare_kernel
def _words(key0, key1, first, counter, words):  # type: ignore[no-untyped-def]
    """The first Threefry words of the counters."""
    wide_vectors()
    for lane in range(words.shape[0]):
        words[lane] = threefry(key0, key1, np.uint32(first + np.uint32(lane)), counter)[0]


@rare_kernel
def _add_packed(words, table, low_bits, step, rows):  # type: ignore[no-untyped-def]
    """Add step * outcome to the rows, with one read of the guide (formula: `Guide`)."""
    wide_vectors()
    low = np.uint32(np.uint32(1) << low_bits) - np.uint32(1)
    for lane in range(words.shape[0]):
        zeros = leading_zeros(np.uint32(words[lane] | np.uint32(1)))
        normal = np.uint32(words[lane] << zeros)
        octave = np.uint32(np.uint32(31) - zeros)
        bucket = np.uint32(np.uint32(normal >> low_bits) + np.uint32(octave << np.uint32(np.uint32(31) - low_bits)))
        found = table[bucket]
        above = np.int32(np.uint32(normal & np.uint32(low)) < np.uint32(found & np.uint32(low)))
        rows[lane] += np.int32(np.int32(np.int32(found >> low_bits) + above) * step)


@rare_kernel
def _add_bisected(words, table, threshold, low_bits, bisections, step, rows):  # type: ignore[no-untyped-def]
    """The same if buckets hold several thresholds."""
    for lane in range(words.shape[0]):
        zeros = leading_zeros(np.uint32(words[lane] | np.uint32(1)))
        octave = np.uint32(np.uint32(31) - zeros)
        bucket = (np.uint32(words[lane] << zeros) >> low_bits) + (octave << np.uint32(np.uint32(31) - low_bits))
        outcome = np.int64(table[bucket])
        half = 1 << (bisections - 1)
        while half > 0:
            if words[lane] < threshold[outcome + half]:
                outcome += half
            half >>= 1
        rows[lane] += np.int32(outcome * step)


@rare_kernel
def joint_rows(key, own, first, size, draw, alive, hazard, spent, rows):  # type: ignore[no-untyped-def]
    """Rows of `size` rollouts from id `first` on, entry by entry of all robots (`joint_draws`).

    Args:
        key, own: two uint32 halves each, of thresholds and of uncertain cells.
        first: uint32, first id.
        draw: of `draw_arguments`.
        alive: bool `[S]`; hazard: int64 `[S]`; spent: bool `[cells]`: scratch; no cells: none becomes harmless.
        rows: int32 `[G, L]`, the result.
    """
    members, first_row, stride, entry, exposure, doses, (robot, nodes, times), last = draw
    slots, places, own_counters, theres, columns, spots = entry
    for lane in range(size):
        rollout = np.uint32(first + np.uint32(lane))
        alive[:], spent[:], hazard[:] = True, False, 0
        for group in range(rows.shape[0]):
            rows[group, lane] = first_row[group]
            for member in range(members):
                rows[group, lane] += np.int32(stride[group, member] * last[group * members + member])
        for number in range(len(slots)):
            slot = slots[number]
            # In the order of the run: a threat that destroyed an earlier robot may be spent.
            if not alive[slot] or (len(spent) > 0 and spent[spots[number]]):
                continue
            word = np.int64(threefry(own[0], own[1], rollout, own_counters[number])[0] >> np.uint32(8))
            hazard[slot] += hazard_in_state(exposure, doses, theres, columns, number, word)
            reached = exp1_hazard(hazard[slot], nodes, times[slot])
            if reached >= exp1_threshold(threefry(key[0], key[1], rollout, robot[slot])[0]):
                alive[slot] = False
                group, member = slot // members, slot % members
                rows[group, lane] -= np.int32(stride[group, member] * (last[slot] - places[number]))
                if len(spent) > 0:
                    spent[spots[number]] = True


# Scores and counts: from the rows of a tile to histograms and event counts.
#
# `L` rollouts of a tile, `V` words in a block: the words of a row are in blocks that fill vector registers.

VISITED, SURVIVED, TIME, ALIVE, SCORES = range(5)
"""Rows of the array of single rollouts' scores."""
TWO, EIGHT, SIXTEEN = ((0,) * size for size in (2, 8, 16))
"""Words in a block, as tuples: their lengths are compile-time constants."""
BLOCK_WORDS = tuple(map(len, (TWO, EIGHT, SIXTEEN)))
MOST_TILE, LEAST_TILE = 1024, 128
TILE_WORDS = 2**15
"""Event words of a tile: they fit into a core's caches."""
PLANES_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class Scoring:
    """Arguments of `score_tile`.

    Attributes:
        tile: L, a multiple of 128.
        words: of a row, padded to whole blocks. columns: int64 `[W]`, index of each of the plan's words in it.
        arguments: cells uint64 `[R]` (visited + 2**32 * survived), moves uint32 `[R]` (4 * time + alive), bits uint32
            `[R, words]`, extent int32 `[R, 4]` (two ranges of blocks in which the row has bits), planes: two uint32
            `[planes, leading words]`, and V, one of BLOCK_WORDS.
    """

    tile: int
    words: int
    columns: NDArray[np.int64]
    arguments: tuple[Any, ...]

    def event_counts(self, by_bit: NDArray[np.int64]) -> NDArray[np.int64]:
        """Counts by the plan's event bits from counts by the padded row's bits, both int64 `[bits]`."""
        return by_bit.reshape(self.words, 32)[self.columns].reshape(-1)


def make_scoring(tables: OpenLoopTables) -> Scoring:
    """The tables in the form of the kernels: words in blocks, those with weights first if there are many."""
    events = tables.events
    rows, words = events.bits.shape
    block = next((size for size in BLOCK_WORDS if size >= words), BLOCK_WORDS[-1])
    weighted = events.weighted_words if words > block else words
    lead = -(-weighted // block) * block
    columns = np.concatenate([np.arange(weighted), lead + np.arange(words - weighted)]).astype(np.int64)
    padded = lead + -(-(words - weighted) // block) * block
    bits = np.zeros((rows, padded), dtype=np.uint32)
    bits[:, columns] = events.bits
    planes = max(plane_count(events.visited_weight), plane_count(events.survived_weight))
    planes = -(-planes // PLANES_AT_ONCE) * PLANES_AT_ONCE
    both = [weight_planes(w, words, planes) for w in (events.visited_weight, events.survived_weight)]
    shown = tuple(np.ascontiguousarray(plane[:, : events.weighted_words]) for plane in both)
    cells = events.own_visited.astype(np.uint64) | events.own_survived.astype(np.uint64) << np.uint64(32)
    moves = (4 * tables.time + tables.alive).astype(np.uint32)
    tile = min(MOST_TILE, max(LEAST_TILE, TILE_WORDS // max(padded, 1) // LEAST_TILE * LEAST_TILE))
    arguments = (cells, moves, bits, _extents(bits, lead, block), *shown, block)
    return Scoring(tile, padded, columns, arguments)


def _extents(bits: NDArray[np.uint32], lead: int, block: int) -> NDArray[np.int32]:
    """int32 `[R, 4]`: (start, stop) in blocks of the row's bits among the leading words, and among the others."""
    used = (bits != 0).reshape(len(bits), -1, block).any(axis=2)
    split = lead // block
    parts = []
    for start, part in ((0, used[:, :split]), (split, used[:, split:])):
        length = part.shape[1]
        stop = length - np.argmax(part[:, ::-1], axis=1) if length else np.zeros(len(bits), dtype=np.int64)
        stop = np.where(part.any(axis=1), stop, 0) if length else stop
        parts += [np.full(len(bits), start), start + stop]
    return np.stack(parts, axis=1).astype(np.int32)


def work_arrays(tile: int, words: int) -> tuple[NDArray, ...]:
    """Scratch of a tile: cells, joint visited and survived, time, alive `[L]`, event words `[L * words]`, their sums.

    Args:
        tile: L.
        words: of a padded row.
    """
    by_lane = (np.empty(tile, kind) for kind in (np.uint64, *[np.uint32] * 4))
    sums = ((size, tile // lanes * words) for size, lanes in ((4, 8), (8, 128)))
    return (*by_lane, np.zeros(tile * words, np.uint32), *(np.empty(shape, np.uint32) for shape in sums))


@rare_kernel
def score_tile(rows, size, scoring, work, done, singles, sums):  # type: ignore[no-untyped-def]
    """Score the first `size` rollouts of a tile, and add them to the sums.

    Args:
        rows: int32 `[G, L]`, of the draws.
        size: rollouts.
        scoring: `Scoring.arguments`.
        work: of `work_arrays`.
        done: index of the tile's first rollout in `singles`.
        singles: uint32 `[SCORES, rollouts]`, filled in unless empty.
        sums: int64 counts, in the order of `RangeCounts`.
    """
    cells_table, moves_table, bits, extent, visited_planes, survived_planes, block = scoring
    cells, visited, survived, time, alive, union, nibbles, octets = work
    row_sum, event_sum, visited_sum, survived_sum, time_sum, alive_sum, complete_dead = sums
    cells[:], time[:], alive[:] = 0, 0, 0
    for group in range(rows.shape[0]):
        _count_rows(rows[group, :size], row_sum)
        _add_fields(rows[group], size, cells_table, moves_table, cells, time, alive)
    words = bits.shape[1]
    if words > 0:
        union[:] = 0
        flat = bits.reshape(-1)
        for group in range(rows.shape[0]):
            if block == len(TWO):
                _unite(rows[group, :size], flat, words, extent, TWO, union)
            elif block == len(EIGHT):
                _unite(rows[group, :size], flat, words, extent, EIGHT, union)
            else:
                _unite(rows[group, :size], flat, words, extent, SIXTEEN, union)
        visited[:], survived[:] = 0, 0
        for plane in range(0, visited_planes.shape[0], PLANES_AT_ONCE):
            if words == block:
                for word in range(visited_planes.shape[1]):
                    _weigh_word(union, words, word, plane, visited_planes, survived_planes, visited, survived)
            else:
                _weigh_rows(union, words, plane, visited_planes, survived_planes, visited, survived)
        for lane in range(size):
            cells[lane] += np.uint64(visited[lane]) | np.uint64(survived[lane]) << np.uint64(32)
        _count_events(union, words, nibbles, octets, event_sum)
    full = visited_sum.shape[0] - 1
    for lane in range(size):
        covered = np.uint32(cells[lane])
        visited_sum[covered] += 1
        survived_sum[np.uint32(cells[lane] >> np.uint64(32))] += 1
        time_sum[time[lane]] += 1
        alive_sum[alive[lane]] += 1
        complete_dead[0] += (covered == full) & (alive[lane] == 0)
    if singles.shape[1] > 0:
        for lane in range(size):
            singles[VISITED, done + lane] = np.uint32(cells[lane])
            singles[SURVIVED, done + lane] = np.uint32(cells[lane] >> np.uint64(32))
            singles[TIME, done + lane] = time[lane]
            singles[ALIVE, done + lane] = alive[lane]


@rare_kernel
def _count_rows(rows, row_sum):  # type: ignore[no-untyped-def]
    for lane in range(rows.shape[0]):
        row_sum[np.uint32(rows[lane])] += 1


@rare_kernel
def _add_fields(rows, size, cells_table, moves_table, cells, time, alive):  # type: ignore[no-untyped-def]
    wide_vectors()
    for lane in range(size):
        cells[lane] += cells_table[np.uint32(rows[lane])]
    for lane in range(size):
        moves = moves_table[np.uint32(rows[lane])]
        time[lane] = max(time[lane], np.uint32(moves >> np.uint32(2)))
        alive[lane] = np.uint32(alive[lane] + np.uint32(moves & np.uint32(3)))


@rare_kernel
def _unite(rows, bits, words, extent, block, union):  # type: ignore[no-untyped-def]
    """OR the bits of one group's rows into the event words of the tile, both flat; empty blocks are skipped."""
    if words == len(block):
        for lane in range(rows.shape[0]):
            or_words(union, lane * len(block), bits, np.int64(rows[lane]) * len(block), block)
        return
    for lane in range(rows.shape[0]):
        row = np.uint32(rows[lane])
        into, of = lane * words, np.int64(rows[lane]) * words
        for place in range(extent[row, 0], extent[row, 1]):
            or_words(union, into + place * len(block), bits, of + place * len(block), block)
        for place in range(extent[row, 2], extent[row, 3]):
            or_words(union, into + place * len(block), bits, of + place * len(block), block)


@rare_kernel
def _weigh_word(union, words, word, plane, visited_planes, survived_planes, visited, survived):  # type: ignore[no-untyped-def]
    """Add the weights of the events in one word, four bit planes at a time, to every rollout's cells."""
    wide_vectors()
    seen, passed = visited_planes[plane : plane + 4, word], survived_planes[plane : plane + 4, word]
    seen0, seen1, seen2, seen3 = seen[0], seen[1], seen[2], seen[3]
    passed0, passed1, passed2, passed3 = passed[0], passed[1], passed[2], passed[3]
    for lane in range(visited.shape[0]):
        bits = union[lane * words + word]
        low = np.uint32(popcount(bits & seen0) + np.uint32(popcount(bits & seen1) << np.uint32(1)))
        high = np.uint32(popcount(bits & seen2) + np.uint32(popcount(bits & seen3) << np.uint32(1)))
        visited[lane] += np.uint32(np.uint32(low + np.uint32(high << np.uint32(2))) << np.uint32(plane))
        low = np.uint32(popcount(bits & passed0) + np.uint32(popcount(bits & passed1) << np.uint32(1)))
        high = np.uint32(popcount(bits & passed2) + np.uint32(popcount(bits & passed3) << np.uint32(1)))
        survived[lane] += np.uint32(np.uint32(low + np.uint32(high << np.uint32(2))) << np.uint32(plane))


@rare_kernel
def _weigh_rows(union, words, plane, visited_planes, survived_planes, visited, survived):  # type: ignore[no-untyped-def]
    """The same for all leading words of rows of several blocks, rollout by rollout."""
    wide_vectors()
    lead = visited_planes.shape[1]
    for lane in range(visited.shape[0]):
        bits = union[lane * words : lane * words + lead]
        for offset in range(PLANES_AT_ONCE):
            seen, passed = visited_planes[plane + offset], survived_planes[plane + offset]
            total, other = np.uint32(0), np.uint32(0)
            for word in range(lead):
                total = np.uint32(total + popcount(bits[word] & seen[word]))
                other = np.uint32(other + popcount(bits[word] & passed[word]))
            visited[lane] += np.uint32(total << np.uint32(plane + offset))
            survived[lane] += np.uint32(other << np.uint32(plane + offset))


@rare_kernel
def _count_events(union, words, nibbles, octets, event_sum):  # type: ignore[no-untyped-def]
    """Count the tile's rollouts with each event bit; sums in fields of 4, then 8, then 64 bits."""
    wide_vectors()
    eighth, part = nibbles.shape[1], octets.shape[1]
    mask = np.uint32(0x11111111)
    for word in range(eighth):
        total0, total1, total2, total3 = np.uint32(0), np.uint32(0), np.uint32(0), np.uint32(0)
        for slab in range(8):
            bits = union[slab * eighth + word]
            total0 = np.uint32(total0 + np.uint32(bits & mask))
            total1 = np.uint32(total1 + np.uint32(np.uint32(bits >> np.uint32(1)) & mask))
            total2 = np.uint32(total2 + np.uint32(np.uint32(bits >> np.uint32(2)) & mask))
            total3 = np.uint32(total3 + np.uint32(np.uint32(bits >> np.uint32(3)) & mask))
        nibbles[0, word], nibbles[1, word], nibbles[2, word], nibbles[3, word] = total0, total1, total2, total3
    for place in range(4):
        for word in range(part):
            low, high = np.uint32(0), np.uint32(0)
            for slab in range(16):
                bits = nibbles[place, slab * part + word]
                low = np.uint32(low + np.uint32(bits & np.uint32(0x0F0F0F0F)))
                high = np.uint32(high + np.uint32(np.uint32(bits >> np.uint32(4)) & np.uint32(0x0F0F0F0F)))
            octets[place, word], octets[4 + place, word] = low, high
    for field in range(8):
        for word in range(part):
            bits = octets[field, word]
            for octet in range(4):
                event_sum[word % words * 32 + 8 * octet + field] += (bits >> np.uint32(8 * octet)) & np.uint32(255)


# Tiles of rollouts, with a part of the ids for each thread.
#
# A tile goes through passes, each a loop over its rollouts that LLVM vectorises: random words and the row of every
# group, then scores, event counts and histograms.


class NumbaOpenLoop:
    """The kernel (`open_loop.MakeKernel`) of one plan and seed on Numba.

    Args:
        compiled: the plan.
        seed: of the random numbers.
        threads: None: all cores.
    """

    def __init__(self, compiled: CompiledPlan, seed: int, threads: int | None = None) -> None:
        self.compiled = compiled
        self.tables = compiled.tables
        self.threads = threads or available_cores()
        self._key = tuple(np.uint32(half) for half in threshold_key(seed))
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
        """The results of each of these rollouts."""
        singles = np.zeros((SCORES, count), dtype=np.uint32)
        if count:
            self._part(start, count, singles)
        visited, survived, time, alive = singles.astype(np.int32)
        outcome = outcomes_of(visited, alive, self.compiled.accessible)
        return RolloutResults(start, visited, survived, time, alive, outcome)

    def _part(self, start: int, count: int, singles: NDArray[np.uint32] | None = None) -> tuple[NDArray[np.int64], ...]:
        """One thread's counts; `singles`, uint32 `[SCORES, count]`, is filled in unless None."""
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


def draw_arguments(tables: OpenLoopTables) -> tuple[Any, ...]:
    """The argument `draw` of `drawn_once_rows` or `joint_rows`."""
    groups = tables.groups
    place = (groups.members, groups.first_row.astype(np.int32), groups.stride.astype(np.int32))
    if tables.joint is not None:
        *entry, exposure, doses, robot, nodes, times, last, _ = tables.joint
        return (*place, tuple(entry), exposure, doses, (robot, nodes, times), last)
    guide = tables.guide
    assert guide is not None  # there is one of the two
    return (*place, words_of(groups), guide.mantissa, guide.bisections, guide.table, guide.threshold)


@program
def _count_drawn_once(key, start, count, draw, words, rows, scoring, work, singles, sums):  # type: ignore[no-untyped-def]
    tile = rows.shape[1]
    for done in range(0, count, tile):
        drawn_once_rows(key, np.uint32(start + done), draw, words, rows)
        score_tile(rows, min(tile, count - done), scoring, work, done, singles, sums)


@program
def _count_joint(key, own, start, count, draw, alive, hazard, spent, rows, scoring, work, singles, sums):  # type: ignore[no-untyped-def]
    tile = rows.shape[1]
    for done in range(0, count, tile):
        size = min(tile, count - done)
        joint_rows(key, own, np.uint32(start + done), size, draw, alive, hazard, spent, rows)
        score_tile(rows, size, scoring, work, done, singles, sums)
