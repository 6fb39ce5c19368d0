"""The environment in JAX against a plain twin of the rules, step for step; its conventions; the luck of rollouts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mrac_jax.arrays import tolerance_words
from mrac_jax.environment.coverage_env import ACTIONS, AT_ONCE, PLANES, CoverageEnv, State
from planner.errors import InputError
from planner.failure_model import exposure_of, tolerance_of, tolerances
from planner.world.generate import random_world
from planner.world.world import World

MOVES = {"stay": (0, 0), "north": (-1, 0), "west": (0, -1), "east": (0, 1), "south": (1, 0)}
ROWS, COLS, ROBOTS, STEPS = 7, 9, 3, 150


class Twin:
    """The rules in plain Python: sets of cells, and whole numbers of what robots bear and what a visit adds."""

    def __init__(self, world: World, starts: list[int], bears: list[int], worth: float, max_steps: int) -> None:
        self.exposure = exposure_of(world.threat).ravel().tolist()
        self.free = set(np.flatnonzero(world.free).tolist())
        self.worth, self.max_steps, self.step, self.width = worth, max_steps, 0, world.shape[1]
        self.at, self.left = list(starts), list(bears)
        self.alive, self.visited = [True] * len(starts), set[int]()
        for robot, cell in enumerate(starts):
            self.enter(robot, cell)

    def enter(self, robot: int, cell: int) -> float:
        """The robot's reward."""
        new = cell not in self.visited
        self.visited.add(cell)
        self.at[robot] = cell
        self.left[robot] -= self.exposure[cell]
        self.alive[robot] = self.left[robot] > 0
        return new - self.worth * (not self.alive[robot])

    def move(self, actions: list[int]) -> list[float]:
        """The rewards of a step."""
        self.step += 1
        rewards = [0.0] * len(actions)
        for robot, action in enumerate(actions):
            (row, col), (down, right) = divmod(self.at[robot], self.width), MOVES[ACTIONS[action]]
            cell = (row + down) * self.width + col + right
            if self.alive[robot] and action and 0 <= col + right < self.width and cell in self.free:
                rewards[robot] = self.enter(robot, cell)
        return rewards

    @property
    def done(self) -> bool:
        return self.visited == self.free or not any(self.alive) or self.step == self.max_steps


@cache
def made(**more: Any) -> CoverageEnv:
    world = random_world(ROWS, COLS, obstacles=0.15, threats=0.3)
    assert world.components.max() == 1
    return CoverageEnv(world, ROBOTS, **more)


@cache
def advance(env: CoverageEnv) -> Any:
    return jax.jit(jax.vmap(lambda state, actions: (*env.advance(state, actions), env.infos(state))))


def begin(env: CoverageEnv, seed: int, rollouts: np.ndarray) -> State:
    words = jnp.array([seed & 0xFFFFFFFF, seed >> 32], jnp.uint32)
    return jax.vmap(env.begin, (None, 0))(words, jnp.asarray(rollouts, jnp.uint32))


def equal(one: Any, other: Any) -> bool:
    return bool(jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), one, other)))


def test_tolerances_are_those_of_the_plain_numbers() -> None:
    words = np.random.default_rng(0).integers(0, 2**32, 5000, dtype=np.uint32)
    words[:3] = 0, 1, 2**32 - 1
    high, low = np.asarray(jax.jit(tolerance_words)(words)).astype(np.int64).T
    assert ((high << 32 | low) == tolerance_of(words)).all()


def test_transitions_are_those_of_the_plain_rules() -> None:
    """10**5 steps of the team, event for event: places, rewards, who is lost, what was visited, the end."""
    env, seed, rollouts = made(worth=2.5, max_steps=STEPS), 2**40 + 11, np.arange(1400)
    states, draw = begin(env, seed, rollouts), np.random.default_rng(3)
    starts, bears = (env.starts @ [COLS, 1]).tolist(), tolerances(seed, rollouts, ROBOTS).tolist()
    twins = [Twin(env.world, starts, of, 2.5, STEPS) for of in bears]
    done, taken = np.zeros(len(twins), bool), 0
    for _ in range(STEPS):
        actions = draw.integers(0, len(ACTIONS), (len(twins), ROBOTS))
        states, rewards, _ = advance(env)(states, actions)
        came = (rewards, states.cell, states.alive, states.visited, states.done)
        gained, cell, alive, visited, over = map(np.asarray, came)
        for place in np.flatnonzero(~done):
            twin = twins[place]
            assert twin.move(actions[place].tolist()) == gained[place].tolist()
            assert twin.at == cell[place].tolist()
            assert twin.alive == alive[place].tolist() and twin.done == over[place]
            assert twin.visited == set(np.flatnonzero(visited[place]).tolist())
            taken += 1
        done |= over
    assert done.all() and taken > 1e5
    assert len({tuple(twin.alive) for twin in twins}) > ROBOTS


def test_a_key_is_a_seed_and_steps_follow_the_conventions() -> None:
    env = made()
    (seen, state), other = env.reset(jax.random.key(5)), begin(env, 5, np.array([0]))
    assert equal(state, jax.tree.map(lambda of: of[0], other))
    assert list(seen) == env.agents and seen["agent_0"].shape == env.observation_space("agent_0").shape
    actions = dict.fromkeys(env.agents, jnp.int32(1))
    keys = jax.random.split(jax.random.key(9), 4)
    plain = env.step_env(keys[0], state, actions)
    for got in (env.step(keys[0], state, actions), jax.jit(env.step_env)(keys[0], state, actions)):
        assert equal(got, plain)
    assert set(plain[3]) == {*env.agents, "__all__"} and set(plain[2]) == set(env.agents)
    assert env.action_space("agent_0").n == len(ACTIONS) and env.agent_classes == {"robot": env.agents}


