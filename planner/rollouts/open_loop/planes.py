"""Weights of events as bit planes, which both engines of the open loop add up: as many as a word has bits at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.rollouts.open_loop.events import WORD_BITS


def weight_planes(weight: NDArray[np.int64], words: int, planes: int) -> NDArray[np.uint32]:
    """uint32 `[planes, W]`: bit e % 32 of word e // 32 of plane p = bit p of the weight of event e."""
    padded = np.zeros(words * WORD_BITS, dtype=np.int64)
    padded[: len(weight)] = weight
    bits = (padded[None, :] >> np.arange(planes)[:, None]) & 1
    return (bits.reshape(planes, words, WORD_BITS) << np.arange(WORD_BITS)).sum(axis=2).astype(np.uint32)


def plane_count(weight: NDArray[np.int64]) -> int:
    """Planes that hold every weight, at least 1."""
    return max(1, int(weight.max(initial=0)).bit_length())
