"""The rules for the next area, the limits on a team, and the orders of the cells of an area."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from planner.simulator.offers import NO_REFUSAL, CellOffer, Offer, by_cost_and_frontier, by_cost_per_cell


@dataclass(frozen=True)
class Rule:
    """A rule for the next area (`Allocate Next Area`). Areas with equal fractions are ordered by their ids.

    Attributes:
        name: in plan files, options, sweeps.
        order: two fractions (numerator, denominator above 0) by which offers are compared exactly, the least first:
            whole-number arithmetic only, so that Numba can compile it unchanged. Products of a numerator and a
            denominator stay below 2**63.
        replanning: whether the robot re-evaluates. Then the target of an area is its cheapest unvisited cell, and the
            robot reacts to other robots' visits: it drops an area without cells to do, heads for the next target if its
            own was visited, and covers the cells *still* unvisited, leg by leg. Otherwise the target is the area's
            cheapest cell, visited or not, and a path is followed to its end (SPEC section 5).
        reevaluates: on its way, before each dangerous cell, the robot compares its area with the unassigned ones.
        preempts: it also does so while it covers, and is then also held by `risk_cap`. Needs `reevaluates`.
        looks_ahead: it counts the cells that areas would reveal (`Offer.frontier`), which is slow; needs `replanning`.
        limited: whether `risk_cap` and `robot_value` may be combined with it.
        nearest: the order is (level, cost): engines may search for the nearest area of the least level.
        by_price: the order is (C / U, d), U = 0 last: engines may skip areas that come later by bounds on C.
        exact: False: `order` returns anything that Python can compare; only the simulator as Python supports it.
    """

    name: str
    order: Callable[[Offer], Any]
    replanning: bool = True
    reevaluates: bool = False
    preempts: bool = False
    limited: bool = False
    nearest: bool = False
    by_price: bool = False
    exact: bool = True
    looks_ahead: bool = False

    def __post_init__(self) -> None:
        if self.nearest and self.replanning:
            raise ValueError(f"rule {self.name}: the order of nearest areas counts cells, visited or not")
        if (self.reevaluates or self.looks_ahead or self.limited) and not self.replanning:
            raise ValueError(f"rule {self.name}: re-evaluation, looking ahead and limits need robots that re-evaluate")

    def key(self, offer: Offer) -> Any:
        """Sort key of an offer: the fractions themselves.

        Args:
            offer: an area.
        """
        found = self.order(offer)
        return tuple(Fraction(*pair) for pair in found) if self.exact else found

    def largest(self, offers: Iterable[Offer]) -> int:
        """The largest product of a numerator and a denominator in comparisons of these offers.

        Args:
            offers: areas.
        """
        found = [self.order(offer) for offer in offers] if self.exact else []
        places = [list(zip(*pairs, strict=True)) for pairs in zip(*found, strict=True)]
        return max((max(numerators) * max(denominators) for numerators, denominators in places), default=0)


def own_rule(order: Callable[[Offer], Any]) -> Rule:
    """The rule of a user's function; its robots re-evaluate. Only the (slow) simulator as Python supports it.

    Args:
        order: `order(offer)` -> anything that Python can compare, least first.
    """
    return Rule(getattr(order, "__name__", "own"), order, exact=False)


# The paper's rule: the safest area first, the nearest of several (SPEC section 5).


def by_level(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least level, then least cost."""
    return (offer.level, 1), (offer.cost, 1)


MRAC = Rule("mrac", by_level, replanning=False, nearest=True)


PER_CELL = Rule("per_cell", by_cost_per_cell, reevaluates=True, limited=True, by_price=True)


FRONTIER = Rule("frontier", by_cost_and_frontier, reevaluates=True, limited=True, looks_ahead=True)


# `per_cell` that re-evaluates before every danger, also while covering, and may wait for its turn (SPEC section 11).

WATCHFUL = Rule("watchful", by_cost_per_cell, reevaluates=True, preempts=True, limited=True, by_price=True)


# Orders of the cells of an area (Algorithm 3), stated once for all engines.

NEAREST, BOUSTROPHEDON, ROWS, COLUMNS = "nearest", "boustrophedon", "rows", "columns"
ORDERS = (NEAREST, BOUSTROPHEDON, ROWS, COLUMNS)
"""Orders of all engines: the cheapest cell is next. Of adjacent cells, which cost the same, `nearest` takes the lowest
index. In safe areas `rows` continues along the row and `columns` along the column as far as possible; `boustrophedon`
uses the one of the two with fewer straight runs (`planner.mrac.areas`)."""


InAreaOrder = str | Callable[[CellOffer], Any]
"""One of ORDERS, or a user's function: the cell with the least value is next; only the simulator as Python supports
it."""


# Limits on a team: the share of robots at risk (`risk_cap`) and the value of a robot (`robot_value`) (SPEC section 11).


def most_at_risk(risk_cap: float, alive: int) -> int:
    """m, the robots that may be at risk at once: a share of the living, at least one.

    Args:
        risk_cap: the share.
        alive: robots alive.
    """
    return max(1, math.ceil(risk_cap * alive))


def refusal_threshold(robot_value: float | None, cells: int, least_threat: float, risk: str) -> int:
    """theta: an area is refused if its price per new cell exceeds it; NO_REFUSAL if no area is ever refused.

    Args:
        robot_value: V, value of a robot in new cells; None: unlimited.
        cells: n of the whole map (SPEC section 3).
        least_threat: p of the first dangerous level, 0 on a safe map.
        risk: "paper" or "log".

    Source: SPEC section 11.
    """
    if robot_value is None or least_threat == 0:
        return NO_REFUSAL
    rho = least_threat if risk == "paper" else -math.log1p(-least_threat)
    theta = cells / (rho * robot_value)
    return NO_REFUSAL if theta >= NO_REFUSAL else math.floor(theta)
