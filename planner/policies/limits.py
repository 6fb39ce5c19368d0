"""The limits on a team: how many may be at risk (`reserve`), and what a robot is worth (`worth`) (SPEC section 11)."""

from __future__ import annotations

import math

from planner.simulator.offers import NO_REFUSAL


def most_at_risk(reserve: float, alive: int) -> int:
    """m, the robots that may be at risk at once of so many alive: a share of them, at least one."""
    return max(1, math.ceil(reserve * alive))


def refusal_threshold(worth: float | None, cells: int, least_threat: float, risk: str) -> int:
    """theta: an area is refused where its price per new cell is above it. NO_REFUSAL where nothing ever is.

    Args:
        worth: V, the new cells that a robot is worth; None = any number. cells: n of the whole map (SPEC section 3).
        least_threat: p of the first dangerous level, 0 where nothing is dangerous. risk: "paper" or "log".
    """
    if worth is None or least_threat == 0:
        return NO_REFUSAL
    rho = least_threat if risk == "paper" else -math.log1p(-least_threat)
    theta = cells / (rho * worth)
    return NO_REFUSAL if theta >= NO_REFUSAL else math.floor(theta)
