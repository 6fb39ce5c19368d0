"""The paper's formulas in every reading of SPEC section 7, and bounds of our own, each with its proof."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from analysis.theory.exact import RobotChances, chances_of, robot_chances
from planner.plan.plan import Leg, Plan, RobotPlan
from planner.simulator.codes import NO_CELL
from planner.simulator.jit import compiled
from planner.simulator.searches import neighbour_table
from planner.world.levels import find_levels
from planner.world.world import World, check_starts

# The paper's formulas, one function each, in every reading of SPEC section 7; values in cells or probabilities.
#
# Eq. (4) follows a robot along its own path; eqs. (5) and (6) need the plan's legs and areas, so they are undefined
# (None) for the plan of another planner.

Value = TypeVar("Value")
NEXT_TO_NOTHING = 1e-12
"""Cells: what may be added to a bound in the place of working it out."""


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


def all_bounds(plan: Plan, world: World) -> Bounds:
    """Every formula of the paper for this plan, and the ideal of the team (in mid-mission: from here on).

    Undefined where the map is in doubt, or robots are not told it. Where they wear, or are more or less susceptible,
    eqs. (1) and (4) alone hold as they are (SPEC section 14).
    """
    if world.doubt is not None or world.knowledge is not None:
        return _nothing_known(plan)
    robots = chances_of(plan, world)
    gains = tuple(eq4(robot) for robot in robots)
    if not plan.bearing.is_plain:
        return replace(
            _nothing_known(plan),
            eq1=tuple(robot.survival for robot in robots),
            team_survival=team_survival(robots),
            eq4=gains,
        )
    # Theorem 3's C knows no way home, on which robots cross each other's areas.
    others = plan.is_foreign or plan.state is not None or plan.comes_home
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


def eq2_printed(robots: list[RobotChances], makespan: int) -> float:
    """Eq. (2) as printed: `prod_t (1 - prod_i p_i,t)`, p = 0 for a robot that does not move at step t.

    The chance that the whole team is never hit in one single step, which is not the event that the paper states.
    """
    together = np.ones(makespan + 1)
    for robot in robots:
        threat = np.zeros(makespan + 1)
        threat[robot.steps] = robot.threat
        together *= threat
    return float(np.prod(1.0 - together))


def team_survival(robots: list[RobotChances]) -> float:
    """The event that eq. (2) states, some robot alive at the end; open loop `1 - prod_i (1 - Surv(R_i))`.

    By logarithms: the product of many numbers next to 1 is 1 in float64.
    """
    with np.errstate(divide="ignore"):  # a robot that surely survives
        return float(-np.expm1(np.log1p([-robot.survival for robot in robots]).sum()))


def eq4(robot: RobotChances) -> Meanings[float]:
    """Eq. (4): expected cells new on the robot's own path, whatever others visited; in both meanings."""
    return Meanings(float(robot.reach[robot.first].sum()), float(robot.passed[robot.first].sum()))


def eq5(plan: Plan, world: World) -> tuple[Equation5, ...]:
    """Eq. (5) of every robot, as printed (products start at y = 1, so C_0,0 is left out) and with C_0,0.

    Undefined where the nominal run shares areas, where robots have a range or come home, where a robot has no legs, and
    where its start is dangerous.
    """
    undefined = Equation5(None, None)
    if plan.settings is None or plan.shares or plan.state is not None:
        return (undefined,) * len(plan.robots)
    if plan.settings.range is not None or plan.comes_home:
        return (undefined,) * len(plan.robots)
    levels = find_levels(world, world.accessible(plan.starts), plan.settings.levels)
    threat = world.threat.ravel().astype(np.float64)
    return tuple(
        _eq5_of_robot(robot, plan, levels.values, threat) if robot.legs and threat[robot.path[0]] == 0 else undefined
        for robot in plan.robots
    )


def _eq5_of_robot(
    robot: RobotPlan, plan: Plan, level_values: NDArray[np.float64], threat: NDArray[np.float64]
) -> Equation5:
    """The areas in visiting order: |A_a| times the chance to cover all areas up to a and travel between them."""
    own_start = robot.legs[0].kind == "cover" and robot.legs[0].start == 0
    base = 0.0 if own_start else 1.0
    printed, with_c00, cover, travel, first_travel, connections = base, base, 1.0, 1.0, 1.0, 0
    for number, leg in enumerate(robot.legs):
        if leg.kind == "travel":
            chance = float(np.prod(1.0 - threat[robot.path[leg.start : leg.stop]]))
            if connections == 0:
                first_travel *= chance  # several where a way was given up before the first area
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

    A journey is a travel leg and the entry into its area, which belongs to the cover leg that follows. One of a single
    move has no travel leg; one cut short by sharing has no entry. A robot that stands in its area makes none.
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
    """Does this cover leg begin where this travel leg to the same area ends?"""
    return (travel.kind, cover.kind) == ("travel", "cover") and (travel.area, travel.stop) == (cover.area, cover.start)


