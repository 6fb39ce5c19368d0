"""A run whose areas are chosen from outside, at the moments at which Algorithm 2 chooses them; the rest is as ever.

A step that comes to a choice nobody has made yet is taken back, and played again with the answer.
"""

from __future__ import annotations

from typing import Self

from planner.luck import Luck
from planner.mrac.board import Choice, Robot
from planner.mrac.choose import offered
from planner.mrac.executive import Executive
from planner.mrac.problem import Problem
from planner.mrac.recorder import Recorder
from planner.mrac.simulate import play_step
from planner.plans.plan import Area
from planner.tally import Outcome


class Decision(Exception):
    """A robot is to choose. offers: the areas that it may take, at least one, in the order of the rule."""

    def __init__(self, robot: int, offers: list[Choice]) -> None:
        super().__init__(robot, offers)
        self.robot, self.offers = robot, offers


class Chosen(Executive):
    """The team, in a step whose first choices are known.

    Attributes:
        answers: areas that are to be taken, None for none, in the order in which the step asks.
        luck: who is stopped. new: cells that each robot was the first to visit.
    """

    def __init__(
        self, problem: Problem, allocation: tuple[Area, ...], luck: Luck, recorder: Recorder | None = None
    ) -> None:
        super().__init__(problem, allocation, recorder=recorder)
        self.answers: list[int | None] = []
        self.luck, self.new = luck, [0] * len(self.robots)

    def fork(self) -> Self:
        """As of a board."""
        other = super().fork()
        other.answers, other.luck, other.new = self.answers.copy(), self.luck.fork(), self.new.copy()
        return other

    def choose(self, robot: Robot, *, idle: bool = False, own: bool = False) -> Choice | None:
        """As it was answered. Who took none is asked again once other areas are nobody's. Raises Decision."""
        now = (self.changes, robot.cell, 0)
        if idle and robot.asked == now:
            return None
        robot.asked = now
        offers = offered(self, robot, own=own)
        if not offers:
            return None
        if not self.answers:
            raise Decision(robot.number, sorted(offers, key=lambda one: (self.rule.key(one.offer), one.area)))
        area = self.answers.pop(0)
        return next((one for one in offers if one.area == area), None)

    def _refuses(self) -> bool:
        return True

    def _mark(self, robot: Robot, cell: int) -> None:
        self.new[robot.number] += not self.visited[cell]
        super()._mark(robot, cell)


class ChosenRun:
    """One rollout from choice to choice.

    Attributes:
        team: as it stands at the end of the last step that is over. decision: what is to be chosen before the next one
            can be; None before the first `go_on`, and at the end. outcome: how the run ended.
    """

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        luck: Luck,
        max_steps: int | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        """The arguments are those of `Chosen` and `simulate`; a step is written down again with every answer to it."""
        self.team = Chosen(problem, allocation, luck, recorder)
        self.decision: Decision | None = None
        self.outcome: Outcome | None = None
        self._last = max_steps or problem.max_steps

    def go_on(self, choice: int | None = None) -> None:
        """To the next decision, or the end; `choice`: which of the offers is taken, by its place; None: none of them.

        A robot that takes none helps another one, if Algorithm 2 has it so, or rests.
        """
        if self.decision is not None:
            self.team.answers.append(None if choice is None else self.decision.offers[choice].area)
        self.decision = None
        while (outcome := self.team.outcome(self._last)) is None:
            ahead = self.team.fork()
            try:
                play_step(ahead, ahead.luck.hits)
            except Decision as decision:
                self.decision = decision
                return
            self.team, ahead.answers = ahead, []
        self.outcome = outcome
