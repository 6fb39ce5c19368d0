"""Exposure and tolerance (`planner.tolerance`) in two words of 32 bits, the leading one first, along the last axis.

JAX has no larger whole numbers unless a whole process switches them on.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from planner.tolerance import LOGARITHMS, log_units

WORDS, WORD = 2, 32


def two_words(units: NDArray[np.int64]) -> NDArray[np.uint32]:
    """uint32 `[.., 2]` of numbers that are not negative, `[..]`."""
    return np.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(np.uint32)


def is_reached(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """Whether the exposure is as much as is left or more, bool `[..]` of `[.., 2]`."""
    more, as_much = exposure[..., 0] > left[..., 0], exposure[..., 0] == left[..., 0]
    return more | (as_much & (exposure[..., 1] >= left[..., 1]))


def less(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """What is left after an exposure that does not reach it, `[.., 2]`."""
    borrowed = (left[..., 1] < exposure[..., 1]).astype(jnp.uint32)
    return jnp.stack([left[..., 0] - exposure[..., 0] - borrowed, left[..., 1] - exposure[..., 1]], axis=-1)


def tolerance_words(word: jax.Array) -> jax.Array:
    """What robots bear, uint32 `[.., 2]`, by their random words, uint32 `[..]`: `planner.tolerance.tolerance_of`."""
    with jax.enable_x64(True):  # of what is traced here alone
        odd = 2 * word.astype(jnp.int64) + 1
        units = log_units(odd, 63 - jax.lax.clz(odd), jnp.asarray(LOGARITHMS))
        return jnp.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(jnp.uint32)
