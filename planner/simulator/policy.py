"""A policy as the compiled simulator follows it: the order of the rule, and the limits on the team.

One program follows all built-in rules, a second one the rules of users, whose orders it calls through a pointer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import register_jitable
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.jit import UNCOUNTED, kernel, rare_kernel
from planner.mrac.problem import Problem
from planner.policies import RULES
from planner.policies.limits import NO_REFUSAL, is_dangerous, is_refused, most_at_risk
from planner.policies.rule import Offer, Rule, price
from planner.policies.rules import by_cost_and_frontier, by_cost_per_cell
from planner.simulator.robot_types import own, own_level
from planner.simulator.state import DEAD, SEEN, VISITED
from planner.simulator.tables import Tables

for _stated in (price, is_dangerous, is_refused, by_cost_per_cell, by_cost_and_frontier):
    register_jitable(**UNCOUNTED)(_stated)

OF_OFFER = types.int64(*[types.int64] * (1 + len(Offer._fields)))
"""Signature of `Policy.own`."""


def as_function(rule: Rule) -> Any:
    """The order of a user's own rule as a function with a C signature: programs are not compiled anew for each rule.

    Arguments: which of the four numbers of `Rule.order`, and those of an `Offer`. Raises PlanError for an order that is
    not arithmetic.
    """
    order = register_jitable(**UNCOUNTED)(rule.order)

    def number(which, level, cost, unvisited, entry, value, beyond, frontier, surcharge):
        (one, two), (three, four) = order(Offer(level, cost, unvisited, entry, value, beyond, frontier, surcharge))
        # A float has no `|`: an order that is not of whole numbers does not compile, instead of being cut to them.
        return (one if which == 0 else two if which == 1 else three if which == 2 else four) | 0

    try:
        return numba.cfunc(OF_OFFER, error_model="numpy")(number)
    except NumbaError as error:
        raise PlanError(
            f"the order of rule {rule.name} cannot be compiled",
            expected="whole-number arithmetic of an Offer: two pairs (numerator, denominator)",
            fix="roll it out with planner.mrac.simulate.ReferenceLoop",
        ) from error


class Policy(NamedTuple):
    """What an attentive robot decides by. Axes: `A` accessible cells, `K` robots, `L` threat levels.

    Attributes:
        looks_again, breaks_off, looks_ahead, by_price: as in `Rule`. limited: whether areas are ever refused.
        entry: int64 `[L]`, cost of entering a cell of each level. danger: bool `[A]`, cells of a dangerous level.
        cells: n of the whole map. theta: the price per new cell from which an area is refused.
        worth: whether robots say what they refuse.
        most: int64 `[K + 1]`, robots that may be at risk of so many alive; empty: all of them.
        value: int64 `[A]`, what cells count; empty: 1 each. scale, beyond: as in `planner.mrac.problem.Problem`.
        view_begin, in_view: as of `Tables`, if the rule looks ahead and robots learn, else empty.
        stamp: int64 `[A + 1]`, scratch of a thread: the last offer that a cell was counted for; last: offers.
        is_own, own: whether the rule is a user's own, and what it orders offers by (`as_function`); else None.
    """

    looks_again: bool
    breaks_off: bool
    looks_ahead: bool
    by_price: bool
    limited: bool
    entry: NDArray[np.int64]
    danger: NDArray[np.bool_]
    cells: int
    theta: int
    worth: bool
    most: NDArray[np.int64]
    value: NDArray[np.int64]
    scale: int
    beyond: int
    view_begin: NDArray[np.int64]
    in_view: NDArray[Any]
    stamp: NDArray[np.int64]
    is_own: bool | None = None
    own: Any = None


def dangerous(problem: Problem, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """`Policy.danger` of these cells `[A]`; where robots differ in type, `[Y A]`."""
    of_cell = problem.levels.of_cell[cells]
    return (of_cell if problem.own is None else problem.own.level[:, of_cell].ravel()) > 0


def make_policy(problem: Problem, cells: NDArray[np.int64], tables: Tables) -> Policy:
    """The policy of an attentive, exact rule; `cells` int64 `[A]`, the accessible ones. Raises PlanError."""
    rule, settings, unknown = problem.rule, problem.settings, problem.unknown
    ahead = slice(None if rule.looks_ahead and (unknown is None or unknown.looks) else 0)
    alive = range(len(problem.starts) + 1 if settings.reserve is not None else 0)
    is_own = RULES.get(rule.name) is not rule
    return Policy(
        looks_again=rule.looks_again,
        breaks_off=rule.breaks_off,
        looks_ahead=rule.looks_ahead,
        by_price=rule.by_price,
        limited=rule.limited and problem.theta < NO_REFUSAL,
        entry=problem.entry,
        danger=dangerous(problem, cells),
        cells=problem.costs.size,
        theta=problem.theta,
        worth=settings.worth is not None,
        most=np.array([most_at_risk(settings.reserve or 1.0, robots) for robots in alive], dtype=np.int64),
        value=np.zeros(0, dtype=np.int64) if problem.value is None else problem.value[cells],
        scale=problem.scale,
        beyond=problem.beyond,
        view_begin=tables.view_begin[ahead],
        in_view=tables.in_view[ahead],
        stamp=np.zeros(len(cells) + 1, dtype=np.int64)[ahead],
        is_own=True if is_own else None,
        own=as_function(rule) if is_own else None,
    )


@rare_kernel
def value_left(p, s, area):
    """What the unvisited cells of an area are worth."""
    total = np.int64(0)
    for place in range(s.areas[area].begin, s.areas[area].end):
        cell = np.int64(s.order[place])
        if s.home[cell] & VISITED == 0:
            total += p.value[cell]
    return total


@kernel
def offer_of(t, p, s, robot, area, cost):
    """An area as the rule sees it, its target being at this cost from the robot."""
    level, left = own_level(t, robot, s.areas[area].level), np.int64(s.areas[area].left)
    value = value_left(p, s, area) if len(p.value) > 0 else left
    shown = frontier(p, s, area) if len(p.view_begin) > 0 else np.int64(0)
    more = surcharge(t, p, s, robot, area) if t.mixed else np.int64(0)
    return Offer(level, np.int64(cost), left, p.entry[level], value, np.int64(p.beyond), shown, more)


@rare_kernel
def surcharge(t, p, s, robot, area):
    """How much less a robot alive of another type would pay for the area's cells to do."""
    level = np.int64(s.areas[area].level)
    mine = least = p.entry[own_level(t, robot, level)]
    for other in range(len(s.robots)):
        if s.robots[other].doing != DEAD:
            least = min(least, p.entry[own_level(t, other, level)])
    return (mine - least) * np.int64(s.areas[area].left)


