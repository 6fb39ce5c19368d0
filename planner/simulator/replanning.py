"""A robot of a rule that re-evaluates: it notices visits of other robots, and compares areas before each danger.

From t = 0 on a robot with an area is TRAVELING, its way known, and one without is IDLE. Its cells to do are the
unvisited ones of its area: a visit takes TO_DO from a cell (SPEC section 11).
"""

from __future__ import annotations

import numpy as np

from .areas import (
    ALLOCATED_EVENT,
    LOOKED_AGAIN_EVENT,
    REFUSED_EVENT,
    costs_from,
    give,
    has_area,
    moves_on,
    note,
    reopen,
    share_between,
    waits,
)
from .codes import NONE
from .jit import kernel, rare_kernel
from .map_belief import is_lost
from .next_area import first_area, first_of_idle, first_to_share, has_to_wait, head_for, is_full, see
from .offers import is_dangerous
from .paths import entry_of, go_on, list_to_do, next_leg, set_out
from .policy import is_danger, offer_of
from .return_home import charge, may_be_charged, turn_home, turns
from .robot_types import drives_back, hears
from .state import (
    AREA_BITS,
    CHARGING,
    COVERING,
    DONE,
    IDLE,
    MOVES,
    NO_ROOM,
    RESTS,
    RETURNING,
    STARTING,
    TRAVELING,
    VISITED,
    holds,
)


@kernel
def begin(t, s, w):
    """Before t = 0: a robot with an area knows the way to it. A mission from a state began before."""
    if s.marks.step > 0:
        return
    for robot in range(len(s.robots)):
        if s.robots[robot].doing == STARTING:
            s.robots[robot].doing = TRAVELING
            target = entry_of(t, s, w, robot, np.int64(s.robots[robot].area))
            set_out(t, s, w, robot, target, t.searches)
        else:
            s.robots[robot].doing = IDLE


@kernel
def moves(t, s, robot):
    """The robot has got an area, from which nothing holds it any more."""
    s.robots[robot].held = 0
    moves_on(t, s, robot)


@kernel
def settle_on(t, p, s, robot, area):
    """The area is the robot's first choice. An area of one cell stays so until another area becomes unassigned.

    A step on the way of cost e makes the area cheaper by e, others by e at most, and by less per cell where they have
    more cells; what others visit makes none better. Where areas are refused one may be accepted from nearby.
    """
    # Of a robot that returns to base the areas within its range change by themselves.
    sure = p.by_price and not (p.limited or p.breaks_off or t.returns)
    stays_first = sure and len(p.value) == 0 and s.areas[area].left == 1
    s.robots[robot].sure = s.marks.arrivals if stays_first else NONE


@kernel
def take(t, p, s, w, log, robot, area, target):
    give(s, robot, area)
    settle_on(t, p, s, robot, area)
    moves(t, s, robot)
    head_for(t, s, w, robot, target)
    note(log, s, robot, ALLOCATED_EVENT, area, target)


@rare_kernel
def would_be_charged(t, p, s, w, robot):
    """Whether there is an area for the robot, if it is charged."""
    if not may_be_charged(t, s, robot):
        return False
    s.marks.unlimited = 1
    area, _, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    s.marks.unlimited = 0
    return area != NONE


@rare_kernel
def share_or_rest(t, p, s, w, log, robot):
    """`Find Area To Share`, else done: 1 if the robot got a part, 0 if not, NONE if there is no room."""
    owner, cost = first_to_share(t, p, s, w, robot)
    limited = owner != NONE and len(p.most) > 0
    if limited and is_dangerous(offer_of(t, p, s, robot, s.robots[owner].area, cost), p.cells):
        held = s.robots[robot].held or is_full(t, p, s, robot)
        s.robots[robot].held = held
        owner = NONE if held else owner
    if owner != NONE:
        if share_between(t, s, w, log, robot, owner, costs_from(t, s, w, robot)) == NONE:
            return NONE
        moves(t, s, robot)
        return 1
    if p.robot_value and not s.robots[robot].held and s.robots[robot].doing != DONE:
        area, target, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))
        if area != NONE:
            note(log, s, robot, REFUSED_EVENT, area, target)
    s.robots[robot].doing = DONE
    if t.returns and would_be_charged(t, p, s, w, robot):
        turn_home(t, s, w, log, robot, True)
    else:
        waits(t, s, robot)
    return 0


