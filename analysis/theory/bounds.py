"""The paper's formulas in every reading of SPEC section 7, and our own bounds, each with its proof."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from analysis.theory.exact import PathChances, chances_of, robot_chances
from planner.plan.plan import Leg, Plan, RobotPlan
from planner.simulator.jit import compiled
from planner.simulator.searches import neighbour_pairs
from planner.world.levels import find_levels
from planner.world.world import World, check_starts

# The paper's formulas, one function each, in every reading of SPEC section 7; values in cells or probabilities.
#
# Eq. (4) follows a robot along its path. Eqs. (5) and (6) need the plan's legs and areas, and are undefined (None) for
# an external plan.

Value = TypeVar("Value")
NEXT_TO_NOTHING = 1e-12
"""Cells: remainder of a bound below which it is rounded up instead of computed."""


@dataclass(frozen=True)
class Meanings(Generic[Value]):
    """One value for each meaning of "covered" (SPEC section 2), in cells."""

    visited: Value
    survived: Value


@dataclass(frozen=True)
class Equation5:
    """Eq. (5) of one robot in its two readings, in cells; None where it is undefined."""

    printed: float | None
    with_c00: float | None


@dataclass(frozen=True)
class Theorem3:
    """Eq. (6) in its four readings of |C|, in cells: {interior, travel} x {set, multiset}."""

    interior_set: float
    interior_multiset: float
    travel_set: float
    travel_multiset: float


@dataclass(frozen=True, eq=False)
class Bounds:
    """Every formula for one plan. `eq1`, `eq4`, `eq5` have one entry a robot; None where undefined."""

    eq1: tuple[float, ...]
    eq2_printed: float
    team_survival: float
    eq4: tuple[Meanings[float], ...]
    eq5: tuple[Equation5, ...]
    theorem3_visited: Theorem3 | None
    theorem3_survived: Theorem3 | None
    ideal_eq7: float
    ideal_team: float
    json_keys = "eq1 eq2_printed team_survival eq4 eq5 theorem3 ideal_eq7 ideal_team"

    @property
    def theorem3(self) -> dict[str, Theorem3 | dict[str, None]]:
        """Eq. (6) by meaning; None for each reading where it is undefined."""
        found = {"visited": self.theorem3_visited, "survived": self.theorem3_survived}
        return {meaning: one or dict.fromkeys(Theorem3.__dataclass_fields__) for meaning, one in found.items()}


def all_bounds(plan: Plan, world: World) -> Bounds:
    """Every formula of the paper for this plan, and the team's upper bound (of a resumed mission: from its state on).

    Undefined for uncertain and for unknown maps. With a Weibull shape or hazard multipliers only eqs. (1) and (4) hold
    (SPEC section 14).
    """
    if world.uncertainty is not None or world.knowledge is not None:
        return _nothing_known(plan)
    robots = chances_of(plan, world)
    gains = tuple(eq4(robot) for robot in robots)
    if not plan.failure_model.is_plain:
        return replace(
            _nothing_known(plan),
            eq1=tuple(robot.survival for robot in robots),
            team_survival=team_survival(robots),
            eq4=gains,
        )
    # Theorem 3's C does not include ways back to base, on which robots cross each other's areas.
    others = plan.is_external or plan.state is not None or plan.comes_home
    connecting = None if others else connecting_cells(plan)
    left, known, alive = world.accessible(plan.starts).ravel(), 0, len(robots)
    if plan.state is not None:
        left[plan.state.visited] = False
        known, alive = len(plan.state.visited), sum(robot.alive for robot in plan.state.robots)
    threat = np.sort(world.threat.ravel()[left].astype(np.float64))
    return Bounds(
        eq1=tuple(robot.survival for robot in robots),
        eq2_printed=eq2_printed(robots, plan.makespan),
        team_survival=team_survival(robots),
        eq4=gains,
        eq5=eq5(plan, world),
        theorem3_visited=None if connecting is None else theorem3(sum(g.visited for g in gains), connecting),
        theorem3_survived=None if connecting is None else theorem3(sum(g.survived for g in gains), connecting),
        ideal_eq7=known + ideal_team(threat, 1),
        ideal_team=known + ideal_team(threat, alive),
    )


def _nothing_known(plan: Plan) -> Bounds:
    unknown, each = float("nan"), len(plan.robots)
    gain, sum5 = Meanings(unknown, unknown), Equation5(None, None)
    return Bounds((unknown,) * each, unknown, unknown, (gain,) * each, (sum5,) * each, None, None, unknown, unknown)


def eq2_printed(robots: list[PathChances], makespan: int) -> float:
    """Eq. (2) as printed: `prod_t (1 - prod_i p_i,t)`, p = 0 for a robot that does not move at step t.

    The probability that the whole team is never hit in one single step, which is not the event that the paper states.
    """
    together = np.ones(makespan + 1)
    for robot in robots:
        threat = np.zeros(makespan + 1)
        threat[robot.steps] = robot.threat
        together *= threat
    return float(np.prod(1.0 - together))


def team_survival(robots: list[PathChances]) -> float:
    """The event of eq. (2), some robot alive at the end; open loop: `1 - prod_i (1 - Surv(R_i))`.

    By logarithms: the product of many numbers close to 1 is 1 in float64.
    """
    with np.errstate(divide="ignore"):  # a survival of 1
        return float(-np.expm1(np.log1p([-robot.survival for robot in robots]).sum()))


def eq4(robot: PathChances) -> Meanings[float]:
    """Eq. (4): expected number of distinct cells on the robot's own path, in both meanings."""
    return Meanings(float(robot.reach[robot.first].sum()), float(robot.passed[robot.first].sum()))


