"""From a world and starts to a plan: levels, areas, Algorithm 1, the nominal run of Algorithm 2; and plans in files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import argument
from planner.errors import PlanError, StateError
from planner.mrac.areas import allocate_areas_to_robots, connected_parts, find_areas, metis_parts
from planner.mrac.problem import Problem, prepare
from planner.plan.plan import FORMAT, Area, Leg, Plan, RobotPlan, last_move
from planner.plan.reading import check_partition
from planner.plan.state import NAT, ON_ITS_WAY, RETURNING, AreaState, MissionState, RobotState
from planner.rollouts.closed_loop import compile_closed_loop, nominal_loop, with_run
from planner.rollouts.runners import Runner
from planner.rollouts.single_run import SingleRun, play_compiled
from planner.settings import AGAIN, Settings
from planner.simulator.codes import NO_ROBOT
from planner.simulator.searches import NOT_WANTED, UNREACHED
from planner.simulator.thresholds import MOST
from planner.tally import Trace
from planner.world.levels import NO_LEVEL
from planner.world.start_rule import BEFORE, as_before, as_planned, rules_of
from planner.world.world import World

MEDIUM, LARGE = 2**10, 2**18
"""Cells from which on it is faster to load the compiled simulator from the cache, and to compile it, than to run it as
Python. Code that is loaded already is always used."""


def allocate(problem: Problem) -> tuple[Area, ...]:
    """Algorithm 1: the areas in id order with their robots before the start."""
    shape = problem.world.shape
    areas = find_areas(shape, problem.levels)
    paths = [problem.paths_of(robot) for robot in range(len(problem.starts))]
    return allocate_areas_to_robots(areas, problem.starts, shape, paths, problem.settings.density, metis_parts)


def allocated_plan(world: World, starts: ArrayLike, settings: Settings, state: MissionState | None = None) -> Plan:
    """The plan before its nominal run: the areas at t = 0, or in the state, and robots at their starts.

    It has the same rollouts as the whole plan. Args and errors as in `make_plan`.
    """
    return allocated(world, starts, settings, state)[1]


def allocated(
    world: World,
    starts: ArrayLike,
    settings: Settings,
    state: MissionState | None = None,
    before: Problem | None = None,
    allocation: tuple[Area, ...] | None = None,
) -> tuple[Problem, Plan]:
    """`allocated_plan` and its problem.

    Args:
        world, starts, settings, state, allocation: as in `make_plan`.
        before: as in `prepare`.
    """
    homes = None if state is None else state.homes(settings.return_to)
    problem = prepare(world, starts, settings, homes=homes, before=before)
    robots = tuple(RobotPlan(cell) for cell in problem.starts[:, None])
    if state is not None:
        world.require_certain_map("a resumed mission")
        state = made_ready(problem, state)
        areas = areas_of(state)
    elif allocation is None:
        areas = allocate(problem)
    else:
        _check_allocation(problem, allocation)
        areas = allocation
    return problem, Plan(world.shape, world.sha256, problem.settings, robots, areas, state=state, source=world.source)


def nominal_run(problem: Problem, plan: Plan) -> tuple[Trace, tuple[tuple[Leg, ...], ...], tuple[Area, ...]]:
    """Algorithm 2 without losses, from the areas of the plan or from its state; phases change the map.

    Args:
        problem: of the plan.
        plan: with areas.

    Returns:
        (trace, legs of each robot, areas made).

    Raises:
        WorldError: legs stay in areas (`transit="area"`) which change during the run.
    """
    if problem.unknown is not None and problem.unknown.phases is not None and problem.stay_inside:
        problem.world.require_known_map('`transit="area"`, legs that stay in their area,')
    loop = nominal_loop(compile_closed_loop(plan, problem.world, problem=problem, interpreted=True))
    built_in = loop.in_area is None and (loop.policy is None or loop.policy.key is None)
    cells = len(loop.cells)
    if built_in and not loop.learns and (cells >= LARGE or Runner(loop, 0, 1).is_compiled(cached=cells >= MEDIUM)):
        return play_compiled(loop)
    run = SingleRun(loop).play()
    return run.trace, run.legs, tuple(run.notes.made)


def make_plan(
    world: World,
    starts: ArrayLike,
    settings: Settings | None = None,
    allocation: tuple[Area, ...] | None = None,
    state: MissionState | None = None,
) -> Plan:
    """Plan the coverage of a world: the MRAC algorithm without losses.

    By Theorem 1 the paths together visit every accessible cell, unless `max_steps` or the policy ends the run
    (`Plan.outcome`).

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col); robots may share a cell.
        settings: of the planner; None: the defaults.
        allocation: areas at t = 0 in id order; None: by Algorithm 1.
        state: of the mission that the plan resumes, which then gives starts and areas.

    Raises:
        WorldError: starts off the map or on obstacles, or path costs too large.
        StateError: the state does not fit the settings.
        PlanError: settings out of range, or an allocation without each accessible cell exactly once.

    Source: paper, Algorithms 1 and 2.
    """
    if settings is not None and settings.plan_for != "closed_loop":
        raise PlanError(f"plan_for is {settings.plan_for} in a plan with areas", expected="closed_loop")
    problem, plan = allocated(world, starts, settings or Settings(), state, allocation=allocation)
    trace, legs, made = nominal_run(problem, plan)
    return replace(with_run(plan, trace, legs), areas_added=made)


def confirm_plan(plan: Plan, world: World, source: str) -> Plan:
    """A plan from a file, made again from its allocation and compared, so that legs and outcome are reliable.

    Args:
        plan: from the file.
        world: the map.
        source: the file.

    Raises:
        PlanError: the allocation is invalid, or paths, legs or added areas differ (legs may be missing).
    """
    if plan.settings is None:
        return plan
    try:
        # The nominal run is deterministic, so any difference means a changed file or another release.
        made = make_plan(world, plan.starts, plan.settings, plan.areas, plan.state)
    except (PlanError, StateError) as error:
        raise PlanError(error.problem, source=source, expected=error.expected, fix="make the plan again") from error
    for number, (given, follows) in enumerate(zip(plan.robots, made.robots, strict=True)):
        length, what = len(follows.path), ""
        if not np.array_equal(given.path[:length], follows.path) or last_move(given.path) >= length:
            what = "path"
        elif given.legs and given.legs != follows.legs:
            what = "legs"
        if what:
            problem, expected = f"the {what} of robot {number}", "those of the run without losses from the file's areas"
            raise PlanError(problem, source=source, expected=expected, fix="make the plan again")
    return replace(made, notes=plan.notes)


def _check_allocation(problem: Problem, allocation: tuple[Area, ...]) -> None:
    world = problem.world
    starts = np.stack(np.divmod(problem.starts, world.shape[1]), axis=1)
    check_partition(allocation, as_planned(world, starts), starts, PlanError, world.source)
    owners: set[int] = set()
    for number, area in enumerate(allocation):
        for fault, expected in _faults_of(problem, area, owners):
            raise PlanError(f"area {number} {fault}", source=world.source, expected=expected)
        owners.add(area.robot)


def _faults_of(problem: Problem, area: Area, owners: set[int]) -> Iterator[tuple[str, str]]:
    """Faults of an area of an allocation, with the expectation; `owners`: robots of earlier areas."""
    if (problem.levels.of_cell[area.cells] != area.level).any():
        yield f"has level {area.level}", "the level of all its cells in this world"
    if len(connected_parts(problem.world.shape, area.cells)) != 1:
        yield "is not connected", "4-connected cells"
    if area.robot == NO_ROBOT:
        return
    if not 0 <= area.robot < len(problem.starts) or area.robot in owners:
        yield f"is given to robot {area.robot}", "a robot of the team that has no other area"
    if problem.paths.to_all(int(problem.starts[area.robot]))[area.cells[0]] == UNREACHED:
        yield f"cannot be reached by its robot {area.robot}", "an area in its robot's part of the map"


# States prepared for resuming (SPEC section 12).


def made_ready(problem: Problem, state: MissionState) -> MissionState:
    """The state from which runs begin: with areas, by Algorithm 1 if it has none.

    Args:
        problem: of the plan.
        state: of the mission.

    Raises:
        StateError: it does not fit the settings.
    """
    problem.settings.require_uniform("the state of a mission", *AGAIN)
    if state.step >= problem.max_steps:
        raise StateError(f"the state is of step {state.step}", expected=f"a step before the last, {problem.max_steps}")
    left = problem.range - [robot.moves for robot in state.robots]
    for number, robot in enumerate(state.robots):
        if left[number] < 0 or (left[number] == 0 and robot.status in ON_ITS_WAY):
            problem_is = f"robot {number} is {robot.status} after {robot.moves} moves"
            raise StateError(problem_is, expected=f"at most its range, {problem.range[number]}")
    _check_exposures(problem, state)
    ended = [robot.alive and moves == 0 for robot, moves in zip(state.robots, left, strict=True)]
    for number, robot in enumerate(state.robots):
        if robot.status == RETURNING and (problem.home is None or problem.home.moves(number, robot.cell) <= 0):
            ended[number] = True  # it is there, or cut off
    robots = (replace(r, status="done") if end else r for r, end in zip(state.robots, ended, strict=True))
    state = replace(state, robots=tuple(robots))
    if not state.areas:
        able = [n for n, r in enumerate(state.robots) if r.alive and not ended[n] and not r.turned]
        return _allocated(problem, state, able)
    for number, area in enumerate(state.areas):
        if (problem.levels.of_cell[area.cells] != area.level).any():
            expected = "the level of all its cells in this plan"
            raise StateError(f"area {number} has level {area.level}", expected=expected, fix=_settings_asked("levels"))
    at_rest = {number for number, r in enumerate(state.robots) if r.status in ON_ITS_WAY and not len(r.ahead)}
    state = _sent(problem, state, {number: state.robots[number].area for number in at_rest})
    for number, robot in enumerate(state.robots):
        if robot.status in ON_ITS_WAY and not _leads_on(robot, state.areas[robot.area], problem.rule.replanning):
            expected = "a path that ends in its area, and the cells it still has to cover on it"
            problem_is = f"robot {number} is {robot.status}, but not by policy {problem.rule.name}"
            raise StateError(problem_is, expected=expected, fix=_settings_asked("policy"))
    return state


def _settings_asked(name: str) -> str:
    """Fix for a state made under the settings of another plan."""
    return f"give the settings of the plan that was driven, {argument(name)} among them, or resume with that plan"


def _check_exposures(problem: Problem, state: MissionState) -> None:
    """Raise StateError if hazards so far matter, and one is unknown or larger than any threshold."""
    failure_model = problem.settings.failure_model(state.exposures)
    if problem.settings.weibull_shape == 1:
        return
    cumulative_hazard = failure_model.exp1_begun(len(state.robots))
    for number, robot in enumerate(state.robots):
        if robot.alive and robot.exposure is None:
            fault = f"robot {number} has no exposure (Weibull shape {problem.settings.weibull_shape:g})"
            expected = '"exposure": cumulative hazard of each robot, in nat: the sum of -ln(1 - p) over its visits'
            raise StateError(fault, expected=expected)
        if robot.alive and cumulative_hazard[number] > MOST:
            fault = f"robot {number} has an exposure of {state.exposures[number] / NAT:g} nat"
            raise StateError(fault, expected="no more than any failure threshold")


def _leads_on(robot: RobotState, area: AreaState, replanning: bool) -> bool:
    if robot.status == "traveling" or replanning:
        return bool(np.isin(robot.ahead[-1], area.cells))
    return robot.ahead[-1] in robot.to_do and bool(np.isin(robot.to_do, robot.ahead).all())


def _allocated(problem: Problem, state: MissionState, able: list[int]) -> MissionState:
    """Algorithm 1 over the unvisited cells, for the robots that can move; they move from the next step on."""
    shape, levels = problem.world.shape, problem.levels
    seen = np.zeros(problem.costs.size, dtype=np.bool_)
    seen[state.visited] = True

    def parts(of: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.int64]]]:
        return find_areas(shape, replace(levels, of_cell=np.where(of, levels.of_cell, NO_LEVEL)))

    starts, density = problem.starts[able], problem.settings.density
    given = allocate_areas_to_robots(parts(~seen), starts, shape, [problem.paths] * len(starts), density, metis_parts)
    owner = {able[area.robot]: number for number, area in enumerate(given) if area.robot != NO_ROBOT}
    robot_of = {number: robot for robot, number in owner.items()}
    areas = [
        AreaState(a.level, robot_of.get(number, NO_ROBOT), "assigned" if number in robot_of else "unassigned", a.cells)
        for number, a in enumerate(given)
    ]
    done = [AreaState(level, NO_ROBOT, "completed", cells) for level, cells in parts(seen)]
    robots = (replace(r, status="idle") if number in able else r for number, r in enumerate(state.robots))
    return _sent(problem, replace(state, robots=tuple(robots), areas=(*areas, *done), quiet=0), owner)


def _sent(problem: Problem, state: MissionState, owner: dict[int, int]) -> MissionState:
    """The state with robots on the paths to the cells to do in their areas: robot -> area."""
    robots = list(state.robots)
    for robot, number in owner.items():
        rank = np.full(problem.costs.size, NOT_WANTED, dtype=np.int32)
        rank[np.setdiff1d(state.areas[number].cells, state.visited)] = 0
        target = problem.paths.nearest(robots[robot].cell, rank)
        assert target is not None  # Algorithm 1 only assigns reachable areas
        ahead = problem.paths.path(robots[robot].cell, target.cell)
        robots[robot] = replace(robots[robot], status="traveling", area=number, ahead=ahead, held=False)
    return replace(state, robots=tuple(robots))


def areas_of(state: MissionState) -> tuple[Area, ...]:
    """The areas in the form of a plan's allocation."""
    return tuple(
        Area(area.level, area.robot if area.state == "assigned" else NO_ROBOT, area.cells) for area in state.areas
    )


