"""Effects of a visit: cells covered and survived, areas completed, a robot lost."""

import numpy as np

from .areas import COMPLETED_EVENT, HIT_EVENT, close, has_area, note
from .codes import ACTS, ALL_ROBOTS_LOST, COMPLETE, CUT, DEAD, FOLLOWING, GROUP_SPLITS, HIT, NONE, PASSED
from .failure_sampling import first_lost
from .jit import kernel, rare_kernel
from .map_belief import visit_of
from .return_home import leave
from .state import AREA_BITS, AT_STOP, FAR, MOST_COUNTED, ONE, SURVIVED, VISITED, drop, holds, put


@kernel
def count_new(s, c, step, cell, size):
    """Count a cell that has not been visited before this step, in `size` rollouts."""
    c.new[step] += size
    c.covered[cell] += size
    s.marks.covered += 1


@kernel
def visit(s, c, log, step, robot, cell, size, flags):
    """Mark a cell visited for the first time; the last cell of an area completes the area."""
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
    """Count a visit of the cell that a robot survived."""
    if len(s.passes) > 0 and s.passes[cell] < MOST_COUNTED:
        s.passes[cell] += np.uint16(1)


@kernel
def deliver(t, s, robot, cell):
    """Deliver the cells that the robot has visited, if the cell, which it has survived, is one of its bases."""
    if t.returns and len(s.undelivered) > 0 and t.home_bases[t.home_of[robot], cell]:
        unload(s, s.undelivered[robot], s.undelivered[len(s.robots)])


@rare_kernel
def unload(s, undelivered, delivered):
    """Move cells from one set to another, counting those that it lacks."""
    for word in range(len(undelivered)):
        new = undelivered[word] & ~delivered[word]
        undelivered[word] = np.uint64(0)
        delivered[word] |= new
        while new != 0:  # each cell is delivered once
            new &= new - ONE
            s.marks.delivered += 1


@kernel
def is_complete(t, s):
    """Whether every cell that is reachable on the true map is visited."""
    return s.marks.covered == t.goal if t.learns else s.marks.unfinished == 0


@rare_kernel
def count_scores(s, c, covered, size):
    """Add a history's covered cells, times its losses and its survived visits, by cell; for `size` rollouts."""
    weight, cells = float(covered) * size, len(c.passes)
    for cell in range(cells):
        c.passes[cell, 0] += weight * s.passes[cells + cell]
        c.passes[cell, 1] += weight * s.passes[cell]


@kernel
def count_last(t, s, c, cell, mass):
    """Count the mass of a tree's branch in which the last robot alive is lost."""
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
    if len(c.delivered) > 0:
        c.delivered[marks.delivered] += mass
    c.outcomes[COMPLETE if is_complete(t, s) else ALL_ROBOTS_LOST] += mass


@kernel
def leave_branch(s, c, mass, alive):
    """Leave a branch of a tree: its present state is counted as a lower bound."""
    c.left_visited[s.marks.covered] += mass
    c.left_survived[s.marks.covered - s.marks.unsurvived] += mass
    c.left_alive[alive] += mass
    if len(c.left_delivered) > 0:
        c.left_delivered[s.marks.delivered] += mass
    c.histories[1] += 1


@rare_kernel
def prune(t, s, c, how, cell, lost_from):
    """Decide which parts of a tree's branch are followed at a visit.

    Args:
        lost_from: begin of the part of the mass that loses the robot.

    Returns:
        GROUP_SPLITS: both; PASSED, HIT: one, at the end of the branch's mass; CUT: none.
    """
    marks = s.marks
    lost, rest = marks.last - lost_from, lost_from - marks.first
    least = how.cut if c.histories[0] + c.histories[1] < how.most else FAR
    if marks.alive == 1:
        # No robot is left whose decisions a loss could change: the path goes on with the remaining mass.
        count_last(t, s, c, cell, lost)
        lost = 0
    elif lost < least:
        leave_branch(s, c, lost, marks.alive - 1)
        lost = 0
    if rest < least:
        leave_branch(s, c, rest, marks.alive)
        rest = 0
    if lost > 0 and rest > 0:
        return GROUP_SPLITS
    marks.first = marks.last - lost - rest
    if lost == rest:
        return CUT
    return PASSED if rest > 0 else HIT


