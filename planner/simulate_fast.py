"""Algorithm 2 compiled with Numba: the run of `planner.simulate`, rollout by rollout, counted into tallies.

Event for event the same as the readable simulator, with which it shares no code: next-hop tables instead of paths,
legs found one at a time (no leg crosses a cell still to do, so Algorithm 3's path can be found as it is driven), and
areas as segments of one permutation of the cells. Cells are renumbered 0 .. A - 1 in rising index (the accessible ones
alone), which keeps every tie. Axis letters: `A` accessible cells, `K` robots, `M` areas, `T` steps counted.
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
FAR = np.iinfo(np.int64).max


class Tables(NamedTuple):
    """What every rollout reads.

    Attributes:
        near: int32 `[A, 4]`, neighbours N, W, E, S; NONE if blocked.
        cost_to: int32 or int64 `[A, A]`, safest-path cost from row to column; NONE if unreachable.
        hop_to: int16 or int32 `[A, A]`, first cell of that path.
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
"""`cells [7, A]`: area of the cell; the cells area by area; flags (TO_DO: of the coverage path being driven); scratch."""
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


class Counts(NamedTuple):
    """What rollouts are counted into, int64: `by_cell`, `by_step` as above, and histograms; see planner.tally.Tally."""

    by_cell: NDArray
    by_step: NDArray
    visited: NDArray
    survived: NDArray
    alive: NDArray
    outcomes: NDArray


def make_counts(cells: int, robots: int, steps: int) -> Counts:
    """Empty counts for rollouts of at most `steps` steps."""
    shapes = ((CELL_COUNTS, cells), (STEP_COUNTS, steps + 1), (cells + 1,), (cells + 1,), (robots + 1,), (4,))
    return Counts(*(np.zeros(shape, dtype=np.int64) for shape in shapes))


@threaded
def _word(key0, key1, counter0, counter1):  # type: ignore[no-untyped-def]
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
def _reset(starts, order, begin, level, owner, cells, areas, robots, totals):  # type: ignore[no-untyped-def]
    cells[VISITED, :] = 0
    cells[SURVIVED, :] = 0
    cells[TO_DO, :] = 0
    given = len(level)
    totals[AREAS], totals[OPEN], totals[UNVISITED], totals[ALIVE] = given, 0, cells.shape[1], robots.shape[1]
    cells[ORDER, :] = order
    robots[DOING, :] = IDLE
    robots[AREA, :] = NONE
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
def _close(areas, totals, area, status):  # type: ignore[no-untyped-def]
    """Take an area out of the pool, or change what it is."""
    if areas[STATUS, area] == UNASSIGNED:
        totals[OPEN] -= 1
    areas[STATUS, area] = status


@threaded
def _give(areas, robots, totals, robot, area):  # type: ignore[no-untyped-def]
    _close(areas, totals, area, ASSIGNED)
    areas[OWNER, area] = robot
    robots[AREA, robot], robots[DOING, robot] = area, TRAVELING


@threaded
def _cheapest_cell(cost_to, cells, areas, here, area):  # type: ignore[no-untyped-def]
    """The area's cell of least cost from `here`, lowest index first; NONE if it cannot be reached."""
    best, best_cost = NONE, FAR
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        cost = cost_to[here, cell]
        if cost >= 0 and (cost < best_cost or (cost == best_cost and cell < best)):
            best, best_cost = cell, np.int64(cost)
    return best


@threaded
def choose_next_area(cost_to, area_cost, area_entry, cells, areas, totals, here):  # type: ignore[no-untyped-def]
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
            cell = np.int64(_cheapest_cell(cost_to, cells, areas, here, area))
            cost = np.int64(cost_to[here, cell]) if cell != NONE else NONE
        if cost < 0:
            continue
        if best == NONE or level < best_level or cost < best_cost:
            best, best_level, best_cost, best_cell = area, level, cost, cell
    return best, best_cell


@threaded
def _parts(near, cells, areas, area):  # type: ignore[no-untyped-def]
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
        cells[LABEL, first] = parts
        cells[STACK, 0] = first
        top = 1
        while top > 0:
            top -= 1
            here = cells[STACK, top]
            for side in range(4):
                cell = near[here, side]
                if cell == NONE or cells[AREA_OF, cell] != area or cells[VISITED, cell] or cells[LABEL, cell] != NONE:
                    continue
                cells[LABEL, cell] = parts
                cells[STACK, top] = cell
                top += 1
        parts += 1
    return kept, parts


