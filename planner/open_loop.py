"""Plans for a team without communication: paths searched for expected coverage without reallocation.

Every robot first plans the whole map alone (`per_cell`); then each in turn responds to the others: given the
probabilities `S_j(c)` that the others reach a cell, the gain of a path is `sum_c S_i(c) prod_{j != i} (1 - S_j(c))`,
exactly what it adds to the team's expected coverage `sum_c 1 - prod_j (1 - S_j(c))` (the closed form of SPEC section
6). Simulated annealing over the order of its targets searches for a better path.

The expected coverage is a monotone submodular function of the set of paths. So responding in turn, from nothing, with
an optimal path each time covers at least half of the optimum (with a factor alpha from the optimal path: alpha / (1 +
alpha); Jorgensen, Chen, Milam, Pavone: The Team Surviving Orienteers Problem, arXiv 1612.03232). The paths found here
are not known to be optimal: this justifies responding in turn, and is no guarantee on the result.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from planner.arguments import MAX_STEP, POSITIVE, argument
from planner.errors import PlanError, UsageError
from planner.make_plan import make_plan
from planner.mrac.problem import Problem, prepare
from planner.plan.plan import Plan, RobotPlan, entries
from planner.settings import Settings
from planner.simulator.codes import NO_CELL, Outcome
from planner.simulator.jit import put_first, threaded
from planner.simulator.searches import coverage_path, neighbour_table
from planner.world.world import FOUR_NEIGHBOURS, World

# The map for orders of targets: dangerous cells, and safe areas in which every move is free.

MOST_NODES = 6_000
"""Nodes of the largest map: tables of safest paths take 16 bytes per pair while they are made, then 4."""
HOP = 1e-9
"""Added to the hazard of every move, so that of equally safe paths the one with fewer nodes is taken."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Graph of a map. Axes: `V` nodes, `N` cells. A safe area is a 4-connected set of accessible cells with p = 0.

    Attributes:
        areas: number of safe areas, which are the first nodes.
        of_cell: int64 `[N]`, the cell's node; NO_CELL if not accessible.
        cells: of each node, increasing.
        passed: float64 `[V]`, probability to survive one visit. weight: float64 `[V]`, number of cells, or their value
            in values of a mean cell.
        towards: int32 `[V, V]`, `[t, u]`: the node after u on the safest path from u to t; negative: none.
    """

    areas: int
    of_cell: NDArray[np.int64]
    cells: tuple[NDArray[np.int64], ...]
    passed: NDArray[np.float64]
    weight: NDArray[np.float64]
    towards: NDArray[np.int32]

    def order_of(self, path: NDArray[np.int64], first: NDArray[np.int64]) -> NDArray[np.int64]:
        """The nodes of `first`, then those of the cells of `path`: each once, in order.

        Args:
            path: int64 `[steps + 1]`, cells.
            first: int64, nodes.
        """
        nodes = np.concatenate([first, self.of_cell[path]])
        return nodes[np.sort(np.unique(nodes, return_index=True)[1])]

    def drive(self, order: NDArray[np.int64], start: int, problem: Problem) -> NDArray[np.int64]:
        """Path of a robot that visits nodes in an order.

        It takes safest paths, and skips targets that it passed on the way. A safe area is covered when it is first
        entered.

        Args:
            order: int64, nodes.
            start: cell of the robot.
            problem: with paths and coverage order.

        Returns:
            int64 `[steps + 1]`, cells.
        """
        paths = problem.paths
        legs, here, before, seen = [np.array([start], dtype=np.int64)], start, self.of_cell[start], set()
        for node in self._way(order, int(self.of_cell[start])):
            inside = np.zeros(len(self.of_cell), dtype=np.bool_)
            inside[self.cells[before]] = inside[self.cells[node]] = True
            before, target = node, int(self.cells[node][0])
            if node < self.areas:
                to_do = self.cells[node][:0] if node in seen else self.cells[node]
                leg = coverage_path(paths, here, to_do, inside, problem.sides)
            else:
                leg = paths.path(here, target, inside) if here != target else self.cells[node][:0]
            seen.add(node)
            if len(leg):
                legs.append(leg)
                here = int(leg[-1])
        return np.concatenate(legs)

    def _way(self, order: NDArray[np.int64], here: int) -> Iterator[int]:
        """The nodes entered, `here` first."""
        seen = {here}
        yield here
        for target in order.tolist():
            while target not in seen:
                here = int(self.towards[target, here])
                seen.add(here)
                yield here


def make_nodes(world: World, accessible: NDArray[np.bool_]) -> Nodes:
    """Make the nodes of a world.

    Args:
        world: the map.
        accessible: bool `[H, W]`.

    Raises:
        PlanError: there are more than MOST_NODES.
    """
    safe = accessible & (world.threat == 0)
    label, areas = ndimage.label(safe, structure=FOUR_NEIGHBOURS)
    of_cell = label.astype(np.int64).ravel() - 1
    dangerous = np.flatnonzero(accessible & ~safe)
    of_cell[dangerous] = areas + np.arange(len(dangerous))
    count = areas + len(dangerous)
    if count > MOST_NODES:
        raise PlanError(
            f"{len(dangerous)} dangerous cells and {areas} safe areas are too many to plan for the open loop",
            source=world.source,
            expected=f"at most {MOST_NODES} together",
            fix="coarsen the map with cell_size, or leave plan_for out",
        )
    flat = np.flatnonzero(accessible)
    passed = np.ones(count)
    passed[areas:] = 1.0 - world.threat.ravel()[dangerous].astype(np.float64)
    near = neighbour_table(world.shape, accessible.ravel())[flat]
    place, side = np.nonzero(near != NO_CELL)
    pairs = np.unique(np.stack([of_cell[flat[place]], of_cell[near[place, side]]], axis=1), axis=0)
    source, target = pairs[pairs[:, 0] != pairs[:, 1]].T
    hazard = HOP - np.log(passed)
    # backwards: the predecessor of u on the way back from t is the successor of u on the way to t
    back = coo_array((hazard[target], (target, source)), shape=(count, count)).tocsr()
    order = np.argsort(of_cell[flat], kind="stable")
    cells = tuple(np.split(flat[order], np.cumsum(np.bincount(of_cell[flat], minlength=count))[:-1]))
    towards = dijkstra(back, return_predecessors=True)[1].astype(np.int32)
    weight = np.array([float(len(c)) for c in cells])
    if world.value is not None and world.value[accessible].any():
        value = world.value.ravel() / world.value[accessible].mean()
        weight = np.array([value[c].sum() for c in cells])
    return Nodes(areas, of_cell, cells, passed, weight, towards)


# Simulated annealing over the robots' orders of nodes, one robot's turn after another's, compiled.

TURN = 250
"""Evaluations of one robot's order per turn."""
HOT, COLD = 0.5, 0.005
"""Loss in expected cells that a move is accepted with, with probability 1/e: at the start and at the end."""
LONGEST = 0.25
"""Most targets moved at once, as a share of all that matter; usually few."""
NEGLIGIBLE = 1e-9
"""Survival probability below which an evaluation ends."""


