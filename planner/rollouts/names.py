"""The names of the back ends, apart from them: for options and checks, which import no engine."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from pkgutil import resolve_name
from typing import Any

from planner.arguments import ENGINES as ENGINES
from planner.arguments import EngineName as EngineName
from planner.arguments import argument
from planner.errors import UsageError

OF_JAX = {
    "open loop": "mrac_jax.open_loop:JaxOpenLoop",
    "closed loop": "mrac_jax.closed_loop.engine:JaxClosedLoop",
    "environment": "mrac_jax.env.area_env:make_env",
    "policy": "mrac_jax.env.area_env:PolicyRollouts",
    "accelerator": "mrac_jax.runtime:accelerator",
}
"""What the engines and the environment in JAX are asked for: their package stands above, and is known by name alone."""


def check_jax() -> None:
    """Raise UsageError where JAX was taken out to save its 390 MB: nothing but its own engine needs it on a CPU."""
    if find_spec("jax") is None:
        raise UsageError("jax is not installed", fix="pip install jax")


def of_jax(what: str) -> Any:
    """What stands under one of the names in `OF_JAX`, imported now. Raises UsageError where JAX cannot be imported."""
    if what != "accelerator":  # which imports JAX only where there may be one
        try:
            import_module("jax")
        except Exception as error:  # a flag with a wrong value, a jaxlib of another release, no JAX at all
            raise UsageError(why_not(error), fix=f"correct that, or use {argument('engine', 'numba')}") from error
    return resolve_name(OF_JAX[what])


def why_not(error: Exception) -> str:
    """Why JAX cannot run, in one line: what it raised, and the platforms that it was told to use."""
    said = " ".join(str(error).split())[:200] or f"{type(error).__name__}: no such device"
    platforms = os.environ.get("JAX_PLATFORMS", "")
    return f"JAX cannot start{f' with JAX_PLATFORMS={platforms}' if platforms else ''} ({said})"
