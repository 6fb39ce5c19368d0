"""The policy of a plan as the simulator follows it, and a user's own rule as a compiled function."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numba.extending import register_jitable
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.mrac.problem import Problem
from planner.policies import RULES
from planner.policies.limits import most_at_risk
from planner.policies.rule import Rule
from planner.simulator.jit import UNCOUNTED
from planner.simulator.offers import NO_REFUSAL, Offer
from planner.simulator.policy import Policy
from planner.simulator.state import Tables

OF_OFFER = types.int64(*[types.int64] * (1 + len(Offer._fields)))
"""Signature of `Policy.own`."""


def as_function(rule: Rule) -> Any:
    """The order of a user's own rule as a function with a C signature: programs are not compiled anew for each rule.

    Arguments: which of the four numbers of `Rule.order`, and those of an `Offer`. Raises PlanError for an order that is
    not arithmetic.
    """
    order = register_jitable(**UNCOUNTED)(rule.order)

    def number(which, level, cost, unvisited, entry, value, beyond, frontier, surcharge):  # type: ignore[no-untyped-def]
        (one, two), (three, four) = order(Offer(level, cost, unvisited, entry, value, beyond, frontier, surcharge))
        # A float has no `|`: an order that is not of whole numbers does not compile, instead of being cut to them.
        return (one if which == 0 else two if which == 1 else three if which == 2 else four) | 0

    try:
        return numba.cfunc(OF_OFFER, error_model="numpy")(number)
    except NumbaError as error:
        raise PlanError(
            f"the order of rule {rule.name} cannot be compiled",
            expected="whole-number arithmetic of an Offer: two pairs (numerator, denominator)",
            fix="roll it out with planner.mrac.simulate.ReferenceLoop",
        ) from error


def dangerous(problem: Problem, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """`Policy.danger` of these cells `[A]`; where robots differ in type, `[Y A]`."""
    of_cell = problem.levels.of_cell[cells]
    return (of_cell if problem.own is None else problem.own.level[:, of_cell].ravel()) > 0


def make_policy(problem: Problem, cells: NDArray[np.int64], tables: Tables, *, interpreted: bool = False) -> Policy:
    """The policy of a rule that re-evaluates; `cells` int64 `[A]`, the accessible ones. Raises PlanError.

    `interpreted`: for the simulator as Python, which follows any rule; compiled programs follow exact ones.
    """
    rule, settings, unknown = problem.rule, problem.settings, problem.unknown
    ahead = slice(None if rule.looks_ahead and (unknown is None or unknown.looks) else 0)
    alive = range(len(problem.starts) + 1 if settings.reserve is not None else 0)
    is_own = RULES.get(rule.name) is not rule
    return Policy(
        looks_again=rule.looks_again,
        breaks_off=rule.breaks_off,
        looks_ahead=rule.looks_ahead,
        by_price=rule.by_price,
        limited=rule.limited and problem.theta < NO_REFUSAL,
        entry=problem.entry,
        danger=dangerous(problem, cells),
        cells=problem.costs.size,
        theta=problem.theta,
        worth=settings.worth is not None,
        most=np.array([most_at_risk(settings.reserve or 1.0, robots) for robots in alive], dtype=np.int64),
        value=np.zeros(0, dtype=np.int64) if problem.value is None else problem.value[cells],
        scale=problem.scale,
        beyond=problem.beyond,
        view_begin=tables.view_begin[ahead],
        in_view=tables.in_view[ahead],
        stamp=np.zeros(len(cells) + 1, dtype=np.int64)[ahead],
        is_own=True if is_own else None,
        own=as_function(rule) if is_own and not interpreted else None,
        key=rule.key if is_own and interpreted else None,
    )
