"""Algorithm 2 compiled with Numba: the run of `planner.mrac.simulate`, rollout by rollout, counted into tallies.

Event for event the same as the readable simulator, with which it shares the one search of `planner.mrac.costs` and no
other
code: next-hop tables instead of paths (searches where there are no tables, and for legs kept inside their area),
legs found one at a time (no leg crosses a cell still to do, so Algorithm 3's path can be found as it is driven), and
areas as segments of one permutation of the cells. Cells are renumbered 0 .. A - 1 in rising index (the accessible ones
alone), which keeps every tie. Axis letters: `A` accessible cells, `K` robots, `M` areas, `T` steps counted.
"""

from __future__ import annotations

import numpy as np

from planner.jit import threaded
from planner.kernels.areas import close, give, look_up_next_area, replace, search_next_area, share
from planner.kernels.paths import adjacent, look_up_nearest, next_cell, search_nearest, travel, walk_back
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA,
    AREA_OF,
    AREAS,
    AREAS_FULL,
    ASSIGNED,
    BEGIN,
    BISECTED,
    CELL,
    COMPLETE,
    COMPLETED,
    COVERED,
    COVERING,
    DEAD,
    DIVIDED,
    DOING,
    END,
    FINISHED,
    IDLE,
    LEFT,
    LEFT_IN,
    LEVEL,
    NEW_SURVIVED,
    NEW_VISITED,
    NONE,
    OPEN,
    ORDER,
    OWNER,
    SAFELY,
    STATUS,
    STEP,
    STOPPED,
    STOPS,
    STUCK,
    SURVIVED,
    TARGET,
    TIME,
    TIMEOUT,
    TO_DO,
    TRAVELING,
    UNASSIGNED,
    UNVISITED,
    VISITED,
    VISITS,
)
from planner.kernels.trace import ALLOCATED_EVENT, COMPLETED_EVENT, HIT_EVENT, REALLOCATED_EVENT, look, note


@threaded
def _word(key0, key1, counter0, counter1):
    """Word x0 of Threefry-2x32-20, uint32."""
    ks0, ks1 = np.uint32(key0), np.uint32(key1)
    ks2 = np.uint32(ks0 ^ ks1 ^ np.uint32(0x1BD11BDA))
    x0 = np.uint32(np.uint32(counter0) + ks0)
    x1 = np.uint32(np.uint32(counter1) + ks1)
    for group in range(5):
        if group % 2 == 0:
            for r in (13, 15, 26, 6):
                x0 = np.uint32(x0 + x1)
                x1 = np.uint32(np.uint32(x1 << np.uint32(r)) | np.uint32(x1 >> np.uint32(32 - r))) ^ x0
        else:
            for r in (17, 29, 16, 24):
                x0 = np.uint32(x0 + x1)
                x1 = np.uint32(np.uint32(x1 << np.uint32(r)) | np.uint32(x1 >> np.uint32(32 - r))) ^ x0
        rest = group % 3
        add0 = ks1 if rest == 0 else (ks2 if rest == 1 else ks0)
        add1 = ks2 if rest == 0 else (ks0 if rest == 1 else ks1)
        x0 = np.uint32(x0 + add0)
        x1 = np.uint32(x1 + add1 + np.uint32(group + 1))
    return x0


@threaded
def _reset(starts, order, begin, level, owner, cells, areas, robots, totals):
    cells[VISITED, :] = 0
    cells[SURVIVED, :] = 0
    cells[TO_DO, :] = 0
    given = len(level)
    totals[AREAS], totals[OPEN], totals[UNVISITED], totals[ALIVE] = given, 0, cells.shape[1], robots.shape[1]
    totals[BISECTED], totals[DIVIDED] = 0, 0
    cells[ORDER, :] = order
    robots[DOING, :] = IDLE
    robots[AREA, :] = NONE
    robots[AHEAD, :] = 0
    for robot in range(robots.shape[1]):
        robots[CELL, robot] = starts[robot]
    for area in range(given):
        areas[BEGIN, area], areas[END, area], areas[LEVEL, area] = begin[area], begin[area + 1], level[area]
        areas[LEFT_IN, area] = begin[area + 1] - begin[area]
        areas[OWNER, area] = owner[area]
        for place in range(begin[area], begin[area + 1]):
            cells[AREA_OF, order[place]] = area
        if owner[area] == NONE:
            areas[STATUS, area] = UNASSIGNED
            totals[OPEN] += 1
        else:
            areas[STATUS, area] = ASSIGNED
            robots[AREA, owner[area]], robots[DOING, owner[area]] = area, TRAVELING


