"""Robots that do no more: at the end of their range, or since they turn for home (SPEC section 19).

Part of `planner.simulator.rollouts`, which see.
"""

from __future__ import annotations

import numpy as np

from .areas import (
    CHARGED_EVENT,
    HOME_EVENT,
    RANGE_ENDED_EVENT,
    REALLOCATED_EVENT,
    TURNED_HOME_EVENT,
    has_area,
    list_unvisited,
    note,
    replace,
)
from .codes import NONE
from .jit import kernel, rare_kernel
from .paths import adjacent, look_up_nearest, seek, to_do_in, to_do_of, walk_back
from .range_budget import can_go_on, moves_home, own_moves
from .robot_types import own_turn
from .state import (
    CHARGING,
    DEAD,
    DONE,
    FAR,
    RETURNING,
    TO_DO,
    drop,
    holds,
    put,
)


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
    if t.returns and moves_home(t, robot, np.int64(s.robots[robot].cell)) == 0:
        return turn_home(t, s, w, log, robot, t.recharge > 0)
    area = np.int64(s.robots[robot].area) if has_area(s.robots, robot) else np.int64(NONE)
    drop(s.movers, robot)
    drop(s.waiting, robot)
    s.robots[robot].doing = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, area, s.robots[robot].cell)
    return area == NONE or leave(t, s, w, log, robot, area)


@rare_kernel
def end_range(t, s, w, log, robot):
    """The same of a robot that waits and has made a move, if that was its last. False: no room for areas."""
    s.robots[robot].until -= 1
    return s.robots[robot].until > 0 or stay(t, s, w, log, robot)


@rare_kernel
def turns(t, s, robot, step):
    """Whether the robot, which has yet to move in this step, turns for home: 1; to be charged there: 2; else 0."""
    now = own_turn(t, robot, step)
    own = s.robots[robot].until - now
    if can_go_on(t, s, robot, min(own, own_turn(t, robot, t.last_step) - now)):
        return 0
    return 2 if t.recharge > 0 and own + 1 < t.range[robot] and not can_go_on(t, s, robot, own) else 1


@kernel
def arrive(t, s, log, robot):
    """The robot is home, for good or until it has its range again."""
    note(log, s, robot, HOME_EVENT, np.int64(NONE), np.int64(s.robots[robot].cell))
    drop(s.movers, robot)
    s.robots[robot].doing = DONE
    if s.robots[robot].ready > 0 and s.marks.over == 0:
        s.robots[robot].doing, s.robots[robot].ready = CHARGING, s.marks.step + t.recharge
        put(s.movers, robot)


@kernel
def charge(t, s, log, robot, step):
    """A step at the base; whether the robot has its range again, as one that may move from the next step on."""
    if step < s.robots[robot].ready:
        return False
    s.robots[robot].ready, s.robots[robot].until = 0, t.range[robot] + own_turn(t, robot, step)
    note(log, s, robot, CHARGED_EVENT, np.int64(NONE), np.int64(s.robots[robot].cell))
    return True


@kernel
def may_be_charged(t, s, robot):
    """Whether a robot for which nothing is left has made moves, and is charged at its base."""
    return t.recharge > 0 and s.marks.open > 0 and own_moves(t, s, robot) < t.range[robot]


@rare_kernel
def turn_home(t, s, w, log, robot, charges):
    """The robot turns for home, for good unless it is charged there. False: no room for what is left of its area."""
    me = s.robots[robot]
    cell, owns, area = np.int64(me.cell), has_area(s.robots, robot), np.int64(me.area)
    onward, base = t.onward[t.home_of[robot]], cell
    while moves_home(t, robot, base) > 0:
        base = np.int64(onward[base])
    note(log, s, robot, TURNED_HOME_EVENT, area if owns else np.int64(NONE), base)
    if holds(s.waiting, robot):
        s.robots[robot].until += own_turn(t, robot, s.marks.step)  # as of one that moves from the next step on
    drop(s.movers, robot)
    drop(s.waiting, robot)
    me.doing, me.held = DONE, 0
    s.robots[robot].ready = FAR if charges else 0
    if owns and not leave(t, s, w, log, robot, area):
        return False
    if moves_home(t, robot, cell) == 0:
        arrive(t, s, log, robot)
    elif base != cell:
        me.doing, me.next = RETURNING, onward[cell]
        put(s.movers, robot)
    return True


@rare_kernel
def go_home(t, s, log, robot):
    """The robot, which is on its way home, has entered its next cell: there it is, or what it enters next."""
    me = s.robots[robot]
    cell = np.int64(me.cell)
    arrives = moves_home(t, robot, cell) == 0
    if not arrives and own_turn(t, robot, s.marks.step) != s.robots[robot].until:
        me.next = t.onward[t.home_of[robot], cell]
        return
    if arrives:
        arrive(t, s, log, robot)
        return
    drop(s.movers, robot)
    me.doing = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, np.int64(NONE), cell)


