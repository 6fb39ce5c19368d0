"""The book of areas of the compiled simulator: its state's layout, who gets what, components, bisection, sharing.

Part of `planner.simulate_fast`, which see. Axis letters: `A` accessible cells, `K` robots, `M` areas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.jit import threaded

IDLE, TRAVELING, COVERING, FINISHED, DEAD = 0, 1, 2, 3, 4
UNASSIGNED, ASSIGNED, COMPLETED = 0, 1, 2
COMPLETE, STOPPED, STUCK, TIMEOUT, AREAS_FULL = 0, 1, 2, 3, -1
NONE = -1
FAR = 2**63 - 1


RANKED = 128
"""Cells that `Tables.ranked` holds for each cell: a robot in a safe area mostly finds its next cell among them."""


class Tables(NamedTuple):
    """What every rollout reads.

    Attributes:
        near: int32 `[A, 4]`, neighbours N, W, E, S; NONE if blocked.
        cost_to: int32 or int64 `[A, A]`, safest-path cost from row to column; NONE if unreachable.
        hop_to: int16 or int32 `[A, A]`, first cell of that path.
        ranked: like hop_to `[A, RANKED]`, the cells of least cost from each, by (cost, index); NONE after the last.
        bound: uint32 `[A]`, a visit stops the robot iff the 24 leading bits of its word are below this.
        starts: int32 `[K]`.
        area_cost: like cost_to `[A, M]`, cost from each cell to each area of t = 0 (its cheapest cell, visited or not);
            area_entry: like hop_to `[A, M]`, that cell.
        order: int32 `[A]`, the cells area by area; begin: int32 `[M + 1]`, where each area begins in it.
        level, owner: int32 `[M]`, the allocation at t = 0.
    """

    near: NDArray
    cost_to: NDArray
    hop_to: NDArray
    ranked: NDArray
    bound: NDArray
    area_cost: NDArray
    area_entry: NDArray
    starts: NDArray
    order: NDArray
    begin: NDArray
    level: NDArray
    owner: NDArray


# One rollout's state is four int32 arrays, rows named here. (Plain arrays: a tuple of many costs a count of references
# at every call, which made the run 20 times slower.)
AREA_OF, ORDER, VISITED, SURVIVED, TO_DO, LABEL, STACK, CELL_ROWS = 0, 1, 2, 3, 4, 5, 6, 7
"""`cells [7, A]`: area of the cell; the cells area by area; flags (TO_DO: of the path being driven); scratch."""
BEGIN, END, LEVEL, OWNER, STATUS, LEFT_IN, AREA_ROWS = 0, 1, 2, 3, 4, 5, 6
"""`areas [6, M]`: segment of ORDER, level, robot, status, unvisited cells."""
CELL, DOING, AREA, TARGET, LEFT, ROBOT_ROWS = 0, 1, 2, 3, 4, 5
"""`robots [5, K]`: where, what, which area, end of the current leg, cells still to do on the coverage path."""
AREAS, OPEN, UNVISITED, ALIVE, SHARES, TOTALS = 0, 1, 2, 3, 4, 5
"""`totals [5]`: areas so far, unassigned ones, unvisited cells, robots alive, areas shared."""
VISITS, STOPS, COVERED, SAFELY, CELL_COUNTS = 0, 1, 2, 3, 4
"""`by_cell [4, A]`, int64 counts over rollouts: visits, stops, covered (visited), covered (survived)."""
TIME, NEW_VISITED, NEW_SURVIVED, STEP_COUNTS = 0, 1, 2, 3
"""`by_step [3, T + 1]`, int64 counts over rollouts: times, cells new at each step in the two meanings."""


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
    robots[AREA, robot], robots[DOING, robot] = area, TRAVELING


@threaded
def cheapest_cell(cost_to, cells, areas, here, area):
    """The area's cell of least cost from `here`, lowest index first; NONE if it cannot be reached."""
    best, best_cost = NONE, FAR
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        cost = cost_to[here, cell]
        if cost >= 0 and (cost < best_cost or (cost == best_cost and cell < best)):
            best, best_cost = cell, np.int64(cost)
    return best


@threaded
def choose_next_area(cost_to, area_cost, area_entry, cells, areas, totals, here):
    """(area, cell) of the next area by (level, cost, id), NONE if none is reachable. Policies replace this function.

    An area of t = 0 keeps its cells until it is replaced, so its cost is in a table; the others are searched.
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
            cell = np.int64(cheapest_cell(cost_to, cells, areas, here, area))
            cost = np.int64(cost_to[here, cell]) if cell != NONE else NONE
        if cost < 0:
            continue
        if best == NONE or level < best_level or cost < best_cost:
            best, best_level, best_cost, best_cell = area, level, cost, cell
    return best, best_cell


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
    if split and parts == 1:
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
def travel(cost_to, cells, areas, robots, robot):
    robots[TARGET, robot] = cheapest_cell(cost_to, cells, areas, robots[CELL, robot], robots[AREA, robot])
    robots[DOING, robot] = TRAVELING


@threaded
def _steps(hop_to, here, target):
    steps = 0
    while here != target:
        here = hop_to[here, target]
        steps += 1
    return steps


@threaded
def share(near, cost_to, hop_to, cells, areas, robots, totals, helper):
    """`Find Area To Share`: 1 if the helper got a part, 0 if there is nothing to share, NONE if there is no room."""
    here = robots[CELL, helper]
    best, best_level, best_cost = NONE, 0, FAR
    for area in range(totals[AREAS]):
        if areas[STATUS, area] != ASSIGNED or areas[LEFT_IN, area] < 2 or areas[OWNER, area] == helper:
            continue
        cell = cheapest_cell(cost_to, cells, areas, here, area)
        if cell == NONE or _steps(hop_to, here, cell) > areas[LEFT_IN, area]:
            continue
        level, cost = areas[LEVEL, area], np.int64(cost_to[here, cell])
        if best == NONE or level < best_level or (level == best_level and cost < best_cost):
            best, best_level, best_cost = area, level, cost
    if best == NONE:
        return 0
    owner = areas[OWNER, best]
    first, parts = replace(near, cells, areas, totals, best, True)
    if first == NONE:
        return NONE
    least, of_owner, of_helper = FAR, NONE, NONE
    for mine in range(parts):
        to_mine = np.int64(
            cost_to[robots[CELL, owner], cheapest_cell(cost_to, cells, areas, robots[CELL, owner], first + mine)]
        )
        for theirs in range(parts):
            if theirs != mine:
                other = cheapest_cell(cost_to, cells, areas, here, first + theirs)
                total = to_mine + np.int64(cost_to[here, other])
                if total < least:
                    least, of_owner, of_helper = total, first + mine, first + theirs
    give(areas, robots, totals, owner, of_owner)
    give(areas, robots, totals, helper, of_helper)
    travel(cost_to, cells, areas, robots, owner)
    travel(cost_to, cells, areas, robots, helper)
    return 1