@threaded
def _layer_order(near, cells, area, source, count, mark):  # type: ignore[no-untyped-def]
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
def _bisect(near, cells, areas, area, kept):  # type: ignore[no-untyped-def]
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
        cells[LABEL, first] = parts
        cells[STACK, 0] = first
        top, size = 1, 1
        while top > 0:
            top -= 1
            here = cells[STACK, top]
            for side in range(4):
                cell = near[here, side]
                if cell == NONE or cells[AREA_OF, cell] != area or cells[VISITED, cell] or cells[LABEL, cell] != NONE:
                    continue
                cells[LABEL, cell] = parts
                cells[STACK, top] = cell
                top += 1
                size += 1
        if size > stays_size:
            stays, stays_size = parts, size
        parts += 1
    lowest_stays = cells[LABEL, lowest] == stays
    for place in range(kept, end):
        cell = cells[ORDER, place]
        cells[LABEL, cell] = 0 if (cells[LABEL, cell] == stays) == lowest_stays else 1


@threaded
def _replace(near, cells, areas, totals, area, split):  # type: ignore[no-untyped-def]
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
    _close(areas, totals, area, COMPLETED)
    areas[END, area] = kept
    areas[LEFT_IN, area] = 0
    return first_new, parts


@threaded
def _travel(cost_to, cells, areas, robots, robot):  # type: ignore[no-untyped-def]
    robots[TARGET, robot] = _cheapest_cell(cost_to, cells, areas, robots[CELL, robot], robots[AREA, robot])
    robots[DOING, robot] = TRAVELING


@threaded
def _steps(hop_to, here, target):  # type: ignore[no-untyped-def]
    steps = 0
    while here != target:
        here = hop_to[here, target]
        steps += 1
    return steps


@threaded
def _share(near, cost_to, hop_to, cells, areas, robots, totals, helper):  # type: ignore[no-untyped-def]
    """`Find Area To Share`: 1 if the helper got a part, 0 if there is nothing to share, NONE if there is no room."""
    here = robots[CELL, helper]
    best, best_level, best_cost = NONE, 0, FAR
    for area in range(totals[AREAS]):
        if areas[STATUS, area] != ASSIGNED or areas[LEFT_IN, area] < 2 or areas[OWNER, area] == helper:
            continue
        cell = _cheapest_cell(cost_to, cells, areas, here, area)
        if cell == NONE or _steps(hop_to, here, cell) > areas[LEFT_IN, area]:
            continue
        level, cost = areas[LEVEL, area], np.int64(cost_to[here, cell])
        if best == NONE or level < best_level or (level == best_level and cost < best_cost):
            best, best_level, best_cost = area, level, cost
    if best == NONE:
        return 0
    owner = areas[OWNER, best]
    first, parts = _replace(near, cells, areas, totals, best, True)
    if first == NONE:
        return NONE
    least, of_owner, of_helper = FAR, NONE, NONE
    for mine in range(parts):
        to_mine = np.int64(
            cost_to[robots[CELL, owner], _cheapest_cell(cost_to, cells, areas, robots[CELL, owner], first + mine)]
        )
        for theirs in range(parts):
            if theirs != mine:
                other = _cheapest_cell(cost_to, cells, areas, here, first + theirs)
                total = to_mine + np.int64(cost_to[here, other])
                if total < least:
                    least, of_owner, of_helper = total, first + mine, first + theirs
    _give(areas, robots, totals, owner, of_owner)
    _give(areas, robots, totals, helper, of_helper)
    _travel(cost_to, cells, areas, robots, owner)
    _travel(cost_to, cells, areas, robots, helper)
    return 1


@threaded
def _allocate_next(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot, may_share):  # type: ignore[no-untyped-def]
    """1 if the robot got an area, 0 if not, NONE if there is no room for more areas."""
    if totals[OPEN] > 0:
        area, cell = choose_next_area(cost_to, area_cost, area_entry, cells, areas, totals, robots[CELL, robot])
        if area != NONE:
            _give(areas, robots, totals, robot, area)
            robots[TARGET, robot] = cell
            return 1
    if may_share:
        shared = _share(near, cost_to, hop_to, cells, areas, robots, totals, robot)
        if shared != 0:
            totals[SHARES] += 1 if shared == 1 else 0
            return shared
        robots[DOING, robot], robots[AREA, robot] = FINISHED, NONE
    return 0


@threaded
def _adjacent(near, cells, here, area):  # type: ignore[no-untyped-def]
    """The adjacent cell of the area still to do, lowest index first: always the cheapest. NONE if there is none."""
    for side in range(4):
        cell = near[here, side]
        if cell != NONE and cells[TO_DO, cell] and cells[AREA_OF, cell] == area:
            return cell
    return NONE


@threaded
def _nearest_to_do(cost_to, cells, areas, here, area):  # type: ignore[no-untyped-def]
    """The cheapest cell of the area still to do, lowest index first."""
    best, best_cost = NONE, FAR
    for place in range(areas[BEGIN, area], areas[END, area]):
        cell = cells[ORDER, place]
        if cells[TO_DO, cell]:
            cost = np.int64(cost_to[here, cell])
            if cost < best_cost or (cost == best_cost and cell < best):
                best, best_cost = cell, cost
    return best


