"""The readable simulator: luck answers the orders of Algorithm 2, step by step (SPEC section 5).

The run with no hits is the nominal run, which the plan records. Faster engines answer to this reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.mrac.believe import Learning
from planner.mrac.board import Stretch
from planner.mrac.executive import Executive, Split
from planner.mrac.experience import Experienced
from planner.mrac.forewarned import Forewarned
from planner.mrac.homecoming import is_home
from planner.mrac.partition import bisect
from planner.mrac.problem import Problem
from planner.mrac.recorder import Recorder
from planner.plans.plan import Area, Leg
from planner.plans.state import MissionState
from planner.roaming import Roaming
from planner.tally import Outcome
from planner.worlds.evidence import Readings

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
