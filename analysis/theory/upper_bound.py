"""Policy-independent upper bounds: no strategy of a team covers more of this map on average, adaptive ones included."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csc_array, csr_array, hstack, vstack
from scipy.sparse.csgraph import dijkstra

from analysis.theory.bounds import ideal_connected, ideal_team
from analysis.theory.flow_programme import (
    CLASSES,
    INF,
    MOST_NODES,
    ULP,
    Nodes,
    Row,
    contract,
    make_solver,
    missing_ways,
    walk_bound,
)
from planner.plan.plan import Plan
from planner.simulator.searches import neighbour_pairs
from planner.world.uncertain_maps import Hazard
from planner.world.world import World, check_starts

# The linear programme over expected moves: an upper bound of expected cells visited, certified by its dual prices.
#
# The programme is solved by HiGHS, whose result is not trusted: its dual solution is rounded to a feasible one and
# evaluated in exact rational arithmetic, which gives the bound.
#
# Nodes `V`: the dangerous cells, and the safe areas (4-connected sets of safe cells, in which moves are free). A node
# has `w` cells and threat `p` (0 for a safe area); `s` robots start there. Unknowns: `x_uv`, expected moves of the team
# from node u to node v, and `y_v`, the probability that a cell of v is visited. Maximise `sum w_v y_v` subject to
#
#     flow:    sum_v x_uv <= (1 - p_u) a_u         a_u = s_u + sum_t x_tu, the expected arrivals
#     arrive:  y_v <= a_v
#     reach:   y_v <= g_v                          `analysis.theory.bounds.reach_chances`
#     spend:   sum_D p_v y_v <= E min(k, hits)     for every set D of dangerous cells
#     way:     a cell is visited no more often than it is reached, `analysis.theory.flow_programme`
#
# Proof. A robot leaves a node only after an arrival that it survived; a cell is visited only if its node is arrived at.
# The team's first visit of a cell destroys the robot with probability p for any past, so that the left side of `spend`
# is the expected number of robots lost at first visits of D. They are at most k, and at most as many as there are hits
# among |D| draws made in advance, one a cell: a Poisson-binomial number. So the expectations of any strategy satisfy
# the programme, and its optimum is at least their `sum w_v y_v`. Assumption: every visit is checked independently.

ROUNDS = 200
"""Most solutions of the programme; fewer give a weaker bound."""
GAIN, PATIENCE = 2e-4, 10
"""It ends when PATIENCE rounds together gain less than this share of the cells."""
NEW_SETS = 8
"""Sets D added in a round from each order of the cells."""


SWEEPS = 100
"""Most sweeps that raise the prices one by one."""


@dataclass(frozen=True, eq=False)
class Dual:
    """Prices of the programme's constraints, float64: `flow`, `arrive` `[V]`, `rows` of its sets D and ways."""

    flow: NDArray[np.float64]
    arrive: NDArray[np.float64]
    rows: NDArray[np.float64]


def flow_bound(nodes: Nodes, rounds: int = ROUNDS, ways: bool = True, thresholds: bool = False) -> float:
    """The certified bound of the programme, in cells. Violated constraints (sets D and ways) are added in rounds.

    Args:
        nodes: the world. rounds: most solutions of the programme.
        ways: False omits the way constraints, for a fifth of the time.
        thresholds: True restricts teams to walks too (`walk_bound`), as one robot is; takes ten times as long or more.
    """
    dangerous = np.flatnonzero(nodes.threat > 0)
    programme = Programme(nodes)
    optima: list[float] = []
    while True:
        moves, visited, dual = programme.solve()
        optima.append(float(nodes.weight @ visited))
        enough = optima[-PATIENCE - 1 : -PATIENCE] and optima[-PATIENCE - 1] - optima[-1] < GAIN * nodes.weight.sum()
        orders = (np.argsort(-visited[dangerous], kind="stable"), np.argsort(nodes.threat[dangerous], kind="stable"))
        found: list[Row] = [new for order in orders for new in _overspent(nodes, dangerous[order], visited)]
        found += missing_ways(nodes, moves, visited) if ways else []
        if enough or not found or len(optima) == rounds:
            most = min(certified(nodes, programme.rows, dual), float(nodes.weight.sum()))
            robots = max(CLASSES) if thresholds else 1
            if nodes.robots > robots or not ways or rounds < ROUNDS or len(nodes.weight) > MOST_NODES:
                return most
            return min(most, walk_bound(nodes, programme.rows, dual.arrive, dual.rows))
        programme.add(found)


