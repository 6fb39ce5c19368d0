"""Safest paths as all-pairs tables and by searches, and the legs along them. Axes: `A` cells, `M` areas."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from .codes import NO_CELL, NONE
from .jit import kernel, rare_kernel, search, threaded
from .robot_types import own
from .searches import TOO_FAR, UNREACHED, SafeParts, danger_ahead, far_search, pop, push
from .state import AREA_BITS, FAR, RANKED, SURVIVED, TO_DO, VISITED, holds

BLOCK = 32
"""Sources whose first hops are written at a time: by target, so that each cache line is fetched once."""
NO_PATH_COST = 2**62
"""More than the cost of any path."""
LEAST_SHARED = 2**20
"""Table entries from which on threads share the work: smaller tables are done before threads have started."""


def all_pairs(
    near: NDArray[np.int32], entry: NDArray[np.int64], wide: np.dtype, narrow: np.dtype
) -> tuple[NDArray, NDArray, NDArray]:
    """All-pairs tables of safest paths.

    Args:
        near: int32 `[A, 4]`, neighbours, NO_CELL if none.
        entry: int64 `[A]`, entry cost of each cell.
        wide: integer type of costs.
        narrow: integer type of cells.

    Returns:
        `Tables.cost_to`, `hop_to`, both `[A, A]`, and `ranked` `[A, RANKED]`.

    Cost: O(A**2 log A).
    """
    size = len(entry)
    cost = np.full((size, size), UNREACHED, dtype=wide)
    hop = np.zeros((size, size), dtype=narrow)
    ranked = np.full((size, min(size, RANKED)), size, dtype=narrow)
    _share_out(cost.size, lambda part, parts: _fill(part, parts, near, entry, cost, hop, ranked))
    return cost, hop, ranked


def to_areas(
    cost: NDArray, narrow: np.dtype, order: NDArray[np.int32], begin: NDArray[np.int32]
) -> tuple[NDArray, NDArray]:
    """Tables of the cheapest cell of each area of t = 0.

    Args:
        cost: `[A, A]`, of `all_pairs`.
        narrow: integer type of cells.
        order: int32 `[A]`, the cells area by area, increasing in each.
        begin: int32 `[M + 1]`, begin of each area in `order`.

    Returns:
        (cost, cell) `[A, M]`, from each cell to each area.
    """
    area_cost = np.empty((len(cost), len(begin) - 1), dtype=cost.dtype)
    area_entry = np.empty(area_cost.shape, dtype=narrow)
    _share_out(cost.size, lambda part, parts: _nearest(part, parts, cost, order, begin, area_cost, area_entry))
    return area_cost, area_entry


def _share_out(entries: int, work: Callable[[int, int], None]) -> None:
    """Call `work(part, parts)` for each part; in threads if there are many entries."""
    threads = os.cpu_count() or 1
    if entries < LEAST_SHARED:
        work(0, 1)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda part: work(part, threads), range(threads)))


@threaded
def _fill(part, parts, near, entry, cost, hop, ranked):
    """Fill the tables for every `parts`-th BLOCK of sources.

    Dijkstra's algorithm as in `searches.search_within`, but to all cells. Cells leave the queue in increasing order of
    cost, so the predecessor of a cell already has its first hop.
    """
    size, most = len(entry), ranked.shape[1]
    distance, hops = np.empty(size, dtype=np.int64), np.zeros((BLOCK, size), dtype=hop.dtype)
    queue, heap_cell, heap_cost = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int64)
    for begin in range(part * BLOCK, size, parts * BLOCK):
        block = min(BLOCK, size - begin)
        for source in range(begin, begin + block):
            hop_of = hops[source - begin]
            hop_of[:] = 0
            distance[:] = NO_PATH_COST
            distance[source], queue[0] = 0, source
            head, tail, heap_size, now = 0, 1, 0, np.int64(0)
            while True:
                while heap_size > 0 and heap_cost[0] == now:
                    queue[tail] = heap_cell[0]
                    tail += 1
                    heap_size = pop(heap_cost, heap_cell, heap_size)
                layer_end = tail
                while head < layer_end:
                    here = queue[head]
                    head += 1
                    cost[source, here] = now
                    before, known = now - entry[here], False
                    for side in range(4):
                        cell = near[here, side]
                        if cell == NO_CELL:
                            continue
                        if distance[cell] == NO_PATH_COST:
                            distance[cell] = now + entry[cell]
                            if entry[cell] == 1:
                                queue[tail] = cell
                                tail += 1
                            else:
                                heap_size = push(heap_cost, heap_cell, heap_size, now + entry[cell], cell)
                        # Neighbours increase in index, so the first predecessor is the lowest; its hop is known.
                        elif distance[cell] == before and not known:
                            hop_of[here] = here if cell == source else hop_of[cell]
                            known = True
                if tail > layer_end:
                    now += 1
                elif heap_size > 0:
                    now = heap_cost[0]
                else:
                    break
            first = 0
            while first < min(tail, most):  # cells of equal cost, by index
                last = first + 1
                while last < tail and distance[queue[last]] == distance[queue[first]]:
                    last += 1
                for place in range(first + 1, last):
                    cell, at = queue[place], place
                    while at > first and queue[at - 1] > cell:
                        queue[at] = queue[at - 1]
                        at -= 1
                    queue[at] = cell
                for place in range(first, min(last, most)):
                    ranked[source, place] = queue[place]
                first = last
        for cell in range(size):
            for row in range(block):
                # Transposed by blocks: written by source, each write would touch another cache line.
                hop[cell, begin + row] = hops[row, cell]


@threaded
def _nearest(part, parts, cost, order, begin, area_cost, area_entry):
    """Fill every `parts`-th row of the tables of areas; the first of the cells with equal cost."""
    for source in range(part, len(cost), parts):
        for area in range(len(begin) - 1):
            nearest = order[begin[area]]
            for place in range(begin[area] + 1, begin[area + 1]):
                if cost[source, order[place]] < cost[source, nearest]:
                    nearest = order[place]
            area_cost[source, area], area_entry[source, area] = cost[source, nearest], nearest


# The nearest cell of a goal by a search, where there are no tables of distances, and the path to it.
#
# A goal is a test on a cell's area and flags, so that no cells have to be marked before a search. Near cells are found
# by Dijkstra's algorithm with a layered queue, far ones by the algorithm of `SafestPaths`. Ties: SPEC section 3.

ONE_CELL = -2
"""First element of a goal that is one cell; NONE is that of the unassigned areas of a level."""


@kernel
def any_of(area):
    """The goal of all cells of the area."""
    return np.int64(area) << AREA_BITS | VISITED | SURVIVED | TO_DO, np.int64(VISITED | SURVIVED | TO_DO)


@kernel
def to_do_of(area):
    """The goal of the cells to do of the area."""
    return np.int64(area) << AREA_BITS | VISITED | SURVIVED | TO_DO, np.int64(VISITED | SURVIVED)


@kernel
def open_at(level):
    """The goal of all cells of the unassigned areas of this level."""
    return np.int64(NONE), np.int64(level)


@kernel
def one_cell(cell):
    """The goal of one cell; of none for NONE."""
    return np.int64(ONE_CELL), np.int64(cell)


@kernel
def is_goal(home, open_areas, areas, cell, goal):
    """Whether the cell belongs to the goal."""
    flags = np.int64(home[cell])
    if goal[0] >= 0:
        return flags | goal[1] == goal[0]
    if goal[0] == ONE_CELL:
        return cell == goal[1]
    area = flags >> AREA_BITS
    return holds(open_areas, area) and areas[area].level == goal[1]


@kernel
def seek(t, s, w, here, goal, inside):
    """The nearest cell of the goal by (cost, area, index), NONE if unreachable; `walk_back` then gives the path.

    Args:
        here: the cell to start from.
        goal: of `any_of`, `to_do_of`, `open_at` or `one_cell`.
        inside: an area that the path may not leave, or NONE.
    """
    w.last[0] = NONE
    cell = seek_near(t, s, w, here, goal, inside, t.nearby if inside == NONE else len(t.near))
    return seek_far(t, s, w, here, goal) if cell == TOO_FAR else cell


@rare_kernel
def seek_near(t, s, w, here, goal, inside, most):
    """The same; TOO_FAR if more than `most` cells were passed before the result was certain."""
    near, entry = s.near if t.learns else t.near, s.entry if t.learns else t.entry
    return search_near(
        near, entry, s.home, s.open, s.areas, w.distance, w.seen, w.stamp, w.queue, w.heap_cost, w.heap_cell,
        np.int64(here), goal, np.int64(inside), np.int64(most),
    )  # fmt: skip


@search
def search_near(
    near, entries, home, open_areas, areas, distance, seen, stamps, queue, heap_cost, heap_cell, here, goal, inside,
    most,
):  # fmt: skip
    """`seek_near` of arrays: Dijkstra's algorithm with a layered queue.

    Costs belong to the cell entered, so the distance of a cell is final when it is first met: each is queued once.
    Cells of cost 1 (safe ones) go through a layered queue, the others through a heap.
    """
    stamps[0] += 1
    stamp = stamps[0]
    distance[here], seen[here], seen[len(near)] = 0, stamp, stamp  # blocked neighbours count as met
    if is_goal(home, open_areas, areas, here, goal):
        return here
    best, best_cost, best_area, last_cost = np.int64(NONE), np.int64(0), np.int64(0), np.int64(0)
    queue[0], head, tail, heap_size, now = here, 0, 1, 0, np.int64(0)
    while head <= most:
        while heap_size > 0 and heap_cost[0] == now:
            queue[tail] = heap_cell[0]
            tail += 1
            heap_size = pop(heap_cost, heap_cell, heap_size)
        layer_end = tail
        while head < layer_end:
            at = np.int64(queue[head])
            head += 1
            for side in range(4):
                cell = np.int64(near[at, side])
                # A stamp needs no clearing: a search costs the cells it passes, not the size of the map.
                if seen[cell] == stamp or (inside != NONE and np.int64(home[cell]) >> AREA_BITS != inside):
                    continue
                seen[cell], entry = stamp, entries[cell]
                cost = now + entry
                distance[cell] = cost
                if (best == NONE or cost <= best_cost) and is_goal(home, open_areas, areas, cell, goal):
                    area = np.int64(home[cell]) >> AREA_BITS
                    if best == NONE or (cost, area, cell) < (best_cost, best_area, best):
                        best, best_cost, best_area, last_cost = cell, cost, area, entry
                if entry == 1:
                    queue[tail] = cell
                    tail += 1
                else:
                    heap_size = push(heap_cost, heap_cell, heap_size, cost, cell)
        if tail > layer_end:
            now += 1
        elif heap_size > 0:
            now = heap_cost[0]
        else:
            return best
        # No cell still queued can be as cheap, not even with a lower area or index.
        if best != NONE and now + last_cost > best_cost:
            return best
    return np.int64(TOO_FAR)


@rare_kernel
def seek_far(t, s, w, here, goal):
    """The same for far goals: safe components on the way are passed as one node."""
    count = mark_goal(s, w, goal)
    w.stamp[0] += 1
    parts = SafeParts(t.node, t.beside, t.border, t.wide, w.to_go, w.touched)
    ahead = danger_ahead(
        here, w.rank, w.stack[:count], t.near, t.entry, w.stamp[0], w.heap_cost, w.heap_cell, parts
    )  # fmt: skip
    cell = np.int64(NONE if ahead < 0 else TOO_FAR)
    if ahead > 0:
        cell, _ = far_search(
            here, w.rank, w.everywhere, t.near, t.entry, w.distance, w.seen, w.stamp[0], w.heap_cost, w.heap_cell,
            w.queue, w.listed, parts, ahead,
        )  # fmt: skip
    for place in range(count):
        w.rank[w.stack[place]] = NONE
    return seek_near(t, s, w, here, goal, NONE, len(t.near)) if cell == TOO_FAR else np.int64(cell)


@kernel
def mark_goal(s, w, goal):
    """List the goal's cells in `w.stack` and rank them by area; returns how many."""
    if goal[0] == ONE_CELL:
        w.stack[0], w.rank[goal[1]] = goal[1], 0
        return 1
    first, last = np.int64(0), np.int64(s.marks.areas)
    if goal[0] >= 0:
        first = goal[0] >> AREA_BITS
        last = first + 1
    return list_goal(s.home, s.open, s.areas, s.order, goal, first, last, w.stack, w.rank)


