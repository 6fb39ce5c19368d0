"""Teams of robots on a graph: what trails come to, and the search for the best ones by number home."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from analysis.graphs.graph import Graph, Rules
from analysis.graphs.kernel import explore

LONGEST, MOST_BEGUN = 512, 20_000
"""Places of a trail; beginnings of trails up to which all of a graph are looked at."""


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
    rule, known = (graph.base, rules.nodes_once, rules.least_home), _every_trail(graph, rules, longest)
    for turn in range(rounds):
        best = np.maximum.accumulate(np.append(reward[1:], -1.0)[::-1])[::-1]
        new = np.flatnonzero(fresh & (reward > best))
        if not len(new):
            break
        for place in new[:: -1 if turn % 2 else 1].tolist():
            fresh[place] = False
            for ahead in ways:
                explore(place, turn, (chances, ahead, graph.reward, shares), rule, archive, known)
    found = (
        Point(float(reward[place]), float(home[place]), tuple(
            tuple(trails[place, robot, : lengths[place, robot]].tolist()) for robot in range(robots)
        ))
        for place in range(places) if lengths[place, 0]
    )  # fmt: skip
    return efficient(found)


def _every_trail(graph: Graph, rules: Rules, longest: int) -> tuple[NDArray[np.int16], NDArray[np.int64]]:
    """(trails `[T, longest]`, lengths `[T]`): all that leave the base and come back; none where that is too much work.

    Changes along safest ways miss much where arcs lead one way, and there are few trails.
    """
    after = [graph.head[graph.tail == node].tolist() for node in range(len(graph.names))]
    found, begun, seen = list[tuple[int, ...]](), list[tuple[int, ...]]([(graph.base,)]), 0
    while begun:
        trail = begun.pop()
        seen += 1
        if seen > MOST_BEGUN:
            found = []
            break
        gone = {*pairwise(trail)}
        for head in after[trail[-1]]:
            longer = (*trail, head)
            if longer[-2:] in gone or len(longer) >= longest or (rules.nodes_once and head in trail[1:]):
                continue
            if head == graph.base:
                found.append(longer)
            if head != graph.base or not rules.nodes_once:
                begun.append(longer)
    trails = np.zeros((len(found), longest), np.int16)
    for row, trail in zip(trails, found, strict=True):
        row[: len(trail)] = trail
    return trails, np.array([len(trail) for trail in found], np.int64)


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
