"""A rollout whose areas are chosen by a caller, at the moments at which Algorithm 2 chooses them.

A step that needs a choice without an answer is undone, and repeated once the answer is known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.mrac.problem import Problem
from planner.rollouts.single_run import PythonLoop, SingleRun, holds
from planner.rollouts.tables import make_policy
from planner.simulator.codes import NONE, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.offers import Offer
from planner.simulator.state import AREA_BITS, FAR, VISITED

NOTHING = NONE, NONE, FAR
"""Answer for a robot that takes no area: area, target, cost."""


class Choice(NamedTuple):
    """An area that a robot may take; `target`: index of the cell that it would travel to."""

    area: int
    target: int
    offer: Offer


class Decision(Exception):
    """A robot has to choose.

    Attributes:
        robot: index.
        offers: the areas that it may take, at least one, in the order of the rule.
    """

    def __init__(self, robot: int, offers: list[Choice]) -> None:
        super().__init__(robot, offers)
        self.robot, self.offers = robot, offers


class _Chooser:
    """Callbacks that choose areas instead of the rule (`Tables.asks`), and follow moves (`Tables.notes`).

    Attributes:
        answers: choices of the step, in the order in which the simulator needs them.
        policy: of a rule that re-evaluates.
        new: cells that each robot was the first to visit. shrunk: visits of cells of unassigned areas.
        asked_at: of each robot the state of the unassigned areas, and its cell, at its last choice.
    """

    def __init__(self, run: SingleRun, problem: Problem) -> None:
        loop = run.loop
        self.run, self.rule = run, loop.rule
        self.policy = run.p or make_policy(problem, loop.cells, loop.tables, interpreted=True)
        self.policy = self.policy._replace(limited=True)
        self.answers: list[tuple[int, int, int]] = []
        self.new, self.shrunk, self._place = [0] * loop.robots, 0, 0
        self.asked_at: list[tuple[int, ...] | None] = [None] * loop.robots
        self._before = self.new, self.shrunk, self.asked_at

    def begin(self) -> None:
        """Begin the step, possibly again."""
        self._place, (new, self.shrunk, asked_at) = 0, self._before
        self.new, self.asked_at = new.copy(), asked_at.copy()

    def end(self) -> None:
        """End the step."""
        self._before = self.new, self.shrunk, self.asked_at
        self.answers.clear()

    def area(self, t: Any, s: Any, w: Any, robot: int, own: int = NONE) -> tuple[int, int, int]:
        """(area, target, cost) for the robot, area NONE if it takes none; `own`: its own area is offered too.

        A robot that took none chooses again once the unassigned areas have changed.

        Raises:
            Decision: the choice has no answer yet.
        """
        marks = s.marks
        # Equal numbers mean equal offers; a loss counts as an arrival, which `alive` compensates.
        now = marks.arrivals + marks.alive, marks.open, self.shrunk, s.robots[robot].cell
        if self.asked_at[robot] == now and holds(s.waiting, robot):
            return NOTHING
        self.asked_at[robot] = now
        place, self._place = self._place, self._place + 1
        if place == len(self.answers):
            offers = self._offers(t, s, w, robot, own)
            if offers:
                raise Decision(robot, offers)
            self.answers.append(NOTHING)
        answer = self.answers[place]
        if answer[0] != NONE:  # its leg follows the costs computed last
            interpreted("areas").costs_from(t, s, w, robot)
        return answer

    def _offers(self, t: Any, s: Any, w: Any, robot: int, own: int) -> list[Choice]:
        """The unassigned areas that the robot can reach, and `own`, in the order of the rule."""
        raw, cells, count = self.run.raw, self.run.loop.cells, int(s.marks.areas)
        offered = np.unpackbits(raw.open.view(np.uint8), bitorder="little").astype(np.bool_)
        offered[count:] = False
        if own != NONE:
            offered[own] = True
        area_of = raw.home[:-1] >> AREA_BITS
        goals = offered[area_of]
        if self.run.p is not None:  # rules that re-evaluate head for unvisited cells
            goals &= raw.home[:-1] & VISITED == 0
        numbers = np.flatnonzero(goals)
        costs = interpreted("areas").costs_from(t, s, w, robot)[numbers]
        reached = costs >= 0
        numbers, costs = numbers[reached], costs[reached]
        order = np.lexsort((costs, area_of[numbers]))  # stable: the lowest index of equal cells
        areas, first = np.unique(area_of[numbers][order], return_index=True)
        places = order[first]
        offers = self._seen(t, s, robot, areas, costs[places])
        found = list(map(Choice, areas.tolist(), cells[numbers[places]].tolist(), offers))
        return sorted(found, key=lambda choice: self.rule.key(choice.offer))

    def _seen(self, t: Any, s: Any, robot: int, areas: NDArray[Any], costs: NDArray[Any]) -> list[Offer]:
        """Areas at these costs `[M]` as offers."""
        p = self.policy
        if t.mixed or len(p.value) or len(p.view_begin):
            offer_of = interpreted("policy").offer_of
            each = zip(areas.tolist(), costs.tolist(), strict=True)
            return [Offer(*map(int, offer_of(t, p, s, robot, area, cost))) for area, cost in each]
        levels, left = (self.run.raw.areas[name][areas] for name in ("level", "left"))
        columns = levels, costs, left, p.entry[levels], left, np.full_like(left, p.beyond)
        return list(map(Offer, *(column.tolist() for column in columns)))

    def move(self, s: Any, robot: int) -> None:
        """Called before the robot enters its next cell."""
        me = s.robots[robot]
        home = int(s.home[me.next if s.marks.step > 0 else me.cell])
        if home & VISITED == 0:
            self.new[robot] += 1
            self.shrunk += bool(holds(s.open, home >> AREA_BITS))

    def areas(self, s: Any) -> None:
        """Called after areas have been made."""


class ChosenRun:
    """One rollout, from choice to choice.

    Attributes:
        now: the run at the end of the last step that is over.
        decision: the choice that the next step needs; None before the first `go_on`, and at the end.
    """

    def __init__(self, loop: PythonLoop, seed: int, rollout: int) -> None:
        """A rollout of the loop before its first step."""
        self.now = loop.begin(seed, rollout)
        self.decision: Decision | None = None
        self._chooser = _Chooser(self.now, loop.problem)
        self.now.t = self.now.t._replace(asks=self._chooser, notes=self._chooser)
        if self.now.p is not None:  # else a robot may skip a comparison (`replanning.make_first_choice`)
            self.now.p = self.now.p._replace(by_price=False)
        self._saved: list[NDArray[Any]] | None = None

    @property
    def outcome(self) -> Outcome | None:
        """The outcome of the rollout, None while it goes on."""
        return self.now.outcome

    def _end(self) -> None:
        """End by choice instead of no progress if a robot that can move can reach an unassigned area."""
        now = self.now
        if now.outcome is Outcome.NO_PROGRESS:
            could = interpreted("next_area").could_go_on(now.t, self._chooser.policy, now.s, now.w)
            now.outcome = Outcome.NOT_WORTH_THE_RISK if could else now.outcome

    @property
    def new(self) -> NDArray[np.int64]:
        """int64 `[K]`, cells that each robot was the first to visit."""
        return np.array(self._chooser.new)

    def go_on(self, choice: int | None = None) -> None:
        """Continue to the next decision, or the end.

        A robot that takes no area shares another one, if Algorithm 2 has it so, or rests.

        Args:
            choice: position of the chosen offer; None: no offer.
        """
        if self.decision is not None:
            self._chooser.answers.append(self._answer(self.decision, choice))
        self.decision = None
        while self.outcome is None and self.decision is None:
            self._play_step()

    def _answer(self, decision: Decision, choice: int | None) -> tuple[int, int, int]:
        if choice is None:
            return NOTHING
        area, target, offer = decision.offers[choice]
        return area, int(np.searchsorted(self.now.loop.cells, target)), offer.cost

    def _play_step(self) -> None:
        """Play the next step if all its choices have answers; else undo it."""
        if self._saved is None:
            self._saved = self.now.save()
        self._chooser.begin()
        try:
            self.now.advance()
        except BaseException as raised:
            self.now.take_back(self._saved)
            self._chooser.begin()
            if not isinstance(raised, Decision):
                raise
            self.decision = raised.with_traceback(None)
            return
        self._chooser.end()
        self._end()
        self._saved = None
