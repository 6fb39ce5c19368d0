"""Whether JAX has an accelerator here. JAX is not imported to find out that there is nothing to find."""

from __future__ import annotations

import importlib.util
import logging
import os
import pkgutil
import sys
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from planner.rollouts.names import why_not
from planner.simulator.jit import COMPILES_JAX, cache_folder, open_folder

LOG = logging.getLogger("mrac_jax")
PLUGINS = ("jax_plugins", "libtpu")
"""Packages that bring JAX an accelerator."""
CUDA = ("xla_cuda", "cuda", "jax_cuda")
"""What the names of plug-ins for NVIDIA's devices begin with."""
DEVICES = ("nvidia*", "nvhost*", "nvgpu*", "dxg")
"""Files in /dev that Linux has where there is such a device; the last is that of WSL."""


@cache
def accelerator() -> str | None:
    """The platform of JAX's accelerator ("gpu", "tpu"), or None: JAX is not even imported where there can be none.

    One that JAX was told to use, but that cannot be used, is named in a note (log).
    """
    platforms = _platforms()
    if platforms.split(",")[0] == "cpu":
        return None
    try:
        if not _may_be_one():
            if platforms:
                raise RuntimeError("there is no plug-in of JAX with a device here")
            return None
        import jax

        platform = jax.default_backend()
    except Exception as error:  # JAX raises nearly anything: an AssertionError where CUDA has no device
        LOG.warning("%s: the engine is Numba", why_not(error))
        return None
    return None if platform == "cpu" else platform


def _platforms() -> str:
    """The platforms that JAX is told to use, "cuda,cpu", or ""."""
    jax = sys.modules.get("jax")
    told = os.environ.get("JAX_PLATFORMS") if jax is None else jax.config.jax_platforms
    return told or ""


def _may_be_one() -> bool:
    """Whether a plug-in is installed, and for those of NVIDIA's devices alone, such a device is there."""
    names = {point.name for point in entry_points(group="jax_plugins")}
    for package in PLUGINS:
        spec = importlib.util.find_spec(package)
        if spec is not None:
            inside = {found.name for found in pkgutil.iter_modules(spec.submodule_search_locations)}
            names |= inside if package == "jax_plugins" and inside else {package}
    if sys.platform == "linux" and names and all(name.startswith(CUDA) for name in names):
        return any(any(Path("/dev").glob(device)) for device in DEVICES)
    return bool(names)


# JAX's compiled programs are kept in the user's cache folder between runs, as Numba's (`planner.simulator.jit`).

BEGINS = "/jax/core/compile/jaxpr_to_mlir_module_duration"
ENDS = "/jax/core/compile/backend_compile_duration"
"""What JAX reports just before it looks for a compiled program or makes one, and afterwards."""


def keep_jax_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, unless caching is off or the user chose a folder.

    JAX writes its own files in place and reads them unchecked (a damaged one can end the process), so it is given a
    cache of checked files, through an interface of its inside. A JAX without that inside keeps nothing.
    """
    import jax

    _report_compilations()
    folder = cache_folder()
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
            return self._folder.read(key)

        def put(self, key: str, value: bytes) -> None:
            self._folder.write(key, value)

    compilation_cache._cache, compilation_cache._cache_initialized = Programs(open_folder(folder / "jax")), True
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@cache
def _report_compilations() -> None:
    """Report what JAX compiles as the event COMPILES_JAX, from now on."""
    from jax import monitoring
    from numba.core.event import end_event, start_event

    def timed(event: str, duration_secs: float, **_: str | int) -> None:
        if event == BEGINS:
            start_event(COMPILES_JAX)
        elif event == ENDS:
            end_event(COMPILES_JAX)

    monitoring.register_event_duration_secs_listener(timed)
