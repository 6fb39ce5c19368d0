"""The linear programme behind the policy-independent upper bound: its nodes, its way constraints, the single robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import highspy
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from analysis.theory.bounds import reach_chances
from planner.simulator.codes import NO_CELL
from planner.simulator.jit import compiled
from planner.simulator.searches import neighbour_table
from planner.world.world import FOUR_NEIGHBOURS, World, check_starts

# A world as a graph for the bounds: dangerous cells, and safe areas in which moves are free.

ULP = 2.0**-52


@dataclass(frozen=True, eq=False)
class Nodes:
    """A world as a graph. Axes: `V` nodes, `E` pairs of neighbouring nodes, each in both directions.

    Attributes:
        weight: float64 `[V]`, cells, or an upper bound of their value. threat: float64 `[V]`.
        starts: int64 `[V]`, robots that start there.
        reach: float64 `[V]`, upper bound of the probability that a cell of the node is visited.
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
    near = neighbour_table(world.shape, flat)
    cell, side = np.nonzero((near != NO_CELL) & flat[:, None])
    pairs = np.unique(np.stack([node[cell], node[near[cell, side]]], axis=1), axis=0)
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


class Spend(NamedTuple):
    """Constraint of a set D: its `members` int64 `[|D|]` lose at most `most` robots (`analysis.theory.upper_bound`)."""

    members: NDArray[np.int64]
    most: float


class Way(NamedTuple):
    """Constraint `y[node] <= free + share @ x[moves]`; int64 and float64 `[m]`, rounded up."""

    node: int
    moves: NDArray[np.int64]
    share: NDArray[np.float64]
    free: float


def missing_ways(nodes: Nodes, moves: NDArray[np.float64], visited: NDArray[np.float64]) -> Iterator[Way]:
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
            if visited[node] - way.free - way.share @ moves[way.moves] > LEAST:
                yield way


