"""Ways to get there, for the compiled simulator: costs, nearest cells and legs, from all-pairs tables or by searches.

Part of `planner.kernels.rollouts`, which see. `cost_to` and the other tables are empty where distances are searched for
on demand; `entry` and `legs` are where nothing is. A search's answer is the tables', ties included (SPEC section 3).
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.nearest import any_of, searches, seek, to_do_of
from planner.kernels.own import own
from planner.kernels.rows import row_from, walk_back
from planner.kernels.state import (
    AHEAD,
    AREA,
    AREA_BITS,
    BEGIN,
    CELL,
    END,
    FAR,
    LEFT,
    LEVEL,
    NEXT,
    PATH,
    ROOT,
    TARGET,
    TO_DO,
    VISITED,
)
from planner.none import NONE


@kernel
def cheapest_cell(costs, s, area):
    """The area's cell of least cost in `costs` `[A]`, lowest index first; NONE if it cannot be reached.

    Its cells rise, and are reached from anywhere if one of them is.
    """
    begin, end = np.int64(s.areas[area, BEGIN]), np.int64(s.areas[area, END])
    best = np.int64(s.order[begin])
    least = costs[best]
    # An area is connected: if one cell cannot be reached none can.
    if least < 0:
        return np.int64(NONE)
    for place in range(begin + 1, end):
        cell = s.order[place]
        if costs[cell] < least:
            best, least = np.int64(cell), costs[cell]
    return best


@rare_kernel
def entry_of(t, s, w, robot, area):
    """The cheapest cell of an area that the robot can reach."""
    here = s.robots[robot, CELL]
    if not searches(t):
        row = own(t, robot, here)
        cell = np.int64(t.area_entry[row, s.areas[area, ROOT]])
        return cell if np.int64(s.home[cell]) >> AREA_BITS == area else cheapest_cell(t.cost_to[row], s, area)
    if w.row_of[here] != NONE:
        return cheapest_cell(w.rows[row_from(t, s, w, here)], s, area)
    return seek(t, s, w, here, any_of(area), np.int64(NONE))


@kernel
def set_out(t, s, w, robot, target, searched):
    """Begin a leg, along the tables or the last answer's path, which began where the robot is."""
    robots = s.robots
    here, ahead = robots[robot, CELL], 0
    robots[robot, TARGET] = robots[robot, NEXT] = target
    if here != target:
        if searched:
            ahead = walk_back(t, s, w, here, target, s.legs[robot]) - 1
            robots[robot, NEXT] = s.legs[robot, ahead]
        else:
            # By target: a whole leg stays in one row of the table.
            robots[robot, NEXT] = t.hop_to[own(t, robot, target), here]
    robots[robot, AHEAD], robots[robot, PATH] = ahead, 0


@kernel
def go_on(t, s, w, robot):
    """The robot is on its leg: what it enters next."""
    robots = s.robots
    ahead = robots[robot, AHEAD]
    if ahead == 0:
        robots[robot, NEXT] = t.hop_to[own(t, robot, robots[robot, TARGET]), robots[robot, CELL]]
    else:
        robots[robot, AHEAD] = ahead - 1
        path = robots[robot, PATH]
        robots[robot, NEXT] = s.legs[robot, ahead - 1] if path == 0 else w.paths[w.ends[path] - ahead]


@kernel
def list_to_do(s, robot):
    """The cells to do are the area's unvisited cells at this moment."""
    area, left = s.robots[robot, AREA], 0
    for place in range(s.areas[area, BEGIN], s.areas[area, END]):
        cell = s.order[place]
        if s.home[cell] & VISITED == 0:
            s.home[cell] |= TO_DO
            left += 1
    s.robots[robot, LEFT] = left


@kernel
def to_do_in(area):
    """`home >> 2` of a cell to do in the area, whether it is visited or not."""
    return np.int64(area) << 1 | 1


@kernel
def next_leg(t, s, w, how, robot):
    """The leg to the cheapest cell to do, lowest index first; an adjacent one, by its side, is always the cheapest."""
    robots = s.robots
    # Cells of an area cost the same to enter, so nothing beats a neighbour.
    cell = adjacent(t, s, robots[robot, CELL], to_do_in(robots[robot, AREA]))
    if cell != NONE:
        robots[robot, TARGET] = robots[robot, NEXT] = cell
    else:
        set_out_far(t, s, w, how, robot)


@kernel
def adjacent(t, s, here, wanted):
    """The neighbour of `here` that goes first of those that are as `to_do_in` says, NONE if none is."""
    for side in range(4):
        cell = np.int64(t.sweep[here, side])
        if np.int64(s.home[cell]) >> 2 == wanted:
            return cell
    return np.int64(NONE)


@rare_kernel
def set_out_far(t, s, w, how, robot):
    """The same where none is adjacent."""
    here, area = s.robots[robot, CELL], np.int64(s.robots[robot, AREA])
    if len(t.entry) == 0:
        set_out(t, s, w, robot, look_up_nearest(t, s, own(t, robot, here), area), False)
    else:
        set_out(t, s, w, robot, search_nearest(t, s, w, how, here, area), True)


@kernel
def look_up_nearest(t, s, row, area):
    """The cheapest cell of the area to do, from a row of the tables.

    In a safe area it is looked for among the cells ranked by cost; before a dangerous one come too many safe cells.
    """
    if s.areas[area, LEVEL] == 0:
        wanted = to_do_in(area)
        for place in range(t.ranked.shape[1]):
            cell = t.ranked[row, place]
            if np.int64(s.home[cell]) >> 2 == wanted:
                return np.int64(cell)
    best, least = NONE, FAR
    for place in range(s.areas[area, BEGIN], s.areas[area, END]):
        cell = s.order[place]
        if s.home[cell] & TO_DO and t.cost_to[row, cell] < least:
            best, least = np.int64(cell), np.int64(t.cost_to[row, cell])
    return best


@kernel
def search_nearest(t, s, w, how, here, area):
    """The same by a search, inside the area if legs stay there."""
    return seek(t, s, w, here, to_do_of(area), area if how.stay_inside else np.int64(NONE))
