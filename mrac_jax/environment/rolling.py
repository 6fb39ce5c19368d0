"""Whole rollouts of a policy in the environment: compiled if the policy is, else asked step by step."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv, State
from planner.errors import UsageError
from planner.threefry import key_of

AT_ONCE = 256
"""Rollouts that go side by side."""


def roll_out(
    env: CoverageEnv, policy: Callable[..., Any] | None, seed: int, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells visited, robots lost, steps, int64 `[count]` each, of rollouts 0 .. count - 1 of the seed.

    policy: a function of the observations of all robots, float32 `[K, P, h, w]`, that returns an action each, `[K]`; of
    two arguments, then of a random key too (a NumPy generator where it is not compiled), its own for every rollout.
    Under `jax.jit` it runs inside the compiled rollouts. None: a random walk over the actions that are open.
    Raises UsageError for what is no policy.
    """
    words = jnp.asarray(key_of(seed), jnp.uint32)
    if policy is None or hasattr(policy, "lower"):
        run: Callable[..., State] = jax.jit(jax.vmap(_compiled(env, policy), (None, 0)))
    else:
        run = _Asked(env, policy, seed)
    parts, width = [], min(AT_ONCE, count)
    for start in range(0, count, width):
        stop = min(start + width, count) if isinstance(run, _Asked) else start + width  # one width, one program
        state = run(words, jnp.arange(start, stop, dtype=jnp.uint32))
        parts.append([np.asarray(of) for of in (state.covered, (~state.alive).sum(axis=1), state.step)])
    visited, lost, steps = (np.concatenate(of)[:count].astype(np.int64) for of in zip(*parts, strict=True))
    return visited, lost, steps


def _takes_luck(policy: Callable[..., Any]) -> bool:
    return len(inspect.signature(policy).parameters) > 1


def _check(env: CoverageEnv, shape: tuple[int, ...]) -> None:
    if shape != (env.num_agents,):
        raise UsageError(f"the policy returned actions of shape {shape}", expected=f"({env.num_agents},), one a robot")


def _compiled(env: CoverageEnv, policy: Callable[..., Any] | None) -> Callable[[jax.Array, jax.Array], State]:
    """One rollout, `(seed words, id) -> last state`."""

    def actions_of(state: State, key: jax.Array) -> jax.Array:
        if policy is None:
            return jax.random.categorical(key, jnp.where(env.legal(state), 0.0, -jnp.inf))
        seen = env.observe(state)
        actions = policy(seen, key) if _takes_luck(policy) else policy(seen)
        _check(env, jnp.shape(actions))
        return jnp.asarray(actions).astype(jnp.int32)

    def one(seed: jax.Array, rollout: jax.Array) -> State:
        key = jax.random.fold_in(jax.random.wrap_key_data(seed), rollout)
        step = lambda state: env.advance(state, actions_of(state, jax.random.fold_in(key, state.step)))[0]  # noqa: E731
        return jax.lax.while_loop(lambda state: ~state.done, step, env.begin(seed, rollout))

    return one


class _Asked:
    """Rollouts side by side, each robot's action asked for in Python."""

    def __init__(self, env: CoverageEnv, policy: Callable[..., Any], seed: int) -> None:
        self.env, self.policy, self.seed, self.luck = env, policy, seed, _takes_luck(policy)
        self._begin = jax.jit(jax.vmap(env.begin, (None, 0)))
        self._advance = jax.jit(jax.vmap(self._advanced))
        self._observe = jax.jit(jax.vmap(env.observe))

    def __call__(self, seed: jax.Array, rollouts: jax.Array) -> State:
        """Their last states; what is over waits for the others."""
        states = self._begin(seed, rollouts)
        draws = [np.random.default_rng([self.seed, int(rollout)]) for rollout in rollouts]
        while not (done := np.asarray(states.done)).all():
            seen, actions = np.asarray(self._observe(states)), np.zeros((len(done), self.env.num_agents), np.int32)
            for place in np.flatnonzero(~done):
                actions[place] = self._asked(seen[place], draws[place])
            states = self._advance(states, actions)
        return states

    def _advanced(self, state: State, actions: jax.Array) -> State:
        """What is over stays as it is."""
        after = self.env.advance(state, actions)[0]
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def _asked(self, seen: NDArray[np.float32], draws: np.random.Generator) -> NDArray[np.int32]:
        given = np.asarray(self.policy(seen, draws) if self.luck else self.policy(seen))
        _check(self.env, given.shape)
        if given.dtype.kind not in "iu" or not ((given >= 0) & (given < len(ACTIONS))).all():
            raise UsageError(
                f"the policy returned {given.tolist()}", expected=f"whole numbers, 0 to {len(ACTIONS) - 1}"
            )
        return given
