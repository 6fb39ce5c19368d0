"""Names of the back ends, in a module that imports no engine: for options and checks."""

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
"""Engines and environment in JAX, as names: `mrac_jax` imports this package, so this package cannot import it."""


def check_jax() -> None:
    """Check that JAX is installed; it may be left out (390 MB), since only its engines need it.

    Raises:
        UsageError: JAX is not installed.
    """
    if find_spec("jax") is None:
        raise UsageError("jax is not installed", fix="pip install jax")


def of_jax(what: str) -> Any:
    """Import one of the objects in `OF_JAX`.

    Args:
        what: its key.

    Raises:
        UsageError: JAX cannot be imported.
    """
    if what != "accelerator":  # it imports JAX only if there may be an accelerator
        try:
            import_module("jax")
        except Exception as error:  # a wrong flag, a jaxlib of another release, no JAX at all
            raise UsageError(why_not(error), fix=f"correct that, or use {argument('engine', 'numba')}") from error
    return resolve_name(OF_JAX[what])


def why_not(error: Exception) -> str:
    """One line on why JAX cannot run: the error and the platforms requested."""
    said = " ".join(str(error).split())[:200] or f"{type(error).__name__}: no such device"
    platforms = os.environ.get("JAX_PLATFORMS", "")
    return f"JAX cannot start{f' with JAX_PLATFORMS={platforms}' if platforms else ''} ({said})"
