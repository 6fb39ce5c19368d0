"""Whole rollouts of a policy in the environment: compiled if the policy is, else asked step by step."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.environment.area_env import AreaEnv
from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv, State
from mrac_jax.process import fixed_flags
from planner.errors import UsageError
from planner.threefry import key_of

AT_ONCE = 256
"""Rollouts that go side by side, if what they observe fits into SEEN bytes."""
SEEN = 2**27
Ended = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
"""Cells visited, robots lost, steps, int64 `[B]` each."""


class PolicyRollouts:
    """Rollouts of a policy, in any order: each is what it is by its id and the seed. Can be sent to other processes.

    Attributes:
        spans: (start, stop) of those of rollouts 0 .. count - 1 that go side by side.
        compiled: they run without Python.
    """

    def __init__(self, env: CoverageEnv | AreaEnv, policy: Callable[..., Any] | None, seed: int, count: int) -> None:
        """policy: a function of the observations of all robots, float32 `[K, ...]`, that returns an action each.

        Of two arguments, then of a random key too (a NumPy generator where it is not compiled), its own for every
        rollout. Under `jax.jit` it runs inside the compiled rollouts, if its actions are moves. None: a random walk
        over the actions that are open. What is no policy is a UsageError when it is asked.
        """
        self._env, self._policy, self._seed = env, policy, seed
        self.compiled = isinstance(env, CoverageEnv) and (policy is None or hasattr(policy, "lower"))
        seen = 4 * env.num_agents * int(np.prod(env.observation_space(env.agents[0]).shape))
        self._width = min(count, AT_ONCE if self.compiled else max(1, min(AT_ONCE, SEEN // seen)))
        self.spans = [(start, min(start + self._width, count)) for start in range(0, count, self._width)]

    @cached_property
    def _run(self) -> Callable[[jax.Array, jax.Array], tuple[State, Any]]:
        assert isinstance(self._env, CoverageEnv)
        if self._policy is None or self.compiled:
            return jax.jit(jax.vmap(_compiled(self._env, self._policy), (None, 0)))
        return _Asked(self._env, self._policy, self._seed)

    @fixed_flags(user_code=True)
    def __call__(self, span: tuple[int, int]) -> Ended:
        """Rollouts `start .. stop - 1`. Raises UsageError for actions that there are not."""
        if isinstance(self._env, AreaEnv):
            return self._env.roll_out(_chooser(self._env, self._policy), self._seed, *span)
        words, (start, stop) = jnp.asarray(key_of(self._seed), jnp.uint32), span
        last = start + self._width if self.compiled else stop  # one width, one program
        state, valid = self._run(words, jnp.arange(start, last, dtype=jnp.uint32))
        if not np.asarray(valid).all():
            raise UsageError("the policy returned actions that there are not", expected=_whole_numbers(len(ACTIONS)))
        visited, lost, steps = (
            np.asarray(of)[: stop - start].astype(np.int64)
            for of in (state.covered, (~state.alive).sum(axis=1), state.step)
        )
        return visited, lost, steps


def _asking(policy: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """The policy as a function of two arguments, which raises UsageError for whatever it raises."""
    try:
        takes_luck = len(inspect.signature(policy).parameters) > 1
    except (TypeError, ValueError):
        takes_luck = False

    def ask(seen: Any, luck: Any) -> Any:
        try:
            return policy(seen, luck) if takes_luck else policy(seen)
        except Exception as error:
            raise UsageError(f"the policy raised {type(error).__name__}: {error}") from error

    return ask


def _chooser(
    env: AreaEnv, policy: Callable[..., Any] | None
) -> Callable[[NDArray[np.float32], NDArray[np.bool_], np.random.Generator], NDArray[np.int64]]:
    """What `AreaEnv.roll_out` asks; no policy: one of the offers, or none of them, with equal chances."""
    ask, compiled = None if policy is None else _asking(policy), hasattr(policy, "lower")

    def act(seen: NDArray[np.float32], legal: NDArray[np.bool_], draws: np.random.Generator) -> NDArray[np.int64]:
        if ask is None:
            return draws.integers(0, legal.sum(axis=1))
        key = jax.random.key(int(draws.integers(2**32)), impl="threefry2x32") if compiled else draws
        return _checked(env, ask(seen, key), env.offers + 1)

    return act


def _checked(env: CoverageEnv | AreaEnv, actions: Any, most: int) -> NDArray[Any]:
    """What a policy returned, if it is an action below `most` for each robot."""
    given = np.asarray(actions)
    _check(env, given)
    if not ((given >= 0) & (given < most)).all():
        raise UsageError(f"the policy returned {given.tolist()}", expected=_whole_numbers(most))
    return given


def _check(env: CoverageEnv | AreaEnv, given: Any) -> None:
    if given.shape != (env.num_agents,):
        problem = f"the policy returned actions of shape {given.shape}"
        raise UsageError(problem, expected=f"({env.num_agents},), one a robot")
    if given.dtype.kind not in "iu":
        raise UsageError(f"the policy returned actions of {given.dtype}", expected="whole numbers")


def _whole_numbers(count: int) -> str:
    return f"whole numbers, 0 to {count - 1}"


def _compiled(env: CoverageEnv, policy: Callable[..., Any] | None) -> Callable[[jax.Array, jax.Array], tuple]:
    """One rollout, `(seed words, id) -> last state, whether all actions were such as there are`."""
    ask = None if policy is None else _asking(policy)
    closed = jnp.float32(-1e9)  # its chance is 0, and it is no infinity, which JAX_DEBUG_INFS would stop at

    def actions_of(state: State, key: jax.Array) -> jax.Array:
        if ask is None:
            actions = jax.random.categorical(key, jnp.where(env.legal(state), jnp.float32(0), closed))
        else:
            actions = jnp.asarray(ask(env.observe(state), key))
            _check(env, actions)
        return actions.astype(jnp.int32)

    def step(key: jax.Array, state: State, valid: jax.Array) -> tuple[State, jax.Array]:
        actions = actions_of(state, jax.random.fold_in(key, state.step))
        valid &= ((actions >= 0) & (actions < len(ACTIONS))).all()
        return env.advance(state, actions)[0], valid

    def one(seed: jax.Array, rollout: jax.Array) -> tuple[State, jax.Array]:
        key = jax.random.fold_in(jax.random.wrap_key_data(seed, impl="threefry2x32"), rollout)
        begun = env.begin(seed, rollout), jnp.bool_(True)
        return jax.lax.while_loop(lambda now: ~now[0].done, lambda now: step(key, *now), begun)

    return one


class _Asked:
    """Rollouts side by side, each robot's action asked for in Python."""

    def __init__(self, env: CoverageEnv, policy: Callable[..., Any], seed: int) -> None:
        self.env, self.ask, self.seed = env, _asking(policy), seed
        self._begin = jax.jit(jax.vmap(env.begin, (None, 0)))
        self._advance = jax.jit(jax.vmap(self._advanced))
        self._observe = jax.jit(jax.vmap(env.observe))

    def __call__(self, seed: jax.Array, rollouts: jax.Array) -> tuple[State, bool]:
        """Their last states, and that all actions were such as there are; what is over waits for the others."""
        states = self._begin(seed, rollouts)
        draws = [np.random.default_rng([self.seed, int(rollout)]) for rollout in rollouts]
        while not (done := np.asarray(states.done)).all():
            seen, actions = np.asarray(self._observe(states)), np.zeros((len(done), self.env.num_agents), np.int32)
            for place in np.flatnonzero(~done):
                actions[place] = self._asked(seen[place], draws[place])
            states = self._advance(states, actions)
        return states, True

    def _advanced(self, state: State, actions: jax.Array) -> State:
        """What is over stays as it is."""
        after = self.env.advance(state, actions)[0]
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def _asked(self, seen: NDArray[np.float32], draws: np.random.Generator) -> NDArray[np.int32]:
        return _checked(self.env, self.ask(seen, draws), len(ACTIONS))