@rare_kernel
def call_home(t, s, w, log, over):
    """At the end of a step: all turn once the mission is `over`, an Outcome or NONE; before that who would be late.

    False: no room for areas.
    """
    marks = s.marks
    if marks.over > 0:
        return True
    marks.over = over + 1
    for robot in range(len(s.robots)):
        waits, way = holds(s.waiting, robot), moves_home(t, robot, np.int64(s.robots[robot].cell))
        left = own_turn(t, robot, t.last_step) - own_turn(t, robot, marks.step)
        late = waits and way > 0 and left <= way
        doing = s.robots[robot].doing
        if doing == CHARGING and over != NONE:
            drop(s.movers, robot)
            s.robots[robot].doing = DONE
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
        at_base = moves_home(t, robot, np.int64(s.robots[robot].cell)) == 0
        count += s.robots[robot].doing != DEAD and at_base
    s.marks.at_home = count


# Coverage paths remembered: robots mostly begin to cover what one before them has covered from the same cell.
#
# Part of `planner.simulator.rollouts`, which see. A path is found as a whole when it is first wanted, and followed as
# one
# leg to its last cell, the only one marked as to do: no path comes by there sooner. Otherwise (few cells to do, no more
# room, legs that stay in their area) all of them are marked, and legs found one at a time (`planner.simulator.paths`).

FEWEST = 8
"""Cells to do from which on a path is remembered: fewer are sooner covered than looked up."""
KEY = 2
"""Words before a path's cells to do: where it begins, and how many these are."""
MIX = np.uint64(0x9E3779B97F4A7C15)


@kernel
def can_be_remembered(s, w, robot):
    """Whether the path that covers what is unvisited of the robot's area is worth it."""
    return len(w.paths) > 0 and s.areas[s.robots[robot].area].left >= FEWEST


@rare_kernel
def remember(t, s, w, robot):
    """Begin to cover the area's unvisited cells along a path that was remembered or is now; False: no room for it."""
    me = s.robots[robot]
    here, area = np.int64(me.cell), np.int64(me.area)
    count = list_unvisited(s, w, area)
    slot = slot_of(w, here, count)
    if w.slots[slot] == 0:
        w.slots[slot] = new_path(t, s, w, here, area, count)
    path = np.int64(w.slots[slot])
    begin, end = w.ends[max(path, 1) - 1] + KEY + count, w.ends[path]
    if path == 0:
        return False
    target = w.paths[end - 1]
    s.home[target] |= TO_DO
    me.path, me.left, me.ahead, me.next, me.target = path, 1, end - begin - 1, w.paths[begin], target
    return True


@kernel
def mixed(cell):
    """A hash of the cell; those of a set are added."""
    word = (np.uint64(cell) + np.uint64(1)) * MIX
    return (word ^ word >> np.uint64(29)) * MIX


@kernel
def slot_of(w, here, count):
    """The slot of the path from `here` through the `count` cells that are `listed`; a free one if there is none."""
    last, code = len(w.slots) - 1, mixed(here) ^ MIX
    for place in range(count):
        # A sum does not depend on the order; equal hashes are told apart by the cells themselves (`is_of`).
        code += mixed(w.listed[place])
    slot = np.int64((code ^ code >> np.uint64(32)) & np.uint64(last))
    while w.slots[slot] > 0 and not is_of(w, w.ends[w.slots[slot] - 1], here, count):
        # Linear probing; half of the slots stay empty, so it ends soon.
        slot = slot + 1 & last
    return slot


@kernel
def is_of(w, key, here, count):
    """Whether the key at `key` is of that path."""
    same = 0
    if w.paths[key] == here and w.paths[key + 1] == count:
        while same < count and w.paths[key + KEY + same] == w.listed[same]:
            same += 1
    return same == count


@kernel
def new_path(t, s, w, here, area, count):
    """Algorithm 3's path from `here` through the cells that are `listed`; its number, 0 if there is no room for it."""
    path = w.remembered[0]
    key = w.ends[path - 1]
    begin = key + KEY + count
    if path == len(w.ends) or begin > len(w.paths):
        return 0
    w.paths[key], w.paths[key + 1] = here, count
    for place in range(count):
        w.paths[key + KEY + place] = w.listed[place]
        s.home[w.listed[place]] |= TO_DO
    end, cell, wanted, room = begin, here, to_do_in(area), len(w.paths)
    for _ in range(count):
        target = adjacent(t, s, cell, wanted)
        if target == NONE:
            target, end = append_far_leg(t, s, w, cell, area, end, room)
        else:
            if end < room:
                w.paths[end] = target
            end += 1
        # Taken off again as they are met: afterwards the flags are as they were.
        s.home[target] ^= TO_DO
        cell = target
        if end > room:
            w.remembered[0] = len(w.ends)  # and no path after it
            return 0
    w.ends[path] = end
    w.remembered[0] = path + 1
    return path


@rare_kernel
def append_far_leg(t, s, w, here, area, end, room):
    """The cheapest cell to do, where none is adjacent, and where the leg there ends behind `end`; not beyond `room`."""
    if not t.searches:
        target, cell = look_up_nearest(t, s, here, area), np.int64(here)
        while cell != target and end <= room:
            cell = np.int64(t.hop_to[target, cell])
            if end < room:
                w.paths[end] = cell
            end += 1
        return target, end
    target = seek(t, s, w, np.int64(here), to_do_of(area), np.int64(NONE))
    steps = walk_back(t, s, w, here, target, w.queue)
    if end + steps <= room:
        for place in range(steps):
            w.paths[end + place] = w.queue[steps - 1 - place]
    return target, end + steps
