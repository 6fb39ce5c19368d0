"""Safest paths with their ties, as the planner asks for them: by a search for each question, or from tables.

A path's cost is the sum of the entry costs of its cells, the first one left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from planner.arguments import check_word
from planner.errors import WorldError
from planner.simulator.codes import NO_CELL
from planner.simulator.searches import BLOCKED, neighbour_table
from planner.world.levels import ThreatLevels, find_levels
from planner.world.world import World

if TYPE_CHECKING:
    import networkx as nx


def entry_costs(levels: ThreatLevels, risk: Literal["paper", "log"], source: str = "") -> NDArray[np.int64]:
    """Cost of entering each cell, int64 `[N]`, BLOCKED where not accessible (eq. (3) times n, rounded).

    Raises WorldError, of `source`, if the sum over all cells, which no path can exceed, might not fit in 62 bits.
    """
    of_level = level_costs(levels.values, levels.of_cell.size, risk)
    counts = np.bincount(levels.of_cell[levels.accessible], minlength=len(of_level))
    if float(of_level @ counts) >= 2.0**62:
        raise WorldError(
            f"threat levels from {levels.values[1]:g} to {levels.values[-1]:g} make path costs too large for 64 bits",
            source=source,
            expected="a ratio of the largest to the smallest threat below about 2**62 / cells**2",
            fix="raise the smallest threats or set them to 0",
        )
    costs = of_level.astype(np.int64)[np.maximum(levels.of_cell, 0)]
    return np.where(levels.accessible, costs, BLOCKED)


def level_costs(values: NDArray[np.float64], n: int, risk: Literal["paper", "log"]) -> NDArray[np.float64]:
    """Cost of entering a cell of each level `[L]`, whole numbers.

    Safe 1; dangerous `floor(n * p / p_min + 0.5)`, or with logarithms of survival for `risk="log"`.
    """
    check_word("risk", risk, ("paper", "log"))
    of_level = np.ones(len(values), dtype=np.float64)
    if len(values) > 1:
        hazard = values[1:] if risk == "paper" else np.log1p(-values[1:])
        of_level[1:] = np.floor(n * hazard / hazard[0] + 0.5)
    return of_level


# The world as a NetworkX graph, for people who go on from there and as the reference for the cost tables.


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
