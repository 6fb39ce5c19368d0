"""The programme of flow: expected cells visited that no strategy exceeds, proven by prices.

A linear programme over the expected moves of the team, solved by HiGHS and then not trusted: its dual solution is made
feasible by rounding, checked in exact rational arithmetic, and what it proves is the bound.

Nodes `V`: the dangerous cells, and the safe areas (4-connected sets of safe cells, in which moves are free). `w` cells
and threat `p` of a node (p of a safe area is 0); `s` robots start there. Unknowns: `x_uv`, expected moves of the team
from node u to node v, and `y_v`, the chance that a cell of v is visited. Maximise `sum w_v y_v` subject to

    flow:    sum_v x_uv <= (1 - p_u) a_u         a_u = s_u + sum_t x_tu, the expected arrivals
    arrive:  y_v <= a_v
    reach:   y_v <= g_v                          `analysis.theory.own_bounds.reach_chances`
    spend:   sum_D p_v y_v <= E min(k, hits)     for every set D of dangerous cells

Proof. A robot leaves a node only after an arrival that it survived; a cell is visited only if its node is arrived at.
The team's first visit of a cell stops the robot with chance p whatever came before, so the left side of `spend` is the
expected number of robots stopped at first visits of D. They are at most k, and at most as many as there are hits among
|D| draws made in advance, one a cell: a Poisson-binomial number. So the expectations of any strategy satisfy the
programme, and its optimum is no smaller than their `sum w_v y_v`. Presumes that every visit is checked on its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import highspy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, hstack, vstack

from analysis.theory.nodes import ULP, Nodes

ROUNDS = 200
"""Times that it is solved at most; fewer only make the bound less sharp."""
GAIN, PATIENCE = 4e-5, 10
"""It ends when so many rounds together gain less than this share of the cells."""
NEW_SETS = 8
"""Sets D added a round from each order of the cells."""


@dataclass(frozen=True, eq=False)
class Dual:
    """Prices of the programme's constraints, float64: `flow`, `arrive` `[V]`, `spend` `[S]` for the sets D."""

    flow: NDArray[np.float64]
    arrive: NDArray[np.float64]
    spend: NDArray[np.float64]


def flow_bound(nodes: Nodes, rounds: int = ROUNDS) -> float:
    """The programme's certified bound, in cells: sets D are added while the solution spends more than they allow.

    `rounds`: times that it is solved at most.
    """
    dangerous = np.flatnonzero(nodes.threat > 0)
    programme = Programme(nodes)
    optima: list[float] = []
    while True:
        visited, dual = programme.solve()
        optima.append(float(nodes.weight @ visited))
        enough = optima[-PATIENCE - 1 : -PATIENCE] and optima[-PATIENCE - 1] - optima[-1] < GAIN * nodes.weight.sum()
        orders = (np.argsort(-visited[dangerous], kind="stable"), np.argsort(nodes.threat[dangerous], kind="stable"))
        found = [new for order in orders for new in _overspent(nodes, dangerous[order], visited)]
        if enough or not found or len(optima) == rounds:
            return min(certified(nodes, programme.sets, dual), float(nodes.weight.sum()))
        programme.add(found)


def _overspent(
    nodes: Nodes, order: NDArray[np.int64], visited: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], float]]:
    """The beginnings D of `order` that spend most above what is allowed, with that; none within rounding."""
    most = most_stopped(nodes.threat[order], nodes.robots)
    over = np.cumsum(nodes.threat[order] * visited[order]) - most
    peaks = np.flatnonzero((over >= np.append(over[1:], -1.0)) & (over > np.insert(over[:-1], 0, -1.0)) & (over > 1e-6))
    for place in peaks[np.argsort(-over[peaks], kind="stable")][:NEW_SETS].tolist():
        yield np.sort(order[: place + 1]), float(most[place])


def most_stopped(threat: NDArray[np.float64], robots: int) -> NDArray[np.float64]:
    """E min(robots, hits) of the first 1, 2, ... cells of `threat` `[C]`, one visit each, float64 `[C]`; rounded up.

    Sums and products of positive numbers alone, three roundings a cell: a relative error of (4 C + k) ulp at most.
    """
    at_least = np.zeros(min(robots, len(threat)) + 1)
    at_least[0] = 1.0
    most = np.empty(len(threat))
    for place, p in enumerate(threat.tolist()):
        at_least[1:] = at_least[1:] * (1.0 - p) + at_least[:-1] * p
        most[place] = at_least[1:].sum()
    return most * (1.0 + (4.0 * len(threat) + len(at_least) + 4) * ULP)