def _whole(flow: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.floor(np.clip(flow, 0.0, 1.0) * UNITS).astype(np.int32)


def way_within(nodes: Nodes, node: int, inside: NDArray[np.bool_]) -> Way:
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
    return Way(node, entered, share[entered], free)


# The optimum over all strategies, exactly, on tiny worlds: an oracle for policies and bounds.
#
# Expected cells visited under a strategy that knows the full state (robots alive, positions, visited cells) at each
# decision. Moving one robot at a time is no restriction: there is no time limit, and a later decision has more
# information. Moves inside a safe area are free, so the nodes are those of `contract`.

MOST_TO_VISIT = {1: 14, 2: 10}
"""Most nodes without a start, by the number of robots: their power set is enumerated, in about a second."""


def optimum(world: World, starts: ArrayLike) -> float | None:
    """The largest expected number of cells visited by robots at `starts` `[K, 2]`; None beyond MOST_TO_VISIT.

    Dynamic programming backwards from all nodes visited: for a fixed set of visited nodes, values rise until no move
    raises one.
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
    """The mean of `value` `[V + 1, ...]` over the robots' survival at the start nodes `at`; index V: lost."""
    for node in at:
        value = value[node] - nodes.threat[node] * (value[node] - value[-1])
    return float(value)


def _with_visited(
    nodes: Nodes, visited: frozenset[int], more: dict[frozenset[int], NDArray[np.float64]]
) -> NDArray[np.float64]:
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


# One robot: the bound of the programme, restricted to a single walk by prices on repeated counts.
#
# The programme lets a robot be early everywhere, half of it first left and then right, half the other way round. But a
# single robot knows only one history, that it is alive: its strategy is a walk. Each row of the programme, `sum_v b_v
# y_v <= c + sum_uv t_uv x_uv` (spend: t = 0; way: b = 1 for one node), has a price. The value of a walk at prices n and
# z,
#
#   sum_v w_v y_v <= sum_v g_v max(0, w_v - n_v - (z b)_v) + z c + E[sum of n_v over nodes visited, (z t)_uv over moves]
#
# is then bounded where nodes may be counted again, for a toll. Let a clock advance by an integer `d_v` with every move
# to a dangerous node v, and `grow` be a function of it with grow(0) <= 1 and `grow(h) >= (1 - p_v) grow(h + d_v)` for
# every dangerous v. The first arrival at v at clock h pays `m_v grow(h)`: as `grow` times the survival never rises
# along a walk, that is at most `m_v >= 0` on average. So the expectation is at most `sum m_v` and the value of a walk
# on which every arrival at v counts `max(0, n_v - m_v grow(h))`, except that the REMEMBERED largest safe areas count
# `n_v`, once. At the last hour prices end, and all remaining weight is added. The best such walk is found from the last
# hour backwards, over (clock, areas visited, node). Late hours are loose: a live robot then visits every node once.
#
# Initial prices are those of the programme, whose bound they prove. They are improved by cutting planes in a box around
# the best (Marsten, Hogan & Blankenship 1975). Any prices prove a bound; it is added up with every rounding upwards.
# Walks with limited memory are those of Christofides, Mingozzi & Toth (1981) for vehicle routing, clocks those of
# Abeledo et al. (2013) for the time-dependent travelling salesman.

REMEMBERED = 4
"""Safe areas that no walk counts twice."""
TICK, LAST = 0.08, 10.0
"""Hazard -log(1 - p) of a tick of the clock, and of its last hour."""
ROUNDS, ENOUGH = 150, 2e-4
"""Most changes of the prices; the search ends when the possible gain is below this share of the cells."""
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
    """Prices of nodes `[V]` (n), of rows `[R]` (z), and of repeated counts `[V]` (m); all >= 0."""

    visit: NDArray[np.float64]
    rows: NDArray[np.float64]
    again: NDArray[np.float64]


def single_bound(
    nodes: Nodes, rows: Sequence[Spend | Way], arrive: NDArray[np.float64], prices: NDArray[np.float64]
) -> float:
    """The certified bound for the one robot of `nodes`, in cells.

    `rows`, `arrive` `[V]`, `prices` `[R]`: rows and prices of the programme, as initial values.
    """
    walks, start, held = _walks(nodes), int(np.flatnonzero(nodes.starts)[0]), _rows(nodes, rows)
    shape = (len(walks.grow), 2 ** int((walks.bit >= 0).sum()), len(nodes.weight))
    value, chosen = np.zeros(shape), np.full(shape, -1, dtype=np.int32)
    at = Prices(np.minimum(arrive, walks.weight), prices, np.zeros(len(arrive)))
    free = np.where(walks.bit < 0, walks.weight, 0.0)
    box = np.concatenate([np.maximum(walks.weight, 0.2), np.maximum(prices, 0.3), free * nodes.reach / 4])
    most = np.concatenate([walks.weight, np.full(len(prices) + len(free), np.inf)])
    master, best, size, promised = _Master(nodes, held), np.inf, 0.3, -np.inf
    centre = np.concatenate(at)
    for _ in range(ROUNDS):
        toll = (held.share.T @ at.rows) * (1.0 + (len(prices) + 4) * ULP)
        _backwards(walks, at.visit, at.again, toll, value, chosen)
        bound = _proven(nodes, held, at, float(value[0, 0, start]) * float(walks.passed[start]))
        if bound < best:
            size *= 1.5 if best - bound > (best - promised) / 2 else 1.0
            best, centre = bound, np.concatenate(at)
        elif bound - best > best - promised:
            size = max(size * 0.85, 0.03)
        master.add(*_follow(walks, at.visit, at.again, chosen, start, float(walks.passed[start])))
        low, high = np.maximum(centre - size * box, 0.0), np.minimum(centre + size * box, most)
        found, promised = master.least(np.minimum(low, high), high)
        at = Prices(*np.split(found, [len(arrive), len(arrive) + len(prices)]))
        if best - promised < ENOUGH * float(nodes.weight.sum()):
            break
    return best


def _walks(nodes: Nodes) -> Walks:
    passed, order = 1.0 - nodes.threat, np.argsort(nodes.source, kind="stable")
    dangerous, hazard = nodes.threat > 0, -np.log1p(-nodes.threat)
    ticks = np.where(dangerous, np.maximum(np.rint(hazard / TICK), 1), 0).astype(np.int64)
    grow = np.ones(round(LAST / TICK) + 1)
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


def _rows(nodes: Nodes, rows: Sequence[Spend | Way]) -> Rows:
    place = np.empty(len(nodes.source), dtype=np.int64)
    place[np.argsort(nodes.source, kind="stable")] = np.arange(len(place))
    paid, share = np.zeros((len(rows), len(nodes.weight))), np.zeros((len(rows), len(place)))
    for number, row in enumerate(rows):
        if isinstance(row, Way):
            paid[number, row.node], share[number, place[row.moves]] = 1.0, row.share
        else:
            paid[number, row.members] = nodes.threat[row.members]
    most = [row.free if isinstance(row, Way) else row.most for row in rows]
    return Rows(csr_array(paid), csr_array(share), np.array(most, dtype=np.float64))


def _reach(nodes: Nodes) -> NDArray[np.float64]:
    return np.where(nodes.starts > 0, 1.0, nodes.reach)


def _proven(nodes: Nodes, rows: Rows, at: Prices, walk: float) -> float:
    """The bound that prices prove, if a walk gains at most `walk` from the start."""
    paid = at.visit + rows.paid.T @ at.rows
    slack = (len(at.rows) + 8) * ULP
    left = np.maximum(nodes.weight - paid, 0.0) + slack * (nodes.weight + paid)
    total = walk + float(_reach(nodes) @ left) + float(at.rows @ rows.most) + float(at.again.sum())
    return total * (1.0 + (2 * len(paid) + len(at.rows) + 16) * ULP)


@compiled
def _backwards(
    walks: Walks,
    count: NDArray[np.float64],
    again: NDArray[np.float64],
    toll: NDArray[np.float64],
    value: NDArray[np.float64],
    chosen: NDArray[np.int32],
) -> None:
    """Fill `value` `[G + 1, 2**b, V]` and the best move `chosen` (-1: none), by clock, areas visited and node.

    Safe nodes come first: moves to them take no time, and there are none between them. `toll` `[E]`: gain of a move.
    """
    last, nodes = len(walks.grow) - 1, len(count)
    for had in range(value.shape[1]):
        left = 0.0
        for node in range(nodes):
            if walks.bit[node] < 0 or not (had >> walks.bit[node]) & 1:
                left += walks.weight[node]
        value[last, had, :] = left * (1.0 + nodes * ULP)
    node_value = np.empty(nodes)
    for hour in range(last - 1, -1, -1):
        for node in range(nodes):
            node_value[node] = max(0.0, count[node] - again[node] * walks.grow[hour])
        for had in range(value.shape[1] - 1, -1, -1):
            for safe in (True, False):
                for node in range(nodes):
                    if (walks.ticks[node] == 0) != safe:
                        continue
                    best, move = 0.0, -1
                    for at in range(walks.first[node], walks.first[node + 1]):
                        target = walks.target[at]
                        gain, then = node_value[target], had
                        if walks.bit[target] >= 0:
                            then = had | (1 << walks.bit[target])
                            gain = count[target] if then != had else 0.0
                        after = value[min(hour + walks.ticks[target], last), then, target]
                        found = (toll[at] + gain + walks.passed[target] * after) * UP
                        if found > best:
                            best, move = found, at
                    value[hour, had, node], chosen[hour, had, node] = best, move


@compiled
def _follow(
    walks: Walks,
    count: NDArray[np.float64],
    again: NDArray[np.float64],
    chosen: NDArray[np.int32],
    start: int,
    alive: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    """Statistics of the chosen walk: counts `[V]`, moves `[E]`, each price's share `[V]`, remaining weight added."""
    last, hour, had, node = len(walks.grow) - 1, 0, 0, start
    counts, moves, pays = np.zeros(len(count)), np.zeros(len(walks.target)), np.zeros(len(count))
    while hour < last and chosen[hour, had, node] >= 0:
        move = chosen[hour, had, node]
        moves[move] += alive
        node = walks.target[move]
        if walks.bit[node] >= 0:
            counts[node] += alive * (1 - ((had >> walks.bit[node]) & 1))
            had |= 1 << walks.bit[node]
        elif count[node] > again[node] * walks.grow[hour]:
            counts[node] += alive
            pays[node] += alive * walks.grow[hour]
        hour += walks.ticks[node]
        alive *= walks.passed[node]
    given = 0.0
    for node in range(len(count)):
        if hour >= last and (walks.bit[node] < 0 or not (had >> walks.bit[node]) & 1):
            given += alive * walks.weight[node]
    return counts, moves, pays, given


class _Master:
    """Linear programme of the prices: cutting planes from the walks so far."""

    def __init__(self, nodes: Nodes, rows: Rows) -> None:
        """Columns are n `[V]`, z `[R]`, m `[V]`, the remainder of each node `[V]`, and the walks' maximum."""
        count, self._rows = len(nodes.weight), rows
        self._boxed = 2 * count + len(rows.most)
        every = np.arange(count)
        columns = np.concatenate([every, self._boxed + every, count + rows.paid.tocoo().row])
        taken = np.concatenate([np.ones(2 * count), rows.paid.tocoo().data])
        to_rows = np.concatenate([every, every, rows.paid.tocoo().col])
        left = coo_array((taken, (to_rows, columns)), shape=(count, self._boxed + count + 1)).tocsc()
        cost = np.concatenate([np.zeros(count), rows.most, np.ones(count), _reach(nodes), [1.0]])
        self._solver = make_solver(cost, np.full(len(cost), INF), left, nodes.weight, np.full(count, INF))

    def add(
        self, counts: NDArray[np.float64], moves: NDArray[np.float64], pays: NDArray[np.float64], given: float
    ) -> None:
        """Add a walk."""
        brings = np.concatenate([counts, self._rows.share @ moves, -pays])
        used = np.flatnonzero(brings)
        columns = np.append(used, self._boxed + len(counts)).astype(np.int32)
        self._solver.addRow(given, INF, len(columns), columns, np.append(-brings[used], 1.0))

    def least(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """(prices in these limits `[V + R + V]` that minimise the predicted bound, that bound)."""
        self._solver.changeColsBounds(self._boxed, np.arange(self._boxed, dtype=np.int32), low, high)
        self._solver.run()
        found = np.array(self._solver.getSolution().col_value)[: self._boxed]
        return np.clip(found, low, high), float(self._solver.getInfo().objective_function_value)
