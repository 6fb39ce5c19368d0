"""The best that any strategy can do, exactly, on tiny worlds: what policies and bounds answer to.

Expected cells visited under a strategy that sees everything (which robots live, where they stand, what is visited) and
decides as it goes. Robots may as well move one at a time, the others waiting: there is no limit of time, and who moves
later knows more. Moves inside a safe area are free, so the nodes are those of `analysis.theory.nodes`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.theory.nodes import Nodes, contract
from planner.worlds.world import World, check_starts

MOST_TO_VISIT = {1: 14, 2: 10}
"""Nodes without a start that a world may have, by the number of robots: up to 2 to their power sets; a second or so."""


def optimum(world: World, starts: ArrayLike) -> float | None:
    """The greatest expected number of cells visited, for robots at `starts` `[K, 2]`.

    None for more robots or a larger world than MOST_TO_VISIT has. Dynamic programming from all nodes visited
    backwards: with the set of visited nodes fixed, values rise until no move raises one. Cost: as MOST_TO_VISIT says.
    """
    checked = check_starts(starts, world.threat, world.source)
    nodes = contract(world, checked)
    unvisited = np.flatnonzero(nodes.starts == 0)
    if len(unvisited) > MOST_TO_VISIT.get(len(checked), -1):
        return None
    beside = [set(nodes.target[nodes.source == node].tolist()) for node in range(len(nodes.weight))]
    begun = frozenset(np.flatnonzero(nodes.starts).tolist())
    layers = [{begun}]
    while layers[-1]:
        layers.append({had | {new} for had in layers[-1] for new in set().union(*(beside[v] for v in had)) - had})
    values: dict[frozenset[int], NDArray[np.float64]] = {}
    for layer in reversed(layers):
        values = {visited: _with_visited(nodes, visited, values) for visited in layer}
    at = np.repeat(np.arange(len(nodes.starts)), nodes.starts).tolist()
    return _enter(values[begun], nodes, at)


def _enter(value: NDArray[np.float64], nodes: Nodes, at: list[int]) -> float:
    """The mean of `value` `[V + 1, ...]` over who survives the start nodes `at`; place V of an axis: stopped."""
    for node in at:
        value = value[node] - nodes.threat[node] * (value[node] - value[-1])
    return float(value)


def _with_visited(
    nodes: Nodes, visited: frozenset[int], more: dict[frozenset[int], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """The value of every place of the robots, `[V + 1, ...]` an axis a robot, once these nodes are visited.

    `more`: the same with one node more visited.
    """
    count, team = len(nodes.weight), int(nodes.starts.sum())
    best = np.full((count + 1,) * team, float(nodes.weight[list(visited)].sum()))
    new = [v for v in range(count) if v not in visited and visited | {v} in more]
    while True:
        before = best.copy()
        for robot in range(team):
            moved, here = np.moveaxis(best, robot, 0), np.moveaxis(best.copy(), robot, 0)
            for v in (*visited, *new):
                there = here if v in visited else np.moveaxis(more[visited | {v}], robot, 0)
                gain = there[v] - nodes.threat[v] * (there[v] - there[count])  # rounding raises none
                beside = nodes.source[nodes.target == v]
                moved[beside] = np.maximum(moved[beside], gain)
        if (best == before).all():
            return best
