"""The rules for the next area, the limits on a team, and the orders of the cells of an area."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from planner.policies.rule import Rule
from planner.simulator.offers import NO_REFUSAL, CellOffer, Offer, by_cost_and_frontier, by_cost_per_cell

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
