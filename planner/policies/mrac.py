"""The paper's rule: the safest area first, of those the nearest (SPEC section 5)."""

from __future__ import annotations

from typing import Any

from planner.policies.offer import Offer
from planner.policies.rule import Rule


def by_level(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Least level, then least cost."""
    return (offer.level, 1), (offer.cost, 1)


MRAC = Rule("mrac", by_level, attentive=False, nearest=True)