# Plans in files.

KEPT_READING = (
    "made by a release before 0.4 without `plan_on`, so robots plan on all moving threats here (`plan_on: joined`)"
)


def read_plan(path: str | Path, world: World) -> Plan:
    """Read a plan for a world: `mrac-plan`, or an external plan.

    Args:
        path: the file.
        world: the map.

    Raises:
        PlanError: names robot, step or area if it is no plan, is for another map or cannot be driven.
    """
    of, plan = read_plan_on(path, world)
    if of is not world:
        problem = "made by a release before 0.4, which planned on all moving threats where `plan_on` was not given"
        raise PlanError(problem, source=path, fix='make the world with plan_on="joined", or make the plan again')
    return plan


def read_plan_on(path: str | Path, world: World) -> tuple[World, Plan]:
    """The plan in a file and its world: `world`, or the same as releases before 0.4 made it.

    So an older plan keeps its reading of a scenario without `plan_on` for moving threats; its notes say so.

    Args:
        path: the file.
        world: the map.

    Raises:
        PlanError: as in `read_plan`.
    """
    # Only here: readers of all map formats come with it, Pillow among them.
    from planner.plan.plan_file import parse_plan, read_plan_json

    source, before, data = str(path), as_before(world), read_plan_json(path)
    if before is not world and _of_version_1(data, before.sha256):
        plan = confirm_plan(parse_plan(data, before, source), before, source)
        return before, replace(plan, notes=(*plan.notes, f"{source}: {KEPT_READING}"))
    plan = parse_plan(data, world, source)
    try:
        return world, confirm_plan(plan, world, source)
    except PlanError as error:
        same = plan.settings is None or rules_of(world, plan.settings, closed=False) == BEFORE
        if same or not _of_version_1(data, world.sha256):
            raise
        expected = f"{error.expected}; release 0.4 changed the rules for phases and for several types of robots"
        raise PlanError(error.problem, source=source, expected=expected, fix=error.fix) from error


def _of_version_1(data: object, sha256: str) -> bool:
    """Whether a file's JSON is a plan of a release before 0.4 for the map with this hash."""
    if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") != 1:
        return False
    named = data.get("world")
    return isinstance(named, dict) and named.get("sha256") == sha256
