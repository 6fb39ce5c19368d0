"""The map as an order of targets sees it: dangerous cells, and safe areas in which every move is free."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from planner.errors import PlanError
from planner.ids import NO_CELL
from planner.mrac.areas import coverage_path
from planner.mrac.paths import neighbour_table
from planner.mrac.problem import Problem
from planner.policies.rules import NEAREST
from planner.world.world import FOUR_NEIGHBOURS, World

MOST_NODES = 6_000
"""Nodes of the largest map: the tables of safest ways take 16 bytes a pair of them while they are made, then 4."""
HOP = 1e-9
"""Added to the hazard of every move, so that of equally safe ways the one with fewer nodes is taken."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Axes: `V` nodes, `N` cells. A safe area is a 4-connected set of accessible cells with p = 0.

    Attributes:
        areas: safe areas; they are the first nodes. of_cell: int64 `[N]`, the cell's node; NO_CELL if not accessible.
        cells: of each node, increasing.
        passed: float64 `[V]`, chance to survive one visit. weight: float64 `[V]`, cells; or what they are
            worth, in values of a mean cell.
        towards: int32 `[V, V]`, `[t, u]`: the node after u on the safest way from u to t; negative: none.
    """

    areas: int
    of_cell: NDArray[np.int64]
    cells: tuple[NDArray[np.int64], ...]
    passed: NDArray[np.float64]
    weight: NDArray[np.float64]
    towards: NDArray[np.int32]

    def order_of(self, path: NDArray[np.int64], first: NDArray[np.int64]) -> NDArray[np.int64]:
        """The nodes of `first`, then those that the cells of `path` are in: each once, in order."""
        nodes = np.concatenate([first, self.of_cell[path]])
        return nodes[np.sort(np.unique(nodes, return_index=True)[1])]

    def drive(self, order: NDArray[np.int64], start: int, problem: Problem) -> NDArray[np.int64]:
        """The cells, int64 `[steps + 1]`, of a robot at cell `start` that goes to the nodes in this order.

        It takes the safest ways; nodes that it passed on them are no targets any more. A safe area is covered when it
        is first entered.
        """
        paths = problem.paths
        legs, here, before, seen = [np.array([start], dtype=np.int64)], start, self.of_cell[start], set()
        for node in self._way(order, int(self.of_cell[start])):
            inside = np.zeros(len(self.of_cell), dtype=np.bool_)
            inside[self.cells[before]] = inside[self.cells[node]] = True
            before, target = node, int(self.cells[node][0])
            if node < self.areas:
                to_do = self.cells[node][:0] if node in seen else self.cells[node]
                leg = coverage_path(paths, here, to_do, inside, NEAREST, problem.sides)
            else:
                leg = paths.path(here, target, inside) if here != target else self.cells[node][:0]
            seen.add(node)
            if len(leg):
                legs.append(leg)
                here = int(leg[-1])
        return np.concatenate(legs)

    def _way(self, order: NDArray[np.int64], here: int) -> Iterator[int]:
        """The nodes entered, `here` first."""
        seen = {here}
        yield here
        for target in order.tolist():
            while target not in seen:
                here = int(self.towards[target, here])
                seen.add(here)
                yield here


def make_nodes(world: World, accessible: NDArray[np.bool_]) -> Nodes:
    """The nodes of the `accessible` `[H, W]` part of a world. Raises PlanError if there are more than MOST_NODES."""
    safe = accessible & (world.threat == 0)
    label, areas = ndimage.label(safe, structure=FOUR_NEIGHBOURS)
    of_cell = label.astype(np.int64).ravel() - 1
    dangerous = np.flatnonzero(accessible & ~safe)
    of_cell[dangerous] = areas + np.arange(len(dangerous))
    count = areas + len(dangerous)
    if count > MOST_NODES:
        raise PlanError(
            f"{len(dangerous)} dangerous cells and {areas} safe areas are too many to plan for the open loop",
            source=world.source,
            expected=f"at most {MOST_NODES} together",
            fix="coarsen the map with cell_size, or leave plan_for out",
        )
    flat = np.flatnonzero(accessible)
    passed = np.ones(count)
    passed[areas:] = 1.0 - world.threat.ravel()[dangerous].astype(np.float64)
    near = neighbour_table(world.shape, accessible.ravel())[flat]
    place, side = np.nonzero(near != NO_CELL)
    pairs = np.unique(np.stack([of_cell[flat[place]], of_cell[near[place, side]]], axis=1), axis=0)
    source, target = pairs[pairs[:, 0] != pairs[:, 1]].T
    hazard = HOP - np.log(passed)
    # backwards: what comes before u on the way back from t is what comes after u on the way to t
    back = coo_array((hazard[target], (target, source)), shape=(count, count)).tocsr()
    order = np.argsort(of_cell[flat], kind="stable")
    cells = tuple(np.split(flat[order], np.cumsum(np.bincount(of_cell[flat], minlength=count))[:-1]))
    towards = dijkstra(back, return_predecessors=True)[1].astype(np.int32)
    weight = np.array([float(len(c)) for c in cells])
    if world.value is not None and world.value[accessible].any():
        value = world.value.ravel() / world.value[accessible].mean()
        weight = np.array([value[c].sum() for c in cells])
    return Nodes(areas, of_cell, cells, passed, weight, towards)
