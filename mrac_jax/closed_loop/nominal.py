"""The nominal run of a closed loop, on which every rollout is until somebody is hit: lanes begin at the first hit.

Which dangerous entry is a rollout's first hit follows from what its robots bear; what the rollouts have in common with
the nominal run is counted from how many are still on it at each step, and those that are never hit need no lane.
Axis letters: `E` dangerous entries of the nominal run in the order in which they are made, `V` all its entries, `M`
steps at which lanes begin, `T` steps, `B` rollouts; the others as in `mrac_jax.closed_loop.state`. NumPy alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrac_jax.closed_loop.state import CELL_KINDS, NEW_SURVIVED, NEW_VISITED, STEP_KINDS
from planner.kernels.loop import ClosedLoop, known_cells
from planner.kernels.nominal import nominal_trace
from planner.kernels.state import MOST_PASSES
from planner.tolerance import CERTAIN

NO_HIT = 2**30
"""Larger than the number of any entry."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """The run with no hits, as the lanes' counts need it.

    Attributes:
        step, cell, kind: int64 `[V]`, of its entries in order; the kind of a visit as in `mrac_jax.closed_loop.state`.
        turn: int64 `[V]`, entries of the same cell before.
        own, borne: for each robot, the numbers of its dangerous entries, and the exposure after each; int64.
        begins: int32 `[M]`, rising steps: lanes begin at the start of one. begin_of: int32 `[E]`, the last of them that
            is not after the entry. before: int64 `[M, K]`, the exposure of each robot by then.
    """

    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    kind: NDArray[np.int64]
    turn: NDArray[np.int64]
    own: list[NDArray[np.int64]]
    borne: list[NDArray[np.int64]]
    begins: NDArray[np.int32]
    begin_of: NDArray[np.int32]
    before: NDArray[np.int64]

    def first_hits(self, tolerance: NDArray[np.int64]) -> NDArray[np.int64]:
        """The number of each rollout's first hit, `[B]` of int64 `[B, K]`; NO_HIT if there is none."""
        first = np.full(len(tolerance), NO_HIT)
        for robot, (own, borne) in enumerate(zip(self.own, self.borne, strict=True)):
            # Exposure only grows along a path, so a robot's first hit is found by bisection.
            first = np.minimum(first, np.append(own, NO_HIT)[np.searchsorted(borne, tolerance[:, robot])])
        return first

    def count(
        self,
        begun: NDArray[np.int64],
        whole: int,
        by_cell: NDArray[np.int64],
        by_step: NDArray[np.int64],
        passes: NDArray[np.int64] | None = None,
    ) -> None:
        """Add what rollouts did on the nominal run: `begun` `[M]` of them left it for a lane, `whole` never did."""
        on_it = np.full(int(self.step.max(initial=-1)) + 1, whole, dtype=np.int64)  # [T], rollouts that are on it then
        # A lane counts from its snapshot's step on; all before that is the nominal run's.
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
    danger = np.flatnonzero((loop.tables.bound[cell] > 0) & (fresh | (not loop.first_only)))
    exposure = loop.tables.exposure[cell[danger]]
    if loop.in_doubt:  # it is not known here what adds how much: whoever may be hit needs a lane from the first on
        exposure = CERTAIN * (np.arange(len(danger)) == 0)
    begins = np.unique(step[danger])
    # More steps than snapshots: some lanes begin earlier than they need to, and nothing else changes.
    if len(begins) > most_begins:
        begins = begins[np.linspace(0, len(begins) - 1, most_begins).astype(np.int64)]
    own = [np.flatnonzero(robot[danger] == number) for number in range(loop.robots)]
    borne = [np.cumsum(exposure[mine]) for mine in own]
    made = [np.searchsorted(step[danger][mine], begins) for mine in own]
    return Nominal(
        step=step,
        cell=cell,
        kind=fresh * NEW_VISITED + safely * NEW_SURVIVED,
        turn=_turns(cell) + survived[cell],
        own=own,
        borne=borne,
        begins=begins.astype(np.int32),
        begin_of=(np.searchsorted(begins, step[danger], side="right") - 1).astype(np.int32),
        before=np.stack([np.append(0, one)[many] for one, many in zip(borne, made, strict=True)], axis=1),
    )


def _turns(cell: NDArray[np.int64]) -> NDArray[np.int64]:
    """How often each entry's cell was entered before, int64 `[V]`."""
    order = np.argsort(cell, kind="stable")
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    turn = np.empty(len(cell), dtype=np.int64)
    turn[order] = np.arange(len(cell)) - np.repeat(begins, np.diff(begins, append=len(cell)))
    return turn
