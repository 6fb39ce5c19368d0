"""The world as a NetworkX graph, for people who go on from there and as the reference for the cost tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.mrac.costs import entry_costs, neighbour_table
from planner.none import NO_CELL
from planner.worlds.levels import find_levels
from planner.worlds.world import World

if TYPE_CHECKING:
    import networkx as nx


def to_networkx(world: World) -> nx.DiGraph:
    """The free cells as a directed graph: nodes (row, col) with `threat` and `pos` (metres).

    An edge into a cell has `cost` after eq. (3), in the integers of SPEC section 3 (no quantisation), and
    `hazard = -log(1 - p)`, the additive form of the survival probability.
    """
    import networkx as nx

    levels = find_levels(world, world.free, most=world.threat.size + 1)
    costs, threat = entry_costs(levels, "paper"), world.threat.ravel()
    free = np.flatnonzero(world.free.ravel())
    name = {int(cell): divmod(int(cell), world.shape[1]) for cell in free}
    points = world.to_xy(free)
    graph = nx.DiGraph(shape=world.shape, cell_size=world.cell_size, origin=world.origin)
    for cell, (x, y) in zip(free.tolist(), points.tolist(), strict=True):
        graph.add_node(name[cell], threat=float(threat[cell]), pos=(x, y))
    for side in neighbour_table(world.shape, world.free.ravel()).T:
        for cell in free[side[free] != NO_CELL].tolist():
            entered = int(side[cell])
            hazard = float(-np.log1p(-np.float64(threat[entered])))
            graph.add_edge(name[cell], name[entered], cost=int(costs[entered]), hazard=hazard)
    return graph
