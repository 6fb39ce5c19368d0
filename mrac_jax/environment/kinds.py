"""The environment whose actions are moves, or that whose actions are areas; and episodes of it."""

from __future__ import annotations

from typing import Any, Literal, get_args

from numpy.typing import ArrayLike

from mrac_jax.environment.area_env import AreaEnv, AreaRuns
from mrac_jax.environment.coverage_env import CoverageEnv
from mrac_jax.environment.running import Runs
from planner.arguments import argument, check_word
from planner.errors import UsageError
from planner.settings import Policy
from planner.worlds.world import World

Actions = Literal["moves", "areas"]
ONLY_OF = {"view": "moves", "rule": "areas", "offers": "areas"}
"""What goes with one kind of actions alone."""


def make_env(
    world: World,
    robots: int | None = None,
    *,
    actions: Actions = "moves",
    starts: ArrayLike | None = None,
    worth: float = 0.0,
    max_steps: int | None = None,
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
) -> CoverageEnv | AreaEnv:
    """The environment of these actions; arguments as of `mrac.env`. Raises InputError."""
    check_word("actions", actions, get_args(Actions))
    more: dict[str, Any] = {"starts": starts, "worth": worth, "max_steps": max_steps}
    given: dict[str, Any] = {"view": view, "rule": rule, "offers": offers}
    for name, value in given.items():
        if value is not None and ONLY_OF[name] != actions:
            problem = f"{argument(name, value)}, with {argument('actions', actions)}"
            raise UsageError(problem, expected=argument("actions", ONLY_OF[name]), fix="leave it out")
    own = {name: value for name, value in given.items() if value is not None}
    return (AreaEnv if actions == "areas" else CoverageEnv)(world, robots, **more, **own)


def runs_of(env: CoverageEnv | AreaEnv, count: int = 1) -> Runs | AreaRuns:
    """Episodes of so many environments."""
    return AreaRuns(env, count) if isinstance(env, AreaEnv) else Runs(env, count)