def _overspent(nodes: Nodes, order: NDArray[np.int64], visited: NDArray[np.float64]) -> Iterator[Row]:
    """The prefixes D of `order` that violate `spend` most; none within rounding."""
    most = most_stopped(nodes.threat[order], nodes.robots)
    over = np.cumsum(nodes.threat[order] * visited[order]) - most
    peaks = np.flatnonzero((over >= np.append(over[1:], -1.0)) & (over > np.insert(over[:-1], 0, -1.0)) & (over > 1e-6))
    for place in peaks[np.argsort(-over[peaks], kind="stable")][:NEW_SETS].tolist():
        yield spend(nodes, np.sort(order[: place + 1]), float(most[place]))


def spend(nodes: Nodes, members: NDArray[np.int64], most: float) -> Row:
    """The constraint of a set D, int64: its nodes lose at most `most` robots."""
    return Row(members, nodes.threat[members], members[:0], nodes.threat[:0], most)


def most_stopped(threat: NDArray[np.float64], robots: int) -> NDArray[np.float64]:
    """E min(robots, hits) of the first 1, 2, ... cells of `threat` `[C]`, one visit each, float64 `[C]`; rounded up.

    Only sums and products of positive numbers, three roundings a cell: the relative error is at most (4 C + k) ulp.
    """
    at_least = np.zeros(min(robots, len(threat)) + 1)
    at_least[0] = 1.0
    most = np.empty(len(threat))
    for place, p in enumerate(threat.tolist()):
        at_least[1:] = at_least[1:] * (1.0 - p) + at_least[:-1] * p
        most[place] = at_least[1:].sum()
    return most * (1.0 + (4.0 * len(threat) + len(at_least) + 4) * ULP)


class Programme:
    """The programme with its `rows` so far. It stays in the solver, so that added rows reuse the basis."""

    def __init__(self, nodes: Nodes) -> None:
        """Without added rows: columns are x `[E]` and y `[V]`, rows `flow` `[V]` and `arrive` `[V]`."""
        self.nodes, self.rows = nodes, list[Row]()
        count, moves = len(nodes.weight), len(nodes.source)
        every, each, passed = np.arange(moves), np.arange(count), 1.0 - nodes.threat
        into = coo_array((np.ones(moves), (nodes.target, every)), shape=(count, moves)).tocsr()
        out = coo_array((np.ones(moves), (nodes.source, every)), shape=(count, moves)).tocsr()
        visits = csr_array((np.ones(count), (each, each)))
        flow = hstack([out - into.multiply(passed[:, None]), csr_array((count, count))])
        rows = csc_array(vstack([flow, hstack([-into, visits])]))
        cost, upper = np.append(np.zeros(moves), -nodes.weight), np.append(np.full(moves, INF), nodes.reach)
        most = np.concatenate([passed * nodes.starts, nodes.starts])
        self._solver = make_solver(cost, upper, rows, np.full(2 * count, -INF), most)

    def add(self, found: Sequence[Row]) -> None:
        """Add rows."""
        first = len(self.nodes.source)
        for row in found:
            columns, shares = np.append(row.moves, first + row.nodes), np.append(-row.share, row.paid)
            self._solver.addRow(-INF, row.most, len(columns), columns.astype(np.int32), shares)
        self.rows += found

    def solve(self) -> tuple[NDArray[np.float64], NDArray[np.float64], Dual]:
        """Solve the programme: (x `[E]`, y `[V]`, prices)."""
        self._solver.run()
        found, count = self._solver.getSolution(), len(self.nodes.weight)
        if not found.dual_valid:  # without prices this bound is trivial; the others remain
            nothing = np.zeros(count)
            return np.zeros(len(self.nodes.source)), nothing, Dual(nothing, nothing, np.zeros(len(self.rows)))
        prices = np.maximum(-np.array(found.row_dual), 0.0)
        moves, visited = np.split(np.array(found.col_value), [len(self.nodes.source)])
        return moves, visited, Dual(prices[:count], prices[count : 2 * count], prices[2 * count :])


