"""From a random word to a robot's outcome: o = how many of its thresholds lie above the word, exactly, in a few reads.

The thresholds fall roughly geometrically, so words are put into buckets like floating-point numbers: the leading bits
of float32(word). A table gives the least outcome of each bucket, and a branchless bisection over the thresholds that
fall inside a bucket (none or one, nearly always) gives the rest: every comparison is of integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WORD = 2**32
MANTISSA_CHOICES = (4, 5, 6, 7, 8)
"""Leading bits after the first 1 that a bucket may depend on; 32 * 2**bits + 2 buckets a slot."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Inverse survival of all slots. `bucket = max((bits of float32(x) >> shift) - offset, 0)`; then

        o = least[s, bucket];  for half in (2**(steps - 1), ..., 2, 1):  o += half  if  x < threshold[s, o + half]

    Attributes:
        shift, offset: of the bucket's formula.
        steps: rounds of bisection.
        least: int32 `[S, buckets]`, outcome of the largest word of the bucket.
        threshold: uint32 `[S, D + 2**steps]`: entry o is T[o - 1], passed to reach outcome o; entry 0 and those after
            the last are 0, which no word is below.
    """

    shift: int
    offset: int
    steps: int
    least: NDArray[np.int32]
    threshold: NDArray[np.uint32]


def make_guide(thresholds: Sequence[NDArray[np.uint64]]) -> Guide:
    """The guide of slots with these thresholds (uint64 `[D]`, non-increasing, at most 2**32).

    Takes the fewest buckets for which one comparison is enough, else the most buckets and as many steps as needed.
    """
    for mantissa in MANTISSA_CHOICES:
        lowest, highest = _bucket_ranges(mantissa)
        least, inside = _outcomes(thresholds, highest), 0
        most = _outcomes(thresholds, lowest)
        inside = int((most - least).max(initial=0))
        if inside <= 1:
            break
    steps = max(1, int(inside).bit_length())
    longest = max(len(t) for t in thresholds)
    table = np.zeros((len(thresholds), longest + 1 + 2**steps), dtype=np.uint32)
    for slot, above in enumerate(thresholds):
        table[slot, 1 : len(above) + 1] = np.minimum(above, WORD - 1)  # 2**32 is never compared: `least` passed it
    return Guide(23 - mantissa, (127 << mantissa) - 1, steps, least, table)


def buckets_of(words: NDArray[np.uint32], shift: int, offset: int) -> NDArray[np.int64]:
    """The bucket of each word; monotone in the word."""
    bits = words.astype(np.float32).view(np.uint32) >> np.uint32(shift)
    return np.maximum(bits.astype(np.int64) - offset, 0)


def _outcomes(thresholds: Sequence[NDArray[np.uint64]], words: NDArray[np.uint64]) -> NDArray[np.int32]:
    """int32 `[S, words]`: how many thresholds of each slot lie above each word."""
    return np.stack([np.searchsorted(-t.astype(np.int64), -words.astype(np.int64), "left") for t in thresholds]).astype(
        np.int32
    )


def _bucket_ranges(mantissa: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Smallest and largest word of every bucket (of an empty bucket: the next one's smallest, twice)."""
    count = 32 * 2**mantissa + 2
    wanted = np.arange(count + 1)
    low, high = np.zeros(count + 1, dtype=np.uint64), np.full(count + 1, WORD, dtype=np.uint64)
    for _ in range(33):  # least word whose bucket is at least `wanted`, by bisection; 2**32 if there is none
        middle = (low + high) // np.uint64(2)
        words = np.minimum(middle, WORD - 1).astype(np.uint32)
        reached = (buckets_of(words, 23 - mantissa, (127 << mantissa) - 1) >= wanted) | (middle >= WORD)
        low, high = np.where(reached, low, middle + np.uint64(1)), np.where(reached, middle, high)
    start = np.minimum(high[:-1], WORD - 1)
    return start, np.maximum(high[1:] - np.uint64(1), start)
