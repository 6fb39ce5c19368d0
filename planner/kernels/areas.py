"""The book of areas of the compiled simulator: who gets what, components, bisection, sharing.

Part of `planner.kernels.rollouts`, which see; the state's rows are those of `planner.kernels.state`.
"""

from __future__ import annotations

import numpy as np

from planner.jit import threaded
from planner.kernels.paths import cheapest_cell, costs_from, rank_area, seek, steps_to, travel
from planner.kernels.state import (
    AHEAD,
    AREA,
    AREA_OF,
    AREAS,
    ASSIGNED,
    BEGIN,
    BISECTED,
    CELL,
    COMPLETED,
    DIVIDED,
    DOING,
    END,
    EVERYWHERE,
    FAR,
    FROM_HELPER,
    FROM_OWNER,
    LABEL,
    LEFT_IN,
    LEVEL,
    NONE,
    OPEN,
    ORDER,
    OWNER,
    STACK,
    STATUS,
    STEP,
    TARGET,
    TO_DO,
    TRAVELING,
    UNASSIGNED,
    VISITED,
)
from planner.kernels.trace import ALLOCATED_EVENT, SHARED_EVENT, note


@threaded
def close(areas, totals, area, status):
    """Take an area out of the pool, or change what it is."""
    if areas[STATUS, area] == UNASSIGNED:
        totals[OPEN] -= 1
    areas[STATUS, area] = status


@threaded
def give(areas, robots, totals, robot, area):
    close(areas, totals, area, ASSIGNED)
    areas[OWNER, area] = robot
    robots[AREA, robot], robots[DOING, robot], robots[AHEAD, robot] = area, TRAVELING, 0


@threaded
def look_up_next_area(cost_to, area_cost, area_entry, cells, areas, totals, here):
    """(area, cell) of the next area by (level, cost, id), NONE if none is reachable; from tables.

    An area of t = 0 keeps its cells until it is replaced, so its cost is in a table of its own. Policies replace this
    function and `search_next_area`.
    """
    best, best_level, best_cost, best_cell = NONE, 0, FAR, NONE
    left, tabled = totals[OPEN], area_cost.shape[1]
    for area in range(totals[AREAS]):
        if left == 0:
            break
        if areas[STATUS, area] != UNASSIGNED:
            continue
        left -= 1
        level = areas[LEVEL, area]
        if best != NONE and level > best_level:
            continue
        if area < tabled:
            cost, cell = np.int64(area_cost[here, area]), np.int64(area_entry[here, area])
        else:
            cell = np.int64(cheapest_cell(cost_to, here, cells, areas, area))
            cost = np.int64(cost_to[here, cell]) if cell != NONE else NONE
        if cost < 0:
            continue
        if best == NONE or level < best_level or cost < best_cost:
            best, best_level, best_cost, best_cell = area, level, cost, cell
    return best, best_cell


@threaded
def search_next_area(near, entry, work, cells, areas, totals, here):
    """The same without tables: a search for each level of the unassigned areas, ranked by id, until one finds."""
    done = np.int64(NONE)
    while True:
        level = FAR
        for area in range(totals[AREAS]):
            if areas[STATUS, area] == UNASSIGNED and done < areas[LEVEL, area] < level:
                level = np.int64(areas[LEVEL, area])
        if level == FAR:
            return NONE, NONE
        for area in range(totals[AREAS]):
            if areas[STATUS, area] == UNASSIGNED and areas[LEVEL, area] == level:
                rank_area(work, cells, areas, area, area)
        cell = seek(near, entry, work, totals, here, EVERYWHERE)
        for area in range(totals[AREAS]):
            if areas[STATUS, area] == UNASSIGNED and areas[LEVEL, area] == level:
                rank_area(work, cells, areas, area, NONE)
        if cell != NONE:
            return np.int64(cells[AREA_OF, cell]), np.int64(cell)
        done = level


@threaded
def _flood(near, cells, area, first, mark):
    """Label the component of the area's unvisited cells (of label NONE) that holds `first`; returns its size."""
    cells[LABEL, first] = mark
    cells[STACK, 0] = first
    top, size = 1, 1
    while top > 0:
        top -= 1
        here = cells[STACK, top]
        for side in range(4):
            cell = near[here, side]
            if cell == NONE or cells[AREA_OF, cell] != area or cells[VISITED, cell] or cells[LABEL, cell] != NONE:
                continue
            cells[LABEL, cell] = mark
            cells[STACK, top] = cell
            top += 1
            size += 1
    return size


