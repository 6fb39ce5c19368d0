"""What an attentive robot would take next, in kernels: the areas as it sees them and the limits on the team.

Part of `planner.kernels.attentive`, which see. Targets are the cheapest *unvisited* cells.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.areas import any_to_share, costs_from, may_be_shared, steps_to
from planner.kernels.bits import ONE, holds, lowest_bit
from planner.kernels.follow import is_before, offer_of, refuses
from planner.kernels.paths import seek, set_out
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA,
    AREAS,
    BEGIN,
    CELL,
    DOING,
    END,
    FAR,
    FROM_HELPER,
    IDLE,
    LEFT_IN,
    LEVEL,
    NEXT,
    NONE,
    OPEN,
    TARGET,
    VISITED,
    WORD,
)
from planner.kernels.trace import has_area
from planner.policies.limits import is_dangerous


@kernel
def cheapest_unvisited(costs, s, area):
    """(cell, cost): the area's unvisited cell of least cost in `costs` `[A]`, lowest index first; NONE if none is."""
    best, best_cost = NONE, FAR
    for place in range(s.areas[area, BEGIN], s.areas[area, END]):
        cell = np.int64(s.order[place])
        if s.home[cell] & VISITED == 0:
            cost = np.int64(costs[cell])
            if cost >= 0 and (cost < best_cost or (cost == best_cost and cell < best)):
                best, best_cost = cell, cost
    return best, best_cost


@kernel
def see(t, s, w, here, area):
    """The same from a cell whose costs are in the tables, or in `w.costs[FROM_HELPER]`."""
    if len(t.cost_to) == 0:
        return cheapest_unvisited(w.costs[FROM_HELPER], s, area)
    if area < t.area_entry.shape[1]:
        cell = np.int64(t.area_entry[here, area])
        if s.home[cell] & VISITED == 0:
            cost = np.int64(t.area_cost[here, area])
            return (cell, cost) if cost >= 0 else (NONE, FAR)
    return cheapest_unvisited(t.cost_to[here], s, area)


@rare_kernel
def first_area(t, p, s, w, robot, own, refusing):
    """(area, target, cost) of the first unassigned area that the robot can reach, area NONE if there is none.

    `own`: an area that is among them, or NONE. `refusing`: areas that cost more than a robot is worth are not.
    """
    best, target, least = np.int64(NONE), np.int64(NONE), np.int64(FAR)
    if s.marks[OPEN] == 0 and own == NONE:
        return best, target, least
    here = np.int64(s.robots[robot, CELL])
    if len(t.cost_to) == 0:
        costs_from(t, s, w, robot, FROM_HELPER)
    for word in range((s.marks[AREAS] + WORD - 1) // WORD):
        bits = s.open[word]
        if own >= 0 and own // WORD == word:
            bits |= ONE << np.uint64(own % WORD)
        while bits != 0:
            area = np.int64(word * WORD + lowest_bit(bits))
            bits &= bits - ONE
            cell, cost = see(t, s, w, here, area)
            if cell == NONE:
                continue
            offer = offer_of(p, s, area, cost)
            if refusing and refuses(p, offer):
                continue
            if best == NONE or is_before(p, offer, offer_of(p, s, best, least)):
                best, target, least = area, cell, cost
    return best, target, least


@rare_kernel
def first_to_share(t, p, s, w, helper):
    """(owner, cost) of the best area to share, owner NONE if there is none; a search's costs stay in `w.costs`."""
    best, best_level, best_cost, best_area = np.int64(NONE), FAR, np.int64(FAR), FAR
    if not any_to_share(s, helper):
        return best, best_cost
    costs = costs_from(t, s, w, helper, FROM_HELPER)
    for owner in range(len(s.robots)):
        if not may_be_shared(s, owner, helper):
            continue
        area = np.int64(s.robots[owner, AREA])
        cell, cost = cheapest_unvisited(costs, s, area)
        if cell == NONE or refuses(p, offer_of(p, s, area, cost)):
            continue
        level = np.int64(s.areas[area, LEVEL])
        better = (level, cost, area) < (best_level, best_cost, best_area)
        if better and steps_to(t, s, w, helper, cell) <= s.areas[area, LEFT_IN]:
            best, best_level, best_cost, best_area = np.int64(owner), level, cost, area
    return best, best_cost


@kernel
def head_for(t, s, w, robot, target):
    """Begin the way to a cell."""
    searched = len(t.cost_to) == 0
    if searched:
        w.rank[target] = 0
        seek(t, w, s.robots[robot, CELL], w.everywhere)
        w.rank[target] = NONE
    set_out(t, s, w, robot, target, searched)


@kernel
def is_at_risk(t, p, s, robot):
    """Whether the robot has a dangerous area, or a dangerous cell on the rest of its way."""
    me = s.robots[robot]
    if not has_area(s.robots, robot):
        return False
    cell = np.int64(me[NEXT])
    found = s.areas[me[AREA], LEVEL] > 0 or p.danger[cell]
    if me[AHEAD] > 0:
        for place in range(me[AHEAD]):
            found = found or p.danger[s.legs[robot, place]]
        return found
    while not found and cell != me[TARGET]:
        cell = np.int64(t.hop_to[me[TARGET], cell])
        found = p.danger[cell]
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
    mine = offer_of(p, s, area, cost)
    if len(p.most) == 0 or not is_dangerous(mine, p.cells):
        return False
    if is_full(t, p, s, robot):
        return True
    for other in range(len(s.robots)):
        if other != robot and (s.robots[other, DOING] == IDLE or holds(s.waiting, other)):
            theirs, _, their_cost = first_area(t, p, s, w, other, NONE, True)
            if theirs != NONE and is_before(p, offer_of(p, s, theirs, their_cost), mine):
                return True
    return False


@rare_kernel
def could_go_on(t, p, s, w):
    """Whether a robot that can move can reach an unassigned area, refused or not."""
    for robot in range(len(s.robots)):
        if (holds(s.movers, robot) or holds(s.waiting, robot)) and first_area(t, p, s, w, robot, NONE, False)[
            0
        ] != NONE:
            return True
    return False
