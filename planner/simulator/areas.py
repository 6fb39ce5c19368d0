"""The area registry of the compiled simulator: allocation, components, bisection, sharing, and the trace."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .codes import COVERING, NONE, STARTING, TRAVELING, EventKind
from .jit import kernel, rare_kernel, search, spliced
from .paths import cheapest_cell, cheapest_of, entry_of, open_at, row_from, row_if_asked, seek, set_out, walk_back
from .range_budget import is_within_range
from .robot_types import hears, moves_until, own, own_level, own_turn
from .state import AREA_BITS, FAR, ONE, TO_DO, VISITED, WORD, drop, holds, lowest_bit, put

# The trace of the compiled simulator: `planner.tally` in plain arrays, empty where nothing is traced.

COMPLETED_EVENT, HIT_EVENT, REALLOCATED_EVENT = map(int, (EventKind.COMPLETED, EventKind.HIT, EventKind.REALLOCATED))
ALLOCATED_EVENT, SHARED_EVENT = int(EventKind.ALLOCATED), int(EventKind.SHARED)
LOOKED_AGAIN_EVENT, REFUSED_EVENT = int(EventKind.LOOKED_AGAIN), int(EventKind.REFUSED)
RANGE_ENDED_EVENT, SURPRISED_EVENT = int(EventKind.RANGE_ENDED), int(EventKind.SURPRISED)
TURNED_HOME_EVENT, HOME_EVENT, CHARGED_EVENT = map(int, (EventKind.TURNED_HOME, EventKind.HOME, EventKind.CHARGED))
FRAME_CELL, FRAME_DOING, FRAME_AREA, FRAME_ROWS = 0, 1, 2, 3


class Log(NamedTuple):
    """Arrays of a trace.

    Attributes:
        events: int32 `[E + 1, 5]`. Row 0 holds the number of events (those beyond `E` are counted, not kept), the
            others are the rows of `Trace.events`.
        frames: int32 `[T, FRAME_ROWS, K]`: cell, doing and area of each robot at the end of each step; later steps are
            not kept.
        legs: int32 `[L, K]`, a ring by `step % L`: twice the area that each robot has as it enters its next cell, plus
            1 if it covers the area; NONE where it enters no cell or has no area.
        noted: whether legs are kept; None: no code for them.
    """

    events: NDArray[np.int32]
    frames: NDArray[np.int32]
    legs: NDArray[np.int32]
    noted: bool | None = None


def make_log(steps: int, events: int, robots: int, legs: bool = False) -> Log:
    """An empty trace.

    Args:
        steps: T, 0 for none.
        events: E.
        robots: K.
        legs: whether legs are kept.
    """
    rows = events + 1 if steps else 0
    frames = np.zeros((steps, FRAME_ROWS, robots), dtype=np.int32)
    noted = np.full((steps if legs else 0, robots), NONE, dtype=np.int32)
    return Log(np.zeros((rows, 5), dtype=np.int32), frames, noted, True if legs else None)


@rare_kernel
def note_leg(t, s, log, robot):
    """Record the area of the robot, which is about to enter its next cell, and whether it covers it."""
    me, step = s.robots[robot], s.marks.step
    if t.notes:
        t.notes.move(s, robot)
    if has_area(s.robots, robot):
        covers = me.doing == COVERING or me.next == me.target
        if step == 0:
            covers = np.int64(s.home[me.cell]) >> AREA_BITS == me.area
        if step > 0 or covers:
            log.legs[step % len(log.legs), robot] = 2 * me.area + covers


@kernel
def note(log, s, robot, kind, area, other):
    """Record an event."""
    if len(log.events) > 0:
        place = log.events[0, 0] + 1
        log.events[0, 0] = place
        if place < len(log.events):
            log.events[place, 0], log.events[place, 1], log.events[place, 2] = s.marks.step, robot, kind
            log.events[place, 3], log.events[place, 4] = area, other


@kernel
def has_area(robots, robot):
    """Whether the robot has an area."""
    doing = robots[robot].doing
    return doing in (TRAVELING, COVERING, STARTING)


@rare_kernel
def write_frame(log, s, step):
    """Record each robot's cell, activity and area at the end of a step."""
    for robot in range(len(s.robots)):
        log.frames[step, FRAME_CELL, robot] = s.robots[robot].cell
        log.frames[step, FRAME_DOING, robot] = s.robots[robot].doing
        log.frames[step, FRAME_AREA, robot] = s.robots[robot].area if has_area(s.robots, robot) else NONE


