"""Actions and observations of an agent, named as in JaxMARL; and the check of actions that are given."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planner.arguments import did_you_mean
from planner.errors import UsageError


class Discrete(NamedTuple):
    """Actions 0 .. n - 1."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32


class Box(NamedTuple):
    """Arrays of a shape between two numbers."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32


def checked_actions(given: Any, shape: tuple[int, ...], count: int, name: str = "actions") -> Any:
    """The actions as an array of this shape, if each is a whole number, 0 to `count` - 1. Raises UsageError.

    Under a trace of JAX the values are not known: there shape and type alone are checked, and what an action outside
    the space does is undefined.
    """
    traced = isinstance(given, jax.core.Tracer)
    try:
        actions = given if traced else np.asarray(given)
    except ValueError:  # lists of different lengths
        actions = np.array(None)
    each = f"whole numbers, 0 to {count - 1}, of shape {shape}" if shape else f"a whole number, 0 to {count - 1}"
    if actions.shape != shape or actions.dtype.kind not in "iu":
        shown = f"{actions.dtype} of shape {actions.shape}" if traced else reprlib.repr(given)
        raise UsageError(f"{name}: {shown}", expected=each)
    if traced:
        return actions
    for place in map(tuple, np.argwhere((actions < 0) | (actions >= count)).tolist()):
        raise UsageError(f"{name}{list(place) if place else ''}: {actions[place]}", expected=each)
    return actions


def check_agents(given: Any, agents: Sequence[str], needed: Sequence[str]) -> None:
    """Raise UsageError unless `given` is a mapping from names of agents, from all that are `needed` among them."""
    expected = f"a dict from names of agents, {agents[0]!r} to {agents[-1]!r}, to actions"
    if not isinstance(given, Mapping):
        raise UsageError(f"actions: {reprlib.repr(given)}", expected=expected)
    for name in given:
        if name not in agents:
            raise UsageError(f"actions of {name!r}", expected=expected, fix=did_you_mean(name, agents))
    missing = [repr(name) for name in needed if name not in given]
    if missing:
        raise UsageError(f"no action of {', '.join(missing)}", expected=expected)
