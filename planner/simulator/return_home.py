"""Robots at the end of their range or on the return to base (SPEC section 19), and cached coverage paths."""

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
from .codes import CHARGING, DEAD, DONE, NONE, RETURNING
from .jit import kernel, rare_kernel
from .paths import adjacent, look_up_nearest, seek, to_do_in, to_do_of, walk_back
from .range_budget import can_go_on, moves_home, own_moves
from .robot_types import own_turn
from .state import FAR, ONE, TO_DO, WORD, drop, holds, lowest_bit, put


@rare_kernel
def leave(t, s, w, log, robot, area):
    """Make new areas of the unvisited cells of the robot's area. False: the area registry is full."""
    first, parts = replace(t, s, w, area, np.bool_(False))
    if parts > 0:
        note(log, s, robot, REALLOCATED_EVENT, area, parts)
    return first != NONE


@rare_kernel
def stay(t, s, w, log, robot):
    """The robot is at the end of its range: it neither moves nor waits for an area. False: the registry is full."""
    if t.returns and moves_home(t, robot, np.int64(s.robots[robot].cell)) == 0:
        return start_return(t, s, w, log, robot, t.recharge > 0)
    area = np.int64(s.robots[robot].area) if has_area(s.robots, robot) else np.int64(NONE)
    drop(s.moving, robot)
    drop(s.waiting, robot)
    s.robots[robot].doing = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, area, s.robots[robot].cell)
    return area == NONE or leave(t, s, w, log, robot, area)


@rare_kernel
def end_range(t, s, w, log, robot):
    """Count a move of a waiting robot; at the last one it stays. False: the area registry is full."""
    s.robots[robot].until -= 1
    return s.robots[robot].until > 0 or stay(t, s, w, log, robot)


@rare_kernel
def turns(t, s, robot, step):
    """Whether the robot, before its move in this step, starts its return: 1; to go on afterwards: 2; else 0."""
    now = own_turn(t, robot, step)
    own = s.robots[robot].until - now
    if can_go_on(t, s, robot, min(own, own_turn(t, robot, t.last_step) - now)):
        # Without a way to base it would never go on.
        away = t.deliver_every + t.deliver_value > 0 and moves_home(t, robot, np.int64(s.robots[robot].cell)) > 0
        return 2 if away and is_laden(t, s.undelivered[robot], s.undelivered[len(s.robots)]) else 0
    return 2 if t.recharge > 0 and own + 1 < t.range[robot] and not can_go_on(t, s, robot, own) else 1


@kernel
def is_laden(t, undelivered, delivered):
    """Whether the cells of a set that are not in the other are as many, or have the value, that robots deliver."""
    count, value = 0, 0
    for word in range(len(undelivered)):
        left = undelivered[word] & ~delivered[word]
        while left != 0:
            count += 1
            if t.deliver_value > 0:
                value += t.cell_value[word * WORD + lowest_bit(left)]
            left &= left - ONE
    return 0 < t.deliver_every <= count or 0 < t.deliver_value <= value


@kernel
def arrive(t, s, log, robot):
    """The robot is at base, for good or to go on, possibly recharged."""
    note(log, s, robot, HOME_EVENT, np.int64(NONE), np.int64(s.robots[robot].cell))
    drop(s.moving, robot)
    s.robots[robot].doing = DONE
    if s.robots[robot].ready > 0 and s.marks.over == 0:
        s.robots[robot].doing, s.robots[robot].ready = CHARGING, s.marks.step + t.recharge
        put(s.moving, robot)


@kernel
def charge(t, s, log, robot, step):
    """One step at the base; whether the robot may move from the next step on, recharged if it can be."""
    if step < s.robots[robot].ready:
        return False
    s.robots[robot].ready = 0
    if t.recharge > 0:
        s.robots[robot].until = t.range[robot] + own_turn(t, robot, step)
    note(log, s, robot, CHARGED_EVENT, np.int64(NONE), np.int64(s.robots[robot].cell))
    return True


@kernel
def may_recharge(t, s, robot):
    """Whether a robot without an area can be recharged: there are unassigned areas, and it has used some range."""
    return t.recharge > 0 and s.marks.open > 0 and own_moves(t, s, robot) < t.range[robot]


@rare_kernel
def start_return(t, s, w, log, robot, charges):
    """The robot starts its return to base, for good unless it `charges` there. False: the area registry is full."""
    me = s.robots[robot]
    cell, owns, area = np.int64(me.cell), has_area(s.robots, robot), np.int64(me.area)
    # The base is not stored: it is where the way ends.
    onward, base = t.onward[t.home_of[robot]], cell
    while moves_home(t, robot, base) > 0:
        base = np.int64(onward[base])
    note(log, s, robot, TURNED_HOME_EVENT, area if owns else np.int64(NONE), base)
    waited = holds(s.waiting, robot)
    drop(s.moving, robot)
    drop(s.waiting, robot)
    me.doing, me.held = DONE, 0
    s.robots[robot].ready = FAR if charges else 0
    if owns and not leave(t, s, w, log, robot, area):
        return False
    if moves_home(t, robot, cell) == 0:
        arrive(t, s, log, robot)
    elif base != cell:
        me.doing, me.next = RETURNING, onward[cell]
        put(s.moving, robot)
    if waited and holds(s.moving, robot):
        s.robots[robot].until += own_turn(t, robot, s.marks.step)  # a turn again: it moves from the next step on
    return True


