"""JAX's compiled programs are kept in the user's cache folder between runs, as Numba's (`planner.jit`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from planner.jit import cache_folder, sealed_folder

WHEN_JAX_IS_USED: list[Callable[[], None]] = []
"""Called when an engine is made that is about to compile with JAX."""


def keep_jax_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless caching is off or the user chose a folder.

    JAX writes its own files in place and reads them unchecked (a damaged one can end the process), so it is given a
    cache of sealed files, through an interface of its inside. A JAX without that inside keeps nothing.
    """
    import jax

    for use in WHEN_JAX_IS_USED:
        use()
    folder = cache_folder("compiled")
    if folder is None or jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface

        _ = compilation_cache._cache, compilation_cache._cache_initialized
    except (ImportError, AttributeError):
        return

    class Programs(CacheInterface):
        """JAX's programs by its keys, which hold all that a program depends on."""

        def __init__(self, folder: Any) -> None:
            self._path, self._folder = folder.path, folder

        def get(self, key: str) -> bytes | None:
            return self._folder.read(f"jax.{key}")

        def put(self, key: str, value: bytes) -> None:
            self._folder.write(f"jax.{key}", value)

    compilation_cache._cache, compilation_cache._cache_initialized = Programs(sealed_folder(folder)), True
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
