"""From a world and starts to a plan: levels, areas, Algorithm 1, and the nominal run of Algorithm 2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from planner.errors import PlanError, StateError
from planner.mrac.areas import allocate_areas_to_robots, connected_parts, find_areas, metis_parts
from planner.mrac.problem import Problem, prepare
from planner.mrac.simulate import Run, areas_of, made_ready, simulate
from planner.plan.plan import Area, Plan, RobotPlan, last_move
from planner.plan.reading import check_partition
from planner.plan.state import MissionState
from planner.settings import Settings
from planner.simulator.codes import NO_ROBOT
from planner.simulator.searches import UNREACHED
from planner.world.features import as_planned
from planner.world.world import World


def allocate(problem: Problem) -> tuple[Area, ...]:
    """Algorithm 1: the areas in id order with the robots that they are given to before the start."""
    shape = problem.world.shape
    areas = find_areas(shape, problem.levels)
    paths = [problem.paths_of(robot) for robot in range(len(problem.starts))]
    return allocate_areas_to_robots(areas, problem.starts, shape, paths, problem.settings.density, metis_parts)


def allocated_plan(world: World, starts: ArrayLike, settings: Settings, state: MissionState | None = None) -> Plan:
    """The plan before its nominal run: the areas at t = 0, or in the state, and robots that stand where they begin.

    It is rolled out as the whole plan is. Raises as `make_plan`.
    """
    return allocated(world, starts, settings, state)[1]


def allocated(
    world: World,
    starts: ArrayLike,
    settings: Settings,
    state: MissionState | None = None,
    before: Problem | None = None,
) -> tuple[Problem, Plan]:
    """`allocated_plan`, and the problem that it is of; `before`: as of `prepare`."""
    homes = None if state is None else state.homes(settings.return_to)
    problem = prepare(world, starts, settings, homes=homes, before=before)
    robots = tuple(RobotPlan(cell) for cell in problem.starts[:, None])
    if state is None:
        areas = allocate(problem)
        return problem, Plan(world.shape, world.sha256, problem.settings, robots, areas, source=world.source)
    world.check_settled("the rest of a mission")
    state = made_ready(problem, state)
    areas = areas_of(state)
    return problem, Plan(world.shape, world.sha256, problem.settings, robots, areas, state=state, source=world.source)


def nominal_run(problem: Problem, allocation: tuple[Area, ...], state: MissionState | None = None) -> Run:
    """Algorithm 2 from this allocation, or from a state with it, with no hits; threats change as they do.

    Raises WorldError for legs that stay in areas which change on the way.
    """
    changing = problem.unknown is not None and problem.unknown.phases is not None
    if changing and problem.stay_inside:
        problem.world.check_told('`transit="area"`, legs that stay in their area,')
    return simulate(problem, allocation, state=state, truth=0 if changing else None)


def make_plan(
    world: World,
    starts: ArrayLike,
    settings: Settings | None = None,
    allocation: tuple[Area, ...] | None = None,
    state: MissionState | None = None,
) -> Plan:
    """Plan the coverage of `world` from `starts` `[K, 2]` (row, col): the MRAC algorithm with no hits.

    By Theorem 1 the paths together visit every accessible cell, unless `max_steps` ends the run or the policy calls
    robots off (`Plan.outcome`).

    Args:
        world: the map. starts: robots may share a cell.
        settings: the planner's choices; None = the defaults.
        allocation: areas at t = 0 in id order, from elsewhere; None = Algorithm 1's own.
        state: of the mission under way that the plan is the rest of; `starts` and areas are then its own.

    Raises:
        WorldError: starts off the map or on obstacles, or threats whose costs do not fit.
        StateError: a state that the settings do not fit.
        PlanError: settings out of range, or an allocation that does not hold every accessible cell exactly once.
    """
    if settings is not None and settings.plan_for != "closed":
        raise PlanError(f"plan_for is {settings.plan_for} in a plan with areas", expected="closed")
    settings = settings or Settings()
    problem = prepare(world, starts, settings, homes=None if state is None else state.homes(settings.return_to))
    if state is not None:
        world.check_settled("the rest of a mission")
        state = made_ready(problem, state)
        allocation = areas_of(state)
    elif allocation is None:
        allocation = allocate(problem)
    else:
        _check_allocation(problem, allocation)
    run = nominal_run(problem, allocation, state)
    return Plan(
        shape=world.shape,
        sha256=world.sha256,
        settings=problem.settings,
        robots=tuple(RobotPlan(path, legs) for path, legs in zip(run.paths, run.legs, strict=True)),
        areas=allocation,
        areas_added=run.areas_added,
        outcome=run.outcome.by_deadline(problem.settings.ends_by_deadline).word,
        time=run.time,
        shares=run.shares,
        state=state,
        source=world.source,
    )


def confirm_plan(plan: Plan, world: World, source: str) -> Plan:
    """A plan read from a file, made again from its allocation: its legs and outcome can be relied on.

    The allocation at t = 0 is data; everything else follows from it. Raises PlanError, naming `source`, if the
    allocation is none or the file's paths, legs or added areas are not what follows (legs may be left out).
    """
    if plan.settings is None:
        return plan
    try:
        made = make_plan(world, plan.starts, plan.settings, plan.areas, plan.state)
    except (PlanError, StateError) as error:
        raise PlanError(error.problem, source=source, expected=error.expected, fix="make the plan anew") from error
    for number, (given, follows) in enumerate(zip(plan.robots, made.robots, strict=True)):
        length, what = len(follows.path), ""
        if not np.array_equal(given.path[:length], follows.path) or last_move(given.path) >= length:
            what = "path"
        elif given.legs and given.legs != follows.legs:
            what = "legs"
        if what:
            expected = "those of the run with no hits from the file's areas"
            raise PlanError(f"the {what} of robot {number}", source=source, expected=expected, fix="make the plan anew")
    return replace(made, notes=plan.notes)


def _check_allocation(problem: Problem, allocation: tuple[Area, ...]) -> None:
    world = problem.world
    starts = np.stack(np.divmod(problem.starts, world.shape[1]), axis=1)
    check_partition(allocation, as_planned(world, starts), starts, PlanError, world.source)
    owners: set[int] = set()
    for number, area in enumerate(allocation):
        problem_with = _what_is_wrong(problem, area, owners)
        if problem_with:
            raise PlanError(f"area {number} {problem_with[0]}", source=problem.world.source, expected=problem_with[1])
        owners.add(area.robot)


def _what_is_wrong(problem: Problem, area: Area, owners: set[int]) -> tuple[str, str] | None:
    """(what is wrong with an area of an allocation, what was expected), or None; `owners`: robots of earlier areas."""
    if (problem.levels.of_cell[area.cells] != area.level).any():
        return f"has level {area.level}", "the level of all its cells in this world"
    if len(connected_parts(problem.world.shape, area.cells)) != 1:
        return "is not connected", "4-connected cells"
    if area.robot != NO_ROBOT:
        if not 0 <= area.robot < len(problem.starts) or area.robot in owners:
            return f"is given to robot {area.robot}", "a robot of the team that has no other area"
        if problem.paths.to_all(int(problem.starts[area.robot]))[area.cells[0]] == UNREACHED:
            return f"cannot be reached by its robot {area.robot}", "an area in its robot's part of the map"
    return None
