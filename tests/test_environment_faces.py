"""The environment's faces: the conformance tests of PettingZoo and Gymnasium, and the same steps as the one in JAX."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mrac_jax as mrac
from planner.worlds.generate import random_world
from planner.worlds.world import World

gymnasium = pytest.importorskip("gymnasium")
pettingzoo = pytest.importorskip("pettingzoo")
ROBOTS, STEPS = 3, 60


@cache
def world() -> World:
    return random_world(6, 7, obstacles=0.15, threats=0.3)


def test_pettingzoo_conforms() -> None:
    from pettingzoo.test import parallel_api_test
    from pettingzoo.test.seed_test import check_environment_deterministic_parallel

    env = mrac.env(world(), ROBOTS, max_steps=STEPS)
    parallel_api_test(env, num_cycles=100)
    check_environment_deterministic_parallel(env, mrac.env(world(), ROBOTS, max_steps=STEPS), num_cycles=STEPS)


def test_gymnasium_conforms() -> None:
    from gymnasium.utils.env_checker import check_env

    import mrac_jax.environment.gymnasium_env as registered

    one = gymnasium.make(registered.ID, world=world(), robots=ROBOTS, max_steps=STEPS, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not within the observation space|.*Casting")
        check_env(one.unwrapped)
    many = gymnasium.make_vec(registered.ID, num_envs=2, vectorization_mode="vector_entry_point", world=world())
    assert isinstance(many.unwrapped, registered.TeamVectorEnv)


def test_many_environments_are_single_ones_side_by_side() -> None:
    """The vector environment against a single one for each rollout; one that is over begins its next rollout."""
    count, seed = 4, 7
    given: dict[str, Any] = {"robots": ROBOTS, "max_steps": 12, "worth": 2.0}
    many = mrac.env(world(), face="vector", num_envs=count, **given)
    one = mrac.env(world(), face="gymnasium", **given)
    actions = np.random.default_rng(2).integers(0, 5, (30, count, ROBOTS))
    seen, infos = many.reset(seed=seed)
    told = [(seen, None, None, None, infos), *(many.step(given) for given in actions)]
    assert many.observation_space.contains(seen) and many.action_space.contains(actions[0])
    for place in range(count):
        episode, over = place, True
        for step, now in enumerate(told):
            if over:
                one.reset(seed=seed)
                for _ in range(episode):
                    last = one.reset()
                assert (last[0] if episode else one.reset(seed=seed)[0]).tobytes() == now[0][place].tobytes()
                assert step == 0 or (now[1][place] == 0 and not now[2][place] and not now[3][place])
                over, episode = False, episode + count
            else:
                observed, reward, ended, cut, info = one.step(actions[step - 1][place])
                assert observed.tobytes() == now[0][place].tobytes()
                assert (reward, ended, cut) == (now[1][place], now[2][place], now[3][place])
                assert (info["action_mask"] == now[4]["action_mask"][place]).all()
                over = ended or cut
        assert episode > count


def test_pettingzoo_steps_as_jax() -> None:
    """Observations, rewards, who ends, masks; `reset()` goes on to the next rollout of the seed."""
    parallel, env = mrac.env(world(), ROBOTS, max_steps=STEPS), mrac.env(world(), ROBOTS, max_steps=STEPS, face="jax")
    draw, lost, take = np.random.default_rng(5), 0, jax.jit(env.step_env)
    parallel.reset(seed=3)
    for rollout in (1, 2, 3):
        seen, infos = parallel.reset()
        state = env.begin(jnp.array([3, 0], jnp.uint32), jnp.uint32(rollout))
        while parallel.agents:
            masks = env.get_avail_actions(state)
            assert all((infos[name]["action_mask"] == masks[name]).all() for name in parallel.agents)
            there, given = list(parallel.agents), dict(zip(env.agents, draw.integers(0, 5, ROBOTS), strict=True))
            seen, rewards, ends, cuts, infos = parallel.step({name: given[name] for name in there})
            expected, state, gains, dones, told = take(jax.random.key(0), state, given)
            for name in there:
                assert (seen[name] == expected[name]).all() and rewards[name] == gains[name]
                assert (ends[name] or cuts[name]) == dones[name]
            lost += sum(ends.values())
        assert dones["__all__"] and any(cuts.values()) == told["truncated"]
    assert lost > 0


def test_a_picture() -> None:
    env = mrac.env(world(), ROBOTS, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (48, 56, 3) and len(np.unique(env.render())) > 3
    assert mrac.env(world(), ROBOTS).render() is None


def test_what_cannot_be_is_refused() -> None:
    for wrong in (
        {"face": "gym"},
        {"num_envs": 0},
        {"robots": 0},
        {"starts": [[0, 99]]},
        {"actions": "area"},
        {"render_mode": "human"},
        {"face": "jax", "render_mode": "rgb_array"},
    ):
        with pytest.raises(mrac.InputError):
            mrac.env(world(), **wrong)


def test_jumanji_conforms() -> None:
    pytest.importorskip("jumanji")
    from jumanji.testing.env_not_smoke import check_env_does_not_smoke, check_env_specs_does_not_smoke

    env = mrac.env(world(), ROBOTS, max_steps=STEPS, face="jumanji")
    check_env_does_not_smoke(env)
    check_env_specs_does_not_smoke(env)


def test_jaxmarl_wraps_it() -> None:
    pytest.importorskip("jaxmarl")
    from jaxmarl.wrappers.baselines import LogWrapper

    env = LogWrapper(mrac.env(world(), ROBOTS, max_steps=5, face="jax"))
    _, state = env.reset(jax.random.key(0))
    actions = dict.fromkeys(env.agents, jnp.int32(4))
    for step in range(5):
        *_, infos = env.step(jax.random.key(step), state, actions)
        state = _[1]
    assert infos["returned_episode"].all()
