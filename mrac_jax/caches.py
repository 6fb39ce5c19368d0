"""Where compiled code is kept between runs, for both engines; the folders and the switch are those of `planner.jit`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

from planner.jit import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])


def threaded(function: Function) -> Function:
    """`numba.njit` of a function that several threads may run at once (it lets go of the interpreter), cached on disk.

    Threads of our own, never `parallel=True`: Numba's cache confuses a function compiled both ways.
    """
    folder = cache_folder("numba")
    if folder is None:
        return numba.njit(nogil=True)(function)
    before = numba.config.CACHE_DIR
    try:
        if not before:
            folder.mkdir(parents=True, exist_ok=True)
            numba.config.CACHE_DIR = str(folder)
        return numba.njit(nogil=True, cache=True)(function)
    except (OSError, RuntimeError):
        return numba.njit(nogil=True)(function)
    finally:
        numba.config.CACHE_DIR = before