@search
def list_goal(home, open_areas, areas, order, goal, first, last, stack, rank):
    """`mark_goal` of arrays, over the areas `first .. last - 1`."""
    count = 0
    for area in range(first, last):
        if goal[0] == NONE and not (holds(open_areas, area) and areas[area].level == goal[1]):
            continue
        for place in range(areas[area].begin, areas[area].end):
            cell = np.int64(order[place])
            if is_goal(home, open_areas, areas, cell, goal):
                stack[count], rank[cell] = cell, area
                count += 1
    return count


# Costs from one cell to all others, cached as a row where there are no tables: few cells are asked for, and repeatedly.
#
# A row gives the same answer as a search, so no rollout depends on which rows are cached. A thread keeps ROWS_BYTES of
# them; then each new row replaces the oldest.


@rare_kernel
def row_from(t, s, w, here):
    """Index of the row of costs from `here`, made if it is not cached; `walk_back` then follows it.

    The row of the last answer stays valid.
    """
    row = np.int64(w.row_of[here])
    if row == NONE:
        # Sharing compares two rows: the last one must survive the making of the next.
        row = w.oldest[0] if w.oldest[0] != w.last[0] else (w.oldest[0] + 1) % len(w.rows)
        w.oldest[0] = (row + 1) % len(w.rows)
        if w.source_of[row] != NONE:
            w.row_of[w.source_of[row]] = NONE
        w.source_of[row], w.row_of[here] = here, row
        if not t.learns:
            fill_row(t, w, here, row)
        else:
            fill_row_believed(t, s, w, here, row)
    w.last[0] = row
    return row


