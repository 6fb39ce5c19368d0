"""When a robot turns for home (SPEC section 19): what it can afford, and what is left of its leg."""

from __future__ import annotations

from planner.mrac.board import Board, Robot
from planner.mrac.homeward import Homeward
from planner.trace import Doing


def can_go_on(board: Board, home: Homeward, robot: Robot, step: int) -> bool:
    """Whether the robot, which has yet to move in this step, could come home from every cell of the rest of its leg."""
    left = min(robot.moves, home.last - step + 1)
    return all(home.moves(robot.number, cell) <= left - made for made, cell in enumerate(rest_of_leg(board, robot), 1))


def rest_of_leg(board: Board, robot: Robot) -> list[int]:
    """The cells that the robot has still to enter until it is at its area's target, or the next cell to do."""
    ahead = robot.ahead[::-1]
    if robot.status is Doing.COVERING and not board.rule.attentive:
        # No leg crosses a cell that is still to do, so the first of them is its end.
        to_do = set(robot.to_do.tolist()).difference(robot.path[robot.since :])
        end = next(place for place, cell in enumerate(ahead, 1) if cell in to_do)
        return ahead[:end]
    return ahead


def has_to_leave(home: Homeward, robot: Robot, step: int) -> bool:
    """Whether the robot, which waits at the end of this step, could come home too late if it waited for another."""
    return home.moves(robot.number, robot.cell) > max(home.last - step - 1, 0)


def is_home(home: Homeward, robot: Robot) -> bool:
    """Whether the robot is in a cell that is one of its bases."""
    return home.moves(robot.number, robot.cell) == 0
