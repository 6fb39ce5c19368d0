"""Where a run stands: what has been visited, the areas and who has them, the robots and what they are doing."""

from __future__ import annotations

from collections import Counter
from copy import copy
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from planner.mrac.areas import connected_parts
from planner.mrac.home_paths import CUT_OFF, Homeward
from planner.mrac.problem import NO_LIMIT, Problem
from planner.plan.plan import Area, LegKind
from planner.plan.state import MissionState
from planner.simulator.codes import NO_AREA, NO_ROBOT, Doing, EventKind, Outcome
from planner.simulator.offers import Offer
from planner.simulator.searches import NOT_WANTED
from planner.tally import Trace


class State(Enum):
    """What has become of an area (paper, section 4.2)."""

    UNASSIGNED = "unassigned"
    ASSIGNED = "assigned"
    COMPLETED = "completed"


class Choice(NamedTuple):
    """An area that a robot may take. `target`: the cell that it would go to."""

    area: int
    target: int
    offer: Offer


Stretch = tuple[LegKind, int, int, int]
"""(kind, area, start, stop) of a leg, as in `planner.plan.plan.Leg`: the last one grows by a step at a time."""


@dataclass(eq=False)
class Robot:
    """A robot of a run.

    Attributes:
        number: its index. cell: where it is. area: its area's id, or NO_AREA.
        ahead: cells of its path still to enter, the next one last; the first one is its target.
        to_do: cells of its coverage path when it was computed, with `path` as long as `since`.
        held: kept from areas at risk (`reserve`), until it gets one.
        moves: that it can still make (`range`). aside: it makes no progress, and gets nothing (`planner.mission`).
        turned: for home: it gets nothing any more. charges: unless it is charged there, at the step `ready`.
        path: its cell at every step so far. legs: its travel and cover legs.
        asked: after how many changes of the board, and where, it was asked what it would take `first` (`choose`).
    """

    number: int
    cell: int
    status: Doing = Doing.IDLE
    area: int = NO_AREA
    ahead: list[int] = field(default_factory=list)
    to_do: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    since: int = 0
    held: bool = False
    moves: int = NO_LIMIT
    aside: bool = False
    turned: bool = False
    charges: bool = False
    ready: int = 0
    path: list[int] = field(default_factory=list)
    legs: list[Stretch] = field(default_factory=list)
    asked: tuple[int, ...] | None = None
    first: Choice | None = None

    @property
    def alive(self) -> bool:
        """Not stopped."""
        return self.status is not Doing.DEAD

    @property
    def able(self) -> bool:
        """Neither stopped nor at the end of its range, nor set aside, nor bound for home."""
        return self.alive and self.moves > 0 and not self.aside and not self.turned

    @property
    def on_its_way(self) -> bool:
        """Traveling or covering: it has an area."""
        return self.status is Doing.COVERING or self.status is Doing.TRAVELING

    @property
    def busy(self) -> bool:
        """It has a path ahead: to or in its area, home, or another planner's."""
        return self.on_its_way or self.status in (Doing.FOLLOWING, Doing.RETURNING)


@dataclass(eq=False)
class AreaNow:
    """An area of a run. `cells`: what it holds now; `unvisited`: how many of them are; `robot`: who has or had it."""

    level: int
    cells: NDArray[np.int64]
    unvisited: int
    robot: int = NO_ROBOT
    state: State = State.UNASSIGNED


