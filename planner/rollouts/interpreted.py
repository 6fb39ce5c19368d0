"""The simulator as plain Python: a second load of its modules, in which nothing is compiled.

One source serves both. Nominal runs, missions, environments and a user's own functions run a rollout or a step at a
time, and do not wait for a compilation.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType
from typing import Any

import planner.simulator
from planner.simulator import jit

NAME = "planner.simulator_as_python"
"""The name of the second load, in `sys.modules`."""
LARGE = 2**12
"""Cells of a map from which on its searches are compiled at once."""
MOST_CELLS = 2**17
"""Cells, summed over its calls, after which a search is compiled: as Python it has then taken about as long."""


@cache
def interpreted(module: str) -> Any:
    """A module of the simulator, as Python.

    Its own imports are relative, so they find the modules of the same load. In the place of the decorators of
    `planner.simulator.jit` stands the identity.
    """
    if NAME not in sys.modules:
        file, folders = planner.simulator.__file__, list(planner.simulator.__path__)
        spec = spec_from_file_location(NAME, file, submodule_search_locations=folders)
        assert spec is not None and spec.loader is not None
        package, plain = module_from_spec(spec), ModuleType(f"{NAME}.jit")
        vars(plain).update(vars(jit) | dict.fromkeys(("kernel", "rare_kernel", "spliced", "program"), _same))
        vars(plain).update(threaded=_compiled, compiled=_compiled, search=_search, INTERPRETED=True)
        sys.modules |= {NAME: package, f"{NAME}.jit": plain}
        spec.loader.exec_module(package)
    return import_module(f"{NAME}.{module}")


def _same(function: Any) -> Any:
    return function


def _compiled(function: Any) -> Any:
    """The compiled function of the same name."""
    module = import_module(f"planner.simulator.{function.__module__.rpartition('.')[2]}")
    return getattr(module, function.__name__)


def _search(function: Any) -> Any:
    """A loop over arrays: as Python while there is little to do, then compiled."""
    found, done = None, 0

    def call(*given: Any) -> Any:
        nonlocal found, done
        if found is None:
            done += len(given[0])
            if jit.INTERPRETED or (done <= MOST_CELLS and len(given[0]) < LARGE):
                return function(*given)  # Numba may be switched off
            found = jit.program(_compiled(function).py_func)
        return found(*[getattr(one, "array", one) for one in given])

    return call
