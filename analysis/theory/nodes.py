"""A world as bounds for every strategy see it: dangerous cells, and safe areas in which moves are free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.theory.own_bounds import reach_chances
from planner.mrac.costs import neighbour_table
from planner.none import NO_CELL
from planner.worlds.world import FOUR_NEIGHBOURS, World

ULP = 2.0**-52


@dataclass(frozen=True, eq=False)
class Nodes:
    """A world as the programme sees it. Axes: `V` nodes, `E` pairs of nodes side by side, each in both directions.

    Attributes:
        weight: float64 `[V]`, cells, or no less than what they are worth. threat: float64 `[V]`.
        starts: int64 `[V]`, robots that start there.
        reach: float64 `[V]`, no less than the chance that a cell of the node can be given to be visited.
        source, target: int64 `[E]`, a move.
    """

    weight: NDArray[np.float64]
    threat: NDArray[np.float64]
    starts: NDArray[np.int64]
    reach: NDArray[np.float64]
    source: NDArray[np.int64]
    target: NDArray[np.int64]

    @property
    def robots(self) -> int:
        """k."""
        return int(self.starts.sum())


def contract(world: World, starts: NDArray[np.int64], value: NDArray[np.float64] | None = None) -> Nodes:
    """The nodes of the accessible part of `world`; `value`: float64 `[H, W]`, of its cells, None: 1 each."""
    accessible = world.accessible(starts)
    safe = accessible & (world.threat == 0)
    node, areas = ndimage.label(safe, structure=FOUR_NEIGHBOURS)
    node = node.astype(np.int64) - 1
    dangerous = accessible & ~safe
    node[dangerous] = areas + np.arange(int(dangerous.sum()))
    node, flat = node.ravel(), accessible.ravel()
    count = areas + int(dangerous.sum())
    near = neighbour_table(world.shape, flat)
    cell, side = np.nonzero((near != NO_CELL) & flat[:, None])
    pairs = np.unique(np.stack([node[cell], node[near[cell, side]]], axis=1), axis=0)
    source, target = pairs[pairs[:, 0] != pairs[:, 1]].T
    threat, reach = np.zeros(count), np.zeros(count)
    threat[node[dangerous.ravel()]] = world.threat.ravel()[dangerous.ravel()]
    np.maximum.at(reach, node[flat], reach_chances(world, starts)[flat])
    slack = len(starts) * (world.threat.size + 64) * ULP  # of sums of hazards, and of one product a robot
    worth = np.ones(world.threat.size) if value is None else value.ravel()
    weight = np.bincount(node[flat], worth[flat], count).astype(np.float64)
    if value is not None:
        weight *= 1.0 + world.threat.size * ULP  # of sums
    begin = node[starts[:, 0] * world.shape[1] + starts[:, 1]]
    return Nodes(
        weight=weight,
        threat=threat,
        starts=np.bincount(begin, minlength=count),
        reach=np.minimum(reach + slack, 1.0),
        source=source,
        target=target,
    )
