"""JAX's compiled programs are kept in the user's cache folder between runs, as Numba's (`planner.jit`)."""

from __future__ import annotations

from planner.jit import cache_folder


def keep_jax_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless caching is off or the user chose a folder."""
    import jax

    folder = cache_folder("jax")
    if folder is not None and jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
