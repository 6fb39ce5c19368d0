"""What a rule sees: an area as a robot could take it."""

from __future__ import annotations

from typing import Any, NamedTuple


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
