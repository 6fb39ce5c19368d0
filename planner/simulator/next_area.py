"""The next area of a robot that re-evaluates: unassigned areas as offers. Targets are the cheapest unvisited cells."""

import numpy as np

from .areas import any_to_share, costs_from, has_area, is_within, make_lowest, may_be_shared
from .codes import IDLE, NONE, RETURNING
from .jit import kernel, rare_kernel, search
from .offers import Offer, is_dangerous, price
from .paths import one_cell, row_from, seek, set_out
from .policy import is_before, is_danger, offer_of, refuses
from .range_budget import is_within_range, moves_home
from .robot_types import hears, moves_until, own, own_level
from .state import AREA_BITS, FAR, ONE, TO_DO, VISITED, WORD, holds, lowest_bit


@kernel
def cheapest_unvisited(costs, s, area):
    """(cell, cost): the area's unvisited cell of least cost in `costs` `[A]`, lowest index first; NONE if none."""
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
    """(cell, cost): a lower bound on the cost from `here` to any unvisited cell of the area, NONE if unreachable.

    The cell is the area's target if it is an unvisited cell of the area (`is_target`). Without tables the bound is 0.
    """
    if t.searches:
        return np.int64(len(s.order)), np.int64(0)
    root, row = np.int64(s.areas[area].root), own(t, robot, here)
    return np.int64(t.area_entry[row, root]), np.int64(t.area_cost[row, root])


@kernel
def is_target(s, cell, area):
    """Whether the cell of `bound_of` is the area's target, so that its bound is exact."""
    return np.int64(s.home[cell]) | TO_DO == area << AREA_BITS | TO_DO


@kernel
def see(t, s, costs, robot, here, area):
    """(cell, cost) of the area's target from `here`, whose costs are `costs` `[A]`; cell NONE if there is none."""
    cell, cost = bound_of(t, s, robot, here, area)
    if cost < 0:
        return np.int64(NONE), np.int64(FAR)
    return (cell, cost) if is_target(s, cell, area) else cheapest_unvisited(costs, s, area)


@kernel
def is_too_far_from_home(t, p, s, w, robot, here, target, offer, refusing):
    """Whether a robot that returns to base skips an area: out of range, or refused with the way to base included."""
    if not t.returns:
        return False
    if not is_within_range(t, s, w, robot, target):
        return True
    if not refusing:
        return False
    way = t.home_cost[t.home_of[robot]]
    cost, shown = offer.cost + max(way[target] - way[here], 0), offer.frontier
    left, entry, more = offer.unvisited, offer.entry, offer.surcharge
    return refuses(p, Offer(offer.level, cost, left, entry, offer.value, offer.beyond, shown, more))


@kernel
def goes_first(p, offer, area, first, best, refusing):
    """Whether an area is accepted and comes before the `best` so far, whose offer is `first`."""
    if refusing and refuses(p, offer):
        return False
    return best == NONE or is_before(p, offer, first, area < best)


@kernel
def is_below(t, p, s, here, first, best, level):
    """Whether the `best` so far comes before all unassigned areas of this level and above, for a robot `here`.

    None of them costs less per cell than the entry cost of one cell, nor less per value, which is at most `scale` a
    cell. Only areas next to the robot can reach that bound. So an offer without value never comes before all others.
    """
    if level >= len(p.entry):
        return True
    if not p.by_price or best == NONE:
        return False
    # Fractions are compared crosswise, in integers: no rounding decides the order.
    mine, least = p.scale * price(first), p.entry[level] * first.value
    for side in range(4):
        home = np.int64(s.home[t.near[here, side]])
        if mine == least and home & VISITED == 0 and home >> AREA_BITS != best and holds(s.open, home >> AREA_BITS):
            return False
    return mine <= least


