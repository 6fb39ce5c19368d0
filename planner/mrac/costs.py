"""Eq. (3) made exact: integer entry costs and safest paths with their ties. The only room that knows either.

A path's cost is the sum of the entry costs of its cells, the first one left out. Among targets of equal cost the one
of least rank, then of lowest index, is nearest; among equal-cost paths to one target, walking back from the target,
the predecessor of lowest index is taken (SPEC section 3).
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from planner.arguments import check_word
from planner.errors import WorldError
from planner.jit import compiled, threaded
from planner.mrac.far_search import SafeParts, danger_ahead, far_search, find_safe_parts
from planner.mrac.heap import pop, push
from planner.worlds.levels import ThreatLevels

BLOCKED = 0
"""Entry cost of a cell that cannot be entered."""
NOT_WANTED = -1
"""Rank of a cell that is no target; also the cost of a cell that cannot be reached."""
NOWHERE = -1
TOO_FAR = -2
"""In the place of a nearest target: none was certain within the cells that a search was allowed."""
NEAR = 4_000
"""Cells that a search for a target takes before it turns to `far_search`; small maps have fewer."""
TABLE_CELLS = 600
"""Most cells of a map for which costs from each source are kept (3 MB); beyond, each question is searched for."""


class Target(NamedTuple):
    """A nearest target: its cell index and the cost of the safest path to it."""

    cell: int
    cost: int


def entry_costs(levels: ThreatLevels, risk: Literal["paper", "log"]) -> NDArray[np.int64]:
    """Cost of entering each cell, int64 `[N]`, BLOCKED where not accessible (eq. (3) times n, rounded).

    Safe 1; dangerous `floor(n * p / p_min + 0.5)`, or with logarithms of survival for `risk="log"`.
    Raises WorldError if the sum over all cells, which no path can exceed, might not fit in 62 bits.
    """
    check_word("risk", risk, ("paper", "log"))
    n = levels.of_cell.size
    of_level = np.ones(len(levels.values), dtype=np.float64)
    if len(levels.values) > 1:
        hazard = levels.values[1:] if risk == "paper" else np.log1p(-levels.values[1:])
        of_level[1:] = np.floor(n * hazard / hazard[0] + 0.5)
    counts = np.bincount(levels.of_cell[levels.accessible], minlength=len(of_level))
    if float(of_level @ counts) >= 2.0**62:
        raise WorldError(
            f"threat levels from {levels.values[1]:g} to {levels.values[-1]:g} make path costs too large for 64 bits",
            expected="a ratio of the largest to the smallest threat below about 2**62 / cells**2",
            fix="raise the smallest threats or set them to 0",
        )
    costs = of_level.astype(np.int64)[np.maximum(levels.of_cell, 0)]
    return np.where(levels.accessible, costs, BLOCKED)


def neighbour_table(shape: tuple[int, int], passable: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The passable neighbours of each cell, int32 `[N, 4]` in the order N, W, E, S (rising index), NOWHERE if none."""
    height, width = shape
    index = np.where(passable.reshape(shape), np.arange(height * width, dtype=np.int32).reshape(shape), NOWHERE)
    padded = np.pad(index, 1, constant_values=NOWHERE)
    sides = [padded[:-2, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:], padded[2:, 1:-1]]
    return np.ascontiguousarray(np.stack([side.ravel() for side in sides], axis=1).astype(np.int32))


