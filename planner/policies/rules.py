"""The rules for the next area, the limits on a team, and the orders of the cells of an area."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from planner.policies.rule import Rule
from planner.simulator.offers import NO_REFUSAL, CellOffer, Offer, by_cost_and_frontier, by_cost_per_cell

# The paper's rule: the safest area first, of those the nearest (SPEC section 5).


def by_level(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least level, then least cost."""
    return (offer.level, 1), (offer.cost, 1)


MRAC = Rule("mrac", by_level, attentive=False, nearest=True)


PER_CELL = Rule("per_cell", by_cost_per_cell, looks_again=True, limited=True, by_price=True)


FRONTIER = Rule("frontier", by_cost_and_frontier, looks_again=True, limited=True, looks_ahead=True)


# `per_cell` that asks before every danger: while it covers too, and whether its turn has come (SPEC section 11).

WATCHFUL = Rule("watchful", by_cost_per_cell, looks_again=True, breaks_off=True, limited=True, by_price=True)


# In which order are the cells of an area covered (Algorithm 3)? Stated once, here.

NEAREST, BOUSTROPHEDON, ROWS, COLUMNS = "nearest", "boustrophedon", "rows", "columns"
ORDERS = (NEAREST, BOUSTROPHEDON, ROWS, COLUMNS)
"""The orders of every engine: the cheapest cell is next. Of cells beside the robot, which cost alike, `nearest` takes
the lowest index; in safe areas `rows` goes on along the row and `columns` along the column as far as it leads, and
`boustrophedon` along those of the two of which there are fewer (`planner.mrac.areas`)."""


InAreaOrder = str | Callable[[CellOffer], Any]
"""One of ORDERS, or a user's own: the cell of the least value is next, which the simulator
as Python alone follows."""


# The limits on a team: how many may be at risk (`risk_cap`), and what a robot is worth (`robot_value`) (SPEC section
# 11).


def most_at_risk(risk_cap: float, alive: int) -> int:
    """m, the robots that may be at risk at once of so many alive: a share of them, at least one."""
    return max(1, math.ceil(risk_cap * alive))


def refusal_threshold(robot_value: float | None, cells: int, least_threat: float, risk: str) -> int:
    """theta: an area is refused where its price per new cell is above it. NO_REFUSAL where nothing ever is.

    Args:
        worth: V, the new cells that a robot is worth; None = any number. cells: n of the whole map (SPEC section 3).
        least_threat: p of the first dangerous level, 0 where nothing is dangerous. risk: "paper" or "log".
    """
    if robot_value is None or least_threat == 0:
        return NO_REFUSAL
    rho = least_threat if risk == "paper" else -math.log1p(-least_threat)
    theta = cells / (rho * robot_value)
    return NO_REFUSAL if theta >= NO_REFUSAL else math.floor(theta)
