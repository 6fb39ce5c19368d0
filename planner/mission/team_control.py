"""A run whose robots do not always do what was decided: they are pushed, late, held up, found again, or recharged."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import as_whole, is_whole
from planner.errors import StateError
from planner.files import Json
from planner.ids import MAX_STEP
from planner.mrac.board import Robot, is_home
from planner.mrac.choose import has_to_wait, offer_of
from planner.mrac.executive import Executive
from planner.plan.reading import at
from planner.simulator.codes import NO_AREA, Doing, EventKind, Outcome


class Fleet(Executive):
    """What a simulator never reports. The turn of a robot is as of `Executive`, `displace` or `wait` beside `enter`.

    Attributes:
        gain: share of the cost of its way that another target must save for a robot to leave its own; 1: nothing does.
    """

    gain: float = 1.0

    def decide(self, number: int) -> int | None:
        """As of `Executive`, once a robot that is under way has looked for an area that is worth to turn round for."""
        robot = self.robots[number]
        if self.gain < 1 and self.step > 0 and robot.status is Doing.TRAVELING and self.areas[robot.area].unvisited:
            self.next_move = self.step
            self._look_round(robot)
            self.next_move = self.step + 1
        return super().decide(number)

    def _look_round(self, robot: Robot) -> None:
        """The first of the areas that nobody has, if the policy has it before its own, and the way saves enough."""
        first, left = self.choose(robot), self._cost(robot.ahead)
        if first is None or not self._saves(first.offer.cost, left) or has_to_wait(self, robot, first):
            return
        if self.rule.key(first.offer) < self.rule.key(offer_of(self, robot, robot.area, left)):
            self._note(EventKind.LOOKED_AGAIN, robot, robot.area, robot.ahead[-1])
            self.release(robot)
            self._take(robot, first)
            self._finish_paths(robot)

    def _cost(self, way: list[int]) -> int:
        return int(self.problem.costs[way].sum())

    def _saves(self, cost: int, of: int) -> bool:
        return of - cost > self.gain * of

    def wait(self, number: int) -> None:
        """The robot is on its way, and has not got there yet: the step is none of rest."""
        robot = self.robots[number]
        robot.path.append(robot.cell)
        self.progress = True

    def displace(self, number: int, cell: int) -> None:
        """The robot is at a cell that it was not to enter now: it is visited, and the robot goes on from there."""
        robot, width = self.robots[number], self.problem.world.shape[1]
        away = sum(abs(a - b) for a, b in zip(divmod(cell, width), divmod(robot.cell, width), strict=True))
        robot.moves = max(0, robot.moves - away)
        robot.cell = cell
        robot.path.append(cell)
        self.progress = True
        self._mark(robot, cell)
        self._set_out(robot)

    def _set_out(self, robot: Robot) -> None:
        """A new way to what the robot is about."""
        home = self.problem.home
        if robot.turned and home is not None:
            robot.ahead = home.way(robot.number, robot.cell)[::-1]
            robot.status = Doing.RETURNING if robot.ahead or is_home(home, robot) else Doing.DONE
        elif robot.status is Doing.FOLLOWING:
            robot.ahead = robot.ahead[:-1] + self._way(robot, robot.ahead[-1])
        elif robot.on_its_way and self.areas[robot.area].unvisited == 0:
            self.complete(robot.area)
            self._allocate_next(robot)
        elif robot.on_its_way:
            self._aim_as_before(robot)
        self._finish_paths(robot)

    def _aim_as_before(self, robot: Robot) -> None:
        """To what it was about to do next, or to what is nearest of its area now, if that is worth it."""
        ahead, left = robot.ahead[::-1] if robot.status is Doing.COVERING else robot.ahead[:1], self.to_do(robot.area)
        target = next((cell for cell in ahead if cell in left), None)
        way = [] if target is None else self._way(robot, target)
        if self._saves(self.problem.paths.cost_to(robot.cell, left), self._cost(way)) or not way:
            self._travel(robot)
        else:
            robot.status, robot.ahead = Doing.TRAVELING, way

    def visit(self, number: int, cell: int) -> None:
        """The robot has been at the cell, at some time before."""
        self._mark(self.robots[number], cell)
        self.survived[cell] = True

    def find(self, number: int) -> None:
        """A lost robot is back."""
        robot = self.robots[number]
        robot.status, robot.area, robot.ahead, robot.held = Doing.IDLE, NO_AREA, [], False
        robot.turned = False

    def set_aside(self, number: int) -> None:
        """The robot makes no progress: its work is for others, until it moves."""
        robot = self.robots[number]
        self._lay_down(robot)
        robot.aside = True

    def call_off(self) -> None:
        """The operator ends the mission between two steps: robots that come home start their return.

        What had ended it before stays the reason.
        """
        self.over = Outcome.ENDED_BY_OPERATOR if self.over is None else self.over
        self._call_home()

    def come_home(self) -> None:
        """Nothing may be left to do between two steps: then who is to come home turns."""
        if self.problem.home is not None and self.unvisited == 0:
            self._call_home()

    def retire(self, number: int) -> None:
        """The robot does no more."""
        self.limit(number, 0)
        if self.robots[number].alive:
            self._lay_down(self.robots[number])

    def limit(self, number: int, moves: int) -> None:
        """The robot can still make so many moves, whatever was known of its range."""
        robot, ranges = self.robots[number], self.problem.range.copy()
        made = max(int(ranges[number]) - robot.moves, 1)
        ranges[number], robot.moves = made + moves, moves
        if moves > 0 and robot.status is Doing.DONE and self.over is None:
            robot.turned = False  # with a new battery it gets work again
        self.problem = replace(self.problem, range=ranges)


# What robots are told, and what they tell.

Why = Literal["travel", "cover", "follow", "return", "hold", "idle"]
"""`travel` to its area, `cover` it, `follow` another planner's path, `return` home; `hold`: it waits its turn, has no
moves left or makes no progress; `idle`: nothing is left for it."""
Cell = tuple[int, int]


@dataclass(frozen=True)
class Order:
    """What a robot is to do in the step that is under way.

    Attributes:
        robot: its number. cell: (row, col), where it is to be at the end of the step.
        path: cells that it is to enter after that one, as things stand.
        area: the id of the area that it works on, or NO_AREA. why: what it does.
    """

    robot: int
    cell: Cell
    path: tuple[Cell, ...] = ()
    area: int = NO_AREA
    why: Why = "idle"

    def to_json(self) -> Json:
        """As a JSON object."""
        path = [list(cell) for cell in self.path]
        return {"robot": self.robot, "cell": list(self.cell), "path": path, "area": self.area, "why": self.why}


@dataclass(frozen=True)
class Report:
    """What a robot, or who watches it, said of the step that is under way.

    Attributes:
        cell: index of the cell where it is. stopped: it is lost there. found: it was lost before, and is back.
        moves_left: that it can still make; None: as known.
    """

    cell: int
    stopped: bool = False
    found: bool = False
    moves_left: int | None = None


# What robots said of the step under way: whether it can be true, and what of it was late.


class Reports:
    """Reports to a fleet.

    Attributes:
        fleet: as it stands at the end of the last step.
        now: by robot, what holds at the end of this one. passed: (robot, cell) where it was in a step before.
        heard: of each robot the last step that it reported of. seen: p of cells that were seen, None of an obstacle.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.now: dict[int, Report] = {}
        self.passed: list[tuple[int, int]] = []
        self.heard = [fleet.step] * len(fleet.robots)
        self.seen: dict[int, float | None] = {}

    def carry(self, before: Reports) -> None:
        """Take over what was reported before cells were closed; of late ones what can be reached still."""
        self.now, self.heard, self.seen = before.now, before.heard, before.seen
        self.passed = [one for one in before.passed if self.fleet.problem.part[one[1]]]

    def clear(self) -> None:
        """The step is over."""
        self.now, self.passed, self.seen = {}, [], {}

    def hear(self, number: int, cell: ArrayLike | None, step: Any, moves_left: Any, **flags: bool) -> Report | None:
        """A report, arguments as of `Mission.report`; what holds of this step by it, None if nothing is new.

        What is late is taken to hold of a step before, and the report of where the robot was is given back.
        Raises StateError, and nothing is taken.
        """
        there, current = self._cell(number, cell), self.fleet.step + 1
        if moves_left is not None and not is_whole(moves_left, 0, MAX_STEP):
            raise StateError(f"robot {number}: moves_left is {moves_left!r}", expected=f"0 to {MAX_STEP}")
        said = current if step is None else as_whole(step)
        if not is_whole(said, 0, current):
            raise StateError(f"robot {number} reports of step {said!r}", expected=f"a step up to {current}")
        if said < current and said <= self.heard[number] and not any(flags.values()):
            self.passed.append((number, there))
            return Report(there)
        before = self.now.get(number)
        if before is not None and said > self.heard[number] and not before.stopped and there != before.cell:
            self.passed.append((number, before.cell))  # it was late itself
            self.now[number] = replace(before, cell=there)
        report = self._agreed(number, Report(there, moves_left=moves_left, **flags))
        self.heard[number] = max(said, self.heard[number])
        self.now[number] = report
        return None if report == before else report

    def _cell(self, number: int, cell: ArrayLike | None) -> int:
        """The index of the cell that a robot says it is at."""
        if cell is None:
            return self.now[number].cell if number in self.now else self.fleet.robots[number].cell
        world, part, found = self.fleet.problem.world, self.fleet.problem.part, whole_numbers(cell)
        height, width = world.shape
        expected = f"[row, col] of a cell that it can reach, row 0..{height - 1} and col 0..{width - 1}"
        if found.shape != (2,):
            raise StateError(f"robot {number} is at {cell!r:.60}", expected=expected)
        row, col = map(int, found)
        index, where = row * width + col, f"robot {number} is at [{row}, {col}]"
        if not (0 <= row < height and 0 <= col < width):
            raise StateError(f"{where}, off the map", expected=expected)
        if not world.free[row, col] or (index in self.seen and self.seen[index] is None):
            raise StateError(f"{where}, an obstacle", expected=expected)
        if part[index] != part[self.fleet.robots[number].cell]:
            raise StateError(f"{where}, with no way there", expected=expected)
        return index

    def _agreed(self, number: int, new: Report) -> Report:
        """The report, if it can be true with what is known; what it leaves out as it was said before in this step."""
        robot, before = self.fleet.robots[number], self.now.get(number)
        lost = (not robot.alive and (before is None or not before.found)) or (before is not None and before.stopped)
        where = robot.cell if before is None else before.cell
        if lost and not new.found:
            if new.stopped and new.cell == where:
                return before or replace(new, moves_left=None)
            what = "moves" if new.cell != where else "reports"
            raise StateError(f"robot {number} is lost, and {what}", expected="found, if it was found again")
        if lost and self.seen.get(new.cell, 0.0) is None:
            found = f"robot {number} is found at {at(new.cell, self.fleet.problem.world)}, seen to be an obstacle"
            raise StateError(found, expected="the cell where it is")
        if before is None or lost:
            return replace(new, found=lost and new.found)
        if new.cell != before.cell:
            places = " and ".join(at(cell, self.fleet.problem.world) for cell in (before.cell, new.cell))
            raise StateError(
                f"robot {number} is at {places} in step {self.fleet.step + 1}", expected="one place a step"
            )
        moves_left = before.moves_left if new.moves_left is None else new.moves_left
        return Report(new.cell, new.stopped, before.found, moves_left)

    def said(self) -> list[Json]:
        """They as files hold them."""
        width, late = self.fleet.problem.world.shape[1], self.fleet.step
        passed = [{"robot": robot, "cell": list(divmod(cell, width)), "step": late} for robot, cell in self.passed]
        return passed + [
            {"robot": number, **asdict(report), "cell": list(divmod(report.cell, width))}
            for number, report in self.now.items()
        ]


def whole_numbers(given: ArrayLike) -> NDArray[np.int64]:
    """They as an array; an empty one for anything else."""
    try:
        found = np.asarray(given)
    except ValueError:  # ragged
        found = np.zeros(0)
    return found if found.dtype.kind in "iu" else np.zeros(0, dtype=np.int64)