class Programme:
    """The programme with the sets D so far. It stays in the solver: sets are rows added to a basis that is kept.

    `sets`: int64 `[|D|]` each. Nothing that it says is trusted.
    """

    def __init__(self, nodes: Nodes) -> None:
        """Without sets D; columns are x `[E]` and y `[V]`, rows `flow` `[V]` and `arrive` `[V]`."""
        self.nodes, self.sets = nodes, list[NDArray[np.int64]]()
        count, moves = len(nodes.weight), len(nodes.source)
        every, each, passed = np.arange(moves), np.arange(count), 1.0 - nodes.threat
        into = coo_array((np.ones(moves), (nodes.target, every)), shape=(count, moves)).tocsr()
        out = coo_array((np.ones(moves), (nodes.source, every)), shape=(count, moves)).tocsr()
        visits = csr_array((np.ones(count), (each, each)))
        flow = hstack([out - into.multiply(passed[:, None]), csr_array((count, count))])
        rows = csc_array(vstack([flow, hstack([-into, visits])]))
        programme = highspy.HighsLp()
        programme.num_col_, programme.num_row_ = moves + count, 2 * count
        programme.col_cost_ = np.concatenate([np.zeros(moves), -nodes.weight])
        programme.col_lower_ = np.zeros(moves + count)
        programme.col_upper_ = np.concatenate([np.full(moves, highspy.kHighsInf), nodes.reach])
        programme.row_lower_ = np.full(2 * count, -highspy.kHighsInf)
        programme.row_upper_ = np.concatenate([passed * nodes.starts, nodes.starts])
        programme.a_matrix_.start_, programme.a_matrix_.index_ = rows.indptr, rows.indices
        programme.a_matrix_.value_ = rows.data
        self._solver = highspy.Highs()
        self._solver.silent()
        self._solver.setOptionValue("threads", 1)  # none of its own, which a fork of this process would lack
        self._solver.passModel(programme)

    def add(self, found: list[tuple[NDArray[np.int64], float]]) -> None:
        """Sets D, and what each allows to be spent."""
        sets, allowed = [members for members, _ in found], np.array([most for _, most in found])
        members, sizes = np.concatenate(sets), [len(members) for members in sets]
        columns = (len(self.nodes.source) + members).astype(np.int32)
        begin = np.cumsum([0, *sizes[:-1]]).astype(np.int32)
        below = np.full(len(sets), -highspy.kHighsInf)
        threat = self.nodes.threat[members]
        self._solver.addRows(len(sets), below, allowed, len(members), begin, columns, threat)
        self.sets += sets

    def solve(self) -> tuple[NDArray[np.float64], Dual]:
        """(y `[V]`, the prices)."""
        self._solver.run()
        found, count = self._solver.getSolution(), len(self.nodes.weight)
        if not found.dual_valid:  # no prices: they prove nothing, and the other bounds stand
            return np.zeros(count), Dual(np.zeros(count), np.zeros(count), np.zeros(len(self.sets)))
        prices = np.maximum(-np.array(found.row_dual), 0.0)
        visited = np.array(found.col_value)[len(self.nodes.source) :]
        return visited, Dual(prices[:count], prices[count : 2 * count], prices[2 * count :])


def certified(nodes: Nodes, sets: list[NDArray[np.int64]], dual: Dual) -> float:
    """What prices prove, in cells, whatever they are: they are made feasible, and checked and added up exactly.

    Feasible are prices >= 0 with `flow_u >= (1 - p_v) flow_v + arrive_v` for every move, and for every node
    `arrive_v + reach_v + p_v (the spend of all D with v in it) >= w_v`. Rounding raises `flow` until the first can
    hold, lowers `arrive` until it does, and takes the `reach` that is left. Then
    `sum (1 - p) s flow + s arrive + g reach + (what D allows) spend` is no less than the programme's optimum.
    """
    rounded = _feasible(nodes, dual)
    exact = [[Fraction(value) for value in values.tolist()] for values in (rounded.flow, rounded.arrive, dual.spend)]
    flow, arrive, spend = exact
    passed = [1 - Fraction(p) for p in nodes.threat.tolist()]
    for source, target in zip(nodes.source.tolist(), nodes.target.tolist(), strict=True):
        if flow[source] < passed[target] * flow[target] + arrive[target]:
            return float(nodes.weight.sum())
    paid = [Fraction(0)] * len(flow)
    total = Fraction(0)
    for members, price in zip(sets, spend, strict=True):
        if price > 0:
            total += price * Fraction(float(most_stopped(nodes.threat[members], nodes.robots)[-1]))
            for member in members.tolist():
                paid[member] += price
    for node, weight in enumerate(nodes.weight.tolist()):
        starts, p = int(nodes.starts[node]), 1 - passed[node]
        reach = max(Fraction(0), Fraction(weight) - arrive[node] - p * paid[node])
        total += starts * (passed[node] * flow[node] + arrive[node]) + reach * Fraction(float(nodes.reach[node]))
    return float(np.nextafter(float(total), np.inf))


def _feasible(nodes: Nodes, dual: Dual) -> Dual:
    """Prices near these for which every move's condition holds, but for the last bits of rounding."""
    flow, passed = dual.flow.copy(), 1.0 - nodes.threat
    while True:
        least = flow.copy()
        np.maximum.at(least, nodes.source, (passed * flow * (1 + 4 * ULP))[nodes.target])
        if (least == flow).all():
            break
        flow = least
    room = np.full(len(flow), np.inf)
    np.minimum.at(room, nodes.target, (flow[nodes.source] - (passed * flow)[nodes.target]) - 4 * ULP * flow.max())
    return Dual(flow, np.maximum(np.minimum(dual.arrive, room), 0.0), dual.spend)
