"""Whether JAX has an accelerator here. JAX is not imported to find out that there is nothing to find."""

from __future__ import annotations

import importlib.util
import os
from functools import cache
from importlib.metadata import entry_points

PLUGINS = ("jax_plugins", "libtpu")
"""Packages that bring JAX an accelerator."""


@cache
def accelerator() -> str | None:
    """The platform of JAX's accelerator ("gpu", "tpu"), or None; no plug-in for one: JAX is not even imported."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if platforms == "cpu" or not (platforms or _has_plugin()):
        return None
    import jax

    try:
        platform = jax.default_backend()
    except RuntimeError:  # a plug-in without its device
        return None
    return None if platform == "cpu" else platform


def _has_plugin() -> bool:
    return any(map(importlib.util.find_spec, PLUGINS)) or bool(entry_points(group="jax_plugins"))