@rare_kernel
def allocate_next(t, p, s, w, log, robot, idle):
    """`Allocate Next Area`, else `Find Area To Share`, else done; answers as `share_or_rest`.

    `idle`: it has been without an area; unless it is held, it does not try to share again.
    """
    if t.asks:
        area, target, cost = t.asks.area(t, s, w, robot)
    elif idle:
        area, target, cost = first_of_idle(t, p, s, w, robot)
    else:
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    if area == NONE and idle and not s.robots[robot].held:
        if t.returns and would_be_charged(t, p, s, w, robot):
            turn_home(t, s, w, log, robot, True)
        return 0
    if area == NONE:
        return share_or_rest(t, p, s, w, log, robot)
    if has_to_wait(t, p, s, w, robot, area, cost):
        s.robots[robot].held = 1
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@rare_kernel
def look_again(t, p, s, w, log, robot):
    """Before a danger: another area may be better by now, or none worth it; answers as `share_or_rest`."""
    own = np.int64(s.robots[robot].area)
    if t.asks:
        area, target, cost = t.asks.area(t, s, w, robot, own)
    else:
        area, target, cost = first_area(t, p, s, w, robot, own, np.bool_(True))
    waits = p.breaks_off and area != NONE and has_to_wait(t, p, s, w, robot, area, cost)
    if area == own and not waits:
        settle_on(t, p, s, robot, own)
        return 0
    note(log, s, robot, LOOKED_AGAIN_EVENT, own, s.robots[robot].next)
    # Its own area goes back into the pool before it takes another: somebody else may want it.
    reopen(s, own)
    if waits:
        s.robots[robot].held = 1
    if area == NONE or waits:
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@kernel
def aim(t, s, w, how, robot):
    """On to the next target of its area, in which cells are left."""
    if s.robots[robot].doing == TRAVELING:
        costs = costs_from(t, s, w, robot)
        target, _ = see(t, s, costs, robot, np.int64(s.robots[robot].cell), np.int64(s.robots[robot].area))
        set_out(t, s, w, robot, target, t.searches)
    else:
        s.robots[robot].ahead = 0
        next_leg(t, s, w, how, robot)


@rare_kernel
def look_up(t, p, s, w, log, how, robot):
    """What the robot notices before it moves; answers as `share_or_rest`."""
    robots, got = s.robots, 0
    if s.areas[robots[robot].area].left == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    me = robots[robot]
    wary = p.looks_again and (p.breaks_off or me.doing == TRAVELING) and me.sure != s.marks.arrivals
    if wary and is_danger(t, p, s, robot, robots[robot].next) and hears(t, s, robot):
        got = look_again(t, p, s, w, log, robot)
        if got != 0 or not has_area(robots, robot):
            return got
    if s.home[robots[robot].target] & VISITED:
        aim(t, s, w, how, robot)
    return got


@rare_kernel
def end_leg(t, p, s, w, log, how, robot):
    """At the end of a way or leg: the next leg, or the next area; answers as `share_or_rest`."""
    robots = s.robots
    traveled = robots[robot].doing == TRAVELING
    robots[robot].doing = COVERING
    if s.areas[robots[robot].area].left == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    if traveled:
        list_to_do(s, robot)
    next_leg(t, s, w, how, robot)
    return 0


@rare_kernel
def arrive(t, p, s, w, log, how, robot, cell):
    """After the robot has entered the cell: its next leg, or its next area; answers as `share_or_rest`."""
    me = s.robots[robot]
    if s.marks.step > 0:
        if cell == me.target:
            return end_leg(t, p, s, w, log, how, robot)
        go_on(t, s, w, robot)
        return RESTS
    if me.doing == IDLE:
        waits(t, s, robot)
        return RESTS
    area = np.int64(me.area)
    if np.int64(s.home[cell]) >> AREA_BITS == area or s.areas[area].left == 0:
        return end_leg(t, p, s, w, log, how, robot)
    if s.home[me.target] & VISITED:
        aim(t, s, w, how, robot)
    return RESTS


@kernel
def notices(t, p, s, robot):
    """Whether something is to be looked at before the robot moves: an area without cells to do has no target either."""
    return s.home[s.robots[robot].target] & VISITED != 0 or is_danger(t, p, s, robot, s.robots[robot].next)


@kernel
def is_news(s, robot, cell):
    """Whether the robot, which enters the cell, visits one that is to do in another area than its own."""
    home = np.int64(s.home[cell])
    return home & VISITED == 0 and home >> AREA_BITS != s.robots[robot].area


@rare_kernel
def act(t, p, s, w, log, how, robot):
    """The robot's turn up to its move: MOVES, or RESTS, GAINS an area while it rests, NO_ROOM."""
    me, step, got = s.robots[robot], s.marks.step, RESTS
    if not holds(s.movers, robot):
        return MOVES if drives_back(t, s, robot) else allocate_next(t, p, s, w, log, robot, np.bool_(True))
    if t.returns and me.doing == CHARGING:
        s.marks.progress = 1
        if charge(t, s, log, robot, step):
            me.doing = IDLE
            got = allocate_next(t, p, s, w, log, robot, np.bool_(False))
        return got
    if step > 0 and me.doing != RETURNING and notices(t, p, s, robot):
        s.marks.now = 1
        got = look_up(t, p, s, w, log, how, robot)
        s.marks.now = 0
    if not holds(s.movers, robot):
        me.until += 1  # it has not moved in this step
        return got
    if t.returns and step > 0:
        how_turns = turns(t, s, robot, step) if has_area(s.robots, robot) else 0
        if how_turns > 0 and (got == NO_ROOM or not turn_home(t, s, w, log, robot, how_turns > 1)):
            return NO_ROOM
        if not holds(s.movers, robot) or me.doing == CHARGING:
            return got
    return NO_ROOM if got == NO_ROOM else MOVES


@rare_kernel
def set_right(t, p, s, w, log, how, robot):
    """After a map update: a robot with nothing left to do decides, one whose way is not as it was sets out anew."""
    if s.areas[s.robots[robot].area].left == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    if is_lost(s, w, robot):
        aim(t, s, w, how, robot)
    return 0
