"""The team as one agent with Gymnasium's API: one environment, or a batch; registered as `mrac/Coverage-v0`."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mrac_jax.env.area_env import AreaEnv, make_env, runs_of
from mrac_jax.env.coverage_env import CoverageEnv, StepBatch, checked_actions
from planner.world.world import World

ID = "mrac/Coverage-v0"


def _made(world: World | CoverageEnv | AreaEnv, robots: int | None, more: dict[str, Any]) -> CoverageEnv | AreaEnv:
    return make_env(world, robots, **more) if isinstance(world, World) else world


def _spaces(env: CoverageEnv | AreaEnv) -> tuple[spaces.Box, spaces.MultiDiscrete]:
    """Spaces of the observations of all robots, float32 `[K, ...]`, and of their actions."""
    box, actions = env.observation_space(env.agents[0]), env.action_space(env.agents[0]).n
    seen = spaces.Box(box.low, box.high, (env.num_agents, *box.shape), np.float32)
    return seen, spaces.MultiDiscrete([actions] * env.num_agents)


class TeamEnv(gymnasium.Env):
    """Consecutive episodes; the reward is the sum over all robots."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        world: World | CoverageEnv | AreaEnv,
        robots: int | None = None,
        *,
        render_mode: str | None = None,
        **more: Any,
    ) -> None:
        """`world`: or the environment to wrap; `more`: as in `mrac.env`."""
        self._runs, self.render_mode = runs_of(_made(world, robots, more)), render_mode
        self.observation_space, self.action_space = _spaces(self._runs.env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        """Observations of all robots at t = 0; `seed`: its rollouts 0, 1, ... with the random numbers of `evaluate`."""
        super().reset(seed=seed)
        batch = self._runs.reset(seed)
        return batch.seen[0], self._info(batch)

    def step(self, action: ArrayLike) -> tuple[NDArray, float, bool, bool, dict[str, Any]]:
        """A team step with actions `[K]`. Raises UsageError for an action out of range."""
        env = self._runs.env
        given = checked_actions(action, (env.num_agents,), env.action_space(env.agents[0]).n)
        batch = self._runs.step(given[None])
        cut = bool(batch.truncated[0])
        return batch.seen[0], float(batch.rewards[0].sum()), bool(batch.done[0]) and not cut, cut, self._info(batch)

    def _info(self, batch: StepBatch) -> dict[str, Any]:
        return {"action_mask": batch.legal[0].astype(np.int8), **batch.figures(0)}

    def render(self) -> NDArray[np.uint8] | None:
        """A picture `[H, W, 3]`, with `render_mode="rgb_array"`."""
        return self._runs.picture() if self.render_mode == "rgb_array" else None


class TeamVectorEnv(VectorEnv):
    """A batch of environments in one compiled step. A finished one restarts in the next step and ignores its action."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self, world: World | CoverageEnv | AreaEnv, robots: int | None = None, *, num_envs: int = 1, **more: Any
    ) -> None:
        """As `TeamEnv`."""
        self._runs, self.num_envs = runs_of(_made(world, robots, more), num_envs), num_envs
        self.single_observation_space, self.single_action_space = _spaces(self._runs.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray, dict[str, Any]]:
        """Start all; with a seed, its rollouts 0 .. B - 1."""
        super().reset(seed=seed)
        batch = self._runs.reset(seed)
        return batch.seen, self._info(batch)

    def step(self, actions: ArrayLike) -> tuple[NDArray, NDArray, NDArray, NDArray, dict[str, Any]]:
        """A step of all with actions `[B, K]`. Raises UsageError for an action out of range."""
        batch = self._runs.step(actions)
        rewards = batch.rewards.sum(axis=1).astype(np.float64)
        return batch.seen, rewards, batch.done & ~batch.truncated, batch.truncated, self._info(batch)

    def _info(self, batch: StepBatch) -> dict[str, Any]:
        return {
            "action_mask": batch.legal.astype(np.int8),
            "covered": batch.covered,
            "lost": batch.lost,
            "step": batch.step,
        }


if ID not in gymnasium.registry:
    here = f"{__name__}:"
    gymnasium.register(ID, entry_point=f"{here}TeamEnv", vector_entry_point=f"{here}TeamVectorEnv")