class SafestPaths(Protocol):
    """What the planner asks of paths. Cells are indices; `[N]` arrays run over the whole grid."""

    neighbours: NDArray[np.int32]

    def to_all(self, source: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """Cost of the safest path from `source` to every cell, int64 `[N]`; -1 where unreachable.

        `inside` `[N]` limits the cells that a path may enter.
        """

    def cost_to(self, source: int, cells: NDArray[np.int64]) -> int:
        """Cost of the safest path from `source` to the cheapest of `cells`, all of one level; -1: none is reachable."""

    def nearest(
        self,
        source: int,
        rank: NDArray[np.int32],
        inside: NDArray[np.bool_] | None = None,
        among: NDArray[np.int64] | None = None,
    ) -> Target | None:
        """The cheapest target from `source`, or None. Targets have `rank >= 0` and are all of one level.

        Ties go to the least rank, then the lowest index. `inside` `[N]` limits the cells that a path may enter.
        `among`: cells that hold every target, if that is known; None = any.
        """

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """The cells entered on the safest path from `source` (left out) to `target`; it must be reachable."""


class SearchedPaths:
    """Safest paths by a search for each question: for worlds too large for tables. Memory: about 80 bytes a cell.

    `near`: cells that a search for a target may take; a target farther off is looked for by `far_search`.
    """

    def __init__(self, neighbours: NDArray[np.int32], costs: NDArray[np.int64], near: int = NEAR) -> None:
        self.neighbours, self.costs, self.near = neighbours, costs, near
        n = len(costs)
        self._everywhere = np.ones(n, dtype=np.bool_)
        self._no_target = np.full(n, NOT_WANTED, dtype=np.int32)
        self._distance, self._seen = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._queue = np.zeros(n, dtype=np.int32)
        self._heap_cost, self._heap_cell = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int32)
        self._stamp = 0
        self._parts: SafeParts | None = None
        self._last: tuple[int, NDArray[np.bool_] | None] = (NOWHERE, None)
        self._found: int | None = None

    def _search(
        self, source: int, rank: NDArray[np.int32], inside: NDArray[np.bool_] | None, most: int
    ) -> tuple[int, int]:
        """`search_within`; afterwards the way to any cell met is known."""
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
        """`far_search`; afterwards the way to what it found is known."""
        if self._parts is None:
            self._parts = find_safe_parts(self.neighbours, self.costs)
        self._stamp += 1
        grid = self.neighbours, self.costs
        heap = self._heap_cost, self._heap_cell
        ahead = danger_ahead(source, rank, among, *grid, self._stamp, *heap, self._parts)
        if ahead < 0:
            return NOWHERE, NOT_WANTED
        if ahead == 0:
            return self._search(source, rank, inside, len(self.costs))
        allowed = self._everywhere if inside is None else inside
        cell, cost = far_search(
            source, rank, allowed, *grid, self._distance, self._seen, self._stamp, self._parts, ahead
        )
        self._found = cell
        return cell, cost

    def to_all(self, source: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        self._search(source, self._no_target, inside, len(self.costs))
        return np.where(self._seen == self._stamp, self._distance, NOT_WANTED)

    def cost_to(self, source: int, cells: NDArray[np.int64]) -> int:
        rank = self._no_target.copy()
        rank[cells] = 0
        target = self.nearest(source, rank, among=cells)
        return NOT_WANTED if target is None else target.cost

    def nearest(
        self,
        source: int,
        rank: NDArray[np.int32],
        inside: NDArray[np.bool_] | None = None,
        among: NDArray[np.int64] | None = None,
    ) -> Target | None:
        cell, cost = self._search(source, rank, inside, self.near)
        if cell == TOO_FAR:
            cells = np.flatnonzero(rank != NOT_WANTED) if among is None else among
            cell, cost = self._search_far(source, rank, inside, cells)
        return None if cell == NOWHERE else Target(int(cell), int(cost))

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        searched = self._last[0] == source and self._last[1] is inside and self._seen[target] == self._stamp
        if not searched or self._found not in (None, target):
            self._find(source, target, inside)
        return _walk_back(source, target, self._distance, self._seen, self._stamp, self.neighbours, self.costs)

    def _find(self, source: int, target: int, inside: NDArray[np.bool_] | None) -> None:
        rank = self._no_target.copy()
        rank[target] = 0
        if self.nearest(source, rank, inside, np.array([target])) is None:
            raise ValueError(f"cell {target} cannot be reached from {source}")


class TabledPaths(SearchedPaths):
    """Safest paths with the costs from each source, int64 `[N]`, kept once they are asked for: for small worlds.

    A question with `inside` is searched each time, since what is kept is of unrestricted paths.
    """

    def __init__(self, neighbours: NDArray[np.int32], costs: NDArray[np.int64]) -> None:
        super().__init__(neighbours, costs)
        self._kept: dict[int, NDArray[np.int64]] = {}

    def to_all(self, source: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        if inside is not None:
            return super().to_all(source, inside)
        if source not in self._kept:
            self._kept[source] = super().to_all(source)
        return self._kept[source]

    def cost_to(self, source: int, cells: NDArray[np.int64]) -> int:
        return int(self.to_all(source)[cells].min())

    def nearest(
        self,
        source: int,
        rank: NDArray[np.int32],
        inside: NDArray[np.bool_] | None = None,
        among: NDArray[np.int64] | None = None,
    ) -> Target | None:
        if inside is not None:
            return super().nearest(source, rank, inside, among)
        to_each = self.to_all(source)
        targets = np.flatnonzero((rank != NOT_WANTED) & (to_each != NOT_WANTED))
        if len(targets) == 0:
            return None
        costs = to_each[targets]
        tied = targets[costs == costs.min()]
        return Target(int(tied[np.argmin(rank[tied])]), int(costs.min()))

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        if inside is not None:
            return super().path(source, target, inside)
        to_each = self.to_all(source)
        return _walk_back(source, target, to_each, np.minimum(to_each, 0), 0, self.neighbours, self.costs)


def safest_paths(shape: tuple[int, int], costs: NDArray[np.int64]) -> SafestPaths:
    """Safest paths over a grid with these entry costs `[N]`: kept for small worlds, searched for each time in large."""
    neighbours = neighbour_table(shape, costs != BLOCKED)
    return (TabledPaths if len(costs) <= TABLE_CELLS else SearchedPaths)(neighbours, costs)


@threaded
def search(source, rank, inside, neighbours, costs, distance, seen, stamp, queue, heap_cost, heap_cell):  # type: ignore[no-untyped-def]
    """`search_within` any number of cells: always certain."""
    return search_within(
        source, rank, inside, neighbours, costs, distance, seen, stamp, queue, heap_cost, heap_cell, len(costs)
    )


@threaded
def search_within(source, rank, inside, neighbours, costs, distance, seen, stamp, queue, heap_cost, heap_cell, most):  # type: ignore[no-untyped-def]
    """Dijkstra from `source` until the nearest target is certain; `distance[v]` is final where `seen[v] == stamp`.

    Costs sit on the cells entered, so the first time a cell is met its distance is final: each is queued once. Cells
    one unit away (safe ones) go through a queue in layers, the others through a heap. (TOO_FAR, -1) as soon as more
    than `most` cells have gone through the queue.
    """
    distance[source], seen[source] = 0, stamp
    if rank[source] != -1:
        return source, 0
    best, best_cost, target_cost = -1, np.int64(-1), np.int64(0)
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
                if cell == -1 or seen[cell] == stamp or not inside[cell]:
                    continue
                seen[cell] = stamp
                cost = now + costs[cell]
                distance[cell] = cost
                if rank[cell] != -1 and (
                    best == -1
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
        if best != -1 and now + target_cost > best_cost:
            return best, best_cost
        if head > most:
            return TOO_FAR, np.int64(-1)


@compiled
def _walk_back(source, target, distance, seen, stamp, neighbours, costs):  # type: ignore[no-untyped-def]
    """The cells of the safest path after `source`, in driving order, by the lowest-index predecessor."""
    length, here = 0, target
    path = np.empty(64, dtype=np.int64)
    while here != source:
        if length == len(path):
            longer = np.empty(2 * length, dtype=np.int64)
            longer[:length] = path
            path = longer
        path[length] = here
        length += 1
        before = distance[here] - costs[here]
        for side in range(4):
            cell = neighbours[here, side]
            if cell != -1 and seen[cell] == stamp and distance[cell] == before:
                here = cell
                break
    return path[:length][::-1].copy()


@threaded
def first_hops(source, cost, by_cost, neighbours, costs, hops):  # type: ignore[no-untyped-def]
    """Write the first cell of the safest path from `source` to each reachable cell into `hops` `[N]`.

    `cost` `[N]`: of the safest paths, -1 where unreachable; `by_cost`: the cells in rising order of it.
    """
    for cell in by_cost:
        if cost[cell] < 0 or cell == source:
            continue
        for side in range(4):
            before = neighbours[cell, side]
            if before != -1 and cost[before] != -1 and cost[before] == cost[cell] - costs[cell]:
                hops[cell] = cell if before == source else hops[before]
                break
