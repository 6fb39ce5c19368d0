"""What an attentive robot would take next, in kernels: the areas as it sees them and the limits on the team.

Part of `planner.kernels.attentive`, which see. Targets are the cheapest *unvisited* cells.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.areas import any_to_share, costs_from, make_lowest, may_be_shared, steps_to
from planner.kernels.bits import ONE, holds, lowest_bit
from planner.kernels.follow import is_before, offer_of, refuses
from planner.kernels.paths import seek, set_out
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA,
    AREA_BITS,
    AREAS,
    BEGIN,
    CELL,
    CHANGES,
    DOING,
    END,
    FAR,
    FROM_HELPER,
    HELD,
    IDLE,
    LEFT_IN,
    LEVEL,
    LOWEST,
    NEXT,
    NONE,
    OPEN,
    ROOT,
    TARGET,
    TO_DO,
    VISITED,
    WORD,
)
from planner.kernels.trace import has_area
from planner.policies.limits import is_dangerous
from planner.policies.offer import price


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
def bound_of(t, s, here, area):
    """(cell, cost) from the tables: no unvisited cell of the area costs less from `here`, NONE if none can be reached.

    The cell is the area's target if it is an unvisited one of the area. Without tables nothing is known.
    """
    if len(t.cost_to) == 0:
        return np.int64(len(s.order)), np.int64(0)
    root = np.int64(s.areas[area, ROOT])
    return np.int64(t.area_entry[here, root]), np.int64(t.area_cost[here, root])


@kernel
def is_target(s, cell, area):
    """Whether the cell that `bound_of` the area told is its target."""
    return np.int64(s.home[cell]) | TO_DO == area << AREA_BITS | TO_DO


@kernel
def see(t, s, costs, here, area):
    """(cell, cost) of the area's target from `here`, where `costs` `[A]` are from; cell NONE if there is none."""
    cell, cost = bound_of(t, s, here, area)
    if cost < 0:
        return np.int64(NONE), np.int64(FAR)
    return (cell, cost) if is_target(s, cell, area) else cheapest_unvisited(costs, s, area)


@kernel
def goes_first(p, offer, area, first, best, refusing):
    """Whether an area goes before the `best` so far, whose offer is `first`, and is not refused."""
    if refusing and refuses(p, offer):
        return False
    return best == NONE or is_before(p, offer, first, area < best)


@kernel
def is_below(t, p, s, here, first, best, level):
    """Whether the `best` so far goes before all unassigned areas of this level and above for a robot `here`.

    None of them costs less per cell than entering one, nor by value, which is at most `scale` a cell; as little cost
    only those that are next to the robot. So nothing worthless goes before all others.
    """
    if level >= len(p.entry):
        return True
    if not p.by_price or best == NONE:
        return False
    mine, least = p.scale * price(first), p.entry[level] * first.value
    for side in range(4):
        home = np.int64(s.home[t.near[here, side]])
        if mine == least and home & VISITED == 0 and home >> AREA_BITS != best and holds(s.open, home >> AREA_BITS):
            return False
    return mine <= least


