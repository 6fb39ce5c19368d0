"""Costs from one cell to all others, kept as a row where there are no tables: few cells ask, and they ask again.

Part of `planner.kernels.rollouts`, which see. A row answers as a search would, so no rollout depends on which are kept.
There is room for ROWS_BYTES of them a thread; then each new one takes the place of the oldest.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.nearest import one_cell, seek_near
from planner.kernels.state import PATIENCE
from planner.mrac.heap import pop, push
from planner.none import NONE


@rare_kernel
def row_from(t, s, w, here):
    """The number of the row of costs from `here`, which is made if it is not kept; `walk_back` then goes along it.

    The row of the last answer is still there afterwards.
    """
    row = np.int64(w.row_of[here])
    if row == NONE:
        # Sharing compares two rows: the one just given must survive the making of the next.
        row = w.oldest[0] if w.oldest[0] != w.last[0] else (w.oldest[0] + 1) % len(w.rows)
        w.oldest[0] = (row + 1) % len(w.rows)
        if w.source_of[row] != NONE:
            w.row_of[w.source_of[row]] = NONE
        w.source_of[row], w.row_of[here] = here, row
        if len(s.mind) == 0:
            fill_row(t, w, here, row)
        else:
            fill_row_believed(t, s, w, here, row)
    w.last[0] = row
    return row


@kernel
def fill_row(t, w, here, row):
    """Costs to all cells, and of those to each area of t = 0 the least, lowest index first."""
    costs, size = w.rows[row], len(t.near)
    for cell in range(size):
        costs[cell] = NONE
    costs[size] = 0  # what is blocked is met already
    spread(t, w, here, costs)
    costs[size] = NONE
    for area in range(len(t.level)):
        best = np.int64(t.order[t.begin[area]])
        for place in range(t.begin[area] + 1, t.begin[area + 1]):
            cell = np.int64(t.order[place])
            if costs[cell] < costs[best]:
                best = cell
        w.row_costs[row, area], w.row_entries[row, area] = costs[best], best


@kernel
def fill_row_believed(t, s, w, here, row):
    """Costs to all cells, as robots that learn believe them: a search that finds nothing passes all in reach."""
    seek_near(t, s, w, here, one_cell(np.int64(NONE)), np.int64(NONE), len(t.near))
    costs, stamp = w.rows[row], w.stamp[0]
    for cell in range(len(t.near)):
        costs[cell] = w.distance[cell] if w.seen[cell] == stamp else NONE
    costs[len(t.near)] = NONE


@kernel
def spread(t, w, here, costs):
    """Dijkstra from `here` to all cells that have no cost yet.

    What is paid on entering is the same for all cells of a kind, so those of a kind are met in the order in which they
    are due: each kind has a queue of its own, in the part of `w.queue` for its cells, and the heap holds only the first
    of each.
    """
    queue, head, tail, heap_size, now = w.queue, w.heads, w.tails, 0, np.int64(0)
    for kind in range(len(t.kind_cost)):
        head[kind] = tail[kind] = t.kind_begin[kind]
    kind = np.int64(t.kind[here])
    costs[here], queue[tail[kind]] = 0, here
    tail[kind] += 1
    heap_size = push(w.heap_cost, w.heap_cell, heap_size, now, kind)
    while heap_size > 0:
        now, due = w.heap_cost[0], np.int64(w.heap_cell[0])
        heap_size = pop(w.heap_cost, w.heap_cell, heap_size)
        end = tail[due]
        while head[due] < end and costs[queue[head[due]]] == now:
            at = np.int64(queue[head[due]])
            head[due] += 1
            for side in range(4):
                cell = np.int64(t.near[at, side])
                if costs[cell] == NONE:
                    kind = np.int64(t.kind[cell])
                    cost = now + t.kind_cost[kind]
                    costs[cell], queue[tail[kind]] = cost, cell
                    # Its queue was empty, so this cell is its first: the heap has to know.
                    if head[kind] == tail[kind] and kind != due:
                        heap_size = push(w.heap_cost, w.heap_cell, heap_size, cost, kind)
                    tail[kind] += 1
        if head[due] < tail[due]:
            heap_size = push(w.heap_cost, w.heap_cell, heap_size, np.int64(costs[queue[head[due]]]), due)


@kernel
def row_if_asked(t, s, w, here):
    """The number of the row from `here` if it is kept, or has been asked for often enough by now, else NONE."""
    if w.row_of[here] == NONE and w.asked[here] < t.limits[PATIENCE]:
        w.asked[here] += np.uint8(1)
        return np.int64(NONE)
    return row_from(t, s, w, here)


@kernel
def last_cost(w, cell):
    """What the last answer, a row's or a search's, says of the cost of a cell, NONE if nothing."""
    if w.last[0] != NONE:
        return np.int64(w.rows[w.last[0], cell])
    return w.distance[cell] if w.seen[cell] == w.stamp[0] else np.int64(NONE)


@kernel
def walk_back(t, s, w, here, target, leg):
    """Write the last answer's path from `here` to `target` into `leg` `[A]`, last cell first; returns its steps."""
    steps, cell, entry = 0, np.int64(target), s.entry if len(s.mind) > 0 else t.entry
    while cell != here:
        leg[steps] = cell
        steps += 1
        # Neighbours rise in index, so the first that fits is the lowest: the tie of SPEC section 3.
        before = last_cost(w, cell) - entry[cell]
        for side in range(4):
            other = np.int64(t.near[cell, side])
            if last_cost(w, other) == before:
                cell = other
                break
    return steps
