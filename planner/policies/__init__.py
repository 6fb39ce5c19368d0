"""Which area does a robot take next, and when does it change its mind? Rules; plain arithmetic.

A rule is stated once, here, and followed by every engine; the limits on a team (`risk_cap`, `robot_value`) and the
order of
the cells within an area (`in_area`) likewise. No NumPy and no JAX: a rule's numbers may be Python's, Numba's or JAX's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from planner.policies.rule import Rule, own_rule
from planner.policies.rules import FRONTIER, MRAC, PER_CELL, WATCHFUL
from planner.simulator.offers import Offer

RULES: dict[str, Rule] = {rule.name: rule for rule in (MRAC, PER_CELL, FRONTIER, WATCHFUL)}
"""Every rule that a plan can name."""
DEFAULT = MRAC.name


def rule_of(policy: str | Rule | Callable[[Offer], Any]) -> Rule:
    """The rule that is named, or given: a `Rule`, or a function to order areas by (`own_rule`)."""
    if isinstance(policy, str):
        return RULES[policy]
    return policy if isinstance(policy, Rule) else own_rule(policy)
