"""From a world and starts to paths for the open loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.ids import MAX_STEP
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.open_loop.nodes import make_nodes
from planner.open_loop.search import chances, search, team_cells
from planner.plan.plan import Plan, RobotPlan, entries
from planner.settings import Settings
from planner.tally import Outcome
from planner.world.world import World

EFFORT = 200_000
"""Evaluations, unless others are asked for."""
SEED = 0x4F50454E


def make_open_loop_plan(world: World, starts: ArrayLike, settings: Settings, seconds: float | None = None) -> Plan:
    """Paths alone for robots at `starts` `[K, 2]` that are not reallocated: the plan of `planner.open_loop`.

    The search sets out from the better of two: `per_cell` by each robot alone, and the nominal run of the settings'
    policy. It returns the latter's paths where it finds none that are worth more. `settings.effort` evaluations;
    `seconds` may end it before, and a note says so. Equal arguments without `seconds` give equal plans.

    Raises WorldError and PlanError as `make_plan`; PlanError for too large maps.
    """
    closed = replace(settings, plan_for="closed", effort=None)
    world.check_told("a plan for the open loop")
    settings.check_stays("a plan for the open loop")
    settings.check_alike("a plan for the open loop")
    nominal = make_plan(world, starts, closed)
    problem = prepare(world, starts, closed)
    nodes = make_nodes(world, problem.levels.accessible.reshape(world.shape))
    begin = nodes.of_cell[problem.starts]
    alone = _alone(world, problem.starts, closed)
    none = np.empty(0, dtype=np.int64)
    orders = [
        tuple(nodes.order_of(path, none) for path in alone),
        tuple(
            nodes.order_of(path, nodes.order_of(robot.path, none))
            for path, robot in zip(alone, nominal.robots, strict=True)
        ),
    ]
    worth = [
        team_cells(nodes, np.array([chances(nodes, *one) for one in zip(of, begin.tolist(), strict=True)]))
        for of in orders
    ]
    effort = EFFORT if settings.effort is None else settings.effort
    found = search(nodes, orders[int(np.argmax(worth))], begin, effort, SEED, seconds)
    last = MAX_STEP if settings.last_step is None else settings.last_step
    paths = tuple(
        nodes.drive(order, start, problem)[: min(last, moves) + 1]
        for order, start, moves in zip(found.orders, problem.starts.tolist(), problem.range.tolist(), strict=True)
    )
    cells, before = (expected_worth(some, world) for some in (paths, [robot.path for robot in nominal.robots]))
    if before > cells:
        paths = tuple(robot.path for robot in nominal.robots)
    plan = Plan(
        world.shape, world.sha256, None, tuple(RobotPlan(path) for path in paths), outcome=Outcome.END_OF_PATHS.word,
        for_open_loop=True,
        bears=settings.bearing(), source=world.source,
        notes=_notes(cells, before, found.evaluations, effort, closed, "cells" if world.value is None else "of value"),
    )  # fmt: skip
    return replace(plan, time=plan.makespan)


def _alone(world: World, starts: NDArray[np.int64], settings: Settings) -> list[NDArray[np.int64]]:
    """The path over the whole map of each robot by itself, `per_cell`."""
    limits: dict[str, Any] = dict.fromkeys(("reserve", "worth", "max_steps", "deadline", "range"))
    by_itself = replace(settings.alone, policy="per_cell", **limits)
    found = {
        start: make_plan(world, [divmod(start, world.shape[1])], by_itself).robots[0].path for start in starts.tolist()
    }
    return [found[start] for start in starts.tolist()]


def expected_worth(paths: tuple[NDArray[np.int64], ...] | list[NDArray[np.int64]], world: World) -> float:
    """Expected cells visited in the open loop, or their value: `sum_c w_c (1 - prod_i (1 - S_i(c)))`.

    S before the entry's own check.
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
    short = (f"the search ended before its {effort:,} evaluations: it ran out of seconds",) * (done < effort)
    return (f"{said}{settings.rule.name}; {done:,} evaluations", *short)