@threaded
def _allocate_next(
    near, cost_to, hop_to, area_cost, area_entry, entry, work, legs, events, costs, cells, areas, robots, totals,
    robot, may_share,
):  # fmt: skip
    """1 if the robot got an area, 0 if not, NONE if there is no room for more areas."""
    if totals[OPEN] > 0:
        here = np.int64(robots[CELL, robot])
        area, cell = NONE, NONE
        if cost_to is not None:
            area, cell = look_up_next_area(cost_to, area_cost, area_entry, cells, areas, totals, here)
        elif work is not None:
            area, cell = search_next_area(near, entry, work, cells, areas, totals, here)
        if area != NONE:
            give(areas, robots, totals, robot, area)
            robots[TARGET, robot] = cell
            if legs is not None and hop_to is None:
                robots[AHEAD, robot] = walk_back(near, entry, work, totals, here, cell, legs[robot])
            if events is not None:
                note(events, totals[STEP], robot, ALLOCATED_EVENT, area, cell)
            return 1
    if may_share:
        shared = share(cost_to, hop_to, near, entry, work, legs, events, costs, cells, areas, robots, totals, robot)
        if shared != 0:
            return shared
        robots[DOING, robot], robots[AREA, robot] = FINISHED, NONE
    return 0


@threaded
def _finish(
    near, cost_to, hop_to, ranked, area_cost, area_entry, entry, inside, work, legs, events, costs,
    cells, areas, robots, totals, robot,
):  # fmt: skip
    """What follows at the end of a path or a leg, all of it in the same step. False: no room for more areas."""
    while True:
        area = robots[AREA, robot]
        if robots[DOING, robot] == TRAVELING:
            if robots[CELL, robot] != robots[TARGET, robot]:
                return True
            left = 0
            for place in range(areas[BEGIN, area], areas[END, area]):
                cell = cells[ORDER, place]
                if not cells[VISITED, cell]:
                    cells[TO_DO, cell] = 1
                    left += 1
            robots[LEFT, robot] = left
            robots[DOING, robot] = COVERING
            robots[TARGET, robot] = robots[CELL, robot]
        elif robots[DOING, robot] == COVERING:
            if robots[CELL, robot] != robots[TARGET, robot]:
                return True
            if robots[LEFT, robot] > 0:
                target = adjacent(near, cells, robots[CELL, robot], area)
                if target == NONE:
                    if legs is not None:
                        target = search_nearest(near, entry, inside, work, legs, cells, areas, robots, totals, robot)
                    elif cost_to is not None:
                        target = look_up_nearest(
                            cost_to, ranked, cells, areas, robots[CELL, robot], robots[AREA, robot]
                        )
                robots[TARGET, robot] = target
                return True
            close(areas, totals, area, COMPLETED)
            if _allocate_next(
                near, cost_to, hop_to, area_cost, area_entry, entry, work, legs, events, costs,
                cells, areas, robots, totals, robot, True,
            ) == NONE:  # fmt: skip
                return False
        else:
            return True


@threaded
def _end(totals, quiet, step, max_steps):
    """How the rollout ends after this step, NONE if it goes on (SPEC section 5's order)."""
    if totals[UNVISITED] == 0:
        return COMPLETE
    if totals[ALIVE] == 0:
        return STOPPED
    if quiet >= 2:
        return STUCK
    return TIMEOUT if step >= max_steps else NONE


