"""What a robot that comes home can afford (SPEC section 19): how far it can still go, and how far home is.

Part of `planner.kernels.rollouts`, which see; `planner.mrac.homecoming` is the readable one. Ways home are tables:
`Tables.home_of`, `home_steps`, `home_cost`, `onward`; the costs are empty where robots stay where they end.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.bits import holds
from planner.kernels.own import own, own_turn
from planner.kernels.rows import walk_back
from planner.kernels.state import AHEAD, CELL, LAST_STEP, NEXT, NOW, STEP, TARGET, UNLIMITED, UNTIL


@kernel
def comes_home(t):
    """Whether robots come home."""
    return len(t.home_cost) > 0


@kernel
def moves_home(t, robot, cell):
    """h: moves of the robot's way home from the cell, NONE where it is cut off."""
    return np.int64(t.home_steps[t.home_of[robot], cell])


@kernel
def own_moves(t, s, robot):
    """The moves that are left of its range to a robot that decides."""
    until = s.team[robot, UNTIL]
    return until if holds(s.waiting, robot) else until - own_turn(t, robot, s.marks[STEP]) + s.marks[NOW]


@rare_kernel
def affords(t, s, w, robot, target):
    """Whether the robot could come home from this cell, once it has gone there; without tables the last answer was
    `costs_from` it.
    """
    way = moves_home(t, robot, target)
    if s.marks[UNLIMITED] > 0 or way < 0:
        return True
    here = np.int64(s.robots[robot, CELL])
    last = own_turn(t, robot, t.limits[LAST_STEP]) - own_turn(t, robot, s.marks[STEP] - s.marks[NOW])
    left = min(own_moves(t, s, robot), last) - way
    if len(t.cost_to) == 0:
        return walk_back(t, s, w, here, target, w.stack) <= left
    for _ in range(left):
        if here == target:
            break
        here = np.int64(t.hop_to[own(t, robot, target), here])
    return left >= 0 and here == target


@rare_kernel
def can_go_on(t, s, robot, left):
    """Whether the robot, with so many moves left after the next, could come home from every cell of its leg's rest."""
    me = s.robots[robot]
    ahead, cell, target = np.int64(me[AHEAD]), np.int64(me[NEXT]), np.int64(me[TARGET])
    while moves_home(t, robot, cell) <= left:
        if cell == target:
            return True
        if ahead > 0:
            ahead -= 1
            cell = np.int64(s.legs[robot, ahead])
        else:
            cell = np.int64(t.hop_to[own(t, robot, target), cell])
        left -= 1
    return False
