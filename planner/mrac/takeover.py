"""A plan's closed loop made ready: its problem and the areas at t = 0, of MRAC's plans and of other planners' alike.

Robots with paths of another planner follow them (ours; the paper has no such plans). The cells that a robot is the
first to visit are its areas, one a level, which nobody shares; if it is stopped, what is unvisited of them is cut into
connected areas for whoever is free, as the paper's `Reallocate Area` does. Cells that are on nobody's path are areas
that nobody has from the start. A robot at the end of its path goes on as Algorithm 2 says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.mrac.areas import connected_parts
from planner.mrac.problem import Problem, prepare
from planner.none import NO_ROBOT
from planner.plans.plan import Area, Plan
from planner.worlds.doubt import Hazard
from planner.worlds.world import World


def ready_loop(plan: Plan, world: World) -> tuple[Problem, tuple[Area, ...]]:
    """The problem that the plan's closed loop runs, and its areas at t = 0.

    Raises PlanError for another map, WorldError for what robots that are not told the map do not do.
    """
    settings = plan.require(world)
    if plan.is_foreign:
        settings.check_alike("a closed loop on another planner's paths")
    if plan.is_foreign or plan.state is not None:
        world.check_told("a closed loop on another planner's paths" if plan.is_foreign else "the rest of a mission")
    if settings.transit == "area":
        world.check_told('`transit="area"`, legs that stay in their area,')
    if not plan.is_foreign:
        homes = None if plan.state is None else plan.state.homes(settings.return_to)
        return prepare(world, plan.starts, settings, homes=homes), plan.areas
    problem = prepare(world, plan.starts, settings, given=tuple(robot.path for robot in plan.robots))
    return problem, areas_of_paths(problem)


def check_every_visit(world: World, first_only: bool) -> None:
    """Raise WorldError where robots would learn from visits that nobody checks."""
    if first_only and isinstance(world.doubt, Hazard):
        world.check_told(argument("threat_checks", "first_visit"))


def areas_of_paths(problem: Problem) -> tuple[Area, ...]:
    """The areas of robots that follow given paths: for each robot one a level, then the connected ones of nobody."""
    first, level = first_visitors(problem), problem.levels.of_cell
    areas = [
        Area(int(of), robot, np.flatnonzero((first == robot) & (level == of)))
        for robot in range(len(problem.given))
        for of in np.unique(level[first == robot])
    ]
    left = (first == NO_ROBOT) & problem.levels.accessible
    for of in np.unique(level[left]):
        parts = connected_parts(problem.world.shape, np.flatnonzero(left & (level == of)))
        areas += [Area(int(of), NO_ROBOT, part) for part in parts]
    return tuple(areas)


def first_visitors(problem: Problem) -> NDArray[np.int64]:
    """Of each cell the robot that is the first on it if nobody is stopped, the lowest of several; int64 `[N]`."""
    first = np.full(problem.costs.size, NO_ROBOT, dtype=np.int64)
    steps = np.concatenate([np.arange(len(path)) for path in problem.given])
    robots = np.repeat(np.arange(len(problem.given)), [len(path) for path in problem.given])
    latest_first = np.lexsort((robots, steps))[::-1]
    first[np.concatenate(problem.given)[latest_first]] = robots[latest_first]
    return first
