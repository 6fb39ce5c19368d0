"""From a world and starts to a plan: levels, areas, Algorithm 1, and the nominal run of Algorithm 2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.allocate import allocate_areas_to_robots
from planner.areas import find_areas
from planner.costs import SafestPaths, entry_costs, safest_paths
from planner.errors import PlanError
from planner.levels import ThreatLevels, find_levels
from planner.partition import metis_parts
from planner.plan import Area, Plan, RobotPlan, Settings
from planner.simulate import Run, simulate
from planner.world import World, check_starts


@dataclass(frozen=True, eq=False)
class Problem:
    """A world made ready for planning with given starts. Axis `N` = H * W cells.

    Attributes:
        world, settings: what was asked. starts: int64 `[K]`, cell index of each robot.
        levels: the threat levels of the accessible cells. costs: int64 `[N]`, entry costs of eq. (3).
        paths: safest paths over the accessible cells.
    """

    world: World
    settings: Settings
    starts: NDArray[np.int64]
    levels: ThreatLevels
    costs: NDArray[np.int64]
    paths: SafestPaths

    @property
    def max_steps(self) -> int:
        """T_max of the run (SPEC section 5)."""
        if self.settings.max_steps is not None:
            return self.settings.max_steps
        return 8 * len(self.levels.values) * int(self.levels.accessible.sum()) + 64


def prepare(world: World, starts: ArrayLike, settings: Settings) -> Problem:
    """Levels, costs and safest paths of a world for robots at `starts` `[K, 2]`. Raises WorldError."""
    settings.check()
    checked = check_starts(starts, world.threat, world.source)
    levels = find_levels(world, world.accessible(checked), settings.levels)
    costs = entry_costs(levels, settings.risk)
    cells = checked[:, 0] * world.shape[1] + checked[:, 1]
    return Problem(world, settings, cells, levels, costs, safest_paths(world.shape, costs))


def allocate(problem: Problem) -> tuple[Area, ...]:
    """Algorithm 1: the areas in id order with the robots that they are given to before the start."""
    shape = problem.world.shape
    areas = find_areas(shape, problem.levels)
    return allocate_areas_to_robots(areas, problem.starts, shape, problem.paths, problem.settings.density, metis_parts)


def nominal_run(problem: Problem, allocation: tuple[Area, ...]) -> Run:
    """Algorithm 2 from this allocation with no hits."""
    return simulate(
        problem.world.shape,
        problem.paths,
        allocation,
        problem.starts,
        max_steps=problem.max_steps,
        stay_inside=problem.settings.transit == "area",
    )


def make_plan(
    world: World,
    starts: ArrayLike,
    settings: Settings | None = None,
    allocation: tuple[Area, ...] | None = None,
) -> Plan:
    """Plan the coverage of `world` from `starts` `[K, 2]` (row, col): the MRAC algorithm with no hits.

    By Theorem 1 the paths together visit every accessible cell, unless `max_steps` ends the run (`Plan.outcome`).

    Args:
        world: the map. starts: robots may share a cell.
        settings: the planner's choices; None = the defaults.
        allocation: areas at t = 0 in id order, from elsewhere; None = Algorithm 1's own.

    Raises:
        WorldError: starts off the map or on obstacles, or threats whose costs do not fit.
        PlanError: settings out of range, or an allocation that does not hold every accessible cell exactly once.
    """
    problem = prepare(world, starts, settings or Settings())
    if allocation is None:
        allocation = allocate(problem)
    else:
        _check_allocation(problem, allocation)
    run = nominal_run(problem, allocation)
    return Plan(
        shape=world.shape,
        sha256=world.sha256,
        settings=problem.settings,
        robots=tuple(RobotPlan(path, legs) for path, legs in zip(run.paths, run.legs, strict=True)),
        areas=allocation,
        areas_added=run.areas_added,
        outcome=run.outcome.name.lower(),
        time=run.time,
        shares=run.shares,
    )


def _check_allocation(problem: Problem, allocation: tuple[Area, ...]) -> None:
    held = np.zeros(problem.costs.size, dtype=np.int64)
    for area in allocation:
        held[area.cells] += 1
    wrong = np.flatnonzero(held != problem.levels.accessible)
    if len(wrong):
        cell = divmod(int(wrong[0]), problem.world.shape[1])
        raise PlanError(
            f"the allocation holds cell {list(cell)} {held[wrong[0]]} times",
            source=problem.world.source,
            expected="every accessible cell in exactly one area, and no other cell",
        )
