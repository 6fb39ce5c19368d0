"""A run whose robots do not always do what was decided: they are pushed, late, held up, found again, or recharged."""

from __future__ import annotations

from dataclasses import replace

from planner.mrac.board import Robot
from planner.mrac.choose import has_to_wait, offer_of
from planner.mrac.executive import Executive
from planner.mrac.homecoming import is_home
from planner.none import NO_AREA
from planner.tally import Outcome
from planner.trace import Doing, EventKind


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
