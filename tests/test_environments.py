"""Environments: the one in JAX against a plain twin, and areas as actions."""

import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same_trace

import mrac_jax as mrac
from analysis.policy_evaluation.policy_evaluation import roll_policy
from analysis.sampling import RolloutChoices, make_singles
from mrac_jax.arrays import threshold_pairs
from mrac_jax.env.area_env import COLUMNS, AreaEnv
from mrac_jax.env.coverage_env import ACTIONS, AT_ONCE, PLANES, CoverageEnv, State
from planner.failure_model import exp1_thresholds, exposure_of
from planner.make_plan import make_plan
from planner.mission.external_allocation import ChosenRun
from planner.policies import RULES, Rule
from planner.rollouts.single_run import PythonLoop
from planner.settings import Policy, Settings
from planner.simulator.codes import Outcome
from planner.simulator.offers import Offer
from planner.simulator.thresholds import threshold_of
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import Team, World

# The environment in JAX against a plain twin of the rules, step for step; its conventions; the luck of rollouts.

MOVES = {"stay": (0, 0), "north": (-1, 0), "west": (0, -1), "east": (0, 1), "south": (1, 0)}
ROWS, COLS, ROBOTS, STEPS = 7, 9, 3, 150


class Twin:
    """The rules in plain Python: sets of cells, and whole numbers of what robots bear and what a visit adds."""

    def __init__(self, world: World, starts: list[int], bears: list[int], robot_value: float, max_steps: int) -> None:
        self.exposure = exposure_of(world.threat).ravel().tolist()
        self.free = set(np.flatnonzero(world.free).tolist())
        self.robot_value, self.max_steps, self.step, self.width = robot_value, max_steps, 0, world.shape[1]
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
        return new - self.robot_value * (not self.alive[robot])

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
    high, low = np.asarray(jax.jit(threshold_pairs)(words)).astype(np.int64).T
    assert ((high << 32 | low) == threshold_of(words)).all()


def test_transitions_are_those_of_the_plain_rules() -> None:
    """7,000 steps of the team, event for event: places, rewards, who is lost, what was visited, the end."""
    env, seed, rollouts = made(robot_value=2.5, max_steps=STEPS), 2**40 + 11, np.arange(100)
    states, draw = begin(env, seed, rollouts), np.random.default_rng(3)
    starts, bears = (env.starts @ [COLS, 1]).tolist(), exp1_thresholds(seed, rollouts, ROBOTS).tolist()
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
    assert done.all() and taken > 6e3
    assert len({tuple(twin.alive) for twin in twins}) > ROBOTS


def test_a_key_is_a_seed_and_steps_follow_the_conventions() -> None:
    env = made()
    (seen, state), other = env.reset(jax.random.key(5)), begin(env, 5, np.array([0]))
    assert equal(state, jax.tree.map(lambda of: of[0], other))
    assert list(seen) == env.agents and seen["agent_0"].shape == env.observation_space("agent_0").shape
    actions = dict.fromkeys(env.agents, jnp.int32(1))
    keys = jax.random.split(jax.random.key(9), 4)
    plain, same = (jax.jit(step)(keys[0], state, actions) for step in (env.step_env, env.step))
    assert equal(plain, same)
    assert set(plain[3]) == {*env.agents, "__all__"} and set(plain[2]) == set(env.agents)
    assert env.action_space("agent_0").n == len(ACTIONS) and env.agent_classes == {"robot": env.agents}


