"""Who is hit: one word of Threefry for each rollout of a set, and the set parted.

Part of `planner.kernels.rollouts`, which see; the open loop draws with the same `threefry`.
"""

# Numba's integer rules turn uint32 sums into uint64: every step is cast back, and LLVM then drops the casts.

from __future__ import annotations

import numpy as np

from planner.jit import kernel, program, rare_kernel

PARITY = np.uint32(0x1BD11BDA)


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
    for index in range(len(ids)):
        words[index] = threefry(key0, key1, ids[index], counter)[0] >> np.uint32(8)
    kept = gone = 0
    for index in range(len(ids)):
        one, hit = ids[index], np.int64(words[index] < bound)
        ids[kept] = one
        words[gone] = one
        kept += 1 - hit
        gone += hit
    for index in range(gone):
        ids[kept + index] = words[index]
    return kept
