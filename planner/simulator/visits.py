"""What a visit changes: cells covered and survived, areas completed, a robot lost.

Part of `planner.simulator.rollouts`, which see.
"""

from __future__ import annotations

import numpy as np

from .areas import COMPLETED_EVENT, HIT_EVENT, close, has_area, note
from .codes import NONE
from .failure_sampling import stopped_from
from .jit import kernel, rare_kernel
from .map_belief import visit_of
from .return_home import leave
from .state import (
    ACTS,
    ALL_ROBOTS_LOST,
    AREA_BITS,
    AT_STOP,
    COMPLETE,
    CUT,
    DEAD,
    FAR,
    FOLLOWING,
    HIT,
    MOST_COUNTED,
    PARTED,
    PASSED,
    SURVIVED,
    VISITED,
    drop,
    holds,
    put,
)


@kernel
def count_new(s, c, step, cell, size):
    """The cell has not been visited before this step."""
    c.new[step] += size
    c.covered[cell] += size
    s.marks.covered += 1


@kernel
def visit(s, c, log, step, robot, cell, size, flags):
    """The cell, which was not visited, is; the last one of an area completes it."""
    home = np.int64(s.home[cell])
    s.home[cell] = home | flags
    count_new(s, c, step, cell, size)
    holder = np.int64(home) >> AREA_BITS
    left = s.areas[holder].left - 1
    s.areas[holder].left = left
    if left == 0:
        s.marks.unfinished -= 1
        close(s, holder)
        note(log, s, robot, COMPLETED_EVENT, holder, cell)


@kernel
def count_pass(s, cell):
    """A robot was in the cell and was not stopped."""
    if len(s.passes) > 0 and s.passes[cell] < MOST_COUNTED:
        s.passes[cell] += np.uint16(1)


@kernel
def is_complete(t, s):
    """Whether every cell that can truly be reached is visited."""
    return s.marks.covered == t.goal if t.learns else s.marks.unfinished == 0


@rare_kernel
def count_scores(s, c, covered, size):
    """Add the cells covered by a history of so many rollouts, times its losses and its passes, by cell."""
    weight, cells = float(covered) * size, len(c.passes)
    for cell in range(cells):
        c.passes[cell, 0] += weight * s.passes[cells + cell]
        c.passes[cell, 1] += weight * s.passes[cell]


@kernel
def count_last(t, s, c, cell, mass):
    """Add so much of a tree's branch at the stop of the last robot alive."""
    marks = s.marks
    covered, safely = marks.covered, marks.covered - marks.unsurvived
    c.stops[cell] += mass
    if t.scores:
        count_scores(s, c, covered, mass)
        c.passes[cell, 0] += float(covered) * mass
    c.visited[covered] += mass
    c.survived[safely] += mass
    c.time[marks.step] += mass
    c.alive[0] += mass
    if len(c.home) > 0:
        c.home[0] += mass
    c.outcomes[COMPLETE if is_complete(t, s) else ALL_ROBOTS_LOST] += mass


@kernel
def leave_branch(s, c, mass, alive):
    """Leave so much of a tree's branch: what it has come to by now is certain, and no more."""
    c.left_visited[s.marks.covered] += mass
    c.left_survived[s.marks.covered - s.marks.unsurvived] += mass
    c.left_alive[alive] += mass
    c.histories[1] += 1


@rare_kernel
def prune(t, s, c, how, cell, hit_from):
    """A tree's branch of which as much as is behind `hit_from` is stopped: PARTED, or what goes on of it: PASSED, HIT.

    CUT: nothing does. What is left of the branch stays at the end of its mass.
    """
    marks = s.marks
    stopped, rest = marks.last - hit_from, hit_from - marks.first
    least = how.cut if c.histories[0] + c.histories[1] < how.most else FAR
    if marks.alive == 1:
        # Nobody is left whom it would matter to: the one path goes on, with what is left of the mass.
        count_last(t, s, c, cell, stopped)
        stopped = 0
    elif stopped < least:
        leave_branch(s, c, stopped, marks.alive - 1)
        stopped = 0
    if rest < least:
        leave_branch(s, c, rest, marks.alive)
        rest = 0
    if stopped > 0 and rest > 0:
        return PARTED
    marks.first = marks.last - stopped - rest
    if stopped == rest:
        return CUT
    return PASSED if rest > 0 else HIT


