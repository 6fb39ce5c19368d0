"""A bound for every strategy: no team covers more of this map, however it decides and whatever it learns on the way.

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

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.optimize import linprog
from scipy.sparse import coo_array, csr_array, vstack

from analysis.theory.bounds import ideal_team
from analysis.theory.own_bounds import ideal_connected, reach_chances
from planner.mrac.costs import neighbour_table
from planner.none import NO_CELL
from planner.worlds.doubt import Hazard
from planner.worlds.world import FOUR_NEIGHBOURS, World, check_starts

ROUNDS = 60
"""Times that sets D are added at most; fewer only make the bound less sharp."""
GAIN, PATIENCE = 1e-4, 5
"""It ends when so many rounds together gain less than this share of the cells."""
NEW_SETS = 4
"""Sets D added a round from each order of the cells."""
MOST_CELLS = 500
"""Accessible cells up to which the programme is solved unasked: within a second."""
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


@dataclass(frozen=True, eq=False)
class Dual:
    """Prices of the programme's constraints, float64: `flow`, `arrive` `[V]`, `spend` `[S]` for the sets D."""

    flow: NDArray[np.float64]
    arrive: NDArray[np.float64]
    spend: NDArray[np.float64]


@dataclass(frozen=True)
class AnyStrategy:
    """Expected cells visited that no strategy exceeds.

    Attributes:
        flow: the programme's bound, certified; None: it was not solved.
        connected: `own_bounds.ideal_connected`. ideal: `bounds.ideal_team`.
    """

    flow: float | None
    connected: float
    ideal: float

    @property
    def cells(self) -> float:
        """The least of them."""
        return min(bound for bound in (self.flow, self.connected, self.ideal) if bound is not None)


def any_strategy(world: World, starts: ArrayLike, flow: bool | None = None) -> AnyStrategy:
    """The bounds of `world` for robots at `starts` `[K, 2]`.

    `flow`: whether the programme is solved, which takes seconds on thousands of cells; None: up to MOST_CELLS of them.
    """
    world.check_settled("the bound for every strategy")
    checked = check_starts(starts, world.threat, world.source)
    threat = np.sort(world.threat[world.accessible(checked)].astype(np.float64))
    solved = len(threat) <= MOST_CELLS if flow is None else flow
    return AnyStrategy(
        flow=flow_bound(contract(world, checked)) if solved else None,
        connected=ideal_connected(world, checked),
        ideal=ideal_team(threat, len(checked)),
    )


def most_cells(world: World, starts: ArrayLike, flow: bool | None = None) -> float:
    """The least of the bounds of `world`, also where hazards are there or not; `flow`: as of `any_strategy`.

    Of hazards `ideal_team` alone is left, with p = q h: it counts first visits of the team, at each of which a robot is
    stopped with that chance whatever came before, as cells are drawn apart. Survivors may know more of visits after it.
    """
    if not isinstance(world.doubt, Hazard):
        return any_strategy(world, starts, flow).cells
    checked = check_starts(starts, world.threat, world.source)
    threat = world.doubt.q[world.accessible(checked)].astype(np.float64) * world.doubt.h[world.accessible(checked)]
    return ideal_team(np.sort(threat), len(checked))


def value_bound(world: World, starts: ArrayLike) -> float:
    """Expected value of visited cells that no strategy exceeds: the programme with a cell's value as its weight."""
    checked = check_starts(starts, world.threat, world.source)
    if world.value is None:
        return flow_bound(contract(world, checked))
    largest = float(world.value.max())
    return flow_bound(contract(world, checked, world.value / largest * (1.0 + ULP))) * largest * (1.0 + ULP)


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


def flow_bound(nodes: Nodes) -> float:
    """The programme's certified bound, in cells: sets D are added while the solution spends more than they allow."""
    dangerous = np.flatnonzero(nodes.threat > 0)
    sets: list[NDArray[np.int64]] = []
    allowed: list[float] = []
    optima: list[float] = []
    while True:
        visited, dual = _solve(nodes, sets, np.array(allowed))
        optima.append(float(nodes.weight @ visited))
        enough = optima[-PATIENCE - 1 : -PATIENCE] and optima[-PATIENCE - 1] - optima[-1] < GAIN * nodes.weight.sum()
        orders = (np.argsort(-visited[dangerous], kind="stable"), np.argsort(nodes.threat[dangerous], kind="stable"))
        found = [new for order in orders for new in _overspent(nodes, dangerous[order], visited)]
        if enough or not found or len(optima) == ROUNDS:
            return min(certified(nodes, sets, dual), float(nodes.weight.sum()))
        sets += [members for members, _ in found]
        allowed += [most for _, most in found]


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


def _solve(
    nodes: Nodes, sets: list[NDArray[np.int64]], allowed: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Dual]:
    """(y `[V]`, the prices) of the programme with these sets; nothing in it is trusted."""
    count, moves = len(nodes.weight), len(nodes.source)
    every, passed = np.arange(moves), 1.0 - nodes.threat
    into = coo_array((np.ones(moves), (nodes.target, every)), shape=(count, moves)).tocsr()
    out = coo_array((np.ones(moves), (nodes.source, every)), shape=(count, moves)).tocsr()
    nothing, each = csr_array((count, count)), csr_array((np.ones(count), (np.arange(count), np.arange(count))))
    row = np.repeat(np.arange(len(sets)), [len(members) for members in sets])
    member = np.concatenate(sets) if sets else np.zeros(0, dtype=np.int64)
    spend = csr_array((nodes.threat[member], (row, moves + member)), shape=(len(sets), moves + count))
    flow = _beside(out - into.multiply(passed[:, None]), nothing)
    found = linprog(
        np.concatenate([np.zeros(moves), -nodes.weight]),
        A_ub=vstack([flow, _beside(-into, each), spend], format="csr"),
        b_ub=np.concatenate([passed * nodes.starts, nodes.starts, allowed]),
        bounds=np.stack([np.zeros(moves + count), np.concatenate([np.full(moves, np.inf), nodes.reach])], axis=1),
        method="highs",
    )
    if found.x is None:  # no prices: they prove nothing, and the other bounds stand
        return np.zeros(count), Dual(np.zeros(count), np.zeros(count), np.zeros(len(sets)))
    prices = np.maximum(-found.ineqlin.marginals, 0.0)
    return found.x[moves:], Dual(prices[:count], prices[count : 2 * count], prices[2 * count :])


def _beside(left: csr_array, right: csr_array) -> csr_array:
    from scipy.sparse import hstack

    return hstack([left, right], format="csr")


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
