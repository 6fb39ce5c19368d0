"""Exact expected values of the closed loop: every pattern of hits, played by the readable simulator as one tree.

A run is decided by which of its dangerous entries stop a robot, so every leaf of the tree of entries is one run, and
its chance is a product of p and 1 - p. The likeliest branches are played first and equal states are joined; what is
not played, because it is too unlikely or the budget is spent, widens each value to a lower and an upper one. The cost
grows like (entries a robot) ** (robots - 1) steps. The oracle of the closed-loop rollouts: it shares no code with the
compiled simulators.
"""

from __future__ import annotations

import heapq
import itertools
import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.theory.forks import STEP_OVER, Branch, End, ForkedLoop, StateKey, alive, outline, state_key
from planner.arguments import check_word
from planner.plans.plan import Plan
from planner.tally import OF_CLOSED_LOOP, Outcome
from planner.worlds.world import World

MOST_WAITING = 100_000
"""Branches kept for later, at most (about 10 kB each on 400 cells); the less likely half of more is given up."""
MEANS = ("visited", "survived", "time", "alive")
OUTCOMES = tuple(outcome.name.lower() for outcome in OF_CLOSED_LOOP)
"""The closed loop's: complete, stopped, stuck, timeout, called_off."""


class Interval(NamedTuple):
    """A value that lies between two others; they are equal where nothing was left out."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Half way between them."""
        return (self.low + self.high) / 2


@dataclass(frozen=True, eq=False)
class ClosedLoopExact:
    """Expected values and distributions over every pattern of hits. Axes: `A` accessible cells, `K` robots, `T` steps.

    Attributes:
        visited, survived: cells. time: steps. alive: robots. All between a lower and an upper value: what was left out
            covers at least what it had covered, at most every accessible cell, and takes at most T_max steps.
        complete, stopped, stuck, timeout, called_off: probabilities of the outcomes, likewise.
        visited_chance, survived_chance: float64 `[A + 1]`, chance of so many cells, over what was played to its end.
        alive_chance: float64 `[K + 1]`, chance that so many robots are alive at the end. time_chance: float64
            `[T + 1]`, chance that the run ends at that step.
        visited_left, survived_left: float64 `[A + 1]`, what was left out, by the cells that it had covered by then.
        remainder: probability left out; what the chances fall short of 1.
        branches, ends: stretches between dangerous entries that were played, and ends reached (patterns of hits,
            those that led to equal states counted once).
    """

    visited: Interval
    survived: Interval
    time: Interval
    alive: Interval
    complete: Interval
    stopped: Interval
    stuck: Interval
    timeout: Interval
    called_off: Interval
    visited_chance: NDArray[np.float64]
    survived_chance: NDArray[np.float64]
    alive_chance: NDArray[np.float64]
    time_chance: NDArray[np.float64]
    visited_left: NDArray[np.float64]
    survived_left: NDArray[np.float64]
    remainder: float
    branches: int
    ends: int

    def at_least(self, cells: int, meaning: Literal["visited", "survived"] = "visited") -> Interval:
        """Chance that `cells` or more are covered. Raises UsageError for a meaning that is none."""
        check_word("meaning", meaning, ("visited", "survived"))
        chance = self.visited_chance if meaning == "visited" else self.survived_chance
        left = self.visited_left if meaning == "visited" else self.survived_left
        sure = float(chance[cells:].sum())
        return Interval(sure + float(left[cells:].sum()), sure + (self.remainder if cells < len(chance) else 0.0))


def closed_loop_exact(
    plan: Plan,
    world: World,
    *,
    least: float = 0.0,
    most_branches: int | None = None,
    seconds: float | None = None,
    first_only: bool = False,
    between: Callable[[], None] | None = None,
) -> ClosedLoopExact:
    """The closed loop's expected values and distributions (SPEC section 6; the paper's Algorithm 2).

    Args:
        plan: with its allocation; not the plan of another planner.
        world: the world that it was made for.
        least: branches of less probability than this are not played.
        most_branches, seconds: play at most so many branches, or for so long; what is left then is in `remainder`.
        first_only: `threat_checks="first_visit"`.
        between: called between branches; what it raises ends the run.

    Raises:
        PlanError: a plan without areas, or for another map.
    """
    loop = ForkedLoop(plan, world, first_only=first_only)
    sums, waiting = _Sums(loop), _Waiting()
    waiting.add(loop.start())
    played, until = 0, clock.monotonic() + (seconds if seconds is not None else np.inf)
    while (branch := waiting.likeliest()) is not None:
        spent = played == most_branches or clock.monotonic() >= until
        if spent or branch.chance < least:
            sums.leave(branch)
            if spent:
                for other in waiting.rest():
                    sums.leave(other)
            continue
        played += 1
        if between is not None:
            between()
        _play(loop, branch, sums, waiting)
        for other in waiting.surplus():
            sums.leave(other)
    return sums.result(played)


