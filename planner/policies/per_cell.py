"""Least cost per new cell, or per value, looked at again before each danger (SPEC sections 11 and 13)."""

from __future__ import annotations

from typing import Any

from planner.policies.offer import Offer, price
from planner.policies.rule import Rule


def by_cost_per_cell(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least C / U, those of U = 0 after all others and by C, then least cost of the way."""
    worthless = offer.value == 0
    return (price(offer) + worthless * offer.beyond, offer.value + worthless), (offer.cost, 1)


PER_CELL = Rule("per_cell", by_cost_per_cell, looks_again=True, limited=True, by_price=True)