def eq5(plan: Plan, world: World) -> tuple[Equation5, ...]:
    """Eq. (5) of every robot, as printed (products start at y = 1, so that C_0,0 is omitted) and with C_0,0.

    Undefined if the nominal run shares areas, if robots have a range or return to base, and for a robot without legs or
    with a dangerous start.
    """
    undefined = Equation5(None, None)
    if plan.settings is None or plan.shares or plan.state is not None:
        return (undefined,) * len(plan.robots)
    if plan.settings.range is not None or plan.comes_home:
        return (undefined,) * len(plan.robots)
    levels = find_levels(world.threat, world.accessible(plan.starts), plan.settings.levels)
    threat = world.threat.ravel().astype(np.float64)
    return tuple(
        _eq5_of_robot(robot, plan, levels.values, threat) if robot.legs and threat[robot.path[0]] == 0 else undefined
        for robot in plan.robots
    )


def _eq5_of_robot(
    robot: RobotPlan, plan: Plan, level_values: NDArray[np.float64], threat: NDArray[np.float64]
) -> Equation5:
    """The areas in visiting order: |A_a| times the probability to cover all areas up to a and travel between them."""
    own_start = robot.legs[0].kind == "cover" and robot.legs[0].start == 0
    base = 0.0 if own_start else 1.0
    printed, with_c00, cover, travel, first_travel, connections = base, base, 1.0, 1.0, 1.0, 0
    for number, leg in enumerate(robot.legs):
        if leg.kind == "travel":
            chance = float(np.prod(1.0 - threat[robot.path[leg.start : leg.stop]]))
            if connections == 0:
                first_travel *= chance  # several if a journey was abandoned before the first area
            else:
                travel *= chance
            continue
        size = len(plan.area(leg.area).cells)
        cover *= float(1.0 - level_values[leg.level]) ** (leg.stop - leg.start)
        if number == 0 and own_start:
            printed += size
            with_c00 += size
            continue
        printed += cover * travel * size
        with_c00 += cover * travel * first_travel * size
        connections += 1
    return Equation5(printed, with_c00)


@dataclass(frozen=True, eq=False)
class ConnectingCells:
    """The two readings of Theorem 3's C, as lists of cell indices with repetition.

    Attributes:
        interior: every cell entered on a travel leg but its last.
        travel: every cell entered while traveling, and the start cells.
    """

    interior: NDArray[np.int64]
    travel: NDArray[np.int64]


def connecting_cells(plan: Plan) -> ConnectingCells:
    """The cells of the connecting paths of every robot of a plan with legs."""
    interior: list[int] = []
    travel: list[int] = [int(robot.path[0]) for robot in plan.robots]
    for robot in plan.robots:
        for start, stop in _journeys(robot, plan):
            travel += robot.path[start:stop].tolist()
            interior += robot.path[start : stop - 1].tolist()
    return ConnectingCells(np.array(interior, dtype=np.int64), np.array(travel, dtype=np.int64))


