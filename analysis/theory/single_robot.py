"""One robot: the bound of the programme of flow, held to a single walk by prices on being counted again.

The programme lets a robot be early everywhere, half of it first left and then right, half the other way round. But a
single robot knows one history alone, that it lives: its strategy is a walk. Each row of the programme, `sum_v b_v y_v
<= c + sum_uv t_uv x_uv` (spend: t = 0; way: b = 1 for one node), has a price. What a walk is worth at prices n and z,

    sum_v w_v y_v <= sum_v g_v max(0, w_v - n_v - (z b)_v) + z c + E[sum of n_v over nodes visited, (z t)_uv over moves]

is then bounded where nodes may be counted again, for a toll. Let a clock advance by a whole number `d_v` with every
move to a dangerous node v, and `grow` be a function of it with grow(0) <= 1 and `grow(h) >= (1 - p_v) grow(h + d_v)`
for every dangerous v. Whoever first arrives at v at h pays `m_v grow(h)`: as `grow` times the chance to live never
rises along a walk, that is at most `m_v >= 0` on average. So the expectation is at most `sum m_v` and what a walk
brings on which every arrival at v counts `max(0, n_v - m_v grow(h))`, but that the REMEMBERED largest safe areas count
`n_v`, once. At the last hour prices end, and all that is left is given away. The best such walk is found from the last
hour backwards, over (clock, areas had, node). Late hours are dear: a robot that lives visits every node once.

Prices begin as those of the programme, whose bound they prove, and are bettered by cutting planes in a box around the
best (Marsten, Hogan & Blankenship 1975). They need not be right: what they prove is added up, every rounding upwards.
Walks that forget are those of Christofides, Mingozzi & Toth (1981) for vehicle routing, clocks those of Abeledo et al.
(2013) for salesmen who count time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from analysis.theory.flow_programme import INF, ULP, Nodes, Spend, Way, make_solver
from planner.jit import compiled

REMEMBERED = 4
"""Safe areas that no walk counts twice."""
TICK, LAST = 0.08, 10.0
"""Hazard -log(1 - p) of a tick of the clock, and of its last hour."""
ROUNDS, ENOUGH = 150, 2e-4
"""Times that prices are changed at most; it ends when a share of the cells so small is left to win."""
MOST_NODES = 1000
"""Nodes up to which it is worked out: a round takes some 40 ns times 2**REMEMBERED, LAST / TICK and the nodes."""
UP = 1.0 + 8 * ULP


class Walks(NamedTuple):
    """What walks are made of; moves `[E]` by their source.

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
    """The programme's rows: `paid` `[R, V]` (b), `share` `[R, E]` (t, moves by their source), `most` `[R]` (c)."""

    paid: csr_array
    share: csr_array
    most: NDArray[np.float64]


class Prices(NamedTuple):
    """Of nodes `[V]` (n), rows `[R]` (z), and of being counted again `[V]` (m); all >= 0."""

    visit: NDArray[np.float64]
    rows: NDArray[np.float64]
    again: NDArray[np.float64]


def single_bound(
    nodes: Nodes, rows: Sequence[Spend | Way], arrive: NDArray[np.float64], prices: NDArray[np.float64]
) -> float:
    """The certified bound for the one robot of `nodes`, in cells.

    `rows`, `arrive` `[V]`, `prices` `[R]`: those of the programme, and its prices, to begin with.
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
    """The bound that prices prove, where a walk brings at most `walk` from the start."""
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
    """Fills `value` `[G + 1, 2**b, V]` and the move `chosen` there, -1: none; by clock, areas had and node.

    Safe nodes first: moves to them take no time, and between them there are none. `toll` `[E]`: what a move brings.
    """
    last, nodes = len(walks.grow) - 1, len(count)
    for had in range(value.shape[1]):
        left = 0.0
        for node in range(nodes):
            if walks.bit[node] < 0 or not (had >> walks.bit[node]) & 1:
                left += walks.weight[node]
        value[last, had, :] = left * (1.0 + nodes * ULP)
    worth = np.empty(nodes)
    for hour in range(last - 1, -1, -1):
        for node in range(nodes):
            worth[node] = max(0.0, count[node] - again[node] * walks.grow[hour])
        for had in range(value.shape[1] - 1, -1, -1):
            for safe in (True, False):
                for node in range(nodes):
                    if (walks.ticks[node] == 0) != safe:
                        continue
                    best, move = 0.0, -1
                    for at in range(walks.first[node], walks.first[node + 1]):
                        target = walks.target[at]
                        gain, then = worth[target], had
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
    """Of the walk that was chosen: counts `[V]`, moves `[E]`, each price's share `[V]`, and what it is given."""
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
    """Prices, and the most that the walks so far bring at them, in the solver."""

    def __init__(self, nodes: Nodes, rows: Rows) -> None:
        """Columns are n `[V]`, z `[R]`, m `[V]`, what is left of a node `[V]`, and the walks' most."""
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
        """One more walk."""
        brings = np.concatenate([counts, self._rows.share @ moves, -pays])
        used = np.flatnonzero(brings)
        columns = np.append(used, self._boxed + len(counts)).astype(np.int32)
        self._solver.addRow(given, INF, len(columns), columns, np.append(-brings[used], 1.0))

    def least(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """(prices between these `[V + R + V]` that promise the least, what they promise)."""
        self._solver.changeColsBounds(self._boxed, np.arange(self._boxed, dtype=np.int32), low, high)
        self._solver.run()
        found = np.array(self._solver.getSolution().col_value)[: self._boxed]
        return np.clip(found, low, high), float(self._solver.getInfo().objective_function_value)
