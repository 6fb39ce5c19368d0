"""The closed loop as a tree of everything that can happen, played by the readable simulator: exact expected values.

A run is decided by which of its checked visits stop a robot. So all runs begin as one branch, and at each dangerous
visit a branch parts in two: one in which the robot is stopped, and one in which it goes on. Branches are played step by
step side by side, and those that come to equal states are joined. The cost grows like (dangerous visits of a robot) **
(robots - 1) steps. The oracle of the rollouts and of `planner.simulator.exact_tree`; it shares no code with them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.mrac.board import State
from planner.mrac.executive import Executive
from planner.mrac.problem import ready_loop
from planner.mrac.simulate import play_step, take_turns
from planner.plan.plan import Plan
from planner.tally import OF_CLOSED_LOOP, Outcome
from planner.world.world import World

Chance = Any
"""float, or what else counts chances, as Fraction (no union: nobody mixes them)."""
STEP_OVER = -1
"""`Branch.turn` between two steps."""
ENDS = tuple(one for one in OF_CLOSED_LOOP if one not in (Outcome.ENDED_BY_OPERATOR, Outcome.DEADLINE))
OUTCOMES = tuple(outcome.word for outcome in ENDS)
"""The closed loop's that rollouts have: complete, all_robots_lost, no_progress, step_limit, not_worth_the_risk."""


@dataclass(eq=False)
class Branch:
    """A run in progress.

    Attributes:
        run: between two robots' actions in a step.
        turn: the robot whose turn it is in that step (K: only the end of the step is left), or STEP_OVER.
        chance: probability of everything that has happened.
    """

    run: Executive
    turn: int
    chance: Chance


@dataclass(frozen=True)
class End:
    """A run that is over: how, and with how many cells covered, at which step, with how many robots left."""

    chance: Chance
    outcome: Outcome
    visited: int
    survived: int
    time: int
    alive: int


class Tree:
    """A plan's closed loop, to be played as a tree.

    Args:
        plan: this project's, made for `world`, or the paths of another planner.
        first_only: `threat_checks="first_visit"`.
        number: what chances are counted in.

    Attributes:
        accessible: cells. robots: K. max_steps: T_max. certain: the chance 1.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(
        self, plan: Plan, world: World, *, first_only: bool = False, number: Callable[[float], Chance] = float
    ) -> None:
        world.check_settled("the tree of everything that can happen")
        plan.bearing.check_known("the tree of everything that can happen")
        self._problem, self._areas = ready_loop(plan, world)
        self._first_only, self._state, self.certain = first_only, plan.state, number(1)
        self.accessible = int(self._problem.levels.accessible.sum())
        self.robots, self.max_steps = len(plan.robots), self._problem.max_steps
        self._threat = [number(p) for p in np.nan_to_num(world.threat).ravel().tolist()]
        self._branch: Branch
        self._to_play: list[Branch] = []
        self._ends: list[End] = []

    def start(self) -> Branch:
        """The run before any robot has entered its start, or as the mission's state has it."""
        return Branch(Executive(self._problem, self._areas, state=self._state), STEP_OVER, self.certain)

    def step(self, branch: Branch, max_steps: int) -> tuple[list[Branch], list[End]]:
        """All that can happen in the branch's next step: the branches that go on after it, and the ends.

        `branch` itself becomes the one in which nobody is stopped. `max_steps`: a run is cut off at that step.
        """
        self._to_play, self._ends, going = [branch], [], []
        while self._to_play:
            self._branch = branch = self._to_play.pop()
            if branch.turn == STEP_OVER:
                play_step(branch.run, self._hit)
            else:
                take_turns(branch.run, self._hit, branch.turn)
                branch.turn = STEP_OVER
            outcome = branch.run.outcome(max_steps)
            if outcome is None:
                going.append(branch)
            else:
                self._end(branch.run, branch.chance, outcome)
        return going, self._ends

    def _end(self, run: Executive, chance: Chance, outcome: Outcome, lost: int = 0) -> None:
        visited, survived = self.covered(run)
        self._ends.append(End(chance, outcome, visited, survived, run.step, alive(run) - lost))

    def covered(self, run: Executive) -> tuple[int, int]:
        """Cells visited and survived so far."""
        return self.accessible - run.unvisited, int(np.count_nonzero(run.survived))

    def _hit(self, robot: int, step: int, cell: int) -> bool:
        """Part the branch that is being played: it goes on without the hit, a copy in mid-step with it."""
        branch, threat = self._branch, self._threat[cell]
        if threat == 0 or (self._first_only and _entered_before(branch.run, robot, cell)):
            return False
        chance = branch.chance * threat
        branch.chance *= 1 - threat
        if alive(branch.run) == 1:  # nothing follows: no copy is needed
            self._end(branch.run, chance, Outcome.ALL_ROBOTS_LOST if branch.run.unvisited else Outcome.COMPLETE, lost=1)
        else:
            run = branch.run.fork()
            run.stop(robot)
            self._to_play.append(Branch(run, robot + 1, chance))
        return False


