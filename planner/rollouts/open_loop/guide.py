"""From a random word to a robot's outcome: o = how many of its thresholds lie above the word, exactly, in one read.

The thresholds fall roughly geometrically, so words are put into buckets like floating-point numbers: by the place of
the leading 1 and the bits after it. A table gives the least outcome of each bucket and, nearly always, the one
threshold inside it; where buckets hold more, a branchless bisection follows. Every comparison is of integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WORD = 2**32
MANTISSA_CHOICES = (6, 8)
"""Bits after the leading 1 that a bucket may depend on; 33 * 2**bits buckets a slot."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Inverse survival of all slots. With m = mantissa, lz = leading zeros of `x | 1`, and normal = x << lz:

        bucket = (normal >> (31 - m)) + ((31 - lz) << m)
        no bisections:  o = (table >> (31 - m)) + ((normal mod 2**(31 - m)) < (table mod 2**(31 - m)))
        else:  o = table;  for half in (2**(bisections - 1), ..., 2, 1):  if x < threshold[o + half]:  o += half

    Attributes:
        mantissa: m.
        bisections: 0 if no bucket holds two thresholds.
        table: uint32 `[S, buckets]`: the outcome of the bucket's largest word; if there are no bisections above the low
            31 - m bits of the threshold inside the bucket (0: none, no word is below).
        threshold: uint32 `[S, D + 2**bisections]`: entry o is T[o - 1], to be passed for outcome o; entry 0 and those
            after the last are 0, which no word is below.
    """

    mantissa: int
    bisections: int
    table: NDArray[np.uint32]
    threshold: NDArray[np.uint32]


def make_guide(thresholds: Sequence[NDArray[np.uint64]]) -> Guide:
    """The guide of slots with these thresholds (uint64 `[D]`, non-increasing, at most 2**32)."""
    longest = max(len(above) for above in thresholds)
    for mantissa in MANTISSA_CHOICES:
        lowest, highest = bucket_ranges(mantissa)
        least = _outcomes(thresholds, highest)
        inside = int((_outcomes(thresholds, lowest) - least).max(initial=0))
        if inside <= 1 and longest < 2 ** (mantissa + 1):
            low = _inside_bits(thresholds, least, lowest, highest, mantissa)
            return Guide(mantissa, 0, least << np.uint32(31 - mantissa) | low, np.zeros((len(least), 1), np.uint32))
    bisections = max(inside, 1).bit_length()
    table = np.zeros((len(thresholds), longest + 1 + 2**bisections), dtype=np.uint32)
    for slot, above in enumerate(thresholds):
        table[slot, 1 : len(above) + 1] = np.minimum(above, WORD - 1)  # 2**32 is never compared: `least` is past it
    return Guide(mantissa, bisections, least, table)


def bucket_ranges(mantissa: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Smallest and largest word of every bucket; a bucket that no word has (between two whole numbers) gets 0, 0."""
    count = 2**mantissa
    lowest, highest = np.zeros(33 * count, dtype=np.uint64), np.zeros(33 * count, dtype=np.uint64)
    for octave in range(32):  # words 2**octave .. 2**(octave + 1) - 1
        leading = np.arange(count, 2 * count, dtype=np.uint64)
        if octave >= mantissa:
            first = leading << np.uint64(octave - mantissa)
            last = first + np.uint64(2 ** (octave - mantissa) - 1)
        else:
            whole = leading % np.uint64(2 ** (mantissa - octave)) == 0
            first = last = np.where(whole, leading >> np.uint64(mantissa - octave), np.uint64(0))
        place = slice((octave + 1) * count, (octave + 2) * count)
        lowest[place], highest[place] = first, last
    return lowest, highest


def _outcomes(thresholds: Sequence[NDArray[np.uint64]], words: NDArray[np.uint64]) -> NDArray[np.uint32]:
    """uint32 `[S, words]`: how many thresholds of each slot lie above each word."""
    falling = [-above.astype(np.int64) for above in thresholds]
    return np.stack([np.searchsorted(above, -words.astype(np.int64), "left") for above in falling]).astype(np.uint32)


def _inside_bits(
    thresholds: Sequence[NDArray[np.uint64]],
    least: NDArray[np.uint32],
    lowest: NDArray[np.uint64],
    highest: NDArray[np.uint64],
    mantissa: int,
) -> NDArray[np.uint32]:
    """Low bits of the threshold inside each bucket, shifted as the words are; 0 where there is none."""
    octave = np.maximum(np.arange(len(lowest)) // 2**mantissa - 1, 0).astype(np.uint64)
    low = np.zeros_like(least)
    for slot, above in enumerate(thresholds):
        # The next threshold below the bucket's largest word; none is 0, which no word is below.
        following = np.append(above, np.uint64(0))[least[slot]]
        inside = (lowest < following) & (following <= highest)
        normal = (following << (np.uint64(31) - octave)) % np.uint64(2 ** (31 - mantissa))
        low[slot] = np.where(inside, normal, np.uint64(0)).astype(np.uint32)
    return low