def test_an_episode_that_is_over_begins_anew() -> None:
    env = made(max_steps=2)
    state, actions = env.reset(jax.random.key(0))[1], dict.fromkeys(env.agents, jnp.int32(0))
    take = jax.jit(env.step)
    for step in (1, 2):
        seen, state, _, dones, infos = take(jax.random.key(step), state, actions)
    assert dones["__all__"] and infos["truncated"] and not state.done and state.step == 0
    fresh = env.reset(jax.random.key(2))
    assert equal((seen, state), fresh)
    again = take(jax.random.key(7), take(jax.random.key(1), fresh[1], actions)[1], actions, fresh[1])[1]
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
    env = CoverageEnv(world, starts=[[0, 0], [1, 0]], robot_value=10.0)
    state, east, take = jax.jit(env.reset)(jax.random.key(1))[1], ACTIONS.index("east"), jax.jit(env.step_env)
    _, state, rewards, dones, infos = take(jax.random.key(0), state, {"agent_0": east, "agent_1": east})
    assert rewards["agent_0"] == 1 - 10 and rewards["agent_1"] == 1
    assert dones["agent_0"] and not dones["agent_1"] and not dones["__all__"] and infos["lost"] == 1
    assert env.get_avail_actions(state)["agent_0"].tolist() == [True, False, False, False, False]
    seen, state, rewards, *_ = take(jax.random.key(0), state, {"agent_0": east, "agent_1": 0})
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
    states = begin(made(), 1, np.arange(20))
    for _ in range(25):
        states, *_ = advance(made())(states, draw.integers(0, 5, (20, ROBOTS)))
    states, seen = jax.tree.map(np.asarray, (states, jax.jit(jax.vmap(env.observe))(states)))
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


# Areas as actions: the rule's first offers are its closed loop; conformance; rewards and masks; many side by side.

BY_SIZE = Rule("by_size", lambda offer: ((offer.level, 1), (-offer.unvisited, 1)))
POLICIES: dict[str, Policy] = {
    **RULES,
    "by_size": BY_SIZE,
    "own": lambda offer: (-offer.level, offer.cost, offer.unvisited),
}
SEEN = {name: place for place, name in enumerate(COLUMNS)}


@cache
def world(seed: int = 1) -> World:
    pattern = ThreatPattern("contiguous" if seed % 2 else "scattered", areas=3, seed=seed)
    return random_world(8 + seed % 5, 9, pattern, obstacles=0.2, threats=0.35)


@pytest.mark.parametrize("policy", POLICIES.values(), ids=list(POLICIES))
def test_the_first_offers_of_a_rule_are_its_closed_loop(policy: Policy) -> None:
    """Event for event, in worlds of both kinds and with hazards that are consumed, with robots that are lost."""
    choices = 0
    for seed in range(1, 4):
        there = world(seed)
        if seed > 2:
            there = there.with_latent_hazard("consumed", 3 * np.nan_to_num(there.threat), 0.4)
        plan = make_plan(there, place_starts(there, 4)[0], Settings(policy=policy))
        loop = PythonLoop(plan, there)
        for rollout in range(2):
            run = ChosenRun(loop, seed, rollout, traced=True)
            run.go_on()
            while run.decision is not None:
                run.go_on(0)
                choices += 1
            assert run.outcome is not None
            assert_same_trace(run.now.trace, loop.trace(seed, rollout))
    assert choices > 40


@pytest.mark.parametrize("rule", ["mrac", "per_cell"])
def test_rollouts_of_one_loop_may_go_on_in_turn(rule: str) -> None:
    """They share scratch, and each has its own luck: what robots meet in doubt too. Choices are drawn."""
    there = world(3)
    there = there.with_latent_hazard("consumed", 3 * np.nan_to_num(there.threat), 0.4)
    loop = PythonLoop(make_plan(there, place_starts(there, 4)[0], Settings(policy=rule)), there)

    def go_on(run: ChosenRun, draw: np.random.Generator) -> None:
        last = -1 if run.decision is None else len(run.decision.offers) - 1
        run.go_on(int(draw.integers(last + 1)) if last >= 0 and draw.random() < 0.8 else None)

    def begun(rollout: int) -> tuple[ChosenRun, np.random.Generator]:
        return ChosenRun(loop, 8, rollout, traced=True), np.random.default_rng(rollout)

    in_turn, asked = [begun(rollout) for rollout in range(5)], 0
    while left := [one for one in in_turn if one[0].outcome is None]:
        for one in left:
            go_on(*one)
            asked += one[0].decision is not None
    for rollout, (run, _) in enumerate(in_turn):
        alone, draw = begun(rollout)
        while alone.outcome is None:
            go_on(alone, draw)
        assert_same_trace(alone.now.trace, run.now.trace)
        assert alone.now.unvisited == run.now.unvisited == loop.loop.accessible - run.now.visited.sum()
        assert alone.new.sum() == run.now.visited.sum()
    assert asked > 20 and not all(run.now.alive.all() for run, _ in in_turn)


