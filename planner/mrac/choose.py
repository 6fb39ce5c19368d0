"""What a robot would take next: the areas as it sees them, the policy's order, and the limits on the team."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.mrac.board import Board, Choice, Robot, can_afford
from planner.policies.limits import most_at_risk
from planner.settings import Settings
from planner.simulator.codes import NO_CELL, Doing
from planner.simulator.offers import NO_REFUSAL, Offer, is_dangerous, is_refused
from planner.simulator.searches import NOT_WANTED, UNREACHED

# Who hears whom: robots in a chain of short enough links from a base (SPEC section 22).

EPSILON = 1e-9
"""Squares of distances are whole numbers: a radius of 5 reaches (3, 4)."""


def reach_of(settings: Settings) -> int:
    """The largest squared distance of a link, in cells; `radio` is set."""
    assert settings.radio is not None
    return math.floor(settings.radio**2 + EPSILON)


def in_contact(places: NDArray[np.int64], bases: NDArray[np.int64], reach: int) -> NDArray[np.bool_]:
    """Which robots at `places` `[K, 2]`, (row, col), are in a chain from one of the `bases` `[B, 2]`, bool `[K]`."""

    def near(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((np.square(one[:, None] - other).sum(axis=-1) <= reach).any(axis=1))

    heard = near(places, bases)
    while (more := near(places, places[heard]) & ~heard).any():
        heard |= more
    return heard


def hears(board: Board, robot: Robot) -> bool:
    """Whether the robot is in touch with a base, by way of others that are alive: only then it takes over."""
    problem = board.problem
    if problem.settings.radio is None:
        return True
    alive = [other for other in board.robots if other.alive]
    places = np.stack(np.divmod([other.cell for other in alive], problem.world.shape[1]), axis=1)
    return bool(in_contact(places, problem.bases, reach_of(problem.settings))[alive.index(robot)])


def drives_back(board: Board, robot: Robot) -> bool:
    """Whether a robot without an area makes a move back, to hear of those that nobody has; that is then ahead of it."""
    if not board.unassigned or hears(board, robot):
        return False
    of, onward = board.problem.back
    cell = int(onward[of[robot.number], robot.cell])
    robot.ahead = [] if cell == NO_CELL else [cell]
    return bool(robot.ahead)


def first_area(board: Board, robot: Robot, *, own: bool = False, refusing: bool = True) -> Choice | None:
    """`Allocate Next Area`: the first of the unassigned areas that the robot can reach; None if there is none.

    `own`: its own area is among them. `refusing`: areas that cost more than a robot is worth are not.
    """
    if not hears(board, robot):
        return None
    if board.rule.nearest and board.problem.home is None and board.problem.own is None:
        return _nearest(board, robot)
    seen = [choice for choice in offered(board, robot, own=own) if can_afford(board, robot, choice.target)]
    if refusing and board.rule.limited:
        seen = [choice for choice in seen if not _is_refused(board, robot, choice)]
    return min(seen, key=lambda choice: (board.rule.key(choice.offer), choice.area), default=None)


def offered(board: Board, robot: Robot, *, own: bool = False) -> list[Choice]:
    """The unassigned areas that the robot can reach, with its own one if that is asked for, by id."""
    reachable = board.unassigned if board.open_levels(robot) else set()
    numbers = sorted(reachable | ({robot.area} if own else set()))
    cost = board.problem.paths_of(robot.number).to_all(robot.cell) if numbers else np.zeros(0, dtype=np.int64)
    return [choice for number in numbers if (choice := _see(board, robot, number, cost)) is not None]


def first_of_idle(board: Board, robot: Robot) -> Choice | None:
    """The same of a robot that waits, kept until an unassigned area comes, goes, or loses a cell to do."""
    if not hears(board, robot):
        return None
    now: tuple[int, ...] = (board.changes, robot.cell, 0 if board.problem.home is None else board.next_move)
    if board.problem.own is not None:  # the price goes by who is alive
        now = (*now, sum(other.alive for other in board.robots))
    if robot.asked != now:
        robot.asked, robot.first = now, first_area(board, robot)
    return robot.first


def _nearest(board: Board, robot: Robot) -> Choice | None:
    """`first_area` of a rule by (level, cost): the least level with an area that can be reached, by one search each."""
    for level in board.open_levels(robot):
        target = board.problem.paths.nearest(robot.cell, board.open_of(level))
        if target is not None:
            number = int(board.area_of[target.cell])
            return Choice(number, target.cell, offer_of(board, robot, number, target.cost))
    return None


def _see(board: Board, robot: Robot, number: int, cost: NDArray[np.int64]) -> Choice | None:
    """An area at these costs `[N]` from the robot; None if it cannot be reached, or has no cell to head for."""
    cells = board.goals(number)
    if len(cells) == 0 or cost[cells[0]] == UNREACHED:
        return None
    target = int(cells[cost[cells].argmin()])
    return Choice(number, target, offer_of(board, robot, number, int(cost[target])))


def offer_of(board: Board, robot: Robot, number: int, cost: int) -> Offer:
    """An area whose target costs the robot so much to reach, as a rule sees it."""
    area, problem = board.areas[number], board.problem
    value = area.unvisited if problem.value is None else int(problem.value[board.to_do(number)].sum())
    level, shown = problem.level_for(robot.number, area.level), frontier(board, number)
    entry, surcharge = int(problem.entry[level]), 0
    if board.rule.attentive and problem.own is not None:
        levels = (problem.level_for(other.number, area.level) for other in board.robots if other.alive)
        surcharge = area.unvisited * (entry - min((int(problem.entry[level]) for level in levels), default=entry))
    return Offer(level, cost, area.unvisited, entry, value, problem.beyond, shown, surcharge)


def frontier(board: Board, number: int) -> int:
    """How many cells that nobody has seen are seen from the area's cells to do."""
    if board.seen is None or board.problem.unknown is None:
        return 0
    shown = np.zeros_like(board.seen)
    for cell in board.to_do(number).tolist():
        shown[board.problem.unknown.view(cell)] = True
    return int(np.count_nonzero(shown & ~board.seen))


