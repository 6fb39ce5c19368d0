"""Safest paths between all pairs of cells, and from each cell to each area, as tables. Axes: `A` cells, `M` areas."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from planner.jit import threaded
from planner.kernels.state import RANKED
from planner.mrac.heap import pop, push
from planner.mrac.search import UNREACHED
from planner.none import NO_CELL

BLOCK = 32
"""Sources whose first hops are written at a time: by target, so that a line of memory is met once."""
FAR = 2**62
"""Costs more than any path."""
LEAST_SHARED = 2**20
"""Entries of a table from which on threads share it out: fewer are written sooner than threads begin."""


def all_pairs(
    near: NDArray[np.int32], entry: NDArray[np.int64], wide: np.dtype, narrow: np.dtype
) -> tuple[NDArray, NDArray, NDArray]:
    """`Tables.cost_to` and `hop_to` `[A, A]`, and `ranked` `[A, RANKED]`, costs `wide` and cells `narrow`.

    `near` int32 `[A, 4]`: neighbours, NO_CELL if none. `entry` `[A]`: of each cell. Cost: O(A**2 log A).
    """
    size = len(entry)
    cost = np.full((size, size), UNREACHED, dtype=wide)
    hop = np.zeros((size, size), dtype=narrow)
    ranked = np.full((size, min(size, RANKED)), size, dtype=narrow)
    _share_out(cost.size, lambda part, parts: _fill(part, parts, near, entry, cost, hop, ranked))
    return cost, hop, ranked


def to_areas(
    cost: NDArray, narrow: np.dtype, order: NDArray[np.int32], begin: NDArray[np.int32]
) -> tuple[NDArray, NDArray]:
    """(cost, entry) `[A, M]` from each cell to each area of t = 0, whose cells `order[begin[m]:begin[m + 1]]` rise."""
    area_cost = np.empty((len(cost), len(begin) - 1), dtype=cost.dtype)
    area_entry = np.empty(area_cost.shape, dtype=narrow)
    _share_out(cost.size, lambda part, parts: _nearest(part, parts, cost, order, begin, area_cost, area_entry))
    return area_cost, area_entry


def _share_out(entries: int, work: Callable[[int, int], None]) -> None:
    """Call `work(part, parts)` for each part, on a core each where there are many entries."""
    threads = os.cpu_count() or 1
    if entries < LEAST_SHARED:
        work(0, 1)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda part: work(part, threads), range(threads)))


@threaded
def _fill(part, parts, near, entry, cost, hop, ranked):  # type: ignore[no-untyped-def]
    """Every so many-th BLOCK of sources.

    Dijkstra as in `planner.mrac.search.search_within`, but to all cells: they leave the queue in rising order of cost,
    so that whatever precedes a cell has its first hop by then.
    """
    size, most = len(entry), ranked.shape[1]
    distance, hops = np.empty(size, dtype=np.int64), np.zeros((BLOCK, size), dtype=hop.dtype)
    queue, heap_cell, heap_cost = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int64)
    for begin in range(part * BLOCK, size, parts * BLOCK):
        block = min(BLOCK, size - begin)
        for source in range(begin, begin + block):
            hop_of = hops[source - begin]
            hop_of[:] = 0
            distance[:] = FAR
            distance[source], queue[0] = 0, source
            head, tail, heap_size, now = 0, 1, 0, np.int64(0)
            while True:
                while heap_size > 0 and heap_cost[0] == now:
                    queue[tail] = heap_cell[0]
                    tail += 1
                    heap_size = pop(heap_cost, heap_cell, heap_size)
                layer_end = tail
                while head < layer_end:
                    here = queue[head]
                    head += 1
                    cost[source, here] = now
                    before, known = now - entry[here], False
                    for side in range(4):
                        cell = near[here, side]
                        if cell == NO_CELL:
                            continue
                        if distance[cell] == FAR:
                            distance[cell] = now + entry[cell]
                            if entry[cell] == 1:
                                queue[tail] = cell
                                tail += 1
                            else:
                                heap_size = push(heap_cost, heap_cell, heap_size, now + entry[cell], cell)
                        # Neighbours rise in index, so the first predecessor is the lowest; its own hop is known by
                        # then.
                        elif distance[cell] == before and not known:
                            hop_of[here] = here if cell == source else hop_of[cell]
                            known = True
                if tail > layer_end:
                    now += 1
                elif heap_size > 0:
                    now = heap_cost[0]
                else:
                    break
            first = 0
            while first < min(tail, most):  # cells of one cost, in order of index
                last = first + 1
                while last < tail and distance[queue[last]] == distance[queue[first]]:
                    last += 1
                for place in range(first + 1, last):
                    cell, at = queue[place], place
                    while at > first and queue[at - 1] > cell:
                        queue[at] = queue[at - 1]
                        at -= 1
                    queue[at] = cell
                for place in range(first, min(last, most)):
                    ranked[source, place] = queue[place]
                first = last
        for cell in range(size):
            for row in range(block):
                # Transposed a block at a time: by source, each write would be a line of memory of its own.
                hop[cell, begin + row] = hops[row, cell]


@threaded
def _nearest(part, parts, cost, order, begin, area_cost, area_entry):  # type: ignore[no-untyped-def]
    """Every so many-th row of the tables of areas; among cells of equal cost the first."""
    for source in range(part, len(cost), parts):
        for area in range(len(begin) - 1):
            nearest = order[begin[area]]
            for place in range(begin[area] + 1, begin[area + 1]):
                if cost[source, order[place]] < cost[source, nearest]:
                    nearest = order[place]
            area_cost[source, area], area_entry[source, area] = cost[source, nearest], nearest
