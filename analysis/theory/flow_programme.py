"""The linear programme behind the policy-independent upper bound: its nodes, its way constraints, the single robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import factorial, prod
from typing import NamedTuple

import highspy
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import csc_array, csr_array, eye_array, hstack, kron
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from analysis.theory.bounds import reach_chances
from planner.simulator.jit import compiled
from planner.simulator.searches import neighbour_pairs
from planner.world.world import FOUR_NEIGHBOURS, World, check_starts

# A world as a graph for the bounds: dangerous cells, and safe areas in which moves are free.

ULP = 2.0**-52


@dataclass(frozen=True, eq=False)
class Nodes:
    """A world as a graph. Axes: `V` nodes, `E` pairs of neighbouring nodes, each in both directions.

    Attributes:
        weight: float64 `[V]`, cells, or an upper bound of their value. threat: float64 `[V]`.
        starts: int64 `[V]`, robots that start there.
        reach: float64 `[V]`, upper bound of the probability that a cell of the node is visited; 1 of starts.
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
        """Size k of the team."""
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
    pairs = np.unique(node[np.stack(neighbour_pairs(world.shape, flat), axis=1)], axis=0)
    source, target = pairs[pairs[:, 0] != pairs[:, 1]].T
    threat, reach = np.zeros(count), np.zeros(count)
    threat[node[dangerous.ravel()]] = world.threat.ravel()[dangerous.ravel()]
    np.maximum.at(reach, node[flat], reach_chances(world, starts)[flat])
    slack = len(starts) * (world.threat.size + 64) * ULP  # rounding of sums of hazards, and of one product a robot
    node_value = np.ones(world.threat.size) if value is None else value.ravel()
    weight = np.bincount(node[flat], node_value[flat], count).astype(np.float64)
    if value is not None:
        weight *= 1.0 + world.threat.size * ULP  # rounding of sums
    begin = node[starts[:, 0] * world.shape[1] + starts[:, 1]]
    robots, reach = np.bincount(begin, minlength=count), np.minimum(reach + slack, 1.0)
    return Nodes(weight, threat, robots, reach, source, target)


# A linear programme in HiGHS. Its result is not trusted; the caller certifies it.

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
    solver.setOptionValue("threads", 1)  # a fork of this process would lack the solver's threads
    solver.passModel(programme)
    return solver


# Ways: a node is visited no more often than it is reached; the constraint that enforces this.
#
# Flow alone lets half a robot enter a region and go round in it twice, and counts every node there as visited once. So
# a row is added for a node v and a potential `pi >= 0` of the nodes: with `psi_t = (1 - p_t) pi_t`, but `psi_v = 1`,
#
#     way:  y_v <= sum_u s_u psi_u + sum over moves u -> t, u other than v, of max(0, psi_t - pi_u) x_ut
#
# Proof. Until v is first visited let every live robot have the potential of its node. A move u -> t changes it by
# `psi_t - pi_u` on average, for any past; from the visit on v counts 1, and potentials no longer matter. So the
# probability that v is visited is at most the potential at the start and the increase by the moves before the visit, of
# which there are x at most.
#
# Choice of the potential: the nodes W on the far side of a minimal cut have the probability that a robot there reaches
# v without leaving W, other nodes have 0. Then only moves into W count, each with its probability to reach v. Cuts are
# found by maximum flow from the starts to v, with the survived moves as capacities (as in the subtour constraints of
# Dantzig, Fulkerson & Johnson). Rows hold for any potential; coefficients are rounded upwards.

UNITS = 2**24
"""Integer units of flow; more than one robot's flow is never needed."""
LEAST = 1e-4
"""Smallest violation for which a row is added."""
MOST = 200
"""Nodes for which a way is sought in a round: those of largest weighted probability."""


class Row(NamedTuple):
    """Constraint `paid @ y[nodes] <= most + share @ x[moves]`; int64 and float64, `share` and `most` rounded up.

    A way has one node, paid 1. A set D has no moves: its nodes, paid their threats, lose at most `most` robots
    (`spend` of `analysis.theory.upper_bound`).
    """

    nodes: NDArray[np.int64]
    paid: Floats
    moves: NDArray[np.int64]
    share: Floats
    most: float


def missing_ways(nodes: Nodes, moves: Floats, visited: Floats) -> Iterator[Row]:
    """Way constraints that a solution violates; expected `moves` `[E]`, `visited` `[V]`."""
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
            if visited[node] - way.most - way.share @ moves[way.moves] > LEAST:
                yield way


