"""Numba's compiler with the cache in the user's cache folder: `compiled` is what every compiled function here wears.

The folder is `$NUMBA_CACHE_DIR` if set, else `$XDG_CACHE_HOME/mrac-jax/numba`, else `~/.cache/mrac-jax/numba`.
`MRAC_JAX_NO_CACHE=1` in the environment (the command line's `--no-cache`) keeps nothing on disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

NO_CACHE = "MRAC_JAX_NO_CACHE"
Function = TypeVar("Function", bound=Callable[..., Any])


def cache_folder(kind: str) -> Path | None:
    """Where compiled code of this kind ("numba", "jax") is kept between runs; None when caching is turned off."""
    if os.environ.get(NO_CACHE, "") not in ("", "0"):
        return None
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "mrac-jax" / kind


def compiled(function: Function) -> Function:
    """`numba.njit` of a serial function, cached on disk unless that is turned off."""
    return _njit(function, nogil=False)


def threaded(function: Function) -> Function:
    """The same for a function that several threads may run at once: it lets go of the interpreter.

    Threads of our own, never `parallel=True`: Numba's cache confuses a function compiled both ways.
    """
    return _njit(function, nogil=True)


def _njit(function: Function, nogil: bool) -> Function:
    folder = cache_folder("numba")
    if folder is None:
        return numba.njit(nogil=nogil)(function)
    before = numba.config.CACHE_DIR
    try:
        if not before:
            folder.mkdir(parents=True, exist_ok=True)
            numba.config.CACHE_DIR = str(folder)
        return numba.njit(nogil=nogil, cache=True)(function)
    except (OSError, RuntimeError):
        return numba.njit(nogil=nogil)(function)
    finally:
        numba.config.CACHE_DIR = before
