"""The environment of `actions="areas"`: an action is the robot's next area; the planner drives the robot.

An agent acts where Algorithm 2 decides (semi-Markov): `step` runs until the next robot needs an area, or the mission is
over. It is the simulator as Python (`planner.mission.external_allocation`), with the random numbers of `evaluate`.

Axis letters: `K` robots, `M` offers, `F` columns of an offer.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.env import coverage_env
from mrac_jax.process import fixed_flags
from planner.arguments import MAX_STEP, argument, check_word, whole
from planner.errors import UsageError
from planner.failure_model import key_of
from planner.make_plan import allocated
from planner.mission.external_allocation import ChosenRun
from planner.policies import DEFAULT, RULES
from planner.rollouts.single_run import PythonLoop
from planner.settings import Policy
from planner.simulator.codes import Outcome
from planner.world.world import World

COLUMNS = ("offered", "own", "level", "cost", "unvisited", "entry", "covered", "alive")
"""Observed columns of an offer, all 0 without an offer: 1; 1 if the robot already has the area; the numbers of
`planner.simulator.offers.Offer`; the share of the accessible cells that is visited; the share of the team alive."""


class AreaEnv(coverage_env.Mission):
    """The mission of a team on a world, with the choice of areas as actions.

    Attributes:
        max_steps: end of an episode.
        offers: M, largest number of offered areas. walk: name of the random baseline policy.
    """

    walk = "random areas"

    def __init__(
        self,
        world: World,
        robots: int | None = None,
        *,
        starts: ArrayLike | None = None,
        rule: Policy = DEFAULT,
        offers: int = 8,
        robot_value: float = 0.0,
        max_steps: int | None = None,
    ) -> None:
        """`rule`: moves the robots and orders the offers. Raises InputError as `CoverageEnv`."""
        if isinstance(rule, str):
            check_word("rule", rule, tuple(RULES))
        super().__init__(world, robots, starts, robot_value, policy=rule)
        whole(1, 1024).check("offers", offers)
        whole(1).check("max_steps", max_steps, optional=True)
        self._problem, self._plan = allocated(world, self.starts, self.settings)
        self.offers = int(offers)
        self.max_steps = self._problem.max_steps if max_steps is None else int(max_steps)

    @cached_property
    def _loop(self) -> PythonLoop:
        loop = PythonLoop(self._plan, self.world, problem=self._problem)
        # The step limit is part of the loop, so that a rollout ends with the outcome STEP_LIMIT.
        loop.loop = replace(loop.loop, max_steps=min(self.max_steps, MAX_STEP))
        return loop

    def __getstate__(self) -> dict[str, Any]:
        """State for other processes, which build the loop themselves."""
        return {name: value for name, value in vars(self).items() if name != "_loop"}

    def action_space(self, agent: str) -> coverage_env.Discrete:
        """0: continue, or with offers none of them; 1 .. M: an offer. A missing offer counts as 0."""
        return coverage_env.Discrete(self.offers + 1)

    def observation_space(self, agent: str) -> coverage_env.Box:
        """float32 `[M, F]`: COLUMNS of each offer."""
        return coverage_env.Box(0.0, np.inf, (self.offers, len(COLUMNS)))

    def begin(self, seed: int, rollout: int) -> ChosenRun:
        """A rollout before its first step, with the random numbers of `evaluate`."""
        return ChosenRun(self._loop, seed, rollout)

    def take(self, run: ChosenRun, actions: NDArray[np.int64]) -> None:
        """Run to the next decision, with actions of all robots `[K]`; only the deciding robot's action counts."""
        choice = None
        if run.decision is not None:
            action = int(actions[run.decision.robot])
            # A missing offer counts as "none", as the number of offers varies.
            choice = action - 1 if 1 <= action <= self._offered(run) else None
        run.go_on(choice)

    def _offered(self, run: ChosenRun) -> int:
        return 0 if run.decision is None else min(len(run.decision.offers), self.offers)

    def observe(self, run: ChosenRun) -> NDArray[np.float32]:
        """float32 `[K, M, F]`: the offers to the deciding robot, in the rule's order."""
        seen = np.zeros((self.num_agents, self.offers, len(COLUMNS)), np.float32)
        if run.decision is not None:
            number = run.decision.robot
            team = 1 - run.now.unvisited / self.accessible, self.alive(run).mean()
            mine = run.now.area(number)
            for place, (area, _, offer) in enumerate(run.decision.offers[: self.offers]):
                own = area == mine
                seen[number, place] = 1, own, offer.level, offer.cost, offer.unvisited, offer.entry, *team
        return seen

    def legal(self, run: ChosenRun) -> NDArray[np.bool_]:
        """bool `[K, M + 1]`: the legal actions of each robot."""
        opened = np.zeros((self.num_agents, self.offers + 1), bool)
        opened[:, 0] = True
        if run.decision is not None:
            opened[run.decision.robot, : self._offered(run) + 1] = True
        return opened

    def alive(self, run: ChosenRun) -> NDArray[np.bool_]:
        """bool `[K]`, not lost."""
        return run.now.alive

    def roll_out(
        self, act: Callable[[NDArray[np.float32], NDArray[np.bool_], np.random.Generator], NDArray[np.int64]],
        seed: int, start: int, stop: int,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
        """Cells visited, robots lost, steps, int64 `[B]` each, of rollouts `start .. stop - 1` of the seed.

        act: `(observations, legal actions, generator of the rollout) -> actions [K]`.
        """
        found = np.zeros((3, stop - start), np.int64)
        for rollout in range(start, stop):
            run, draws = self.begin(seed, rollout), np.random.default_rng([seed, rollout])
            run.go_on()
            while run.decision is not None:
                self.take(run, act(self.observe(run), self.legal(run), draws))
            found[:, rollout - start] = self.accessible - run.now.unvisited, (~self.alive(run)).sum(), run.now.step
        return found[0], found[1], found[2]


class AreaRuns:
    """Environments that run one after the other; see `Runs`."""

    def __init__(self, env: AreaEnv, count: int = 1) -> None:
        self.env, self._next = env, coverage_env.Next(count)
        self._runs: list[ChosenRun] = []

    def reset(self, seed: int | None = None) -> coverage_env.StepBatch:
        """As in `Runs`; before the first decision."""
        rollouts = self._next.begin(seed)
        self._runs = [self.env.begin(self._next.seed, int(rollout)) for rollout in rollouts]
        return self._tell(np.zeros((len(self._runs), self.env.num_agents), np.float32))

    def step(self, actions: ArrayLike) -> coverage_env.StepBatch:
        """As in `Runs`, with actions `[B, K]`; each environment runs to its next decision."""
        if not self._runs:
            raise RuntimeError("step before reset")
        env = self.env
        given = coverage_env.checked_actions(actions, (len(self._runs), env.num_agents), env.offers + 1)
        rewards = np.zeros((len(self._runs), env.num_agents), np.float32)
        rollouts = self._next.after(np.array([run.outcome is not None for run in self._runs]))
        for place, run in enumerate(self._runs):
            if run.outcome is not None:
                self._runs[place] = env.begin(self._next.seed, int(rollouts[place]))
                continue
            new, alive = run.new, env.alive(run)
            env.take(run, given[place])
            # Several steps pass between decisions: the reward sums them.
            rewards[place] = run.new - new - env.robot_value * (alive & ~env.alive(run))
        return self._tell(rewards)

    def _tell(self, rewards: NDArray[np.float32]) -> coverage_env.StepBatch:
        env, runs = self.env, self._runs
        alive = np.array([env.alive(run) for run in runs])
        return coverage_env.StepBatch(
            seen=np.array([env.observe(run) for run in runs]),
            legal=np.array([env.legal(run) for run in runs]),
            rewards=rewards,
            alive=alive,
            done=np.array([run.outcome is not None for run in runs]),
            truncated=np.array([run.outcome is Outcome.STEP_LIMIT for run in runs]),
            covered=np.array([1 - run.now.unvisited / env.accessible for run in runs], np.float32),
            lost=(~alive).sum(axis=1, dtype=np.int32),
            step=np.array([max(run.now.step, 0) for run in runs], np.int32),
        )

    def picture(self) -> NDArray[np.uint8]:
        """As in `Runs`."""
        if not self._runs:
            raise RuntimeError("render before reset")
        now = self._runs[0].now
        cells = now.loop.cells[now.raw.robots["cell"]]
        return coverage_env.picture_of(self.env.world, now.visited, cells, now.alive)


# Creation of both environments, and episodes of them.

Actions = Literal["moves", "areas"]
ONLY_OF = {"view": "moves", "rule": "areas", "offers": "areas"}
"""Arguments for one kind of actions only."""


def make_env(
    world: World,
    robots: int | None = None,
    *,
    actions: Actions = "moves",
    starts: ArrayLike | None = None,
    robot_value: float = 0.0,
    max_steps: int | None = None,
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
) -> coverage_env.CoverageEnv | AreaEnv:
    """The environment of these actions; arguments as in `mrac.env`. Raises InputError."""
    check_word("actions", actions, get_args(Actions))
    more: dict[str, Any] = {"starts": starts, "robot_value": robot_value, "max_steps": max_steps}
    given: dict[str, Any] = {"view": view, "rule": rule, "offers": offers}
    for name, value in given.items():
        if value is not None and ONLY_OF[name] != actions:
            problem = f"{argument(name, value)}, with {argument('actions', actions)}"
            raise UsageError(problem, expected=argument("actions", ONLY_OF[name]), fix="omit it")
    own = {name: value for name, value in given.items() if value is not None}
    return (AreaEnv if actions == "areas" else coverage_env.CoverageEnv)(world, robots, **more, **own)


def runs_of(env: coverage_env.CoverageEnv | AreaEnv, count: int = 1) -> coverage_env.Runs | AreaRuns:
    """Episodes of `count` environments."""
    return AreaRuns(env, count) if isinstance(env, AreaEnv) else coverage_env.Runs(env, count)


# Complete rollouts of a policy in the environment: compiled if the policy is, else called step by step.

AT_ONCE = 256
"""Rollouts that run side by side, if their observations fit into SEEN bytes."""
SEEN = 2**27
Ended = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
"""Cells visited, robots lost, steps, int64 `[B]` each."""


class PolicyRollouts:
    """Rollouts of a policy, in any order: each depends only on its id and the seed. Can be sent to other processes.

    Attributes:
        spans: (start, stop) of groups of rollouts 0 .. count - 1 that run side by side.
        compiled: the rollouts run without Python.
    """

    def __init__(
        self, env: coverage_env.CoverageEnv | AreaEnv, policy: Callable[..., Any] | None, seed: int, count: int
    ) -> None:
        """policy: a function from the observations of all robots, float32 `[K, ...]`, to their actions `[K]`.

        A second parameter receives a random key of the rollout (a NumPy generator if it is not compiled). Under
        `jax.jit` with moves as actions it runs inside the compiled rollouts. None: a random walk over the legal
        actions. An invalid policy raises UsageError when it is called.
        """
        self._env, self._policy, self._seed = env, policy, seed
        self.compiled = isinstance(env, coverage_env.CoverageEnv) and (policy is None or hasattr(policy, "lower"))
        seen = 4 * env.num_agents * int(np.prod(env.observation_space(env.agents[0]).shape))
        self._width = min(count, AT_ONCE if self.compiled else max(1, min(AT_ONCE, SEEN // seen)))
        self.spans = [(start, min(start + self._width, count)) for start in range(0, count, self._width)]

    @cached_property
    def _run(self) -> Callable[[jax.Array, jax.Array], tuple[coverage_env.State, Any]]:
        assert isinstance(self._env, coverage_env.CoverageEnv)
        if self._policy is None or self.compiled:
            return jax.jit(jax.vmap(_compiled(self._env, self._policy), (None, 0)))
        return _Asked(self._env, self._policy, self._seed)

    @fixed_flags(user_code=True)
    def __call__(self, span: tuple[int, int]) -> Ended:
        """Rollouts `start .. stop - 1`. Raises UsageError for actions out of range."""
        if isinstance(self._env, AreaEnv):
            return self._env.roll_out(_chooser(self._env, self._policy), self._seed, *span)
        words, (start, stop) = jnp.asarray(key_of(self._seed), jnp.uint32), span
        last = start + self._width if self.compiled else stop  # one width, one program
        # Surplus rollouts of the last group are computed and dropped.
        state, valid = self._run(words, jnp.arange(start, last, dtype=jnp.uint32))
        if not np.asarray(valid).all():
            raise UsageError(
                "the policy returned actions out of range", expected=_whole_numbers(len(coverage_env.ACTIONS))
            )
        visited, lost, steps = (
            np.asarray(of)[: stop - start].astype(np.int64)
            for of in (state.covered, (~state.alive).sum(axis=1), state.step)
        )
        return visited, lost, steps


def _asking(policy: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """The policy as a function of two arguments; its exceptions become UsageErrors."""
    try:
        takes_key = len(inspect.signature(policy).parameters) > 1
    except (TypeError, ValueError):
        takes_key = False

    def ask(seen: Any, key: Any) -> Any:
        try:
            return policy(seen, key) if takes_key else policy(seen)
        except Exception as error:
            raise UsageError(f"the policy raised {type(error).__name__}: {error}") from error

    return ask


def _chooser(
    env: AreaEnv, policy: Callable[..., Any] | None
) -> Callable[[NDArray[np.float32], NDArray[np.bool_], np.random.Generator], NDArray[np.int64]]:
    """The function for `AreaEnv.roll_out`; without a policy one of the offers, or none, with equal probabilities."""
    ask, compiled = None if policy is None else _asking(policy), hasattr(policy, "lower")

    def act(seen: NDArray[np.float32], legal: NDArray[np.bool_], draws: np.random.Generator) -> NDArray[np.int64]:
        if ask is None:
            return draws.integers(0, legal.sum(axis=1))
        key = jax.random.key(int(draws.integers(2**32)), impl="threefry2x32") if compiled else draws
        return _checked(env, ask(seen, key), env.offers + 1)

    return act


def _checked(env: coverage_env.CoverageEnv | AreaEnv, actions: Any, most: int) -> NDArray[Any]:
    """The policy's result, if it is an action below `most` for each robot. Raises UsageError."""
    given = np.asarray(actions)
    _check(env, given)
    if not ((given >= 0) & (given < most)).all():
        raise UsageError(f"the policy returned {given.tolist()}", expected=_whole_numbers(most))
    return given


def _check(env: coverage_env.CoverageEnv | AreaEnv, given: Any) -> None:
    if given.shape != (env.num_agents,):
        problem = f"the policy returned actions of shape {given.shape}"
        raise UsageError(problem, expected=f"({env.num_agents},), one for each robot")
    if given.dtype.kind not in "iu":
        raise UsageError(f"the policy returned actions of {given.dtype}", expected="whole numbers")


def _whole_numbers(count: int) -> str:
    return f"whole numbers, 0 to {count - 1}"


def _compiled(
    env: coverage_env.CoverageEnv, policy: Callable[..., Any] | None
) -> Callable[[jax.Array, jax.Array], tuple]:
    """One rollout, `(seed words, id) -> (last state, whether all actions were in range)`."""
    ask = None if policy is None else _asking(policy)
    closed = jnp.float32(-1e9)  # probability 0 without an infinity, which JAX_DEBUG_INFS would report

    def actions_of(state: coverage_env.State, key: jax.Array) -> jax.Array:
        if ask is None:
            actions = jax.random.categorical(key, jnp.where(env.legal(state), jnp.float32(0), closed))
        else:
            actions = jnp.asarray(ask(env.observe(state), key))
            _check(env, actions)
        return actions.astype(jnp.int32)

    def step(key: jax.Array, state: coverage_env.State, valid: jax.Array) -> tuple[coverage_env.State, jax.Array]:
        actions = actions_of(state, jax.random.fold_in(key, state.step))
        valid &= ((actions >= 0) & (actions < len(coverage_env.ACTIONS))).all()
        return env.advance(state, actions)[0], valid

    def one(seed: jax.Array, rollout: jax.Array) -> tuple[coverage_env.State, jax.Array]:
        key = jax.random.fold_in(jax.random.wrap_key_data(seed, impl="threefry2x32"), rollout)
        begun = env.begin(seed, rollout), jnp.bool_(True)
        return jax.lax.while_loop(lambda now: ~now[0].done, lambda now: step(key, *now), begun)

    return one


class _Asked:
    """Rollouts side by side, with a Python call for each team's actions."""

    def __init__(self, env: coverage_env.CoverageEnv, policy: Callable[..., Any], seed: int) -> None:
        self.env, self.ask, self.seed = env, _asking(policy), seed
        self._begin = jax.jit(jax.vmap(env.begin, (None, 0)))
        self._advance = jax.jit(jax.vmap(self._advanced))
        self._observe = jax.jit(jax.vmap(env.observe))

    def __call__(self, seed: jax.Array, rollouts: jax.Array) -> tuple[coverage_env.State, bool]:
        """The last states, and True: actions were checked; finished rollouts wait for the others."""
        states = self._begin(seed, rollouts)
        draws = [np.random.default_rng([self.seed, int(rollout)]) for rollout in rollouts]
        while not (done := np.asarray(states.done)).all():
            seen, actions = np.asarray(self._observe(states)), np.zeros((len(done), self.env.num_agents), np.int32)
            for place in np.flatnonzero(~done):
                # Each rollout has its own generator, so the result does not depend on the grouping.
                actions[place] = self._asked(seen[place], draws[place])
            states = self._advance(states, actions)
        return states, True

    def _advanced(self, state: coverage_env.State, actions: jax.Array) -> coverage_env.State:
        """The next state; a finished rollout does not change."""
        after = self.env.advance(state, actions)[0]
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def _asked(self, seen: NDArray[np.float32], draws: np.random.Generator) -> NDArray[np.int32]:
        return _checked(self.env, self.ask(seen, draws), len(coverage_env.ACTIONS))
