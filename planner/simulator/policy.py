"""A policy as the compiled simulator follows it: the order of offers, and the limits on the team.

One program serves all built-in rules; a second one serves users' rules, whose orders it calls through a pointer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from .codes import DEAD
from .jit import UNCOUNTED, kernel, rare_kernel
from .offers import NO_REFUSAL, Offer, by_cost_and_frontier, by_cost_per_cell, is_dangerous, is_refused, price
from .robot_types import own, own_level
from .state import SEEN, VISITED

for _stated in (price, is_dangerous, is_refused, by_cost_per_cell, by_cost_and_frontier):
    register_jitable(**UNCOUNTED)(_stated)


class Policy(NamedTuple):
    """Decisions of robots of a rule that re-evaluates. Axes: `A` accessible cells, `K` robots, `L` threat levels.

    Attributes:
        reevaluates, preempts, by_price: as in `Rule`. looks_ahead: too, but None where no program updates the map.
        limited: whether areas can be refused.
        entry: int64 `[L]`, cost of entering a cell of each level. danger: bool `[A]`, cells of a dangerous level.
        cells: n of the whole map. theta: the price per new cell from which on an area is refused.
        robot_value: whether refusals are recorded.
        most: int64 `[K + 1]`, robots that may be at risk, by the number alive; empty: all of them.
        value: int64 `[A]`, value of the cells; empty: 1 each. scale, beyond: as in `planner.mrac.problem.Problem`.
        view_begin, in_view: as in `Tables`, if the rule looks ahead in an online mission, else empty.
        stamp: int64 `[A + 1]`, scratch of a thread: the last offer that counted each cell; at the end the number of
            offers.
        is_own, own: whether the rule has an order that `order_of` lacks, and that order (`as_function`); else None.
        key: None in compiled programs; the order of a rule that runs as Python only (`Rule.key`).
    """

    reevaluates: bool
    preempts: bool
    looks_ahead: bool | None
    by_price: bool
    limited: bool
    entry: NDArray[np.int64]
    danger: NDArray[np.bool_]
    cells: int
    theta: int
    robot_value: bool
    most: NDArray[np.int64]
    value: NDArray[np.int64]
    scale: int
    beyond: int
    view_begin: NDArray[np.int64]
    in_view: NDArray[Any]
    stamp: NDArray[np.int64]
    is_own: bool | None = None
    own: Any = None
    key: Any = None


@rare_kernel
def unvisited_value(p, s, area):
    """Value of the unvisited cells of an area."""
    total = np.int64(0)
    for place in range(s.areas[area].begin, s.areas[area].end):
        cell = np.int64(s.order[place])
        if s.home[cell] & VISITED == 0:
            total += p.value[cell]
    return total


@kernel
def offer_of(t, p, s, robot, area, cost):
    """An area as an offer to the robot, with its target at this cost."""
    level, left = own_level(t, robot, s.areas[area].level), np.int64(s.areas[area].left)
    value = unvisited_value(p, s, area) if len(p.value) > 0 else left
    shown = frontier(p, s, area) if p.looks_ahead and len(p.view_begin) > 0 else np.int64(0)
    more = surcharge(t, p, s, robot, area) if t.mixed else np.int64(0)
    return Offer(level, np.int64(cost), left, p.entry[level], value, np.int64(p.beyond), shown, more)


@rare_kernel
def surcharge(t, p, s, robot, area):
    """How much less a living robot of another type would pay for the area's cells to do."""
    level = np.int64(s.areas[area].level)
    # Over living robots only: a loss of the last robot of a type changes every price (`visits.lose`).
    mine = least = p.entry[own_level(t, robot, level)]
    for other in range(len(s.robots)):
        if s.robots[other].doing != DEAD:
            least = min(least, p.entry[own_level(t, other, level)])
    return (mine - least) * np.int64(s.areas[area].left)


@rare_kernel
def frontier(p, s, area):
    """Number of cells not seen yet that would be seen from the area's cells to do."""
    last, shown = len(p.stamp) - 1, np.int64(0)
    # A stamp for each offer counts a cell seen from several cells to do once, without clearing.
    p.stamp[last] += 1
    for place in range(s.areas[area].begin, s.areas[area].end):
        cell = np.int64(s.order[place])
        if s.home[cell] & VISITED:
            continue
        for at in range(p.view_begin[cell], p.view_begin[cell + 1]):
            other = p.in_view[at]
            if s.known[other] & SEEN == 0 and p.stamp[other] != p.stamp[last]:
                p.stamp[other] = p.stamp[last]
                shown += 1
    return shown


@kernel
def is_danger(t, p, s, robot, cell):
    """Whether the cell is of a dangerous level on the robot's map."""
    return s.level[cell] > 0 if t.learns else p.danger[own(t, robot, cell)]


@kernel
def order_of(p, offer):
    """The two fractions by which the rule orders offers: (numerator, denominator) each."""
    if p.is_own:
        return own_order(p, offer)
    return by_cost_and_frontier(offer) if p.looks_ahead else by_cost_per_cell(offer)


@rare_kernel
def own_order(p, o):
    """`order_of` a rule that is not built in."""
    given = o.level, o.cost, o.unvisited, o.entry, o.value, o.beyond, o.frontier, o.surcharge
    return (p.own(0, *given), p.own(1, *given)), (p.own(2, *given), p.own(3, *given))


@kernel
def is_before(p, one, other, by_id):
    """Whether the rule puts one offer before the other; `by_id` decides ties."""
    if p.key:
        mine, theirs = p.key(one), p.key(other)
        return mine < theirs or (mine == theirs and by_id)
    mine, theirs = order_of(p, one), order_of(p, other)
    # Crosswise products of whole numbers: no rounding decides an order.
    left, right = mine[0][0] * theirs[0][1], theirs[0][0] * mine[0][1]
    if left != right:
        return left < right
    left, right = mine[1][0] * theirs[1][1], theirs[1][0] * mine[1][1]
    return left < right or (left == right and by_id)


@kernel
def refuses(p, offer):
    """Whether an area is not worth the risk to a robot."""
    # The cheap tests come first: `is_refused` divides.
    return p.limited and p.theta < NO_REFUSAL and is_refused(offer, p.cells, p.theta, p.scale)