def _journeys(robot: RobotPlan, plan: Plan) -> Iterator[tuple[int, int]]:
    """The half-open ranges of steps in which cells are entered on each journey of a robot.

    A journey is a travel leg and the entry into its area, which belongs to the cover leg that follows. A journey of one
    move has no travel leg; a journey cut short by sharing has no entry; a robot in its area makes none.
    """
    for number, leg in enumerate(robot.legs):
        follows = robot.legs[number + 1] if number + 1 < len(robot.legs) else None
        if leg.kind == "travel" and not (follows and _enters(follows, leg)):
            yield leg.start, leg.stop
        elif leg.kind == "cover" and leg.start > 0:
            before = robot.legs[number - 1] if number else None
            if before is not None and _enters(leg, before):
                yield before.start, leg.start + 1
            elif robot.path[leg.start - 1] not in plan.area(leg.area).cells:
                yield leg.start, leg.start + 1


def _enters(cover: Leg, travel: Leg) -> bool:
    """Whether this cover leg begins where this travel leg to the same area ends."""
    return (travel.kind, cover.kind) == ("travel", "cover") and (travel.area, travel.stop) == (cover.area, cover.start)


def theorem3(expected_alone: float, connecting: ConnectingCells) -> Theorem3:
    """Eq. (6): `sum_i E(R_i) - |C|` from the sum of eq. (4) over the robots, in its four readings."""
    readings = [of for cells in (connecting.interior, connecting.travel) for of in (np.unique(cells), cells)]
    return Theorem3(*(expected_alone - len(cells) for cells in readings))


def ideal_team(threat: NDArray[np.float64], robots: int) -> float:
    """Upper bound of the coverage of `robots` robots on any map, in cells, for every strategy, adaptive ones included.

    With the accessible cells in increasing order of p, the j-th is reached if fewer than k hits fell on the j - 1
    before it: `sum_j P(PoissonBinomial(p_1 .. p_{j-1}) < k)`. One robot gives eq. (7). The sum ends when the remaining
    probability is negligible; the most that the rest can add is then added.

    Args:
        threat: float64 `[accessible]`, the accessible cells' p.
    """
    return float(np.count_nonzero(threat == 0) + _reached(np.sort(threat[threat > 0]), np.zeros(robots)))


@compiled
def _reached(dangerous, hits):  # type: ignore[no-untyped-def]
    """Reached cells of `dangerous` `[n]`, p in increasing order; `hits` `[k]` of zeros: P(0 .. k - 1 hits)."""
    total, cells, hits[0] = 0.0, len(dangerous), 1.0
    for place in range(cells):
        reached, p = hits.sum(), dangerous[place]
        if reached * (cells - place) < NEXT_TO_NOTHING:  # probabilities only fall: the rest is smaller
            return total + reached * (cells - place)
        total += reached
        for lost in range(len(hits) - 1, 0, -1):
            hits[lost] = hits[lost] * (1.0 - p) + hits[lost - 1] * p
        hits[0] *= 1.0 - p
    return total


# Our own bounds, each with its proof: Theorem 3 corrected, coverage until the first loss, the upper bound on a map.
#
# They need only the plan or the world, no rollouts. `q_i(c)` is the probability that robot i covers cell c on its own
# path, in one of the two meanings of SPEC section 2 (`visited`: it makes its first entry of c; `survived`: it also
# survives that entry), and `E(R_i) = sum_c q_i(c)` is eq. (4).


@dataclass(frozen=True)
class CorrectedTheorem3:
    """Three lower bounds on the open loop's E(team), in cells: `count <= largest <= spread <= E(team)`.

    Attributes:
        count: the paper's form, `sum_i E(R_i) - |C|`, with the C that makes it true.
        largest: the same with probabilities instead of counts.
        spread: the tightest of them.
    """

    count: float
    largest: float
    spread: float


