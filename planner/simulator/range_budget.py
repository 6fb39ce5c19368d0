"""What a robot that comes home can afford (SPEC section 19): how far it can still go, and how far home is.

Part of `planner.simulator.rollouts`, which see. Ways home are tables:
`Tables.home_of`, `home_steps`, `home_cost`, `onward`; the costs are empty where robots stay where they end.
"""

from __future__ import annotations

import numpy as np

from .codes import NONE
from .jit import kernel, rare_kernel
from .paths import walk_back
from .robot_types import own, own_turn
from .searches import pop, push
from .state import holds


@kernel
def moves_home(t, robot, cell):
    """h: moves of the robot's way home from the cell, NONE where it is cut off."""
    return np.int64(t.home_steps[t.home_of[robot], cell])


@rare_kernel
def find_ways_home(t, s, w):
    """Ways home as the set believes the map: from the bases outwards, by what is paid up to a cell and for entering it.

    A thread of robots that learn has these tables for itself.
    """
    size = len(t.near)
    for number in range(len(t.home_steps)):
        cost, steps, onward, due = t.home_cost[number], t.home_steps[number], t.onward[number], 0
        for cell in range(size):
            base = t.home_bases[number, cell] and s.entry[cell] > 0
            cost[cell], steps[cell], onward[cell] = (0, 0, cell) if base else (NONE, NONE, cell)
            if base:
                due = push(w.heap_cost, w.heap_cell, due, s.entry[cell], cell)
        while due > 0:
            here = np.int64(w.heap_cell[0])
            due = pop(w.heap_cost, w.heap_cell, due)
            for side in range(4):
                cell = np.int64(s.near[here, side])
                if cell == size:
                    continue
                if cost[cell] == NONE:
                    cost[cell] = cost[here] + s.entry[here]
                    due = push(w.heap_cost, w.heap_cell, due, cost[cell] + s.entry[cell], cell)
                # Sides rise in index: of equal ways the neighbour of lowest index is entered.
                nearer = steps[cell] >= 0 and cost[cell] + s.entry[cell] == cost[here]
                if nearer and (steps[here] == NONE or steps[cell] + 1 < steps[here]):
                    steps[here], onward[here] = steps[cell] + 1, cell


@kernel
def own_moves(t, s, robot):
    """The moves that are left of its range to a robot that decides, or that another one asks about."""
    until, step, acts = s.robots[robot].until, s.marks.step, s.marks.robot
    if holds(s.waiting, robot):
        return until
    now = own_turn(t, robot, step)
    to_move = robot > acts or (robot == acts and s.marks.now > 0)
    return until - now + (to_move and step > 0 and now > own_turn(t, robot, step - 1))


@rare_kernel
def affords(t, s, w, robot, target):
    """Whether the robot could come home from this cell, once it has gone there; without tables the last answer was
    `costs_from` it.
    """
    way = moves_home(t, robot, target)
    if s.marks.unlimited > 0 or way < 0:
        return True
    here = np.int64(s.robots[robot].cell)
    last = own_turn(t, robot, t.last_step) - own_turn(t, robot, s.marks.step - s.marks.now)
    left = min(own_moves(t, s, robot), last) - way
    if t.searches:
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
    ahead, cell, target = np.int64(me.ahead), np.int64(me.next), np.int64(me.target)
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
