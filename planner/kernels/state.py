"""The compiled simulator's data: what every rollout reads, the state that it keeps, and what it is counted into.

Part of `planner.kernels.rollouts`, which see. Axis letters: `A` accessible cells, `K` robots, `M` areas, `T` steps, `E`
events. The arrays that a way of running does without are None: Numba compiles each kernel for the ways that it is
called in, and leaves out what tests for None rule out, so that tables, searches and traces cost the others nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

IDLE, TRAVELING, COVERING, FINISHED, DEAD = 0, 1, 2, 3, 4
UNASSIGNED, ASSIGNED, COMPLETED = 0, 1, 2
COMPLETE, STOPPED, STUCK, TIMEOUT, AREAS_FULL = 0, 1, 2, 3, -1
NONE = -1
FAR = 2**63 - 1

RANKED = 128
"""Cells that `Tables.ranked` holds for each cell: a robot in a safe area mostly finds its next cell among them."""

Table = Any
"""An array, or None where the way of running does without it (no union: its reader knows that it is there)."""


class Tables(NamedTuple):
    """What every rollout reads. The all-pairs tables are None where distances are searched for on demand.

    Attributes:
        near: int32 `[A, 4]`, neighbours N, W, E, S; NONE if blocked.
        cost_to: int32 or int64 `[A, A]`, safest-path cost from row to column; NONE if unreachable.
        hop_to: int16 or int32 `[A, A]`, first cell of that path.
        ranked: like hop_to `[A, RANKED]`, the cells of least cost from each, by (cost, index); NONE after the last.
        area_cost: like cost_to `[A, M]`, cost from each cell to each area of t = 0 (its cheapest cell, visited or not);
            area_entry: like hop_to `[A, M]`, that cell.
        entry: int64 `[A]`, cost of entering each cell (eq. (3)); None where nothing is searched for.
        bound: uint32 `[A]`, a visit stops the robot iff the 24 leading bits of its word are below this.
        starts: int32 `[K]`.
        order: int32 `[A]`, the cells area by area; begin: int32 `[M + 1]`, where each area begins in it.
        level, owner: int32 `[M]`, the allocation at t = 0.
    """

    near: NDArray
    cost_to: Table
    hop_to: Table
    ranked: Table
    area_cost: Table
    area_entry: Table
    entry: Table
    bound: NDArray
    starts: NDArray
    order: NDArray
    begin: NDArray
    level: NDArray
    owner: NDArray


# One rollout's state is a few arrays, rows named here. (Plain arrays: a tuple of many costs a count of references
# at every call, which made the run 20 times slower.)
AREA_OF, ORDER, VISITED, SURVIVED, TO_DO, LABEL, STACK, CELL_ROWS = 0, 1, 2, 3, 4, 5, 6, 7
"""`cells [7, A]`: area of the cell; the cells area by area; flags (TO_DO: of the path being driven); scratch."""
BEGIN, END, LEVEL, OWNER, STATUS, LEFT_IN, AREA_ROWS = 0, 1, 2, 3, 4, 5, 6
"""`areas [6, M]`: segment of ORDER, level, robot, status, unvisited cells."""
CELL, DOING, AREA, TARGET, LEFT, AHEAD, ROBOT_ROWS = 0, 1, 2, 3, 4, 5, 6
"""`robots [6, K]`: where, what, which area, end of the current leg, cells still to do on the coverage path, and how
many cells of `legs` are still to enter (0: the leg is one move, or follows `hop_to`)."""
AREAS, OPEN, UNVISITED, ALIVE, BISECTED, DIVIDED, STEP, STAMP, TOTALS = 0, 1, 2, 3, 4, 5, 6, 7, 8
"""`totals [8]`, int64: areas so far, unassigned ones, unvisited cells, robots alive, areas shared by bisection, areas
shared that lay in several components already, the step (kept for traces alone), searches so far (never reset)."""
RANK, EVERYWHERE, INSIDE, DISTANCE, SEEN, QUEUE, HEAP_COST, HEAP_CELL, WORK_ROWS = range(9)
"""`work [8, A]`, int64, for searches: RANK is that of `planner.mrac.costs.search` (NONE = no target); EVERYWHERE is 1,
INSIDE 0 between searches."""
FROM_OWNER, FROM_HELPER, COST_ROWS = 0, 1, 2
"""`costs [2, A]`, int64, for searches: from two robots to every cell, NONE if unreachable."""
SINGLES = 7
"""Numbers kept of a single rollout: visited, survived, time, alive, outcome, bisected, divided."""
VISITS, STOPS, COVERED, SAFELY, CELL_COUNTS = 0, 1, 2, 3, 4
"""`by_cell [4, A]`, int64 counts over rollouts: visits, stops, covered (visited), covered (survived)."""
TIME, NEW_VISITED, NEW_SURVIVED, STEP_COUNTS = 0, 1, 2, 3
"""`by_step [3, T + 1]`, int64 counts over rollouts: times, cells new at each step in the two meanings."""


class Counts(NamedTuple):
    """What rollouts are counted into, int64: `by_cell`, `by_step` as above, and histograms; see planner.tally.Tally."""

    by_cell: NDArray
    by_step: NDArray
    visited: NDArray
    survived: NDArray
    alive: NDArray
    outcomes: NDArray


def make_counts(cells: int, robots: int, steps: int) -> Counts:
    """Empty counts for rollouts of at most `steps` steps."""
    shapes = ((CELL_COUNTS, cells), (STEP_COUNTS, steps + 1), (cells + 1,), (cells + 1,), (robots + 1,), (4,))
    return Counts(*(np.zeros(shape, dtype=np.int64) for shape in shapes))


class State(NamedTuple):
    """One thread's rollout in progress, rows as above; `legs`: int32 `[K, A]`, the cells of each leg, last first."""

    work: NDArray | None
    legs: NDArray | None
    costs: NDArray | None
    cells: NDArray
    areas: NDArray
    robots: NDArray
    totals: NDArray


def make_state(tables: Tables, room: int) -> State:
    """A state with room for `room` areas; `work`, `legs` and `costs` only where something is searched for."""
    size, team = len(tables.bound), len(tables.starts)
    work = legs = costs = None
    if tables.entry is not None:
        work = np.zeros((WORK_ROWS, size), dtype=np.int64)
        work[RANK], work[EVERYWHERE] = NONE, 1
        legs, costs = np.zeros((team, size), dtype=np.int32), np.zeros((COST_ROWS, size), dtype=np.int64)
    shapes = ((CELL_ROWS, size), (AREA_ROWS, room), (ROBOT_ROWS, team))
    cells, areas, robots = (np.zeros(shape, dtype=np.int32) for shape in shapes)
    return State(work, legs, costs, cells, areas, robots, np.zeros(TOTALS, dtype=np.int64))