def corrected_theorem3(plan: Plan, world: World) -> Meanings[CorrectedTheorem3]:
    """Theorem 3 in a correct form, from the robots' own expectations and the cells that they share.

    A cell is shared if m >= 2 paths enter it. Let S = sum_i q_i and M = max_i q_i over those m robots.

        count:    E(team) >= sum_i E(R_i) - sum_shared (m - 1)
        largest:  E(team) >= sum_i E(R_i) - sum_shared (S - M)
        spread:   E(team) >= sum_i E(R_i) - sum_shared (S - 1 + (1 - M) (1 - (S - M) / (m - 1)) ** (m - 1))

    So the paper's C is the list of visits by other robots to cells already on some robot's path, each cell m - 1
    times, on connecting and coverage paths. (The printed C is too small because it omits cells of coverage paths that
    others cross; the list of all cells entered while traveling is too large.)

    Proof. In the open loop the robots are independent, so a cell is covered with probability `U = 1 - prod_i (1 -
    q_i)`, and `E(team) = sum_c U(c) = sum_i E(R_i) - sum_shared (S - U)`; cells on one path have U = S. It remains to
    bound U from below on shared cells. U >= M, since the cell is covered if the likeliest robot covers it: `largest`.
    All q_i <= 1, so S - M <= m - 1: `count`. The m - 1 others have mean probability a = (S - M) / (m - 1), and their
    prod (1 - q_i) <= (1 - a) ** (m - 1), a geometric mean being at most the arithmetic one: `spread`; and it is at
    least `largest`, as (1 - M) (1 - a) ** (m - 1) <= 1 - M.

    None can be improved without further information. `count` is attained if no visit is dangerous. `largest` is the
    best bound for any dependence of the robots (it is attained when the covering events are nested), so that it does
    not need independence. `spread` is the best function of (m, S, M) for independent robots: it is attained by m - 1
    robots of equal probability a, a choice with these m, S and M as a <= M. It is an equality for one or two robots and
    wherever a cell is on at most two paths. Knowledge of every q_i gives the closed form. (The best bound from S and
    the sum of q_i q_j over pairs, for any other dependence, is that of Dawson and Sankoff, "An inequality for
    probabilities", Proc. AMS 18, 1967. It was below `spread` on 99 % of the paper's maps.)

    Cost: linear in the total length of the paths: a sum, a maximum and a count for each first entry.
    """
    robots = [robot_chances(robot, world) for robot in plan.robots]
    chances = [robot.reach for robot in robots], [robot.passed for robot in robots]
    return Meanings(*(_corrected(robots, of_meaning, world.threat.size) for of_meaning in chances))


def _corrected(robots: list[PathChances], chances: list[NDArray[np.float64]], cells: int) -> CorrectedTheorem3:
    total, most, robots_of = np.zeros(cells), np.zeros(cells), np.zeros(cells, dtype=np.int64)
    for robot, chance in zip(robots, chances, strict=True):
        own = robot.cells[robot.first]
        total[own] += chance[robot.first]
        most[own] = np.maximum(most[own], chance[robot.first])
        robots_of[own] += 1
    shared = robots_of >= 2
    expected, others = float(total.sum()), robots_of[shared] - 1
    rest = total[shared] - most[shared]
    covered = 1.0 - (1.0 - most[shared]) * (1.0 - rest / others) ** others
    return CorrectedTheorem3(*(expected - float(of.sum()) for of in (others, rest, total[shared] - covered)))


def until_first_loss(plan: Plan, world: World) -> Meanings[float]:
    """Expected cells covered before any robot is lost: a lower bound for the closed and for the open loop.

    `sum_c prod (1 - p)` over all entries, by any robot, that come before the nominal run's first entry of c in the
    order of actions (step, then robot); for `survived` including that entry.

    Proof. Up to the first loss the closed loop makes the nominal run's moves, because they depend only on the past. If
    none of those entries destroys a robot, which has that probability by independence, c is entered (and survived). Sum
    over the cells.

    For one robot it is the expected coverage, because the loss of the only robot ends the run. Cost: a sort of the
    entries. It holds for threats checked on every visit, and for `first_visit`, which checks fewer.
    """
    robots = [robot_chances(robot, world) for robot in plan.robots]
    steps = np.concatenate([robot.steps for robot in robots])
    number = np.repeat(np.arange(len(robots)), [len(robot.steps) for robot in robots])
    order = np.lexsort((number, steps))
    cells = np.concatenate([robot.cells for robot in robots])[order]
    passed = np.cumprod(1.0 - np.concatenate([robot.threat for robot in robots])[order])
    before = np.concatenate([[1.0], passed[:-1]])
    first = np.unique(cells, return_index=True)[1]
    return Meanings(float(before[first].sum()), float(passed[first].sum()))