@kernel
def enter(t, s, c, w, log, how, ids, robot, cell):
    """Move into the cell: HIT or PASSED, ACTS if there is no danger; PARTED, since some of the set are hit; or CUT."""
    marks, step = s.marks, s.marks.step
    size = marks.last - marks.first
    s.robots[robot].cell = cell
    # The set is one run for all its rollouts: what one of them does is done `size` times.
    c.visits[cell] += size
    fresh = s.home[cell] & VISITED == 0
    place = visit_of(t, s, robot, cell)
    safe = t.bound[place] == 0
    # Where threats change, a robot may have been stopped in what is safe by now.
    verdict = ACTS if safe and not t.phased else PASSED
    survives = verdict == ACTS and not t.moving
    if survives:
        count_pass(s, cell)
    elif t.moving:
        put(s.entered, robot)
    if fresh:
        visit(s, c, log, step, robot, cell, size, VISITED | SURVIVED if survives else VISITED)
        if not survives:
            # Marked before the check, as Algorithm 2 does: visited at once, survived only if it is (`survive`).
            c.late[step] -= size
            c.unsurvived[cell] += size
            marks.unsurvived += 1
    elif survives and s.home[cell] & SURVIVED == 0:  # a robot of another type was stopped there
        mark_survived(s, c, cell)
    if not safe and (fresh or not how.first_only) and not (t.spends and holds(s.spent, cell)):
        hit_from = stopped_from(t, s, c, w, how, ids, robot, cell, place)
        # All of them are hit alike: still one run, so nothing has to be copied.
        if hit_from == marks.first and how.aside == 0:
            verdict = HIT
        elif hit_from < marks.last:
            verdict = PARTED if how.cut == 0 else prune(t, s, c, how, cell, hit_from)
            if verdict == PARTED:
                marks.robot, marks.last, marks.progress = robot, hit_from, 1
    return verdict


@rare_kernel
def lose(t, s, c, w, log, robot):
    """The robot is stopped in its cell, and what it leaves unvisited of its area becomes areas. False: no room.

    If it is the last one nobody will take them: they are only made to be written down.
    """
    cell, area = s.robots[robot].cell, np.int64(s.robots[robot].area)
    owns, followed = has_area(s.robots, robot), s.robots[robot].doing == FOLLOWING
    c.stops[cell] += s.marks.last - s.marks.first
    if t.scores:
        s.passes[len(s.passes) // 2 + cell] += np.uint16(1)
    if t.spends:
        put(s.spent, cell)
    if t.estimates:
        s.odds[cell] = t.lessons[AT_STOP]
    s.marks.alive -= 1
    drop(s.movers, robot)
    drop(s.waiting, robot)
    s.robots[robot].doing = DEAD
    if t.mixed:
        s.marks.changes += 1  # prices depend on the types of the robots alive
    note(log, s, robot, HIT_EVENT, area if owns else NONE, cell)
    # Nobody is left to take what it leaves.
    if s.marks.alive == 0 and len(log.events) == 0:
        return True
    if followed:
        # Another planner's robot owns all areas of its path, not only the one that it is in.
        for left in range(len(t.owner)):
            unfinished = t.owner[left] == robot and s.areas[left].left > 0
            if unfinished and not leave(t, s, w, log, robot, left):
                return False
    return not owns or leave(t, s, w, log, robot, area)


@kernel
def mark_survived(s, c, cell):
    """The cell, which was visited, is survived for the first time."""
    size = s.marks.last - s.marks.first
    s.home[cell] |= SURVIVED
    c.late[s.marks.step] += size
    c.unsurvived[cell] -= size
    s.marks.unsurvived -= 1


@kernel
def survive(s, c, cell):
    """A dangerous cell has been entered by a robot that was not stopped."""
    count_pass(s, cell)
    if s.home[cell] & SURVIVED == 0:
        mark_survived(s, c, cell)
