"""The area that an attentive robot would take next, in kernels: the unassigned ones as it sees them.

Part of `planner.simulator.replanning`, which see. Targets are the cheapest *unvisited* cells.
"""

from __future__ import annotations

import numpy as np

from .areas import any_to_share, costs_from, has_area, is_within, make_lowest, may_be_shared
from .codes import NONE
from .jit import kernel, rare_kernel, search
from .offers import Offer, is_dangerous, price
from .paths import one_cell, row_from, seek, set_out
from .policy import is_before, is_danger, offer_of, refuses
from .range_budget import affords, moves_home
from .robot_types import hears, moves_until, own, own_level
from .state import (
    AREA_BITS,
    FAR,
    IDLE,
    ONE,
    RETURNING,
    TO_DO,
    VISITED,
    WORD,
    holds,
    lowest_bit,
)


@kernel
def cheapest_unvisited(costs, s, area):
    """(cell, cost): the area's unvisited cell of least cost in `costs` `[A]`, lowest index first; NONE if none is."""
    return cheapest_to_do(costs, s.home, s.order, np.int64(s.areas[area].begin), np.int64(s.areas[area].end))


@search
def cheapest_to_do(costs, home, order, begin, end):
    """`cheapest_unvisited`, of arrays."""
    best, best_cost = np.int64(NONE), np.int64(FAR)
    for place in range(begin, end):
        cell = np.int64(order[place])
        if home[cell] & VISITED == 0:
            cost = np.int64(costs[cell])
            if cost >= 0 and (cost < best_cost or (cost == best_cost and cell < best)):
                best, best_cost = cell, cost
    return best, best_cost


@kernel
def bound_of(t, s, robot, here, area):
    """(cell, cost) from the tables: no unvisited cell of the area costs less from `here`, NONE if none can be reached.

    The cell is the area's target if it is an unvisited one of the area. Without tables nothing is known.
    """
    if t.searches:
        return np.int64(len(s.order)), np.int64(0)
    root, row = np.int64(s.areas[area].root), own(t, robot, here)
    return np.int64(t.area_entry[row, root]), np.int64(t.area_cost[row, root])


@kernel
def is_target(s, cell, area):
    """Whether the cell that `bound_of` the area told is its target."""
    return np.int64(s.home[cell]) | TO_DO == area << AREA_BITS | TO_DO


@kernel
def see(t, s, costs, robot, here, area):
    """(cell, cost) of the area's target from `here`, where `costs` `[A]` are from; cell NONE if there is none."""
    cell, cost = bound_of(t, s, robot, here, area)
    if cost < 0:
        return np.int64(NONE), np.int64(FAR)
    return (cell, cost) if is_target(s, cell, area) else cheapest_unvisited(costs, s, area)


@kernel
def is_too_far_from_home(t, p, s, w, robot, here, target, offer, refusing):
    """Whether a robot that comes home leaves an area alone: it cannot afford it, or refuses it for the way home."""
    if not t.returns:
        return False
    if not affords(t, s, w, robot, target):
        return True
    if not refusing:
        return False
    way = t.home_cost[t.home_of[robot]]
    cost, shown = offer.cost + max(way[target] - way[here], 0), offer.frontier
    left, entry, more = offer.unvisited, offer.entry, offer.surcharge
    return refuses(p, Offer(offer.level, cost, left, entry, offer.value, offer.beyond, shown, more))


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
    # Fractions compared crosswise, in integers: no rounding decides who goes first.
    mine, least = p.scale * price(first), p.entry[level] * first.value
    for side in range(4):
        home = np.int64(s.home[t.near[here, side]])
        if mine == least and home & VISITED == 0 and home >> AREA_BITS != best and holds(s.open, home >> AREA_BITS):
            return False
    return mine <= least


