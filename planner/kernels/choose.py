"""What an attentive robot may take next, in kernels: sharing, and the limits on the team.

Part of `planner.kernels.attentive`, which see.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.afford import moves_home
from planner.kernels.areas import any_to_share, costs_from, is_within, may_be_shared
from planner.kernels.bits import holds
from planner.kernels.first import (
    bound_of,
    cheapest_unvisited,
    first_area,
    first_of_idle,
    is_too_far_from_home,
)
from planner.kernels.follow import is_before, is_danger, offer_of, refuses
from planner.kernels.nearest import one_cell, searches, seek
from planner.kernels.own import moves_until, own, own_level
from planner.kernels.paths import set_out
from planner.kernels.radio import hears
from planner.kernels.rows import row_from
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA,
    CELL,
    DOING,
    FAR,
    HELD,
    IDLE,
    LEFT_IN,
    LEVEL,
    NEXT,
    RETURNING,
    TARGET,
)
from planner.kernels.trace import has_area
from planner.none import NONE
from planner.policies.limits import is_dangerous


@rare_kernel
def first_to_share(t, p, s, w, helper):
    """(owner, cost) of the best area to share, owner NONE if there is none.

    Who is held gets none but a safe area that it reaches without danger, where a step costs 1.
    """
    best, best_level, best_cost, best_area = np.int64(NONE), FAR, np.int64(FAR), FAR
    if not any_to_share(t, s, helper) or not hears(t, s, helper):
        return best, best_cost
    costs = costs_from(t, s, w, helper)
    here, held = np.int64(s.robots[helper, CELL]), s.robots[helper, HELD] != 0
    for owner in range(len(s.robots)):
        if not may_be_shared(t, s, owner, helper):
            continue
        area = np.int64(s.robots[owner, AREA])
        level, most = own_level(t, helper, s.areas[area, LEVEL]), np.int64(s.areas[area, LEFT_IN])
        most = moves_until(t, helper, owner, most)
        if held and (level > 0 or bound_of(t, s, helper, here, area)[1] > most):
            continue
        cell, cost = cheapest_unvisited(costs, s, area)
        offer = offer_of(t, p, s, helper, area, cost)
        if cell == NONE or refuses(p, offer):
            continue
        better = (level, cost, area) < (best_level, best_cost, best_area)
        near = better and is_within(t, s, w, helper, cell, most)
        if near and not is_too_far_from_home(t, p, s, w, helper, here, cell, offer, np.bool_(True)):
            best, best_level, best_cost, best_area = np.int64(owner), level, cost, area
    return best, best_cost


@kernel
def head_for(t, s, w, robot, target):
    """Begin the way to a cell."""
    searched = searches(t)
    if searched:
        here = np.int64(s.robots[robot, CELL])
        if w.row_of[here] != NONE:
            row_from(t, s, w, here)
        else:
            seek(t, s, w, here, one_cell(target), np.int64(NONE))
    set_out(t, s, w, robot, target, searched)


@kernel
def is_at_risk(t, p, s, robot):
    """Whether the robot has a dangerous area, or a dangerous cell on the rest of its way."""
    me = s.robots[robot]
    cell = np.int64(me[NEXT])
    if me[DOING] == RETURNING:
        found = is_danger(t, p, s, robot, cell)
        while not found and moves_home(t, robot, cell) > 0:
            cell = np.int64(t.onward[t.home_of[robot], cell])
            found = is_danger(t, p, s, robot, cell)
        return found
    if not has_area(s.robots, robot):
        return False
    found = own_level(t, robot, s.areas[me[AREA], LEVEL]) > 0 or is_danger(t, p, s, robot, cell)
    if me[AHEAD] > 0:
        for place in range(me[AHEAD]):
            found = found or is_danger(t, p, s, robot, s.legs[robot, place])
        return found
    # With tables the rest of the way is not written down: it is walked.
    while not found and cell != me[TARGET]:
        cell = np.int64(t.hop_to[own(t, robot, me[TARGET]), cell])
        found = p.danger[own(t, robot, cell)]
    return found


@rare_kernel
def is_full(t, p, s, robot):
    """Whether as many other robots are at risk as may be."""
    at_risk, most = 0, p.most[s.marks[ALIVE]]
    for other in range(len(s.robots)):
        if other != robot and is_at_risk(t, p, s, other):
            at_risk += 1
            if at_risk >= most:
                return True
    return False


@rare_kernel
def has_to_wait(t, p, s, w, robot, area, cost):
    """Whether the robot is held from an area that it would be allocated (`reserve`)."""
    mine = offer_of(t, p, s, robot, area, cost)
    if len(p.most) == 0 or not is_dangerous(mine, p.cells):
        return False
    if is_full(t, p, s, robot):
        return True
    for other in range(len(s.robots)):
        # One that waits, or will without danger, and would take a better offer goes first (`reserve`).
        rests = s.robots[other, DOING] == IDLE or holds(s.waiting, other)
        if p.breaks_off and has_area(s.robots, other):
            rests = not is_at_risk(t, p, s, other)
        if other != robot and rests:
            theirs, _, their_cost = first_of_idle(t, p, s, w, other)
            if theirs != NONE and is_before(p, offer_of(t, p, s, other, theirs, their_cost), mine, False):
                return True
    return False


@rare_kernel
def could_go_on(t, p, s, w):
    """Whether a robot that can move can reach an unassigned area, where some are refused."""
    for robot in range(len(s.robots) if p.limited else 0):
        able = (holds(s.movers, robot) and s.robots[robot, DOING] != RETURNING) or holds(s.waiting, robot)
        if able and first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))[0] != NONE:
            return True
    return False
