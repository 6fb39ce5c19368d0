"""JAX in this process: whether it can run, and the flags that this package's programs run under.

The programs are whole-number programs of 32 bits that broadcast. They are compiled under the flags that they were
written for, so that no `JAX_...` variable of the user's changes a count or stops them.

JAX's threads do not survive a fork, so a child of a process with a started JAX cannot use it: without this module,
which is imported before the fork, such a child waits for those threads for ever. JAX is imported when it is used.
`planner` is, too: another module of that name is `mrac_jax`'s to report.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

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


RUN: dict[str, Any] = {
    "disable_jit": False,  # loops of the programs would run step by step in Python, and fail under vmap
    "check_tracer_leaks": False,
    "transfer_guard": "allow",  # inputs are NumPy arrays
    "debug_key_reuse": False,
    "threefry_partitionable": True,  # which numbers `jax.random` draws
}
"""Flags that change how a program runs, or which random numbers it draws."""
WRITTEN: dict[str, Any] = {
    "enable_x64": False,
    "numpy_rank_promotion": "allow",
    "numpy_dtype_promotion": "standard",
    "debug_nans": False,
    "debug_infs": False,
}
"""Flags that change what the code of a program means."""


def require_jax() -> None:
    """Raise UsageError where JAX cannot run: in a process forked after it had started, or without its devices."""
    if jax_is_inherited():
        from planner.arguments import argument
        from planner.errors import UsageError

        raise UsageError(
            "JAX had started before this process was forked, and cannot run in it",
            fix="start processes by spawn, as AsyncVectorEnv(..., context='spawn') or multiprocessing.get_context"
            f"('spawn'), or use face='vector', which needs none, or {argument('engine', 'numba')}",
        )
    _start()


@cache
def _start() -> None:
    import jax

    try:
        jax.local_devices()
    except Exception as error:
        from planner.arguments import argument
        from planner.errors import UsageError
        from planner.rollouts.names import why_not

        raise UsageError(why_not(error), fix=f"set JAX_PLATFORMS=cpu, or use {argument('engine', 'numba')}") from error


@contextmanager
def fixed_flags(*, user_code: bool = False) -> Iterator[None]:
    """Run what is inside, in this thread, under the flags of this module; also a decorator. Raises as `require_jax`.

    `user_code`: a user's function is traced inside, to which the flags of WRITTEN stay as the user set them.
    """
    require_jax()
    import jax

    with ExitStack() as stack:
        for name, value in (RUN if user_code else RUN | WRITTEN).items():
            stack.enter_context(getattr(jax, name)(value))
        yield