def chances(nodes: Nodes, order: NDArray[np.int64], here: int) -> NDArray[np.float64]:
    """S, float64 `[V]`: probability that a robot reaches each node.

    Args:
        nodes: of the map.
        order: int64, the robot's targets.
        here: its node.
    """
    chance = np.zeros(len(nodes.weight))
    _gain(order, here, nodes.passed, nodes.weight, nodes.towards, np.zeros(len(chance), dtype=np.bool_), chance)
    return chance


def search(
    nodes: Nodes,
    orders: tuple[NDArray[np.int64], ...],
    starts: NDArray[np.int64],
    effort: int,
    seed: int,
    seconds: float | None = None,
) -> tuple[tuple[NDArray[np.int64], ...], int]:
    """Search for better orders. Equal arguments give equal results, unless `seconds` ends the search.

    Args:
        nodes: of the map.
        orders: to start from, one per robot.
        starts: int64 `[K]`, the robots' nodes.
        effort: evaluations.
        seed: of the annealing.
        seconds: time limit.

    Returns:
        (the targets of each robot, int64; evaluations done).
    """
    draw = np.random.default_rng(seed)
    began, done = time.monotonic(), 0
    now = [order.copy() for order in orders]
    reached = np.array([chances(nodes, order, here) for order, here in zip(now, starts.tolist(), strict=True)])
    best, most = tuple(order.copy() for order in now), team_cells(nodes, reached)
    scratch = np.empty_like(nodes.weight, dtype=np.int64), np.zeros(len(nodes.weight), dtype=np.bool_)
    while done < effort and (seconds is None or time.monotonic() - began < seconds):
        for robot, here in enumerate(starts.tolist()):
            count = min(TURN, effort - done)
            heat = HOT * (COLD / HOT) ** (done / effort)
            others = nodes.weight * np.prod(1.0 - np.delete(reached, robot, axis=0), axis=0)
            _turn(now[robot], here, nodes.passed, others, nodes.towards, draw.random((count, 6)), heat, *scratch)
            reached[robot] = chances(nodes, now[robot], here)
            done += count
            cells = team_cells(nodes, reached)
            if cells > most:
                best, most = tuple(order.copy() for order in now), cells
    return best, done


