"""The closed loop as a tree of everything that can happen, from the plain oracle alone."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracle_simulator import Paper, PerCell

from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.codes import NO_ROBOT
from planner.world.world import World

# The closed loop as a tree of everything that can happen, played by the plain oracle: exact expected values.
#
# A run is decided by which of its checked visits stop a robot. So all runs begin as one branch, and at each dangerous
# visit a branch parts in two: one in which the robot is stopped, and one in which it goes on. Branches are played
# step by step side by side, and those that come to equal states are joined. The cost grows like (dangerous visits of
# a robot) ** (robots - 1) steps. The oracle of the rollouts and of `planner.rollouts.exact_tree`; it shares no code
# with them.

OUTCOMES = ("complete", "all_robots_lost", "no_progress", "step_limit", "not_worth_the_risk")
"""How rollouts of the closed loop can end; the last one is never the oracle's."""
RULES = {"mrac": Paper, "per_cell": PerCell}


def plain_run(plan: Plan, world: World) -> Paper:
    """The plan's closed loop before its first step.

    Raises PlanError of a plan for another map, ValueError of one with what the oracle knows nothing of.
    """
    settings = plan.require(world)
    asked = settings.policy, settings.transit, settings.max_steps, settings.density, settings.levels
    policy, transit, last, density, levels = asked
    plain = Settings(policy=policy, transit=transit, max_steps=last, density=density, levels=levels)
    odd = world.knowledge, world.uncertainty, world.value, world.types, world.moving_threats, plan.state
    if settings != plain or policy not in RULES or plan.is_external or any(one is not None for one in odd):
        raise ValueError("the plain oracle knows `mrac` and `per_cell` alone, without limits, on a map that is known")
    starts = [(row, col) for row, col in plan.starts.tolist()]
    run = RULES[policy](world.threat.astype(np.float64), starts, plain_areas(plan), last, inside=transit == "area")
    if len(run.scale) > levels:
        raise ValueError("the plain oracle knows no bins of threats")
    return run


def plain_areas(plan: Plan) -> list[tuple[int, int | None, list[tuple[int, int]]]]:
    """The plan's allocation as the oracle has it."""
    width = plan.shape[1]
    return [
        (area.level, None if area.robot == NO_ROBOT else area.robot, [divmod(c, width) for c in area.cells.tolist()])
        for area in plan.areas
    ]


@dataclass(eq=False)
class Branch:
    """A run in progress. `turn`: the robot that acts next in its step. `chance`: of everything that has happened."""

    run: Paper
    turn: int
    chance: float


@dataclass(frozen=True)
class End:
    """A run that is over: how, and with how many cells covered, at which step, with how many robots left."""

    chance: float
    outcome: str
    visited: int
    survived: int
    time: int
    alive: int


class Tree:
    """A closed loop, to be played as a tree.

    Args:
        root: the run before its first step. threat: p of its cells `[H, W]`.
        first_only: `threat_checks="first_visit"`.

    Attributes:
        accessible: cells. robots: K.
    """

    def __init__(self, root: Paper, threat: NDArray, *, first_only: bool = False) -> None:
        self._root, self._first_only = root, first_only
        self.accessible, self.robots = len(root.goal), len(root.team)
        self._threat = {cell: float(threat[cell]) for cell in root.goal}

    def start(self) -> Branch:
        """The run before any robot has entered its start."""
        return Branch(self._root.fork(), 0, 1.0)

    def step(self, branch: Branch) -> tuple[list[Branch], list[End]]:
        """All that can happen in the branch's next step: the branches that go on after it, and the ends.

        `branch` itself becomes the one in which nobody is stopped.
        """
        to_play, going, ends = [branch], [], []
        while to_play:
            branch = to_play.pop()
            for found in self._play(branch):
                if isinstance(found, End):
                    ends.append(found)
                else:
                    to_play.append(found)
            if branch.run.outcome:
                ends.append(self._end(branch.run, branch.chance, branch.run.outcome))
            else:
                going.append(branch)
        return going, ends

    def _play(self, branch: Branch) -> Iterator[Branch | End]:
        """The rest of the step, in which nobody is stopped; what else may happen: copies in mid-step, or ends."""
        run = branch.run
        for robot in range(branch.turn, self.robots):
            cell = run.decide(robot)
            if cell is None:
                continue
            threat = 0 if self._first_only and cell in run.visited else self._threat[cell]
            run.enter(robot)
            if threat:
                chance = branch.chance * threat
                branch.chance *= 1 - threat
                if alive(run) == 1:  # nothing follows: no copy is needed
                    outcome = "complete" if run.goal <= run.visited else "all_robots_lost"
                    yield self._end(run, chance, outcome, lost=1)
                else:
                    other = run.fork()
                    other.lose(robot)
                    yield Branch(other, robot + 1, chance)
            run.survive(robot)
        run.end_step()
        branch.turn = 0

    def _end(self, run: Paper, chance: float, outcome: str, lost: int = 0) -> End:
        return End(chance, outcome, len(run.visited), len(run.survived), run.step, alive(run) - lost)


