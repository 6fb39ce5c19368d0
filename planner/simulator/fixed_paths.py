"""The turn of a robot under the paper's rule: one path per area, followed to its end (Algorithms 2 and 3).

A robot travels to the cheapest cell of its area, visited or not. It then covers the cells that were unvisited when it
arrived.
"""

import numpy as np

from .areas import ALLOCATED_EVENT, find_next_area, give, has_area, moves_on, note, share, waits
from .codes import (
    CHARGING,
    COVERING,
    DONE,
    FOLLOWING,
    IDLE,
    LANDING,
    MOVES,
    NO_ROOM,
    NONE,
    RESTS,
    RETURNING,
    STARTING,
    TRAVELING,
)
from .jit import kernel, rare_kernel
from .map_belief import is_lost
from .paths import entry_of, go_on, list_to_do, next_leg, set_out, to_do_in
from .return_home import cache_path, can_be_cached, charge, may_recharge, start_return, turns
from .robot_types import drives_back
from .state import AREA_BITS, SURVIVED, TO_DO, VISITED


@kernel
def take_next_area(t, s, w, log, robot):
    """`Allocate Next Area` (Algorithm 2); returns whether the robot got one."""
    if s.marks.open == 0:
        return False
    area, cell = t.asks.area(t, s, w, robot)[:2] if t.asks else find_next_area(t, s, w, robot)
    if area == NONE:
        return False
    give(s, robot, area)
    set_out(t, s, w, robot, cell, t.searches)
    note(log, s, robot, ALLOCATED_EVENT, area, cell)
    return True


@rare_kernel
def should_recharge(t, s, w, robot):
    """Whether the robot should recharge: it may, and an area is open to it if its range is ignored."""
    if not may_recharge(t, s, robot):
        return False
    # The search runs without the range limit; the flag is reset at once.
    s.marks.unlimited = 1
    area, _ = find_next_area(t, s, w, robot)
    s.marks.unlimited = 0
    return area != NONE


@rare_kernel
def after_move(t, s, w, log, how, robot):
    """Decide at the end of a path or leg, or while waiting; all decisions fall in the same step.

    Returns:
        GAINS if the robot got an area, RESTS if not, NO_ROOM if the area registry is full.
    """
    robots = s.robots
    got = 0
    while True:
        doing = robots[robot].doing
        if doing == LANDING:
            robots[robot].doing = IDLE
            waits(t, s, robot)
            return got
        if doing == STARTING:
            robots[robot].doing = TRAVELING
            target = entry_of(t, s, w, robot, robots[robot].area)
            set_out(t, s, w, robot, target, t.searches)
        if doing in (STARTING, TRAVELING):
            if robots[robot].cell != robots[robot].target:
                return got
            robots[robot].doing = COVERING
            # Before the cells are marked: of a cached path only the last cell is marked as to do.
            if can_be_cached(s, w, robot) and cache_path(t, s, w, robot):
                return got
            list_to_do(s, robot)
        if doing not in (IDLE, DONE) and robots[robot].left > 0:
            next_leg(t, s, w, how, robot)
            return got
        if take_next_area(t, s, w, log, robot):
            got = 1
        elif doing in (IDLE, DONE):
            if t.returns and should_recharge(t, s, w, robot):
                start_return(t, s, w, log, robot, True)
            return got
        else:
            shared = share(t, s, w, log, robot)
            if shared == NONE:
                return NONE
            if shared == 0:
                robots[robot].doing = DONE
                if t.returns and should_recharge(t, s, w, robot):
                    start_return(t, s, w, log, robot, True)
                else:
                    waits(t, s, robot)
                return got
            got = 1
        if doing in (IDLE, DONE):
            moves_on(t, s, robot)


@rare_kernel
def repair_plan(t, s, w, log, how, robot):
    """After a map update: a robot with no cells left decides, one with a changed path replans. Returns as
    `after_move`."""
    me = s.robots[robot]
    area = np.int64(me.area)
    if s.areas[area].left == 0:
        me.doing, me.left = COVERING, 0
    elif not is_lost(s, w, robot):
        return 0
    elif me.doing == TRAVELING:
        set_out(t, s, w, robot, entry_of(t, s, w, robot, area), True)
    else:
        # Cells may have left the area: all marks are cleared, and set again.
        for place in range(s.areas[area].begin, s.areas[area].end):
            s.home[s.order[place]] &= VISITED | SURVIVED | np.int64(-1) << AREA_BITS
        list_to_do(s, robot)
        next_leg(t, s, w, how, robot)
        return 0
    return after_move(t, s, w, log, how, robot)


@kernel
def act(t, s, w, log, how, robot):
    """The robot's turn up to its move: MOVES, RESTS, GAINS (an area, no move), or NO_ROOM."""
    me = s.robots[robot]
    if t.returns:
        if me.doing == CHARGING:
            s.marks.progress = 1
            if not charge(t, s, log, robot, s.marks.step):
                return RESTS
            me.doing, me.left = COVERING, 0  # decides like a robot that has covered its area
            return after_move(t, s, w, log, how, robot)
        if s.marks.step > 0 and has_area(s.robots, robot):
            turn_kind = turns(t, s, robot, s.marks.step)
            if turn_kind > 0:
                if not start_return(t, s, w, log, robot, turn_kind > 1):
                    return NO_ROOM
                if me.doing != RETURNING:
                    return RESTS
    if (me.doing == IDLE or me.doing == DONE) and not drives_back(t, s, robot):
        return after_move(t, s, w, log, how, robot)
    return MOVES


@kernel
def arrive(t, s, w, log, how, robot, cell):
    """Continue after the robot entered the cell: it MOVES on along its path, or decides as `after_move` does."""
    me = s.robots[robot]
    if t.follows and me.doing == FOLLOWING:
        if s.marks.step < t.length[robot]:
            me.next = t.given[robot, s.marks.step + 1]
            return MOVES
    elif cell != me.target:
        go_on(t, s, w, robot)
        # Under a user's order a leg may cross other cells to do; under the paper's it never does.
        if how.in_area and np.int64(s.home[cell]) >> 2 == to_do_in(me.area):
            s.home[cell] ^= TO_DO
            me.left -= 1
        return MOVES
    if me.doing == COVERING:
        # The target of a coverage leg is always a cell to do.
        s.home[cell] ^= TO_DO
        me.left -= 1
        if me.left > 0:
            next_leg(t, s, w, how, robot)
            return MOVES
    return after_move(t, s, w, log, how, robot)
