"""Actions and observations of an agent, named as in JaxMARL."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp


class Discrete(NamedTuple):
    """Actions 0 .. n - 1."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32


class Box(NamedTuple):
    """Arrays of a shape between two numbers."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32
