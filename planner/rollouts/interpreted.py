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
        same = dict.fromkeys(("kernel", "rare_kernel", "spliced", "program", "threaded", "compiled"), _same)
        vars(plain).update(vars(jit) | same | {"__name__": plain.__name__, "INTERPRETED": True})
        sys.modules |= {NAME: package, plain.__name__: plain}
        spec.loader.exec_module(package)
    return import_module(f"{NAME}.{module}")


def _same(function: Any) -> Any:
    return function
