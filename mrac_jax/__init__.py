"""mrac-jax: the coverage of a dangerous area by a team of robots that may be lost, with confidence intervals.

The public API: `import mrac_jax as mrac`, then `mrac.load`, `mrac.plan`, `mrac.evaluate` and the other names of
`__all__`. Each name is imported at its first use. `analysis` and `planner` import nothing through this module.
"""

# ruff: noqa: F405 (the names of `analysis.api`)
from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

from mrac_jax import process as process  # which has to be there before a fork

if TYPE_CHECKING:
    from analysis import plots
    from analysis.api import *  # noqa: F403
    from mrac_jax import functional
    from mrac_jax.env.making import env
    from planner.errors import InputError
    from planner.make_plan import read_plan
    from planner.plan.plan import Plan
    from planner.rollouts.coverage_gradient import closed_loop_gradient
    from planner.settings import Settings
    from planner.world.world import World

__version__ = next((found.version for found in distributions(name="mrac-jax")), "0+unknown")  # not installed
__all__ = [
    "InputError", "Plan", "Settings", "World", "check", "closed_loop_gradient", "compare", "debrief", "drive", "env",
    "evaluate", "export", "front", "functional", "generate", "inspect", "judge", "load", "plan", "plots",
    "read_outcomes", "read_plan", "read_rollouts", "record", "results", "size", "starts", "studio", "suite", "sweep",
    "threats",
]  # fmt: skip
ELSEWHERE = {
    "InputError": "planner.errors",
    "Plan": "planner.plan.plan",
    "Settings": "planner.settings",
    "World": "planner.world.world",
    "closed_loop_gradient": "planner.rollouts.coverage_gradient",
    "env": "mrac_jax.env.making",
    "functional": "mrac_jax.functional",
    "plots": "analysis.plots",
    "read_plan": "planner.make_plan",
}
"""The module of a name, if it is not `analysis.api`."""
OF_0_3 = {
    "with_hazard": ("planner.world.world", "World.with_latent_hazard"),
    "with_maps": ("planner.world.world", "World.with_maps"),
    "with_movers": ("planner.world.world", "World.with_moving_threats"),
    "with_phases": ("planner.world.world", "World.with_phases"),
    "with_prior": ("planner.world.world", "World.with_prior_map"),
    "with_sense": ("planner.world.world", "World.with_sensor_range"),
    "with_spread": ("planner.world.world", "World.with_spread"),
    "with_truth": ("planner.world.world", "World.with_true_map"),
    "to_networkx": ("planner.world.world", "World.to_networkx"),
    "attack": ("analysis.api", "threats(..., add=1)"),
    "clear": ("analysis.api", "threats(..., remove=1)"),
    "mission": ("analysis.api", "drive"),
    "reproduce": ("analysis.api", "check(paper=...)"),
}
"""Names of release 0.3, which work for one release: the module and today's name of each."""
MODULES = ("functional", "plots")
"""Names that are modules."""
NEIGHBOURS = ("planner", "analysis")
HOME = Path(__file__).parent.parent


def __getattr__(name: str) -> Any:
    if name not in __all__ and name not in OF_0_3:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    for neighbour in NEIGHBOURS:
        _check_is_ours(neighbour)
    if name in OF_0_3:
        module, new = OF_0_3[name]
        import_module("planner.errors").warn_renamed(f"mrac_jax.{name}", f"mrac_jax.{new}")
        home = import_module(module)
        if new.startswith("World."):
            return _with_names_of_0_3(getattr(home.World, new.removeprefix("World.")))
        return getattr(home, name, None) or home.OF_0_3[name]
    home = import_module(ELSEWHERE.get(name, "analysis.api"))
    if name in MODULES:
        return home
    found = getattr(home, name)
    if not isinstance(found, FunctionType):
        return found
    return import_module("analysis.utils.notes").with_hints(found, _functions)


def _with_names_of_0_3(method: Callable[..., Any]) -> Callable[..., Any]:
    """A method of World as the function of release 0.3: the world first, and its names of arguments."""
    today = {"sense": "sensor_range", "truth": "true_map", "movers": "threats"}

    def call(world: Any, *given: Any, **named: Any) -> Any:
        return method(world, *given, **{today.get(name, name): value for name, value in named.items()})

    return call


def _functions() -> dict[str, FunctionType]:
    """The public functions by name, to suggest the function that has an unknown argument."""
    found = {}
    for name in __all__:
        with suppress(ImportError):  # without an extra there is one function less to suggest
            found[name] = __getattr__(name)
    return {name: one for name, one in found.items() if isinstance(one, FunctionType)}


def __dir__() -> list[str]:
    # Thirty names fit a screen: `read_outcomes`, for recordings alone, is in the reference.
    return [name for name in __all__ if name != "read_outcomes"]


def _check_is_ours(package: str) -> None:
    """Raise ImportError if another file of that name comes first on the path, as any folder `analysis` may."""
    ours, spec = HOME / package / "__init__.py", find_spec(package)
    found = None if spec is None else spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    if found is None or not (Path(found).exists() and ours.samefile(found)):
        raise ImportError(
            f"mrac_jax needs its own package {package!r}, {ours.parent}, but `import {package}` finds {found}: "
            f"rename that one, or take its folder off sys.path and PYTHONPATH, or put {HOME} before it"
        )