def alive(run: Paper) -> int:
    """Robots not stopped so far."""
    return sum(walker.doing != "dead" for walker in run.team)


@dataclass(frozen=True, eq=False)
class ClosedLoopExact:
    """Expected values and distributions over everything that can happen. Axes: `A` accessible cells, `K` robots.

    Attributes:
        visited, survived: cells. time: steps. alive: robots.
        complete, all_robots_lost, no_progress, step_limit, not_worth_the_risk: probabilities of the outcomes.
        visited_chance, survived_chance: float64 `[A + 1]`, chance of so many cells. alive_chance: float64 `[K + 1]`,
            chance that so many robots are alive at the end. time_chance: float64 `[T + 1]`, chance that the run ends at
            that step.
        branches: played from one parting to the next. ends: reached, those of equal states counted once.
    """

    visited: float
    survived: float
    time: float
    alive: float
    complete: float
    all_robots_lost: float
    no_progress: float
    step_limit: float
    not_worth_the_risk: float
    visited_chance: NDArray[np.float64]
    survived_chance: NDArray[np.float64]
    alive_chance: NDArray[np.float64]
    time_chance: NDArray[np.float64]
    branches: int
    ends: int


def closed_loop_exact(plan: Plan, world: World, *, first_only: bool = False) -> ClosedLoopExact:
    """The closed loop's expected values and distributions (SPEC section 6; the paper's Algorithm 2).

    Args:
        plan, world: as of `plain_run`, which may raise.
        first_only: `threat_checks="first_visit"`.
    """
    return exactly(Tree(plain_run(plan, world), world.threat, first_only=first_only))


def exactly(tree: Tree) -> ClosedLoopExact:
    """The same of any run."""
    ends: list[End] = []
    branches, now = 0, [tree.start()]
    while now:
        after: list[Branch] = []
        for branch in now:
            going, over = tree.step(branch)
            branches += bool(over or len(going) > 1)
            after += going
            ends += over
        now = _joined(after)
    return _summed(ends, branches, tree)


def _joined(branches: list[Branch]) -> list[Branch]:
    """Branches of equal states as one. Only those whose robots stand alike are compared: states are long."""
    alike: defaultdict[tuple[object, ...], list[Branch]] = defaultdict(list)
    for branch in branches:
        where = tuple(walker.doing != "dead" and walker.at for walker in branch.run.team)
        alike[len(branch.run.visited), where].append(branch)
    kept: list[Branch] = []
    for group in alike.values():
        same: dict[tuple[object, ...], Branch] = {}
        for branch in group:
            one = same.setdefault(branch.run.state_key() if len(group) > 1 else (), branch)
            if one is not branch:
                one.chance += branch.chance
        kept += same.values()
    return kept


def _summed(ends: list[End], branches: int, tree: Tree) -> ClosedLoopExact:
    weights = np.array([end.chance for end in ends])
    outcomes = np.bincount([OUTCOMES.index(end.outcome) for end in ends], weights, len(OUTCOMES))
    values: dict[str, Any] = dict(zip(OUTCOMES, outcomes.tolist(), strict=True))
    cells = tree.accessible + 1
    for figure, size in (("visited", cells), ("survived", cells), ("time", 0), ("alive", tree.robots + 1)):
        chance = np.bincount([getattr(end, figure) for end in ends], weights, size)
        values |= {figure: float(chance @ np.arange(len(chance))), f"{figure}_chance": chance}
    return ClosedLoopExact(**values, branches=branches, ends=len(ends))