@kernel
def enter(t, s, c, w, log, how, ids, step, robot, cell, size):
    """Move into the cell.

    Returns:
        ACTS if there is no danger, PASSED or HIT for all rollouts, GROUP_SPLITS if the group splits, or CUT.
    """
    marks = s.marks
    s.robots[robot].cell = cell
    # The group is one run: each event counts for all of its rollouts.
    c.visits[cell] += size
    fresh = s.home[cell] & VISITED == 0
    place = visit_of(t, s, robot, cell)
    safe = t.bound[place] == 0
    # Where threats change, a robot may have been lost earlier in a cell that is safe by now.
    verdict = ACTS if safe and not t.phased else PASSED
    survives = verdict == ACTS and not t.moving
    if t.returns and len(s.undelivered) > 0:
        put(s.undelivered[robot], cell)
    if survives:
        count_pass(s, cell)
        deliver(t, s, robot, cell)
    elif t.moving:
        put(s.entered, robot)
    if fresh:
        visit(s, c, log, step, robot, cell, size, VISITED | SURVIVED if survives else VISITED)
        if not survives:
            # Algorithm 2 marks before it checks: visited at once, survived only after the check (`survive`).
            c.late[step] -= size
            c.unsurvived[cell] += size
            marks.unsurvived += 1
    elif survives and s.home[cell] & SURVIVED == 0:  # a robot of another type was lost there
        mark_survived(s, c, step, cell, size)
    if not safe and (fresh or not how.first_only) and not (t.spends and holds(s.spent, cell)):
        lost_from = first_lost(t, s, c, w, how, ids, robot, cell, place)
        # All rollouts lose the robot: still one run, so no state is copied.
        if lost_from == marks.first and how.deferred == 0:
            verdict = HIT
        elif lost_from < marks.last:
            verdict = GROUP_SPLITS if how.cut == 0 else prune(t, s, c, how, cell, lost_from)
            if verdict == GROUP_SPLITS:
                marks.robot, marks.last, marks.progress = robot, lost_from, 1
    return verdict


@rare_kernel
def lose(t, s, c, w, log, robot):
    """Remove a lost robot; the unvisited cells of its area become areas. False: the area registry is full.

    After the last robot's loss no robot takes them: they are made for the trace only.
    """
    cell, area = s.robots[robot].cell, np.int64(s.robots[robot].area)
    owns, followed = has_area(s.robots, robot), s.robots[robot].doing == FOLLOWING
    c.stops[cell] += s.marks.last - s.marks.first
    if t.scores:
        s.passes[len(s.passes) // 2 + cell] += np.uint16(1)
    if t.spends:
        put(s.spent, cell)
    if t.estimates:
        s.odds[cell] = t.evidence[AT_STOP]
    s.marks.alive -= 1
    drop(s.moving, robot)
    drop(s.waiting, robot)
    s.robots[robot].doing = DEAD
    if t.mixed:
        s.marks.changes += 1  # prices depend on the types of the robots alive
    note(log, s, robot, HIT_EVENT, area if owns else NONE, cell)
    # No robot is left to take the cells.
    if s.marks.alive == 0 and len(log.events) == 0:
        return True
    if followed:
        # A robot on an external path owns all areas of its path, not only the current one.
        for left in range(len(t.owner)):
            unfinished = t.owner[left] == robot and s.areas[left].left > 0
            if unfinished and not leave(t, s, w, log, robot, left):
                return False
    return not owns or leave(t, s, w, log, robot, area)


@kernel
def mark_survived(s, c, step, cell, size):
    """Mark a visited cell as survived for the first time."""
    s.home[cell] |= SURVIVED
    c.late[step] += size
    c.unsurvived[cell] -= size
    s.marks.unsurvived -= 1


@kernel
def survive(t, s, c, step, robot, cell, size):
    """Count that the robot entered a dangerous cell and survived."""
    count_pass(s, cell)
    deliver(t, s, robot, cell)
    if s.home[cell] & SURVIVED == 0:
        mark_survived(s, c, step, cell, size)
