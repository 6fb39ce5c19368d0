"""Ways: a node is visited no more often than somebody gets to it; how the programme of flow is held to that.

Flow alone lets half a robot enter a region and go round in it twice, and counts every node there as visited once. So a
row is added for a node v and a potential `pi >= 0` of the nodes: with `psi_t = (1 - p_t) pi_t`, but `psi_v = 1`,

    way:  y_v <= sum_u s_u psi_u + sum over moves u -> t, u other than v, of max(0, psi_t - pi_u) x_ut

Proof. Until v is first visited let every robot that lives have the potential of its node. A move u -> t changes it by
`psi_t - pi_u` on average, whatever came before; from then on v counts 1, and potentials no longer matter. So the chance
that v is visited is at most what there is at the start and what the moves before it add, of which there are x at most.

Which potential: the nodes W on the far side of a minimal cut, each with the chance that a robot that is there reaches v
without leaving W, and 0 elsewhere. Then moves into W alone are counted, each with its chance to get to v. Cuts are
found by flow from the starts to v, at most the moves that are survived (what Dantzig, Fulkerson & Johnson's subtours
are to routes). Potentials need not be right for rows to hold: coefficients are rounded upwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from analysis.theory.nodes import ULP, Nodes

UNITS = 2**24
"""Of flow, which is whole; more than one robot's is never needed."""
LEAST = 1e-4
"""What a row has to be violated by."""
MOST = 200
"""Nodes for which a way is sought at a time: those that count most."""


class Spend(NamedTuple):
    """Of a set D, its `members` int64 `[|D|]` spend so much at `most` (`analysis.theory.flow`)."""

    members: NDArray[np.int64]
    most: float


class Way(NamedTuple):
    """`y[node] <= free + share @ x[moves]`; int64 and float64 `[m]`, no less than exact."""

    node: int
    moves: NDArray[np.int64]
    share: NDArray[np.float64]
    free: float


def missing_ways(nodes: Nodes, moves: NDArray[np.float64], visited: NDArray[np.float64]) -> Iterator[Way]:
    """Ways that a solution lacks: expected `moves` `[E]` and `visited` `[V]` that violate them."""
    count, begin = len(nodes.weight), np.flatnonzero(nodes.starts)
    source, target = np.append(nodes.source, np.full(len(begin), count)), np.append(nodes.target, begin)
    passed = 1.0 - nodes.threat
    arriving, surviving = (
        np.append(_whole(each), _whole(nodes.starts * passed)[begin]) for each in (moves, moves * passed[nodes.target])
    )
    counts = nodes.weight * visited * (nodes.starts == 0)
    for node in np.argsort(-counts, kind="stable")[:MOST].tolist():
        if counts[node] <= LEAST:
            break
        room = np.where(target == node, arriving, surviving)
        graph = csr_array((room, (source, target)), shape=(count + 1, count + 1))
        found = maximum_flow(graph, count, node)
        if found.flow_value < (visited[node] - LEAST) * UNITS:
            left = csr_array(graph - found.flow > 0)
            beyond = np.ones(count + 1, dtype=np.bool_)
            beyond[breadth_first_order(left, count, return_predecessors=False)] = False
            way = way_within(nodes, node, beyond[:count])
            if visited[node] - way.free - way.share @ moves[way.moves] > LEAST:
                yield way


def _whole(flow: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.floor(np.clip(flow, 0.0, 1.0) * UNITS).astype(np.int32)


def way_within(nodes: Nodes, node: int, inside: NDArray[np.bool_]) -> Way:
    """The way to a node by moves into the nodes `inside` bool `[V]`, it among them."""
    passed, count = 1.0 - nodes.threat, len(nodes.weight)
    hazard = np.where(nodes.target == node, 0.0, -np.log1p(-nodes.threat)[nodes.target])
    held = inside[nodes.source] & inside[nodes.target]
    backwards = (np.maximum(hazard, np.finfo(float).tiny)[held], (nodes.target[held], nodes.source[held]))
    far = dijkstra(csr_array(backwards, shape=(count, count)), indices=node)
    rank = np.empty(count)
    rank[np.argsort(far, kind="stable")] = np.arange(count)
    potential = np.exp(-far) * (1.0 + 2.0**-46 * rank)  # so that moves along the best way count nothing for certain
    after = passed * potential
    after[node] = 1.0
    more, less = after[nodes.target], potential[nodes.source]
    share = np.where(nodes.source == node, 0.0, np.maximum(more - less + 8 * ULP * (more + less), 0.0))
    entered = np.flatnonzero(share)
    free = float(nodes.starts @ after) * (1.0 + (count + 8) * ULP)
    return Way(node, entered, share[entered], free)
