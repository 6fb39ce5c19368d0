"""Ways home as tables that every lane reads (SPEC section 19): `planner.mrac.homeward` for lanes. NumPy alone.

A leg is the safest path from cell to cell, as `hop` has it. Axis letters: `B` sets of bases; the others as in
`mrac_jax.closed_loop.tables`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, on_host, padded
from planner.arguments import argument
from planner.errors import WorldError
from planner.kernels.closed_loop import MOST_TABLED
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import LAST_STEP, RECHARGE
from planner.none import NONE

GOALS_AT_A_TIME = 64
NO_LEG = -(2**20)
"""Far less than any leg needs."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Homes:
    """Where home is, and how far.

    Attributes:
        of: int32 `[K]`, the bases of each robot.
        steps: int32 `[B * A]`, moves of the way home from each cell, NONE where it is cut off; cost: int32, its cost;
            onward, base: uint16, what is entered next on it, and where it ends.
        moves: uint16 `[A * A]`, those of the leg from row to column. need: uint16 `[B * A * A]`, the moves that a robot
            must have left before the leg, so that it is within its way home of a base all along.
        last: int32 scalar, D. furthest: int32 scalar, moves of the longest way home.
        recharge: int32 scalar, steps; None: robots are not charged.
    """

    of: Array
    steps: Array
    cost: Array
    onward: Array
    base: Array
    moves: Array
    need: Array
    last: Array
    furthest: Array
    recharge: Array | None

    @property
    def size(self) -> int:
        """A."""
        return self.steps.shape[0] // (self.need.shape[0] // self.moves.shape[0])


def lane_homes(loop: ClosedLoop, size: int, robots: int, sets: tuple[int, ...]) -> Homes | None:
    """The ways home of a closed loop, None where robots stay where they end; A; K; B is the first of `sets` that fits.

    Raises WorldError for more than there is room for.
    """
    if not loop.comes_home:
        return None
    tables, (given, count) = loop.tables, loop.tables.home_steps.shape
    if given * count**2 > MOST_TABLED**2:
        raise WorldError(
            f"{given} bases for themselves on {count:,} cells",
            expected=f"bases x cells x cells up to {MOST_TABLED**2:,} for the closed loop in JAX",
            fix=f"use {argument('engine', 'numba')}, or {argument('return_to', 'nearest')}",
        )
    more = next(one for one in sets if one >= given) - given
    base = onward = np.where(tables.home_steps > 0, tables.onward, np.arange(count)).astype(np.int64)
    while (tables.home_steps[np.arange(given)[:, None], base] > 0).any():
        base = np.take_along_axis(base, base, axis=1)
    moves, need = _legs(loop, size)

    def flat(rows: NDArray, fill: int, kind: type) -> NDArray:
        return np.pad(rows.astype(kind), ((0, more), (0, size - count)), constant_values=fill).reshape(-1)

    return on_host(
        Homes,
        of=padded(tables.home_of, robots),
        steps=flat(tables.home_steps, NONE, np.int32),
        cost=flat(tables.home_cost, NONE, np.int32),
        onward=flat(onward, size - 1, np.uint16),
        base=flat(base, size - 1, np.uint16),
        moves=moves.reshape(-1),
        need=np.pad(need, ((0, more), (0, 0), (0, 0))).reshape(-1),
        last=np.int32(tables.limits[LAST_STEP]),
        furthest=np.int32(tables.home_steps.max()),
        recharge=np.int32(tables.limits[RECHARGE]) if tables.limits[RECHARGE] else None,
    )


def _legs(loop: ClosedLoop, size: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """`moves` `[A, A]` and `need` `[B', A, A]` of Homes: legs twice as long at a time, of some goals at a time."""
    tables, steps, count = loop.tables, loop.tables.home_steps, len(loop.cells)
    moves, need = np.zeros((size, size), np.uint16), np.zeros((len(steps), size, size), np.uint16)
    for begin in range(0, count, GOALS_AT_A_TIME):
        goals = np.arange(begin, min(begin + GOALS_AT_A_TIME, count))
        row, end = np.arange(len(goals))[:, None], goals[:, None]
        made = ((tables.cost_to[goals] >= 0) & (end != np.arange(count))).astype(np.int64)
        at = np.where(made, tables.hop_to[goals], end)
        most = np.where(made, 1 + steps[:, at], NO_LEG)
        while (at != end).any():
            most = np.maximum(most, made + most[:, row, at])
            made, at = made + made[row, at], at[row, at]
        moves[:count, goals] = made.T
        need[:, :count, goals] = np.maximum(most, 0).transpose(0, 2, 1)
    return moves, need