@kernel
def least_open(p, s):
    """The lowest level of an unassigned area, L if there is none."""
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
    """Compare an unassigned area with the best so far.

    Args:
        closely: whether its cells may be searched; else only the bound of the tables is used.
        best, target, first: the best area so far, its target and its offer.
        refusing: whether areas that are not worth the risk are excluded.

    Returns:
        (area, target, offer) of the better one, and whether only a search of its cells can decide.
    """
    cell, cost = bound_of(t, s, robot, here, area)
    offer = offer_of(t, p, s, robot, area, cost)
    # The table's cost is a lower bound: if even that comes later, no cell is searched.
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
    """Compare the areas of the lowest level, or the `further` ones, with the best so far.

    Returns:
        (area, target, offer) of the best, and whether only a search of cells can decide for some area (`look_at`).
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
    """Whether the `best` so far comes before this area of t = 0 and all that rank after it in `Tables.foremost`."""
    size, entry = np.int64(t.begin[area + 1] - t.begin[area]), p.entry[t.level[area]]
    # The lowest possible price: nothing visited, and every further cell one step away.
    least = max(np.int64(t.area_cost[here, area]), entry) + (size - 1) * entry
    return best != NONE and least * first.value > price(first) * t.counted[area]


@kernel
def next_ranked(t, s, here, place):
    """First position in `Tables.foremost`, from `place` on, of an unassigned area or of the end; its length if none.

    A separate loop, since most positions are skipped: the variables of `first_ranked` stay out of its registers.
    """
    while place < t.foremost.shape[1]:
        area = np.int64(t.foremost[here, place])
        if area == len(t.level) or holds(s.open, area):
            break
        place += 1
    return place


@kernel
def first_ranked(t, p, s, w, costs, robot, here, best, target, first, refusing):
    """(area, target, offer) of the best of the unassigned areas, and whether all of them were compared.

    An area never costs less per cell (or per value, if each cell had its best cell's value) than it did before any
    visit, nor does a part of it. So the areas of t = 0 are compared in the order of that bound until all others come
    later. The table may end before.
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

    Args:
        its_own: the robot's own area, compared with them, or NONE.
        refusing: whether areas that are not worth the risk are excluded.
    """
    best, target, first = np.int64(NONE), np.int64(NONE), offer_of(t, p, s, robot, 0, FAR)
    if (s.marks.open == 0 and its_own == NONE) or not hears(t, s, robot):
        return best, target, first.cost
    here = np.int64(s.robots[robot].cell)
    costs = costs_from(t, s, w, robot)
    if its_own != NONE:  # its target stays the same on the way, until it is visited or costs change
        cell = np.int64(s.robots[robot].target)
        cost = np.int64(costs[cell])
        if s.home[cell] & VISITED or t.learns or t.phased:  # a robot of a mission may be displaced on its way
            cell, cost = see(t, s, costs, robot, here, its_own)
        offer = offer_of(t, p, s, robot, its_own, cost)
        before = goes_first(p, offer, its_own, first, best, refusing)
        if before and not is_too_far_from_home(t, p, s, w, robot, here, cell, offer, refusing):
            best, target, first = its_own, cell, offer
    home = np.int64(s.home[here])
    # A start cell not visited yet: only its own area can cost less than the entry cost of one cell.
    if home & VISITED == 0 and holds(s.open, home >> AREA_BITS):
        best, target, first, _ = look_at(
            t, p, s, w, costs, robot, here, home >> AREA_BITS, True, best, target, first, refusing
        )
    if len(t.foremost) > 0:
        best, target, first, all_seen = first_ranked(t, p, s, w, costs, robot, here, best, target, first, refusing)
        if all_seen:
            return best, target, first.cost
    level = least_open(p, s)
    mixed = t.mixed and s.marks.open > 0  # robot types do not agree on the order of levels
    for further in range(2):
        # First only by the tables' bounds; cells are searched only for areas that may still come first.
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
    """`first_area` of a waiting robot, cached until an unassigned area comes, goes, or loses a cell to do."""
    kept, here = w.kept[robot], np.int64(s.robots[robot].cell)
    if not hears(t, s, robot):
        return np.int64(NONE), np.int64(NONE), np.int64(FAR)
    # `changes` counts every change that could alter the result, so an equal count means an equal result.
    # A robot that returns to base is excluded: the areas within its range change without an event.
    if kept[0] != s.marks.changes or kept[1] != here or t.returns:
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
        kept[0], kept[1], kept[2], kept[3], kept[4] = s.marks.changes, here, area, target, cost
    return kept[2], kept[3], kept[4]


# Sharing, and the limits on the team.


@rare_kernel
def first_to_share(t, p, s, w, helper):
    """(owner, cost) of the best area to share, owner NONE if there is none.

    A held robot may only share a safe area that it reaches without danger, where each step costs 1.
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
        # A cost of at most `most` proves a path of safe cells: a dangerous cell costs more than all safe ones.
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
    """Begin the path to a cell."""
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
    """Whether the robot has a dangerous area, or a dangerous cell on the rest of its path."""
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
    # With tables the rest of the path is not stored: it is followed.
    while not found and cell != me.target:
        cell = np.int64(t.hop_to[own(t, robot, me.target), cell])
        found = p.danger[own(t, robot, cell)]
    return found


@rare_kernel
def is_full(t, p, s, robot):
    """Whether as many other robots are at risk as the cap allows."""
    at_risk, most = 0, p.most[s.marks.alive]
    for other in range(len(s.robots)):
        if other != robot and is_at_risk(t, p, s, other):
            at_risk += 1
            if at_risk >= most:
                return True
    return False


@rare_kernel
def has_to_wait(t, p, s, w, robot, area, cost):
    """Whether the cap on robots at risk keeps the robot from an area that it would be allocated."""
    mine = offer_of(t, p, s, robot, area, cost)
    if len(p.most) == 0 or not is_dangerous(mine, p.cells):
        return False
    if is_full(t, p, s, robot):
        return True
    for other in range(len(s.robots)):
        # A robot that waits, or will wait without danger, and would accept a better offer has priority.
        rests = s.robots[other].doing == IDLE or holds(s.waiting, other)
        if p.preempts and has_area(s.robots, other):
            rests = not is_at_risk(t, p, s, other)
        if other != robot and rests:
            theirs, _, their_cost = first_of_idle(t, p, s, w, other)
            if theirs != NONE and is_before(p, offer_of(t, p, s, other, theirs, their_cost), mine, False):
                return True
    return False


@rare_kernel
def could_go_on(t, p, s, w):
    """Whether a robot that can move can reach an unassigned area, in a mission that refuses some."""
    for robot in range(len(s.robots) if p.limited else 0):
        able = (holds(s.moving, robot) and s.robots[robot].doing != RETURNING) or holds(s.waiting, robot)
        if able and first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))[0] != NONE:
            return True
    return False
