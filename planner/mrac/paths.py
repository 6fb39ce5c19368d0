"""Safest paths with their ties, as the planner asks for them: by a search for each question, or from tables.

A path's cost is the sum of the entry costs of its cells, the first one left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.mrac.costs import BLOCKED, neighbour_table
from planner.mrac.far_search import SafeParts, danger_ahead, far_search, find_safe_parts
from planner.mrac.search import NOT_WANTED, TOO_FAR, UNREACHED, search_within, walk_back
from planner.none import NO_CELL

NEAR = 4_000
"""Cells that a search for a target takes before it turns to `far_search`; small maps have fewer."""
TABLE_CELLS = 600
"""Most cells of a map for which costs from each source are kept (3 MB); beyond, each question is searched for."""


class Target(NamedTuple):
    """A nearest target: its cell index and the cost of the safest path to it."""

    cell: int
    cost: int


class SafestPaths:
    """Safest paths by a search for each question: for worlds too large for tables. Memory: about 84 bytes a cell.

    Cells are indices; `[N]` arrays run over the whole grid. `inside` `[N]` limits the cells that a path may enter.
    `near`: cells that a search for a target may take; a target farther off is looked for by `far_search`.
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
        """Cost of the safest path from `source` to every cell, int64 `[N]`; UNREACHED where it is."""
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
        """The cheapest target from `source`, or None. Targets have a rank and are all of one level.

        Ties go to the least rank, then the lowest index. `among`: cells that hold every target, if that is known.
        """
        cell, cost = self._search(source, rank, inside, self.near)
        if cell == TOO_FAR:
            cells = np.flatnonzero(rank != NOT_WANTED) if among is None else among
            cell, cost = self._search_far(source, rank, inside, cells)
        return None if cell == NO_CELL else Target(int(cell), int(cost))

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        """The cells entered on the safest path from `source` (left out) to `target`; it must be reachable."""
        searched = self._last[0] == source and self._last[1] is inside and self._seen[target] == self._stamp
        if not searched or self._found not in (None, target):
            self._find(source, target, inside)
        return walk_back(source, target, self._distance, self._seen, self._stamp, self.neighbours, self.costs)

    def _find(self, source: int, target: int, inside: NDArray[np.bool_] | None) -> None:
        rank = self._no_target.copy()
        rank[target] = 0
        if self.nearest(source, rank, inside, np.array([target])) is None:
            raise ValueError(f"cell {target} cannot be reached from {source}")


class TabledPaths(SafestPaths):
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
        targets = np.flatnonzero((rank != NOT_WANTED) & (to_each != UNREACHED))
        if len(targets) == 0:
            return None
        costs = to_each[targets]
        tied = targets[costs == costs.min()]
        return Target(int(tied[np.argmin(rank[tied])]), int(costs.min()))

    def path(self, source: int, target: int, inside: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
        if inside is not None:
            return super().path(source, target, inside)
        to_each = self.to_all(source)
        return walk_back(source, target, to_each, np.minimum(to_each, 0), 0, self.neighbours, self.costs)


def safest_paths(shape: tuple[int, int], costs: NDArray[np.int64]) -> SafestPaths:
    """Safest paths over a grid with these entry costs `[N]`: kept for small worlds, searched for each time in large."""
    neighbours = neighbour_table(shape, costs != BLOCKED)
    return (TabledPaths if len(costs) <= TABLE_CELLS else SafestPaths)(neighbours, costs)