class Board:
    """The state of a run. Axis `N` = H * W cells.

    Attributes:
        problem, rule: what is run. robots, areas: by index and id.
        visited, survived: bool `[N]`. unvisited: accessible cells that are not visited.
        area_of: int32 `[N]`, the area that holds each cell. unassigned: ids of the areas that nobody has.
        open_in: how many of them lie in a (connected part of the map, level).
        open: int32 `[N]`, the area of each cell whose area nobody has and is of level `open_level`, else NOT_WANTED.
        changes: how often an area that nobody has came, went, or lost an unvisited cell, or would show less.
        next_move: the step in which a robot that decides now moves first. limited: it takes only what it can afford, of
            robots that come home.
        seen: bool `[N]`, cells that somebody has seen; None: nothing is left to see, or nobody asks.
        made: every area as it was when it was made; the first `given` of them at t = 0.
    """

    def __init__(self, problem: Problem, allocation: tuple[Area, ...]) -> None:
        n = problem.costs.size
        self.problem, self.rule = problem, problem.rule
        self.visited, self.survived = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        self.area_of = np.full(n, NO_AREA, dtype=np.int32)
        self.open, self.open_level = np.full(n, NOT_WANTED, dtype=np.int32), 0
        self.next_move, self.limited = 0, True
        self.unassigned: set[int] = set()
        self.open_in: Counter[tuple[int, int]] = Counter()
        self.changes = 0
        self.seen: NDArray[np.bool_] | None = None
        self.areas: list[AreaNow] = []
        self.made: list[Area] = []
        team = enumerate(zip(problem.starts.tolist(), problem.range.tolist(), strict=True))
        self.robots = [Robot(number, cell, moves=moves) for number, (cell, moves) in team]
        self.given = len(allocation)
        for area in allocation:
            self.append_area(area.level, area.cells)
        for number, area in enumerate(allocation):
            if area.robot != NO_ROBOT and problem.given:
                self._close(number, State.ASSIGNED)
                self.areas[number].robot = area.robot
            elif area.robot != NO_ROBOT:
                self.give(self.robots[area.robot], number)
        for robot, path in zip(self.robots, problem.given, strict=False):
            robot.status, robot.ahead = Doing.FOLLOWING, path[:0:-1].tolist()
        self.unvisited = sum(area.unvisited for area in self.areas)

    def set_back_to(self, state: MissionState) -> None:
        """Take over from a state whose areas were the allocation."""
        self.visited[state.visited] = self.survived[state.survived] = True
        self.unvisited -= len(state.visited)
        for number, given in enumerate(state.areas):
            area = self.areas[number]
            area.unvisited, area.robot = int(np.count_nonzero(~self.visited[area.cells])), given.robot
            if given.state == State.COMPLETED.value:
                self.complete(number)
        for robot, its in zip(self.robots, state.robots, strict=True):
            robot.status, robot.area, robot.held = Doing[its.status.upper()], its.area, its.held
            robot.ahead, robot.to_do, robot.moves = its.ahead[::-1].tolist(), its.to_do, robot.moves - its.moves
            robot.path, robot.turned = [robot.cell] * (state.step + 1), its.turned
            if robot.status is Doing.RETURNING and self.problem.home is not None:
                robot.ahead = self.problem.home.way(robot.number, robot.cell)[::-1]

    def fork(self) -> Self:
        """A run that goes on from here, in mid-step too; what it writes down (paths, legs, areas made) begins here."""
        other = copy(self)
        other.visited, other.survived = self.visited.copy(), self.survived.copy()
        other.area_of, other.open = self.area_of.copy(), self.open.copy()
        other.unassigned, other.open_in = self.unassigned.copy(), self.open_in.copy()
        other.areas = [  # `copy` takes ten times as long; their arrays are replaced, never written
            AreaNow(area.level, area.cells, area.unvisited, area.robot, area.state) for area in self.areas
        ]
        other.robots = [
            replace(robot, ahead=robot.ahead.copy(), path=robot.path[robot.since :], since=0, legs=[])
            for robot in self.robots
        ]
        other.made, other.given = [], 0
        return other

    def levels(self) -> NDArray[np.int16]:
        """The level of each cell `[N]` as robots know it, NO_LEVEL of an obstacle."""
        return self.problem.levels.of_cell

    def to_do(self, number: int) -> NDArray[np.int64]:
        """The unvisited cells of an area."""
        cells = self.areas[number].cells
        return cells[~self.visited[cells]]

    def goals(self, number: int) -> NDArray[np.int64]:
        """The cells of an area that the rule may head for."""
        return self.to_do(number) if self.rule.attentive else self.areas[number].cells

    def append_area(self, level: int, cells: NDArray[np.int64]) -> int:
        """A new area of unvisited cells that nobody has; its id."""
        number = len(self.areas)
        self.areas.append(AreaNow(level, cells, len(cells)))
        self.made.append(Area(level, NO_ROBOT, cells))
        self.area_of[cells] = number
        self._open(number)
        return number

    def give(self, robot: Robot, number: int) -> None:
        """The robot has the area, and is to travel there."""
        self._close(number, State.ASSIGNED)
        self.areas[number].robot = robot.number
        robot.area, robot.status, robot.held = number, Doing.TRAVELING, False

    def release(self, robot: Robot) -> None:
        """The robot's area is nobody's again, its cells as they are."""
        area = self.areas[robot.area]
        area.state, area.robot = State.UNASSIGNED, NO_ROBOT
        self._open(robot.area)
        robot.area = NO_AREA

    def complete(self, number: int) -> None:
        """Nothing of the area is to be done any more."""
        self._close(number, State.COMPLETED)

    def cut(self, number: int) -> list[NDArray[np.int64]]:
        """Complete the area, with what was visited of it; the components of the rest, by lowest cell."""
        area = self.areas[number]
        parts = connected_parts(self.problem.world.shape, self.to_do(number))
        self.complete(number)
        area.cells = area.cells[self.visited[area.cells]]
        area.unvisited = 0
        return parts

    def open_levels(self, robot: Robot) -> list[int]:
        """The levels, rising, of the areas that nobody has and the robot can reach."""
        part = self.problem.part[robot.cell]
        return sorted(level for (where, level), count in self.open_in.items() if count and where == part)

    def _where(self, number: int) -> tuple[int, int]:
        area = self.areas[number]
        return int(self.problem.part[area.cells[0]]), area.level

    def open_of(self, level: int) -> NDArray[np.int32]:
        """`open` of this level."""
        if level != self.open_level:
            self.open, self.open_level = np.full(len(self.visited), NOT_WANTED, dtype=np.int32), level
            for number in self.unassigned:
                if self.areas[number].level == level:
                    self.open[self.areas[number].cells] = number
        return self.open

    def _open(self, number: int) -> None:
        self.unassigned.add(number)
        self.changes += 1
        self.open_in[self._where(number)] += 1
        if self.areas[number].level == self.open_level:
            self.open[self.areas[number].cells] = number

    def _close(self, number: int, state: State) -> None:
        area = self.areas[number]
        if number in self.unassigned:
            self.unassigned.remove(number)
            self.changes += 1
            self.open_in[self._where(number)] -= 1
            if area.level == self.open_level:
                self.open[area.cells] = NOT_WANTED
        area.state = state


