"""The environment with Jumanji's API: the team is one agent, what it observes is planes and the mask of its actions."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jumanji import specs
from jumanji.env import Environment
from jumanji.types import TimeStep, restart, termination, transition, truncation

from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv, State


class Observation(NamedTuple):
    """planes: float32 `[K, P, h, w]`; action_mask: bool `[K, 5]`; step_count: int32."""

    planes: jax.Array
    action_mask: jax.Array
    step_count: jax.Array


class Keyed(NamedTuple):
    """The state, with the key that wrappers take the next episode's from."""

    state: State
    key: jax.Array


class CoverageJumanji(Environment):
    """`CoverageEnv` for Jumanji; the reward is that of all robots together."""

    def __init__(self, env: CoverageEnv) -> None:
        self.env = env
        super().__init__()

    def __reduce__(self) -> tuple[type, tuple[CoverageEnv]]:
        """Made anew from the environment: what Jumanji caches need not be such as can be pickled."""
        return type(self), (self.env,)

    def reset(self, key: jax.Array) -> tuple[Keyed, TimeStep]:
        """The state at t = 0, with the luck of the key."""
        state = self.env.reset(key)[1]
        return Keyed(state, key), restart(self._observation(state), self.env.infos(state))

    def step(self, state: Keyed, action: jax.Array) -> tuple[Keyed, TimeStep]:
        """A team step with an action for each robot, int32 `[K]`; `CoverageEnv.step_env` says what is checked."""
        after, rewards = self.env.advance(state.state, action)
        infos, seen, gained = self.env.infos(after), self._observation(after), rewards.sum()
        kind = after.done.astype(jnp.int32) + infos["truncated"].astype(jnp.int32)
        ways: Any = (transition, termination, truncation)
        made = [lambda way=way: way(reward=gained, observation=seen, extras=infos) for way in ways]
        return Keyed(after, state.key), jax.lax.switch(kind, made)

    def _observation(self, state: State) -> Observation:
        return Observation(self.env.observe(state), self.env.legal(state), state.step)

    @cached_property
    def observation_spec(self) -> specs.Spec:
        """Of `Observation`."""
        robots, box = self.env.num_agents, self.env.observation_space(self.env.agents[0])
        planes = specs.BoundedArray((robots, *box.shape), jnp.float32, 0.0, 1.0, "planes")
        mask = specs.BoundedArray((robots, len(ACTIONS)), bool, False, True, "action_mask")
        count = specs.BoundedArray((), jnp.int32, 0, self.env.max_steps, "step_count")
        return specs.Spec(Observation, "ObservationSpec", planes=planes, action_mask=mask, step_count=count)

    @cached_property
    def action_spec(self) -> specs.MultiDiscreteArray:
        """A number of ACTIONS for each robot."""
        return specs.MultiDiscreteArray(jnp.full(self.env.num_agents, len(ACTIONS), jnp.int32), name="action")
