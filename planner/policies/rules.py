"""The paper's rule: the safest area first, of those the nearest (SPEC section 5)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from planner.policies.rule import Offer, Rule, price


def by_level(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least level, then least cost."""
    return (offer.level, 1), (offer.cost, 1)


MRAC = Rule("mrac", by_level, attentive=False, nearest=True)


# Least cost per new cell, or per value, looked at again before each danger (SPEC sections 11 and 13).


def by_cost_per_cell(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / U, those of U = 0 after all others and by C, then least cost of the way."""
    worthless = offer.value == 0
    return (price(offer) + worthless * offer.beyond, offer.value + worthless), (offer.cost, 1)


PER_CELL = Rule("per_cell", by_cost_per_cell, looks_again=True, limited=True, by_price=True)


# As `per_cell`, but what an area would show counts too (SPEC section 11): robots that learn the map look ahead.

A_CELL = 4
"""Unseen cells that are worth one cell to do: about as many of them come to be covered because they were shown."""


def by_cost_and_frontier(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / (U + F / 4), those of U = F = 0 after all others and by C, then least cost of the way."""
    gain = A_CELL * offer.value + offer.frontier
    worthless = gain == 0
    return (price(offer) + worthless * offer.beyond, gain + worthless), (offer.cost, 1)


FRONTIER = Rule("frontier", by_cost_and_frontier, looks_again=True, limited=True, looks_ahead=True)


# `per_cell` that asks before every danger: while it covers too, and whether its turn has come (SPEC section 11).

WATCHFUL = Rule("watchful", by_cost_per_cell, looks_again=True, breaks_off=True, limited=True, by_price=True)


# In which order are the cells of an area covered (Algorithm 3)? Stated once, here.

NEAREST, BOUSTROPHEDON, ROWS, COLUMNS = "nearest", "boustrophedon", "rows", "columns"
ORDERS = (NEAREST, BOUSTROPHEDON, ROWS, COLUMNS)
"""The orders of every engine: the cheapest cell is next. Of cells beside the robot, which cost alike, `nearest` takes
the lowest index; in safe areas `rows` goes on along the row and `columns` along the column as far as it leads, and
`boustrophedon` along those of the two of which there are fewer (`planner.mrac.areas`)."""


class CellOffer(NamedTuple):
    """A cell still to do in a robot's area, where the robot's last leg has ended.

    Attributes:
        here: the cell where the robot stands. cell: the one to do; indices `row * W + col`.
        cost: of the safest path between them.
    """

    here: int
    cell: int
    cost: int


InAreaOrder = str | Callable[[CellOffer], Any]
"""One of ORDERS, or a user's own: the cell of the least value is next, which the readable simulator alone follows."""
