"""Coverage paths remembered: robots mostly begin to cover what one before them has covered from the same cell.

Part of `planner.kernels.rollouts`, which see. A path is found as a whole when it is first wanted, and followed as one
leg to its last cell, the only one marked as to do: no path comes by there sooner. Otherwise (few cells to do, no more
room, legs that stay in their area) all of them are marked, and legs found one at a time (`planner.kernels.paths`).
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.areas import list_unvisited
from planner.kernels.nearest import searches, seek, to_do_of
from planner.kernels.paths import adjacent, look_up_nearest, to_do_in
from planner.kernels.rows import walk_back
from planner.kernels.state import AHEAD, AREA, CELL, LEFT, LEFT_IN, NEXT, PATH, TARGET, TO_DO
from planner.none import NONE

FEWEST = 8
"""Cells to do from which on a path is remembered: fewer are sooner covered than looked up."""
KEY = 2
"""Words before a path's cells to do: where it begins, and how many these are."""
MIX = np.uint64(0x9E3779B97F4A7C15)


@kernel
def can_be_remembered(s, w, robot):
    """Whether the path that covers what is unvisited of the robot's area is worth it."""
    return len(w.paths) > 0 and s.areas[s.robots[robot, AREA], LEFT_IN] >= FEWEST


@rare_kernel
def remember(t, s, w, robot):
    """Begin to cover the area's unvisited cells along a path that was remembered or is now; False: no room for it."""
    me = s.robots[robot]
    here, area = np.int64(me[CELL]), np.int64(me[AREA])
    count = list_unvisited(s, w, area)
    slot = slot_of(w, here, count)
    if w.slots[slot] == 0:
        w.slots[slot] = new_path(t, s, w, here, area, count)
    path = np.int64(w.slots[slot])
    begin, end = w.ends[max(path, 1) - 1] + KEY + count, w.ends[path]
    if path == 0 or begin == end:
        return False
    target = w.paths[end - 1]
    s.home[target] |= TO_DO
    me[PATH], me[LEFT], me[AHEAD], me[NEXT], me[TARGET] = path, 1, end - begin - 1, w.paths[begin], target
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
    """Algorithm 3's path from `here` through the cells that are `listed`; its number, 0 if there is no room for it.

    One that is too long for AHEAD to count its moves is remembered without them.
    """
    path = w.remembered[0]
    key = w.ends[path - 1]
    begin = key + KEY + count
    if path == len(w.ends) or begin > len(w.paths):
        return 0
    w.paths[key], w.paths[key + 1] = here, count
    for place in range(count):
        w.paths[key + KEY + place] = w.listed[place]
        s.home[w.listed[place]] |= TO_DO
    end, cell, wanted = begin, here, to_do_in(area)
    room = min(len(w.paths), begin + 2 ** (8 * s.robots.itemsize) - 1)
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
            if room == len(w.paths):
                w.remembered[0] = len(w.ends)  # and no path after it
                return 0
            end = begin
            break
    w.ends[path] = end
    w.remembered[0] = path + 1
    return path


@rare_kernel
def append_far_leg(t, s, w, here, area, end, room):
    """The cheapest cell to do, where none is adjacent, and where the leg there ends behind `end`; not beyond `room`."""
    if not searches(t):
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