@kernel
def fill_row(t, w, here, row):
    """Fill a row: costs to all cells, and the cheapest cell of each area of t = 0, lowest index first."""
    spread(t.near, t.kind, t.kind_cost, t.kind_begin, w.queue, w.heads, w.tails, w.heap_cost, w.heap_cell,
        np.int64(here), w.rows[row])  # fmt: skip
    nearest_of_areas(w.rows[row], t.order, t.begin, w.row_costs[row], w.row_entries[row])


@search
def nearest_of_areas(costs, order, begin, area_costs, area_entries):
    """The cheapest cell of each area of t = 0, lowest index first, and its cost."""
    for area in range(len(area_costs)):
        best = np.int64(order[begin[area]])
        for place in range(begin[area] + 1, begin[area + 1]):
            cell = np.int64(order[place])
            if costs[cell] < costs[best]:
                best = cell
        area_costs[area], area_entries[area] = costs[best], best


@kernel
def fill_row_believed(t, s, w, here, row):
    """Fill a row on the team's map in an online mission: a search for no cell passes all reachable ones."""
    seek_near(t, s, w, here, one_cell(np.int64(NONE)), np.int64(NONE), len(t.near))
    costs, stamp = w.rows[row], w.stamp[0]
    for cell in range(len(t.near)):
        costs[cell] = w.distance[cell] if w.seen[cell] == stamp else NONE
    costs[len(t.near)] = NONE