def alive(run: Executive) -> int:
    """Robots not stopped so far."""
    return sum(robot.alive for robot in run.robots)


def _entered_before(run: Executive, number: int, cell: int) -> bool:
    """Had any robot entered the cell before this one did just now? It passed there, or was stopped there."""
    return bool(run.survived[cell]) or any(not r.alive and r.cell == cell for r in run.robots if r.number != number)


def state_key(branch: Branch) -> tuple[object, ...]:
    """What the rest of the run depends on, the step left out: equal for equal states.

    Areas are named by their order alone, and those that are completed and held by no live robot are left out. Where
    stopped robots lie matters for `first_only` alone, and is told by the cells visited but not survived.
    """
    run = branch.run
    held = {robot.area for robot in run.robots if robot.alive}
    kept = [number for number, area in enumerate(run.areas) if area.state is not State.COMPLETED or number in held]
    place = {number: index for index, number in enumerate(kept)}
    limited = run.problem.settings.range is not None
    areas = tuple((a.level, a.state, a.robot, a.cells.tobytes()) for a in (run.areas[number] for number in kept))
    robots = tuple(
        (robot.cell, robot.status, robot.held, place.get(robot.area), tuple(robot.ahead), limited and robot.moves)
        if robot.alive
        else None
        for robot in run.robots
    )
    return branch.turn, run.quiet, run.progress, robots, areas, run.visited.tobytes(), run.survived.tobytes()


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
        plan: with its allocation, or the paths of another planner. world: the one that it was made for.
        first_only: `threat_checks="first_visit"`.

    Raises:
        PlanError: a plan for another map.
    """
    tree = Tree(plan, world, first_only=first_only)
    ends: list[End] = []
    branches, now = 0, [tree.start()]
    while now:
        after: list[Branch] = []
        for branch in now:
            going, over = tree.step(branch, tree.max_steps)
            branches += bool(over or len(going) > 1)
            after += going
            ends += over
        now = _joined(after)
    return _summed(ends, branches, tree)


def _joined(branches: list[Branch]) -> list[Branch]:
    """Branches of equal states as one. Only those whose robots stand alike are compared: states are long."""
    alike: defaultdict[tuple[object, ...], list[Branch]] = defaultdict(list)
    for branch in branches:
        where = tuple(robot.cell if robot.alive else None for robot in branch.run.robots)
        alike[branch.run.unvisited, where].append(branch)
    kept: list[Branch] = []
    for group in alike.values():
        same: dict[tuple[object, ...], Branch] = {}
        for branch in group:
            one = same.setdefault(state_key(branch) if len(group) > 1 else (), branch)
            if one is not branch:
                one.chance += branch.chance
        kept += same.values()
    return kept


def _summed(ends: list[End], branches: int, tree: Tree) -> ClosedLoopExact:
    weights = np.array([end.chance for end in ends])
    outcomes = np.bincount([ENDS.index(end.outcome) for end in ends], weights, len(OUTCOMES))
    values: dict[str, Any] = dict(zip(OUTCOMES, outcomes.tolist(), strict=True))
    cells = tree.accessible + 1
    for figure, size in (("visited", cells), ("survived", cells), ("time", 0), ("alive", tree.robots + 1)):
        chance = np.bincount([getattr(end, figure) for end in ends], weights, size)
        values |= {figure: float(chance @ np.arange(len(chance))), f"{figure}_chance": chance}
    return ClosedLoopExact(**values, branches=branches, ends=len(ends))