def theorem3(expected_alone: float, connecting: ConnectingCells) -> Theorem3:
    """Eq. (6): `sum_i E(R_i) - |C|` from the sum of eq. (4) over the robots, in its four readings."""
    return Theorem3(
        interior_set=expected_alone - len(np.unique(connecting.interior)),
        interior_multiset=expected_alone - len(connecting.interior),
        travel_set=expected_alone - len(np.unique(connecting.travel)),
        travel_multiset=expected_alone - len(connecting.travel),
    )


def ideal_team(threat: NDArray[np.float64], robots: int) -> float:
    """The ideal of a team of `robots`, in cells: an upper bound for every strategy, adaptive ones included.

    With the accessible cells in increasing order of p, the j-th is still reached if fewer than k hits fell on the
    j - 1 before it: `sum_j P(PoissonBinomial(p_1 .. p_{j-1}) < k)`. One robot gives eq. (7).

    Args:
        threat: float64 `[accessible]`, the accessible cells' p.

    Where next to no chance is left it is not followed further, and what it can add at most is added.
    """
    return float(np.count_nonzero(threat == 0) + _reached(np.sort(threat[threat > 0]), np.zeros(robots)))


@compiled
def _reached(dangerous, hits):  # type: ignore[no-untyped-def]
    """Of cells in order of p, `[n]`, those that the ideal reaches; `hits` `[k]` of zeros: chances of 0 .. k - 1."""
    total, cells, hits[0] = 0.0, len(dangerous), 1.0
    for place in range(cells):
        reached, p = hits.sum(), dangerous[place]
        if reached * (cells - place) < NEXT_TO_NOTHING:  # the chances only fall: all that is left is less than that
            return total + reached * (cells - place)
        total += reached
        for lost in range(len(hits) - 1, 0, -1):
            hits[lost] = hits[lost] * (1.0 - p) + hits[lost - 1] * p
        hits[0] *= 1.0 - p
    return total


# Bounds of our own, each with its proof: Theorem 3 mended, coverage until the first loss, the ideal of a map.
#
# They need the plan or the world alone and no rollout. `q_i(c)` is the chance that robot i covers cell c on its own
# path, in one of the two meanings of SPEC section 2 (`visited`: it gets as far as its first entry of c; `survived`:
# it also passes that entry's hit check), and `E(R_i) = sum_c q_i(c)` is eq. (4).


@dataclass(frozen=True)
class MendedTheorem3:
    """Three lower bounds on the open loop's E(team), in cells: `count <= largest <= spread <= E(team)`.

    Attributes:
        count: the paper's form, `sum_i E(R_i) - |C|`, with the C that makes it true.
        largest: the same with chances in place of counts.
        spread: the sharpest of them.
    """

    count: float
    largest: float
    spread: float


def mended_theorem3(plan: Plan, world: World) -> Meanings[MendedTheorem3]:
    """Theorem 3 in the form in which it holds, from the robots' own expectations and the cells that they share.

    A cell is shared if m >= 2 paths enter it. Let S = sum_i q_i and M = max_i q_i over those m robots.

        count:    E(team) >= sum_i E(R_i) - sum_shared (m - 1)
        largest:  E(team) >= sum_i E(R_i) - sum_shared (S - M)
        spread:   E(team) >= sum_i E(R_i) - sum_shared (S - 1 + (1 - M) (1 - (S - M) / (m - 1)) ** (m - 1))

    So the paper's C is the list of visits by other robots to cells already on some robot's path, each cell m - 1
    times, wherever they lie: connecting path or coverage. (Cells of coverage paths that others cross are what makes
    the printed C too small; counting every cell that is entered while traveling is what makes it too large.)

    Proof. Open loop, the robots' fates are independent, so a cell is covered with chance `U = 1 - prod_i (1 - q_i)`,
    and `E(team) = sum_c U(c) = sum_i E(R_i) - sum_shared (S - U)`; cells on one path have U = S. It is left to bound U
    from below on shared cells. U >= M, since the cell is covered if the likeliest robot covers it: `largest`. All
    q_i <= 1, so S - M <= m - 1: `count`. The m - 1 others have mean chance a = (S - M) / (m - 1), and their
    prod (1 - q_i) <= (1 - a) ** (m - 1), a geometric mean being at most the arithmetic one: `spread`; and it is at
    least `largest`, as (1 - M) (1 - a) ** (m - 1) <= 1 - M.

    None can be sharpened without knowing more. `count` is attained where no visit is dangerous. `largest` is the best
    that holds whatever the dependence of the robots' fates (it is attained when the q_i are nested: one coin for all),
    so it outlives the independence of the model. `spread` is the best function of (m, S, M) for independent robots: it
    is attained by m - 1 robots of equal chance a, a choice with these very m, S and M as a <= M. It is an equality for
    one or two robots and wherever a cell is on at most two paths. Knowing every q_i leaves the closed form itself.
    (The best bound from S and the sum of q_i q_j over pairs, whatever else the dependence, is Dawson and Sankoff's, "An
    inequality for probabilities", Proc. AMS 18, 1967. It was below `spread` on 99 % of the paper's maps.)

    Cost: linear in the total length of the paths: a sum, a maximum and a count for each first entry.
    """
    robots = [robot_chances(robot, world) for robot in plan.robots]
    return Meanings(
        visited=_mended(robots, [robot.reach for robot in robots], world.threat.size),
        survived=_mended(robots, [robot.passed for robot in robots], world.threat.size),
    )


