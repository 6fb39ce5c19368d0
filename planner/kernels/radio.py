"""Who hears whom (SPEC section 22): `planner.mrac.radio` for one robot of a set.

Part of `planner.kernels.rollouts`, which see. `Tables.place`, `bases` and `reach` are empty where all do.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.bits import holds, put
from planner.kernels.state import CELL, CHANGES, DEAD, DOING, NEXT, OPEN, UNTIL


@kernel
def hears(t, s, robot):
    """Whether the robot is in touch with a base, by way of others that are alive: only then it takes over."""
    return len(t.reach) == 0 or _is_in_chain(t, s, robot)


@kernel
def drives_back(t, s, robot):
    """Whether a robot that waits makes a move back, to hear of areas that nobody has: into its next cell, then."""
    return len(t.reach) > 0 and _has_way_back(t, s, robot)


@rare_kernel
def _has_way_back(t, s, robot):
    me = s.robots[robot]
    if s.marks[OPEN] == 0 or s.team[robot, UNTIL] == 0 or not holds(s.waiting, robot) or _is_in_chain(t, s, robot):
        return False
    me[NEXT] = t.onward[t.home_of[robot], me[CELL]]
    s.marks[CHANGES] += 1  # what it visits on its way makes offers worse
    return me[NEXT] != me[CELL]


@kernel
def came_back(t, s, robot):
    """Whether the robot has just made such a move."""
    return len(t.reach) > 0 and holds(s.waiting, robot)


@rare_kernel
def _is_in_chain(t, s, robot):
    s.heard[:] = np.uint64(0)
    found = True
    while found and not holds(s.heard, robot):
        found = False
        for one in range(len(s.robots)):
            if not holds(s.heard, one) and s.robots[one, DOING] != DEAD and _is_near(t, s, one):
                put(s.heard, one)
                found = True
    return holds(s.heard, robot)


@kernel
def _is_near(t, s, one):
    """Whether a base, or a robot that is heard, is near enough."""
    row, col = t.place[s.robots[one, CELL], 0], t.place[s.robots[one, CELL], 1]
    for base in range(len(t.bases)):
        if (row - t.bases[base, 0]) ** 2 + (col - t.bases[base, 1]) ** 2 <= t.reach[0]:
            return True
    for other in range(len(s.robots)):
        cell = s.robots[other, CELL]
        if holds(s.heard, other) and (row - t.place[cell, 0]) ** 2 + (col - t.place[cell, 1]) ** 2 <= t.reach[0]:
            return True
    return False