@threaded
def _finish(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot):  # type: ignore[no-untyped-def]
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
                here = robots[CELL, robot]
                target = _adjacent(near, cells, here, area)
                if target == NONE:
                    target = _nearest_to_do(cost_to, cells, areas, here, area)
                robots[TARGET, robot] = target
                return True
            _close(areas, totals, area, COMPLETED)
            if _allocate_next(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot, True) == NONE:
                return False
        else:
            return True


@threaded
def _end(totals, quiet, step, max_steps):  # type: ignore[no-untyped-def]
    """How the rollout ends after this step, NONE if it goes on (SPEC section 5's order)."""
    if totals[UNVISITED] == 0:
        return COMPLETE
    if totals[ALIVE] == 0:
        return STOPPED
    if quiet >= 2:
        return STUCK
    return TIMEOUT if step >= max_steps else NONE


@threaded
def _run(  # type: ignore[no-untyped-def]
    near, cost_to, hop_to, bound, area_cost, area_entry, starts, order, begin, level, owner,
    cells, areas, robots, totals, by_cell, by_step, rollout, key0, key1, max_steps, first_only,
):  # fmt: skip
    """One rollout: (outcome, time); AREAS_FULL if there is no room for its areas.

    A robot's action stands here in full, t = 0 (every robot enters its start) included: most steps of most robots end
    without a call, and a call with this many arrays costs as much as the step.
    """
    _reset(starts, order, begin, level, owner, cells, areas, robots, totals)
    step, quiet = 0, 0
    while True:
        progress = step == 0
        for robot in range(robots.shape[1]):
            doing = robots[DOING, robot]
            moving = doing == TRAVELING or doing == COVERING
            if not moving and step > 0:
                if doing != DEAD and totals[OPEN] > 0:
                    got = _allocate_next(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot, False)
                    if got == NONE:
                        return AREAS_FULL, step
                    progress = progress or got == 1
                    if got == 1 and not _finish(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot):
                        return AREAS_FULL, step
                continue
            cell = np.int64(robots[CELL, robot])
            if step > 0:
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
            if bound[cell] > 0 and (fresh or not first_only):
                word = _word(key0, key1, rollout, np.uint32(step * 1024 + robot))
                if (word >> np.uint32(8)) < bound[cell]:
                    by_cell[STOPS, cell] += 1
                    robots[DOING, robot] = DEAD
                    totals[ALIVE] -= 1
                    area = robots[AREA, robot]
                    if area != NONE and _replace(near, cells, areas, totals, area, False)[0] == NONE:
                        return AREAS_FULL, step
                    continue
            if cells[SURVIVED, cell] == 0:
                cells[SURVIVED, cell] = 1
                by_step[NEW_SURVIVED, step] += 1
                by_cell[SAFELY, cell] += 1
            if step == 0:
                if not moving:
                    continue
                _travel(cost_to, cells, areas, robots, robot)
            if cell != robots[TARGET, robot]:
                continue
            if doing == COVERING:
                cells[TO_DO, cell] = 0
                robots[LEFT, robot] -= 1
                if robots[LEFT, robot] > 0:
                    target = _adjacent(near, cells, cell, robots[AREA, robot])
                    if target == NONE:
                        target = _nearest_to_do(cost_to, cells, areas, cell, robots[AREA, robot])
                    robots[TARGET, robot] = target
                    continue
            if not _finish(near, cost_to, hop_to, area_cost, area_entry, cells, areas, robots, totals, robot):
                return AREAS_FULL, step
        quiet = 0 if progress else quiet + 1
        outcome = _end(totals, quiet, step, max_steps)
        if outcome != NONE:
            return outcome, step
        step += 1


@threaded
def run_rollouts(  # type: ignore[no-untyped-def]
    near, cost_to, hop_to, bound, area_cost, area_entry, starts, order, begin, level, owner,
    by_cell, by_step, visited, survived, alive, outcomes,
    singles, start, count, room, key0, key1, max_steps, first_only,
):  # fmt: skip
    """Rollouts `start .. start + count - 1` of `Tables` (line 1) into `Counts` (line 2).

    `room`: areas that a rollout has room for; False if one needed more (the counts are then void).
    `singles`: int32 `[count or 0, 5]`: visited, survived, time, alive, outcome of each, if there is room for them.
    """
    size, team = len(bound), len(starts)
    cells = np.zeros((CELL_ROWS, size), dtype=np.int32)
    areas, robots = np.zeros((AREA_ROWS, room), dtype=np.int32), np.zeros((ROBOT_ROWS, team), dtype=np.int32)
    totals = np.zeros(TOTALS, dtype=np.int64)
    for index in range(count):
        outcome, time = _run(
            near, cost_to, hop_to, bound, area_cost, area_entry, starts, order, begin, level, owner,
            cells, areas, robots, totals, by_cell, by_step, start + index, key0, key1, max_steps, first_only,
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
    return True
