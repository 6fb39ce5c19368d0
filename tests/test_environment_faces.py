"""PettingZoo and Gymnasium, and the example that learns by PPO."""

import copy
import importlib.util
import os
import pickle
import sys
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import run_python

import mrac_jax as mrac
from planner.world.generate import random_world
from planner.world.world import World

# The environment's faces: the conformance tests of PettingZoo and Gymnasium, and the same steps as the one in JAX.

gymnasium = pytest.importorskip("gymnasium")
pettingzoo = pytest.importorskip("pettingzoo")
ROBOTS, STEPS = 3, 60


@cache
def world() -> World:
    return random_world(6, 7, obstacles=0.15, threats=0.3)


BOTH = pytest.mark.parametrize("given", [{"max_steps": STEPS}, {"actions": "areas"}], ids=["moves", "areas"])


@BOTH
def test_pettingzoo_conforms(given: dict[str, Any]) -> None:
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    parallel_api_test(mrac.env(world(), ROBOTS, render_mode="rgb_array", **given), num_cycles=100)
    parallel_seed_test(lambda: mrac.env(world(), ROBOTS, **given), num_cycles=STEPS)


@BOTH
def test_gymnasium_conforms(given: dict[str, Any]) -> None:
    from gymnasium.utils.env_checker import check_env

    import mrac_jax.env.gymnasium_env as registered

    one = gymnasium.make(registered.ID, world=world(), robots=ROBOTS, render_mode="rgb_array", **given)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*maximum value is infinity|.*not within the observation|.*Casting")
        check_env(one.unwrapped)
    how: dict[str, Any] = {"num_envs": 2, "vectorization_mode": "vector_entry_point"}
    many = gymnasium.make_vec(registered.ID, world=world(), robots=ROBOTS, **how, **given)
    assert isinstance(many.unwrapped, registered.TeamVectorEnv)


@pytest.mark.parametrize(
    ("given", "count", "steps"),
    [({"max_steps": 12, "robot_value": 2.0}, 4, 30),
     ({"actions": "areas", "rule": "per_cell", "robot_value": 1.0}, 2, 120)],
    ids=["moves", "areas"],
)  # fmt: skip
def test_many_environments_are_single_ones_side_by_side(given: dict[str, Any], count: int, steps: int) -> None:
    """The vector environment against a single one for each rollout; one that is over begins its next rollout."""
    seed = 7
    many = mrac.env(world(), ROBOTS, face="vector", num_envs=count, **given)
    one = mrac.env(world(), ROBOTS, face="gymnasium", **given)
    actions = np.random.default_rng(2).integers(0, many.single_action_space.nvec[0], (steps, count, ROBOTS))
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
                assert info["step"] == now[4]["step"][place]
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


@BOTH
def test_a_picture(given: dict[str, Any]) -> None:
    env = mrac.env(world(), ROBOTS, render_mode="rgb_array", **given)
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
    for face in ("jumanji", "pymarl"):
        with pytest.raises(mrac.InputError, match="left with release"):
            mrac.env(world(), face=face)


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


OUTSIDE = (5, 9, -1, 2.7, np.nan, "north")


def test_an_action_outside_the_space_is_refused_and_changes_nothing() -> None:
    team, many = mrac.env(world(), ROBOTS, face="gymnasium"), mrac.env(world(), ROBOTS, face="vector", num_envs=2)
    alike = {"pettingzoo": mrac.env(world(), ROBOTS), "gymnasium": team, "vector": many}
    others = copy.deepcopy(alike)
    for env in (*alike.values(), *others.values()):
        env.reset(seed=3)
    for wrong in OUTSIDE:
        with pytest.raises(mrac.InputError, match=r"^action of agent_1: .*; expected a whole number, 0 to 4$"):
            alike["pettingzoo"].step({"agent_0": 0, "agent_1": wrong, "agent_2": 0})
        expected = r": .*; expected whole numbers, 0 to 4, of shape"
        with pytest.raises(mrac.InputError, match=rf"^actions(\[1\]|){expected} \(3,\)$"):
            team.step([0, wrong, 0])
        with pytest.raises(mrac.InputError, match=rf"^actions(\[1, 2\]|){expected} \(2, 3\)$"):
            many.step([[0, 0, 0], [0, 0, wrong]])
    right = {"pettingzoo": dict.fromkeys(alike["pettingzoo"].agents, 4), "gymnasium": [4] * 3, "vector": [[4] * 3] * 2}
    for face, actions in right.items():
        assert same(alike[face].step(actions), others[face].step(actions))