@threaded
def _parts(near, cells, areas, area):
    """Put the area's visited cells first, then the components of its unvisited cells by lowest cell, in rising order.

    Returns (first place of the unvisited cells, number of components); `labels` holds each cell's component.
    """
    begin, end = areas[BEGIN, area], areas[END, area]
    kept, scratch = begin, 0
    for place in range(begin, end):
        cell = cells[ORDER, place]
        if cells[VISITED, cell]:
            cells[ORDER, kept] = cell
            kept += 1
        else:
            cells[STACK, scratch] = cell
            scratch += 1
    for index in range(scratch):
        cells[LABEL, cells[STACK, index]] = NONE
        cells[ORDER, kept + index] = cells[STACK, index]
    parts = 0
    for place in range(kept, end):
        first = cells[ORDER, place]
        if cells[LABEL, first] != NONE:
            continue
        _flood(near, cells, area, first, parts)
        parts += 1
    return kept, parts


@threaded
def _layer_order(near, cells, area, source, count, mark):
    """Breadth-first order from `source` over the area's unvisited cells, layers in index order, into `stack`.

    `labels` becomes `mark` where reached. Returns where the last layer begins.
    """
    cells[STACK, 0] = source
    cells[LABEL, source] = mark
    layer, tail = 0, 1
    while tail < count:
        stop = tail
        for place in range(layer, stop):
            here = cells[STACK, place]
            for side in range(4):
                cell = near[here, side]
                if cell == NONE or cells[AREA_OF, cell] != area or cells[VISITED, cell] or cells[LABEL, cell] == mark:
                    continue
                cells[LABEL, cell] = mark
                cells[STACK, tail] = cell
                tail += 1
        cells[STACK, stop:tail].sort()
        layer = stop
    return layer


@threaded
def _bisect(near, cells, areas, area, kept):
    """Split the one component of unvisited cells in two (SPEC section 5): labels 0 (with the lowest cell) and 1."""
    end = areas[END, area]
    count = end - kept
    lowest = cells[ORDER, kept]
    last = _layer_order(near, cells, area, lowest, count, 2)
    far_end = cells[STACK, last]
    _layer_order(near, cells, area, far_end, count, 3)
    goal = (count + 1) // 2
    for index in range(count):
        cells[LABEL, cells[STACK, index]] = 4 if index < goal else NONE
    stays, stays_size = NONE, 0
    parts = 5
    for place in range(kept, end):
        first = cells[ORDER, place]
        if cells[LABEL, first] != NONE:
            continue
        size = _flood(near, cells, area, first, parts)
        if size > stays_size:
            stays, stays_size = parts, size
        parts += 1
    lowest_stays = cells[LABEL, lowest] == stays
    for place in range(kept, end):
        cell = cells[ORDER, place]
        cells[LABEL, cell] = 0 if (cells[LABEL, cell] == stays) == lowest_stays else 1


@threaded
def replace(near, cells, areas, totals, area, split):
    """Complete an area; what is unvisited becomes new areas. Returns (first new id, how many); NONE: no room."""
    for place in range(areas[BEGIN, area], areas[END, area]):
        cells[TO_DO, cells[ORDER, place]] = 0
    kept, parts = _parts(near, cells, areas, area)
    if split:
        totals[BISECTED if parts == 1 else DIVIDED] += 1
        if parts == 1:
            _bisect(near, cells, areas, area, kept)
            parts = 2
    first_new = totals[AREAS]
    if first_new + parts > areas.shape[1]:
        return NONE, 0
    end = areas[END, area]
    count = end - kept
    for index in range(count):
        cells[STACK, index] = cells[ORDER, kept + index]
    place = kept
    for part in range(parts):
        new = first_new + part
        areas[BEGIN, new] = place
        for index in range(count):
            cell = cells[STACK, index]
            if cells[LABEL, cell] == part:
                cells[ORDER, place] = cell
                cells[AREA_OF, cell] = new
                place += 1
        areas[END, new] = place
        areas[LEVEL, new], areas[OWNER, new], areas[STATUS, new] = areas[LEVEL, area], NONE, UNASSIGNED
        areas[LEFT_IN, new] = place - areas[BEGIN, new]
    totals[AREAS] += parts
    totals[OPEN] += parts
    close(areas, totals, area, COMPLETED)
    areas[END, area] = kept
    areas[LEFT_IN, area] = 0
    return first_new, parts


