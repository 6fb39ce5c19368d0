"""Arrays of the JAX engines: made of NumPy on the host, read as JAX arrays by what is traced."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax

Array: TypeAlias = jax.Array
HostArrays: TypeAlias = dict[str, Any]
"""NumPy arrays and scalars by the names of the fields that they are for."""
STATIC = {"static": True}
"""Of fields of tables that programs are compiled for; all others are data."""
Tables = TypeVar("Tables")


def on_host(kind: Callable[..., Tables], **fields: Any) -> Tables:
    """Tables of NumPy arrays, in the place of JAX arrays until all of them are put on a device at once."""
    return kind(**fields)