def team_cells(nodes: Nodes, reached: NDArray[np.float64]) -> float:
    """Expected cells of a team, `sum_c 1 - prod_j (1 - S_j(c))`, from S float64 `[K, V]`."""
    return float(nodes.weight @ (1.0 - np.prod(1.0 - reached, axis=0)))


@threaded
def _gain(order, here, passed, weight, towards, seen, chance):  # type: ignore[no-untyped-def]
    """(sum of `weight` `[V]` times the probability to get there, number of targets that matter).

    The probabilities are written to `chance` if it has elements. `seen` bool `[V]`: scratch.
    """
    seen[:] = False
    seen[here] = True
    total, reach, used = weight[here], passed[here], 0
    if len(chance):
        chance[here] = 1.0
    for target in order:
        used += 1
        if seen[target]:
            continue
        while here != target:
            here = towards[target, here]
            if not seen[here]:
                seen[here] = True
                total += weight[here] * reach
                if len(chance):
                    chance[here] = reach
            reach *= passed[here]
        if reach < NEGLIGIBLE:
            break
    return total, used


@threaded
def _turn(order, here, passed, weight, towards, draws, heat, tried, seen):  # type: ignore[no-untyped-def]
    """Anneal one robot's `order` in place, with a row of `draws` `[evaluations, 6]` for each evaluation."""
    unasked = np.empty(0)
    value, used = _gain(order, here, passed, weight, towards, seen, unasked)
    count = len(order)
    tried = tried[:count]
    for draw in draws:
        after = min(int(draw[0] * used), count - 1)
        run = 1 + int(draw[1] ** 3 * LONGEST * used)
        if draw[2] < 0.5:  # a node next to the one at `after`, on the way to any other
            beside = towards[order[min(int(draw[3] * count), count - 1)], order[after]]
            begin = 0
            while begin < count - 1 and order[begin] != beside:
                begin += 1
        else:
            begin = min(int(draw[3] * (used + run)), count - 1)
        run = min(run, count - begin)
        if begin <= after < begin + run:
            continue
        _move(order, tried, begin, run, after, draw[4] < 0.5)
        new, new_used = _gain(tried, here, passed, weight, towards, seen, unasked)
        if new >= value or draw[5] < np.exp((new - value) / heat):
            put_first(tried, order)
            value, used = new, new_used


@threaded
def _move(order, tried, begin, run, after, backwards):  # type: ignore[no-untyped-def]
    """`order` with `run` targets from `begin` on moved behind the one at `after`, written to `tried`."""
    place = 0
    for old in range(len(order)):
        if not begin <= old < begin + run:
            tried[place] = order[old]
            place += 1
        if old == after:
            for step in range(run):
                tried[place] = order[begin + run - 1 - step] if backwards else order[begin + step]
                place += 1


# Open-loop plans from a world and starts.

EFFORT = 200_000
"""Default number of evaluations."""
SEED = 0x4F50454E