def reach_chances(world: World, starts: ArrayLike) -> NDArray[np.float64]:
    """Upper bound of the probability to visit each cell, for every strategy, adaptive ones included; float64 `[N]`.

    `g(c) = 1 - prod_i (1 - r_i(c))`, where `r_i(c)` is the largest product of (1 - p) over the cells before c, the
    start included, on any path from robot i's start to c. 0 if no robot can reach c.

    Proof. Let `r(x, c)` be that largest product from cell x, x itself left out, and `F` the product of 1 - r(x_i, c)
    over the robots alive at x_i. If a robot moves to y != c, its factor becomes 1 - r(y, c) with probability 1 - p(y),
    and 1 with probability p(y): on average 1 - (1 - p(y)) r(y, c) >= 1 - r(x, c), as x, y, ... is a path from x. So F
    does not fall on average, for any move of any robot, until c is visited. It is at most 1, and 0 once a robot is next
    to c or in it, so P(c never visited) >= E(F at the end) >= F at the start. Entering the start is such a move, with
    `r_i(c) = (1 - p(start)) r(start, c)`, and c is visited for certain if it is a start.
    """
    checked = check_starts(starts, world.threat, world.source)
    chosen, team = np.unique(checked, axis=0, return_counts=True)
    missed = np.zeros(world.threat.size)  # logarithms: 1 - product would lose values below 1e-16
    with np.errstate(divide="ignore"):
        for start, robots in zip(chosen, team.tolist(), strict=True):
            missed += robots * np.log1p(-np.minimum(best_survival(world, start[None])[0], 1.0))
    return np.where(np.isnan(world.threat.ravel()), 0.0, -np.expm1(missed))


def best_survival(world: World, starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """`r_i(c)` of `reach_chances` for a robot at each of `starts` `[S, 2]`, float64 `[S, N]`; 0 if unreachable."""
    threat = world.threat.ravel().astype(np.float64)
    source, target = neighbour_pairs(world.shape, ~np.isnan(threat))
    # Leaving a cell costs its hazard; a safe cell gets a tiny one, because csgraph may drop an explicit 0.
    hazard = np.maximum(-np.log1p(-threat[source]), np.finfo(np.float64).tiny)
    graph = csr_array((hazard, (source, target)), shape=(threat.size, threat.size))
    chances: NDArray[np.float64] = np.exp(-dijkstra(graph, indices=starts[:, 0] * world.shape[1] + starts[:, 1]))
    return chances


def ideal_connected(world: World, starts: ArrayLike) -> float:
    """Upper bound of the coverage of a team on this map, in cells, for every strategy, adaptive ones included.

    Split the accessible cells into D and the rest: `sum_D g(c) + ideal_team over the rest`, with g of `reach_chances`.
    D holds every safe cell and the dangerous ones of smallest g, as many as minimise the bound.

    Proof. Expected cells visited are those of D, each visited with probability g(c) at most, and those of the rest. For
    the latter the proof of `ideal_team` holds: it counts losses in these cells only, and losses elsewhere add to them.
    Every split gives a bound, and so does their minimum. With no dangerous cell in D and all g = 1 it equals
    `ideal_team`, so it never exceeds that. It is smaller if safe cells lie behind dangerous ones and robots are few.

    Cost: a shortest-path search for each start, and the ideal for about 64 sizes of D.
    """
    checked = check_starts(starts, world.threat, world.source)
    reach, accessible = reach_chances(world, checked), world.accessible(checked).ravel()
    threat = world.threat.ravel().astype(np.float64)
    dangerous = np.flatnonzero(accessible & (threat > 0))
    dangerous = dangerous[np.argsort(reach[dangerous], kind="stable")]
    sizes = np.unique(np.linspace(0, len(dangerous), num=65).astype(np.int64)).tolist()
    rest = min(
        float(reach[dangerous[:size]].sum()) + ideal_team(threat[dangerous[size:]], len(checked)) for size in sizes
    )
    return float(reach[accessible & (threat == 0)].sum()) + rest