@search
def spread(near, kinds, kind_cost, kind_begin, queue, head, tail, heap_cost, heap_cell, here, costs):
    """Dijkstra's algorithm from `here` to all cells.

    All cells of a kind cost the same to enter, so cells of a kind leave the queue in the order in which they enter it.
    Each kind has a first-in first-out queue, a segment of `queue`; the heap holds only the first cell of each.

    Args:
        near: `[A, 4]`, neighbours; A if blocked.
        kinds, kind_cost, kind_begin: as in `Tables`.
        queue: `[A]`; head, tail: `[C]`; heap_cost, heap_cell: `[A]`: scratch.
        here: the source.
        costs: `[A + 1]`, the result; NONE for unreachable cells, and at the end.
    """
    for cell in range(len(near)):
        costs[cell] = NONE
    costs[len(near)] = 0  # blocked neighbours count as met
    heap_size, now = 0, np.int64(0)
    for kind in range(len(kind_cost)):
        head[kind] = tail[kind] = kind_begin[kind]
    kind = np.int64(kinds[here])
    costs[here], queue[tail[kind]] = 0, here
    tail[kind] += 1
    heap_size = push(heap_cost, heap_cell, heap_size, now, kind)
    while heap_size > 0:
        now, due = heap_cost[0], np.int64(heap_cell[0])
        heap_size = pop(heap_cost, heap_cell, heap_size)
        end = tail[due]
        while head[due] < end and costs[queue[head[due]]] == now:
            at = np.int64(queue[head[due]])
            head[due] += 1
            for side in range(4):
                cell = np.int64(near[at, side])
                if costs[cell] == NONE:
                    kind = np.int64(kinds[cell])
                    cost = now + kind_cost[kind]
                    costs[cell], queue[tail[kind]] = cost, cell
                    # Its queue was empty, so this cell is its first: it enters the heap.
                    if head[kind] == tail[kind] and kind != due:
                        heap_size = push(heap_cost, heap_cell, heap_size, cost, kind)
                    tail[kind] += 1
        if head[due] < tail[due]:
            heap_size = push(heap_cost, heap_cell, heap_size, np.int64(costs[queue[head[due]]]), due)
    costs[len(near)] = NONE