def make_open_loop_plan(world: World, starts: ArrayLike, settings: Settings, seconds: float | None = None) -> Plan:
    """Make an open-loop plan: paths of robots that are not reallocated.

    The search starts from the better of two plans: `per_cell` by each robot alone, and the nominal run of the settings'
    policy. It returns the latter's paths if it finds none with more value. Equal arguments without `seconds` give equal
    plans.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
        settings: of the planner; `effort` evaluations.
        seconds: time limit; a note says if it ended the search.

    Raises:
        WorldError, PlanError: as in `make_plan`, or the map is too large.
    """
    closed = replace(settings, plan_for="closed_loop", effort=None)
    world.require_known_map("a plan for the open loop")
    settings.require_uniform("a plan for the open loop", "return_to")
    nominal = make_plan(world, starts, closed)
    problem = prepare(world, starts, closed)
    nodes = make_nodes(world, problem.levels.accessible.reshape(world.shape))
    begin = nodes.of_cell[problem.starts]
    alone = _alone(world, problem.starts, closed)
    none = np.empty(0, dtype=np.int64)
    first = [nodes.order_of(robot.path, none) for robot in nominal.robots]
    orders = [tuple(map(nodes.order_of, alone, before)) for before in ([none] * len(alone), first)]
    covered = [team_cells(nodes, np.array([*map(partial(chances, nodes), of, begin.tolist())])) for of in orders]
    effort = EFFORT if settings.effort is None else settings.effort
    found, done = search(nodes, orders[int(np.argmax(covered))], begin, effort, SEED, seconds)
    last = MAX_STEP if settings.last_step is None else settings.last_step
    paths = tuple(
        nodes.drive(order, start, problem)[: min(last, moves) + 1]
        for order, start, moves in zip(found, problem.starts.tolist(), problem.range.tolist(), strict=True)
    )
    cells, before = (expected_value(some, world) for some in (paths, [robot.path for robot in nominal.robots]))
    if before > cells:
        paths = tuple(robot.path for robot in nominal.robots)
    plan = Plan(
        world.shape, world.sha256, None, tuple(RobotPlan(path) for path in paths), outcome=Outcome.END_OF_PATHS.word,
        for_open_loop=True,
        failures=settings.failure_model(), source=world.source,
        notes=_notes(cells, before, done, effort, closed, "cells" if world.value is None else "of value"),
    )  # fmt: skip
    return replace(plan, time=plan.makespan)


def _alone(world: World, starts: NDArray[np.int64], settings: Settings) -> list[NDArray[np.int64]]:
    """The path over the whole map of each robot alone, by `per_cell`."""
    limits: dict[str, Any] = dict.fromkeys(("risk_cap", "robot_value", "max_steps", "deadline", "range"))
    by_itself = replace(settings.alone, policy="per_cell", **limits)
    found = {
        start: make_plan(world, [divmod(start, world.shape[1])], by_itself).robots[0].path for start in starts.tolist()
    }
    return [found[start] for start in starts.tolist()]


def expected_value(paths: tuple[NDArray[np.int64], ...] | list[NDArray[np.int64]], world: World) -> float:
    """Expected cells visited in the open loop, or their value: `sum_c w_c (1 - prod_i (1 - S_i(c)))`.

    S is the probability before the entry's own check.

    Args:
        paths: int64 `[steps + 1]` each, cells.
        world: the map.

    Source: SPEC section 6.
    """
    missed = np.ones(world.threat.size)
    for path in paths:
        cells = path[entries(path)]
        reach = np.cumprod(np.concatenate([[1.0], 1.0 - world.threat.ravel()[cells[:-1]].astype(np.float64)]))
        first = np.unique(cells, return_index=True)[1]
        missed[cells[first]] *= 1.0 - reach[first]
    return float(world.threat.size - missed.sum() if world.value is None else world.value.ravel() @ (1.0 - missed))


def _notes(cells: float, before: float, done: int, effort: int, settings: Settings, unit: str) -> tuple[str, ...]:
    said = (
        f"planned for the open loop: {max(cells, before):.2f} {unit} expected, {before:.2f} with the nominal plan of "
    )
    short = (f"the search ended before its {effort:,} evaluations: its time limit was reached",) * (done < effort)
    return (f"{said}{settings.rule.name}; {done:,} evaluations", *short)


def plan_team(world: World, starts: ArrayLike, settings: Settings | None = None, seconds: float | None = None) -> Plan:
    """Make the plan for the loop of `settings.plan_for`: MRAC's nominal run (`make_plan`), or paths.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
        settings: of the planner; None: the defaults.
        seconds: time limit of the search for an open-loop plan.

    Raises:
        WorldError, PlanError, UsageError: an invalid input.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    if settings is None or settings.plan_for == "closed_loop":
        if seconds is not None:
            raise UsageError(f"{argument('seconds', seconds)} is for plans for the open loop", fix="leave it out")
        return make_plan(world, starts, settings)
    return make_open_loop_plan(world, starts, settings, seconds)