def certified(nodes: Nodes, rows: Sequence[Row], dual: Dual) -> float:
    """The bound that any prices prove, in cells: they are made feasible, and evaluated exactly.

    Prices >= 0 are feasible if `flow_u >= (1 - p_v) flow_v + arrive_v + (shares of all ways in u -> v)` for every move,
    and `arrive_v + reach_v + p_v (spend of all D with v in it) + (ways to v) >= w_v` for every node. `flow` is raised
    until the first holds, and `reach` takes the remainder. Then `sum (1 - p) s flow + s arrive + g reach + (limit of D)
    spend + (free part) way` is at least the programme's optimum.
    """
    tolls, paid, total = [Fraction(0)] * len(nodes.source), [Fraction(0)] * len(nodes.weight), Fraction(0)
    passed = [1 - Fraction(p) for p in nodes.threat.tolist()]
    for row, price in zip(rows, map(Fraction, dual.rows.tolist()), strict=True):
        if not price:
            continue
        total += price * Fraction(row.most)
        for node, share in zip(row.nodes.tolist(), row.paid.tolist(), strict=True):
            paid[node] += price * Fraction(share)
        for move, share in zip(row.moves.tolist(), row.share.tolist(), strict=True):
            tolls[move] += price * Fraction(share)
    arrive = [Fraction(value) for value in dual.arrive.tolist()]
    toll = np.array([float(value) for value in tolls]) * (1 + ULP)
    flow = [Fraction(value) for value in _feasible(nodes, dual, toll).tolist()]
    for move, (source, target) in enumerate(zip(nodes.source.tolist(), nodes.target.tolist(), strict=True)):
        if flow[source] < passed[target] * flow[target] + arrive[target] + tolls[move]:
            return float(nodes.weight.sum())
    for node, weight in enumerate(nodes.weight.tolist()):
        reach = max(Fraction(0), Fraction(weight) - arrive[node] - paid[node])
        total += int(nodes.starts[node]) * (passed[node] * flow[node] + arrive[node])
        total += reach * Fraction(float(nodes.reach[node]))
    return float(np.nextafter(float(total), np.inf))


def _feasible(nodes: Nodes, dual: Dual, toll: NDArray[np.float64]) -> NDArray[np.float64]:
    """Feasible prices `flow` `[V]`, no lower than the dual's; `toll` `[E]`: sum of the ways' shares of each move.

    Violated prices are raised in sweeps. A remaining violation is removed by raising all prices, of dangerous nodes by
    `more` and of safe ones by a little less: there are no moves between safe areas.
    """
    flow, passed = dual.flow.copy(), 1.0 - nodes.threat
    if not len(nodes.source):
        return flow
    asked = (dual.arrive[nodes.target] + toll) * (1 + 4 * ULP)
    for _ in range(SWEEPS):
        needed = passed[nodes.target] * flow[nodes.target] * (1 + 4 * ULP) + asked
        short = float((needed - flow[nodes.source]).max())
        if short <= 0:
            return flow
        np.maximum.at(flow, nodes.source, needed * (1 + 2 * ULP))
    least = float(nodes.threat[nodes.threat > 0].min()) / 2
    short += 16 * ULP * float(flow.max())
    return flow + (short / least) * (1 + 1e-6) * np.where(nodes.threat > 0, 1.0, 1.0 - least)


MOST_CELLS = 500
"""Accessible cells up to which the programme is solved in full by default: about half a second."""
MOST_DANGEROUS, HASTY = 1000, 12
"""Dangerous cells up to which it is solved by default on larger maps, in HASTY rounds: within 3 seconds."""


@dataclass(frozen=True)
class AnyStrategy:
    """Upper bounds of expected cells visited for every strategy.

    Attributes:
        flow: certified bound of the programme; None: it was not solved.
        connected: `bounds.ideal_connected`. ideal: `bounds.ideal_team`.
    """

    flow: float | None
    connected: float
    ideal: float

    @property
    def cells(self) -> float:
        """The smallest of them."""
        return min(bound for bound in (self.flow, self.connected, self.ideal) if bound is not None)


def any_strategy(
    world: World, starts: ArrayLike, flow: bool | None = None, ways: bool = True, thresholds: bool = False
) -> AnyStrategy:
    """The bounds of `world` for robots at `starts` `[K, 2]`.

    Args:
        flow: whether the programme is solved, which may take seconds; None: in at most HASTY rounds on maps of more
            than MOST_CELLS, and not for more than MOST_DANGEROUS dangerous cells.
        ways, thresholds: as in `flow_bound`.

    Raises:
        WorldError: the map is uncertain or changes.
    """
    world.require_certain_map("the bound for every strategy")
    checked = check_starts(starts, world.threat, world.source)
    threat = np.sort(world.threat[world.accessible(checked)].astype(np.float64))
    solved = np.count_nonzero(threat) <= MOST_DANGEROUS if flow is None else flow
    rounds = ROUNDS if flow or len(threat) <= MOST_CELLS else HASTY
    nodes = contract(world, checked) if solved else None
    return AnyStrategy(
        flow=None if nodes is None else flow_bound(nodes, rounds, ways, thresholds),
        connected=ideal_connected(world, checked),
        ideal=ideal_team(threat, len(checked)),
    )


