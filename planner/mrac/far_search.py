"""The nearest target when it is far: a search that knows how much danger still lies ahead.

A dangerous cell costs more than every safe one, so a plain search explores the whole safe part of the map around it
before it goes through a second dangerous cell. Here a search backwards from the targets, in which every component of
safe cells is one node (safe cells cost nothing there), finds the danger still to go; A* with it as its potential then
spends time on safe steps alone. Where that search was ended early, its last cost is the potential: a lower bound that
keeps A* exact. Answers, ties and paths are those of `planner.mrac.search`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.jit import compiled, threaded
from planner.mrac.heap import pop, push
from planner.mrac.search import NOT_WANTED, TOO_FAR, UNREACHED
from planner.none import NO_CELL


class SafeParts(NamedTuple):
    """The map with every connected component of safe cells as one node. Axes: `N` cells, `B` cells at borders.

    Attributes:
        node: int32 `[N]`, the lowest cell of a safe cell's component; of a dangerous cell the cell itself.
        begin, border: int32 `[N + 1]`, `[B]`: beside component v are the dangerous cells
            `border[begin[v] : begin[v + 1]]`.
        wide: dangerous cells around a component that are worth a visit when the robot itself stands in danger.
        to_go, touched: int64 `[N]`, of each node: least danger to a target, and the search that found it.
    """

    node: NDArray[np.int32]
    begin: NDArray[np.int32]
    border: NDArray[np.int32]
    wide: int
    to_go: NDArray[np.int64]
    touched: NDArray[np.int64]


def find_safe_parts(neighbours: NDArray[np.int32], costs: NDArray[np.int64], wide: int = 1_000) -> SafeParts:
    """The safe components of a map with these `neighbours` `[N, 4]` and entry costs `[N]`."""
    n = len(costs)
    node = _label(neighbours, costs)
    beside = node[neighbours]
    counts = (costs[:, None] > 1) & (neighbours >= 0) & (costs[neighbours] == 1)
    cell = np.broadcast_to(np.arange(n)[:, None], counts.shape)[counts]
    pairs = np.unique(beside[counts].astype(np.int64) * n + cell)
    begin = np.searchsorted(pairs, np.arange(n + 1) * n).astype(np.int32)
    return SafeParts(node, begin, (pairs % n).astype(np.int32), wide, np.zeros(n, np.int64), np.zeros(n, np.int64))


@compiled
def _label(neighbours, costs):  # type: ignore[no-untyped-def]
    """`SafeParts.node`."""
    n = len(costs)
    node, stack = np.full(n, NO_CELL, dtype=np.int32), np.empty(n, dtype=np.int32)
    for first in range(n):
        if node[first] != NO_CELL:
            continue
        node[first] = first
        top = 0
        if costs[first] == 1:
            stack[0], top = first, 1
        while top > 0:
            top -= 1
            here = stack[top]
            for side in range(4):
                cell = neighbours[here, side]
                if cell != NO_CELL and costs[cell] == 1 and node[cell] == NO_CELL:
                    node[cell] = first
                    stack[top] = cell
                    top += 1
    return node


@threaded
def danger_ahead(source, rank, among, neighbours, costs, stamp, heap_cost, heap_cell, parts):  # type: ignore[no-untyped-def]
    """Search backwards from the targets, all of them `among` these cells, until the source, itself none, is touched.

    The danger to go from any node not touched is at least the result, UNREACHED if no target can be reached. A node is
    queued by what it hands on to those before it, its own danger included, so that the first touch is final. From a
    dangerous source it ends at the first wide component.
    """
    node, begin, border, wide, to_go, touched = parts
    size, start = 0, node[source]
    for cell in among:
        if rank[cell] != NOT_WANTED and touched[node[cell]] != stamp:
            touched[node[cell]], to_go[node[cell]] = stamp, 0
            size = push(heap_cost, heap_cell, size, costs[cell] if costs[cell] > 1 else np.int64(0), node[cell])
    if touched[start] == stamp:
        return np.int64(0)
    from_danger = costs[source] > 1
    while size > 0:
        now, here = heap_cost[0], heap_cell[0]
        size = pop(heap_cost, heap_cell, size)
        safe = costs[here] == 1
        for side in range(begin[here], begin[here + 1]) if safe else range(4):
            cell = border[side] if safe else neighbours[here, side]
            if cell == NO_CELL or node[cell] == NO_CELL:
                continue
            cell = node[cell]
            if touched[cell] == stamp:
                continue
            touched[cell], to_go[cell] = stamp, now
            if cell == start or (from_danger and begin[cell + 1] - begin[cell] > wide):
                return now
            size = push(heap_cost, heap_cell, size, now + costs[cell] if costs[cell] > 1 else now, cell)
    return np.int64(UNREACHED)


@threaded
def far_search(  # type: ignore[no-untyped-def]
    source, rank, inside, neighbours, costs, distance, seen, stamp, heap_cost, heap_cell, layer, later, parts, ahead
):
    """The nearest target and its cost, as `search_within` finds them, NO_CELL if there is none, after `danger_ahead`.

    A* with the danger to go, at most `ahead`, as its potential, until all that costs as little as the answer is
    settled. Costs with what is to go never fall on a way, and mostly rise by 0 or 1: what comes `now` and what comes
    next are lists, all else is in a heap. Of `distance` only what lies on safest paths to the answer is final.
    TOO_FAR where a cell that was queued again found no room in `layer`, `later` or the heap.
    """
    node, to_go, touched = parts.node, parts.to_go, parts.touched
    distance[source], seen[source] = 0, stamp
    best, best_cost, now = NO_CELL, np.int64(UNREACHED), np.int64(ahead)
    layer[0], count, beyond, size, room = source, 1, 0, 0, len(layer) - 4
    while best == NO_CELL or now <= best_cost:
        place = 0
        while place < count:
            here = layer[place]
            place += 1
            at = node[here]
            if now != distance[here] + (to_go[at] if touched[at] == stamp else ahead):
                continue  # queued before a cheaper way was found
            if rank[here] != NOT_WANTED:
                if best == NO_CELL or rank[here] < rank[best] or (rank[here] == rank[best] and here < best):
                    best, best_cost = here, distance[here]
                continue
            if max(count, beyond, size) > room:
                return TOO_FAR, np.int64(UNREACHED)
            for side in range(4):
                cell = neighbours[here, side]
                if cell == NO_CELL or not inside[cell]:
                    continue
                cost = distance[here] + costs[cell]
                if seen[cell] == stamp and distance[cell] <= cost:
                    continue
                distance[cell], seen[cell] = cost, stamp
                at = node[cell]
                total = cost + (to_go[at] if touched[at] == stamp else ahead)
                if total == now:
                    layer[count] = cell
                    count += 1
                elif total == now + 1:
                    later[beyond] = cell
                    beyond += 1
                else:
                    size = push(heap_cost, heap_cell, size, total, cell)
        layer, later, count, beyond = later, layer, beyond, 0
        if count > 0:
            now += 1
        elif size > 0:
            now = heap_cost[0]
        else:
            break
        while size > 0 and heap_cost[0] == now:
            if count > room:
                return TOO_FAR, np.int64(UNREACHED)
            layer[count] = heap_cell[0]
            count += 1
            size = pop(heap_cost, heap_cell, size)
    return best, best_cost
