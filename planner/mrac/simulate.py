"""Algorithm 2, readable: one run of the team, step by step, with or without hits (SPEC section 5).

The run with no hits is the nominal run, which the plan records. Faster engines answer to this reference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planner.mrac.allocate import choose_next_area, choose_parts
from planner.mrac.areas import connected_parts
from planner.mrac.costs import NOT_WANTED, SafestPaths
from planner.mrac.coverage import coverage_path
from planner.mrac.partition import bisect
from planner.mrac.recorder import Recorder
from planner.plans.plan import NO_ROBOT, Area, Leg
from planner.tally import Outcome
from planner.trace import Doing, EventKind

Hit = Callable[[int, int, int], bool]
"""`hit(robot, step, cell)`: is the robot stopped as it enters the cell at this step?"""
Split = Callable[[tuple[int, int], NDArray[np.int64]], Sequence[NDArray[np.int64]]]
"""`(shape, cells of a connected area of at least 2) -> its two connected parts`, in any order."""
STUCK_AFTER = 2
"""Steps in a row without a move or an allocation that end a run as stuck."""


class Status(Enum):
    """What a robot is doing (paper, section 4.2)."""

    IDLE = "idle"
    TRAVELING = "traveling"
    COVERING = "covering"
    DONE = "done"
    DEAD = "dead"


class State(Enum):
    """What has become of an area (paper, section 4.2)."""

    UNASSIGNED = "unassigned"
    ASSIGNED = "assigned"
    COMPLETED = "completed"


@dataclass(eq=False)
class _Robot:
    number: int
    cell: int
    status: Status = Status.IDLE
    area: int = NO_ROBOT
    ahead: list[int] = field(default_factory=list)  # cells of the current path still to enter, the next one last
    path: list[int] = field(default_factory=list)  # the cell at every step so far
    legs: list[Leg] = field(default_factory=list)

    @property
    def alive(self) -> bool:
        return self.status is not Status.DEAD


@dataclass(eq=False)
class _Area:
    level: int
    cells: NDArray[np.int64]
    unvisited: int
    robot: int = NO_ROBOT
    state: State = State.UNASSIGNED


@dataclass(frozen=True, eq=False)
class Run:
    """What happened in one run. Axis `K` = robots.

    Attributes:
        paths: per robot int64 `[steps + 1]`: its cell at each step from t = 0 to its last move.
        legs: per robot, its travel and cover legs.
        areas_added: areas made during the run, by sharing or reallocation, in id order.
        outcome, time: how and at which step it ended.
        bisected, divided: areas shared whose unvisited cells were one component, and that lay in several already.
        visited, survived: bool `[N]`, cells entered, and entered without being stopped there.
        alive: bool `[K]`.
        area_of: int32 `[N]`, id of the last area that each cell belonged to, -1 where inaccessible.
    """

    paths: tuple[NDArray[np.int64], ...]
    legs: tuple[tuple[Leg, ...], ...]
    areas_added: tuple[Area, ...]
    outcome: Outcome
    time: int
    bisected: int
    divided: int
    visited: NDArray[np.bool_]
    survived: NDArray[np.bool_]
    alive: NDArray[np.bool_]
    area_of: NDArray[np.int32]

    @property
    def shares(self) -> int:
        """Areas shared."""
        return self.bisected + self.divided


def never_hit(robot: int, step: int, cell: int) -> bool:
    """The nominal run's luck."""
    return False


def simulate(
    shape: tuple[int, int],
    paths: SafestPaths,
    allocation: tuple[Area, ...],
    starts: NDArray[np.int64],
    *,
    max_steps: int,
    stay_inside: bool = False,
    hit: Hit = never_hit,
    split: Split = bisect,
    recorder: Recorder | None = None,
) -> Run:
    """Run Algorithm 2 from an allocation to its end.

    Args:
        shape: (H, W). paths: safest paths over the accessible cells.
        allocation: the areas at t = 0 in id order; together they hold every accessible cell once.
        starts: cell index of each robot, int64 `[K]`.
        max_steps: T_max, the step at which an unfinished run ends as a timeout.
        stay_inside: `transit="area"`: legs of a coverage path stay inside the area.
        hit: decides every hit; called once for each cell that a live robot enters, in order.
        split: halves the one component of a shared area. recorder: writes down the run for its trace.
    """
    return Simulation(shape, paths, allocation, starts, stay_inside, hit, split, recorder).run(max_steps)