@threaded
def _may_be_shared(areas, area, helper):
    return areas[STATUS, area] == ASSIGNED and areas[LEFT_IN, area] >= 2 and areas[OWNER, area] != helper


@threaded
def _area_to_share(table, row, hop_to, near, entry, work, legs, cells, areas, robots, totals, helper):
    """The best area of another live robot to share by (level, cost, id), NONE if none; costs in `table[row]`."""
    here = np.int64(robots[CELL, helper])
    best, best_level, best_cost = NONE, 0, FAR
    for area in range(totals[AREAS]):
        if not _may_be_shared(areas, area, helper):
            continue
        cell = np.int64(cheapest_cell(table, row, cells, areas, area))
        if cell == NONE:
            continue
        if steps_to(hop_to, near, entry, work, legs, totals, helper, here, cell) > areas[LEFT_IN, area]:
            continue
        level, cost = areas[LEVEL, area], np.int64(table[row, cell])
        if best == NONE or level < best_level or (level == best_level and cost < best_cost):
            best, best_level, best_cost = area, level, cost
    return best


@threaded
def _search_area_to_share(hop_to, near, entry, work, legs, costs, cells, areas, robots, totals, helper):
    """The same without tables; the costs of the helper and of the area's owner are in `costs` then."""
    found = False
    for area in range(totals[AREAS]):
        found = found or _may_be_shared(areas, area, helper)
    if not found:
        return NONE
    costs_from(near, entry, work, costs, totals, np.int64(robots[CELL, helper]), FROM_HELPER)
    area = _area_to_share(costs, FROM_HELPER, hop_to, near, entry, work, legs, cells, areas, robots, totals, helper)
    if area != NONE:
        costs_from(near, entry, work, costs, totals, np.int64(robots[CELL, areas[OWNER, area]]), FROM_OWNER)
    return area


@threaded
def _choose_parts(table, owner_row, helper_row, cells, areas, first, parts):
    """The owner's and the helper's part by least total cost; ties: the owner's lower part, then the helper's."""
    least, of_owner, of_helper = FAR, NONE, NONE
    for mine in range(first, first + parts):
        to_mine = np.int64(table[owner_row, cheapest_cell(table, owner_row, cells, areas, mine)])
        for theirs in range(first, first + parts):
            if theirs != mine:
                total = to_mine + np.int64(table[helper_row, cheapest_cell(table, helper_row, cells, areas, theirs)])
                if total < least:
                    least, of_owner, of_helper = total, mine, theirs
    return of_owner, of_helper


@threaded
def share(cost_to, hop_to, near, entry, work, legs, events, costs, cells, areas, robots, totals, helper):
    """`Find Area To Share`: 1 if the helper got a part, 0 if there is nothing to share, NONE if there is no room."""
    here, area = np.int64(robots[CELL, helper]), NONE
    if cost_to is not None:
        area = _area_to_share(cost_to, here, hop_to, near, entry, work, legs, cells, areas, robots, totals, helper)
    elif work is not None:
        area = _search_area_to_share(hop_to, near, entry, work, legs, costs, cells, areas, robots, totals, helper)
    if area == NONE:
        return 0
    owner = areas[OWNER, area]
    first, parts = replace(near, cells, areas, totals, area, True)
    if first == NONE:
        return NONE
    of_owner, of_helper = NONE, NONE
    if cost_to is not None:
        owner_at = np.int64(robots[CELL, owner])
        of_owner, of_helper = _choose_parts(cost_to, owner_at, here, cells, areas, first, parts)
    elif work is not None:
        of_owner, of_helper = _choose_parts(costs, FROM_OWNER, FROM_HELPER, cells, areas, first, parts)
    give(areas, robots, totals, owner, of_owner)
    give(areas, robots, totals, helper, of_helper)
    travel(cost_to, near, entry, work, legs, cells, areas, robots, totals, owner)
    travel(cost_to, near, entry, work, legs, cells, areas, robots, totals, helper)
    if events is not None:
        note(events, totals[STEP], helper, SHARED_EVENT, area, parts)
        note(events, totals[STEP], owner, ALLOCATED_EVENT, of_owner, robots[TARGET, owner])
        note(events, totals[STEP], helper, ALLOCATED_EVENT, of_helper, robots[TARGET, helper])
    return 1
