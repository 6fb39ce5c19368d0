"""Episodes of an environment driven from the host: one rollout of a seed after the other, NumPy out."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv, State
from mrac_jax.environment.spaces import checked_actions
from mrac_jax.process import fixed_flags
from planner.arguments import SEED
from planner.threefry import key_of
from planner.worlds.world import World


class Told(NamedTuple):
    """What a step tells of B environments.

    Attributes:
        seen: float32 `[B, K, ...]`, observations. legal: bool `[B, K, actions]`, those that are open.
        rewards: float32 `[B, K]`. alive: bool `[B, K]`.
        done, truncated: bool `[B]`, the episode is over; it was cut off. covered: float32 `[B]`. lost: int32 `[B]`.
        step: int32 `[B]`, steps of the team so far.
    """

    seen: NDArray[np.float32]
    legal: NDArray[np.bool_]
    rewards: NDArray[np.float32]
    alive: NDArray[np.bool_]
    done: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    covered: NDArray[np.float32]
    lost: NDArray[np.int32]
    step: NDArray[np.int32]

    def figures(self, place: int) -> dict[str, Any]:
        """What infos of one environment hold beside masks."""
        return {"covered": float(self.covered[place]), "lost": int(self.lost[place]), "step": int(self.step[place])}


class Next:
    """Which rollouts of which seed B environments begin: those that nobody has begun, in order."""

    def __init__(self, count: int) -> None:
        self.count, self.seed = count, 0
        self._next: NDArray[np.uint32] | None = None

    def begin(self, seed: int | None) -> NDArray[np.uint32]:
        """Of all environments `[B]`: 0 and on of the seed, or without one the next; the first time of a random seed."""
        SEED.check("seed", seed, optional=True)
        if seed is not None or self._next is None:
            self.seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0]) if seed is None else int(seed)
            self._next = np.arange(self.count, dtype=np.uint32)
        begun, self._next = self._next, self._next + np.uint32(self.count)
        return begun

    def after(self, over: NDArray[np.bool_]) -> NDArray[np.uint32]:
        """Of each environment `[B]` the one that follows; those that are over begin it."""
        assert self._next is not None
        following, self._next = self._next, self._next + over.astype(np.uint32) * np.uint32(self.count)
        return following


class Runs:
    """B environments. The n-th episode of environment b, counted from the last seed given, is rollout n B + b of it.

    JAX starts with the first `reset`: until then the process may be forked. A copy, pickled or not, goes on from where
    it was made.
    """

    def __init__(self, env: CoverageEnv, count: int = 1) -> None:
        self.env, self._next = env, Next(count)
        self._seed = np.zeros(2, np.uint32)
        self.state: State | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but compiled programs, which stay in their process; arrays as NumPy's, which do not start JAX."""
        kept = {name: value for name, value in vars(self).items() if name not in ("_begin", "_advance")}
        return kept | {"state": jax.tree.map(np.asarray, self.state)}

    @cached_property
    def _begin(self) -> Any:
        return jax.jit(self._began)

    @cached_property
    def _advance(self) -> Any:
        return jax.jit(self._advanced)

    @fixed_flags()
    def reset(self, seed: int | None = None) -> Told:
        """Begin: rollout 0 and on of the seed, or without one the next ones; the first time of a random seed."""
        rollouts = self._next.begin(seed)
        self._seed = np.asarray(key_of(self._next.seed), np.uint32)
        self.state, told = self._begin(self._seed, rollouts)
        return Told(*jax.device_get(told))

    @fixed_flags()
    def step(self, actions: ArrayLike) -> Told:
        """Take the actions `[B, K]`; where the episode was over before, they are ignored and the next one begins.

        Raises UsageError for actions outside the space; the state is then what it was.
        """
        if self.state is None:
            raise RuntimeError("step before reset")
        given = checked_actions(actions, (self._next.count, self.env.num_agents), len(ACTIONS))
        rollouts = self._next.after(np.asarray(self.state.done))
        self.state, told = self._advance(self._seed, rollouts, self.state, given.astype(np.int32))
        return Told(*jax.device_get(told))

    def _began(self, seed: jax.Array, rollouts: jax.Array) -> tuple[State, tuple[jax.Array, ...]]:
        states = jax.vmap(self.env.begin, (None, 0))(seed, rollouts)
        return states, self._tell(states, jnp.zeros(states.alive.shape, jnp.float32))

    def _advanced(
        self, seed: jax.Array, rollouts: jax.Array, states: State, actions: jax.Array
    ) -> tuple[State, tuple[jax.Array, ...]]:
        after, rewards = jax.vmap(self.env.advance)(states, actions)
        fresh = jax.vmap(self.env.begin, (None, 0))(seed, rollouts)
        over = jax.vmap(lambda done, new, old: jax.tree.map(lambda one, other: jnp.where(done, one, other), new, old))
        chosen: Any = over(states.done, fresh, after)
        return chosen, self._tell(chosen, jnp.where(states.done[:, None], 0.0, rewards))

    def _tell(self, states: State, rewards: jax.Array) -> tuple[jax.Array, ...]:
        infos, env = jax.vmap(self.env.infos)(states), self.env
        seen, legal = jax.vmap(env.observe)(states), jax.vmap(env.legal)(states)
        ends = (states.done, infos["truncated"], infos["covered"], infos["lost"], states.step)
        return seen, legal, rewards, states.alive, *ends

    def picture(self) -> NDArray[np.uint8]:
        """The first environment in colours, uint8 `[H * SCALE, W * SCALE, 3]`: robots blue, lost ones black."""
        if self.state is None:
            raise RuntimeError("render before reset")
        state = jax.tree.map(lambda of: np.asarray(of[0]), self.state)
        return picture_of(self.env.world, state.visited, state.cell, state.alive)


def picture_of(
    world: World, visited: NDArray[np.bool_], cell: NDArray[np.integer], alive: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """A team in colours, uint8 `[H * SCALE, W * SCALE, 3]`: robots blue, lost ones black; visited `[N]` is darker."""
    threat = np.nan_to_num(world.threat)
    pale = 1.0 - threat / max(float(threat.max()), 1e-9)
    colours = np.stack([np.ones_like(pale), pale, pale], axis=-1) * np.where(visited, 0.8, 1.0).reshape(
        (*world.shape, 1)
    )
    colours[~world.free] = 0.3
    rows, cols = np.divmod(cell, world.shape[1])
    colours[rows, cols] = np.where(alive[:, None], (0.1, 0.3, 0.9), 0.0)
    return np.kron(colours * 255, np.ones((SCALE, SCALE, 1))).astype(np.uint8)


SCALE = 8
"""Pixels a cell."""
