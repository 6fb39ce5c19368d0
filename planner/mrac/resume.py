"""A run as the state of a mission, and a state made ready to go on from (SPEC section 12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import StateError
from planner.mrac.allocate import allocate_areas_to_robots
from planner.mrac.areas import find_areas
from planner.mrac.board import Robot
from planner.mrac.executive import Executive
from planner.mrac.partition import metis_parts
from planner.mrac.problem import Problem
from planner.mrac.search import NOT_WANTED
from planner.none import NO_AREA, NO_ROBOT
from planner.plans.plan import Area
from planner.plans.state import NAT, ON_ITS_WAY, RETURNING, AreaState, MissionState, RobotState
from planner.tolerance import MOST
from planner.trace import Doing
from planner.worlds.levels import NO_LEVEL


def state_of(run: Executive, borne: Sequence[int] | None = None) -> MissionState:
    """Where a run stands between two steps. Completed areas without cells are left out, the others close up.

    borne: what each robot has borne, in units of 2**-32 nat, which is kept where robots wear. A real robot may have
    borne more than any luck that is drawn: then it is kept as the most that one can.
    """
    world, settings = run.problem.world, run.problem.settings
    settings.check_not_charged("the state of a mission")
    settings.check_alike("the state of a mission")
    known, home = None, run.problem.home
    if borne is not None and settings.wear != 1:
        known = np.minimum(borne, settings.bearing().most(len(run.robots))).tolist()
    kept = [number for number, area in enumerate(run.areas) if len(area.cells)]
    place = {number: index for index, number in enumerate(kept)}
    robots = tuple(
        RobotState(
            cell=robot.cell,
            status=robot.status.name.lower(),
            area=place[robot.area] if robot.on_its_way else NO_AREA,
            ahead=np.array(robot.ahead[::-1] if robot.on_its_way else [], dtype=np.int64),
            to_do=_still_to_do(run, robot),
            moves=int(run.problem.range[robot.number]) - robot.moves,
            held=robot.held,
            exposure=None if known is None else known[robot.number],
            home=None if home is None else int(home.starts[robot.number]),
            turned=robot.turned,
        )
        for robot in run.robots
    )
    areas = []
    for number in kept:
        area, owner = run.areas[number], run.robots[run.areas[number].robot]
        has_it = area.robot != NO_ROBOT and owner.on_its_way and owner.area == number
        areas.append(AreaState(area.level, area.robot if has_it else NO_ROBOT, area.state.value, area.cells))
    visited, survived = np.flatnonzero(run.visited), np.flatnonzero(run.survived)
    over, quiet = (None, run.quiet) if run.over is None else (run.over.word, 0)
    return MissionState(world.shape, world.sha256, run.step, visited, survived, robots, tuple(areas), quiet, over)


def _still_to_do(run: Executive, robot: Robot) -> NDArray[np.int64]:
    """The cells that its coverage path has still to reach: no leg crosses one of them."""
    if robot.status is not Doing.COVERING:
        return np.zeros(0, dtype=np.int64)
    return run.to_do(robot.area) if run.rule.attentive else np.setdiff1d(robot.to_do, robot.path[robot.since :])


def made_ready(problem: Problem, state: MissionState) -> MissionState:
    """The state as runs begin with it: with areas, those of Algorithm 1 where it has none. Raises StateError."""
    problem.settings.check_not_charged("the state of a mission")
    problem.settings.check_alike("the state of a mission")
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
    robots = (
        _sent(problem, robot, robot.area, state.areas[robot.area], state.visited)
        if robot.status in ON_ITS_WAY and not len(robot.ahead)
        else robot
        for robot in state.robots
    )
    state = replace(state, robots=tuple(robots))
    for number, robot in enumerate(state.robots):
        if robot.status in ON_ITS_WAY and not _leads_on(robot, state.areas[robot.area], problem.rule.attentive):
            expected = "a path that ends in its area, and what it has still to cover on it"
            problem_is = f"robot {number} is {robot.status}, but not by policy {problem.rule.name}"
            raise StateError(problem_is, expected=expected, fix=_settings_asked("policy"))
    return state


def _settings_asked(name: str) -> str:
    """What to do about a state that another plan's settings have made."""
    return f"give the settings of the plan that was driven, {argument(name)} among them, or go on with that plan"


def _check_exposures(problem: Problem, state: MissionState) -> None:
    """Raise StateError where robots wear, and what one of them has borne is not known, or more than any robot bears."""
    bearing = problem.settings.bearing(state.exposures)
    if problem.settings.wear == 1:
        return
    borne = bearing.fresh_begun(len(state.robots))
    for number, robot in enumerate(state.robots):
        if robot.alive and robot.exposure is None:
            raise StateError(
                f"robot {number} has no exposure, and robots wear (shape {problem.settings.wear:g})",
                expected='"exposure": what each robot has borne so far, in nat: the sum of -ln(1 - p) over its visits',
            )
        if robot.alive and borne[number] > MOST:
            raise StateError(
                f"robot {number} has an exposure of {state.exposures[number] / NAT:g} nat",
                expected="no more than a robot bears",
            )


def _leads_on(robot: RobotState, area: AreaState, attentive: bool) -> bool:
    if robot.status == "traveling" or attentive:
        return bool(np.isin(robot.ahead[-1], area.cells))
    return robot.ahead[-1] in robot.to_do and bool(np.isin(robot.to_do, robot.ahead).all())


def _allocated(problem: Problem, state: MissionState, able: list[int]) -> MissionState:
    """Algorithm 1 over what is not visited, for the robots that can move; they set out in the next step."""
    shape, levels = problem.world.shape, problem.levels
    seen = np.zeros(problem.costs.size, dtype=np.bool_)
    seen[state.visited] = True

    def parts(of: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.int64]]]:
        return find_areas(shape, replace(levels, of_cell=np.where(of, levels.of_cell, NO_LEVEL)))

    starts, density = problem.starts[able], problem.settings.density
    given = allocate_areas_to_robots(parts(~seen), starts, shape, [problem.paths] * len(starts), density, metis_parts)
    areas = [
        AreaState(a.level, able[a.robot], "assigned", a.cells)
        if a.robot != NO_ROBOT
        else AreaState(a.level, NO_ROBOT, "unassigned", a.cells)
        for a in given
    ]
    owner = {area.robot: number for number, area in enumerate(areas) if area.robot != NO_ROBOT}
    done = [AreaState(level, NO_ROBOT, "completed", cells) for level, cells in parts(seen)]
    robots = tuple(
        _sent(problem, robot, owner[number], areas[owner[number]], state.visited)
        if number in owner
        else replace(robot, status="idle" if number in able else robot.status)
        for number, robot in enumerate(state.robots)
    )
    return replace(state, robots=robots, areas=(*areas, *done), quiet=0)


def _sent(problem: Problem, robot: RobotState, number: int, area: AreaState, visited: NDArray[np.int64]) -> RobotState:
    """The robot on its way to what is to be done of its area."""
    rank = np.full(problem.costs.size, NOT_WANTED, dtype=np.int32)
    rank[np.setdiff1d(area.cells, visited)] = 0
    target = problem.paths.nearest(robot.cell, rank)
    assert target is not None  # Algorithm 1 gives away what can be reached
    ahead = problem.paths.path(robot.cell, target.cell)
    return replace(robot, status="traveling", area=number, ahead=ahead, held=False)


def areas_of(state: MissionState) -> tuple[Area, ...]:
    """The areas as a plan's allocation holds them."""
    return tuple(
        Area(area.level, area.robot if area.state == "assigned" else NO_ROBOT, area.cells) for area in state.areas
    )