def _whole(flow: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.floor(np.clip(flow, 0.0, 1.0) * UNITS).astype(np.int32)


def way_within(nodes: Nodes, node: int, inside: NDArray[np.bool_]) -> Row:
    """The way constraint of a node for moves into the nodes `inside` bool `[V]`, which contain it."""
    passed, count = 1.0 - nodes.threat, len(nodes.weight)
    hazard = np.where(nodes.target == node, 0.0, -np.log1p(-nodes.threat)[nodes.target])
    held = inside[nodes.source] & inside[nodes.target]
    backwards = (np.maximum(hazard, np.finfo(float).tiny)[held], (nodes.target[held], nodes.source[held]))
    far = dijkstra(csr_array(backwards, shape=(count, count)), indices=node)
    rank = np.empty(count)
    rank[np.argsort(far, kind="stable")] = np.arange(count)
    potential = np.exp(-far) * (1.0 + 2.0**-46 * rank)  # so that rounding gives moves along the best way no share
    after = passed * potential
    after[node] = 1.0
    more, less = after[nodes.target], potential[nodes.source]
    share = np.where(nodes.source == node, 0.0, np.maximum(more - less + 8 * ULP * (more + less), 0.0))
    entered = np.flatnonzero(share)
    free = float(nodes.starts @ after) * (1.0 + (count + 8) * ULP)
    return Row(np.array([node]), np.ones(1), entered, share[entered], free)


# The optimum over all strategies, exactly, on tiny worlds: an oracle for policies and bounds.
#
# Expected cells visited under a strategy that knows the full state (robots alive, positions, visited cells) at each
# decision. Moving one robot at a time is no restriction: there is no time limit, and a later decision has more
# information. Moves inside a safe area are free, so the nodes are those of `contract`.

MOST_TO_VISIT = {1: 14, 2: 10}
"""Most nodes without a start, by the number of robots: their power set is enumerated, in about a second."""


def optimum(world: World, starts: ArrayLike, value: Floats | None = None) -> float | None:
    """The largest expected number of cells visited by robots at `starts` `[K, 2]`; None beyond MOST_TO_VISIT.

    `value`: float64 `[H, W]`, of the cells, None: 1 each. Dynamic programming backwards from all nodes visited: for a
    fixed set of visited nodes, values rise until no move raises one.
    """
    checked = check_starts(starts, world.threat, world.source)
    nodes = contract(world, checked, value)
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
    """The mean of `value` `[V + 1, ...]` over the robots' survival at the start nodes `at`; index V: lost."""
    for node in at:
        value = value[node] - nodes.threat[node] * (value[node] - value[-1])
    return float(value)


def _with_visited(nodes: Nodes, visited: frozenset[int], more: dict[frozenset[int], Floats]) -> Floats:
    """The value of every position of the robots, `[V + 1, ...]`, an axis a robot, once these nodes are visited.

    `more`: the same with one more node visited.
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
                gain = there[v] - nodes.threat[v] * (there[v] - there[count])  # no rounding upwards
                beside = nodes.source[nodes.target == v]
                moved[beside] = np.maximum(moved[beside], gain)
        if (best == before).all():
            return best


# Walks: the bound of the programme, with every robot restricted to single walks by prices on its counts.
#
# The programme lets a robot be early everywhere, half of it first left and then right, half the other way round. But a
# robot i has a failure threshold T_i, Exp(1): the hazard -log(1 - p) of its visits that destroys it. Given the
# thresholds of the others, a live robot knows one history, that it is alive: its moves are one walk, and it visits v if
# T_i exceeds H_v, the hazard before the walk's first visit of v. Each row of the programme, `sum_v b_v y_v <= c +
# sum_uv t_uv x_uv` (spend: t = 0; way: b = 1 for one node), has a price z, and each node prices n_v by the classes of
# all robots' thresholds. For any n, z, r >= 0 the team's visits are worth
#
#   sum_v w_v y_v <= E[sum_v max(0, w_v - n_v - (z b)_v - r_v)] + sum_v r_v g_v + z c
#                    + sum_i E[sum of n_v over the nodes that i visits, (z t)_uv over its moves]
#
# as the value of a visited node is at most the rest, and n for each robot that visits it. The last term is a maximum
# over walks, for each multiset of the others' classes: an arrival at hazard H counts `sum_a P(a | T > H) n_v(a,
# others)` (B classes a of equal probability; one robot has one class).
#
# A walk is bounded where nodes may be counted again, for a toll. Let a clock advance by an integer `d_v` with every
# move to a dangerous node v, and `grow` be a function of it with grow(0) <= 1 and `grow(h) >= (1 - p_v) grow(h + d_v)`
# for every dangerous v. The first arrival at v at clock h pays `m_v grow(h)`: as `grow` times the survival never rises
# along a walk, that is at most `m_v >= 0` on average. So the expectation is at most `sum m_v` and the value of a walk
# on which every arrival at v counts `max(0, n_v - m_v grow(h))`, except that the REMEMBERED largest safe areas count
# `n_v`, once.
#
# The hazard of a walk at clock h is between h times the least and h times the largest hazard a tick of any node. The
# count in this interval is largest at an end, or at an edge of a class: with s = exp(-H), and `lo < exp(-T) <= hi` in
# class a, `P(a | T > H) = max(0, min(s, hi) - lo) / s`, which between edges is `A + B / s`, so monotone.
#
# At the last hour a robot stops, and all remaining weight is added. The rows hold of robots that stop: the others'
# moves may depend on hazards that it would have met, but these are independent draws. Late hours are loose: a live
# robot then visits every node once. The best walk is found from the last hour backwards (clock, areas visited, node).
#
# Initial prices are those of the programme, whose bound they prove. They are improved by cutting planes in a box around
# the best (Marsten, Hogan & Blankenship 1975), a part of the way back to the best (Wentges 1997). Any prices prove a
# bound; it is added up with every rounding upwards. Walks with limited memory are those of Christofides, Mingozzi &
# Toth (1981) for vehicle routing, clocks those of Abeledo et al. (2013) for the time-dependent travelling salesman.

REMEMBERED = 4
"""Safe areas that no walk counts twice."""
TICK, LAST = 0.08, 10.0
"""Hazard -log(1 - p) of a tick of the clock, and of its last hour."""
ROUNDS, ENOUGH = 150, 2e-4
"""Most changes of the prices a robot; the search ends when the possible gain is below this share of the cells."""
BACK = 0.3
"""Share of the way that prices go back from the predicted to the best ones so far."""
CLASSES = {1: 1, 2: 2, 3: 2, 4: 2}
"""Classes of a robot's threshold, by the number of robots; a power of two, so that their edges are exact."""
MOST_NODES = 1000
"""Nodes up to which it is computed: a round takes some 40 ns times 2**REMEMBERED, LAST / TICK and the nodes."""
UP = 1.0 + 8 * ULP


class Walks(NamedTuple):
    """The graph of walks; moves `[E]` sorted by their source.

    Attributes:
        weight: float64 `[V]`, cells; 0 of the start. passed: float64 `[V]`, 1 - p. ticks: int64 `[V]`, 0 of safe nodes.
        bit: int64 `[V]`, of an area that is remembered; else -1. first, target: int64 `[V + 1]`, `[E]`.
        grow: float64 `[G + 1]`, by the clock.
    """

    weight: NDArray[np.float64]
    passed: NDArray[np.float64]
    ticks: NDArray[np.int64]
    bit: NDArray[np.int64]
    first: NDArray[np.int64]
    target: NDArray[np.int64]
    grow: NDArray[np.float64]


class Rows(NamedTuple):
    """The programme's rows: `paid` `[R, V]` (b), `share` `[R, E]` (t, moves sorted by source), `most` `[R]` (c)."""

    paid: csr_array
    share: csr_array
    most: NDArray[np.float64]


class Prices(NamedTuple):
    """Prices of nodes `[M, V]` (n), of rows `[R]` (z), and of repeated counts `[N, V]` (m); all >= 0."""

    visit: NDArray[np.float64]
    rows: NDArray[np.float64]
    again: NDArray[np.float64]


class Classes(NamedTuple):
    """Multisets of the classes of failure thresholds: `M` of the team, `N` of all robots but one. `B` classes.

    Attributes:
        team, others: float64 `[M]`, `[N]`, probabilities.
        joined: int64 `[N, B]`, the team's multiset, by the others' and the class of the robot itself.
        chance: float64 `[G + 1, B + 1, B]`, of a live robot's class, by the clock and the hazards at which a count may
            have its maximum.
    """

    team: NDArray[np.float64]
    others: NDArray[np.float64]
    joined: NDArray[np.int64]
    chance: NDArray[np.float64]


def walk_bound(nodes: Nodes, rows: Sequence[Row], arrive: Floats, prices: Floats) -> float:
    """The certified bound for the robots of `nodes`, each restricted to single walks, in cells.

    `rows`, `arrive` `[V]`, `prices` `[R]`: rows and prices of the programme, as initial values.
    """
    walks, held = _walks(nodes), _rows(nodes, rows)
    classes = _classes(nodes, walks)
    teams, others = len(classes.team), len(classes.others)

    def all_prices(visit: Floats, row: Floats, again: Floats) -> Floats:
        return np.concatenate([np.tile(visit, teams), row, np.tile(again, others)])

    free = np.where(walks.bit < 0, walks.weight, 0.0)
    now = centre = all_prices(np.minimum(arrive, walks.weight), prices, np.zeros(len(arrive)))
    box = all_prices(np.maximum(walks.weight, 0.2), np.maximum(prices, 0.3), free * nodes.reach / 4)
    most = all_prices(walks.weight, np.full(len(prices), INF), np.where(free > 0, INF, 0.0))
    robots = np.outer(classes.others, nodes.starts[nodes.starts > 0]).ravel()
    master, best, size, promised = _Master(nodes, held, classes, robots), np.inf, 0.3, -np.inf
    for _ in range(ROUNDS * nodes.robots):
        visit, row, again = np.split(now, [teams * len(arrive), teams * len(arrive) + len(prices)])
        at = Prices(visit.reshape(teams, -1), row, again.reshape(others, -1))
        values, gains, given = zip(*_best_walks(nodes, walks, held, classes, at), strict=True)
        master.add(gains, given)
        bound = _proven(nodes, held, classes, at, float(robots @ values))
        if bound < best:
            size *= 1.5 if best - bound > (best - promised) / 2 else 1.0
            best, centre = bound, now
        elif bound - best > best - promised:
            size = max(size * 0.85, 0.03)
        low, high = np.maximum(centre - size * box, 0.0), np.minimum(centre + size * box, most)
        now, promised = master.least(np.minimum(low, high), high)
        now += BACK * (centre - now)
        if best - promised < ENOUGH * float(nodes.weight.sum()):
            break
    return best


def _walks(nodes: Nodes) -> Walks:
    passed, order = 1.0 - nodes.threat, np.argsort(nodes.source, kind="stable")
    dangerous, hazard = nodes.threat > 0, -np.log1p(-nodes.threat)
    tried = np.geomspace(TICK, TICK / CLASSES[nodes.robots], 17)
    pace = hazard[dangerous] / np.maximum(np.rint(hazard[dangerous] / tried[:, None]), 1)
    tick = float(tried[np.argmin(pace.max(axis=1, initial=0.0) / pace.min(axis=1, initial=np.inf))])
    ticks = np.where(dangerous, np.maximum(np.rint(hazard / tick), 1), 0).astype(np.int64)
    grow = np.ones(round(LAST / tick) + 1)
    for hour in range(len(grow) - 2, -1, -1):
        later = grow[np.minimum(hour + ticks[dangerous], len(grow) - 1)]
        grow[hour] = (passed[dangerous] * later).max(initial=0.0) * UP
    weight, bit = np.where(nodes.starts > 0, 0.0, nodes.weight), np.full(len(passed), -1)
    safe = np.where(dangerous, 0.0, weight)
    large = np.argsort(-safe, kind="stable")[:REMEMBERED]
    large = large[safe[large] > 0]
    bit[large] = np.arange(len(large))
    first = np.searchsorted(nodes.source[order], np.arange(len(passed) + 1))
    scale = max(float(grow[0]), np.finfo(float).tiny)
    return Walks(weight, passed, ticks, bit, first, nodes.target[order], grow / scale * (1.0 - 4 * ULP))


def _classes(nodes: Nodes, walks: Walks) -> Classes:
    size, dangerous = CLASSES[nodes.robots], walks.ticks > 0
    pace = -np.log1p(-nodes.threat[dangerous]) / walks.ticks[dangerous]
    # A hazard has five roundings, and matters up to log(size): then a live robot is in the last class.
    hours, edges = np.arange(len(walks.grow))[:, None], np.arange(size, -1, -1) / size
    early = np.exp(-hours * pace.min(initial=1.0)) * (1.0 + 64 * ULP)
    late = np.exp(-hours * pace.max(initial=0.0)) * (1.0 - 64 * ULP)
    alive = np.maximum(np.clip(edges, late, early), 1.0 / size)[:, :, None]
    chance = np.maximum(np.minimum(alive, edges[:-1]) - edges[1:], 0.0) / alive + 8 * size * ULP
    teams, others = (list(combinations_with_replacement(range(size), of)) for of in (nodes.robots, nodes.robots - 1))
    joined = [[teams.index(tuple(sorted((*of, own)))) for own in range(size)] for of in others]
    return Classes(_chances(teams, size), _chances(others, size), np.array(joined), chance)


def _chances(multisets: list[tuple[int, ...]], size: int) -> NDArray[np.float64]:
    """Multinomial probabilities of multisets of `size` equally likely classes."""
    orders = [factorial(len(of)) / prod(factorial(of.count(own)) for own in range(size)) for of in multisets]
    return np.array(orders) / size ** len(multisets[0])


def _rows(nodes: Nodes, rows: Sequence[Row]) -> Rows:
    place = np.empty(len(nodes.source), dtype=np.int64)
    place[np.argsort(nodes.source, kind="stable")] = np.arange(len(place))
    paid, share = np.zeros((len(rows), len(nodes.weight))), np.zeros((len(rows), len(place)))
    for number, row in enumerate(rows):
        paid[number, row.nodes], share[number, place[row.moves]] = row.paid, row.share
    return Rows(csr_array(paid), csr_array(share), np.array([row.most for row in rows], dtype=np.float64))


def _proven(nodes: Nodes, rows: Rows, classes: Classes, at: Prices, walks: float) -> float:
    """The bound that prices prove, if the walks of all robots gain at most `walks` from their starts."""
    paid = at.visit + rows.paid.T @ at.rows
    slack = (len(at.rows) + 8) * ULP
    left = np.maximum(nodes.weight - paid, 0.0) + slack * (nodes.weight + paid)
    limit = np.concatenate([np.zeros((1, len(nodes.weight))), left])[:, None]
    rest = nodes.reach * limit[:, 0] + np.einsum("m,lmv->lv", classes.team, np.maximum(left - limit, 0.0))
    repeated = nodes.robots * float(classes.others @ at.again.sum(axis=1))
    total = walks + float(rest.min(axis=0).sum()) + float(at.rows @ rows.most) + repeated
    return total * (1.0 + (2 * at.visit.size + len(at.rows) + 16) * ULP)


def _best_walks(
    nodes: Nodes, walks: Walks, rows: Rows, classes: Classes, at: Prices
) -> Iterator[tuple[float, Floats, float]]:
    """The best walk at these prices for each multiset of the others' classes, and of these for each start.

    Its value, its gains for each price, and the remaining weight added.
    """
    shape = (len(walks.grow), 2 ** int((walks.bit >= 0).sum()), len(nodes.weight))
    value, chosen = np.empty(shape), np.empty(shape, dtype=np.int32)
    toll = (rows.share.T @ at.rows) * (1.0 + (len(at.rows) + 4) * ULP)
    for number, joined in enumerate(classes.joined):
        counts = classes.chance @ at.visit[joined]
        which, prize = counts.argmax(axis=1), counts.max(axis=1) - at.again[number] * walks.grow[:, None]
        _backwards(walks, prize, toll, value, chosen)
        for start in np.flatnonzero(nodes.starts).tolist():
            hour = min(int(walks.ticks[start]), len(walks.grow) - 1)
            seen, moves, given = _follow(walks, prize, chosen, start)
            at_hour, node = np.nonzero(seen)
            alive, visits, pays = seen[at_hour, node], np.zeros(at.visit.shape), np.zeros(at.again.shape)
            np.add.at(visits, (joined, node[:, None]), alive[:, None] * classes.chance[at_hour, which[at_hour, node]])
            np.add.at(pays[number], node, alive * walks.grow[at_hour])
            gains = np.concatenate([visits.ravel(), rows.share @ moves, -pays.ravel()])
            yield float(walks.passed[start] * value[hour, 0, start]), gains, given


@compiled
def _backwards(walks: Walks, prize: Floats, toll: Floats, value: Floats, chosen: NDArray[np.int32]) -> None:
    """Fill `value` `[G + 1, 2**b, V]` and the best move `chosen` (-1: none), by clock, areas visited and node.

    Safe nodes come first: moves to them take no time, and there are none between them. `prize` `[G + 1, V]`: gain of an
    arrival by the clock before it; `toll` `[E]`: gain of a move.
    """
    last, nodes = len(walks.grow) - 1, len(walks.weight)
    for had in range(value.shape[1]):
        left = 0.0
        for node in range(nodes):
            if walks.bit[node] < 0 or not (had >> walks.bit[node]) & 1:
                left += walks.weight[node]
        value[last, had, :] = left * (1.0 + nodes * ULP)
    for hour in range(last - 1, -1, -1):
        for had in range(value.shape[1] - 1, -1, -1):
            for safe in (True, False):
                for node in range(nodes):
                    if (walks.ticks[node] == 0) != safe:
                        continue
                    best, move = 0.0, -1
                    for at in range(walks.first[node], walks.first[node + 1]):
                        target = walks.target[at]
                        gain, then = max(0.0, prize[hour, target]), had
                        if walks.bit[target] >= 0:
                            then = had | (1 << walks.bit[target])
                            gain = gain if then != had else 0.0
                        after = value[min(hour + walks.ticks[target], last), then, target]
                        found = (toll[at] + gain + walks.passed[target] * after) * UP
                        if found > best:
                            best, move = found, at
                    value[hour, had, node], chosen[hour, had, node] = best, move


@compiled
def _follow(walks: Walks, prize: Floats, chosen: NDArray[np.int32], start: int) -> tuple[Floats, Floats, float]:
    """Statistics of the chosen walk: counted arrivals `[G + 1, V]`, moves `[E]`, remaining weight added."""
    last, hour, had, node = len(walks.grow) - 1, walks.ticks[start], 0, start
    seen, moves, alive = np.zeros(prize.shape), np.zeros(len(walks.target)), walks.passed[start]
    while hour < last and chosen[hour, had, node] >= 0:
        move = chosen[hour, had, node]
        moves[move] += alive
        node = walks.target[move]
        if walks.bit[node] >= 0:
            seen[hour, node] += alive * (1 - ((had >> walks.bit[node]) & 1))
            had |= 1 << walks.bit[node]
        elif prize[hour, node] > 0:
            seen[hour, node] += alive
        hour += walks.ticks[node]
        alive *= walks.passed[node]
    given = 0.0
    for node in range(len(walks.weight)):
        if hour >= last and (walks.bit[node] < 0 or not (had >> walks.bit[node]) & 1):
            given += alive * walks.weight[node]
    return seen, moves, given


class _Master:
    """Linear programme of the prices: cutting planes from the walks so far."""

    def __init__(self, nodes: Nodes, rows: Rows, classes: Classes, robots: Floats) -> None:
        """Columns are n `[M, V]`, z `[R]`, m `[N, V]`, the remainders `[M, V]`, r `[V]`, and the walks' maxima.

        `robots`: of each maximum, in expectation.
        """
        teams, each = np.ones((len(classes.team), 1)), eye_array(len(nodes.weight))
        every, again = eye_array(classes.team.size * len(nodes.weight)), np.repeat(classes.others, len(nodes.weight))
        nothing = csr_array((every.shape[0], len(again)))
        parts = [every, kron(teams, rows.paid.T), nothing, every, kron(teams, each), nothing[:, : len(robots)]]
        cost = [np.zeros(every.shape[0]), rows.most, nodes.robots * again, np.repeat(classes.team, len(nodes.weight))]
        prices = np.concatenate([*cost, nodes.reach, robots])
        least = np.tile(nodes.weight, len(teams))
        self._boxed, self._walks = sum(map(len, cost[:3])), len(prices) - len(robots)
        self._solver = make_solver(prices, np.full(len(prices), INF), csc_array(hstack(parts)), least, least + INF)

    def add(self, gains: Sequence[Floats], given: Sequence[float]) -> None:
        """Add a walk to those of each maximum."""
        for number, (of_prices, least) in enumerate(zip(gains, given, strict=True)):
            used = np.flatnonzero(of_prices)
            columns = np.append(used, self._walks + number).astype(np.int32)
            self._solver.addRow(least, INF, len(columns), columns, np.append(-of_prices[used], 1.0))

    def least(self, low: Floats, high: Floats) -> tuple[Floats, float]:
        """(prices in these limits that minimise the predicted bound, that bound)."""
        self._solver.changeColsBounds(self._boxed, np.arange(self._boxed, dtype=np.int32), low, high)
        self._solver.run()
        found = np.array(self._solver.getSolution().col_value)[: self._boxed]
        return np.clip(found, low, high), float(self._solver.getInfo().objective_function_value)
