"""Bounds of our own, each with its proof: Theorem 3 mended, coverage until the first loss, the ideal of a map.

They need the plan or the world alone and no rollout. `q_i(c)` is the chance that robot i covers cell c on its own path,
in one of the two meanings of SPEC section 2 (`visited`: it gets as far as its first entry of c; `survived`: it also
passes that entry's hit check), and `E(R_i) = sum_c q_i(c)` is eq. (4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from analysis.theory.bounds import Meanings, ideal_team
from analysis.theory.exact import RobotChances, robot_chances
from planner.ids import NO_CELL
from planner.mrac.paths import neighbour_table
from planner.plan.plan import Plan
from planner.world.world import World, check_starts


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
