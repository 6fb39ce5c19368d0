"""A run whose robots do not always do what was decided: they are pushed, late, stuck, found again, or recharged."""

from __future__ import annotations

from dataclasses import replace

from planner.mrac.board import Robot
from planner.mrac.executive import Executive
from planner.none import NO_AREA
from planner.trace import Doing


class Fleet(Executive):
    """What a simulator never reports. The turn of a robot is as of `Executive`, `displace` or `wait` beside `enter`."""

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
        if robot.status is Doing.FOLLOWING:
            robot.ahead = robot.ahead[:-1] + self._way(robot, robot.ahead[-1])
        elif robot.on_its_way and self.areas[robot.area].unvisited == 0:
            self.complete(robot.area)
            self._allocate_next(robot)
        elif robot.on_its_way:
            self._travel(robot)
        self._finish_paths(robot)

    def visit(self, number: int, cell: int) -> None:
        """The robot has been at the cell, at some time before."""
        self._mark(self.robots[number], cell)
        self.survived[cell] = True

    def find(self, number: int) -> None:
        """A lost robot is back."""
        robot = self.robots[number]
        robot.status, robot.area, robot.ahead, robot.held = Doing.IDLE, NO_AREA, [], False

    def set_aside(self, number: int) -> None:
        """The robot makes no progress: its work is for others, until it moves."""
        robot = self.robots[number]
        self._lay_down(robot)
        robot.aside = True

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
        self.problem = replace(self.problem, range=ranges)