def test_areas_that_are_outside_the_space_are_refused() -> None:
    env = mrac.env(world(), 2, actions="areas", offers=3, face="gymnasium")
    env.reset(seed=0)
    for wrong in (4, -1, 0.5, np.nan):
        with pytest.raises(mrac.InputError, match="expected whole numbers, 0 to 3"):
            env.step([0, wrong])


def test_actions_of_another_team_are_refused() -> None:
    parallel = mrac.env(world(), ROBOTS)
    parallel.reset(seed=0)
    with pytest.raises(mrac.InputError, match=r"actions of 'agent_3'; expected a dict .* did you mean 'agent_"):
        parallel.step({"agent_3": 0})
    with pytest.raises(mrac.InputError, match="expected a dict from names of agents, 'agent_0' to 'agent_2'"):
        parallel.step([0, 0, 0])
    for given, missing in (({}, "'agent_0', 'agent_1', 'agent_2'"), ({"agent_1": 4}, "'agent_0', 'agent_2'")):
        with pytest.raises(mrac.InputError, match=f"no action for {missing}; expected a dict"):
            parallel.step(given)
    many = mrac.env(world(), ROBOTS, face="vector", num_envs=2)
    many.reset(seed=0)
    for wrong in (np.zeros((2, 2), int), np.zeros(3, int), [[0, 0, 0], [0, 0]], None):
        with pytest.raises(mrac.InputError, match=r"of shape \(2, 3\)"):
            many.step(wrong)


def test_jax_s_face_checks_what_it_knows() -> None:
    """Names, shapes and types always; values where they are not traced."""
    env = mrac.env(world(), ROBOTS, face="jax")
    key = jax.random.key(0)
    state = env.reset(key)[1]
    right = dict.fromkeys(env.agents, jnp.int32(0))
    for step in (env.step, env.step_env):
        for wrong in (jnp.int32(5), 9, -1, 2.7, jnp.float32(jnp.nan)):
            with pytest.raises(mrac.InputError, match=r"action of agent_1: .*; expected a whole number, 0 to 4"):
                step(key, state, right | {"agent_1": wrong})
        with pytest.raises(mrac.InputError, match="no action for 'agent_2'"):
            step(key, state, {"agent_0": 0, "agent_1": 0})
    with pytest.raises(mrac.InputError, match="action of agent_1: float32 of shape"):
        jax.jit(env.step)(key, state, right | {"agent_1": jnp.float32(1)})
    assert same(jax.jit(env.step)(key, state, right), env.step(key, state, right))


def same(one: Any, other: Any) -> bool:
    equal = jax.tree.map(lambda a, b: np.array_equal(np.asarray(a), np.asarray(b)), one, other)
    return bool(jax.tree.all(equal))


FACES = (("gymnasium", "areas"), ("vector", "moves"), ("pettingzoo", "moves"))


@pytest.mark.parametrize(
    ("again", "faces"),
    [(copy.deepcopy, FACES[:2]), (lambda env: pickle.loads(pickle.dumps(env)), FACES)],
    ids=["copy", "pickle"],
)
def test_a_copy_goes_on_as_the_original(again: Any, faces: Any) -> None:
    """Before the first reset, and in the middle of an episode; of a copy's next episode, too."""
    draw = np.random.default_rng(8)
    for face, actions in faces:
        env = mrac.env(world(), ROBOTS, face=face, actions=actions)

        def taken(face: str = face) -> Any:
            given = draw.integers(0, 4, (1, ROBOTS) if face == "vector" else ROBOTS)
            return {f"agent_{robot}": action for robot, action in enumerate(given)} if face == "pettingzoo" else given

        before = again(env)
        assert same(env.reset(seed=3), before.reset(seed=3))
        for _ in range(3):
            env.step(taken())
        middle = again(env)
        for _ in range(4):
            actions_now = taken()
            assert same(env.step(actions_now), middle.step(actions_now)), face
        assert same(env.reset(), middle.reset())
    whole = mrac.env(world(), ROBOTS, face="jax")
    assert same(*(jax.jit(of.reset)(jax.random.key(2)) for of in (again(whole), whole)))