@kernel
def least_open(p, s):
    """The least level of an unassigned area, L if there is none."""
    if s.marks[OPEN] == 0:
        return np.int64(len(p.entry))
    bits = np.uint64(0)
    for word in range((s.marks[AREAS] + WORD - 1) // WORD):
        bits |= s.lowest[word]
    if bits == 0:
        make_lowest(s)
    return np.int64(s.marks[LOWEST])


@kernel
def first_among(t, p, s, costs, here, further, closely, best, target, first, refusing):
    """(area, target, offer) of the first among the `best` so far and the areas of the least level, or the `further`
    ones; and whether there are some that may go before it, but for a look at their cells: `closely`, they have it.
    """
    unseen = False
    for word in range((s.marks[AREAS] + WORD - 1) // WORD):
        bits = s.open[word] & ~s.lowest[word] if further else s.lowest[word]
        while bits != 0:
            area = np.int64(word * WORD + lowest_bit(bits))
            bits &= bits - ONE
            cell, cost = bound_of(t, s, here, area)
            offer = offer_of(p, s, area, cost)
            if cost < 0 or (p.by_price and not goes_first(p, offer, area, first, best, refusing)):
                continue
            if not is_target(s, cell, area):
                unseen = True
                if not closely:
                    continue
                cell, cost = cheapest_unvisited(costs, s, area)
                offer = offer_of(p, s, area, cost)
            if cell != NONE and goes_first(p, offer, area, first, best, refusing):
                best, target, first = area, cell, offer
    return best, target, first, unseen


@rare_kernel
def first_area(t, p, s, w, robot, own, refusing):
    """(area, target, cost) of the first unassigned area that the robot can reach, area NONE if there is none.

    `own`: an area that is among them, or NONE. `refusing`: areas that cost more than a robot is worth are not.
    """
    best, target, first = np.int64(NONE), np.int64(NONE), offer_of(p, s, 0, FAR)
    if s.marks[OPEN] == 0 and own == NONE:
        return best, target, first.cost
    here, level = np.int64(s.robots[robot, CELL]), least_open(p, s)
    costs = costs_from(t, s, w, robot, FROM_HELPER)
    if own != NONE:  # its target stays the same on the way there, until it is visited
        cell = np.int64(s.robots[robot, TARGET])
        cost = np.int64(costs[cell])
        if s.home[cell] & VISITED:
            cell, cost = see(t, s, costs, here, own)
        offer = offer_of(p, s, own, cost)
        if goes_first(p, offer, own, first, best, refusing):
            best, target, first = own, cell, offer
    for further in range(2):
        for closely in range(2):
            if is_below(t, p, s, here, first, best, level + further):
                return best, target, first.cost
            best, target, first, unseen = first_among(
                t, p, s, costs, here, further, closely, best, target, first, refusing
            )
            if not unseen:
                break
    return best, target, first.cost


@rare_kernel
def first_of_idle(t, p, s, w, robot):
    """The same of a robot that waits, kept until an unassigned area comes, goes, or loses a cell to do."""
    kept, here = w.kept[robot], np.int64(s.robots[robot, CELL])
    if kept[0] != s.marks[CHANGES] or kept[1] != here:
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
        kept[0], kept[1], kept[2], kept[3], kept[4] = s.marks[CHANGES], here, area, target, cost
    return kept[2], kept[3], kept[4]


@rare_kernel
def first_to_share(t, p, s, w, helper):
    """(owner, cost) of the best area to share, owner NONE if there is none; a search's costs stay in `w.costs`.

    Who is held gets none but a safe area that it reaches without danger, where a step costs 1.
    """
    best, best_level, best_cost, best_area = np.int64(NONE), FAR, np.int64(FAR), FAR
    if not any_to_share(s, helper):
        return best, best_cost
    costs = costs_from(t, s, w, helper, FROM_HELPER)
    here, held = np.int64(s.robots[helper, CELL]), s.robots[helper, HELD] != 0
    for owner in range(len(s.robots)):
        if not may_be_shared(s, owner, helper):
            continue
        area = np.int64(s.robots[owner, AREA])
        level = np.int64(s.areas[area, LEVEL])
        if held and (level > 0 or bound_of(t, s, here, area)[1] > s.areas[area, LEFT_IN]):
            continue
        cell, cost = cheapest_unvisited(costs, s, area)
        if cell == NONE or refuses(p, offer_of(p, s, area, cost)):
            continue
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
            theirs, _, their_cost = first_of_idle(t, p, s, w, other)
            if theirs != NONE and is_before(p, offer_of(p, s, theirs, their_cost), mine, False):
                return True
    return False


@rare_kernel
def could_go_on(t, p, s, w):
    """Whether a robot that can move can reach an unassigned area, refused or not."""
    for robot in range(len(s.robots)):
        able = holds(s.movers, robot) or holds(s.waiting, robot)
        if able and first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))[0] != NONE:
            return True
    return False
