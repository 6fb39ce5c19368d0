"""A mission under way as the compiled simulator's first state, instead of t = 0 (`planner.plans.state`).

Plain Python, once a thread. Axis `A` = accessible cells; the rows are those of `planner.kernels.state`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.kernels.bits import fill
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA,
    AREA_BITS,
    BORNE,
    COVERED,
    COVERING,
    DEAD,
    DOING,
    DONE,
    HELD,
    IDLE,
    LEFT,
    LEFT_IN,
    LOWEST,
    NEXT,
    NO_LEVEL,
    OPEN,
    OVER,
    QUIET,
    RETURNING,
    STEP,
    SURVIVED,
    TARGET,
    TO_DO,
    TRAVELING,
    UNFINISHED,
    UNSURVIVED,
    UNTIL,
    VISITED,
    State,
    Tables,
)
from planner.plans.state import ON_ITS_WAY, MissionState, RobotState
from planner.tally import Outcome

DOINGS = {"idle": IDLE, "traveling": TRAVELING, "covering": COVERING, "done": DONE, "dead": DEAD}
DOINGS |= {"returning": RETURNING}


def set_back_to(mission: MissionState, state: State, tables: Tables, cells: NDArray[np.int64]) -> None:
    """Write the mission into `state`, which holds t = 0 of its areas; `cells`: int64 `[A]`, the accessible ones."""
    state.home[np.searchsorted(cells, mission.visited)] |= VISITED
    survived = np.searchsorted(cells, mission.survived)
    state.home[survived] |= SURVIVED
    if len(state.passes):
        state.passes[survived] = 1  # how often before is not known
    left = np.bincount(state.home[:-1][state.home[:-1] & VISITED == 0] >> AREA_BITS, minlength=len(mission.areas))
    state.areas[: len(left), LEFT_IN] = left
    state.marks[[COVERED, UNSURVIVED]] = len(mission.visited), len(mission.visited) - len(mission.survived)
    unassigned = [number for number, area in enumerate(mission.areas) if area.state == "unassigned"]
    level, lowest = tables.level[unassigned], tables.level[unassigned].min(initial=NO_LEVEL)
    alive = sum(robot.alive for robot in mission.robots)
    state.marks[[STEP, QUIET, ALIVE, OPEN]] = mission.step + 1, mission.quiet, alive, len(unassigned)
    state.marks[[LOWEST, UNFINISHED]] = lowest, np.count_nonzero(left)
    if len(tables.times):
        state.team[:, BORNE] = mission.exposures
    until = state.team[:, UNTIL]
    until[:] = tables.range - [robot.moves for robot in mission.robots]
    moving = np.array([robot.status in (*ON_ITS_WAY, "returning") for robot in mission.robots])
    rests = [robot.status in ("idle", "done") and not robot.turned for robot in mission.robots]
    waiting = np.array(rests) & (until > 0)
    state.marks[OVER] = 0 if mission.over is None else Outcome[mission.over.upper()] + 1
    until[moving] += mission.step
    for bits, members in (
        (state.open, unassigned),
        (state.lowest, np.array(unassigned, dtype=np.int64)[level == lowest]),
        (state.movers, np.flatnonzero(moving)),
        (state.waiting, np.flatnonzero(waiting)),
    ):
        fill(bits, members)
    for number, robot in enumerate(mission.robots):
        _put_robot(state, number, robot, cells)
        if robot.status == "returning":
            here = np.searchsorted(cells, robot.cell)
            state.robots[number, NEXT] = tables.onward[tables.home_of[number], here]


def _put_robot(state: State, number: int, robot: RobotState, cells: NDArray[np.int64]) -> None:
    row = state.robots[number]
    row[DOING], row[HELD] = DOINGS[robot.status], robot.held
    if robot.status not in ON_ITS_WAY:
        return
    to_do, ahead = np.searchsorted(cells, robot.to_do), np.searchsorted(cells, robot.ahead)
    state.home[to_do] |= TO_DO
    ends = np.flatnonzero(np.isin(ahead, to_do)) if robot.status == "covering" else ahead[:0]
    leg = ahead[: int(ends[0]) + 1] if len(ends) else ahead
    row[AREA], row[LEFT], row[NEXT], row[TARGET] = robot.area, len(to_do), leg[0], leg[-1]
    if len(state.legs):
        row[AHEAD] = len(leg) - 1
        state.legs[number, : len(leg) - 1] = leg[:0:-1]


def first_frames(mission: MissionState, cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """Cell, doing and area of each robot, as it stands in every step up to the state's: int32 `[step + 1, 3, K]`."""
    robots = mission.robots
    now = [
        np.searchsorted(cells, [robot.cell for robot in robots]).tolist(),
        [DOINGS[robot.status] for robot in robots],
        [robot.area for robot in robots],
    ]
    return np.broadcast_to(np.array(now, dtype=np.int32), (mission.step + 1, 3, len(robots)))
