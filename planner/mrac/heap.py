"""A binary heap of (cost, cell) in two arrays, for the compiled searches."""

from __future__ import annotations

from planner.jit import threaded


@threaded
def push(heap_cost, heap_cell, size, cost, cell):  # type: ignore[no-untyped-def]
    """Add a cell to a heap of `size`; returns the new size."""
    child = size
    while child > 0:
        parent = (child - 1) >> 1
        if heap_cost[parent] <= cost:
            break
        heap_cost[child], heap_cell[child] = heap_cost[parent], heap_cell[parent]
        child = parent
    heap_cost[child], heap_cell[child] = cost, cell
    return size + 1


@threaded
def pop(heap_cost, heap_cell, size):  # type: ignore[no-untyped-def]
    """Take the first off a heap of `size`, having read it; returns the new size."""
    size -= 1
    cost, cell = heap_cost[size], heap_cell[size]
    parent = 0
    while True:
        child = 2 * parent + 1
        if child >= size:
            break
        if child + 1 < size and heap_cost[child + 1] < heap_cost[child]:
            child += 1
        if heap_cost[child] >= cost:
            break
        heap_cost[parent], heap_cell[parent] = heap_cost[child], heap_cell[child]
        parent = child
    heap_cost[parent], heap_cell[parent] = cost, cell
    return size