def _mended(robots: list[RobotChances], chances: list[NDArray[np.float64]], cells: int) -> MendedTheorem3:
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
    return MendedTheorem3(
        count=expected - float(others.sum()),
        largest=expected - float(rest.sum()),
        spread=expected - float((total[shared] - covered).sum()),
    )


def until_first_loss(plan: Plan, world: World) -> Meanings[float]:
    """Expected cells covered before any robot is lost: a lower bound for the closed loop and the open loop alike.

    `sum_c prod (1 - p)` over all entries, by any robot, that come before the nominal run's first entry of c in the
    order of actions (step, then robot); for `survived` that entry included.

    Proof. Up to the first hit the closed loop makes the nominal run's moves: they depend on the past alone, and the
    pasts are the same. If none of those entries is a hit, which has that chance as hits are independent, c is entered
    (and its robot not stopped there). Sum over the cells.

    For one robot it is the expected coverage itself, as the loss of the only robot ends the run. Cost: a sort of the
    entries. Holds for hits checked on every visit, and so for `first_visit` too, where there are fewer.
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
    """Most that any strategy, adaptive ones included, can make of the chance to visit each cell; float64 `[N]`.

    `g(c) = 1 - prod_i (1 - r_i(c))`, where `r_i(c)` is the greatest product of (1 - p) over the cells before c, the
    start included, on any path from robot i's start to c. 0 where no robot can go.

    Proof. Let `r(x, c)` be that greatest product from cell x, x itself left out, and `F` the product of 1 - r(x_i, c)
    over the robots alive at x_i. If a robot moves to y != c, its factor becomes 1 - r(y, c) with chance 1 - p(y), and 1
    with chance p(y): on average 1 - (1 - p(y)) r(y, c) >= 1 - r(x, c), as x, y, ... is a path from x. So F does not
    fall on average, whatever robot the strategy moves where, until c is visited. It is at most 1, and 0 once a robot
    stands beside c or in it, so P(c never visited) >= E(F at the end) >= F at the start. Entering the start is such a
    move, with `r_i(c) = (1 - p(start)) r(start, c)`, and c is visited for certain if it is a start.
    """
    checked = check_starts(starts, world.threat, world.source)
    chosen, team = np.unique(checked, axis=0, return_counts=True)
    missed = np.zeros(world.threat.size)  # its logarithm: 1 minus a product would lose all below 1e-16
    with np.errstate(divide="ignore"):
        for start, robots in zip(chosen, team.tolist(), strict=True):
            missed += robots * np.log1p(-np.minimum(best_survival(world, start[None])[0], 1.0))
    return np.where(np.isnan(world.threat.ravel()), 0.0, -np.expm1(missed))


def best_survival(world: World, starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """`r_i(c)` of `reach_chances` for a robot at each of `starts` `[S, 2]`, float64 `[S, N]`; 0 where it cannot go."""
    threat = world.threat.ravel().astype(np.float64)
    near = neighbour_table(world.shape, ~np.isnan(threat))
    source, side = np.nonzero(near != NO_CELL)
    # Leaving a cell costs its hazard; a safe one a trifle, since a stored 0 may count as no edge.
    hazard = np.maximum(-np.log1p(-threat[source]), np.finfo(np.float64).tiny)
    graph = csr_array((hazard, (source, near[source, side])), shape=(threat.size, threat.size))
    chances: NDArray[np.float64] = np.exp(-dijkstra(graph, indices=starts[:, 0] * world.shape[1] + starts[:, 1]))
    return chances


def ideal_connected(world: World, starts: ArrayLike) -> float:
    """The ideal of a team on this map, in cells: an upper bound for every strategy, adaptive ones included.

    Split the accessible cells into D and the rest: `sum_D g(c) + ideal of the team over the rest`, with g of
    `reach_chances`. D holds every safe cell and the dangerous ones of least g, as many as make the bound least.

    Proof. Expected cells visited are those of D, each visited with chance g(c) at most, and those of the rest. For the
    latter the proof of the team's ideal stands: it counts hits in these cells alone, and hits elsewhere only add to
    them. Every split is a bound, so the least is. With no dangerous cell in D and all g = 1 it is SPEC's ideal of the
    team, so it never exceeds that; it gains where safe cells lie behind dangerous ones and few robots can be spared.

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
