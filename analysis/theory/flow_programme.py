"""A world as bounds for every strategy see it: dangerous cells, and safe areas in which moves are free."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import highspy
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from analysis.theory.own_bounds import reach_chances
from planner.ids import NO_CELL
from planner.mrac.paths import neighbour_table
from planner.world.world import FOUR_NEIGHBOURS, World, check_starts

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


# A linear programme in HiGHS. Nothing that it says is trusted: whoever asks proves it.

INF = highspy.kHighsInf
Floats = NDArray[np.float64]


def make_solver(cost: Floats, upper: Floats, rows: csc_array, least: Floats, most: Floats) -> highspy.Highs:
    """Minimise `cost @ x` over 0 <= x <= `upper` `[C]` with `least` <= `rows` @ x <= `most` `[R]`."""
    programme, solver = highspy.HighsLp(), highspy.Highs()
    programme.num_row_, programme.num_col_ = rows.shape
    programme.col_cost_, programme.col_lower_, programme.col_upper_ = cost, np.zeros(len(cost)), upper
    programme.row_lower_, programme.row_upper_ = least, most
    programme.a_matrix_.start_, programme.a_matrix_.index_ = rows.indptr, rows.indices
    programme.a_matrix_.value_ = rows.data
    solver.silent()
    solver.setOptionValue("threads", 1)  # none of its own, which a fork of this process would lack
    solver.passModel(programme)
    return solver


# Ways: a node is visited no more often than somebody gets to it; how the programme of flow is held to that.
#
# Flow alone lets half a robot enter a region and go round in it twice, and counts every node there as visited once. So
# a
# row is added for a node v and a potential `pi >= 0` of the nodes: with `psi_t = (1 - p_t) pi_t`, but `psi_v = 1`,
#
#     way:  y_v <= sum_u s_u psi_u + sum over moves u -> t, u other than v, of max(0, psi_t - pi_u) x_ut
#
# Proof. Until v is first visited let every robot that lives have the potential of its node. A move u -> t changes it by
# `psi_t - pi_u` on average, whatever came before; from then on v counts 1, and potentials no longer matter. So the
# chance
# that v is visited is at most what there is at the start and what the moves before it add, of which there are x at
# most.
#
# Which potential: the nodes W on the far side of a minimal cut, each with the chance that a robot that is there
# reaches v
# without leaving W, and 0 elsewhere. Then moves into W alone are counted, each with its chance to get to v. Cuts are
# found by flow from the starts to v, at most the moves that are survived (what Dantzig, Fulkerson & Johnson's subtours
# are to routes). Potentials need not be right for rows to hold: coefficients are rounded upwards.

UNITS = 2**24
"""Of flow, which is whole; more than one robot's is never needed."""
LEAST = 1e-4
"""What a row has to be violated by."""
MOST = 200
"""Nodes for which a way is sought at a time: those that count most."""


class Spend(NamedTuple):
    """Of a set D, its `members` int64 `[|D|]` spend so much at `most` (`analysis.theory.upper_bound`)."""

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


# The best that any strategy can do, exactly, on tiny worlds: what policies and bounds answer to.
#
# Expected cells visited under a strategy that sees everything (which robots live, where they stand, what is visited)
# and
# decides as it goes. Robots may as well move one at a time, the others waiting: there is no limit of time, and who
# moves
# later knows more. Moves inside a safe area are free, so the nodes are those of `analysis.theory.flow_programme`.

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
