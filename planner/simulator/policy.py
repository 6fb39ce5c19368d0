"""A policy as kernels follow it: the rule's own `order`, compiled for the rule, and the limits on the team.

Part of `planner.simulator.attentive`, which see. The rule is told by the type of `Policy.rule`: a program is compiled
for
each, and found in the cache. A user's own rule is compiled in every process, since nobody knows what it depends on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import typeof, types
from numba.core.errors import NumbaError
from numba.extending import NativeValue, models, overload, register_jitable, register_model, typeof_impl, unbox
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.jit import OF_THIS_PROCESS, UNCOUNTED, kernel, rare_kernel
from planner.mrac.problem import Problem
from planner.policies import RULES
from planner.policies.limits import NO_REFUSAL, is_dangerous, is_refused, most_at_risk
from planner.policies.rule import Offer, Rule, price
from planner.simulator.robot_types import own, own_level
from planner.simulator.state import BEGIN, DEAD, DOING, END, LEFT_IN, LEVEL, SEEN, VISITED
from planner.simulator.struct_pointers import Handed
from planner.simulator.tables import Tables

for _stated in (price, is_dangerous, is_refused):
    register_jitable(**UNCOUNTED)(_stated)

_ORDERS: dict[str, Callable[[Offer], Any]] = {}
"""What rules order areas by, by the names of their types."""


class Followed:
    """A rule for kernels, by its `name` and `order`; `kind` names its type."""

    def __init__(self, rule: Rule) -> None:
        self.name, self.order = rule.name, rule.order
        if rule.name in RULES and RULES[rule.name] is rule:
            self.kind = f"rule {rule.name}"
        else:
            self.kind = f"rule {rule.name} {OF_THIS_PROCESS} {id(rule.order):x}"
        if self.kind not in _ORDERS:
            _ORDERS[self.kind] = register_jitable(**UNCOUNTED)(rule.order)


class RuleType(types.Type):
    """The type of a rule: nothing but its name."""

    def __init__(self, kind: str) -> None:
        super().__init__(name=kind)


register_model(RuleType)(models.OpaqueModel)


@typeof_impl.register(Followed)
def _typeof(rule: Followed, _context: Any) -> RuleType:
    return RuleType(rule.kind)


@unbox(RuleType)
def _unbox(_kind: RuleType, _value: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())


def order_of(rule: Followed, offer: Offer) -> Any:
    """The fractions that the rule orders an offer by."""
    return _ORDERS[rule.kind](offer)


@overload(order_of, jit_options=UNCOUNTED, strict=False)
def _compiled_order_of(rule: Any, offer: Any) -> Any:
    order = _ORDERS[rule.name]
    return lambda rule, offer: order(offer)


class Policy(NamedTuple):
    """What an attentive robot decides by. Axes: `A` accessible cells, `K` robots, `L` threat levels.

    Attributes:
        rule: orders areas. looks_again, breaks_off, by_price: as in `Rule`. limited: whether areas are ever refused.
        entry: int64 `[L]`, cost of entering a cell of each level. danger: bool `[A]`, cells of a dangerous level.
        cells: n of the whole map. theta: the price per new cell from which an area is refused.
        worth: whether robots say what they refuse.
        most: int64 `[K + 1]`, robots that may be at risk of so many alive; empty: all of them.
        value: int64 `[A]`, what cells count; empty: 1 each. scale, beyond: as in `planner.mrac.problem.Problem`.
        view_begin, in_view: as of `Tables`, if the rule looks ahead and robots learn, else empty.
        stamp: int64 `[A + 1]`, scratch of a thread: the last offer that a cell was counted for; last: offers.
    """

    rule: Followed
    looks_again: bool
    breaks_off: bool
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


def dangerous(problem: Problem, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """`Policy.danger` of these cells `[A]`; where robots differ in type, `[Y A]`."""
    of_cell = problem.levels.of_cell[cells]
    return (of_cell if problem.own is None else problem.own.level[:, of_cell].ravel()) > 0


def make_policy(problem: Problem, cells: NDArray[np.int64], tables: Tables) -> Policy:
    """The policy of an attentive, exact rule; `cells` int64 `[A]`, the accessible ones. Raises PlanError."""
    rule, settings, unknown = problem.rule, problem.settings, problem.unknown
    ahead = slice(None if rule.looks_ahead and (unknown is None or unknown.looks) else 0)
    alive = range(len(problem.starts) + 1 if settings.reserve is not None else 0)
    policy = Policy(
        rule=Followed(rule),
        looks_again=rule.looks_again,
        breaks_off=rule.breaks_off,
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
    )
    if RULES.get(rule.name) is not rule:
        _check_order(policy)
    return policy


def _check_order(policy: Policy) -> None:
    """Raise PlanError for an order that is not arithmetic."""
    offer = typeof(Offer(*map(np.int64, (0, 1, 1, 1, 1, 0, 0, 0))))
    try:
        is_before.compile((Handed(typeof(policy)), offer, offer, types.boolean))  # type: ignore[attr-defined]
    except NumbaError as error:
        raise PlanError(
            f"the order of rule {policy.rule.name} cannot be compiled",
            expected="arithmetic of an Offer: two pairs (numerator, denominator)",
            fix="roll it out with planner.mrac.simulate.ReferenceLoop",
        ) from error


@rare_kernel
def value_left(p, s, area):
    """What the unvisited cells of an area are worth."""
    total = np.int64(0)
    for place in range(s.areas[area, BEGIN], s.areas[area, END]):
        cell = np.int64(s.order[place])
        if s.home[cell] & VISITED == 0:
            total += p.value[cell]
    return total


@kernel
def offer_of(t, p, s, robot, area, cost):
    """An area as the rule sees it, its target being at this cost from the robot."""
    level, left = own_level(t, robot, s.areas[area, LEVEL]), np.int64(s.areas[area, LEFT_IN])
    value = value_left(p, s, area) if len(p.value) > 0 else left
    shown = frontier(p, s, area) if len(p.view_begin) > 0 else np.int64(0)
    more = surcharge(t, p, s, robot, area) if len(t.type_of) > 0 else np.int64(0)
    return Offer(level, np.int64(cost), left, p.entry[level], value, np.int64(p.beyond), shown, more)


@rare_kernel
def surcharge(t, p, s, robot, area):
    """How much less a robot alive of another type would pay for the area's cells to do."""
    level = np.int64(s.areas[area, LEVEL])
    mine = least = p.entry[own_level(t, robot, level)]
    for other in range(len(s.robots)):
        if s.robots[other, DOING] != DEAD:
            least = min(least, p.entry[own_level(t, other, level)])
    return (mine - least) * np.int64(s.areas[area, LEFT_IN])


@rare_kernel
def frontier(p, s, area):
    """How many cells that nobody has seen are seen from the area's cells to do."""
    last, shown = len(p.stamp) - 1, np.int64(0)
    p.stamp[last] += 1
    for place in range(s.areas[area, BEGIN], s.areas[area, END]):
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
    return s.level[cell] > 0 if len(s.mind) > 0 else p.danger[own(t, robot, cell)]


@kernel
def is_before(p, one, other, by_id):
    """Whether the rule puts one offer before the other; `by_id`: where it does not tell them apart."""
    mine, theirs = order_of(p.rule, one), order_of(p.rule, other)
    left, right = mine[0][0] * theirs[0][1], theirs[0][0] * mine[0][1]
    if left != right:
        return left < right
    left, right = mine[1][0] * theirs[1][1], theirs[1][0] * mine[1][1]
    return left < right or (left == right and by_id)


@kernel
def refuses(p, offer):
    """Whether an area costs more than a robot is worth."""
    return p.limited and p.theta < NO_REFUSAL and is_refused(offer, p.cells, p.theta, p.scale)
