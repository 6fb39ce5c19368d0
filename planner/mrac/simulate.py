"""The readable simulator: luck answers the orders of Algorithm 2, step by step (SPEC section 5).

The run with no hits is the nominal run, which the plan records. Faster engines answer to this reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import StateError
from planner.mrac.areas import allocate_areas_to_robots, bisect, find_areas, metis_parts
from planner.mrac.board import Recorder, Robot, Stretch, is_home
from planner.mrac.executive import Executive, Split
from planner.mrac.map_belief import Experienced, Forewarned, Learning
from planner.mrac.problem import Problem, check_every_visit, ready_loop
from planner.plan.plan import Area, Leg, Plan
from planner.plan.state import NAT, ON_ITS_WAY, RETURNING, AreaState, MissionState, RobotState
from planner.rollout_sampling import Luck, Roaming, check_counters, rows_met
from planner.simulator.codes import NO_AREA, NO_ROBOT, Doing, Outcome
from planner.simulator.searches import NOT_WANTED
from planner.simulator.thresholds import MOST
from planner.tally import Trace
from planner.world.levels import NO_LEVEL
from planner.world.map_knowledge import Readings
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

Hit = Callable[[int, int, int], bool]
"""`hit(robot, step, cell)`: is the robot stopped as it enters the cell at this step?"""


@dataclass(frozen=True, eq=False)
class Run:
    """What happened in one run. Axis `K` = robots.

    Attributes:
        paths: per robot int64 `[steps + 1]`: its cell at each step from t = 0 to its last move.
        legs: per robot, its travel and cover legs.
        areas_added: areas made during the run, by sharing or reallocation, in id order.
        outcome, time: how and at which step it ended.
        bisected, divided: areas shared whose unvisited cells were one component, and that lay in several already.
        visited, survived: bool `[N]`, cells entered, and entered without being stopped there.
        alive: bool `[K]`. home: bool `[K]`, alive and at a base, of robots that come home (SPEC section 19).
        area_of: int32 `[N]`, id of the last area that each cell belonged to, -1 where inaccessible.
    """

    paths: tuple[NDArray[np.int64], ...]
    legs: tuple[tuple[Leg, ...], ...]
    areas_added: tuple[Area, ...]
    outcome: Outcome
    time: int
    bisected: int
    divided: int
    visited: NDArray[np.bool_]
    survived: NDArray[np.bool_]
    alive: NDArray[np.bool_]
    home: NDArray[np.bool_]
    area_of: NDArray[np.int32]

    @property
    def shares(self) -> int:
        """Areas shared."""
        return self.bisected + self.divided


def never_hit(robot: int, step: int, cell: int) -> bool:
    """The nominal run's luck."""
    return False


def simulate(
    problem: Problem,
    allocation: tuple[Area, ...],
    *,
    max_steps: int | None = None,
    hit: Hit = never_hit,
    split: Split = bisect,
    recorder: Recorder | None = None,
    state: MissionState | None = None,
    truth: int | None = None,
    movers: Roaming | None = None,
    readings: Readings | None = None,
) -> Run:
    """Run Algorithm 2 from an allocation to its end, by the policy of the problem's settings (SPEC section 11).

    Args:
        problem, allocation, split, recorder, state: as of `Executive`.
        max_steps: T_max, the step at which an unfinished run is cut off; None = the problem's.
        hit: decides every hit; called once for each cell that a live robot enters, in order.
        truth: which of the maps robots meet and learn, where they are not told it (`Problem.unknown`); None: the one
            that they believe. Of hazards it is none of them, but robots learn.
        movers: threats that move (SPEC section 16). readings: of robots with detectors.
    """
    team, last = make_team(problem, allocation, split, recorder, state, truth, readings), max_steps or problem.max_steps
    while (outcome := team.outcome(last)) is None:
        play_step(team, hit, movers)
    return run_of(team, outcome)


def make_team(
    problem: Problem,
    allocation: tuple[Area, ...],
    split: Split = bisect,
    recorder: Recorder | None = None,
    state: MissionState | None = None,
    truth: int | None = None,
    readings: Readings | None = None,
) -> Executive:
    """A run that has not begun; arguments as of `simulate`."""
    if truth is None or problem.unknown is None or not problem.learns:
        return Executive(problem, allocation, split, recorder, state)
    if problem.unknown.evidence is not None:
        return Experienced(problem, allocation, split, recorder, problem.unknown.evidence, readings)
    if problem.unknown.phases is not None:
        return Forewarned(problem, allocation, split, recorder, None, problem.unknown.belief)
    return Learning(problem, allocation, split, recorder, state, problem.unknown.truths[truth])


def play_step(team: Executive, hit: Hit, movers: Roaming | None = None) -> None:
    """The next step, t = 0 if there was none."""
    team.begin_step()
    take_turns(team, hit, movers=movers)


def take_turns(team: Executive, hit: Hit, first: int = 0, movers: Roaming | None = None) -> None:
    """Robots `first`, `first + 1`, ... act in this step, then movers, and it ends."""
    survived = None if movers is None else team.survived.copy()
    for number in range(first, len(team.robots)):
        if not team.has_turn(number):
            team.wait(number)
            continue
        cell = team.decide(number)
        if cell is None:
            continue
        team.enter(number)
        if hit(number, team.step, cell):
            team.stop(number)
        else:
            team.survive(number)
    if movers is not None and survived is not None:
        meet(team, movers, survived)
    team.end_step()