@kernel
def least_open(p, s):
    """The least level of an unassigned area, L if there is none."""
    if s.marks.open == 0:
        return np.int64(len(p.entry))
    bits = np.uint64(0)
    for word in range((s.marks.areas + WORD - 1) // WORD):
        bits |= s.lowest[word]
    if bits == 0:
        make_lowest(s)
    return np.int64(s.marks.lowest)


@kernel
def look_at(t, p, s, w, costs, robot, here, area, closely, best, target, first, refusing):
    """(area, target, offer) of the first of the `best` so far and an unassigned area; and whether the area may go
    before it, but for a look at its cells: `closely`, they have it.
    """
    cell, cost = bound_of(t, s, robot, here, area)
    offer = offer_of(t, p, s, robot, area, cost)
    # The table's cost is a lower bound: if even that comes later, no cell has to be looked at.
    if cost < 0 or (p.by_price and not goes_first(p, offer, area, first, best, refusing)):
        return best, target, first, False
    if not is_target(s, cell, area):
        if not closely:
            return best, target, first, True
        cell, cost = cheapest_unvisited(costs, s, area)
        offer = offer_of(t, p, s, robot, area, cost)
    before = cell != NONE and goes_first(p, offer, area, first, best, refusing)
    if before and not is_too_far_from_home(t, p, s, w, robot, here, cell, offer, refusing):
        return area, cell, offer, False
    return best, target, first, False


@kernel
def first_among(t, p, s, w, costs, robot, here, further, closely, best, target, first, refusing):
    """(area, target, offer) of the first among the `best` so far and the areas of the least level, or the `further`
    ones; and whether there are some that may go before it, but for a look at their cells: `closely`, they have it.
    """
    unseen = False
    for word in range((s.marks.areas + WORD - 1) // WORD):
        bits = s.open[word] & ~s.lowest[word] if further else s.lowest[word]
        while bits != 0:
            area = np.int64(word * WORD + lowest_bit(bits))
            bits &= bits - ONE
            best, target, first, more = look_at(
                t, p, s, w, costs, robot, here, area, closely, best, target, first, refusing
            )
            unseen |= more
    return best, target, first, unseen


@kernel
def is_last(t, p, here, area, best, first):
    """Whether the `best` so far, whose offer is `first`, goes before this area of t = 0 and all that rank after it."""
    size, entry = np.int64(t.begin[area + 1] - t.begin[area]), p.entry[t.level[area]]
    # The price at its best: nothing visited, and every further cell one step away.
    least = max(np.int64(t.area_cost[here, area]), entry) + (size - 1) * entry
    return best != NONE and least * first.value > price(first) * t.counted[area]


@kernel
def next_ranked(t, s, here, place):
    """The first place of `Tables.foremost`, from this one on, of an unassigned area or of none; its length: no place.

    A loop of its own, which most places do not leave: what `first_ranked` carries along is not in its way.
    """
    while place < t.foremost.shape[1]:
        area = np.int64(t.foremost[here, place])
        if area == len(t.level) or holds(s.open, area):
            break
        place += 1
    return place


@kernel
def first_ranked(t, p, s, w, costs, robot, here, best, target, first, refusing):
    """(area, target, offer) of the first among the `best` so far and the unassigned areas, and whether that is all.

    An area costs no less per cell, or by value than all its cells would at its best one's, than it did when nothing of
    it was visited, nor does a part of it: those of t = 0 are looked at in that order, from a table, until all others
    come later. It may end before.
    """
    given, ranked = len(t.level), t.foremost.shape[1]
    all_seen, place = ranked == given, next_ranked(t, s, here, 0)
    while place < ranked:
        area = np.int64(t.foremost[here, place])
        if area == given or is_last(t, p, here, area, best, first):
            all_seen = True
            break
        best, target, first, _ = look_at(t, p, s, w, costs, robot, here, area, True, best, target, first, refusing)
        place = next_ranked(t, s, here, place + 1)
    for word in range(given // WORD, (s.marks.areas + WORD - 1) // WORD):
        bits = s.open[word]
        if word == given // WORD:
            bits &= ~np.uint64(0) << np.uint64(given % WORD)
        while bits != 0:
            area = np.int64(word * WORD + lowest_bit(bits))
            bits &= bits - ONE
            best, target, first, _ = look_at(t, p, s, w, costs, robot, here, area, True, best, target, first, refusing)
    return best, target, first, all_seen


@rare_kernel
def first_area(t, p, s, w, robot, its_own, refusing):
    """(area, target, cost) of the first unassigned area that the robot can reach, area NONE if there is none.

    `its_own`: an area that is among them, or NONE. `refusing`: areas that cost more than a robot is worth are not.
    """
    best, target, first = np.int64(NONE), np.int64(NONE), offer_of(t, p, s, robot, 0, FAR)
    if (s.marks.open == 0 and its_own == NONE) or not hears(t, s, robot):
        return best, target, first.cost
    here = np.int64(s.robots[robot].cell)
    costs = costs_from(t, s, w, robot)
    if its_own != NONE:  # its target stays the same on the way there, until it is visited, or costs are others
        cell = np.int64(s.robots[robot].target)
        cost = np.int64(costs[cell])
        if s.home[cell] & VISITED or t.learns or t.phased:  # a robot of a mission may be displaced on its way
            cell, cost = see(t, s, costs, robot, here, its_own)
        offer = offer_of(t, p, s, robot, its_own, cost)
        before = goes_first(p, offer, its_own, first, best, refusing)
        if before and not is_too_far_from_home(t, p, s, w, robot, here, cell, offer, refusing):
            best, target, first = its_own, cell, offer
    home = np.int64(s.home[here])
    # A start that nobody has visited yet: its area alone may cost less than entering one.
    if home & VISITED == 0 and holds(s.open, home >> AREA_BITS):
        best, target, first, _ = look_at(
            t, p, s, w, costs, robot, here, home >> AREA_BITS, True, best, target, first, refusing
        )
    if len(t.foremost) > 0:
        best, target, first, all_seen = first_ranked(t, p, s, w, costs, robot, here, best, target, first, refusing)
        if all_seen:
            return best, target, first.cost
    level = least_open(p, s)
    mixed = t.mixed and s.marks.open > 0  # levels of areas are in the order of nobody's own
    for further in range(2):
        # First by bounds from the tables alone; cells are looked at only of what may still go before.
        for closely in range(2):
            if is_below(t, p, s, here, first, best, np.int64(0) if mixed else level + further):
                return best, target, first.cost
            best, target, first, unseen = first_among(
                t, p, s, w, costs, robot, here, further, closely, best, target, first, refusing
            )
            if not unseen:
                break
    return best, target, first.cost


@rare_kernel
def first_of_idle(t, p, s, w, robot):
    """The same of a robot that waits, kept until an unassigned area comes, goes, or loses a cell to do."""
    kept, here = w.kept[robot], np.int64(s.robots[robot].cell)
    if not hears(t, s, robot):
        return np.int64(NONE), np.int64(NONE), np.int64(FAR)
    # CHANGES counts whatever could alter the answer, so an equal count means the same answer.
    if kept[0] != s.marks.changes or kept[1] != here or t.returns:  # what it can afford changes by itself
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
        kept[0], kept[1], kept[2], kept[3], kept[4] = s.marks.changes, here, area, target, cost
    return kept[2], kept[3], kept[4]


# What an attentive robot may take next, in kernels: sharing, and the limits on the team.
#
# Part of `planner.simulator.replanning`, which see.


@rare_kernel
def first_to_share(t, p, s, w, helper):
    """(owner, cost) of the best area to share, owner NONE if there is none.

    Who is held gets none but a safe area that it reaches without danger, where a step costs 1.
    """
    best, best_level, best_cost, best_area = np.int64(NONE), FAR, np.int64(FAR), FAR
    if not any_to_share(t, s, helper) or not hears(t, s, helper):
        return best, best_cost
    costs = costs_from(t, s, w, helper)
    here, held = np.int64(s.robots[helper].cell), s.robots[helper].held != 0
    for owner in range(len(s.robots)):
        if not may_be_shared(t, s, owner, helper):
            continue
        area = np.int64(s.robots[owner].area)
        level, most = own_level(t, helper, s.areas[area].level), np.int64(s.areas[area].left)
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
    searched = t.searches
    if searched:
        here = np.int64(s.robots[robot].cell)
        if w.row_of[here] != NONE:
            row_from(t, s, w, here)
        else:
            seek(t, s, w, here, one_cell(target), np.int64(NONE))
    set_out(t, s, w, robot, target, searched)


@kernel
def is_at_risk(t, p, s, robot):
    """Whether the robot has a dangerous area, or a dangerous cell on the rest of its way."""
    me = s.robots[robot]
    cell = np.int64(me.next)
    if me.doing == RETURNING:
        found = is_danger(t, p, s, robot, cell)
        while not found and moves_home(t, robot, cell) > 0:
            cell = np.int64(t.onward[t.home_of[robot], cell])
            found = is_danger(t, p, s, robot, cell)
        return found
    if not has_area(s.robots, robot):
        return False
    found = own_level(t, robot, s.areas[me.area].level) > 0 or is_danger(t, p, s, robot, cell)
    if me.ahead > 0:
        for place in range(me.ahead):
            found = found or is_danger(t, p, s, robot, s.legs[robot, place])
        return found
    # With tables the rest of the way is not written down: it is walked.
    while not found and cell != me.target:
        cell = np.int64(t.hop_to[own(t, robot, me.target), cell])
        found = p.danger[own(t, robot, cell)]
    return found


@rare_kernel
def is_full(t, p, s, robot):
    """Whether as many other robots are at risk as may be."""
    at_risk, most = 0, p.most[s.marks.alive]
    for other in range(len(s.robots)):
        if other != robot and is_at_risk(t, p, s, other):
            at_risk += 1
            if at_risk >= most:
                return True
    return False


@rare_kernel
def has_to_wait(t, p, s, w, robot, area, cost):
    """Whether the robot is held from an area that it would be allocated (`risk_cap`)."""
    mine = offer_of(t, p, s, robot, area, cost)
    if len(p.most) == 0 or not is_dangerous(mine, p.cells):
        return False
    if is_full(t, p, s, robot):
        return True
    for other in range(len(s.robots)):
        # One that waits, or will without danger, and would take a better offer goes first (`risk_cap`).
        rests = s.robots[other].doing == IDLE or holds(s.waiting, other)
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
        able = (holds(s.movers, robot) and s.robots[robot].doing != RETURNING) or holds(s.waiting, robot)
        if able and first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))[0] != NONE:
            return True
    return False
