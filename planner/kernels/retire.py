"""Robots that do no more: at the end of their range, or since they turn for home (SPEC section 19).

Part of `planner.kernels.rollouts`, which see; the readable one is `planner.mrac.executive`.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.afford import can_go_on, comes_home, moves_home, own_moves
from planner.kernels.areas import replace
from planner.kernels.bits import drop, holds, put
from planner.kernels.own import own_turn
from planner.kernels.state import (
    AREA,
    AT_HOME,
    CELL,
    CHARGING,
    DEAD,
    DOING,
    DONE,
    FAR,
    HELD,
    LAST_STEP,
    NEXT,
    OPEN,
    OVER,
    READY,
    RECHARGE,
    RETURNING,
    STEP,
    UNTIL,
)
from planner.kernels.trace import (
    CHARGED_EVENT,
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
        return turn_home(t, s, w, log, robot, t.limits[RECHARGE] > 0)
    area = np.int64(s.robots[robot, AREA]) if has_area(s.robots, robot) else np.int64(NONE)
    drop(s.movers, robot)
    drop(s.waiting, robot)
    s.robots[robot, DOING] = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, area, s.robots[robot, CELL])
    return area == NONE or leave(t, s, w, log, robot, area)


@rare_kernel
def end_range(t, s, w, log, robot):
    """The same of a robot that waits and has made a move, if that was its last. False: no room for areas."""
    s.team[robot, UNTIL] -= 1
    return s.team[robot, UNTIL] > 0 or stay(t, s, w, log, robot)


@rare_kernel
def turns(t, s, robot, step):
    """Whether the robot, which has yet to move in this step, turns for home: 1; to be charged there: 2; else 0."""
    now = own_turn(t, robot, step)
    own = s.team[robot, UNTIL] - now
    if can_go_on(t, s, robot, min(own, own_turn(t, robot, t.limits[LAST_STEP]) - now)):
        return 0
    return 2 if t.limits[RECHARGE] > 0 and own + 1 < t.range[robot] and not can_go_on(t, s, robot, own) else 1


@kernel
def arrive(t, s, log, robot):
    """The robot is home, for good or until it has its range again."""
    note(log, s, robot, HOME_EVENT, np.int64(NONE), np.int64(s.robots[robot, CELL]))
    drop(s.movers, robot)
    s.robots[robot, DOING] = DONE
    if s.team[robot, READY] > 0 and s.marks[OVER] == 0:
        s.robots[robot, DOING], s.team[robot, READY] = CHARGING, s.marks[STEP] + t.limits[RECHARGE]
        put(s.movers, robot)


@kernel
def charge(t, s, log, robot, step):
    """A step at the base; whether the robot has its range again, as one that may move from the next step on."""
    if step < s.team[robot, READY]:
        return False
    s.team[robot, READY], s.team[robot, UNTIL] = 0, t.range[robot] + own_turn(t, robot, step)
    note(log, s, robot, CHARGED_EVENT, np.int64(NONE), np.int64(s.robots[robot, CELL]))
    return True


@kernel
def may_be_charged(t, s, robot):
    """Whether a robot for which nothing is left has made moves, and is charged at its base."""
    return t.limits[RECHARGE] > 0 and s.marks[OPEN] > 0 and own_moves(t, s, robot) < t.range[robot]


@rare_kernel
def turn_home(t, s, w, log, robot, charges):
    """The robot turns for home, for good unless it is charged there. False: no room for what is left of its area."""
    me = s.robots[robot]
    cell, owns, area = np.int64(me[CELL]), has_area(s.robots, robot), np.int64(me[AREA])
    onward, base = t.onward[t.home_of[robot]], cell
    while moves_home(t, robot, base) > 0:
        base = np.int64(onward[base])
    note(log, s, robot, TURNED_HOME_EVENT, area if owns else np.int64(NONE), base)
    if holds(s.waiting, robot):
        s.team[robot, UNTIL] += own_turn(t, robot, s.marks[STEP])  # as of one that moves from the next step on
    drop(s.movers, robot)
    drop(s.waiting, robot)
    me[DOING], me[HELD] = DONE, 0
    s.team[robot, READY] = FAR if charges else 0
    if owns and not leave(t, s, w, log, robot, area):
        return False
    if moves_home(t, robot, cell) == 0:
        arrive(t, s, log, robot)
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
    if not arrives and own_turn(t, robot, s.marks[STEP]) != s.team[robot, UNTIL]:
        me[NEXT] = t.onward[t.home_of[robot], cell]
        return
    if arrives:
        arrive(t, s, log, robot)
        return
    drop(s.movers, robot)
    me[DOING] = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, np.int64(NONE), cell)


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
        left = own_turn(t, robot, t.limits[LAST_STEP]) - own_turn(t, robot, marks[STEP])
        late = waits and way > 0 and left <= way
        doing = s.robots[robot, DOING]
        if doing == CHARGING and over != NONE:
            drop(s.movers, robot)
            s.robots[robot, DOING] = DONE
        turned = not waits and (not holds(s.movers, robot) or doing in (RETURNING, CHARGING))
        if not turned and (late or over != NONE) and not turn_home(t, s, w, log, robot, False):
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
