"""The mission with PyMARL's interface of 2020 and what MAPS' agents see, so that they can be trained and judged here.

`step(actions) -> reward, terminated, info`, `get_obs`, `get_state`, `get_avail_actions`, `get_env_info`, as in PyMARL,
DCG and MAPS (YairKorn/MAPS, `src/envs/adv_coverage.py`). The rules and the luck are those of `evaluate`: unlike in MAPS
a robot that stays is not checked again, robots act in the order of their numbers, and reward is cells, less `worth`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv
from mrac_jax.environment.running import Runs
from mrac_jax.environment.spaces import checked_actions
from planner.arguments import argument
from planner.errors import UsageError

LABELS = ("right", "down", "left", "up", "stay")
"""What MAPS' actions mean, by number."""
MOVES = np.array([ACTIONS.index(name) for name in ("east", "south", "west", "north", "stay")])
SHIFTS = np.array([[0, 1], [1, 0], [0, -1], [-1, 0], [0, 0]])
Select = Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]], ArrayLike]
"""`(state, observations, open actions) -> actions`: of `PymarlEnv.get_state`, `get_obs`, `get_avail_actions`."""


class PymarlEnv:
    """Episodes one after the other, of the whole map.

    Attributes:
        n_agents, n_actions, episode_limit: as in PyMARL.
    """

    def __init__(self, env: CoverageEnv) -> None:
        if env.view is not None:
            raise UsageError(argument("view", env.view), expected="the whole map, as in MAPS", fix="leave it out")
        self.n_agents, self.n_actions, self.episode_limit = env.num_agents, len(LABELS), env.max_steps
        self._runs, self._cells = Runs(env), env.world.threat.size
        self._planes = np.zeros((self.n_agents, *env.observation_space(env.agents[0]).shape), np.float32)

    def reset(self, seed: int | None = None, **told: Any) -> tuple[list[NDArray[np.float32]], NDArray[np.float32]]:
        """Observations and state at t = 0; with a seed of its rollout 0, then of 1, ...: the luck of `evaluate`.

        What MAPS' runner tells (`test_mode`, `t_env`, ...) changes nothing.
        """
        self._planes = self._runs.reset(seed).seen[0]
        return self.get_obs(), self.get_state()

    def step(self, actions: Any) -> tuple[float, bool, dict[str, float]]:
        """The team's reward, whether the episode is over, and `episode_limit`, `covered`, `lost`; actions `[K]`."""
        given = np.asarray(actions.cpu() if hasattr(actions, "cpu") else actions)
        told = self._runs.step(moves_of(given, self._planes)[None])
        self._planes, cut = told.seen[0], bool(told.truncated[0])
        info = {"episode_limit": cut, "covered": float(told.covered[0]), "lost": int(told.lost[0])}
        return float(told.rewards[0].sum()), bool(told.done[0]), info

    def get_obs(self) -> list[NDArray[np.float32]]:
        """What each robot sees, float32 `[H W 5]`: where it is, who is where (0 or 1), covered, obstacles, threat."""
        return list(as_maps_sees(self._planes)[1])

    def get_obs_agent(self, agent_id: int) -> NDArray[np.float32]:
        """Of one robot."""
        return self.get_obs()[agent_id]

    def get_state(self) -> NDArray[np.float32]:
        """float32 `[H W 4]`: the number of the robot there, from 1, or 0; covered; -1 for an obstacle; threat."""
        return as_maps_sees(self._planes)[0]

    def get_avail_actions(self) -> list[NDArray[np.bool_]]:
        """Which of LABELS are open to each robot, bool `[5]`: no obstacle, nobody there; to a lost one, to stay."""
        return list(as_maps_sees(self._planes)[2])

    def get_avail_agent_actions(self, agent_id: int) -> NDArray[np.bool_]:
        """To one robot."""
        return self.get_avail_actions()[agent_id]

    def get_obs_size(self) -> int:
        """H W 5."""
        return 5 * self._cells

    def get_state_size(self) -> int:
        """H W 4."""
        return 4 * self._cells

    def get_total_actions(self) -> int:
        """Actions of a robot."""
        return self.n_actions

    def get_env_info(self) -> dict[str, int]:
        """What PyMARL makes its networks and buffers by."""
        return {
            "state_shape": self.get_state_size(), "obs_shape": self.get_obs_size(), "n_actions": self.n_actions,
            "n_agents": self.n_agents, "episode_limit": self.episode_limit,
        }  # fmt: skip

    def close(self) -> None:
        """Nothing to close."""


def pymarl_policy(select: Select) -> Callable[[NDArray[np.float32]], NDArray[np.int64]]:
    """MAPS' or PyMARL's agents as a policy that `mrac.judge` rolls out: what they see, and moves by our numbers."""
    return partial(_selected, select)


def _selected(select: Select, planes: NDArray[np.float32]) -> NDArray[np.int64]:
    return moves_of(np.asarray(select(*as_maps_sees(planes))), planes)


def as_maps_sees(
    planes: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """State `[H W 4]`, observations `[K, H W 5]` and open actions `[K, 5]`, of what robots observe of the whole map."""
    (threat, obstacles, visited), here = planes[0, :3], planes[:, 3]
    who = (np.arange(1, len(here) + 1)[:, None, None] * here).max(axis=0)
    grid = np.stack([who, np.maximum(visited, obstacles), -obstacles, threat], axis=-1).astype(np.float32)
    flags = np.concatenate([(who > 0)[..., None], grid[..., 1:]], axis=-1)
    seen = [np.concatenate([mine[..., None], flags], axis=-1).ravel() for mine in here]
    shut, opened = _shut(obstacles + who), np.zeros((len(here), len(LABELS)), bool)
    opened[:, -1] = True
    for robot, row, col in np.argwhere(here):
        rows, cols = (SHIFTS[:-1] + np.array([row + 1, col + 1])).T
        opened[robot, :-1] = ~shut[rows, cols]
    return grid.ravel(), np.array(seen, np.float32), opened


def moves_of(actions: NDArray[Any], planes: NDArray[np.float32]) -> NDArray[np.int64]:
    """ACTIONS `[K]` for MAPS' ones: as robots block each other there, a move to where another one is, is to stay."""
    actions = checked_actions(actions, (len(planes),), len(LABELS))
    shut, moves = _shut(planes[0, 1]), np.zeros(len(planes), np.int64)
    at = {int(robot): (int(row) + 1, int(col) + 1) for robot, row, col in np.argwhere(planes[:, 3])}
    for robot, (row, col) in list(at.items()):
        to = row + int(SHIFTS[actions[robot]][0]), col + int(SHIFTS[actions[robot]][1])
        if not shut[to] and to not in at.values():
            moves[robot], at[robot] = MOVES[actions[robot]], to
    return moves


def _shut(plane: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where it is not 0, and around the map, bool `[H + 2, W + 2]`."""
    return np.pad(plane != 0, 1, constant_values=True)
