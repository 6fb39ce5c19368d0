"""Steps in which one robot alone can do something: most rollouts end with many of them.

The general loop (`planner.simulator.step`) takes every decision. Here a robot only moves, until one is due: a possible
loss, the end of an area, of a leg or of its range.
"""

from __future__ import annotations

import numpy as np

from .codes import NONE
from .failure_sampling import fresh
from .jit import kernel
from .paths import adjacent, go_on, next_leg, set_out_far, to_do_in
from .replanning import is_news, notices
from .robot_types import own
from .state import AREA_BITS, COVERING, FOLLOWING, ONE, SURVIVED, TO_DO, TRAVELING, VISITED, lowest_bit
from .visits import count_new


@kernel
def only_mover(t, p, s, log):
    """The only robot that can act until the next loss; NONE if several can, or none.

    Also NONE where every step matters: robots differ in speed or type, a trace or survived visits are kept, threats
    move or change, robots learn or return to base.
    """
    bits = s.movers[0]
    # bits & (bits - 1) takes the lowest bit away: 0 if it was the only one. One word of robots is enough for most
    # teams.
    alone = bits != 0 and bits & (bits - ONE) == 0 and (s.marks.open == 0 or s.waiting[0] == 0)
    noted = len(log.frames) > 0 or len(s.passes) > 0 or t.moving or t.learns
    differ = t.paced or t.mixed or t.phased
    if not alone or len(s.movers) != 1 or noted or t.returns or differ:
        return np.int64(NONE)
    if p is not None and len(p.most) > 0 and s.waiting[0] != 0:  # a robot that is held asks in every step
        return np.int64(NONE)
    robot = np.int64(lowest_bit(bits))
    return robot if s.robots[robot].doing != FOLLOWING else np.int64(NONE)


@kernel
def bears(t, s, how, robot, cell):
    """Whether no rollout of the group loses the robot in the dangerous cell; its hazard then includes the visit."""
    # Where only robots that were lost have been, a further visit may be the first that a robot survives.
    if t.doubtful or how.first_only or s.home[cell] & (VISITED | SURVIVED) == VISITED:
        return False
    # The cumulative hazard decides, not this visit: below the lowest threshold of the group no word is drawn.
    borne = s.robots[robot].borne + t.exposure[own(t, robot, cell)]
    if fresh(t, robot, borne) >= s.robots[robot].bears:
        return False
    s.robots[robot].borne = borne
    return True


@kernel
def walk_path(t, s, c, w, how, robot, step, size):
    """The last of the steps after `step` in which the robot only moves, and no other robot acts.

    It stops before anything else can happen: a loss, the end of an area or of a path.
    """
    # What changes at every step is kept in registers, and written back where somebody else reads it.
    me = s.robots[robot]
    covering, left, wanted = me.doing == COVERING, np.int64(me.left), to_do_in(me.area)
    here, cell, target = np.int64(me.cell), np.int64(me.next), np.int64(me.target)
    stop, kept = min(how.max_steps, s.robots[robot].until), me.path > 0
    ahead, end = np.int64(me.ahead) if kept else 0, w.ends[me.path] if kept else 0
    while step + 1 < stop:
        home = np.int64(s.home[cell])
        arrives = cell == target
        fresh = home & VISITED == 0
        # The end of a path, of an area or of a range is a decision: the full loop takes it.
        if (arrives and (not covering or left == 1)) or (fresh and s.areas[home >> AREA_BITS].left == 1):
            break
        if t.bound[own(t, robot, cell)] > 0 and not bears(t, s, how, robot, cell):
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
    """The last of the steps after `step` in which the robot only moves over safe cells, and no other robot acts.

    It stops before anything else can happen, or has to be noticed.
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
            s.marks.changes += is_news(s, robot, cell)
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
    """Let the only robot that can do something move until a decision is due; the last step that is over by then."""
    step, size = s.marks.step, s.marks.last - s.marks.first
    if p is None:
        return walk_path(t, s, c, w, how, robot, step, size)
    return walk_watching(t, p, s, c, w, how, robot, step, size)