@kernel
def room_of(s):
    """Areas that there is room for; in online missions also the index that stands for "in no area"."""
    return len(s.areas) - (len(s.mind) > 0)


@kernel
def close(s, area):
    """Make an area not unassigned."""
    if holds(s.open, area):
        drop(s.open, area)
        drop(s.lowest, area)
        s.marks.open -= 1
        s.marks.changes += 1


@kernel
def compare_again(s):
    """Make every robot compare its area with others again: an area has come, or costs have changed."""
    s.marks.arrivals += 1


@kernel
def reopen(s, area):
    """Make an area unassigned."""
    level = np.int64(s.areas[area].level)
    put(s.open, area)
    s.marks.open += 1
    s.marks.changes += 1
    compare_again(s)
    # `lowest` is updated only where that is cheap; else it is rebuilt when it is needed.
    if level < s.marks.lowest:
        make_lowest(s)
    elif level == s.marks.lowest:
        put(s.lowest, area)


@rare_kernel
def make_lowest(s):
    """Find the unassigned areas of the lowest level."""
    s.marks.lowest = FAR
    for word in range((s.marks.areas + WORD - 1) // WORD):
        s.lowest[word], bits = 0, s.open[word]
        while bits != 0:
            area = word * WORD + lowest_bit(bits)
            bits &= bits - ONE
            level = np.int64(s.areas[area].level)
            if level < s.marks.lowest:
                s.marks.lowest = level
                for before in range(word + 1):
                    s.lowest[before] = 0
            if level == s.marks.lowest:
                put(s.lowest, area)


@kernel
def give(s, robot, area):
    """Assign an area to a robot, which travels to it."""
    close(s, area)
    s.robots[robot].area = area
    if s.robots[robot].doing != STARTING:
        s.robots[robot].doing = TRAVELING


@rare_kernel
def find_affordable(t, s, w, robot):
    """`find_next_area` with the robot's range or its type's own levels."""
    here = np.int64(s.robots[robot].cell)
    if not t.searches:
        row = own(t, robot, here)
        return affordable(t, s, w, robot, t.cost_to[row], t.area_cost[row], t.area_entry[row])
    row = row_from(t, s, w, here)
    return affordable(t, s, w, robot, w.rows[row], w.row_costs[row], w.row_entries[row])


@kernel
def affordable(t, s, w, robot, costs, area_costs, area_entries):
    """`look_up_among` over all unassigned areas, with the robot's range and its type's own levels."""
    best, best_level, best_cost, best_cell = np.int64(NONE), FAR, FAR, np.int64(NONE)
    for area in range(s.marks.areas):
        if not holds(s.open, area):
            continue
        level, root = own_level(t, robot, s.areas[area].level), np.int64(s.areas[area].root)
        if t.learns:  # areas gain cells in map updates: the tables of the areas of t = 0 do not hold
            cell = cheapest_cell(costs, s, area)
            cost = np.int64(costs[cell]) if cell != NONE else np.int64(NONE)
        else:
            cost, cell = np.int64(area_costs[root]), np.int64(area_entries[root])
        if level > best_level or (level == best_level and cost >= best_cost):
            continue
        if cost >= 0 and np.int64(s.home[cell]) >> AREA_BITS != area:
            cell = cheapest_cell(costs, s, area)
            cost = np.int64(costs[cell])
        better = cost >= 0 and (level < best_level or cost < best_cost)
        # The range is tested last: it follows the whole path.
        if better and (not t.returns or is_within_range(t, s, w, robot, cell)):
            best, best_level, best_cost, best_cell = np.int64(area), level, cost, cell
    return best, best_cell


@kernel
def find_next_area(t, s, w, robot):
    """(area, cell) of the next area by (level, cost, id), NONE if none is reachable (Algorithm 2)."""
    if not hears(t, s, robot):
        return np.int64(NONE), np.int64(NONE)
    if t.returns or t.mixed:
        return find_affordable(t, s, w, robot)
    here = np.int64(s.robots[robot].cell)
    if not t.searches:
        return look_up_next_area(s, t.cost_to[here], t.area_cost[here], t.area_entry[here])
    if t.learns:  # areas gain cells in map updates: the tables of the areas of t = 0 do not hold
        return search_next_area(t, s, w, here)
    row = row_if_asked(t, s, w, here)
    if row != NONE:
        return look_up_next_area(s, w.rows[row], w.row_costs[row], w.row_entries[row])
    return search_next_area(t, s, w, here)


@kernel
def look_up_next_area(s, costs, area_costs, area_entries):
    """(area, cell) of the next area, from tables.

    An area's part that holds its cheapest cell costs what the area did, other parts no less: a lower bound.

    Args:
        costs: `[A]`, cost to every cell.
        area_costs: `[M]`, cost to every area of t = 0.
        area_entries: `[M]`, the cell of each with that cost.
    """
    area, cell = look_up_among(s, s.lowest, costs, area_costs, area_entries)
    return (area, cell) if area != NONE else look_up_further(s, costs, area_costs, area_entries)


@rare_kernel
def look_up_further(s, costs, area_costs, area_entries):
    """The same if no area of the lowest level is left, or none can be reached."""
    make_lowest(s)
    return look_up_among(s, s.open, costs, area_costs, area_entries)


@kernel
def look_up_among(s, areas, costs, area_costs, area_entries):
    """The same among these areas."""
    return look_up(areas, np.int64(s.marks.areas), s.areas, s.home, s.order, costs, area_costs, area_entries)


@search
def look_up(members, count, areas, home, order, costs, area_costs, area_entries):
    """`look_up_among` of arrays; `members` are bits of `count` areas."""
    best, best_level, best_cost, best_cell = np.int64(NONE), np.int64(FAR), np.int64(FAR), np.int64(NONE)
    for word in range((count + WORD - 1) // WORD):
        bits = members[word]
        while bits != 0:
            area = np.int64(word * WORD + lowest_bit(bits))
            bits &= bits - ONE
            level = np.int64(areas[area].level)
            root = np.int64(areas[area].root)
            cost, cell = np.int64(area_costs[root]), np.int64(area_entries[root])
            if level > best_level or (level == best_level and cost > best_cost):
                continue
            # The nearest cell belongs to another part of the split area: search this part's cells.
            if cost >= 0 and np.int64(home[cell]) >> AREA_BITS != area:
                cell = cheapest_of(costs, order, np.int64(areas[area].begin), np.int64(areas[area].end))
                cost = np.int64(costs[cell])
            if cost >= 0 and (level < best_level or cost < best_cost):
                best, best_level, best_cost, best_cell = area, level, cost, cell
    return best, best_cell


@rare_kernel
def search_next_area(t, s, w, here):
    """(area, cell) of the next area by one search for each level of unassigned areas, in increasing order."""
    done = np.int64(NONE)
    while True:
        level = FAR
        for area in range(s.marks.areas):
            if holds(s.open, area) and done < s.areas[area].level < level:
                level = np.int64(s.areas[area].level)
        if level == FAR:
            return NONE, NONE
        cell = seek(t, s, w, here, open_at(level), np.int64(NONE))
        if cell != NONE:
            return np.int64(s.home[cell] >> AREA_BITS), np.int64(cell)
        done = level


@search
def flood(near, home, stack, first, of, mark):
    """Move the component of the area's unvisited cells that holds `first` to the area `mark`; returns its size.

    Args:
        near: `[A, 4]`, neighbours.
        home: `[A + 1]`, areas and flags, changed in place.
        stack: `[A]`, scratch.
        first: a cell of the component.
        of: the area.
        mark: the new area.
    """
    wanted, mark = np.int64(of) << AREA_BITS | TO_DO, np.int64(mark) << AREA_BITS
    # Moved when first met, so each cell is put on the stack once.
    home[first], stack[0] = mark, first
    top, size = 1, 1
    while top > 0:
        top -= 1
        here = stack[top]
        for side in range(4):
            cell = near[here, side]
            if np.int64(home[cell]) | TO_DO == wanted:
                home[cell] = mark
                stack[top] = cell
                top += 1
                size += 1
    return size


@kernel
def list_unvisited(s, w, area):
    """Write the area's unvisited cells, increasing, into `w.listed`; returns how many."""
    return list_of(s.home, s.order, np.int64(s.areas[area].begin), np.int64(s.areas[area].end), w.listed)


@search
def list_of(home, order, begin, end, listed):
    """`list_unvisited` of arrays."""
    count = 0
    for place in range(begin, end):
        cell = order[place]
        if home[cell] & VISITED == 0:
            listed[count] = cell
            count += 1
    return count


@kernel
def in_layers(near, home, seen, stamps, stack, source, area, count):
    """Breadth-first search over the area's unvisited cells from `source`, at least `count` of them, into `stack`.

    Returns:
        Begin and end of the last layer in `stack`. `seen` holds the new stamp of each cell met.
    """
    stamps[0] += 1
    stamp, wanted = stamps[0], np.int64(area) << AREA_BITS
    stack[0], seen[source] = source, stamp
    layer, tail = 0, 1
    while tail < count:
        stop = tail
        for place in range(layer, stop):
            here = stack[place]
            for side in range(4):
                cell = near[here, side]
                if home[cell] == wanted and seen[cell] != stamp:
                    seen[cell] = stamp
                    stack[tail] = cell
                    tail += 1
        layer = stop
    return layer, tail


@search
def bisect(near, home, seen, stamps, stack, listed, area, count):
    """Split an area in two connected halves by growing a wavefront (SPEC section 5).

    The half without the lowest cell becomes the area of the next id.

    Args:
        listed: the area's unvisited cells, one component, increasing.
        count: how many.
    """
    lowest, goal = listed[0], (count + 1) // 2
    layer, tail = in_layers(near, home, seen, stamps, stack, lowest, area, count)
    # The lowest index of the last layer: the stack holds a layer in order of discovery.
    far_end = stack[layer]
    for place in range(layer, tail):
        far_end = min(far_end, stack[place])
    layer, tail = in_layers(near, home, seen, stamps, stack, far_end, area, goal)
    reached, grown = stamps[0], stamps[0] + 1
    stamps[0] = grown
    for place in range(layer):
        seen[stack[place]] = grown
    left = goal - layer
    for index in range(count):  # the last layer in index order, as many cells as needed
        cell = listed[index]
        if seen[cell] == reached and left > 0:
            seen[cell] = grown
            left -= 1
    stays = largest_rest(near, home, seen, stamps, stack, listed, area, count, grown)
    with_lowest = seen[lowest] == stays
    for index in range(count):
        cell = listed[index]
        # Parts are ordered by lowest cell: the part that holds it keeps the first id.
        if (seen[cell] == stays) != with_lowest:
            home[cell] = np.int64(area) + 1 << AREA_BITS


@kernel
def largest_rest(near, home, seen, stamps, stack, listed, area, count, grown):
    """Stamp the components of the cells that have not `grown`; the stamp of the largest, on a tie of the lowest."""
    stays, stays_size, wanted = NONE, 0, np.int64(area) << AREA_BITS
    for index in range(count):
        first = listed[index]
        if seen[first] >= grown:
            continue
        stamps[0] += 1
        stamp, top, size = stamps[0], 1, 1
        seen[first], stack[0] = stamp, first
        while top > 0:
            top -= 1
            here = stack[top]
            for side in range(4):
                cell = near[here, side]
                if home[cell] == wanted and seen[cell] < grown:
                    seen[cell] = stamp
                    stack[top] = cell
                    top += 1
                    size += 1
        if size > stays_size:
            stays, stays_size = stamp, size
    return stays


@rare_kernel
def replace(t, s, w, area, split):
    """Complete an area; its unvisited cells become new areas, one for each component.

    Args:
        split: whether a single component is bisected.

    Returns:
        (first new id, number of new areas); (NONE, 0) if the area registry is full.
    """
    areas, marks = s.areas, s.marks
    first_new, parts, begin = marks.areas, 0, np.int64(areas[area].begin)
    count = list_unvisited(s, w, area)
    for index in range(count):
        cell = w.listed[index]
        if np.int64(s.home[cell]) >> AREA_BITS == area:
            # Room for this part and for the second half of a bisection.
            if first_new + parts + 2 > room_of(s):
                return np.int64(NONE), 0
            areas[first_new + parts].left = flood(t.near, s.home, w.stack, cell, area, first_new + parts)
            parts += 1
    if split:
        if parts > 1:
            marks.divided += 1
        else:
            marks.bisected += 1
            bisect(t.near, s.home, w.seen, w.stamp, w.stack, w.listed, first_new, count)
            parts = 2
            areas[first_new].left = areas[first_new + 1].left = 0
            for index in range(count):
                areas[np.int64(s.home[w.listed[index]]) >> AREA_BITS].left += 1
    for new in range(first_new, first_new + parts):
        areas[new].begin = areas[new].end = begin
        begin += areas[new].left
        areas[new].level, areas[new].root = areas[area].level, areas[area].root
        if new % WORD == 0:
            s.open[new // WORD] = s.lowest[new // WORD] = 0
    if parts == 1:
        begin = np.int64(areas[first_new].begin)
        areas[first_new].end = begin + count
        for index in range(count):
            s.order[begin + index] = w.listed[index]
    else:
        for index in range(count):
            cell = w.listed[index]
            new = np.int64(s.home[cell]) >> AREA_BITS
            # `listed` increases, so each part's segment does: ties stay as in SPEC section 3.
            s.order[areas[new].end] = cell
            areas[new].end += 1
    marks.areas += parts
    if t.notes:
        t.notes.areas(s)
    for new in range(first_new, first_new + parts):
        reopen(s, new)
    marks.unfinished += parts - (1 if count > 0 else 0)
    close(s, area)
    areas[area].left = 0
    return first_new, parts


@spliced
def costs_from(t, s, w, robot):
    """Cost from the robot's cell to every cell, NONE if unreachable; without tables valid until the next but one."""
    here = np.int64(s.robots[robot].cell)
    return t.cost_to[own(t, robot, here)] if not t.searches else w.rows[row_from(t, s, w, here)]


@kernel
def is_within(t, s, w, helper, target, most):
    """Whether `target` is at most `most` moves from the helper; without tables `costs_from` it must come before."""
    here = s.robots[helper].cell
    if t.searches:
        return walk_back(t, s, w, here, target, s.legs[helper]) <= most
    for _ in range(most):
        if here == target:
            break
        here = t.hop_to[own(t, helper, target), here]
    return here == target


@kernel
def may_be_shared(t, s, owner, helper):
    """Whether the helper may share the owner's area: it has two cells to do, and both robots are in radio range."""
    return (
        owner != helper and has_area(s.robots, owner) and s.areas[s.robots[owner].area].left >= 2 and hears(t, s, owner)
    )


@kernel
def any_to_share(t, s, helper):
    """Whether there is an area to share, at any distance."""
    found = False
    for owner in range(len(s.robots)):
        found = found or may_be_shared(t, s, owner, helper)
    return found


@kernel
def owner_to_share_with(t, s, w, helper, costs):
    """The robot whose area is best to share by (level, cost, id), NONE if none; `costs` `[A]` of the helper."""
    best, best_level, best_cost, best_area = NONE, FAR, FAR, FAR
    for owner in range(len(s.robots)):
        if not may_be_shared(t, s, owner, helper):
            continue
        area = np.int64(s.robots[owner].area)
        level = own_level(t, helper, s.areas[area].level)
        if level > best_level:
            continue
        cell = cheapest_cell(costs, s, area)
        if cell == NONE:
            continue
        cost, left = np.int64(costs[cell]), moves_until(t, helper, owner, np.int64(s.areas[area].left))
        better = (level, cost, area) < (best_level, best_cost, best_area)
        # Moves are counted along the path only if the cost does not decide.
        near = better and (cost <= left or is_within(t, s, w, helper, cell, left))  # a step costs 1 at least
        if near and (not t.returns or is_within_range(t, s, w, helper, cell)):
            best, best_level, best_cost, best_area = owner, level, cost, area
    return best


@search
def choose_parts(order, areas, owner_costs, helper_costs, first, parts):
    """The owner's and the helper's part, by least total cost; ties: the owner's lower part, then the helper's."""
    # The helper takes the part nearest to it, or the second nearest if the owner takes that one.
    nearest, second, nearest_cost, second_cost = np.int64(NONE), np.int64(NONE), np.int64(FAR), np.int64(FAR)
    for part in range(first, first + parts):
        cell = cheapest_of(helper_costs, order, np.int64(areas[part].begin), np.int64(areas[part].end))
        cost = np.int64(helper_costs[cell])
        if cost < nearest_cost:
            second, second_cost, nearest, nearest_cost = nearest, nearest_cost, np.int64(part), cost
        elif cost < second_cost:
            second, second_cost = np.int64(part), cost
    least, of_owner, of_helper = np.int64(FAR), np.int64(NONE), np.int64(NONE)
    for part in range(first, first + parts):
        cell = cheapest_of(owner_costs, order, np.int64(areas[part].begin), np.int64(areas[part].end))
        total = owner_costs[cell] + (nearest_cost if part != nearest else second_cost)
        if total < least:
            least, of_owner, of_helper = np.int64(total), np.int64(part), nearest if part != nearest else second
    return of_owner, of_helper


@rare_kernel
def share(t, s, w, log, helper):
    """`Find Area To Share`: GAINS if the helper got a part, RESTS if there is nothing to share, NO_ROOM."""
    if not hears(t, s, helper) or (t.searches and not any_to_share(t, s, helper)):  # nothing to search for
        return 0
    # Two rows at once: there is always room for two, and the row of the last answer is not replaced (`row_from`).
    helper_costs = costs_from(t, s, w, helper)
    owner = owner_to_share_with(t, s, w, helper, helper_costs)
    return 0 if owner == NONE else share_between(t, s, w, log, helper, owner, helper_costs)


@kernel
def share_between(t, s, w, log, helper, owner, helper_costs):
    """Split the owner's area between both; `helper_costs`: `costs_from` the helper. GAINS, or NO_ROOM."""
    owner_costs = costs_from(t, s, w, owner)
    area = np.int64(s.robots[owner].area)
    first, parts = replace(t, s, w, area, np.bool_(True))
    if first == NONE:
        return NONE
    of_owner, of_helper = choose_parts(s.order, s.areas, owner_costs, helper_costs, np.int64(first), np.int64(parts))
    note(log, s, helper, SHARED_EVENT, area, parts)
    for robot, part in ((owner, of_owner), (helper, of_helper)):
        give(s, robot, part)
        target = entry_of(t, s, w, robot, part)
        note(log, s, robot, ALLOCATED_EVENT, part, target)
        if s.robots[robot].doing != STARTING:
            set_out(t, s, w, robot, target, t.searches)
    return 1


@kernel
def waits(t, s, robot):
    """Make a robot that moved wait for an area."""
    if holds(s.moving, robot):
        drop(s.moving, robot)
        put(s.waiting, robot)
        # A waiting robot uses no turns, so `until` becomes the number of moves left.
        s.robots[robot].until -= own_turn(t, robot, s.marks.step)


@kernel
def moves_on(t, s, robot):
    """Make a robot that waited move from the next step on: it has an area."""
    if holds(s.waiting, robot):
        drop(s.waiting, robot)
        put(s.moving, robot)
        s.robots[robot].until += own_turn(t, robot, s.marks.step)
