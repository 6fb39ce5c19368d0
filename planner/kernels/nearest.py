"""The nearest cell of a goal by a search, where there are no tables of distances, and the way to it.

Part of `planner.kernels.rollouts`, which see. A goal tells by a cell's area and flags whether it is looked for, so
that nothing has to be marked before a search. What is near is found by Dijkstra's algorithm in layers, what is far by
the planner's `planner.mrac.far_search`. Ties are those of SPEC section 3.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.bits import holds
from planner.kernels.state import AREA_BITS, AREAS, BEGIN, END, LEVEL, NEAR, SURVIVED, TO_DO, VISITED, WIDE
from planner.mrac.far_search import SafeParts, danger_ahead, far_search
from planner.mrac.heap import pop, push
from planner.mrac.search import TOO_FAR
from planner.none import NONE

ONE_CELL = -2
"""In the first place of a goal of one cell; NONE is there in that of the unassigned areas of a level."""


@kernel
def searches(t):
    """Whether there are no tables of distances: then there is `entry`, and where that is known not to be, no search."""
    return len(t.entry) > 0 and len(t.cost_to) == 0


@kernel
def any_of(area):
    """All cells of the area."""
    return np.int64(area) << AREA_BITS | VISITED | SURVIVED | TO_DO, np.int64(VISITED | SURVIVED | TO_DO)


@kernel
def to_do_of(area):
    """Those of its cells that are to do."""
    return np.int64(area) << AREA_BITS | VISITED | SURVIVED | TO_DO, np.int64(VISITED | SURVIVED)


@kernel
def open_at(level):
    """All cells of the unassigned areas of this level."""
    return np.int64(NONE), np.int64(level)


@kernel
def one_cell(cell):
    """That cell; NONE: none at all."""
    return np.int64(ONE_CELL), np.int64(cell)


@kernel
def is_goal(s, cell, goal):
    """Whether the cell is one of the goal's."""
    home = np.int64(s.home[cell])
    if goal[0] >= 0:
        return home | goal[1] == goal[0]
    if goal[0] == ONE_CELL:
        return cell == goal[1]
    area = home >> AREA_BITS
    return holds(s.open, area) and s.areas[area, LEVEL] == goal[1]


@kernel
def seek(t, s, w, here, goal, inside):
    """The nearest cell of the goal by (cost, area, index), NONE if none can be reached; `walk_back` then finds the way.

    `inside`: the area that a way may not leave, or NONE.
    """
    w.last[0] = NONE
    cell = seek_near(t, s, w, here, goal, inside, t.limits[NEAR] if inside == NONE else len(t.near))
    return seek_far(t, s, w, here, goal) if cell == TOO_FAR else cell


@rare_kernel
def seek_near(t, s, w, here, goal, inside, most):
    """The same; TOO_FAR if more than `most` cells have been passed before it was certain.

    Costs sit on the cells entered, so the first time a cell is met its distance is final: each is queued once. Cells
    one unit away (safe ones) go through a queue in layers, the others through a heap.
    """
    distance, seen, queue = w.distance, w.seen, w.queue
    near, entries = s.near if len(s.mind) > 0 else t.near, s.entry if len(s.mind) > 0 else t.entry
    w.stamp[0] += 1
    stamp, here = w.stamp[0], np.int64(here)
    distance[here], seen[here], seen[len(t.near)] = 0, stamp, stamp  # what is blocked is met already
    if is_goal(s, here, goal):
        return here
    best, best_cost, best_area, last_cost = np.int64(NONE), np.int64(0), np.int64(0), np.int64(0)
    queue[0], head, tail, heap_size, now = here, 0, 1, 0, np.int64(0)
    while head <= most:
        while heap_size > 0 and w.heap_cost[0] == now:
            queue[tail] = w.heap_cell[0]
            tail += 1
            heap_size = pop(w.heap_cost, w.heap_cell, heap_size)
        layer_end = tail
        while head < layer_end:
            at = np.int64(queue[head])
            head += 1
            for side in range(4):
                cell = np.int64(near[at, side])
                # A stamp instead of clearing: a search costs what it passes, not the size of the map.
                if seen[cell] == stamp or (inside != NONE and np.int64(s.home[cell]) >> AREA_BITS != inside):
                    continue
                seen[cell], entry = stamp, entries[cell]
                cost = now + entry
                distance[cell] = cost
                if (best == NONE or cost <= best_cost) and is_goal(s, cell, goal):
                    area = np.int64(s.home[cell]) >> AREA_BITS
                    if best == NONE or (cost, area, cell) < (best_cost, best_area, best):
                        best, best_cost, best_area, last_cost = cell, cost, area, entry
                if entry == 1:
                    queue[tail] = cell
                    tail += 1
                else:
                    heap_size = push(w.heap_cost, w.heap_cell, heap_size, cost, cell)
        if tail > layer_end:
            now += 1
        elif heap_size > 0:
            now = w.heap_cost[0]
        else:
            return best
        # Nothing that is still due can be as cheap, not even with a lower area or index.
        if best != NONE and now + last_cost > best_cost:
            return best
    return np.int64(TOO_FAR)


@rare_kernel
def seek_far(t, s, w, here, goal):
    """The same where it is far: safe components that lie between are passed as one."""
    count = mark_goal(s, w, goal)
    w.stamp[0] += 1
    parts = SafeParts(t.node, t.beside, t.border, t.limits[WIDE], w.to_go, w.touched)
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
    """List the goal's cells in `stack`, and rank them by area; returns how many."""
    count, last = 0, np.int64(s.marks[AREAS])
    if goal[0] == ONE_CELL:
        w.stack[0], w.rank[goal[1]] = goal[1], 0
        return 1
    first = np.int64(0)
    if goal[0] >= 0:
        first = goal[0] >> AREA_BITS
        last = first + 1
    for area in range(first, last):
        if goal[0] == NONE and not (holds(s.open, area) and s.areas[area, LEVEL] == goal[1]):
            continue
        for place in range(s.areas[area, BEGIN], s.areas[area, END]):
            cell = np.int64(s.order[place])
            if is_goal(s, cell, goal):
                w.stack[count], w.rank[cell] = cell, area
                count += 1
    return count
