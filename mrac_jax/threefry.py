"""Threefry-2x32 with 20 rounds in jnp: the words of `planner.threefry`, written out so that XLA fuses them away.

`jax.random` is not used: its streams are flags away from changing, and its Threefry never fuses on a CPU (a tenth of
the words a second).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from planner.threefry import KEY_PARITY, ROTATIONS


def threefry2x32(key: jax.Array, counter0: jax.Array, counter1: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Words (x0, x1) of one counter. All uint32: key `[2]` (low half of the seed first), counters and words scalars."""
    schedule = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(KEY_PARITY))
    x0, x1 = counter0 + schedule[0], counter1 + schedule[1]
    for group in range(5):
        for rotation in ROTATIONS[4 * (group % 2) : 4 * (group % 2) + 4]:
            x0 = x0 + x1
            x1 = (x1 << jnp.uint32(rotation)) | (x1 >> jnp.uint32(32 - rotation))
            x1 = x1 ^ x0
        x0 = x0 + schedule[(group + 1) % 3]
        x1 = x1 + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return x0, x1
