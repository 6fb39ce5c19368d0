"""Who is hit: one word of Threefry for each rollout of a set, and the set parted.

Part of `planner.kernels.rollouts`, which see; the open loop draws with the same `threefry`.
"""

# Numba's integer rules turn uint32 sums into uint64: every step is cast back, and LLVM then drops the casts.

from __future__ import annotations

import numpy as np

from planner.jit import kernel, program, rare_kernel
from planner.kernels.lanes import GROUP, PARITY, part_lanes

MANY, SOME = (0,) * (4 * GROUP), (0,) * GROUP
"""As many lanes as keep a core busy, and as few as are worth it."""


@kernel
def _round(x0, x1, rotation):
    x0 = np.uint32(x0 + x1)
    x1 = np.uint32(np.uint32(x1 << np.uint32(rotation)) | np.uint32(x1 >> np.uint32(32 - rotation)))
    return x0, np.uint32(x1 ^ x0)


@kernel
def _first_rounds(x0, x1):
    x0, x1 = _round(x0, x1, 13)
    x0, x1 = _round(x0, x1, 15)
    x0, x1 = _round(x0, x1, 26)
    return _round(x0, x1, 6)


@kernel
def _second_rounds(x0, x1):
    x0, x1 = _round(x0, x1, 17)
    x0, x1 = _round(x0, x1, 29)
    x0, x1 = _round(x0, x1, 16)
    return _round(x0, x1, 24)


@program
def threefry(key0, key1, counter0, counter1):
    """Words (x0, x1) of Threefry-2x32-20; every argument and both words uint32. Equal to `planner.threefry`."""
    key2 = np.uint32(np.uint32(key0 ^ key1) ^ PARITY)
    x0, x1 = _first_rounds(np.uint32(counter0 + key0), np.uint32(counter1 + key1))
    x0, x1 = _second_rounds(np.uint32(x0 + key1), np.uint32(np.uint32(x1 + key2) + np.uint32(1)))
    x0, x1 = _first_rounds(np.uint32(x0 + key2), np.uint32(np.uint32(x1 + key0) + np.uint32(2)))
    x0, x1 = _second_rounds(np.uint32(x0 + key0), np.uint32(np.uint32(x1 + key1) + np.uint32(3)))
    x0, x1 = _first_rounds(np.uint32(x0 + key1), np.uint32(np.uint32(x1 + key2) + np.uint32(4)))
    return np.uint32(x0 + key2), np.uint32(np.uint32(x1 + key0) + np.uint32(5))


@kernel
def part(ids, words, how, first, last, counter, bound):
    """Part `ids[first:last]` in place, who is not hit first, both in their order; returns where the hit ones begin."""
    if last - first == 1:
        return first if threefry(how.key0, how.key1, ids[first], counter)[0] >> np.uint32(8) < bound else last
    return first + part_many(ids[first:last], words[: last - first], how.key0, how.key1, counter, bound)


@rare_kernel
def part_many(ids, words, key0, key1, counter, bound):
    """The same for all of `ids` `[B]`, with scratch like it."""
    at, gone = _part_by(ids, words, 0, 0, (key0, key1), counter, bound, MANY)
    at, gone = _part_by(ids, words, at, gone, (key0, key1), counter, bound, SOME)
    for index in range(at, len(ids)):
        one = ids[index]
        ids[index - gone], words[gone] = one, one
        gone += np.int64(threefry(key0, key1, one, counter)[0] >> np.uint32(8) < bound)
    return _join(ids, words, gone)


@kernel
def _part_by(ids, words, at, gone, keys, counter, bound, lanes):
    """`part_lanes` from `at` on for as long as there are so many; where it ends, and how many are hit by then."""
    while at + len(lanes) <= len(ids):
        gone += part_lanes(ids, words, at, gone, keys, counter, bound, lanes)
        at += len(lanes)
    return at, gone


@rare_kernel
def part_in_doubt(t, ids, words, how, first, last, counter, cell):
    """`part` where what is true of the cell is drawn for each rollout too: see `planner.worlds.doubt.Draws`."""
    mine, room = ids[first:last], words[: last - first]
    for index in range(len(mine)):
        word = threefry(how.key0, how.key1, mine[index], counter)[0] >> np.uint32(8)
        room[index] = word >= bound_in_doubt(t, how, mine[index], cell)
    return first + _split(mine, room, 1)


@kernel
def bound_in_doubt(t, how, rollout, cell):
    """Below which bound a visit's 24 bits stop the robot, as the cell is in this rollout."""
    word = threefry(how.own0, how.own1, rollout, t.own_counter[cell])[0] >> np.uint32(8)
    if len(t.table) > 0:
        return t.table[np.int64(word) * len(t.table) >> 24, t.column[cell]]
    return t.bound[cell] if word < t.there[cell] else np.uint32(0)


@kernel
def _split(ids, words, bound):
    """Part `ids` by which of `words`, which become scratch, are below the bound; returns how many are not."""
    gone = 0
    for index in range(len(ids)):
        one, hit = ids[index], np.int64(words[index] < bound)
        ids[index - gone] = one
        words[gone] = one
        gone += hit
    return _join(ids, words, gone)


@kernel
def _join(ids, words, gone):
    """Put those who are hit, the first `gone` of `words`, behind the others; returns how many the others are."""
    kept = len(ids) - gone
    for index in range(gone):
        ids[kept + index] = words[index]
    return kept
