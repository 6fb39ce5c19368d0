"""The nominal run of a closed loop, on which every rollout is until somebody is hit: lanes begin at the first hit.

Which dangerous entry is a rollout's first hit is drawn for all of them at once; what the rollouts have in common with
the nominal run is counted from how many are still on it at each step, and those that are never hit need no lane.
Axis letters: `E` dangerous entries of the nominal run in the order in which they are made, `V` all its entries, `M`
steps at which lanes begin, `T` steps, `B` rollouts; the others as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array
from mrac_jax.closed_loop.state import CELL_KINDS, NEW_SURVIVED, NEW_VISITED, STEP_KINDS
from mrac_jax.doubt import Doubt, bound_in_doubt, make_doubt
from mrac_jax.threefry import threefry2x32
from planner.kernels.loop import ClosedLoop, known_cells
from planner.kernels.nominal import nominal_trace
from planner.kernels.state import MOST_PASSES
from planner.threefry import ROBOT_STRIDE

LEAST_ENTRIES = 64
ENTRIES_A_STEP = 4
"""Dangerous entries that are drawn before anybody looks whether any rollout is still on the nominal run."""
NO_HIT = 2**30
"""Larger than the number of any entry."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """The run with no hits, as the lanes' counts need it.

    Attributes:
        step, cell, kind: int64 `[V]`, of its entries in order; the kind of a visit as in `mrac_jax.closed_loop.state`.
        turn: int64 `[V]`, entries of the same cell before.
        moment, bound: uint32 `[E']`, E padded: counter word of each dangerous entry, and below which it is a hit.
        doubt: at the same places, what is in doubt about them, or None.
        dangerous: E.
        begins: int32 `[M]`, rising steps: lanes begin at the start of one. begin_of: int32 `[E]`, the last of them that
            is not after the entry.
    """

    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    kind: NDArray[np.int64]
    turn: NDArray[np.int64]
    moment: NDArray[np.uint32]
    bound: NDArray[np.uint32]
    doubt: Doubt | None
    dangerous: int
    begins: NDArray[np.int32]
    begin_of: NDArray[np.int32]

    def count(
        self,
        begun: NDArray[np.int64],
        whole: int,
        by_cell: NDArray[np.int64],
        by_step: NDArray[np.int64],
        passes: NDArray[np.int64] | None = None,
    ) -> None:
        """Add what rollouts did on the nominal run: `begun` `[M]` of them left it for a lane, `whole` never did."""
        on_it = np.full(int(self.step[-1]) + 1, whole, dtype=np.int64)  # [T], rollouts that are on it in each step
        for step, leaving in zip(self.begins.tolist(), begun.tolist(), strict=True):
            on_it[:step] += leaving
        np.add.at(by_cell, self.cell * CELL_KINDS + self.kind, on_it[self.step])
        np.add.at(by_step, self.step * STEP_KINDS + self.kind, on_it[self.step])
        if passes is not None:
            told = self.turn < MOST_PASSES
            np.add.at(passes, (self.cell * MOST_PASSES + self.turn)[told], on_it[self.step[told]])


def nominal_of(loop: ClosedLoop, most_begins: int) -> Nominal:
    """The nominal run of a closed loop; lanes begin at `most_begins` of its steps at most."""
    trace = nominal_trace(loop)
    moved = np.diff(trace.cells, axis=0, prepend=-1) != 0  # all robots enter their starts at t = 0
    visited, survived = (np.isin(loop.cells, known) for known in known_cells(loop))
    moved[: 0 if loop.state is None else loop.state.step + 1] = False
    step, robot = np.nonzero(moved)
    cell = np.searchsorted(loop.cells, trace.cells[moved])
    first = np.zeros(len(cell), dtype=np.bool_)
    first[np.unique(cell, return_index=True)[1]] = True
    fresh, safely = first & ~visited[cell], first & ~survived[cell]
    bound = loop.tables.bound[cell]
    danger = np.flatnonzero((bound > 0) & (fresh | (not loop.first_only)))
    begins = np.unique(step[danger])
    if len(begins) > most_begins:
        begins = begins[np.linspace(0, len(begins) - 1, most_begins).astype(np.int64)]
    room = max(LEAST_ENTRIES, 1 << max(len(danger) - 1, 0).bit_length())
    return Nominal(
        step=step,
        cell=cell,
        kind=fresh * NEW_VISITED + safely * NEW_SURVIVED,
        turn=_turns(cell) + survived[cell],
        moment=_padded(step[danger] * ROBOT_STRIDE + robot[danger], room),
        bound=_padded(bound[danger], room),
        doubt=make_doubt(loop.tables, False, room, cell[danger]) if loop.in_doubt else None,
        dangerous=len(danger),
        begins=begins.astype(np.int32),
        begin_of=(np.searchsorted(begins, step[danger], side="right") - 1).astype(np.int32),
    )


def _turns(cell: NDArray[np.int64]) -> NDArray[np.int64]:
    """How often each entry's cell was entered before, int64 `[V]`."""
    order = np.argsort(cell, kind="stable")
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    turn = np.empty(len(cell), dtype=np.int64)
    turn[order] = np.arange(len(cell)) - np.repeat(begins, np.diff(begins, append=len(cell)))
    return turn


def first_hits(
    key: jax.Array, rollouts: jax.Array, moment: Array, bound: Array, doubt: Doubt | None, dangerous: jax.Array
) -> jax.Array:
    """The number of each rollout's first hit among the nominal run's dangerous entries, int32 `[B]`; E or more: none.

    uint32 key `[2]` or `[4]`, rollouts `[B]`, moment and bound `[E']`; dangerous: int32 scalar, E.
    """

    def more(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        entry, first = state
        return (entry < dangerous) & (first >= entry).any()

    def draw(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        entry, first = state
        for number in (entry + place for place in range(ENTRIES_A_STEP)):
            luck = threefry2x32(key, rollouts, moment[number])[0] >> jnp.uint32(8)
            most = bound[number]
            if doubt is not None:
                most = bound_in_doubt(doubt, key, rollouts, number, most)
            first = jnp.minimum(first, jnp.where(luck < most, number, NO_HIT))
        return entry + ENTRIES_A_STEP, first

    return jax.lax.while_loop(more, draw, (jnp.int32(0), jnp.full(rollouts.shape, NO_HIT, dtype=jnp.int32)))[1]


def _padded(values: NDArray[np.int64], size: int) -> NDArray[np.uint32]:
    out = np.zeros(size, dtype=np.uint32)
    out[: len(values)] = values
    return out
