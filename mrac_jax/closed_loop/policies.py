"""A policy as the lanes follow it: the rule's own `order`, traced by JAX as it stands, in 32-bit numbers.

Axis letters as in `mrac_jax.closed_loop.tables`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import STATIC, Array, on_host, padded
from planner.arguments import argument
from planner.errors import WorldError
from planner.kernels.loop import ClosedLoop
from planner.policies.limits import NO_REFUSAL
from planner.policies.offer import Offer, price

LARGEST_DENOMINATOR = 2**16 - 1
"""Products of an int32 and a number up to this are compared in two words."""
LARGEST = 2**31 - 1
"""A theta that refuses nothing, since every price is less."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LanePolicy:
    """What attentive robots decide by. One program for all limits on a team: they are numbers in it.

    Attributes:
        entry: int32 `[A]`, cost of entering a cell of each cell's level.
        cells: int32 scalar, n of the whole map. theta: int32 scalar, the price per new cell from which an area is
            refused. refuses: bool scalar, there is a `worth`.
        most: int32 `[K + 1]`, robots that may be at risk of so many alive. holds: bool scalar, there is a `reserve`.
        value: int32 `[A]`, what cells count; None: 1 each. scale, beyond: int32 scalars as in
            `planner.mrac.problem.Problem`.
        order: of the rule, offer -> two fractions. looks_again, breaks_off: as in `planner.policies.rule.Rule`. Static.
    """

    entry: Array
    cells: Array
    theta: Array
    refuses: Array
    most: Array
    holds: Array
    value: Array | None
    scale: Array
    beyond: Array
    order: Callable[[Offer], Any] = field(metadata=STATIC)
    looks_again: bool = field(metadata=STATIC)
    breaks_off: bool = field(metadata=STATIC)


def lane_policy(loop: ClosedLoop, level: NDArray[np.int32], robots: int) -> LanePolicy | None:
    """The policy of a closed loop, None for the paper's rule; int32 `[A]`, the level of each cell's area; K."""
    policy = loop.policy
    if policy is None:
        return None
    most = np.full(robots + 1, robots, dtype=np.int32)
    most[: len(policy.most)] = policy.most
    return on_host(
        LanePolicy,
        entry=policy.entry[level].astype(np.int32),
        cells=np.int32(policy.cells),
        theta=np.int32(min(policy.theta, LARGEST)),
        refuses=np.bool_(policy.worth and policy.theta < NO_REFUSAL),
        most=most,
        holds=np.bool_(len(policy.most) > 0),
        value=padded(policy.value, len(level)) if len(policy.value) else None,
        scale=np.int32(policy.scale),
        beyond=np.int32(policy.beyond),
        order=policy.rule.order,
        looks_again=policy.looks_again,
        breaks_off=policy.breaks_off,
    )


def check_policy(loop: ClosedLoop) -> None:
    """Raise WorldError for a policy that JAX cannot trace, or whose numbers do not fit into 32 bits.

    What the rule makes of the dearest offer of each level is computed with overflow being an error.
    """
    policy, fix = loop.policy, f"use {argument('engine', 'numba')}"
    if policy is None:
        return
    try:
        jax.eval_shape(policy.rule.order, Offer(*[jax.ShapeDtypeStruct((1,), np.int32)] * 6))
    except (TypeError, OverflowError) as error:
        raise WorldError(
            f"the order of rule {policy.rule.name} cannot be traced by JAX", expected="arithmetic alone", fix=fix
        ) from error
    longest = int(loop.tables.cost_to.max()) * (1 + loop.comes_home)  # a way home may get dearer by as much
    sizes = np.bincount(loop.tables.level, weights=np.diff(loop.tables.begin), minlength=len(policy.entry))
    try:
        for level, (cells, entry) in enumerate(zip(sizes, policy.entry, strict=True)):
            with np.errstate(over="raise"):
                left = max(int(cells), 1)
                most = left if len(policy.value) == 0 else left * int(policy.value.max())
                for value in (most, 0)[: 1 + (len(policy.value) > 0)]:
                    said = (level, longest, left, int(entry), value, policy.beyond)
                    offer = Offer(*map(np.int32, said))
                    np.int32(policy.scale if policy.worth else 1) * price(offer)
                    denominators = [int(denominator) for _, denominator in policy.rule.order(offer)]
                    if max(denominators) > (LARGEST if len(policy.value) else LARGEST_DENOMINATOR):
                        raise OverflowError
    except (FloatingPointError, OverflowError) as error:
        raise WorldError(
            f"prices of areas too large for policy {policy.rule.name} to be compared in 32 bits",
            expected=f"numerators below 2**31, denominators up to {LARGEST_DENOMINATOR} for the closed loop in JAX",
            fix=f"{fix}, or raise the smallest threats",
        ) from error
