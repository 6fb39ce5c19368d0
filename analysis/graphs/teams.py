"""Teams of robots on a graph: what trails come to, and the search for the best ones by number home."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from analysis.graphs.graph import Graph, Rules
from analysis.graphs.kernel import explore

LONGEST = 512
"""Places of a trail."""


class Point(NamedTuple):
    """A plan: expected reward, expected robots home, a trail for each robot as places of nodes."""

    reward: float
    home: float
    trails: tuple[tuple[int, ...], ...]


def search(graph: Graph, robots: int, rules: Rules, places: int, rounds: int) -> list[Point]:
    """The best plans found, none beaten by another in reward and robots home; by robots home, fewest first.

    `places`: of the archive. `rounds`: times at most that all changes of all new plans are looked at.
    """
    chances, count = graph.chances(), len(graph.names)
    longest = min(len(graph.tail) + 2, 6 * count + 2, LONGEST)
    trails, lengths = np.zeros((places, robots, longest), np.int16), np.zeros((places, robots), np.int64)
    reward, home, fresh = np.full(places, -1.0), np.zeros(places), np.zeros(places, np.bool_)
    trails[-1, :, 0], lengths[-1], home[-1], fresh[-1] = graph.base, 1, robots, True
    reward[-1] = graph.reward[graph.base] * sum(graph.visits[:robots])
    archive = (trails, lengths, reward, home, fresh)
    safest, shares = _ahead(graph), np.array(graph.visits)
    ways = [safest]
    if rules.nodes_once:  # the safest ways soon cross where the robot was: arcs, where there are any, do not
        ways.append(np.where(chances > 0, np.arange(count), safest).astype(np.int16))
    rule = (graph.base, rules.nodes_once, rules.least_home)
    for turn in range(rounds):
        best = np.maximum.accumulate(np.append(reward[1:], -1.0)[::-1])[::-1]
        new = np.flatnonzero(fresh & (reward > best))
        if not len(new):
            break
        for place in new[:: -1 if turn % 2 else 1].tolist():
            fresh[place] = False
            for ahead in ways:
                explore(place, turn, (chances, ahead, graph.reward, shares), rule, archive)
    found = (
        Point(float(reward[place]), float(home[place]), tuple(
            tuple(trails[place, robot, : lengths[place, robot]].tolist()) for robot in range(robots)
        ))
        for place in range(places) if lengths[place, 0]
    )  # fmt: skip
    return efficient(found)


def _ahead(graph: Graph) -> NDArray[np.int16]:
    """The next node `[V, V]` on the safest way from a node to another; -1: there is none."""
    before = dijkstra(graph.hazards().T, return_predecessors=True)[1]  # from every target along the arcs backwards
    return np.where(before.T >= 0, before.T, -1).astype(np.int16)


def efficient(points: Iterable[Point]) -> list[Point]:
    """Those that no other beats, fewest home first."""
    kept = list[Point]()
    for point in sorted(points, key=lambda one: (-one.home, -one.reward)):
        if not kept or point.reward > kept[-1].reward:
            kept.append(point)
    return kept[::-1]


def area(points: Iterable[Point], total: float, robots: int) -> float:
    """The share of (`total` reward) x (`robots` home) that is below the points: the union of their rectangles."""
    found, before = 0.0, 0.0
    for point in efficient(points)[::-1]:
        found += (point.reward - before) * point.home
        before = point.reward
    return found / (total * robots)
