"""The search for safest paths, compiled, for `planner.mrac.paths`.

Among targets of equal cost the one of least rank, then of lowest index, is nearest; among equal-cost paths to one
target, walking back from the target, the predecessor of lowest index is taken (SPEC section 3).
"""

from __future__ import annotations

import numpy as np

from planner.jit import compiled, put_first, threaded
from planner.mrac.heap import pop, push
from planner.none import NO_CELL

NOT_WANTED = -1
"""Rank of a cell that is no target."""
UNREACHED = -1
"""Cost of a cell that cannot be reached."""
TOO_FAR = -2
"""In the place of a nearest target: none was certain within the cells that a search was allowed."""


@threaded
def search_within(source, rank, inside, neighbours, costs, distance, seen, stamp, queue, heap_cost, heap_cell, most):  # type: ignore[no-untyped-def]
    """Dijkstra from `source` until the nearest target is certain; `distance[v]` is final where `seen[v] == stamp`.

    Costs sit on the cells entered, so the first time a cell is met its distance is final: each is queued once. Cells
    one unit away (safe ones) go through a queue in layers, the others through a heap. TOO_FAR as soon as more
    than `most` cells have gone through the queue.
    """
    distance[source], seen[source] = 0, stamp
    if rank[source] != NOT_WANTED:
        return source, 0
    best, best_cost, target_cost = NO_CELL, np.int64(UNREACHED), np.int64(0)
    head, tail, heap_size = 0, 1, 0
    queue[0] = source
    now = np.int64(0)
    while True:
        layer_end = tail
        if heap_size > 0 and heap_cost[0] == now:
            while heap_size > 0 and heap_cost[0] == now:
                queue[tail] = heap_cell[0]
                tail += 1
                heap_size = pop(heap_cost, heap_cell, heap_size)
            layer_end = tail
        while head < layer_end:
            here = queue[head]
            head += 1
            for side in range(4):
                cell = neighbours[here, side]
                if cell == NO_CELL or seen[cell] == stamp or not inside[cell]:
                    continue
                seen[cell] = stamp
                cost = now + costs[cell]
                distance[cell] = cost
                if rank[cell] != NOT_WANTED and (
                    best == NO_CELL
                    or cost < best_cost
                    or (cost == best_cost and (rank[cell] < rank[best] or (rank[cell] == rank[best] and cell < best)))
                ):
                    best, best_cost, target_cost = cell, cost, costs[cell]
                if costs[cell] == 1:
                    queue[tail] = cell
                    tail += 1
                else:
                    heap_size = push(heap_cost, heap_cell, heap_size, cost, cell)
        if tail > layer_end:
            now += 1
        elif heap_size > 0:
            now = heap_cost[0]
        else:
            return best, best_cost
        if best != NO_CELL and now + target_cost > best_cost:
            return best, best_cost
        if head > most:
            return TOO_FAR, np.int64(UNREACHED)


@compiled
def walk_back(source, target, distance, seen, stamp, neighbours, costs):  # type: ignore[no-untyped-def]
    """The cells of the safest path after `source`, in driving order, by the lowest-index predecessor."""
    length, here = 0, target
    path = np.empty(64, dtype=np.int64)
    while here != source:
        if length == len(path):
            longer = np.empty(2 * length, dtype=np.int64)
            put_first(path, longer)
            path = longer
        path[length] = here
        length += 1
        before = distance[here] - costs[here]
        for side in range(4):
            cell = neighbours[here, side]
            if cell != NO_CELL and seen[cell] == stamp and distance[cell] == before:
                here = cell
                break
    return path[:length][::-1].copy()
