"""The environment of `actions="areas"`: an action is the area that a robot works on next; the planner does the rest.

An agent acts where Algorithm 2 decides (semi-Markov): `step` goes on until the next robot needs an area, or the mission
is over. It is the readable executive with luck (`planner.missions.chosen`), in Python.

Axis letters: `K` robots, `M` offers, `F` columns of them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mrac_jax.environment.asked import asked_of
from mrac_jax.environment.running import Next, Told, picture_of
from mrac_jax.environment.spaces import Box, Discrete, checked_actions
from planner.arguments import Numbers, check_word, whole
from planner.luck import Luck
from planner.missions.chosen import ChosenRun
from planner.mrac.make_plan import allocate
from planner.mrac.problem import prepare
from planner.policies import DEFAULT, RULES
from planner.settings import Policy
from planner.tally import Outcome
from planner.worlds.doubt import Hazard
from planner.worlds.starts import starts_of
from planner.worlds.world import World

COLUMNS = ("offered", "own", "level", "cost", "unvisited", "entry", "covered", "alive")
"""What a robot sees of an offer, all 0 where there is none: 1; 1 if it is the area that it has; the numbers of
`planner.policies.offer.Offer`; the share of the accessible cells that is visited; the share of the team alive."""


class AreaEnv:
    """The mission of a team on a world, whose robots are told which area is next.

    Attributes:
        agents: "agent_0" .. "agent_K-1". num_agents: K. accessible: cells that count. starts: int64 `[K, 2]`.
        max_steps: of the team, at which an episode is cut off. worth: what a lost robot takes off its reward, in cells.
        offers: M, areas that a robot is shown at most. walk: what a policy without a thought does, in words.
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
        worth: float = 0.0,
        max_steps: int | None = None,
    ) -> None:
        """`rule`: by which robots travel and cover, and offers are in order. Raises InputError as `CoverageEnv`."""
        placed = starts_of(world, robots, starts)
        (world.check_told if isinstance(world.doubt, Hazard) else world.check_settled)("the environment")
        world.check_alike("the environment")
        Numbers(0).check("worth", worth)
        whole(1, 1024).check("offers", offers)
        if isinstance(rule, str):
            check_word("rule", rule, tuple(RULES))
        whole(1).check("max_steps", max_steps, optional=True)
        self._problem = prepare(world, placed, asked_of(world, policy=rule))
        self._areas = allocate(self._problem)
        self.world, self.starts, self.worth, self.offers = world, placed, float(worth), int(offers)
        self.num_agents, self.accessible = len(placed), int(self._problem.levels.accessible.sum())
        self.max_steps = self._problem.max_steps if max_steps is None else int(max_steps)
        self.agents = [f"agent_{robot}" for robot in range(self.num_agents)]

    def action_space(self, agent: str) -> Discrete:
        """0: go on, or where there are offers none of them; 1 .. M: an offer. What is not there is as 0."""
        return Discrete(self.offers + 1)

    def observation_space(self, agent: str) -> Box:
        """float32 `[M, F]`: of each offer COLUMNS."""
        return Box(0.0, np.inf, (self.offers, len(COLUMNS)))

    def begin(self, seed: int, rollout: int) -> ChosenRun:
        """A rollout, before its first step: the luck of `evaluate`."""
        return ChosenRun(self._problem, self._areas, Luck(self.world, seed, rollout), self.max_steps)

    def take(self, run: ChosenRun, actions: NDArray[np.int64]) -> None:
        """On to the next decision, with an action of each robot `[K]`: of who is to choose, that is."""
        choice = None
        if run.decision is not None:
            action = int(actions[run.decision.robot])
            choice = action - 1 if 1 <= action <= self._offered(run) else None
        run.go_on(choice)

    def _offered(self, run: ChosenRun) -> int:
        return 0 if run.decision is None else min(len(run.decision.offers), self.offers)

    def observe(self, run: ChosenRun) -> NDArray[np.float32]:
        """float32 `[K, M, F]`: the offers to the robot that is to choose, those of the rule's order first."""
        seen = np.zeros((self.num_agents, self.offers, len(COLUMNS)), np.float32)
        if run.decision is not None:
            number = run.decision.robot
            team = 1 - run.team.unvisited / self.accessible, self.alive(run).mean()
            for place, (area, _, offer) in enumerate(run.decision.offers[: self.offers]):
                own = area == run.team.robots[number].area
                seen[number, place] = 1, own, offer.level, offer.cost, offer.unvisited, offer.entry, *team
        return seen

    def legal(self, run: ChosenRun) -> NDArray[np.bool_]:
        """bool `[K, M + 1]`: the actions that are open to each robot."""
        opened = np.zeros((self.num_agents, self.offers + 1), bool)
        opened[:, 0] = True
        if run.decision is not None:
            opened[run.decision.robot, : self._offered(run) + 1] = True
        return opened

    def alive(self, run: ChosenRun) -> NDArray[np.bool_]:
        """bool `[K]`, not lost."""
        return np.array([robot.alive for robot in run.team.robots])

    def roll_out(
        self, act: Callable[[NDArray[np.float32], NDArray[np.bool_], np.random.Generator], NDArray[np.int64]],
        seed: int, start: int, stop: int,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
        """Cells visited, robots lost, steps, int64 `[B]` each, of rollouts `start .. stop - 1` of the seed.

        act: `(observations, open actions, generator of the rollout) -> actions [K]`.
        """
        found = np.zeros((3, stop - start), np.int64)
        for rollout in range(start, stop):
            run, draws = self.begin(seed, rollout), np.random.default_rng([seed, rollout])
            run.go_on()
            while run.decision is not None:
                self.take(run, act(self.observe(run), self.legal(run), draws))
            found[:, rollout - start] = self.accessible - run.team.unvisited, (~self.alive(run)).sum(), run.team.step
        return found[0], found[1], found[2]


class AreaRuns:
    """Environments that go on one after the other; as `Runs`."""

    def __init__(self, env: AreaEnv, count: int = 1) -> None:
        self.env, self._next = env, Next(count)
        self._runs: list[ChosenRun] = []

    def reset(self, seed: int | None = None) -> Told:
        """As of `Runs`; nothing has happened yet, nobody is to choose."""
        rollouts = self._next.begin(seed)
        self._runs = [self.env.begin(self._next.seed, int(rollout)) for rollout in rollouts]
        return self._tell(np.zeros((len(self._runs), self.env.num_agents), np.float32))

    def step(self, actions: ArrayLike) -> Told:
        """As of `Runs`, with actions `[B, K]`; each goes on to its own next decision."""
        if not self._runs:
            raise RuntimeError("step before reset")
        env = self.env
        given = checked_actions(actions, (len(self._runs), env.num_agents), env.offers + 1)
        rewards = np.zeros((len(self._runs), env.num_agents), np.float32)
        rollouts = self._next.after(np.array([run.outcome is not None for run in self._runs]))
        for place, run in enumerate(self._runs):
            if run.outcome is not None:
                self._runs[place] = env.begin(self._next.seed, int(rollouts[place]))
                continue
            new, alive = np.array(run.team.new), env.alive(run)
            env.take(run, given[place])
            rewards[place] = run.team.new - new - env.worth * (alive & ~env.alive(run))
        return self._tell(rewards)

    def _tell(self, rewards: NDArray[np.float32]) -> Told:
        env, runs = self.env, self._runs
        alive = np.array([env.alive(run) for run in runs])
        return Told(
            seen=np.array([env.observe(run) for run in runs]),
            legal=np.array([env.legal(run) for run in runs]),
            rewards=rewards,
            alive=alive,
            done=np.array([run.outcome is not None for run in runs]),
            truncated=np.array([run.outcome is Outcome.STEP_LIMIT for run in runs]),
            covered=np.array([1 - run.team.unvisited / env.accessible for run in runs], np.float32),
            lost=(~alive).sum(axis=1, dtype=np.int32),
            step=np.array([max(run.team.step, 0) for run in runs], np.int32),
        )

    def picture(self) -> NDArray[np.uint8]:
        """As of `Runs`."""
        if not self._runs:
            raise RuntimeError("render before reset")
        team = self._runs[0].team
        cells = np.array([robot.cell for robot in team.robots])
        return picture_of(self.env.world, team.visited, cells, self.env.alive(self._runs[0]))