@pytest.mark.parametrize(
    "rule", [pytest.param(rule, marks=() if rule in ("mrac", "per_cell") else pytest.mark.slow) for rule in RULES]
)
def test_so_it_is_when_it_is_judged(rule: str) -> None:
    """On the luck of plans, id for id: none ahead, none behind; another process would find the same."""

    def first(seen: np.ndarray) -> np.ndarray:
        assert seen.shape == (3, 5, len(COLUMNS)) and (seen[:, 0, 0] == seen[:, :, 0].max(axis=1)).all()
        return np.ones(len(seen), np.int64)

    given: dict[str, Any] = {"rule": rule, "offers": 5}
    count = 60 if rule == "mrac" else 30
    visited, lost, steps = roll_policy(AreaEnv(world(), 3, **given), first, 4, 20)
    found = make_singles(world(), mrac.plan(world(), 3, policy=rule), RolloutChoices(rollouts=count, seed=4))(0, count)
    sent = pickle.loads(pickle.dumps(AreaEnv(world(), 3, **given)))
    assert (roll_policy(sent, first, 4, 5)[0] == visited[:5]).all()
    assert (visited == found.visited[:20]).all() and (lost == 3 - found.alive[:20]).all()
    assert (steps == found.time[:20]).all()
    judged = mrac.judge(world(), first, 3, actions="areas", **given, rollouts=count, seed=4, against=[rule])
    assert judged.plans[rule].ahead.mean == 0 and 0 < judged.losses.mean == (3 - found.alive).mean() < 3
    assert judged.coverage.mean > judged.random.mean + 3 * judged.random.se
    assert "random areas" in repr(judged)


@pytest.mark.parametrize(
    ("asked", "rule"),
    [({"levels": 2}, "mrac"), ({"in_area": "rows"}, "per_cell"), ({"policy": "per_cell", "robot_value": 1.0}, "mrac")],
)
def test_what_a_world_asks_of_the_planner_counts(asked: dict[str, Any], rule: str) -> None:
    """As in `evaluate` with that policy, which leaves the world's own policy and its limits behind."""
    there = replace(world(), team=Team(settings=asked))
    found = make_singles(there, mrac.plan(there, 3, policy=rule), RolloutChoices(rollouts=8, seed=4))(0, 8)
    given: dict[str, Any] = {"actions": "areas", "rule": rule, "rollouts": 8, "seed": 4, "against": [rule]}
    judged = mrac.judge(there, lambda seen: np.ones(len(seen), np.int64), 3, **given)
    for figures in (judged, judged.plans[rule]):
        assert figures.coverage.mean == pytest.approx(found.visited.mean() / judged.cells, rel=1e-12)
        assert figures.losses.mean == pytest.approx(3 - found.alive.mean(), rel=1e-12)
    assert judged.steps.mean == found.time.mean()
    plain = mrac.judge(world(), lambda seen: np.ones(len(seen), np.int64), 3, **given)
    assert ("robot_value" in asked) == (plain.to_json() == judged.to_json())


def of_offer(order: Any) -> Any:
    """A policy of the observations: the first by the order of what a rule sees."""

    def policy(seen: np.ndarray) -> list[int]:
        names = ("level", "cost", "unvisited", "entry")
        told = [[Offer(*(int(offer[SEEN[name]]) for name in names), int(offer[SEEN["unvisited"]]), 0)
                 for offer in robot if offer[0]] for robot in seen]  # fmt: skip
        return [1 + min(range(len(offers)), key=lambda one: order(offers[one])) if offers else 0 for offers in told]

    return policy


def test_observations_are_what_a_rule_sees() -> None:
    """A policy that orders them by another rule covers as that rule, whose robots travel and cover alike."""
    order = POLICIES["own"]
    assert callable(order)
    there = (AreaEnv(world(2), 4, rule=rule, offers=64) for rule in (BY_SIZE, order))
    mine, theirs = (roll_policy(env, policy, 7, 20) for env, policy in
                    zip(there, (of_offer(order), lambda seen: [1] * 4), strict=True))  # fmt: skip
    assert all((one == other).all() for one, other in zip(mine, theirs, strict=True))
    assert (roll_policy(AreaEnv(world(2), 4, rule=BY_SIZE), lambda seen: [1] * 4, 7, 20)[0] != mine[0]).any()