def meet(team: Executive, movers: Roaming, survived: NDArray[np.bool_]) -> None:
    """After the robots' turns movers move, and a robot in the cell of one, standing still or not, may be stopped.

    Who is stopped so in the step in which it entered the cell has not survived there. `survived`: bool `[N]`, as it was
    before the step.
    """
    movers.move(team.step)
    met = [robot for robot in team.robots if robot.alive and movers.meets(robot.number, team.step, robot.cell)]
    for robot in met:
        team.stop(robot.number)
    for cell in {robot.cell for robot in met}:
        others = any(robot.alive and robot.cell == cell for robot in team.robots)
        team.survived[cell] = survived[cell] or others


def run_of(team: Executive, outcome: Outcome) -> Run:
    """What happened, now that the run has ended."""

    def leg(of: Stretch) -> Leg:
        kind, area, start, stop = of
        return Leg(kind, area, team.areas[area].level, start, stop)

    ways = team.problem.home
    home = [ways is not None and robot.alive and is_home(ways, robot) for robot in team.robots]
    return Run(
        paths=tuple(_without_tail(robot.path) for robot in team.robots),
        legs=tuple(tuple(map(leg, robot.legs)) for robot in team.robots),
        areas_added=tuple(team.made[team.given :]),
        outcome=outcome,
        time=team.step,
        bisected=team.bisected,
        divided=team.divided,
        visited=team.visited,
        survived=team.survived,
        alive=np.array([robot.alive for robot in team.robots]),
        home=np.array(home, dtype=np.bool_),
        area_of=team.area_of,
    )


def _without_tail(path: list[int]) -> NDArray[np.int64]:
    """The path without the waiting after its last move."""
    last = len(path)
    while last > 1 and path[last - 1] == path[last - 2]:
        last -= 1
    return np.array(path[:last], dtype=np.int64)


# A run as the state of a mission, and a state made ready to go on from (SPEC section 12).


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


# The closed loop of the readable simulator with the project's randomness: what the compiled engines answer to.
#
# It is slow and shares no kernel with them; use it to check one, or to follow one rollout through
# `planner.mrac.simulate`.


class ReferenceLoop:
    """A plan's closed loop, rollout by rollout.

    Args:
        plan: this project's, made for `world`, or the paths of another planner (`planner.mrac.problem`).
        first_only: `threat_checks="first_visit"`.

    Raises:
        PlanError: a plan for another map.
    """

    def __init__(self, plan: Plan, world: World, *, first_only: bool = False) -> None:
        self._problem, self._areas = ready_loop(plan, world)
        check_counters(world, len(plan.robots), self._problem.max_steps)
        check_every_visit(world, first_only)
        self._bearing = plan.bearing
        self._world, self._first_only, self._state = world, first_only, plan.state

    def run(self, seed: int, rollout: int, recorder: Recorder | None = None) -> Run:
        """Rollout `rollout` (below 2**32) of `seed`, `0 <= seed < 2**64`."""
        problem, areas = self._problem, self._areas
        luck = self._luck_of(seed, rollout)
        return simulate(
            problem, areas, hit=self._hit(luck), recorder=recorder, state=self._state,
            truth=self._truth(seed, rollout), movers=self._movers_of(seed, rollout), readings=luck.readings,
        )  # fmt: skip

    def state_at(self, step: int, seed: int, rollout: int) -> MissionState | None:
        """Where the rollout stands at the end of a step, to go on from; None if it has ended by then."""
        luck = self._luck_of(seed, rollout)
        for team in self._steps(seed, rollout, luck):
            if team.step == step and team.outcome(self._problem.max_steps) is None:
                return state_of(team, [luck.borne(number) for number in range(len(team.robots))])
        return None

    def teams(self, seed: int, rollout: int) -> Iterator[Executive]:
        """The team as it stands at the end of every step: one, which goes on."""
        return self._steps(seed, rollout, self._luck_of(seed, rollout))

    def _steps(self, seed: int, rollout: int, luck: Luck) -> Iterator[Executive]:
        truth, movers, hit = self._truth(seed, rollout), self._movers_of(seed, rollout), self._hit(luck)
        team = make_team(self._problem, self._areas, state=self._state, truth=truth, readings=luck.readings)
        while team.outcome(self._problem.max_steps) is None:
            play_step(team, hit, movers)
            yield team

    def _luck_of(self, seed: int, rollout: int) -> Luck:
        return Luck(self._world, seed, rollout, self._bearing)

    def _truth(self, seed: int, rollout: int) -> int:
        """Which of the maps in doubt is true, 0 where there is one."""
        doubt = self._world.doubt
        return int(rows_met(doubt, seed, rollout)[0]) if isinstance(doubt, Uncertain) else 0

    def _movers_of(self, seed: int, rollout: int) -> Roaming | None:
        movers = self._world.movers
        return None if movers is None else Roaming(movers, seed, rollout, len(self._problem.starts))

    def _hit(self, luck: Luck) -> Hit:
        entered = np.zeros(self._world.threat.size, dtype=np.bool_)
        if self._state is not None:
            entered[self._state.visited] = True

        def hit(robot: int, step: int, cell: int) -> bool:
            checked = not (self._first_only and entered[cell])
            entered[cell] = True
            return checked and luck.hits(robot, step, cell)

        return hit

    def trace(self, seed: int, rollout: int) -> Trace:
        """The same rollout in full; `planner.rollouts.closed_loop.trace_rollouts` gives the same, event for event."""
        recorder = Recorder()
        run = self.run(seed, rollout, recorder)
        return recorder.trace(rollout, run.area_of, run.outcome)
