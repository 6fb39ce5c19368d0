"""Detection of JAX's accelerator, without importing JAX if there can be none; and the cache of compiled programs."""

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
"""Packages that add an accelerator to JAX."""
CUDA = ("xla_cuda", "cuda", "jax_cuda")
"""Prefixes of plug-ins for NVIDIA's devices."""
DEVICES = ("nvidia*", "nvhost*", "nvgpu*", "dxg")
"""Files in /dev for such devices on Linux; the last is for WSL."""


@cache
def accelerator() -> str | None:
    """The platform of JAX's accelerator ("gpu", "tpu"), or None; JAX is not imported if there can be no accelerator.

    A log note names an accelerator that JAX is configured to use, but that is not usable.
    """
    platforms = _platforms()
    if platforms.split(",")[0] == "cpu":
        return None
    try:
        if not _may_be_one():
            if platforms:
                raise RuntimeError("no JAX plug-in has a device")
            return None
        import jax

        platform = jax.default_backend()
    except Exception as error:  # JAX may raise any exception, as an AssertionError if CUDA has no device
        LOG.warning("%s: the engine is Numba", why_not(error))
        return None
    return None if platform == "cpu" else platform


def _platforms() -> str:
    """The platforms that JAX is configured to use, "cuda,cpu", or ""."""
    jax = sys.modules.get("jax")
    platforms = os.environ.get("JAX_PLATFORMS") if jax is None else jax.config.jax_platforms
    return platforms or ""


def _may_be_one() -> bool:
    """Whether a plug-in is installed; for NVIDIA plug-ins, whether there is also a device."""
    names = {point.name for point in entry_points(group="jax_plugins")}
    for package in PLUGINS:
        spec = importlib.util.find_spec(package)
        if spec is not None:
            inside = {found.name for found in pkgutil.iter_modules(spec.submodule_search_locations)}
            names |= inside if package == "jax_plugins" and inside else {package}
    if sys.platform == "linux" and names and all(name.startswith(CUDA) for name in names):
        return any(any(Path("/dev").glob(device)) for device in DEVICES)
    return bool(names)


# JAX's compiled programs are cached in the user's cache folder, like Numba's (`planner.simulator.jit`).

BEGINS = "/jax/core/compile/jaxpr_to_mlir_module_duration"
ENDS = "/jax/core/compile/backend_compile_duration"
"""Events that JAX reports before it looks up or compiles a program, and afterwards."""


def keep_jax_programs() -> None:
    """Let JAX cache compiled programs in the user's cache folder, unless caching is off or the user set a folder.

    JAX's own cache writes files in place and reads them without a check, so that a damaged file can end the process. It
    therefore gets a cache of checked files, through an internal interface. A JAX without that interface caches nothing.
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
        """Programs by JAX's keys, which contain all that a program depends on."""

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
    """From now on, report JAX's compilations as the event COMPILES_JAX."""
    from jax import monitoring
    from numba.core.event import end_event, start_event

    def timed(event: str, duration_secs: float, **_: str | int) -> None:
        if event == BEGINS:
            start_event(COMPILES_JAX)
        elif event == ENDS:
            end_event(COMPILES_JAX)

    monitoring.register_event_duration_secs_listener(timed)