@rare_kernel
def frontier(p, s, area):
    """How many cells that nobody has seen are seen from the area's cells to do."""
    last, shown = len(p.stamp) - 1, np.int64(0)
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
    """Whether the cell is of a dangerous level, as the robot knows it."""
    return s.level[cell] > 0 if t.learns else p.danger[own(t, robot, cell)]


@kernel
def order_of(p, offer):
    """The fractions that the rule orders an offer by."""
    if p.is_own:
        return own_order(p, offer)
    return by_cost_and_frontier(offer) if p.looks_ahead else by_cost_per_cell(offer)


@rare_kernel
def own_order(p, o):
    """The same of a user's own rule."""
    given = o.level, o.cost, o.unvisited, o.entry, o.value, o.beyond, o.frontier, o.surcharge
    return (p.own(0, *given), p.own(1, *given)), (p.own(2, *given), p.own(3, *given))


@kernel
def is_before(p, one, other, by_id):
    """Whether the rule puts one offer before the other; `by_id`: where it does not tell them apart."""
    mine, theirs = order_of(p, one), order_of(p, other)
    left, right = mine[0][0] * theirs[0][1], theirs[0][0] * mine[0][1]
    if left != right:
        return left < right
    left, right = mine[1][0] * theirs[1][1], theirs[1][0] * mine[1][1]
    return left < right or (left == right and by_id)


@kernel
def refuses(p, offer):
    """Whether an area costs more than a robot is worth."""
    return p.limited and p.theta < NO_REFUSAL and is_refused(offer, p.cells, p.theta, p.scale)
