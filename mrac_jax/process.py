"""JAX in this process: whether it can run, and the flags that this package's programs run under.

The programs are whole-number programs of 32 bits that broadcast. They are compiled under the flags that they were
written for, so that no `JAX_...` variable of the user's changes a count or stops them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

import jax

from mrac_jax.forks import jax_is_inherited
from planner.arguments import argument
from planner.errors import UsageError
from planner.rollouts.names import why_not

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
        raise UsageError(
            "JAX had started before this process was forked, and cannot run in it",
            fix="start processes by spawn, as AsyncVectorEnv(..., context='spawn') or multiprocessing.get_context"
            f"('spawn'), or use face='vector', which needs none, or {argument('engine', 'numba')}",
        )
    _start()


@cache
def _start() -> None:
    try:
        jax.local_devices()
    except Exception as error:
        raise UsageError(why_not(error), fix=f"set JAX_PLATFORMS=cpu, or use {argument('engine', 'numba')}") from error


@contextmanager
def fixed_flags(*, user_code: bool = False) -> Iterator[None]:
    """Run what is inside, in this thread, under the flags of this module; also a decorator. Raises as `require_jax`.

    `user_code`: a user's function is traced inside, to which the flags of WRITTEN stay as the user set them.
    """
    require_jax()
    with ExitStack() as stack:
        for name, value in (RUN if user_code else RUN | WRITTEN).items():
            stack.enter_context(getattr(jax, name)(value))
        yield
