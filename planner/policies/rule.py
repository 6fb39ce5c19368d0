"""What a rule is."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
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


@dataclass(frozen=True)
class Rule:
    """A rule for the next area (`Allocate Next Area`). Areas whose fractions are equal go by their ids.

    Attributes:
        name: in plan files, options, sweeps.
        order: two fractions (numerator, denominator above 0) by which offers are compared exactly, the least first:
            arithmetic alone (no `if`, `min`, `max`), so that Numba compiles and JAX traces it as it stands. Products of
            a numerator and a denominator stay below 2**63 (JAX: numerators fit into 32 bits, denominators into 16).
        attentive: the target of an area is its cheapest unvisited cell, and the robot notices what others visit: it
            drops an area without cells to do, turns to the next target when its own has been visited, and covers the
            cells *still* unvisited, leg by leg. Otherwise: its cheapest cell, visited or not, and a path once computed
            is driven to its end (SPEC section 5).
        looks_again: on its way, before each dangerous cell, the robot compares its area with the unassigned ones.
        breaks_off: it looks again while it covers too, and is then also held by `reserve`. Needs `looks_again`.
        looks_ahead: it asks what areas would show (`Offer.frontier`), which takes time; the robots are attentive.
        limited: `reserve` and `worth` may go with it.
        nearest: the order is (level, cost): engines may search for the nearest area of the least level.
        by_price: the order is (C / U, d), those of U = 0 last: engines may leave out areas for which bounds of C tell
            that they come later.
        exact: False: `order` returns anything that Python can compare; the readable simulator alone follows it.
    """

    name: str
    order: Callable[[Offer], Any]
    attentive: bool = True
    looks_again: bool = False
    breaks_off: bool = False
    limited: bool = False
    nearest: bool = False
    by_price: bool = False
    exact: bool = True
    looks_ahead: bool = False

    def __post_init__(self) -> None:
        if self.nearest and self.attentive:
            raise ValueError(f"rule {self.name}: the nearest area is one of any cells, visited or not")
        if (self.looks_again or self.looks_ahead or self.limited) and not self.attentive:
            raise ValueError(
                f"rule {self.name}: who looks again or ahead, or asks what a cell is worth, has to be attentive"
            )

    def key(self, offer: Offer) -> Any:
        """What the readable simulator sorts by: the fractions as such."""
        found = self.order(offer)
        return tuple(Fraction(*pair) for pair in found) if self.exact else found

    def largest(self, offers: Iterable[Offer]) -> int:
        """The largest product of a numerator and a denominator that comparing these offers takes."""
        found = [self.order(offer) for offer in offers] if self.exact else []
        places = [list(zip(*pairs, strict=True)) for pairs in zip(*found, strict=True)]
        return max((max(numerators) * max(denominators) for numerators, denominators in places), default=0)


def own_rule(order: Callable[[Offer], Any]) -> Rule:
    """The rule of a user's own function, `order(offer)` -> anything that Python can compare, least first.

    Its robots are attentive. The readable simulator alone follows it, which is slow.
    """
    return Rule(getattr(order, "__name__", "own"), order, exact=False)
