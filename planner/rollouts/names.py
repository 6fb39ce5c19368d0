"""The names of the back ends, apart from them: for options and checks, which import no engine."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal, get_args

from planner.errors import UsageError

EngineName = Literal["auto", "jax", "numba"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)


def check_jax() -> None:
    """Raise UsageError where JAX was taken out to save its 390 MB: nothing but its own engine needs it on a CPU."""
    if find_spec("jax") is None:
        raise UsageError("jax is not installed", fix="pip install jax")
