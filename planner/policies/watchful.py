"""`per_cell` that asks before every danger: while it covers too, and whether its turn has come (SPEC section 11)."""

from __future__ import annotations

from planner.policies.per_cell import by_cost_per_cell
from planner.policies.rule import Rule

WATCHFUL = Rule("watchful", by_cost_per_cell, looks_again=True, breaks_off=True, limited=True, by_price=True)
