"""Rules for the next area: plain arithmetic.

A rule is stated once, here, and followed by every engine that supports it; so are the limits on a team (`risk_cap`,
`robot_value`) and the order of the cells of an area (`in_area`). No NumPy: a rule's numbers may be Python's or Numba's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from planner.policies.rules import FRONTIER, MRAC, PER_CELL, WATCHFUL, Rule, own_rule
from planner.simulator.offers import Offer

RULES: dict[str, Rule] = {rule.name: rule for rule in (MRAC, PER_CELL, FRONTIER, WATCHFUL)}
"""All rules that a plan can name."""
DEFAULT = MRAC.name


def rule_of(policy: str | Rule | Callable[[Offer], Any]) -> Rule:
    """The rule of a policy.

    Args:
        policy: a name, a `Rule`, or a function that orders areas (`own_rule`).
    """
    if isinstance(policy, str):
        return RULES[policy]
    return policy if isinstance(policy, Rule) else own_rule(policy)