@threaded
def _run(
    near, cost_to, hop_to, ranked, area_cost, area_entry, entry, bound, starts, order, begin, level, owner,
    work, legs, costs, cells, areas, robots, totals, by_cell, by_step, events, frames,
    rollout, key0, key1, max_steps, first_only, inside,
):  # fmt: skip
    """One rollout: (outcome, time); AREAS_FULL if there is no room for its areas.

    A robot's action stands here in full, t = 0 (every robot enters its start) included: most steps of most robots end
    without a call, and a call with this many arrays costs as much as the step.
    """
    _reset(starts, order, begin, level, owner, cells, areas, robots, totals)
    step, quiet = 0, 0
    while True:
        progress = step == 0
        if events is not None:
            totals[STEP] = step
        for robot in range(robots.shape[1]):
            doing = robots[DOING, robot]
            moving = doing in (TRAVELING, COVERING)
            if not moving and step > 0:
                if doing != DEAD and totals[OPEN] > 0:
                    got = _allocate_next(
                        near, cost_to, hop_to, area_cost, area_entry, entry, work, legs, events, costs,
                        cells, areas, robots, totals, robot, False,
                    )  # fmt: skip
                    if got == NONE:
                        return AREAS_FULL, step
                    progress = progress or got == 1
                    if got == 1 and not _finish(
                        near, cost_to, hop_to, ranked, area_cost, area_entry, entry, inside, work, legs, events, costs,
                        cells, areas, robots, totals, robot,
                    ):  # fmt: skip
                        return AREAS_FULL, step
                continue
            cell = np.int64(robots[CELL, robot])
            if step > 0:
                if legs is not None:
                    cell = next_cell(hop_to, legs, robots, robot)
                elif hop_to is not None:
                    cell = np.int64(hop_to[cell, robots[TARGET, robot]])
                robots[CELL, robot] = cell
            progress = True
            by_cell[VISITS, cell] += 1
            fresh = cells[VISITED, cell] == 0
            if fresh:
                cells[VISITED, cell] = 1
                by_step[NEW_VISITED, step] += 1
                by_cell[COVERED, cell] += 1
                totals[UNVISITED] -= 1
                holder = cells[AREA_OF, cell]
                areas[LEFT_IN, holder] -= 1
                if areas[LEFT_IN, holder] == 0:
                    if areas[STATUS, holder] == UNASSIGNED:
                        totals[OPEN] -= 1
                    areas[STATUS, holder] = COMPLETED
                    if events is not None:
                        note(events, step, robot, COMPLETED_EVENT, holder, cell)
            if bound[cell] > 0 and (fresh or not first_only):
                word = _word(key0, key1, rollout, np.uint32(step * 1024 + robot))
                if (word >> np.uint32(8)) < bound[cell]:
                    by_cell[STOPS, cell] += 1
                    robots[DOING, robot] = DEAD
                    totals[ALIVE] -= 1
                    area = robots[AREA, robot]
                    if events is not None:
                        note(events, step, robot, HIT_EVENT, area, cell)
                    if area != NONE:
                        first, parts = replace(near, cells, areas, totals, area, False)
                        if first == NONE:
                            return AREAS_FULL, step
                        if events is not None and parts > 0:
                            note(events, step, robot, REALLOCATED_EVENT, area, parts)
                        robots[AREA, robot] = NONE
                    continue
            if cells[SURVIVED, cell] == 0:
                cells[SURVIVED, cell] = 1
                by_step[NEW_SURVIVED, step] += 1
                by_cell[SAFELY, cell] += 1
            if step == 0:
                if not moving:
                    continue
                travel(cost_to, near, entry, work, legs, cells, areas, robots, totals, robot)
            if cell != robots[TARGET, robot]:
                continue
            if doing == COVERING:
                cells[TO_DO, cell] = 0
                robots[LEFT, robot] -= 1
                if robots[LEFT, robot] > 0:
                    target = adjacent(near, cells, cell, robots[AREA, robot])
                    if target == NONE:
                        if legs is not None:
                            target = search_nearest(
                                near, entry, inside, work, legs, cells, areas, robots, totals, robot
                            )
                        elif cost_to is not None:
                            target = look_up_nearest(
                                cost_to, ranked, cells, areas, robots[CELL, robot], robots[AREA, robot]
                            )
                    robots[TARGET, robot] = target
                    continue
            if not _finish(
                near, cost_to, hop_to, ranked, area_cost, area_entry, entry, inside, work, legs, events, costs,
                cells, areas, robots, totals, robot,
            ):  # fmt: skip
                return AREAS_FULL, step
        if frames is not None:
            look(frames, step, robots)
        quiet = 0 if progress else quiet + 1
        outcome = _end(totals, quiet, step, max_steps)
        if outcome != NONE:
            return outcome, step
        step += 1


@threaded
def run_rollouts(
    near, cost_to, hop_to, ranked, area_cost, area_entry, entry, bound, starts, order, begin, level, owner,
    by_cell, by_step, visited, survived, alive, outcomes,
    work, legs, costs, cells, areas, robots, totals,
    singles, events, frames, start, count, key0, key1, max_steps, first_only, inside,
):  # fmt: skip
    """Rollouts `start .. start + count - 1` of `Tables` (line 1) into `Counts` (line 2), with a `State` (line 3).

    `singles`: int32 `[count or 0, SINGLES]`, the numbers of each rollout, if there is room for them.
    `events`, `frames`: None, or where to write down what happens; see planner.kernels.trace.
    `inside`: EVERYWHERE or INSIDE, where a coverage path may lead (`transit`).
    Returns False if one needed more areas than the state has room for (the counts are then void).
    """
    size = len(bound)
    for index in range(count):
        outcome, time = _run(
            near, cost_to, hop_to, ranked, area_cost, area_entry, entry, bound, starts, order, begin, level, owner,
            work, legs, costs, cells, areas, robots, totals, by_cell, by_step, events, frames,
            start + index, key0, key1, max_steps, first_only, inside,
        )  # fmt: skip
        if outcome == AREAS_FULL:
            return False
        covered, safely = size - totals[UNVISITED], 0
        for cell in range(size):
            safely += cells[SURVIVED, cell]
        visited[covered] += 1
        survived[safely] += 1
        by_step[TIME, time] += 1
        alive[totals[ALIVE]] += 1
        outcomes[outcome] += 1
        if len(singles) > 0:
            singles[index, 0], singles[index, 1], singles[index, 2] = covered, safely, time
            singles[index, 3], singles[index, 4] = totals[ALIVE], outcome
            singles[index, 5], singles[index, 6] = totals[BISECTED], totals[DIVIDED]
    return True
