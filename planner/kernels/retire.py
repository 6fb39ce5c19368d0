"""Robots that do no more: at the end of their range, or since they turn for home (SPEC section 19).

Part of `planner.kernels.rollouts`, which see; `planner.mrac.homecoming` is the readable one. Ways home are tables:
`Tables.home_of`, `home_steps`, `onward`, empty where robots stay where they end.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.areas import replace
from planner.kernels.bits import drop, holds, put
from planner.kernels.state import (
    AHEAD,
    AREA,
    AT_HOME,
    CELL,
    DEAD,
    DOING,
    DONE,
    HELD,
    LAST_STEP,
    NEXT,
    OVER,
    RETURNING,
    STEP,
    TARGET,
    UNTIL,
)
from planner.kernels.trace import (
    HOME_EVENT,
    RANGE_ENDED_EVENT,
    REALLOCATED_EVENT,
    TURNED_HOME_EVENT,
    has_area,
    note,
)
from planner.none import NONE


@rare_kernel
def leave(t, s, w, log, robot, area):
    """What the robot leaves unvisited of its area becomes areas. False: no room."""
    first, parts = replace(t, s, w, area, np.bool_(False))
    if parts > 0:
        note(log, s, robot, REALLOCATED_EVENT, area, parts)
    return first != NONE


@rare_kernel
def stay(t, s, w, log, robot):
    """The robot is at the end of its range: it neither moves nor waits for an area. False: no room for areas."""
    if comes_home(t) and moves_home(t, robot, np.int64(s.robots[robot, CELL])) == 0:
        return turn_home(t, s, w, log, robot)
    area = np.int64(s.robots[robot, AREA])
    drop(s.movers, robot)
    s.robots[robot, DOING] = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, area, s.robots[robot, CELL])
    return leave(t, s, w, log, robot, area)


@kernel
def comes_home(t):
    """Whether robots come home."""
    return len(t.home_of) > 0


@kernel
def moves_home(t, robot, cell):
    """h: moves of the robot's way home from the cell."""
    return np.int64(t.home_steps[t.home_of[robot], cell])


@rare_kernel
def can_go_on(t, s, robot, step):
    """Whether the robot, which has yet to move in this step, could come home from every cell of the rest of its leg."""
    me = s.robots[robot]
    left, ahead = min(s.team[robot, UNTIL], t.limits[LAST_STEP]) - step, np.int64(me[AHEAD])
    cell, target = np.int64(me[NEXT]), np.int64(me[TARGET])
    while moves_home(t, robot, cell) <= left:
        if cell == target:
            return True
        if ahead > 0:
            ahead -= 1
            cell = np.int64(s.legs[robot, ahead])
        else:
            cell = np.int64(t.hop_to[target, cell])
        left -= 1
    return False


@rare_kernel
def turn_home(t, s, w, log, robot):
    """The robot turns for home, for good: others may have what is left of its area. False: no room for areas."""
    me = s.robots[robot]
    cell, owns, area = np.int64(me[CELL]), has_area(s.robots, robot), np.int64(me[AREA])
    onward, base = t.onward[t.home_of[robot]], cell
    while moves_home(t, robot, base) > 0:
        base = np.int64(onward[base])
    note(log, s, robot, TURNED_HOME_EVENT, area if owns else np.int64(NONE), base)
    if holds(s.waiting, robot):
        s.team[robot, UNTIL] += s.marks[STEP]  # as of one that moves from the next step on
    drop(s.movers, robot)
    drop(s.waiting, robot)
    me[DOING], me[HELD] = DONE, 0
    if owns and not leave(t, s, w, log, robot, area):
        return False
    if moves_home(t, robot, cell) == 0:
        note(log, s, robot, HOME_EVENT, np.int64(NONE), cell)
    elif base != cell:
        me[DOING], me[NEXT] = RETURNING, onward[cell]
        put(s.movers, robot)
    return True


@rare_kernel
def go_home(t, s, log, robot):
    """The robot, which is on its way home, has entered its next cell: there it is, or what it enters next."""
    me = s.robots[robot]
    cell = np.int64(me[CELL])
    arrives = moves_home(t, robot, cell) == 0
    if not arrives and s.marks[STEP] != s.team[robot, UNTIL]:
        me[NEXT] = t.onward[t.home_of[robot], cell]
        return
    drop(s.movers, robot)
    me[DOING] = DONE
    note(log, s, robot, HOME_EVENT if arrives else RANGE_ENDED_EVENT, np.int64(NONE), cell)


@rare_kernel
def call_home(t, s, w, log, over):
    """At the end of a step: all turn once the mission is `over`, an Outcome or NONE; before that who would be late.

    False: no room for areas.
    """
    marks = s.marks
    if marks[OVER] > 0:
        return True
    marks[OVER] = over + 1
    for robot in range(len(s.robots)):
        waits, way = holds(s.waiting, robot), moves_home(t, robot, np.int64(s.robots[robot, CELL]))
        late = waits and way > 0 and t.limits[LAST_STEP] - marks[STEP] <= way
        turned = not waits and (not holds(s.movers, robot) or s.robots[robot, DOING] == RETURNING)
        if not turned and (late or over != NONE) and not turn_home(t, s, w, log, robot):
            return False
    return True


@kernel
def is_away(s):
    """Whether some robot moves, or is about to."""
    found = False
    for word in range(len(s.movers)):
        found = found or s.movers[word] != 0
    return found


@rare_kernel
def count_home(t, s):
    """At the end of a run: robots alive that are at one of their bases."""
    count = 0
    for robot in range(len(s.robots)):
        at_base = moves_home(t, robot, np.int64(s.robots[robot, CELL])) == 0
        count += s.robots[robot, DOING] != DEAD and at_base
    s.marks[AT_HOME] = count
