"""As `per_cell`, but what an area would show counts too (SPEC section 11): robots that learn the map look ahead."""

from __future__ import annotations

from typing import Any

from planner.policies.offer import Offer, price
from planner.policies.rule import Rule

A_CELL = 4
"""Unseen cells that are worth one cell to do: about as many of them come to be covered because they were shown."""


def by_cost_and_frontier(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / (U + F / 4), those of U = F = 0 after all others and by C, then least cost of the way."""
    gain = A_CELL * offer.value + offer.frontier
    worthless = gain == 0
    return (price(offer) + worthless * offer.beyond, gain + worthless), (offer.cost, 1)


FRONTIER = Rule("frontier", by_cost_and_frontier, looks_again=True, limited=True, looks_ahead=True)
