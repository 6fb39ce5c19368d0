"""Safest paths on a grid with their ties, by searches, and coverage paths.

The cost of a path is the sum of the entry costs of its cells, the first cell excluded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.simulator.codes import BLOCKED

from .codes import NO_CELL
from .jit import host_search, kernel, threaded

# Eq. (3) with integer entry costs, and the neighbours in the grid of safest paths (SPEC section 3).


def neighbour_table(shape: tuple[int, int], passable: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The passable neighbours of each cell.

    Args:
        shape: (H, W).
        passable: bool `[N]`.

    Returns:
        int32 `[N, 4]` in the order N, W, E, S; NO_CELL where there is none.
    """
    height, width = shape
    padded = np.full((height + 2, width + 2), NO_CELL, dtype=np.int32)
    padded[1:-1, 1:-1] = np.where(passable, np.arange(height * width), NO_CELL).reshape(shape)
    sides = [padded[:-2, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:], padded[2:, 1:-1]]
    return np.stack(sides, axis=2).reshape(-1, 4)


def neighbour_pairs(shape: tuple[int, int], passable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """All pairs of neighbouring passable cells, as of `neighbour_table`: the cells, and a neighbour of each."""
    near = neighbour_table(shape, passable)
    cell, side = np.nonzero((near != NO_CELL) & passable[:, None])
    return cell, near[cell, side]


# A binary heap of (cost, cell) in two arrays, for compiled searches.


@kernel
def push(heap_cost, heap_cell, size, cost, cell):  # type: ignore[no-untyped-def]
    """Add a cell to a heap of `size` elements; returns the new size."""
    child = size
    while child > 0:
        parent = (child - 1) >> 1
        if heap_cost[parent] <= cost:
            break
        heap_cost[child], heap_cell[child] = heap_cost[parent], heap_cell[parent]
        child = parent
    heap_cost[child], heap_cell[child] = cost, cell
    return size + 1


@kernel
def pop(heap_cost, heap_cell, size):  # type: ignore[no-untyped-def]
    """Remove the first element of a heap of `size` elements; returns the new size."""
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


# The compiled search for safest paths of `SafestPaths`.
#
# Of targets of equal cost the one of least rank, then of lowest index, is nearest. Of paths of equal cost to one target
# the predecessor of lowest index is taken at each cell, backwards from the target (SPEC section 3).

NOT_WANTED = -1
"""Rank of a cell that is not a target."""
UNREACHED = -1
"""Cost of a cell that cannot be reached."""
TOO_FAR = -2
"""Result instead of a nearest target: none was certain within the allowed number of cells."""


@host_search
def search_within(source, rank, inside, neighbours, costs, distance, seen, stamp, queue, heap_cost, heap_cell, most):  # type: ignore[no-untyped-def]
    """Dijkstra's algorithm from `source` until the nearest target is certain.

    Costs belong to the cell entered, so the distance of a cell is final when it is first met: each is queued once.
    Cells of cost 1 (safe ones) go through a layered queue, the others through a heap.

    Args:
        source: a cell.
        rank: int32 `[N]`, NOT_WANTED for cells that are not targets.
        inside: bool `[N]`, cells that may be entered.
        neighbours: int32 `[N, 4]`, NO_CELL if none.
        costs: int64 `[N]`, entry costs.
        distance: int64 `[N]`, results: final where `seen` is `stamp`.
        seen: int64 `[N]`; stamp: the number of this search.
        queue, heap_cost, heap_cell: `[N]`, scratch.
        most: cells that may go through the queue.

    Returns:
        (cell, cost) of the nearest target; NO_CELL if none is reachable, TOO_FAR if more than `most` cells were needed.
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


@host_search
def walk_back(source, target, distance, seen, stamp, neighbours, costs):  # type: ignore[no-untyped-def]
    """The cells of the safest path after `source`, in order, by predecessors of lowest index; int64 `[steps]`."""
    length, here = 0, target
    path = np.empty(64, dtype=np.int64)
    while here != source:
        if length == len(path):
            path = np.append(path, np.empty(length, dtype=np.int64))
        path[length] = here
        length += 1
        before = distance[here] - costs[here]
        for side in range(4):
            cell = neighbours[here, side]
            if cell != NO_CELL and seen[cell] == stamp and distance[cell] == before:
                here = cell
                break
    return path[:length][::-1].copy()


# The nearest target if it is far: a search that knows how much danger still lies ahead.
#
# A dangerous cell costs more than all safe ones, so a plain search explores the whole safe part of the map around it
# before it passes a second dangerous cell. Here a search backwards from the targets, with every component of safe cells
# as one node of cost 0, finds the danger to go. A* with that as its potential then spends time on safe steps only. If
# the backward search is ended early, its last cost is the potential: a lower bound that keeps A* exact. Results, ties
# and paths equal those of `SafestPaths`.


class SafeParts(NamedTuple):
    """The map with each connected component of safe cells as one node. Axes: `N` cells, `B` cells at borders.

    Attributes:
        node: int32 `[N]`, the lowest cell of a safe cell's component; for a dangerous cell the cell itself.
        begin, border: int32 `[N + 1]`, `[B]`: the dangerous cells next to component v are
            `border[begin[v] : begin[v + 1]]`.
        wide: number of dangerous cells around a component from which on a search from danger ends there.
        to_go, touched: int64 `[N]`, of each node: least danger to a target, and the search that found it.
    """

    node: NDArray[np.int32]
    begin: NDArray[np.int32]
    border: NDArray[np.int32]
    wide: int
    to_go: NDArray[np.int64]
    touched: NDArray[np.int64]


def find_safe_parts(neighbours: NDArray[np.int32], costs: NDArray[np.int64], wide: int = 1_000) -> SafeParts:
    """Find the safe components of a map.

    Args:
        neighbours: int32 `[N, 4]`, NO_CELL if none.
        costs: int64 `[N]`, entry costs.
        wide: as in `SafeParts`.
    """
    n = len(costs)
    node = _label(neighbours, costs)
    nodes_around = node[neighbours]
    counts = (costs[:, None] > 1) & (neighbours >= 0) & (costs[neighbours] == 1)
    cell = np.broadcast_to(np.arange(n)[:, None], counts.shape)[counts]
    pairs = np.unique(nodes_around[counts].astype(np.int64) * n + cell)
    begin = np.searchsorted(pairs, np.arange(n + 1) * n).astype(np.int32)
    return SafeParts(node, begin, (pairs % n).astype(np.int32), wide, np.zeros(n, np.int64), np.zeros(n, np.int64))


@host_search
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
    """Search backwards from the targets until the source is met.

    A node is queued by the danger that it adds for the nodes before it, so its value is final when it is first met.
    From a dangerous source the search ends at the first wide component.

    Args:
        source: a cell, no target.
        rank: int32 `[N]`, NOT_WANTED for cells that are not targets.
        among: cells that include all targets.
        neighbours, costs, stamp, heap_cost, heap_cell: as in `search_within`.
        parts: SafeParts; `to_go` and `touched` are results.

    Returns:
        A lower bound on the danger to go from any node not met; UNREACHED if no target can be reached.
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
    """The nearest target and its cost as by `search_within`, NO_CELL if there is none, after `danger_ahead`.

    A* with the danger to go, at most `ahead`, as its potential, until all cells as cheap as the answer are settled.
    Cost plus potential never falls along a path and mostly rises by 0 or 1. So the cells of the present and the next
    value are lists, all others are in a heap. `distance` is final only on safest paths to the answer. TOO_FAR if a cell
    that was queued again found no room in `layer`, `later` or the heap.
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
                continue  # queued before a cheaper path was found
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


NEAR = 4_000
"""Cells that a search for a target may pass before `far_search` takes over; small maps have fewer."""


class Target(NamedTuple):
    """A nearest target: its cell index and the cost of the safest path to it."""

    cell: int
    cost: int


class SafestPaths:
    """Safest paths by searches. Memory: about 84 bytes per cell.

    Cells are indices; `[N]` arrays run over the whole grid. `inside`, bool `[N]`, limits the cells that a path may
    enter.

    Args:
        neighbours: int32 `[N, 4]`, NO_CELL if none.
        costs: int64 `[N]`, entry costs.
        near: cells that a search may pass before `far_search` takes over.
    """

    def __init__(self, neighbours: NDArray[np.int32], costs: NDArray[np.int64], near: int = NEAR) -> None:
        self.neighbours, self.costs, self.near = neighbours, costs, near
        n = len(costs)
        self._everywhere = np.ones(n, dtype=np.bool_)
        self._no_target = np.full(n, NOT_WANTED, dtype=np.int32)
        self._distance, self._seen = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._queue, self._later = np.zeros(n, dtype=np.int32), np.zeros(n, dtype=np.int32)
        self._heap_cost, self._heap_cell = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int32)
        self._stamp = 0
        self._parts: SafeParts | None = None
        self._last: tuple[int, NDArray[np.bool_] | None] = (NO_CELL, None)
        self._found: int | None = None

    def _search(
        self, source: int, rank: NDArray[np.int32], inside: NDArray[np.bool_] | None, most: int
    ) -> tuple[int, int]:
        """`search_within`; afterwards the path to each cell met is known."""
        self._stamp += 1
        self._last, self._found = (source, inside), None
        return search_within(
            source,
            rank,
            self._everywhere if inside is None else inside,
            self.neighbours,
            self.costs,
            self._distance,
            self._seen,
            self._stamp,
            self._queue,
            self._heap_cost,
            self._heap_cell,
            most,
        )

    def _search_far(
        self, source: int, rank: NDArray[np.int32], inside: NDArray[np.bool_] | None, among: NDArray[np.int64]
    ) -> tuple[int, int]:
        """`far_search`; afterwards the path to its result is known."""
        if self._parts is None:
            self._parts = find_safe_parts(self.neighbours, self.costs)
        self._stamp += 1
        grid = self.neighbours, self.costs
        heap = self._heap_cost, self._heap_cell
        ahead = danger_ahead(source, rank, among, *grid, self._stamp, *heap, self._parts)
        if ahead < 0:
            return NO_CELL, UNREACHED
        if ahead > 0:
            allowed = self._everywhere if inside is None else inside
            met = self._distance, self._seen, self._stamp
            lists = self._queue, self._later
            cell, cost = far_search(source, rank, allowed, *grid, *met, *heap, *lists, self._parts, ahead)
            self._found = cell
            if cell != TOO_FAR:
                return cell, cost
        return self._search(source, rank, inside, len(self.costs))

    def to_all(self, source: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """Cost of the safest path from `source` to every cell, int64 `[N]`; UNREACHED where there is none.

        Args:
            source: a cell.
            inside: bool `[N]`, cells that may be entered; None: all.
        """
        self._search(source, self._no_target, inside, len(self.costs))
        return np.where(self._seen == self._stamp, self._distance, UNREACHED)

    def cost_to(self, source: int, cells: NDArray[np.int64]) -> int:
        """Cost of the safest path from `source` to the cheapest of `cells`, all of one level, or UNREACHED."""
        rank = self._no_target.copy()
        rank[cells] = 0
        target = self.nearest(source, rank, among=cells)
        return UNREACHED if target is None else target.cost

    def nearest(
        self,
        source: int,
        rank: NDArray[np.int32],
        inside: NDArray[np.bool_] | None = None,
        among: NDArray[np.int64] | None = None,
    ) -> Target | None:
        """The cheapest target, or None. All targets have one level; ties go to the least rank, then the lowest index.

        Args:
            source: a cell.
            rank: int32 `[N]`, NOT_WANTED for cells that are not targets.
            inside: bool `[N]`, cells that may be entered; None: all.
            among: cells that include all targets, if known.
        """
        cell, cost = self._search(source, rank, inside, self.near)
        if cell == TOO_FAR:
            cells = np.flatnonzero(rank != NOT_WANTED) if among is None else among
            cell, cost = self._search_far(source, rank, inside, cells)
        return None if cell == NO_CELL else Target(int(cell), int(cost))

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """The cells entered on the safest path from `source` (excluded) to `target`, int64 `[steps]`.

        Args:
            source, target: cells; the target must be reachable.
            inside: bool `[N]`, cells that may be entered; None: all.

        Raises:
            ValueError: the target cannot be reached.
        """
        searched = self._last[0] == source and self._last[1] is inside and self._seen[target] == self._stamp
        if not searched or self._found not in (None, target):
            self._find(source, target, inside)
        return walk_back(source, target, self._distance, self._seen, self._stamp, self.neighbours, self.costs)

    def _find(self, source: int, target: int, inside: NDArray[np.bool_] | None) -> None:
        rank = self._no_target.copy()
        rank[target] = 0
        if self.nearest(source, rank, inside, np.array([target])) is None:
            raise ValueError(f"cell {target} cannot be reached from {source}")


def safest_paths(shape: tuple[int, int], costs: NDArray[np.int64]) -> SafestPaths:
    """Safest paths over a grid.

    Args:
        shape: (H, W).
        costs: int64 `[N]`, entry costs; BLOCKED for cells that cannot be entered.
    """
    return SafestPaths(neighbour_table(shape, costs != BLOCKED), costs)


# Algorithm 3, the modified GAC: cover the rest of an area, nearest cell first.


def coverage_path(
    paths: SafestPaths, here: int, to_do: NDArray[np.int64], inside: NDArray[np.bool_] | None, sides: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The cells entered, in order, to visit every cell of `to_do` from `here` (excluded).

    Repeatedly takes the cheapest cell to do from the end of the last leg, by the safest path.

    Args:
        paths: the safest paths of the world.
        here: the robot's cell.
        to_do: int64 `[cells]`, the area's unvisited cells, reachable from `here`.
        inside: bool `[N]`, cells that legs may enter (`transit="area"`), or None for all.
        sides: int64 `[N, 4]`, the priority of each cell's sides (`planner.mrac.areas`).

    Returns:
        int64 `[steps]`.

    Source: paper, Algorithm 3; ties of SPEC sections 3 and 5.
    """
    rank = np.full(len(paths.neighbours), NOT_WANTED, dtype=np.int32)
    rank[to_do] = 0
    rank[here] = NOT_WANTED
    left = int(np.count_nonzero(rank != NOT_WANTED))
    path = [np.empty(0, dtype=np.int64)]
    while left:
        leg = _cheapest_legs(paths, here, rank, inside, to_do, sides)
        left -= int(np.count_nonzero(rank[leg] != NOT_WANTED))
        rank[leg] = NOT_WANTED
        path.append(leg)
        here = int(leg[-1])
    return np.concatenate(path)


def _cheapest_legs(
    paths: SafestPaths,
    here: int,
    rank: NDArray[np.int32],
    inside: NDArray[np.bool_] | None,
    to_do: NDArray[np.int64],
    sides: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Legs to the cheapest cells: adjacent ones as long as there are any; if there is none, one leg by a search.

    The cells are of one level, so an adjacent cell is always cheapest.
    """
    adjacent = _adjacent_run(here, rank, paths.neighbours, sides, len(to_do))
    if len(adjacent):
        return adjacent
    target = paths.nearest(here, rank, inside, to_do)
    if target is None:
        raise ValueError(f"cells to cover cannot be reached from cell {here}")
    return paths.path(here, target.cell, inside)


@host_search
def _adjacent_run(here, rank, neighbours, sides, most):  # type: ignore[no-untyped-def]
    """From cell to adjacent cell of rank 0, by `sides`, until there is none or after `most`; int64 `[legs]`."""
    run, length = np.empty(most, dtype=np.int64), 0
    while length < most:
        after = NO_CELL
        for place in range(4):
            cell = neighbours[here, sides[here, place]]
            if cell != NO_CELL and rank[cell] == 0:
                after = cell
                break
        if after == NO_CELL:
            break
        here = after
        rank[here] = NOT_WANTED
        run[length] = here
        length += 1
    run = run[:length].copy()
    rank[run] = 0
    return run


# Priority of the cells next to a robot if all of them are to do: it makes coverage paths straight.

BY_INDEX, BY_ROW, BY_COLUMN = (0, 1, 2, 3), (1, 2, 0, 3), (0, 3, 1, 2)
"""Orders of sides: 0 north, 1 west, 2 east, 3 south."""