def test_an_episode_that_is_over_begins_anew() -> None:
    env = made(max_steps=2)
    state, actions = env.reset(jax.random.key(0))[1], dict.fromkeys(env.agents, jnp.int32(0))
    for step in (1, 2):
        seen, state, _, dones, infos = env.step(jax.random.key(step), state, actions)
    assert dones["__all__"] and infos["truncated"] and not state.done and state.step == 0
    fresh = env.reset(jax.random.key(2))
    assert equal((seen, state), fresh)
    again = env.step(jax.random.key(7), env.step(jax.random.key(1), fresh[1], actions)[1], actions, fresh[1])[1]
    assert (again.left == fresh[1].left).all()


def test_of_a_batch_those_that_are_over_begin_anew() -> None:
    """None, some, and more at once than a chunk: as one by one."""
    env, count = made(max_steps=9), AT_ONCE + 9
    draw, began, tree = np.random.default_rng(1), set[int](), jax.tree
    many, fresh_ones, plain = (jax.jit(jax.vmap(of)) for of in (env.step, env.reset, env.step_env))
    states = fresh_ones(jax.random.split(jax.random.key(99), count))[1]
    states = replace(states, step=-draw.integers(0, 2, count, np.int32) * draw.integers(0, 9, count, np.int32))
    for step in range(18):
        keys = jax.random.split(jax.random.key(step), count)
        given = keys, states, dict(zip(env.agents, draw.integers(0, 5, (ROBOTS, count)), strict=True))
        found, went_on, fresh = (tree.map(np.asarray, of) for of in (many(*given), plain(*given), fresh_ones(keys)))
        over = found[3]["__all__"]
        began.add(int(over.sum()))
        for got, new, old in zip(*map(tree.leaves, (found[:2], fresh, went_on[:2])), strict=True):
            assert (got == np.where(over.reshape(-1, *[1] * (got.ndim - 1)), new, old)).all()
        assert equal(found[2:], went_on[2:])
        states = found[1]
    assert 0 in began and max(began) >= 20 and len(began) > 4


def test_a_lost_robot_stays_and_has_no_reward() -> None:
    world = World.create([[0.0, 0.999, 0.0], [0.0, 0.0, 0.0]])
    env = CoverageEnv(world, starts=[[0, 0], [1, 0]], worth=10.0)
    state, east = env.reset(jax.random.key(1))[1], ACTIONS.index("east")
    _, state, rewards, dones, infos = env.step_env(jax.random.key(0), state, {"agent_0": east, "agent_1": east})
    assert rewards["agent_0"] == 1 - 10 and rewards["agent_1"] == 1
    assert dones["agent_0"] and not dones["agent_1"] and not dones["__all__"] and infos["lost"] == 1
    assert env.get_avail_actions(state)["agent_0"].tolist() == [True, False, False, False, False]
    seen, state, rewards, *_ = env.step_env(jax.random.key(0), state, {"agent_0": east, "agent_1": 0})
    assert rewards["agent_0"] == 0 and state.cell.tolist() == [1, 4]
    assert not seen["agent_0"][PLANES.index("self")].any() and not seen["agent_1"][PLANES.index("others")].any()


def planes_by_hand(env: CoverageEnv, state: State, robot: int) -> np.ndarray:
    """What one robot observes of the whole map, with an obstacle around it."""
    cell, alive = np.asarray(state.cell), np.asarray(state.alive)
    planes = np.zeros((len(PLANES), env.world.threat.size))
    planes[0], planes[1] = np.nan_to_num(env.world.threat).ravel(), ~env.world.free.ravel()
    planes[2] = state.visited
    planes[3, cell[robot]] = alive[robot]
    for other in range(env.num_agents):
        if other != robot and alive[other]:
            planes[4, cell[other]] = 1
    planes[5] = alive.mean()
    return planes.reshape(len(PLANES), *env.world.shape)


@pytest.mark.parametrize("view", [None, 0, 2, 12])
def test_planes(view: int | None) -> None:
    env, draw = made(view=view), np.random.default_rng(4)
    states = begin(env, 1, np.arange(20))
    for _ in range(25):
        states, *_ = advance(env)(states, draw.integers(0, 5, (20, ROBOTS)))
    seen = np.asarray(jax.vmap(env.observe)(states))
    for place in range(20):
        state = jax.tree.map(lambda of, place=place: of[place], states)
        for robot in range(ROBOTS):
            planes = planes_by_hand(env, state, robot)
            if view is not None:
                around = ((0, 0), (view, view), (view, view))
                beyond = np.pad(planes[1:2], around, constant_values=1.0)
                planes = np.concatenate([np.pad(planes[:1], around), beyond, np.pad(planes[2:5], around),
                                         np.full_like(beyond, planes[5, 0, 0])])  # fmt: skip
                row, col = divmod(int(state.cell[robot]), COLS)
                planes = planes[:, row : row + 2 * view + 1, col : col + 2 * view + 1]
            np.testing.assert_allclose(seen[place, robot], planes, rtol=1e-6)
    assert np.asarray(states.alive).mean() < 0.9


def test_what_cannot_be_is_refused() -> None:
    env = made()
    for wrong in ({"view": -1}, {"view": 1.5}, {"worth": -1}, {"max_steps": 0}):
        with pytest.raises(InputError):
            CoverageEnv(env.world, **wrong)
    with pytest.raises(InputError, match="value"):
        CoverageEnv(env.world.with_values(2.0))
