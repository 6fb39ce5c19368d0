"""Missions as environments, in which policies are learned, and the benchmark suite."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Environments(ModuleType):
    """This package, which can be called as the function `mrac.env`.

    Python binds `mrac_jax.env` to the package once a module of it is imported.
    """

    def __call__(self, *given: Any, **options: Any) -> Any:
        """`mrac_jax.env.making.env`."""
        return sys.modules["mrac_jax"].__getattr__("env")(*given, **options)


sys.modules[__name__].__class__ = _Environments
