"""When a robot turns for home (SPEC section 19): what it can afford, and what is left of its leg."""

from __future__ import annotations

from planner.mrac.board import Board, Robot
from planner.mrac.homeward import CUT_OFF, Homeward
from planner.trace import Doing


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
