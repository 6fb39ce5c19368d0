"""Arrays of the JAX engines: made of NumPy on the host, read as JAX arrays by what is traced."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = jax.Array
HostArrays: TypeAlias = dict[str, Any]
"""NumPy arrays and scalars by the names of the fields that they are for."""
STATIC = {"static": True}
"""Of fields of tables that programs are compiled for; all others are data."""
Tables = TypeVar("Tables")


def padded(values: NDArray, size: int, fill: int = 0, dtype: type = np.int32) -> NDArray:
    """`[size]` that begins with the values."""
    return np.pad(values.astype(dtype), (0, size - len(values)), constant_values=fill)


def on_host(kind: Callable[..., Tables], **fields: Any) -> Tables:
    """Tables of NumPy arrays, in the place of JAX arrays until all of them are put on a device at once."""
    return kind(**fields)
