"""What no team's trails exceed: an outer polygon of the front, a half-plane for each price of a robot that comes home.

A linear programme of expected moves, solved by HiGHS and not trusted: any prices >= 0 of its rows prove a bound, since
every unknown has an upper limit; that bound is added up in exact fractions. For `k` robots that all leave the base,
each on a trail of its own that uses an arc at most once, decided in advance: `x_a` expected departures along arc a
(survival `q_a`), `f_v` robots that reach node v, `t_vm` parts of them, `h` robots home, all of them expected. Maximise
`sum_v r_v sum_m s_vm t_vm + price * h` subject to

    flow:   out_v <= in_v,  at the base out + h <= k + in      out = sum x_a, in = sum q_a x_a
    leave:  h <= in at the base, k <= out
    reach:  sum_m t_vm <= f_v <= in(W)      for every set W of nodes with v in it, and not the base
    once:   x_a <= f_v for arcs out of v    (nodes visited once: in_v <= f_v, and at the base out <= k)
    lose:   sum_D p_i c_i <= n (1 - prod_D (1 - p_i))      for every set D of arcs, or of first visits of nodes
    limits: f_v, t_vm / k <= k g_v / k, x_a <= k g_a, h <= k * (best way out and back)

with `g_v` the best chance to reach v, `g_a` that of its tail; `p_i` the chance to be lost on an arc, or on the safest
one into a node, and `c_i` how often that is tried: `x_a`, or `f_v / (1 - p_v)`; `n`: `k` times the largest g of D, or
`f_u` where nobody gets to D but through node u.

Proof. Flow, leave: a robot departs only after it arrived alive, and comes home after its last arrival there. Reach,
once: who reaches v enters W first, and uses each arc once, after v. Lose: a robot gets to D with a chance of n / k or
less; from there the chance to be lost in D is 1 less the product over what it tries, each once. The chances z_i <= g_v
of the robots to visit v are independent, so the expected reward is linear in each; as the shares of visits fall, moving
two of them apart, their sum the same, adds to it: of all z_i <= g_v with sum f it is largest where all but one are 0 or
g_v. That is `sum_m s_vm t_vm`, t_vm <= g_v, with `s_vm` the expected share of a visit after m others of chance g_v.
A plan that reacts to losses may exceed it: its robots' visits are not independent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from analysis.graphs.graph import Graph, Rules
from analysis.theory.solver import INF, make_solver

ULP = 2.0**-52
ROUNDS, NEW_SETS, SLACK = 60, 12, 1e-5
"""Times that it is solved at most for a price; sets D added a time; how far a row must be violated, in robots."""
GAIN, PATIENCE = 1e-4, 4
"""It ends when so many rounds together gain less than this share."""
PARTS = 1e7
"""Parts of a robot that flow, in whole numbers, where a set W is looked for."""
Row = tuple[NDArray[np.int64], NDArray[np.float64], float]
"""Columns, shares of them, and what their sum is at most."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What a graph allows one robot, all rounded upwards.

    Attributes:
        reach: best chances to reach the nodes, float64 `[V]`; 0 where nobody can be, and still come home as asked.
        enter: best chances to survive an arc to them; before: best chances to be at the tail of one.
        share: expected shares `s_vm` of a node's reward, float64 `[V, k]`. home: the best chance to leave and return.
        behind: of each node, those that nobody gets to but through it, bool `[V, V]`.
    """

    reach: NDArray[np.float64]
    enter: NDArray[np.float64]
    before: NDArray[np.float64]
    share: NDArray[np.float64]
    home: float
    behind: NDArray[np.bool_]


def limits_of(graph: Graph, robots: int, least_home: float) -> Limits:
    """The limits of so many robots, each of which comes home with the chance `least_home` or more."""
    chances, count = graph.chances(), len(graph.names)
    cost, up = graph.hazards(), 1.0 + count * 1e-11  # more than the least cost of an arc, and any rounding
    out, back = (np.minimum(np.exp(-dijkstra(way, indices=graph.base)) * up, 1.0) for way in (cost, cost.T))
    reach = np.where(out * back * up >= least_home, out, 0.0)
    enter, before = np.zeros(count), np.zeros(count)
    np.maximum.at(enter, graph.head, graph.survival * (reach[graph.tail] > 0))
    np.maximum.at(before, graph.head, reach[graph.tail])
    before[graph.base] = 0.0  # its first visit is the start
    leaving = (graph.tail == graph.base) & (reach[graph.head] > 0)
    home = min(1.0, float((graph.survival * back[graph.head])[leaving].max(initial=0.0)) * up)
    gains = np.zeros(robots)
    gains[: len(graph.visits)] = graph.visits[:robots]
    share, others = np.zeros((count, robots)), np.zeros((count, robots))
    others[:, 0] = 1.0  # chances of 0, 1, ... visits before
    for robot in range(robots):
        share[:, robot] = others @ gains
        others[:, 1:] = others[:, 1:] * (1 - reach[:, None]) + others[:, :-1] * reach[:, None]
        others[:, 0] *= 1 - reach
    behind = np.ones((count, count), np.bool_)
    for node in range(count):
        if node != graph.base:
            kept = chances * (np.arange(count) != node)
            behind[node, breadth_first_order(csr_array(kept), graph.base, return_predecessors=False)] = False
            behind[node, node] = True
    return Limits(reach, enter, before, share * (1.0 + 8 * (robots + 8) * ULP), home, behind)


class Programme:
    """The programme of one team; its rows are kept from price to price. Columns: x `[A]`, t `[V k]`, f `[V]`, h."""

    def __init__(self, graph: Graph, robots: int, rules: Rules, leave: bool = True) -> None:
        """`leave`: False where robots may stay at the base too."""
        self.graph, self.robots, self.limits = graph, robots, limits_of(graph, robots, rules.least_home)
        arcs, count, reach = len(graph.tail), len(graph.names), self.limits.reach
        self.parts = arcs + np.arange(count * robots).reshape(count, robots)
        self.reached, self.home = arcs + count * robots + np.arange(count), arcs + count * (robots + 1)
        self.rows = list[Row]()
        most = robots * (1 + 2 * ULP)
        self.upper = np.concatenate([most * reach[graph.tail], np.repeat(reach, robots), most * reach, [0.0]])
        self.upper[self.home] = most * (self.limits.home if leave else 1.0)
        self.gain = np.zeros(self.home + 1)
        self.gain[self.parts] = graph.reward[:, None] * self.limits.share * (1 + 2 * ULP)
        self.gain[self.parts[graph.base]] = 0.0  # where they all are
        none = np.zeros(0)
        self._solver = make_solver(-self.gain, self.upper, csc_array((0, self.home + 1)), none, none)
        for node in range(count):
            out, into = np.flatnonzero(graph.tail == node), np.flatnonzero(graph.head == node)
            arrived = graph.survival[into]
            if node == graph.base:
                self._add([*out, self.home, *into], [*np.ones(len(out) + 1), *-arrived], robots)
                if leave:
                    self._add([self.home, *into], [1.0, *-arrived], 0.0)
                    self._add(out, -np.ones(len(out)), -robots)
                if rules.nodes_once:
                    self._add(out, np.ones(len(out)), robots)
                if rules.least_home:
                    self._add([self.home], [-1.0], -robots * rules.least_home)
                continue
            self._add([*out, *into], [*np.ones(len(out)), *-arrived], 0.0)
            self._add([*self.parts[node], self.reached[node]], [*np.ones(robots), -1.0], 0.0)
            self._add([self.reached[node], *into], [1.0, *-arrived], 0.0)
            if rules.nodes_once:
                self._add([self.reached[node], *into], [-1.0, *arrived], 0.0)

    def _add(self, columns: object, shares: object, most: float) -> None:
        """A row: the sum of so many of these columns is at most `most`."""
        row = np.array(columns, dtype=np.int64), np.array(shares, dtype=np.float64), float(most)
        self.rows.append(row)
        self._solver.addRow(-INF, row[2], len(row[0]), row[0].astype(np.int32), row[1])

    def bound(self, price: float) -> float:
        """`E[R] + price E[S]` that no such team exceeds, without what the base is worth; rows are added on the way."""
        self._solver.changeColCost(self.home, -price)
        self.gain[self.home] = price
        self._solver.run()
        optima = list[float]()
        while len(optima) < ROUNDS:
            optima.append(-float(self._solver.getObjectiveValue()))
            enough = optima[-PATIENCE - 1 : -PATIENCE] and optima[-PATIENCE - 1] - optima[-1] < GAIN * optima[-1]
            rows = [] if enough else list(self._missing(np.array(self._solver.getSolution().col_value)))
            if not rows:
                break
            for row in rows:
                self._add(*row)
            self._solver.run()
        return self._certified(np.maximum(-np.array(self._solver.getSolution().row_dual), 0.0))

    def _missing(self, found: NDArray[np.float64]) -> Iterator[Row]:
        """Rows that the solution violates."""
        graph, limits, arcs = self.graph, self.limits, np.arange(len(self.graph.tail))
        moves, reached = found[arcs], found[self.reached]
        for arc in np.flatnonzero((moves > reached[graph.tail] + SLACK) & (graph.tail != graph.base)).tolist():
            yield np.array([arc, self.reached[graph.tail[arc]]]), np.array([1.0, -1.0]), 0.0
        yield from self._ways(moves, reached)
        lost = 1.0 - limits.enter
        for loss, tried, reach, columns, shares, inside in (
            (1.0 - graph.survival, moves, limits.reach[graph.tail], arcs, 1.0 - graph.survival, graph.tail),
            (lost, reached / np.maximum(1 - lost, ULP), limits.before, self.reached,
             lost / np.maximum(1 - lost, ULP) * (1 - 4 * ULP), np.arange(len(reached))),
        ):  # fmt: skip
            sets = list[tuple[float, NDArray[np.int64], int]]()
            used = np.flatnonzero((tried > 1e-9) & (loss > 0) & (reach > 0))
            for most in np.unique(reach[used].round(6)):
                some = used[reach[used] <= most + 1e-6]
                sets += ((*one, graph.base) for one in _overspent(loss, tried, some, self.robots * reach))
            for gate in np.flatnonzero((limits.behind.sum(axis=1) > 1) & (reached > 1e-9)).tolist():
                behind = limits.behind[gate][inside] & ((columns < len(arcs)) | (inside != gate))
                some = used[behind[used]]
                sets += ((*one, gate) for one in _overspent(loss, tried, some, np.full(len(loss), reached[gate])))
            for _, some, gate in sorted(sets, key=lambda one: -one[0])[:NEW_SETS]:
                stopped = (1.0 - float(np.prod(1.0 - loss[some])) * (1 - 2 * (len(some) + 2) * ULP)) * (1 + 8 * ULP)
                if gate == graph.base:
                    yield columns[some], shares[some], self.robots * float(reach[some].max()) * stopped
                else:
                    yield np.append(columns[some], self.reached[gate]), np.append(shares[some], -stopped), 0.0

    def _ways(self, moves: NDArray[np.float64], reached: NDArray[np.float64]) -> Iterator[Row]:
        """Sets W that fewer robots enter than reach a node in them."""
        graph, count = self.graph, len(reached)
        flow = np.round(moves * graph.survival * PARTS).astype(np.int32)
        used = flow > 0
        pipes = csr_array((flow[used], (graph.tail[used], graph.head[used])), shape=(count, count))
        for node in np.flatnonzero(reached > SLACK).tolist():
            if node == graph.base:
                continue
            sent = maximum_flow(pipes, graph.base, node)
            if sent.flow_value < (reached[node] - SLACK) * PARTS:
                left = csr_array(pipes.toarray() > sent.flow.toarray())
                inside = np.ones(count, np.bool_)
                inside[breadth_first_order(left, graph.base, return_predecessors=False)] = False
                into = np.flatnonzero(inside[graph.head] & ~inside[graph.tail])
                yield np.append(into, self.reached[node]), np.append(-graph.survival[into], 1.0), 0.0

    def _certified(self, prices: NDArray[np.float64]) -> float:
        """What prices of the rows prove, added up exactly: sum of price * most, and what each unknown is worth beyond
        what its rows charge, times its limit."""
        total, worth = Fraction(0), [Fraction(gain) for gain in self.gain.tolist()]
        for (columns, shares, most), price in zip(self.rows, map(Fraction, prices.tolist()), strict=True):
            if price:
                total += price * Fraction(most)
                for column, share in zip(columns.tolist(), shares.tolist(), strict=True):
                    worth[column] -= price * Fraction(share)
        total += sum((one * Fraction(most) for one, most in zip(worth, self.upper.tolist(), strict=True) if one > 0))
        return float(np.nextafter(float(total), np.inf))


def _overspent(
    loss: NDArray[np.float64], tried: NDArray[np.float64], some: NDArray[np.int64], robots: NDArray[np.float64]
) -> Iterator[tuple[float, NDArray[np.int64]]]:
    """The beginning of `some`, most tried first, on which most robots are lost above those that can be; and how many.

    `robots`: of each, how many may get so far.
    """
    order = some[np.argsort(-tried[some] / np.maximum(robots[some], ULP), kind="stable")]
    kept = np.exp(np.cumsum(np.log1p(-loss[order])))
    over = np.cumsum(loss[order] * tried[order]) - np.maximum.accumulate(robots[order]) * (1.0 - kept)
    place = int(over.argmax()) if len(over) else 0
    if len(over) and over[place] > SLACK:
        yield float(over[place]), order[: place + 1]
