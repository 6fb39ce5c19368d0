"""What a rule is."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from planner.simulator.offers import Offer


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
        breaks_off: it looks again while it covers too, and is then also held by `risk_cap`. Needs `looks_again`.
        looks_ahead: it asks what areas would show (`Offer.frontier`), which takes time; the robots are attentive.
        limited: `risk_cap` and `robot_value` may go with it.
        nearest: the order is (level, cost): engines may search for the nearest area of the least level.
        by_price: the order is (C / U, d), those of U = 0 last: engines may leave out areas for which bounds of C tell
            that they come later.
        exact: False: `order` returns anything that Python can compare; the simulator as Python alone follows it.
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
        """By what offers are sorted: the fractions themselves."""
        found = self.order(offer)
        return tuple(Fraction(*pair) for pair in found) if self.exact else found

    def largest(self, offers: Iterable[Offer]) -> int:
        """The largest product of a numerator and a denominator that comparing these offers takes."""
        found = [self.order(offer) for offer in offers] if self.exact else []
        places = [list(zip(*pairs, strict=True)) for pairs in zip(*found, strict=True)]
        return max((max(numerators) * max(denominators) for numerators, denominators in places), default=0)


def own_rule(order: Callable[[Offer], Any]) -> Rule:
    """The rule of a user's own function, `order(offer)` -> anything that Python can compare, least first.

    Its robots are attentive. The simulator as Python alone follows it, which is slow.
    """
    return Rule(getattr(order, "__name__", "own"), order, exact=False)
