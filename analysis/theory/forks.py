"""The closed loop as a tree: the readable simulator, forked wherever a robot may be stopped.

Every run begins with the same nominal steps; at each dangerous entry it goes on in two ways, stopped and not stopped.
A fork copies the run in mid-step, so that no step is played twice. It shares no code with the compiled simulators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from planner.mrac.board import State
from planner.mrac.simulate import Simulation
from planner.mrac.takeover import ready_loop
from planner.plans.plan import Plan
from planner.tally import Outcome
from planner.worlds.world import World

Chance = Any
"""float, or Fraction where chances are exact (no union: nobody mixes them)."""
StateKey = tuple[object, ...]
"""Equal for equal states."""
STEP_OVER = -1
"""`Branch.turn` between two steps."""


@dataclass(eq=False)
class Branch:
    """A run in progress.

    Attributes:
        run: between two robots' actions in a step.
        turn: the robot whose turn it is in that step (K: only the end of the step is left), or STEP_OVER.
        chance: probability of everything that has happened.
    """

    run: Simulation
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


@dataclass(eq=False)
class Forks:
    """What left a branch in a step: `branches` in mid-step, and `ends`, where the last robot alive was stopped."""

    branches: list[Branch] = field(default_factory=list)
    ends: list[End] = field(default_factory=list)


class ForkedLoop:
    """A plan's closed loop, played as a tree.

    Args:
        plan: this project's, made for `world`, or the paths of another planner.
        first_only: `threat_checks="first_visit"`.
        exact: chances are fractions, from the float32 threats as they are.

    Attributes:
        accessible: cells. robots: K. max_steps: T_max. certain: the chance 1.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False, exact: bool = False) -> None:
        world.check_settled("the tree of everything that can happen")
        self._problem, self._areas = ready_loop(plan, world)
        self._first_only, self._state = first_only, plan.state
        self.accessible = int(self._problem.levels.accessible.sum())
        self.robots, self.max_steps = len(plan.robots), self._problem.max_steps
        number = Fraction if exact else float
        self.certain: Chance = number(1)
        self._threat: Sequence[Chance] = [number(p) for p in np.nan_to_num(world.threat).ravel().tolist()]
        self._branch: Branch
        self._forks = Forks()

    def start(self) -> Branch:
        """The run before any robot has entered its start, or as the mission's state has it."""
        run = Simulation(self._problem, self._areas, self._hit, state=self._state)
        return Branch(run, 0 if self._state is None else STEP_OVER, self.certain)

    def play_step(self, branch: Branch) -> Forks:
        """The rest of the branch's step, or the next step if that is over, with no robot stopped.

        `branch.chance` becomes that of no hit; the hits are in the forks.
        """
        self._branch, self._forks = branch, Forks()
        if branch.turn == STEP_OVER:
            branch.run.advance()
        else:
            branch.run.take_turns(branch.turn)
            branch.turn = STEP_OVER
        return self._forks

    def end_of(self, branch: Branch) -> End | None:
        """How the branch ends after the step just played; None if it goes on."""
        outcome = branch.run.outcome(self.max_steps)
        return None if outcome is None else self._end(branch.run, branch.chance, outcome, 0)

    def _end(self, run: Simulation, chance: Chance, outcome: Outcome, lost: int) -> End:
        visited, survived = self.covered(run)
        return End(chance, outcome, visited, survived, run.step, alive(run) - lost)

    def covered(self, run: Simulation) -> tuple[int, int]:
        """Cells visited and survived so far."""
        return self.accessible - run.unvisited, int(np.count_nonzero(run.survived))

    def _hit(self, robot: int, step: int, cell: int) -> bool:
        branch, threat = self._branch, self._threat[cell]
        if threat == 0 or (self._first_only and _entered_before(branch.run, robot, cell)):
            return False
        chance = branch.chance * threat
        branch.chance *= 1 - threat
        if alive(branch.run) == 1:
            outcome = Outcome.STOPPED if branch.run.unvisited else Outcome.COMPLETE
            self._forks.ends.append(self._end(branch.run, chance, outcome, 1))
        else:
            run = branch.run.copy()
            run.stop(robot)
            self._forks.branches.append(Branch(run, robot + 1, chance))
        return False


def alive(run: Simulation) -> int:
    """Robots not stopped so far."""
    return sum(robot.alive for robot in run.robots)


def _entered_before(run: Simulation, number: int, cell: int) -> bool:
    """Had any robot entered the cell before this one did just now? It passed there, or was stopped there."""
    return bool(run.survived[cell]) or any(not r.alive and r.cell == cell for r in run.robots if r.number != number)


def outline(branch: Branch) -> StateKey:
    """A part of the state that is quick to tell: branches whose outlines differ are in different states."""
    run = branch.run
    robots = tuple((robot.cell, robot.status) if robot.alive else None for robot in run.robots)
    return run.step, branch.turn, robots, run.visited.tobytes(), run.survived.tobytes()


def state_key(branch: Branch) -> StateKey:
    """What the rest of the run depends on, the step left out (it matters where T_max is in reach).

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