def test_rewards_masks_and_the_end() -> None:
    """Rewards sum up to the cells visited less the worth of the lost; one robot at a time has offers."""
    env = mrac.env(world(), 4, actions="areas", robot_value=3.0, face="gymnasium")
    draw, asked, lost = np.random.default_rng(1), 0, 0
    env.reset(seed=5)
    for episode in range(15):
        (seen, info), total, over = env.reset(), 0.0, False
        assert not seen.any() and info["action_mask"].sum() == 4 and info["step"] == 0
        while not over:
            masks = info["action_mask"]
            action = [draw.choice(np.flatnonzero(mask)) for mask in masks]
            step = info["step"]
            seen, reward, ended, cut, info = env.step(action)
            total, over = total + reward, ended or cut
            offered = info["action_mask"][:, 1:].sum(axis=1)
            assert (offered > 0).sum() == (not over) and (seen[..., 0].sum(axis=1) == offered).all()
            assert info["step"] >= step
            asked += not over
        cells = env.unwrapped._runs.env.accessible
        assert total == round(info["covered"] * cells) - 3 * info["lost"], episode
        lost += info["lost"]
    assert asked > 60 and lost > 10


def test_who_takes_none_rests_until_areas_change() -> None:
    """Nobody takes an area that it was not given before t = 0: called off, and no robot is asked twice in vain."""
    env = AreaEnv(world(), 3)
    run, asked = env.begin(0, 0), []
    run.go_on()
    while run.decision is not None:
        asked.append((run.now.step, run.decision.robot))
        run.go_on(None)
    assert run.outcome is Outcome.NOT_WORTH_THE_RISK
    assert 0 < len(set(asked)) == len(asked) < 40 and run.now.unvisited > 0


def test_what_cannot_be_is_refused() -> None:
    of_areas = ({"view": 2}, {"offers": 0}, {"face": "jax"}, {"robot_value": -1})
    of_moves = ({"view": -1}, {"view": 1.5}, {"robot_value": -1}, {"max_steps": 0}, {"rule": "mrac"}, {"offers": 3})
    for wrong in (*({"actions": "areas"} | more for more in of_areas), *of_moves, {"actions": "area"}):
        with pytest.raises(mrac.InputError):
            mrac.env(world(), 2, **wrong)
    with pytest.raises(mrac.InputError, match="value"):
        mrac.env(world().with_values(2.0), 2)
    with pytest.raises(mrac.InputError, match="rule='best'; expected 'mrac'"):
        mrac.env(world(), 2, actions="areas", rule="best")
    apart = replace(world(), team=Team(settings={"radio": 3.0}))
    for asked in ({}, {"actions": "areas"}):
        with pytest.raises(mrac.InputError, match="the environment with radio"):
            mrac.env(apart, 2, **asked)
    odd = {
        "weibull_shape": 2.0, "hazard_multiplier": (1.0, 3.0), "range": 9, "return_to": "home", "deadline": 12,
        "plan_for": "open_loop",
    }  # fmt: skip
    for name, value in odd.items():
        apart = replace(world(), team=Team(settings={name: value}))
        for asked in ({}, {"actions": "areas"}):
            with pytest.raises(mrac.InputError, match=f"seed1: the environment with {name}; omit {name}"):
                mrac.env(apart, 2, **asked)
            with pytest.raises(mrac.InputError, match=f"the environment with {name}"):
                mrac.judge(apart, lambda seen: [0] * 2, 2, rollouts=2, **asked)
    plain = replace(
        world(), team=Team(settings={"weibull_shape": 1.0, "hazard_multiplier": (1.0, 1.0), "plan_for": "closed_loop"})
    )
    assert mrac.env(plain, 2).possible_agents == mrac.env(world(), 2).possible_agents
    with pytest.raises(mrac.InputError, match="policy returned"):
        mrac.judge(world(), lambda seen: [9] * 2, 2, actions="areas", rollouts=2)
