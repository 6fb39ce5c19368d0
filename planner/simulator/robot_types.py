"""What differs from robot to robot where they are of several types, or speeds (SPEC section 22).

Part of `planner.simulator.rollouts`, which see. Of several types tables by cell have the rows of each, one after the
other: `Tables.type_of` and `own_level`. Of several speeds a robot has a turn in every `pace`-th step, and what counts
its moves counts these turns. All empty where robots are alike.
"""

from __future__ import annotations

import numpy as np

from .jit import kernel, rare_kernel
from .state import DEAD, holds, put


@kernel
def own(t, robot, cell):
    """The row of the cell in tables that are by type."""
    return np.int64(cell) if not t.mixed else np.int64(cell) + t.type_of[robot] * len(t.near)


@kernel
def own_level(t, robot, level):
    """What an area of this level is to the robot, 0 = safe."""
    return np.int64(level) if not t.mixed else t.own_level[t.type_of[robot], level]


@kernel
def own_turn(t, robot, step):
    """The turns that the robot has had by the end of this step, that of t = 0 left out."""
    return np.int64(step) if not t.paced else np.int64(step) // t.pace[robot]


@kernel
def on_turn(t, step, word, bits):
    """Those of the robots, bits of a word of them, that have a turn in this step."""
    return bits if not t.paced else bits & turns_in(t, step, word)


@rare_kernel
def turns_in(t, step, word):
    """Bits of the robots of a word that have a turn in this step."""
    found = np.uint64(0)
    for number in range(len(t.ticks)):
        if step % t.ticks[number] == 0:
            found |= t.clock[number, word]
    return found


@kernel
def moves_until(t, helper, owner, moves):
    """The moves that the helper makes while the owner makes so many."""
    return moves if not t.paced else moves * t.pace[owner] // t.pace[helper]


# Which robots hear each other (SPEC section 22).
#
# Part of `planner.simulator.rollouts`, which see. `Tables.place`, `bases` and `reach` are empty where all do.


@kernel
def hears(t, s, robot):
    """Whether the robot is in touch with a base, by way of others that are alive: only then it takes over."""
    return not t.radio or _is_in_chain(t, s, robot)


@kernel
def drives_back(t, s, robot):
    """Whether a robot that waits makes a move back, to hear of areas that nobody has: into its next cell, then."""
    return t.radio and _has_way_back(t, s, robot)


@rare_kernel
def _has_way_back(t, s, robot):
    me = s.robots[robot]
    if s.marks.open == 0 or s.robots[robot].until == 0 or not holds(s.waiting, robot) or _is_in_chain(t, s, robot):
        return False
    me.next = t.onward[t.home_of[robot], me.cell]
    s.marks.changes += 1  # what it visits on its way makes offers worse
    return me.next != me.cell


@kernel
def came_back(t, s, robot):
    """Whether the robot has just made such a move."""
    return t.radio and holds(s.waiting, robot)


@rare_kernel
def _is_in_chain(t, s, robot):
    s.heard[:] = np.uint64(0)
    found = True
    while found and not holds(s.heard, robot):
        found = False
        for one in range(len(s.robots)):
            if not holds(s.heard, one) and s.robots[one].doing != DEAD and _is_near(t, s, one):
                put(s.heard, one)
                found = True
    return holds(s.heard, robot)


@kernel
def _is_near(t, s, one):
    """Whether a base, or a robot that is heard, is near enough."""
    row, col = t.place[s.robots[one].cell, 0], t.place[s.robots[one].cell, 1]
    for base in range(len(t.bases)):
        if (row - t.bases[base, 0]) ** 2 + (col - t.bases[base, 1]) ** 2 <= t.reach[0]:
            return True
    for other in range(len(s.robots)):
        cell = s.robots[other].cell
        if holds(s.heard, other) and (row - t.place[cell, 0]) ** 2 + (col - t.place[cell, 1]) ** 2 <= t.reach[0]:
            return True
    return False
