"""Least cost per new cell, looked at again before each danger (SPEC section 11)."""

from __future__ import annotations

from typing import Any

from planner.policies.offer import Offer, price
from planner.policies.rule import Rule


def by_cost_per_cell(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / u, then least cost of the way."""
    return (price(offer), offer.unvisited), (offer.cost, 1)


PER_CELL = Rule("per_cell", by_cost_per_cell, looks_again=True, limited=True, by_price=True)
