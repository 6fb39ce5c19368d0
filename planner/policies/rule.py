"""Rules for the next area."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from planner.simulator.offers import Offer


@dataclass(frozen=True)
class Rule:
    """A rule for the next area (`Allocate Next Area`). Areas with equal fractions are ordered by their ids.

    Attributes:
        name: in plan files, options, sweeps.
        order: two fractions (numerator, denominator above 0) by which offers are compared exactly, the least first:
            arithmetic only (no `if`, `min`, `max`), so that Numba can compile and JAX can trace it unchanged. Products
            of a numerator and a denominator stay below 2**63 (JAX: numerators fit into 32 bits, denominators into 16).
        attentive: whether the robot re-evaluates. Then the target of an area is its cheapest unvisited cell, and the
            robot reacts to other robots' visits: it drops an area without cells to do, heads for the next target if its
            own was visited, and covers the cells *still* unvisited, leg by leg. Otherwise the target is the area's
            cheapest cell, visited or not, and a path is followed to its end (SPEC section 5).
        looks_again: on its way, before each dangerous cell, the robot compares its area with the unassigned ones.
        breaks_off: it also does so while it covers, and is then also held by `risk_cap`. Needs `reevaluates`.
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
            raise ValueError(f"rule {self.name}: re-evaluation, looking ahead and limits need attentive robots")

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
