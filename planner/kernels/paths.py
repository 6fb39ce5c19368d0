"""Ways to get there, for the compiled simulator: costs, nearest cells and legs, from all-pairs tables or by searches.

Part of `planner.kernels.rollouts`, which see. `cost_to` and the other tables are None where distances are searched for
on demand; `work` and `legs` are None where nothing is. A search's answer is the tables', ties included (SPEC section
3).
"""

from __future__ import annotations

import numpy as np

from planner.jit import threaded
from planner.kernels.state import (
    AHEAD,
    AREA,
    AREA_OF,
    BEGIN,
    CELL,
    DISTANCE,
    DOING,
    END,
    EVERYWHERE,
    FAR,
    HEAP_CELL,
    HEAP_COST,
    INSIDE,
    LEVEL,
    NONE,
    ORDER,
    QUEUE,
    RANK,
    SEEN,
    STAMP,
    TARGET,
    TO_DO,
    TRAVELING,
)
from planner.mrac.costs import search


@threaded
def seek(near, entry, work, totals, here, inside):
    """The nearest cell that has a RANK, by (cost, rank, index), NONE if none can be reached; no RANK: all are seen."""
    totals[STAMP] += 1
    cell, _ = search(
        here, work[RANK], work[inside], near, entry, work[DISTANCE], work[SEEN], totals[STAMP],
        work[QUEUE], work[HEAP_COST], work[HEAP_CELL],
    )  # fmt: skip
    return cell


@threaded
def walk_back(near, entry, work, totals, here, target, leg):
    """Write the last search's path from `here` to `target` into `leg` `[A]`, last cell first; returns its steps."""
    stamp, steps, cell = totals[STAMP], 0, target
    while cell != here:
        leg[steps] = cell
        steps += 1
        before = work[DISTANCE, cell] - entry[cell]
        for side in range(4):
            other = np.int64(near[cell, side])
            if other != NONE and work[SEEN, other] == stamp and work[DISTANCE, other] == before:
                cell = other
                break
    return steps


@threaded
def costs_from(near, entry, work, costs, totals, here, row):
    """Search for the cost from `here` to every cell, NONE if unreachable, and keep it in `costs[row]`."""
    seek(near, entry, work, totals, here, EVERYWHERE)
    for cell in range(costs.shape[1]):
        costs[row, cell] = work[DISTANCE, cell] if work[SEEN, cell] == totals[STAMP] else NONE


@threaded
def steps_to(hop_to, near, entry, work, legs, totals, robot, here, target):
    """Moves from the robot's cell `here` to `target`; without tables the last search was `costs_from` there."""
    steps = 0
    if hop_to is not None:
        while here != target:
            here = np.int64(hop_to[here, target])
            steps += 1
    elif legs is not None:
        steps = walk_back(near, entry, work, totals, here, target, legs[robot])
    return steps


@threaded
def next_cell(hop_to, legs, robots, robot):
    """The cell that the robot enters next on its leg."""
    if hop_to is not None and robots[DOING, robot] == TRAVELING:
        return np.int64(hop_to[robots[CELL, robot], robots[TARGET, robot]])
    ahead = robots[AHEAD, robot]
    if ahead == 0:
        return np.int64(robots[TARGET, robot])
    robots[AHEAD, robot] = ahead - 1
    return np.int64(legs[robot, ahead - 1])


@threaded
def cheapest_cell(costs, row, cells, areas, area):
    """The area's cell of least cost in `costs[row]`, lowest index first; NONE if it cannot be reached."""
    best, best_cost = NONE, FAR
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        cost = costs[row, cell]
        if cost >= 0 and (cost < best_cost or (cost == best_cost and cell < best)):
            best, best_cost = cell, np.int64(cost)
    return best


@threaded
def rank_area(work, cells, areas, area, rank):
    """Make the cells of an area targets of this rank (NONE: no longer)."""
    for place in range(areas[BEGIN, area], areas[END, area]):
        work[RANK, cells[ORDER, place]] = rank


@threaded
def travel(cost_to, near, entry, work, legs, cells, areas, robots, totals, robot):
    """Send the robot to the cheapest cell of its area."""
    here, area = np.int64(robots[CELL, robot]), robots[AREA, robot]
    robots[DOING, robot] = TRAVELING
    if cost_to is not None:
        robots[TARGET, robot] = cheapest_cell(cost_to, here, cells, areas, area)
    elif work is not None:
        rank_area(work, cells, areas, area, 0)
        target = seek(near, entry, work, totals, here, EVERYWHERE)
        rank_area(work, cells, areas, area, NONE)
        robots[TARGET, robot] = target
        robots[AHEAD, robot] = walk_back(near, entry, work, totals, here, target, legs[robot])


@threaded
def adjacent(near, cells, here, area):
    """The adjacent cell of the area still to do, lowest index first: always the cheapest. NONE if there is none."""
    for side in range(4):
        cell = near[here, side]
        if cell != NONE and cells[TO_DO, cell] and cells[AREA_OF, cell] == area:
            return cell
    return NONE


@threaded
def look_up_nearest(cost_to, ranked, cells, areas, here, area):
    """The cheapest cell of the area still to do, lowest index first, from tables.

    In a safe area it is looked for among the cells ranked by cost; before a dangerous one come too many safe cells.
    """
    if areas[LEVEL, area] == 0:
        for place in range(ranked.shape[1]):
            cell = np.int64(ranked[here, place])
            if cell == NONE:
                break
            if cells[TO_DO, cell] and cells[AREA_OF, cell] == area:
                return cell
    best, best_cost = NONE, FAR
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        if cells[TO_DO, cell]:
            cost = np.int64(cost_to[here, cell])
            if cost < best_cost or (cost == best_cost and cell < best):
                best, best_cost = cell, cost
    return best


@threaded
def search_nearest(near, entry, inside, work, legs, cells, areas, robots, totals, robot):
    """The same for the robot by a search among the cells `inside`: EVERYWHERE, or INSIDE the area. Keeps the leg."""
    here, area = np.int64(robots[CELL, robot]), robots[AREA, robot]
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        work[INSIDE, cell] = 1
        if cells[TO_DO, cell]:
            work[RANK, cell] = 0
    target = seek(near, entry, work, totals, here, inside)
    rank_area(work, cells, areas, area, NONE)
    for place in range(areas[BEGIN, area], areas[END, area]):
        work[INSIDE, cells[ORDER, place]] = 0
    robots[AHEAD, robot] = walk_back(near, entry, work, totals, here, target, legs[robot])
    return target