class Simulation:
    """A run in progress: `simulate` is `run`; an oracle drives it step by step and forks it at hits."""

    def __init__(
        self,
        shape: tuple[int, int],
        paths: SafestPaths,
        allocation: tuple[Area, ...],
        starts: NDArray[np.int64],
        stay_inside: bool,
        hit: Hit,
        split: Split,
        recorder: Recorder | None,
    ) -> None:
        self.shape, self.paths, self.stay_inside = shape, paths, stay_inside
        self.hit, self.split, self.recorder = hit, split, recorder
        n = shape[0] * shape[1]
        self.visited, self.survived = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        self.area_of = np.full(n, NO_ROBOT, dtype=np.int32)
        self.level_of_open = np.full(n, NOT_WANTED, dtype=np.int16)
        self.open_levels: Counter[int] = Counter()
        self.areas: list[_Area] = []
        self.made: list[Area] = []  # every area as it was when it was made
        self.robots = [_Robot(number, int(cell)) for number, cell in enumerate(starts)]
        self.given = len(allocation)
        self.step, self.quiet, self.bisected, self.divided, self.progress = 0, 0, 0, 0, False
        for area in allocation:
            self._append_area(area.level, area.cells)
        for number, area in enumerate(allocation):
            if area.robot != NO_ROBOT:
                self._give(self.robots[area.robot], number)
        self.unvisited = sum(area.unvisited for area in self.areas)

    def run(self, max_steps: int) -> Run:
        self.take_turns()
        while (outcome := self.outcome(max_steps)) is None:
            self.advance()
        return self._result(outcome)

    def advance(self) -> None:
        """The next step."""
        self.step += 1
        self.progress = False
        self.take_turns()

    def take_turns(self, first: int = 0) -> None:
        """Robots `first`, `first + 1`, ... act in this step, and it ends."""
        for robot in range(first, len(self.robots)):
            if self.step == 0:
                self._start(robot)
            else:
                self._act(robot)
        self.quiet = 0 if self.progress else self.quiet + 1
        self._look()

    def stop(self, number: int) -> None:
        """The robot, which has just entered its cell, is stopped there."""
        robot = self.robots[number]
        robot.status = Status.DEAD
        self._note(EventKind.HIT, number, robot.area, robot.cell)
        if robot.area != NO_ROBOT:
            self._reallocate(robot)

    def copy(self) -> Simulation:
        """A fork that goes on from here, in mid-step too; what it writes down (paths, legs, areas made) begins here."""
        fork = copy(self)
        fork.visited, fork.survived = self.visited.copy(), self.survived.copy()
        fork.area_of, fork.level_of_open = self.area_of.copy(), self.level_of_open.copy()
        fork.open_levels = self.open_levels.copy()
        fork.areas = [copy(area) for area in self.areas]  # their arrays are replaced, never written
        fork.robots = [replace(robot, ahead=robot.ahead.copy(), path=[], legs=[]) for robot in self.robots]
        fork.made, fork.given = [], 0
        return fork

    def outcome(self, max_steps: int) -> Outcome | None:
        """How the run ends after this step; None if it goes on."""
        if self.unvisited == 0:
            return Outcome.COMPLETE
        if not any(robot.alive for robot in self.robots):
            return Outcome.STOPPED
        if self.quiet >= STUCK_AFTER:
            return Outcome.STUCK
        if self.step >= max_steps:
            return Outcome.TIMEOUT
        return None

    # --- what a robot does in one step ---

    def _start(self, number: int) -> None:
        """t = 0: the start cell is entered like any other; a robot that stands in its area begins to cover it."""
        robot = self.robots[number]
        in_own_area = robot.status is Status.TRAVELING and self.area_of[robot.cell] == robot.area
        self._enter(number, robot.cell, "cover" if in_own_area else None)
        if robot.alive and robot.status is Status.TRAVELING:
            self._travel(robot)
            self._finish_paths(number)

    def _act(self, number: int) -> None:
        robot = self.robots[number]
        if robot.status in (Status.TRAVELING, Status.COVERING):
            arrives = robot.status is Status.COVERING or len(robot.ahead) == 1
            self._enter(number, robot.ahead.pop(), "cover" if arrives else "travel")
            if robot.alive:
                self._finish_paths(number)
        elif robot.alive:
            robot.path.append(robot.cell)
            if self._allocate_next(number, may_share=False):
                self._finish_paths(number)

    def _enter(self, number: int, cell: int, leg: str | None) -> None:
        """Move into `cell`: mark it, complete its area, then the hit check."""
        robot = self.robots[number]
        robot.cell = cell
        robot.path.append(cell)
        self.progress = True
        if leg is not None:
            self._log_leg(robot, leg)
        if not self.visited[cell]:
            self.visited[cell] = True
            self.unvisited -= 1
            holder = self.areas[self.area_of[cell]]
            holder.unvisited -= 1
            if holder.unvisited == 0:
                self._set_state(int(self.area_of[cell]), State.COMPLETED)
                self._note(EventKind.COMPLETED, number, int(self.area_of[cell]), cell)
        if self.hit(number, self.step, cell):
            self.stop(number)
        else:
            self.survived[cell] = True

    def _log_leg(self, robot: _Robot, kind: str) -> None:
        last = robot.legs[-1] if robot.legs else None
        if last is not None and (last.kind, last.area, last.stop) == (kind, robot.area, self.step):
            robot.legs[-1] = Leg(last.kind, last.area, last.level, last.start, self.step + 1)
        else:
            level = self.areas[robot.area].level
            robot.legs.append(Leg(kind, robot.area, level, self.step, self.step + 1))  # type: ignore[arg-type]

    def _finish_paths(self, number: int) -> None:
        """A path with no cells left is finished at once, in the same step; so is the next one, if it has none."""
        robot = self.robots[number]
        while not robot.ahead:
            if robot.status is Status.TRAVELING:
                self._cover(robot)
            elif robot.status is Status.COVERING:
                self._set_state(robot.area, State.COMPLETED)
                self._allocate_next(number, may_share=True)
            else:
                return

    def _cover(self, robot: _Robot) -> None:
        cells = self.areas[robot.area].cells
        inside = None
        if self.stay_inside:
            inside = np.zeros(len(self.visited), dtype=np.bool_)
            inside[cells] = True
        to_do = cells[~self.visited[cells]]
        robot.ahead = coverage_path(self.paths, robot.cell, to_do, inside)[::-1].tolist()
        robot.status = Status.COVERING

    def _travel(self, robot: _Robot) -> None:
        """The safest path to the cheapest cell of the robot's area."""
        rank = np.full(len(self.visited), NOT_WANTED, dtype=np.int32)
        rank[self.areas[robot.area].cells] = 0
        target = self.paths.nearest(robot.cell, rank)
        if target is None:
            raise ValueError(f"area {robot.area} cannot be reached from cell {robot.cell}")
        robot.ahead = self.paths.path(robot.cell, target.cell)[::-1].tolist()
        robot.status = Status.TRAVELING

    # --- who gets what ---

    def _allocate_next(self, number: int, *, may_share: bool) -> bool:
        """`Allocate Next Area`, else `Find Area To Share`, else done. True if the robot got an area."""
        robot = self.robots[number]
        levels = sorted(level for level, count in self.open_levels.items() if count)
        target = choose_next_area(self.paths, robot.cell, levels, self.level_of_open, self.area_of)
        if target is not None:
            self._give(robot, int(self.area_of[target.cell]))
            robot.ahead = self.paths.path(robot.cell, target.cell)[::-1].tolist()
            self._note(EventKind.ALLOCATED, number, robot.area, target.cell)
            self.progress = True
            return True
        if may_share and self._share(number):
            self.progress = True
            return True
        if may_share:
            robot.status, robot.area = Status.DONE, NO_ROBOT
        return False

    def _share(self, helper_number: int) -> bool:
        """`Find Area To Share`: the best area of another live robot is split between the two."""
        helper = self.robots[helper_number]
        cost = self.paths.to_all(helper.cell)
        candidates = []
        for number, area in enumerate(self.areas):
            if area.state is State.ASSIGNED and area.unvisited >= 2 and area.robot != helper_number:
                nearest = int(area.cells[np.argmin(cost[area.cells])])
                reached = cost[nearest] != NOT_WANTED
                if reached and len(self.paths.path(helper.cell, nearest)) <= area.unvisited:
                    candidates.append((area.level, int(cost[nearest]), number))
        if not candidates:
            return False
        number = min(candidates)[2]
        owner = self.robots[self.areas[number].robot]
        parts = self._replace(number, split=True)
        owner_cost = self.paths.to_all(owner.cell)
        chosen = choose_parts([self.areas[part].cells for part in parts], owner_cost, cost)
        self._give(owner, parts[chosen.owner])
        self._give(helper, parts[chosen.helper])
        self._note(EventKind.SHARED, helper_number, number, len(parts))
        for robot in (owner, helper):
            self._travel(robot)
            # at t = 0 an owner that acts later may stand in its part: it has not entered its start yet
            target = robot.ahead[0] if robot.ahead else robot.cell
            self._note(EventKind.ALLOCATED, robot.number, robot.area, target)
        return True

    def _reallocate(self, robot: _Robot) -> None:
        """`Reallocate Area`: what the robot left unvisited becomes unassigned areas of their own."""
        if parts := self._replace(robot.area, split=False):
            self._note(EventKind.REALLOCATED, robot.number, robot.area, len(parts))

    def _replace(self, number: int, *, split: bool) -> list[int]:
        """Complete the area; the components of its unvisited cells become new areas. `split`: at least two."""
        area = self.areas[number]
        parts = connected_parts(self.shape, area.cells[~self.visited[area.cells]])
        if split and len(parts) > 1:
            self.divided += 1
        elif split:
            self.bisected += 1
            parts = sorted(self.split(self.shape, parts[0]), key=lambda part: int(part[0]))
        self._set_state(number, State.COMPLETED)
        area.cells = area.cells[self.visited[area.cells]]
        area.unvisited = 0
        return [self._append_area(area.level, part) for part in parts]

    # --- the book of areas ---

    def _append_area(self, level: int, cells: NDArray[np.int64]) -> int:
        number = len(self.areas)
        self.areas.append(_Area(level, cells, len(cells)))
        self.made.append(Area(level, NO_ROBOT, cells))
        self.area_of[cells] = number
        self.level_of_open[cells] = level
        self.open_levels[level] += 1
        return number

    def _give(self, robot: _Robot, number: int) -> None:
        self._set_state(number, State.ASSIGNED)
        self.areas[number].robot = robot.number
        robot.area, robot.status = number, Status.TRAVELING

    def _set_state(self, number: int, state: State) -> None:
        area = self.areas[number]
        if area.state is State.UNASSIGNED and state is not State.UNASSIGNED:
            self.level_of_open[area.cells] = NOT_WANTED
            self.open_levels[area.level] -= 1
        area.state = state

    # --- what is told about the run ---

    def _note(self, kind: EventKind, robot: int, area: int, other: int) -> None:
        if self.recorder is not None:
            self.recorder.note(self.step, robot, kind, area, other)

    def _look(self) -> None:
        if self.recorder is not None:
            self.recorder.look([(robot.cell, Doing[robot.status.name], robot.area) for robot in self.robots])

    def _result(self, outcome: Outcome) -> Run:
        return Run(
            paths=tuple(_without_tail(robot.path) for robot in self.robots),
            legs=tuple(tuple(robot.legs) for robot in self.robots),
            areas_added=tuple(self.made[self.given :]),
            outcome=outcome,
            time=self.step,
            bisected=self.bisected,
            divided=self.divided,
            visited=self.visited,
            survived=self.survived,
            alive=np.array([robot.alive for robot in self.robots]),
            area_of=self.area_of,
        )


def _without_tail(path: list[int]) -> NDArray[np.int64]:
    """The path without the waiting after its last move."""
    last = len(path)
    while last > 1 and path[last - 1] == path[last - 2]:
        last -= 1
    return np.array(path[:last], dtype=np.int64)
