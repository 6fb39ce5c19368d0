"""Threefry-2x32 with 20 rounds (Salmon et al. 2011), the project's one source of randomness, in NumPy.

A draw is addressed by (seed, rollout, step, robot), so it never depends on what was drawn before (SPEC section 6).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROTATIONS = (13, 15, 26, 6, 17, 29, 16, 24)
KEY_PARITY = 0x1BD11BDA
ROBOT_STRIDE = 1024
"""Robots that one step's counters hold: counter = (rollout, step * ROBOT_STRIDE + robot)."""
FAST_COUNTER = 2**32 - 1
"""The fast open loop draws word x1 of counter (rollout, FAST_COUNTER - robot)."""
OWN_KEYS = 0x48415A44
"""First counter word of the keys for hazards and maps."""


def threefry2x32(
    key: tuple[int, int], counter0: ArrayLike, counter1: ArrayLike
) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Words (x0, x1), uint32, of the counters (uint32, broadcast together) under `key` (two 32-bit halves)."""
    key0, key1 = np.uint32(key[0]), np.uint32(key[1])
    schedule = (key0, key1, key0 ^ key1 ^ np.uint32(KEY_PARITY))
    with np.errstate(over="ignore"):
        x0, x1 = np.broadcast_arrays(np.asarray(counter0, np.uint32), np.asarray(counter1, np.uint32))
        x0, x1 = x0 + schedule[0], x1 + schedule[1]
        for group in range(5):
            for rotation in ROTATIONS[4 * (group % 2) : 4 * (group % 2) + 4]:
                x0 = x0 + x1
                x1 = (x1 << np.uint32(rotation)) | (x1 >> np.uint32(32 - rotation))
                x1 = x1 ^ x0
            x0 = x0 + schedule[(group + 1) % 3]
            x1 = x1 + schedule[(group + 2) % 3] + np.uint32(group + 1)
    return x0, x1


def key_of(seed: int) -> tuple[int, int]:
    """The generator's key: the two 32-bit halves of a seed `0 <= seed < 2**64`, low first."""
    return seed & 0xFFFFFFFF, seed >> 32


@lru_cache
def own_key(seed: int, purpose: int) -> tuple[int, int]:
    """The key of the numbers that say what is true in a rollout (SPEC section 13): one for hazards, one for maps."""
    x0, x1 = threefry2x32(key_of(seed), OWN_KEYS, purpose)
    return int(x0), int(x1)


def uniform(seed: int, rollout: ArrayLike, step: ArrayLike, robot: ArrayLike) -> NDArray[np.float32]:
    """u(r, t, i) in [0, 1), float32: robot i entering a cell of threat p at step t is stopped iff u < p."""
    counter1 = np.asarray(step, np.uint32) * np.uint32(ROBOT_STRIDE) + np.asarray(robot, np.uint32)
    x0, _ = threefry2x32(key_of(seed), np.asarray(rollout, np.uint32), counter1)
    return (x0 >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)