def _is_refused(board: Board, robot: Robot, choice: Choice) -> bool:
    problem, offer = board.problem, choice.offer
    limited = board.rule.limited and problem.theta < NO_REFUSAL
    if limited and problem.home is not None:  # what it costs includes a longer way home
        offer = offer._replace(cost=offer.cost + problem.home.further(robot.number, robot.cell, choice.target))
    return bool(limited and is_refused(offer, problem.costs.size, problem.theta, problem.scale))


def first_to_share(board: Board, robot: Robot) -> Choice | None:
    """`Find Area To Share`: the best area of another live robot that is worth the way; None if there is none."""
    if not hears(board, robot):
        return None
    numbers = [number for number in _held_by_others(board, robot) if _may_be_worth_it(board, robot, number)]
    levels = {number: board.problem.level_for(robot.number, board.areas[number].level) for number in numbers}
    for level in sorted(set(levels.values())):
        left = {number for number in numbers if levels[number] == level}
        while left and (choice := _nearest_of(board, robot, left)) is not None:
            steps = len(board.problem.paths_of(robot.number).path(robot.cell, choice.target))
            near = _is_near(board, robot, choice.area, steps) and can_afford(board, robot, choice.target)
            if near and not _is_refused(board, robot, choice):
                return choice
            left.remove(choice.area)
    return None


def _held_by_others(board: Board, robot: Robot) -> list[int]:
    """Areas of other live robots with at least two cells to do."""
    numbers = (other.area for other in board.robots if other is not robot and other.on_its_way and hears(board, other))
    return [number for number in numbers if board.areas[number].unvisited >= 2]


def _may_be_worth_it(board: Board, robot: Robot, number: int) -> bool:
    """False if the way there takes more steps than the area has cells to do, however it leads."""
    width = board.problem.world.shape[1]
    row, col = divmod(robot.cell, width)
    rows, cols = np.divmod(board.goals(number), width)
    return _is_near(board, robot, number, int((np.abs(rows - row) + np.abs(cols - col)).min()))


def _is_near(board: Board, helper: Robot, number: int, moves: int) -> bool:
    """Whether the helper would be in another's area after so many moves before that one has covered it alone."""
    area, pace = board.areas[number], board.problem.pace
    return moves * pace(helper.number) <= area.unvisited * pace(area.robot)


def _nearest_of(board: Board, robot: Robot, numbers: set[int]) -> Choice | None:
    """Of these areas of one level the first by (cost, id); None if none can be reached."""
    goals = {number: board.goals(number) for number in numbers}
    rank = np.full(len(board.visited), NOT_WANTED, dtype=np.int32)
    for number, cells in goals.items():
        rank[cells] = number
    paths = board.problem.paths_of(robot.number)
    target = paths.nearest(robot.cell, rank, among=np.concatenate(list(goals.values())))
    if target is None:
        return None
    number = int(rank[target.cell])
    return Choice(number, target.cell, offer_of(board, robot, number, target.cost))


def is_at_risk(board: Board, choice: Choice) -> bool:
    """True if the area is dangerous, or a cell on the way to it."""
    return bool(is_dangerous(choice.offer, board.problem.costs.size))


def is_full(board: Board, robot: Robot) -> bool:
    """True if as many other robots are at risk as the team's `reserve` allows."""
    reserve = board.problem.settings.reserve
    if reserve is None:
        return False
    alive = sum(other.alive for other in board.robots)
    at_risk = sum(_is_now_at_risk(board, other) for other in board.robots if other is not robot)
    return at_risk >= most_at_risk(reserve, alive)


def _is_now_at_risk(board: Board, robot: Robot) -> bool:
    dangerous = board.problem.is_dangerous(robot.number, board.levels()[robot.ahead])
    if robot.status is Doing.RETURNING:
        return dangerous
    level = board.areas[robot.area].level if robot.on_its_way else 0
    return robot.on_its_way and (board.problem.level_for(robot.number, level) > 0 or dangerous)


def has_to_wait(board: Board, robot: Robot, choice: Choice) -> bool:
    """True if `reserve` holds the robot from an area that it would be allocated: too many are at risk, or one of the
    idle and done robots, or where robots break off of those that are not at risk, would get its own first area at a
    lower price.
    """
    if board.problem.settings.reserve is None or not is_at_risk(board, choice):
        return False
    if is_full(board, robot):
        return True
    mine = board.rule.key(choice.offer)
    for other in board.robots:
        busy = other.on_its_way and not (board.rule.breaks_off and not _is_now_at_risk(board, other))
        if other is not robot and other.able and not busy:
            first = first_of_idle(board, other)
            if first is not None and board.rule.key(first.offer) < mine:
                return True
    return False
