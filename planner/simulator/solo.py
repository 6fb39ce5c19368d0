"""Steps in which only one robot can act: most rollouts end with many of them.

The general loop (`planner.simulator.step`) takes every decision. These loops only move the robot until a decision is
due: a possible loss, or the end of an area, a leg or the robot's range.
"""

import numpy as np

from .codes import COVERING, FOLLOWING, NONE, TRAVELING
from .failure_sampling import fresh
from .jit import kernel
from .paths import adjacent, go_on, next_leg, set_out_far, to_do_in
from .replanning import notices, visits_other_area
from .robot_types import own
from .state import AREA_BITS, ONE, SURVIVED, TO_DO, VISITED, lowest_bit
from .visits import count_new


@kernel
def only_moving_robot(t, p, s, log):
    """The only robot that can act until the next loss; NONE if several can, or none.

    Also NONE where the general loop has to see every step: several speeds or types, a trace, counted survived visits,
    moving or changing threats, online map updates, return to base.
    """
    bits = s.moving[0]
    # bits & (bits - 1) removes the lowest bit: 0 if it was the only one. One word of robots serves most teams.
    alone = bits != 0 and bits & (bits - ONE) == 0 and (s.marks.open == 0 or s.waiting[0] == 0)
    noted = len(log.frames) > 0 or len(s.passes) > 0 or t.moving or t.learns
    differ = t.paced or t.mixed or t.phased
    if not alone or len(s.moving) != 1 or noted or t.returns or differ:
        return np.int64(NONE)
    if p is not None and len(p.most) > 0 and s.waiting[0] != 0:  # a held robot asks again in every step
        return np.int64(NONE)
    robot = np.int64(lowest_bit(bits))
    return robot if s.robots[robot].doing != FOLLOWING else np.int64(NONE)


@kernel
def survives_visit(t, s, how, robot, cell):
    """Whether the robot survives the dangerous cell in the whole group; then its hazard includes the visit."""
    # A cell visited but not survived may be survived for the first time: the general loop counts that.
    if t.uncertain or how.first_only or s.home[cell] & (VISITED | SURVIVED) == VISITED:
        return False
    # The cumulative hazard decides: below the lowest threshold of the group no word is drawn.
    cumulative_hazard = s.robots[robot].cumulative_hazard + t.exposure[own(t, robot, cell)]
    if fresh(t, robot, cumulative_hazard) >= s.robots[robot].least_threshold:
        return False
    s.robots[robot].cumulative_hazard = cumulative_hazard
    return True


@kernel
def walk_path(t, s, c, w, how, robot, step, size):
    """Move the robot under the paper's rule until something else can happen.

    Args:
        step: the last step that is over.
        size: rollouts of the group.

    Returns:
        The last step that is over: the next may bring a loss, or the end of an area or of a path.
    """
    # Values that change in every step are kept in registers, and written back before they are read elsewhere.
    me = s.robots[robot]
    covering, left, wanted = me.doing == COVERING, np.int64(me.left), to_do_in(me.area)
    here, cell, target = np.int64(me.cell), np.int64(me.next), np.int64(me.target)
    stop, kept = min(how.max_steps, s.robots[robot].until), me.path > 0
    ahead, end = np.int64(me.ahead) if kept else 0, w.ends[me.path] if kept else 0
    while step + 1 < stop:
        home = np.int64(s.home[cell])
        arrives = cell == target
        fresh = home & VISITED == 0
        # The end of a path, an area or a range is a decision: the general loop takes it.
        if (arrives and (not covering or left == 1)) or (fresh and s.areas[home >> AREA_BITS].left == 1):
            break
        if t.bound[own(t, robot, cell)] > 0 and not survives_visit(t, s, how, robot, cell):
            break
        if fresh:
            s.areas[home >> AREA_BITS].left -= 1
            home |= VISITED | SURVIVED
            count_new(s, c, step + 1, cell, size)
        step += 1
        c.visits[cell] += size
        here = cell
        if arrives:
            s.home[cell] = home ^ TO_DO
            left -= 1
            cell = target = adjacent(t, s, here, wanted)
            if cell != NONE:
                continue
            me.cell = here
            set_out_far(t, s, w, how, robot)
            target = np.int64(me.target)
        else:
            s.home[cell] = home
            if ahead > 0:
                cell = np.int64(w.paths[end - ahead])
                ahead -= 1
                continue
            me.cell = here
            go_on(t, s, w, robot)
        cell = np.int64(me.next)
    if kept:
        me.ahead = ahead
    me.cell, me.next, me.target, me.left = here, cell, target, left
    return step


@kernel
def walk_watching(t, p, s, c, w, how, robot, step, size):
    """Move the robot under a rule that re-evaluates, over safe cells, until something else can happen.

    Returns:
        The last step that is over: the next may bring a danger, the end of an area, or a re-evaluation.
    """
    me, stop = s.robots[robot], min(how.max_steps, s.robots[robot].until)
    while step + 1 < stop and not notices(t, p, s, robot):
        cell, arrives = np.int64(me.next), me.next == me.target
        home = np.int64(s.home[cell]) & ~TO_DO
        if t.bound[own(t, robot, cell)] > 0 or (arrives and me.doing == TRAVELING):
            break
        if home & VISITED == 0:
            if s.areas[home >> AREA_BITS].left == 1:
                break
            s.areas[home >> AREA_BITS].left -= 1
            s.marks.changes += visits_other_area(s, robot, cell)
            home |= VISITED | SURVIVED
            count_new(s, c, step + 1, cell, size)
        step += 1
        c.visits[cell] += size
        s.home[cell], me.cell = home, cell
        if arrives:
            next_leg(t, s, w, how, robot)
        else:
            go_on(t, s, w, robot)
    return step


@kernel
def walk_alone(t, p, s, c, w, how, robot):
    """Move the only robot that can act until a decision is due; returns the last step that is over."""
    step, size = s.marks.step, s.marks.last - s.marks.first
    if p is None:
        return walk_path(t, s, c, w, how, robot, step, size)
    return walk_watching(t, p, s, c, w, how, robot, step, size)
