"""Where compiled code is kept between runs, for both engines; the folders and the switch are those of `planner.jit`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

from planner.jit import cache_folder

Function = TypeVar("Function", bound=Callable[..., Any])


def threaded(function: Function) -> Function:
    """`numba.njit` of a function that several threads may run at once (it lets go of the interpreter), cached on disk.

    Threads of our own, never `parallel=True`: Numba's cache confuses a function compiled both ways. Nor does it see
    that a function in another file has changed: so the folder is named after all sources of this package.
    """
    folder = cache_folder("numba")
    if folder is None:
        return numba.njit(nogil=True)(function)
    before = numba.config.CACHE_DIR
    try:
        mine = Path(before) if before else folder
        mine = mine / f"mrac_jax-{_sources_hash()}"
        mine.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(mine)
        return numba.njit(nogil=True, cache=True)(function)
    except (OSError, RuntimeError):
        return numba.njit(nogil=True)(function)
    finally:
        numba.config.CACHE_DIR = before


def keep_jax_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless caching is off or the user chose a folder."""
    import jax

    folder = cache_folder("jax")
    if folder is not None and jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@cache
def _sources_hash() -> str:
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]