def _play(loop: ForkedLoop, branch: Branch, sums: _Sums, waiting: _Waiting) -> None:
    """The branch through its next dangerous entries to the end of that step; what can go on is put in line."""
    while True:
        forks = loop.play_step(branch)
        for end in forks.ends:
            sums.count(end)
        for fork in forks.branches:
            waiting.add(fork)
        end_here = loop.end_of(branch)
        if end_here is not None:
            sums.count(end_here)
            return
        if forks.ends or forks.branches:
            waiting.add(branch)
            return


class _Waiting:
    """Branches in line: first those that can move the bounds most; those in equal states are one."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Branch]] = []
        self._same: dict[StateKey, list[Branch]] = {}
        self._number = itertools.count()

    def add(self, branch: Branch) -> None:
        alike = self._same.setdefault(outline(branch), [])
        if alike:
            key = state_key(branch)
            for other in alike:
                if state_key(other) == key:
                    other.chance += branch.chance
                    return
        alike.append(branch)
        heapq.heappush(self._heap, (-branch.chance * (1 + branch.run.unvisited), next(self._number), branch))

    def likeliest(self) -> Branch | None:
        """The next to play, out of the line. (Its place does not count what joined it later.)"""
        if not self._heap:
            return None
        branch = heapq.heappop(self._heap)[2]
        self._forget(branch)
        return branch

    def _forget(self, branch: Branch) -> None:
        key = outline(branch)
        self._same[key].remove(branch)
        if not self._same[key]:
            del self._same[key]

    def surplus(self) -> list[Branch]:
        """The less likely half, out of the line, if it holds more than MOST_WAITING."""
        if len(self._heap) <= MOST_WAITING:
            return []
        self._heap.sort()
        half = len(self._heap) // 2
        gone = [branch for _, _, branch in self._heap[half:]]
        del self._heap[half:]
        for branch in gone:
            self._forget(branch)
        return gone

    def rest(self) -> list[Branch]:
        """All of them, out of the line."""
        branches = [branch for _, _, branch in self._heap]
        self._heap.clear()
        self._same.clear()
        return branches


class _Sums:
    """What was played to its end, and what was left out, added up. Axis 4: MEANS."""

    def __init__(self, loop: ForkedLoop) -> None:
        cells = loop.accessible + 1
        self.loop, self.ends, self.remainder = loop, 0, 0.0
        self.visited, self.survived, self.alive = np.zeros(cells), np.zeros(cells), np.zeros(loop.robots + 1)
        self.visited_left, self.survived_left = np.zeros(cells), np.zeros(cells)
        self.time: dict[int, float] = {}
        self.low, self.high = np.zeros(4), np.zeros(4)
        self.outcome_low, self.outcome_high = np.zeros(len(OUTCOMES)), np.zeros(len(OUTCOMES))

    def count(self, end: End) -> None:
        """A run that is over."""
        self.ends += 1
        self.visited[end.visited] += end.chance
        self.survived[end.survived] += end.chance
        self.alive[end.alive] += end.chance
        self.time[end.time] = self.time.get(end.time, 0.0) + end.chance
        self.outcome_low[OF_CLOSED_LOOP.index(end.outcome)] += end.chance

    def leave(self, branch: Branch) -> None:
        """A branch that is not played: what it is sure to come to, and what it may come to."""
        loop, run, chance = self.loop, branch.run, branch.chance
        visited, survived = loop.covered(run)
        done = run.unvisited == 0 and branch.turn != STEP_OVER
        self.remainder += chance
        self.visited_left[visited] += chance
        self.survived_left[survived] += chance
        self.low += chance * np.array([visited, survived, run.step, 0])
        most = run.step if done else loop.max_steps
        self.high += chance * np.array([loop.accessible, loop.accessible, most, alive(run)])
        if done:
            self.outcome_low[OF_CLOSED_LOOP.index(Outcome.COMPLETE)] += chance
        else:
            self.outcome_high += chance

    def result(self, branches: int) -> ClosedLoopExact:
        time = np.zeros(max(self.time, default=0) + 1)
        time[list(self.time)] = list(self.time.values())
        played = np.array([d @ np.arange(len(d)) for d in (self.visited, self.survived, time, self.alive)])
        means = dict(
            zip(MEANS, map(Interval, (played + self.low).tolist(), (played + self.high).tolist()), strict=True)
        )
        sure, maybe = self.outcome_low.tolist(), (self.outcome_low + self.outcome_high).tolist()
        return ClosedLoopExact(
            **means,
            **dict(zip(OUTCOMES, map(Interval, sure, maybe), strict=True)),
            visited_chance=self.visited,
            survived_chance=self.survived,
            alive_chance=self.alive,
            time_chance=time,
            visited_left=self.visited_left,
            survived_left=self.survived_left,
            remainder=self.remainder,
            branches=branches,
            ends=self.ends,
        )
