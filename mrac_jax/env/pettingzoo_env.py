"""The environment with PettingZoo's parallel API: dicts by agent; lost robots leave `agents`."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from mrac_jax.env.area_env import AreaEnv, runs_of
from mrac_jax.env.coverage_env import CoverageEnv, StepBatch, check_agents, checked_actions

Dicts = tuple[dict[str, NDArray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


class CoverageParallelEnv(ParallelEnv):
    """Robots that move, or choose areas; `infos[agent]["action_mask"]` gives the legal actions.

    `reset(seed=s)` starts rollout 0 of that seed, the next `reset()` rollout 1, and so on, with the random numbers of
    `evaluate`.
    """

    def __init__(self, env: CoverageEnv | AreaEnv, render_mode: str | None = None) -> None:
        self.metadata = {"name": "mrac_coverage_v0", "render_modes": ["rgb_array"], "is_parallelizable": True}
        self.render_mode, self.possible_agents, self.agents = render_mode, list(env.agents), list[str]()
        self._runs, box = runs_of(env), env.observation_space(env.agents[0])
        self.observation_spaces = {name: spaces.Box(box.low, box.high, box.shape, np.float32) for name in env.agents}
        actions = env.action_space(env.agents[0]).n
        self.action_spaces = {name: spaces.Discrete(actions) for name in env.agents}

    def observation_space(self, agent: str) -> spaces.Space:
        """float32 `[P, h, w]`, PLANES of `coverage_env`, or `[M, F]`, COLUMNS of `area_env`."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Indices of ACTIONS of `coverage_env`, or 0 .. M for the offers."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray], dict[str, dict[str, Any]]]:
        """Observations and infos at t = 0."""
        batch = self._runs.reset(seed)
        self.agents = list(self.possible_agents)
        return self._of_agents(batch.seen[0]), self._infos(batch)

    def step(self, actions: dict[str, Any]) -> Dicts:
        """Observations, rewards, terminations, truncations and infos of the present agents.

        Raises UsageError for an unknown agent, for one of `agents` without an action, and for an action out of range.
        """
        check_agents(actions, self.possible_agents, self.agents)
        spaces = ((name, int(space.n)) for name, space in self.action_spaces.items())
        given = [checked_actions(actions.get(name, 0), (), count, f"action of {name}") for name, count in spaces]
        batch = self._runs.step([given])
        ended, cut = bool(batch.done[0] and not batch.truncated[0]), bool(batch.truncated[0])
        alive = dict(zip(self.possible_agents, batch.alive[0].tolist(), strict=True))
        before = list(self.agents)
        rewards = self._of_agents(batch.rewards[0].tolist())
        terminations = {name: ended or not alive[name] for name in before}
        truncations = {name: cut and alive[name] for name in before}
        seen, infos = self._of_agents(batch.seen[0]), self._infos(batch)
        self.agents = [name for name in before if not terminations[name] and not truncations[name]]
        return seen, rewards, terminations, truncations, infos

    def _of_agents(self, each: Any) -> dict[str, Any]:
        """The values of the agents that are still present."""
        return {name: of for name, of in zip(self.possible_agents, each, strict=True) if name in self.agents}

    def _infos(self, batch: StepBatch) -> dict[str, dict[str, Any]]:
        of_all = batch.figures(0)
        masks = self._of_agents(batch.legal[0].astype(np.int8))
        return {name: {"action_mask": mask, **of_all} for name, mask in masks.items()}

    def render(self) -> NDArray[np.uint8] | None:
        """A picture `[H, W, 3]`, with `render_mode="rgb_array"`."""
        return self._runs.picture() if self.render_mode == "rgb_array" else None