@kernel
def row_if_asked(t, s, w, here):
    """Index of the row from `here` if it is cached or has been asked for often enough, else NONE."""
    if w.row_of[here] == NONE and w.asked[here] < t.patience:
        w.asked[here] += np.uint8(1)
        return np.int64(NONE)
    return row_from(t, s, w, here)


@kernel
def last_cost(w, cell):
    """Cost of a cell by the last answer, of a row or a search; NONE if it has none."""
    if w.last[0] != NONE:
        return np.int64(w.rows[w.last[0], cell])
    return w.distance[cell] if w.seen[cell] == w.stamp[0] else np.int64(NONE)


@kernel
def walk_back(t, s, w, here, target, leg):
    """Write the last answer's path from `here` to `target` into `leg` `[A]`, last cell first; returns its moves."""
    steps, cell, entry = 0, np.int64(target), s.entry if t.learns else t.entry
    while cell != here:
        leg[steps] = cell
        steps += 1
        # Neighbours increase in index, so the first that fits is the lowest: the tie of SPEC section 3.
        before = last_cost(w, cell) - entry[cell]
        for side in range(4):
            other = np.int64(t.near[cell, side])
            if last_cost(w, other) == before:
                cell = other
                break
    return steps


# Costs, nearest cells and legs, from all-pairs tables or by searches.
#
# `cost_to` and the other tables are empty where distances are searched for; `entry` and `legs` are empty where there
# are tables. A search gives the same result as the tables, ties included (SPEC section 3).


@kernel
def cheapest_cell(costs, s, area):
    """The area's cell of least cost in `costs` `[A]`, lowest index first; NONE if it cannot be reached.

    The area's cells increase, and either all or none of them are reachable.
    """
    return cheapest_of(costs, s.order, np.int64(s.areas[area].begin), np.int64(s.areas[area].end))


@search
def cheapest_of(costs, order, begin, end):
    """`cheapest_cell` of arrays."""
    best = np.int64(order[begin])
    least = costs[best]
    # An area is connected: if one cell cannot be reached, none can.
    if least < 0:
        return np.int64(NONE)
    for place in range(begin + 1, end):
        cell = order[place]
        if costs[cell] < least:
            best, least = np.int64(cell), costs[cell]
    return best


@rare_kernel
def entry_of(t, s, w, robot, area):
    """The cheapest cell of an area that the robot can reach."""
    here = s.robots[robot].cell
    if not t.searches:
        row = own(t, robot, here)
        cell = np.int64(t.area_entry[row, s.areas[area].root])
        return cell if np.int64(s.home[cell]) >> AREA_BITS == area else cheapest_cell(t.cost_to[row], s, area)
    if w.row_of[here] != NONE:
        return cheapest_cell(w.rows[row_from(t, s, w, here)], s, area)
    return seek(t, s, w, here, any_of(area), np.int64(NONE))


@kernel
def set_out(t, s, w, robot, target, searched):
    """Begin a leg: along the tables, or (`searched`) along the last answer's path from the robot's cell."""
    robots = s.robots
    here, ahead = robots[robot].cell, 0
    robots[robot].target = robots[robot].next = target
    if here != target:
        if searched:
            ahead = walk_back(t, s, w, here, target, s.legs[robot]) - 1
            robots[robot].next = s.legs[robot, ahead]
        else:
            # By target: a whole leg reads one row of the table.
            robots[robot].next = t.hop_to[own(t, robot, target), here]
    robots[robot].ahead, robots[robot].path = ahead, 0


