"""Numba's compiler with the cache in the user's cache folder: compiled functions wear `compiled` or `threaded`.

The folder is `$NUMBA_CACHE_DIR` if set, else `$XDG_CACHE_HOME/mrac-jax/numba`, else `~/.cache/mrac-jax/numba`; in it,
one folder for each state of a package's sources, since Numba does not see that a function in another file has changed.
`MRAC_JAX_NO_CACHE=1` in the environment (the command line's `--no-cache`) keeps nothing on disk.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

NO_CACHE = "MRAC_JAX_NO_CACHE"
Function = TypeVar("Function", bound=Callable[..., Any])


def cache_folder(kind: str) -> Path | None:
    """Where compiled code of this kind ("numba", "jax") is kept between runs; None when nothing is to be kept."""
    if os.environ.get(NO_CACHE, "") not in ("", "0"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    except RuntimeError:  # nobody's home
        return None
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
    chosen = numba.config.CACHE_DIR
    folder = Path(chosen) if chosen else cache_folder("numba")
    if folder is None or cache_folder("numba") is None:
        return numba.njit(nogil=nogil)(function)
    source = Path(function.__code__.co_filename).parent
    try:
        mine = folder / f"{source.name}-{_sources_hash(source)}"
        mine.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(mine)
        return numba.njit(nogil=nogil, cache=True)(function)
    except (OSError, RuntimeError):
        return numba.njit(nogil=nogil)(function)
    finally:
        numba.config.CACHE_DIR = chosen


@cache
def _sources_hash(package: Path) -> str:
    """Hash of every source of a package."""
    digest = hashlib.sha256()
    for source in sorted(package.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