FORKED = """
import multiprocessing, pickle, sys, warnings
import gymnasium, numpy as np
import mrac_jax as mrac
warnings.filterwarnings("ignore")
world = mrac.load(np.zeros((4, 4)))
make = lambda: mrac.env(world, 2, face="gymnasium")

def tried(begin):
    try:
        return begin()
    except Exception as error:
        return f"{type(error).__name__}: {error}"

def fresh():
    many = gymnasium.vector.AsyncVectorEnv([make] * 2)
    try:
        seen = many.reset(seed=0)[0].sum()
        print(tried(lambda: many.step(np.full((2, 2), 9))))
        return seen
    finally:
        many.close(terminate=True)

def rolled(engine):
    return tried(lambda: mrac.evaluate(world, 2, loop="open", rollouts=64, engine=engine, band=False).visited.mean)

print(tried(fresh))
assert "jax" in sys.modules
one = make()
print(one.reset(seed=0)[0].sum())  # JAX starts
print(tried(fresh))
with multiprocessing.get_context("fork").Pool(1) as pool:
    print(*pool.map(rolled, ["jax", "auto"]), sep="\\n")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_after_a_fork_environments_work_or_say_why_not() -> None:
    """AsyncVectorEnv's default, before and after JAX had started; an engine in a forked pool."""
    wrong, fresh, own, forked, rolled, auto = run_python(FORKED).splitlines()
    assert float(fresh) == 2 * float(own) > 0
    assert wrong == "UsageError: actions[0]: 9; expected whole numbers, 0 to 4, of shape (2,)"
    for said in (forked, rolled):
        assert said.startswith("UsageError: JAX had started before this process was forked")
        assert "context='spawn'" in said and "face='vector'" in said
    assert float(auto) == 1.0


# The example that learns by PPO: in a few updates more than a random walk, by advantages as they are defined.


@pytest.fixture(scope="module")
def ppo() -> Any:
    pytest.importorskip("equinox")
    pytest.importorskip("optax")
    path = Path(__file__).parent.parent / "docs" / "examples" / "ppo.py"
    assert len(path.read_text().splitlines()) <= 200
    spec = importlib.util.spec_from_file_location("ppo", path)
    module = sys.modules["ppo"] = importlib.util.module_from_spec(spec)  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("updates", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_a_few_updates_beat_a_random_walk(ppo: Any, updates: int) -> None:
    said: list[str] = []
    env = mrac.env(ppo.world(), ppo.ROBOTS, face="jax")
    network = ppo.train(env, ppo.Choices(updates=updates, envs=32), 1, said.append)
    assert len(said) == min(updates, 10) and "covered" in said[-1]
    judged = mrac.judge(ppo.world(), ppo.policy_of(network), ppo.ROBOTS, rollouts=256, against=(), progress=False)
    assert judged.score is not None and (judged.score.mean > 5 * judged.score.se or updates < 20)


def test_advantages_are_sums_of_errors(ppo: Any) -> None:
    """By the definition: of what follows, discounted, until the episode is over."""
    draw, choices = np.random.default_rng(0), ppo.Choices()
    reward, value, over = draw.random((9, 2, 3)), draw.random((9, 2, 3)), draw.random((9, 2, 3)) < 0.2
    last, none = draw.random((2, 3)), jnp.zeros((9, 2, 3))
    taken = ppo.Taken(none, none, none, *(jnp.asarray(of, jnp.float32) for of in (value, reward)), none, over)
    found = ppo.advantages(taken, jnp.asarray(last, jnp.float32), choices)
    for env, robot in np.ndindex(2, 3):
        for step in range(9):
            total, weight = 0.0, 1.0
            for at in range(step, 9):
                following = value[at + 1, env, robot] if at < 8 else last[env, robot]
                ends = over[at, env, robot]
                total += weight * (
                    reward[at, env, robot] + choices.discount * following * (not ends) - value[at, env, robot]
                )
                weight *= choices.discount * choices.trace
                if ends:
                    break
            assert abs(total - float(found[step, env, robot])) < 1e-4
    assert jax.tree.leaves(found)[0].dtype == jnp.float32
