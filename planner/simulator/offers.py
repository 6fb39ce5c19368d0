"""Areas and cells as a robot could take them, and by which of their numbers the built-in rules order them."""

from __future__ import annotations

from typing import Any, NamedTuple

# What a rule sees: an area as a robot could take it.


class Offer(NamedTuple):
    """An area with cells to do, seen from where a robot stands. Whole numbers: int, a Numba scalar or a JAX array.

    Attributes:
        level: index of its threat level, 0 = safe.
        cost: d, of the safest path to its target (SPEC section 3): the cheapest cell of it that the rule heads for.
        unvisited: u, its cells still to do, at least 1.
        entry: w, cost of entering one cell of its level.
        value: U, what its cells to do are worth in whole numbers (SPEC section 13); u where no cell has a value.
        beyond: more than any C where cells have a value, 0 where they have none: areas worth nothing go last.
        frontier: F, cells that nobody has seen and that would be seen from its cells to do, where robots learn the map
            as they drive and the rule looks ahead; else 0.
        surcharge: what covering its cells to do costs more than for the robot type in the team that pays least for
            them (SPEC section 22); 0 where all robots are of one type. It counts in C, not in d.
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
    """C = d + (u - 1) w: what it costs to go there and enter every cell to do (SPEC section 11), and the surcharge."""
    return offer.cost + (offer.unvisited - 1) * offer.entry + offer.surcharge


NO_REFUSAL = 2**42
"""A theta that refuses nothing; larger ones are as good as none."""


def is_dangerous(offer: Offer, cells: Any) -> Any:
    """True if the area is, or a cell on the way to it: one dangerous cell costs more than every safe one."""
    return price(offer) >= cells


def is_refused(offer: Offer, cells: Any, theta: Any, scale: Any) -> Any:
    """True if the area costs more than it is worth: C >= n and scale C > theta U, without the product.

    `scale`: U of one cell of the largest value, 1 where no cell has a value. So an area worth nothing is refused.
    """
    worthless = offer.value == 0
    each = (scale * price(offer) - 1) // (offer.value + worthless)
    return is_dangerous(offer, cells) & (each >= theta * (1 - worthless))


# Least cost per new cell, or per value, looked at again before each danger (SPEC sections 11 and 13).


def by_cost_per_cell(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / U, those of U = 0 after all others and by C, then least cost of the way."""
    worthless = offer.value == 0
    return (price(offer) + worthless * offer.beyond, offer.value + worthless), (offer.cost, 1)


# As `per_cell`, but what an area would show counts too (SPEC section 11): robots that learn the map look ahead.

A_CELL = 4
"""Unseen cells that are worth one cell to do: about as many of them come to be covered because they were shown."""


def by_cost_and_frontier(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / (U + F / 4), those of U = F = 0 after all others and by C, then least cost of the way."""
    gain = A_CELL * offer.value + offer.frontier
    worthless = gain == 0
    return (price(offer) + worthless * offer.beyond, gain + worthless), (offer.cost, 1)


class CellOffer(NamedTuple):
    """A cell still to do in a robot's area, where the robot's last leg has ended.

    Attributes:
        here: the cell where the robot stands. cell: the one to do; indices `row * W + col`.
        cost: of the safest path between them.
    """

    here: int
    cell: int
    cost: int