# What the readable simulator writes down of a run, for its trace.


class Recorder:
    """Collects one run's events, and where every robot is at the end of each step."""

    def __init__(self) -> None:
        self._events: list[tuple[int, int, EventKind, int, int]] = []
        self._steps: list[list[tuple[int, Doing, int]]] = []

    def note(self, step: int, robot: int, kind: EventKind, area: int, other: int) -> None:
        """Something happened; the columns of `Trace.events`."""
        self._events.append((step, robot, kind, area, other))

    def look(self, robots: list[tuple[int, Doing, int]]) -> None:
        """A step ended: (cell, what it is doing, its area) of each robot. A stopped robot has no area."""
        self._steps.append([(c, doing, NO_AREA if doing is Doing.DEAD else area) for c, doing, area in robots])

    def trace(self, rollout: int, area_of: np.ndarray, outcome: Outcome) -> Trace:
        """The trace of the run, once it has ended. `area_of`: int32 `[N]`, as in `Trace`."""
        steps = np.array(self._steps, dtype=np.int32)
        return Trace(
            rollout=rollout,
            cells=steps[:, :, 0],
            doing=steps[:, :, 1].astype(np.int8),
            areas=steps[:, :, 2],
            events=np.array(self._events, dtype=np.int32).reshape(-1, 5),
            area_of=area_of,
            outcome=outcome,
        )


# When a robot turns for home (SPEC section 19): what it can afford, and what is left of its leg.


def can_go_on(board: Board, home: Homeward, robot: Robot, left: int) -> bool:
    """Whether the robot, with so many moves left, could come home from every cell of the rest of its leg."""
    return all(home.moves(robot.number, cell) <= left - made for made, cell in enumerate(rest_of_leg(board, robot), 1))


def moves_left(home: Homeward, robot: Robot, step: int, pace: int) -> int:
    """Moves that the robot can make from this step on: its range, and the mission's end if that is sooner.

    It makes one in every step that is a multiple of `pace`.
    """
    return min(robot.moves, home.last // pace - (step - 1) // pace)


def can_afford(board: Board, robot: Robot, target: int) -> bool:
    """Whether a robot that comes home could do so from this cell, once it has gone there."""
    home = board.problem.home
    if home is None or not board.limited or home.moves(robot.number, target) == CUT_OFF:
        return True
    pace = board.problem.pace(robot.number)
    there = len(board.problem.paths_of(robot.number).path(robot.cell, target)) if target != robot.cell else 0
    return there + home.moves(robot.number, target) <= moves_left(home, robot, board.next_move, pace)


def rest_of_leg(board: Board, robot: Robot) -> list[int]:
    """The cells that the robot has still to enter until it is at its area's target, or the next cell to do."""
    ahead = robot.ahead[::-1]
    if robot.status is Doing.COVERING and not board.rule.attentive:
        # No leg crosses a cell that is still to do, so the first of them is its end.
        to_do = set(robot.to_do.tolist()).difference(robot.path[robot.since :])
        end = next(place for place, cell in enumerate(ahead, 1) if cell in to_do)
        return ahead[:end]
    return ahead


def has_to_leave(home: Homeward, robot: Robot, step: int, pace: int) -> bool:
    """Whether the robot, which waits at the end of this step, could come home too late if it waited for another."""
    return home.moves(robot.number, robot.cell) > max(home.last // pace - step // pace - 1, 0)


def is_home(home: Homeward, robot: Robot) -> bool:
    """Whether the robot is in a cell that is one of its bases."""
    return home.moves(robot.number, robot.cell) == 0
