"""Range budget of a robot that returns to base (SPEC section 19): moves left, and moves to base.

Ways to base are tables: `Tables.home_of`, `home_steps`, `home_cost`, `onward`. Costs are empty where robots do not
return.
"""

import numpy as np

from .codes import NONE
from .jit import kernel, rare_kernel
from .paths import walk_back
from .robot_types import own, own_turn
from .searches import pop, push
from .state import holds


@kernel
def moves_home(t, robot, cell):
    """h: moves of the robot's way to base from the cell, NONE where there is none."""
    return np.int64(t.home_steps[t.home_of[robot], cell])


@rare_kernel
def find_ways_to_base(t, s, w):
    """Compute ways to base on the team's map, by Dijkstra's algorithm from the bases outwards.

    Cells are queued by cost to base plus own entry cost. In online missions each thread has its own tables.
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
                # Sides increase in index: of equal ways the neighbour of lowest index is entered.
                # A cell leaves the queue after all cells on cheapest ways from it, so their moves are final.
                nearer = steps[cell] >= 0 and cost[cell] + s.entry[cell] == cost[here]
                if nearer and (steps[here] == NONE or steps[cell] + 1 < steps[here]):
                    steps[here], onward[here] = steps[cell] + 1, cell


@kernel
def own_moves(t, s, robot):
    """Moves left of the range of a robot that decides, or that another robot evaluates."""
    until, step, acts = s.robots[robot].until, s.marks.step, s.marks.robot
    if holds(s.waiting, robot):
        return until
    now = own_turn(t, robot, step)
    # Robots act in index order: those after the acting one still have this step's move.
    to_move = robot > acts or (robot == acts and s.marks.now > 0)
    # A robot that has yet to move in this step has one move more than after it.
    return until - now + (to_move and step > 0 and now > own_turn(t, robot, step - 1))


@rare_kernel
def is_within_range(t, s, w, robot, target):
    """Whether the robot can reach the cell and then return to base; without tables `costs_from` must come before."""
    way = moves_home(t, robot, target)
    # A cell that has no way to base does not bind the robot: it stays where its range ends.
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
    """Whether the robot, with `left` moves after the next one, could return to base from all cells of its leg."""
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
