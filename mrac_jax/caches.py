"""JAX's compiled programs are kept in the user's cache folder between runs, as Numba's (`planner.jit`)."""

from __future__ import annotations

from functools import cache
from typing import Any

from planner.jit import OF_JAX, cache_folder, sealed_folder

BEGINS = "/jax/core/compile/jaxpr_to_mlir_module_duration"
ENDS = "/jax/core/compile/backend_compile_duration"
"""What JAX reports just before it looks for a compiled program or makes one, and afterwards."""


def keep_jax_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless caching is off or the user chose a folder.

    JAX writes its own files in place and reads them unchecked (a damaged one can end the process), so it is given a
    cache of sealed files, through an interface of its inside. A JAX without that inside keeps nothing.
    """
    import jax

    _report_compilations()
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


@cache
def _report_compilations() -> None:
    """Tell who listens (`planner.jit.OF_JAX`), from now on."""
    from jax import monitoring

    def timed(event: str, duration_secs: float, **_: str | int) -> None:
        for listener in OF_JAX:
            if event == BEGINS:
                listener.begins()
            elif event == ENDS:
                listener.ends()

    monitoring.register_event_duration_secs_listener(timed)