@rare_kernel
def move_to_base(t, s, log, robot):
    """The robot has moved on its way to base: it has arrived, or the next cell is set, or its range has ended."""
    me = s.robots[robot]
    cell = np.int64(me.cell)
    arrives = moves_home(t, robot, cell) == 0
    if not arrives and own_turn(t, robot, s.marks.step) != s.robots[robot].until:
        me.next = t.onward[t.home_of[robot], cell]
        return
    if arrives:
        arrive(t, s, log, robot)
        return
    drop(s.moving, robot)
    me.doing = DONE
    note(log, s, robot, RANGE_ENDED_EVENT, np.int64(NONE), cell)


@rare_kernel
def start_returns(t, s, w, log, over):
    """Start returns at the end of a step: all robots if the mission is over, before that those that would be late.

    Args:
        over: the Outcome, or NONE.

    Returns:
        False if the area registry is full.
    """
    marks = s.marks
    if marks.over > 0:
        return True
    marks.over = over + 1
    for robot in range(len(s.robots)):
        waits, way = holds(s.waiting, robot), moves_home(t, robot, np.int64(s.robots[robot].cell))
        left = own_turn(t, robot, t.last_step) - own_turn(t, robot, marks.step)
        # A moving robot decides in its own turn; only a waiting one can be late without noticing.
        late = waits and way > 0 and left <= way
        doing = s.robots[robot].doing
        if doing == CHARGING and over != NONE:
            drop(s.moving, robot)
            s.robots[robot].doing = DONE
        turned = not waits and (not holds(s.moving, robot) or doing in (RETURNING, CHARGING))
        if not turned and (late or over != NONE) and not start_return(t, s, w, log, robot, False):
            return False
    return True


@kernel
def is_away(s):
    """Whether some robot moves or is about to."""
    found = False
    for word in range(len(s.moving)):
        found = found or s.moving[word] != 0
    return found


@rare_kernel
def count_at_base(t, s):
    """Count the robots alive at one of their bases, at the end of a run."""
    count = 0
    for robot in range(len(s.robots)):
        at_base = moves_home(t, robot, np.int64(s.robots[robot].cell)) == 0
        count += s.robots[robot].doing != DEAD and at_base
    s.marks.at_home = count


# Cached coverage paths: robots mostly cover the same cells from the same start as a robot before them.
#
# A cached path is computed as a whole when it is first needed. It is followed as one leg to its last cell, the only one
# marked as to do: no path enters that cell earlier. Otherwise (few cells to do, no room, legs that stay in their area)
# all cells are marked, and legs are found one at a time (`planner.simulator.paths`).

FEWEST = 8
"""Cells to do from which on a path is cached: fewer are covered faster than looked up."""
KEY = 2
"""Words before the cells of a path's key: its first cell, and the number of cells to do."""
MIX = np.uint64(0x9E3779B97F4A7C15)


@kernel
def can_be_cached(s, w, robot):
    """Whether the path over the unvisited cells of the robot's area is worth caching."""
    return len(w.paths) > 0 and s.areas[s.robots[robot].area].left >= FEWEST


@rare_kernel
def cache_path(t, s, w, robot):
    """Begin to cover the area's unvisited cells along a cached path, made if needed; False: the cache is full."""
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
    """Hash of a cell; the hashes of a set are added."""
    word = (np.uint64(cell) + np.uint64(1)) * MIX
    return (word ^ word >> np.uint64(29)) * MIX


@kernel
def slot_of(w, here, count):
    """The slot of the path from `here` through the first `count` cells of `w.listed`, or the free slot for it."""
    last, code = len(w.slots) - 1, mixed(here) ^ MIX
    for place in range(count):
        # A sum does not depend on the order; equal hashes are distinguished by the cells (`is_of`).
        code += mixed(w.listed[place])
    slot = np.int64((code ^ code >> np.uint64(32)) & np.uint64(last))
    while w.slots[slot] > 0 and not is_of(w, w.ends[w.slots[slot] - 1], here, count):
        # Linear probing; at most half of the slots are used, so it ends soon.
        slot = slot + 1 & last
    return slot


@kernel
def is_of(w, key, here, count):
    """Whether the key at position `key` is that of this path."""
    same = 0
    if w.paths[key] == here and w.paths[key + 1] == count:
        while same < count and w.paths[key + KEY + same] == w.listed[same]:
            same += 1
    return same == count


@kernel
def new_path(t, s, w, here, area, count):
    """Compute Algorithm 3's path from `here` through the listed cells; its index, 0 if the cache is full."""
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
        # Cleared when the path meets them: afterwards all flags are restored.
        s.home[target] ^= TO_DO
        cell = target
        if end > room:
            w.remembered[0] = len(w.ends)  # the cache is closed
            return 0
    w.ends[path] = end
    w.remembered[0] = path + 1
    return path


@rare_kernel
def append_far_leg(t, s, w, here, area, end, room):
    """Append the leg to the cheapest cell to do, if none is adjacent; (that cell, end of the leg), within `room`."""
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
