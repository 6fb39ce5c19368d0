"""Differences between robots: types, speeds, and radio range (SPEC section 22).

With several types, tables by cell hold the rows of each type in turn (`Tables.type_of`, `own_level`). With several
speeds a robot has a turn in every `pace`-th step, and its moves are counted in turns. All tables are empty for equal
robots.
"""

import numpy as np

from .codes import DEAD
from .jit import kernel, rare_kernel
from .state import holds, put


@kernel
def own(t, robot, cell):
    """Row of the cell in tables by type."""
    return np.int64(cell) if not t.mixed else np.int64(cell) + t.type_of[robot] * len(t.near)


@kernel
def own_level(t, robot, level):
    """Level of an area for the robot's type, 0 = safe."""
    return np.int64(level) if not t.mixed else t.own_level[t.type_of[robot], level]


@kernel
def own_turn(t, robot, step):
    """Turns that the robot has had by the end of this step, without that of t = 0."""
    return np.int64(step) if not t.paced else np.int64(step) // t.pace[robot]


@kernel
def on_turn(t, step, word, bits):
    """Bits of the robots of a word that are in `bits` and have a turn in this step."""
    return bits if not t.paced else bits & turns_in(t, step, word)


@rare_kernel
def turns_in(t, step, word):
    """Bits of the robots of a word that have a turn in this step."""
    found = np.uint64(0)
    for number in range(len(t.ticks)):
        # One test per speed, not per robot: robots of a speed are a set of bits.
        if step % t.ticks[number] == 0:
            found |= t.clock[number, word]
    return found


@kernel
def moves_until(t, helper, owner, moves):
    """Moves that the helper makes while the owner makes `moves`."""
    return moves if not t.paced else moves * t.pace[owner] // t.pace[helper]


# Radio range (SPEC section 22): `Tables.place`, `bases` and `reach` are empty where it has no limit.


@kernel
def hears(t, s, robot):
    """Whether the robot reaches a base by radio, through other robots alive; only then it can be given an area."""
    return not t.radio or _is_in_chain(t, s, robot)


@kernel
def drives_back(t, s, robot):
    """Whether a waiting robot out of radio range moves towards base, since there are unassigned areas; sets `next`."""
    return t.radio and _has_way_back(t, s, robot)


@rare_kernel
def _has_way_back(t, s, robot):
    me = s.robots[robot]
    if s.marks.open == 0 or s.robots[robot].until == 0 or not holds(s.waiting, robot) or _is_in_chain(t, s, robot):
        return False
    me.next = t.onward[t.home_of[robot], me.cell]
    s.marks.changes += 1  # its visits on the way make offers worse
    return me.next != me.cell


@kernel
def came_back(t, s, robot):
    """Whether the robot has just moved as `drives_back` says."""
    return t.radio and holds(s.waiting, robot)


@rare_kernel
def _is_in_chain(t, s, robot):
    s.heard[:] = np.uint64(0)
    # Breadth-first: robots in contact are added until no more are found.
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
    """Whether a base, or a robot that is in contact, is within radio range."""
    row, col = t.place[s.robots[one].cell, 0], t.place[s.robots[one].cell, 1]
    for base in range(len(t.bases)):
        if (row - t.bases[base, 0]) ** 2 + (col - t.bases[base, 1]) ** 2 <= t.reach[0]:
            return True
    for other in range(len(s.robots)):
        cell = s.robots[other].cell
        if holds(s.heard, other) and (row - t.place[cell, 0]) ** 2 + (col - t.place[cell, 1]) ** 2 <= t.reach[0]:
            return True
    return False