def most_cells(world: World, starts: ArrayLike, flow: bool | None = None) -> float:
    """The smallest bound of `world`, also for latent hazards; `flow`: as in `any_strategy`.

    For hazards only `ideal_team` holds, with p = q h: it counts first visits of the team, each of which destroys a
    robot with that probability for any past, as cells are independent. Later visits may use what survivors learned.
    """
    if not isinstance(world.uncertainty, Hazard):
        return any_strategy(world, starts, flow).cells
    checked = check_starts(starts, world.threat, world.source)
    accessible = world.accessible(checked)
    threat = world.uncertainty.q[accessible].astype(np.float64) * world.uncertainty.h[accessible]
    return ideal_team(np.sort(threat), len(checked))


def value_bound(world: World, starts: ArrayLike, ways: bool = True, thresholds: bool = False) -> float:
    """Upper bound of the expected value of visited cells: the programme with a cell's value as its weight.

    `ways`, `thresholds`: as in `flow_bound`.
    """
    checked = check_starts(starts, world.threat, world.source)
    if world.value is None:
        return flow_bound(contract(world, checked), ways=ways, thresholds=thresholds)
    largest = float(world.value.max())
    nodes = contract(world, checked, world.value / largest * (1.0 + ULP))
    return flow_bound(nodes, ways=ways, thresholds=thresholds) * largest * (1.0 + ULP)


# The cells within a team's range for any strategy; bounds may exclude the others.


def moves_left(plan: Plan) -> list[int] | None:
    """Moves left of each robot, -1 if it is lost; None: no range. With recharging: moves of a full battery."""
    limit = None if plan.settings is None else plan.settings.range
    if limit is None:
        return None
    moves = list(limit) if isinstance(limit, tuple) else [limit] * len(plan.robots)
    if plan.state is None:
        return moves
    return [most - robot.moves if robot.alive else -1 for most, robot in zip(moves, plan.state.robots, strict=True)]


def within(world: World, plan: Plan) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells that some robot alive could enter with its remaining moves, without losses.

    A robot that returns to base must be able to reach one of its bases from the cell: the fewest moves there and back
    are together at most its moves. With recharging: from its start or from any base that it can reach.
    """
    moves, settings = moves_left(plan), plan.settings
    if moves is None or settings is None:
        return world.accessible(plan.starts)
    steps = _graph(world)
    found = np.zeros(world.threat.size, dtype=bool)
    starts = (plan.starts @ (world.shape[1], 1)).tolist()
    bases = [tuple(sorted(own)) for own in plan.bases] or [()] * len(starts)
    for start, most, own in sorted(set(zip(starts, moves, bases, strict=True))):
        if most >= 0:
            found |= _visitable(steps, start, most, own, recharged=settings.recharge is not None)
    return found.reshape(world.shape)


def _visitable(
    steps: csr_array, start: int, most: int, bases: tuple[int, ...], *, recharged: bool
) -> NDArray[np.bool_]:
    """bool `[N]`: cells that a robot with `most` moves can visit; `bases`: it must return to one of them, if any."""
    back = _moves(steps, bases) if bases else np.zeros(steps.shape[0])
    if back[start] > most:  # a resumed mission: no base is in reach
        back[:] = 0
    reached = np.array([start])
    while True:
        found = np.asarray(_moves(steps, reached) + back <= most)
        full = np.union1d([start], [base for base in bases if found[base]]).astype(np.int64)
        if not recharged or np.array_equal(full, reached):
            return found
        reached = full


def _graph(world: World) -> csr_array:
    """The moves between free cells, `[N, N]`."""
    pairs = neighbour_pairs(world.shape, world.free.ravel())
    return csr_array((np.ones(len(pairs[0])), pairs), shape=(world.threat.size, world.threat.size))


def _moves(steps: csr_array, cells: NDArray[np.int64] | tuple[int, ...]) -> NDArray[np.float64]:
    """float64 `[N]`: fewest moves between each cell and the nearest of `cells`; inf: unreachable."""
    return np.asarray(dijkstra(steps, unweighted=True, indices=np.array(cells), min_only=True))


def trimmed(world: World, plan: Plan) -> World:
    """`world` with obstacles outside the team's range; bounds for every strategy there hold for `world` too."""
    if moves_left(plan) is None:
        return world
    return replace(world, threat=np.where(within(world, plan), world.threat, np.float32(np.nan)))