@kernel
def go_on(t, s, w, robot):
    """Set the next cell of a robot on its leg."""
    robots = s.robots
    ahead = robots[robot].ahead
    if ahead == 0:
        robots[robot].next = t.hop_to[own(t, robot, robots[robot].target), robots[robot].cell]
    else:
        robots[robot].ahead = ahead - 1
        path = robots[robot].path
        robots[robot].next = s.legs[robot, ahead - 1] if path == 0 else w.paths[w.ends[path] - ahead]


@kernel
def list_to_do(s, robot):
    """Mark the area's unvisited cells as cells to do of the robot."""
    area, left = s.robots[robot].area, 0
    for place in range(s.areas[area].begin, s.areas[area].end):
        cell = s.order[place]
        if s.home[cell] & VISITED == 0:
            s.home[cell] |= TO_DO
            left += 1
    s.robots[robot].left = left


@kernel
def to_do_in(area):
    """`home >> 2` of a cell to do in the area: the flags VISITED and SURVIVED are shifted out."""
    return np.int64(area) << 1 | 1


@kernel
def next_leg(t, s, w, how, robot):
    """Begin the leg to the cheapest cell to do, lowest index first; an adjacent one, by its side, is cheapest."""
    robots = s.robots
    if how.in_area:
        set_out_by_order(t, s, w, how, robot)
        return
    # All cells of an area cost the same to enter, so no cell is cheaper than a neighbour.
    cell = adjacent(t, s, robots[robot].cell, to_do_in(robots[robot].area))
    if cell != NONE:
        robots[robot].target = robots[robot].next = cell
    else:
        set_out_far(t, s, w, how, robot)


@rare_kernel
def set_out_by_order(t, s, w, how, robot):
    """Begin the leg to the first cell by a user's order; as Python only."""
    here, area = s.robots[robot].cell, s.robots[robot].area
    w.last[0] = NONE
    seek_near(t, s, w, here, one_cell(NONE), area if how.stay_inside else NONE, len(t.near))
    cells = s.order[s.areas[area].begin : s.areas[area].end]
    to_do = [int(cell) for cell in cells if s.home[cell] & TO_DO and cell != here]
    set_out(t, s, w, robot, min(to_do, key=lambda cell: how.in_area(here, cell, int(last_cost(w, cell)))), True)


@kernel
def adjacent(t, s, here, wanted):
    """The first neighbour of `here`, by the sides' order, that matches `wanted` (`to_do_in`); NONE if none does."""
    for side in range(4):
        cell = np.int64(t.sweep[here, side])
        if np.int64(s.home[cell]) >> 2 == wanted:
            return cell
    return np.int64(NONE)


@rare_kernel
def set_out_far(t, s, w, how, robot):
    """Begin the leg to the cheapest cell to do if none is adjacent."""
    here, area = s.robots[robot].cell, np.int64(s.robots[robot].area)
    if not t.walks:
        set_out(t, s, w, robot, look_up_nearest(t, s, own(t, robot, here), area), False)
    else:
        set_out(t, s, w, robot, search_nearest(t, s, w, how, here, area), True)


@kernel
def look_up_nearest(t, s, row, area):
    """The cheapest cell of the area to do, from a row of the tables.

    In a safe area the cells ranked by cost are tried first; dangerous cells come after too many safe ones.
    """
    if s.areas[area].level == 0:
        wanted = to_do_in(area)
        for place in range(t.ranked.shape[1]):
            cell = t.ranked[row, place]
            if np.int64(s.home[cell]) >> 2 == wanted:
                return np.int64(cell)
    best, least = NONE, FAR
    for place in range(s.areas[area].begin, s.areas[area].end):
        cell = s.order[place]
        if s.home[cell] & TO_DO and t.cost_to[row, cell] < least:
            best, least = np.int64(cell), np.int64(t.cost_to[row, cell])
    return best


@kernel
def search_nearest(t, s, w, how, here, area):
    """The same by a search, inside the area if legs stay there."""
    return seek(t, s, w, here, to_do_of(area), area if how.stay_inside else np.int64(NONE))
