"""PyMARL's face: its interface, the layout of MAPS, and the steps of the environment in JAX where robots block."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mrac_jax as mrac
from analysis.judging.rolling import roll_policy
from mrac_jax.environment.coverage_env import ACTIONS, CoverageEnv
from mrac_jax.environment.pymarl_env import LABELS, PymarlEnv, pymarl_policy
from planner.worlds.generate import random_world
from planner.worlds.world import World

ROBOTS, SEED = 3, 3
COMPASS = {"right": ("east", 0, 1), "down": ("south", 1, 0), "left": ("west", 0, -1), "up": ("north", -1, 0)}


@cache
def world() -> World:
    return random_world(6, 7, obstacles=0.15, threats=0.3)


class Tensor:
    """Actions as PyMARL hands them over."""

    def __init__(self, given: np.ndarray) -> None:
        self.given = given

    def cpu(self) -> np.ndarray:
        return self.given


def by_ours(labels: list[str], cells: list[tuple[int, int]], alive: list[bool]) -> list[int]:
    """The actions of the environment in JAX: who would meet another robot stays; robots move by number."""
    free, at, taken = world().free, dict(enumerate(cells)), []
    for robot, label in enumerate(labels):
        name, down, right = COMPASS.get(label, ("stay", 0, 0))
        row, col = at[robot][0] + down, at[robot][1] + right
        others = [at[other] for other in range(ROBOTS) if other != robot and alive[other]]
        inside = 0 <= row < free.shape[0] and 0 <= col < free.shape[1] and free[row, col]
        if not alive[robot] or not inside or (row, col) in others:
            name, row, col = "stay", *at[robot]
        at[robot] = (row, col)
        taken.append(ACTIONS.index(name))
    return taken


def test_steps_are_those_of_the_environment_in_jax() -> None:
    env, ours = mrac.env(world(), ROBOTS, face="pymarl", max_steps=60), CoverageEnv(world(), ROBOTS, max_steps=60)
    take, draw, height, width = jax.jit(ours.advance), np.random.default_rng(5), *world().shape
    blocked = lost = cut = 0
    assert env.get_env_info() == {
        "state_shape": 168, "obs_shape": 210, "n_actions": 5, "n_agents": ROBOTS, "episode_limit": 60,
    }  # fmt: skip
    for rollout in range(6):
        env.reset(seed=SEED) if rollout == 0 else env.reset(test_mode=True, t_env=5)
        state, over = ours.begin(jnp.array([SEED, 0], jnp.uint32), jnp.uint32(rollout)), False
        while not over:
            cells = [divmod(int(cell), width) for cell in state.cell]
            alive = state.alive.tolist()
            grid = env.get_state().reshape(height, width, 4)
            expected = np.zeros_like(grid)
            for robot in np.flatnonzero(state.alive):
                expected[cells[robot]][0] = robot + 1
            expected[..., 1] = np.asarray(state.visited).reshape(height, width) | ~world().free
            expected[..., 2], expected[..., 3] = -1.0 * ~world().free, np.nan_to_num(world().threat)
            assert (grid == expected).all()
            for robot, seen in enumerate(env.get_obs()):
                mine, flags = seen.reshape(height, width, 5)[..., 0], seen.reshape(height, width, 5)[..., 1:]
                assert mine.sum() == alive[robot] and mine[cells[robot]] == alive[robot]
                assert (flags[..., 0] == (grid[..., 0] > 0)).all() and (flags[..., 1:] == grid[..., 1:]).all()
            masks, actions = env.get_avail_actions(), draw.integers(0, 5, ROBOTS)
            for robot, mask in enumerate(masks):
                for number, label in enumerate(LABELS[:-1]):
                    alone = ["stay"] * robot + [label] + ["stay"] * (ROBOTS - robot - 1)
                    assert mask[number] == (by_ours(alone, cells, alive)[robot] != 0)
                assert mask[-1]
            moves = by_ours([LABELS[action] for action in actions], cells, alive)
            blocked += sum(LABELS[a] != "stay" and move == 0 for a, move in zip(actions, moves, strict=True))
            state, rewards = take(state, jnp.asarray(moves))
            reward, over, info = env.step(Tensor(actions))
            assert reward == rewards.sum() and over == state.done
            assert info["lost"] == (~state.alive).sum() and info["covered"] == pytest.approx(
                int(state.covered) / ours.accessible
            )
        lost, cut = lost + info["lost"], cut + info["episode_limit"]
    assert blocked > 20 and lost > 0 and cut > 0


def test_its_agents_are_judged() -> None:
    """Agents that go right, by MAPS' numbers, are the policy that goes east."""
    corridor = World.create(np.array([[0.0, 0.0, *[0.1] * 10]]))
    right = pymarl_policy(lambda state, seen, opened: np.array([LABELS.index("right")]))
    env = CoverageEnv(corridor, 1)
    found, east = roll_policy(env, right, 9, 100), roll_policy(env, lambda seen: [ACTIONS.index("east")], 9, 100)
    assert all((a == b).all() for a, b in zip(found, east, strict=True)) and len(set(found[0].tolist())) > 3


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(mrac.InputError, match="whole map"):
        PymarlEnv(CoverageEnv(world(), view=2))
    env = mrac.env(world(), ROBOTS, face="pymarl")
    env.reset(seed=0)
    for wrong in ([0, 1], [0, 1, 5], [0, 1, -1], [0, 1, 0.5]):
        with pytest.raises(mrac.InputError, match=r"^actions"):
            env.step(np.array(wrong))
