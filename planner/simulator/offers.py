"""Areas and cells as offers to a robot, and the orders of the built-in rules."""

from __future__ import annotations

from typing import Any, NamedTuple

# An area as a rule sees it.


class Offer(NamedTuple):
    """An area with cells to do, as an offer to a robot. Whole numbers: int, a Numba scalar or a JAX array.

    Attributes:
        level: index of its threat level, 0 = safe.
        cost: d, of the safest path to its target (SPEC section 3): the cheapest cell that the rule heads for.
        unvisited: u, its cells to do, at least 1.
        entry: w, cost of entering one cell of its level.
        value: U, value of its cells to do in whole numbers (SPEC section 13); u where cells have no values.
        beyond: more than any C where cells have values, so that areas without value go last; else 0.
        frontier: F, cells not seen yet that would be seen from its cells to do, if the rule looks ahead in an online
            mission; else 0.
        surcharge: extra cost of its cells to do over the robot type in the team that pays least for them (SPEC section
            22); 0 for one robot type. It counts in C, not in d.
    """

    level: Any
    cost: Any
    unvisited: Any
    entry: Any
    value: Any
    beyond: Any
    frontier: Any = 0
    surcharge: Any = 0


def price(offer: Offer) -> Any:
    """C = d + (u - 1) w plus the surcharge: cost of going there and entering every cell to do (SPEC section 11)."""
    return offer.cost + (offer.unvisited - 1) * offer.entry + offer.surcharge


NO_REFUSAL = 2**42
"""A theta that refuses nothing; larger ones have the same effect."""


def is_dangerous(offer: Offer, cells: Any) -> Any:
    """True if the area or a cell on the path to it is dangerous: one dangerous cell costs more than all safe ones.

    Args:
        offer: the area.
        cells: n of the whole map.
    """
    return price(offer) >= cells


def is_refused(offer: Offer, cells: Any, theta: Any, scale: Any) -> Any:
    """True if the area is not worth the risk: C >= n and scale C > theta U, computed without the product.

    An area without value is always refused if it is dangerous.

    Args:
        offer: the area.
        cells: n of the whole map.
        theta: price per new cell from which on an area is refused.
        scale: U of one cell of the largest value, 1 where cells have no values.

    Source: SPEC section 11.
    """
    worthless = offer.value == 0
    each = (scale * price(offer) - 1) // (offer.value + worthless)
    return is_dangerous(offer, cells) & (each >= theta * (1 - worthless))


# Least cost per new cell, or per value, re-evaluated before each danger (SPEC sections 11 and 13).


def by_cost_per_cell(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Order by least C / U (U = 0: after all others, by C), then by least cost of the path."""
    worthless = offer.value == 0
    return (price(offer) + worthless * offer.beyond, offer.value + worthless), (offer.cost, 1)


# As `per_cell`, but cells that an area would reveal count too (SPEC section 11): online missions look ahead.

A_CELL = 4
"""Cells not seen yet that count as one cell to do: about one in so many is later covered because it was revealed."""


def by_cost_and_frontier(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Order by least C / (U + F / 4) (U = F = 0: after all others, by C), then by least cost of the path."""
    gain = A_CELL * offer.value + offer.frontier
    worthless = gain == 0
    return (price(offer) + worthless * offer.beyond, gain + worthless), (offer.cost, 1)


class CellOffer(NamedTuple):
    """A cell to do in a robot's area, seen from the end of the robot's last leg.

    Attributes:
        here: the robot's cell. cell: the cell to do; indices `row * W + col`.
        cost: of the safest path between them.
    """

    here: int
    cell: int
    cost: int
