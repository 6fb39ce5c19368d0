"""Forked processes: JAX's threads do not survive a fork, so a child of a process with a started JAX cannot use it.

Without this module such a child waits for those threads for ever. JAX is not imported here.
"""

from __future__ import annotations

import os
import sys

_inherited: list[int] = []
"""Ids of the forked processes, this one among them, that inherited a started JAX."""


def jax_is_inherited() -> bool:
    """True in a process that was forked after JAX had started."""
    return bool(_inherited)


def _look() -> None:
    """Note, in the child, whether JAX had started. Takes no lock: another thread may have held it at the fork."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is not None and getattr(bridge, "_backends", True):
        _inherited.append(os.getpid())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look)
