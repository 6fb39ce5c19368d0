"""The turn of a robot of a rule that re-evaluates: it reacts to other robots' visits, and compares areas before danger.

From t = 0 on a robot with an area is TRAVELING, and one without is IDLE. Its cells to do are the unvisited cells of its
area: a visit removes TO_DO from a cell (SPEC section 11).
"""

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
from .codes import CHARGING, COVERING, DONE, IDLE, MOVES, NO_ROOM, NONE, RESTS, RETURNING, STARTING, TRAVELING
from .jit import kernel, rare_kernel
from .map_belief import is_lost
from .next_area import first_area, first_of_idle, first_to_share, has_to_wait, head_for, is_full, see
from .offers import is_dangerous
from .paths import entry_of, go_on, list_to_do, next_leg, set_out
from .policy import is_danger, offer_of
from .return_home import charge, may_recharge, start_return, turns
from .robot_types import drives_back, hears, own_turn
from .state import AREA_BITS, VISITED, holds


@kernel
def begin(t, s, w):
    """Before t = 0: compute the path of each robot with an area. A mission resumed from a state has them already."""
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
    """The robot has got an area and is no longer held."""
    s.robots[robot].held = 0
    moves_on(t, s, robot)


@kernel
def make_first_choice(t, p, s, robot, area):
    """Make the area the robot's first choice. An area of one cell stays so until another area becomes unassigned.

    A step of cost e towards the area lowers its cost by e, and that of others by at most e, and by less per cell where
    they have more cells. Visits of other robots improve no offer. Where areas can be refused, an area may become
    acceptable on the way.
    """
    # For a robot that returns to base the areas within range change with every step.
    sure = p.by_price and not (p.limited or p.preempts or t.returns)
    stays_first = sure and len(p.value) == 0 and s.areas[area].left == 1
    s.robots[robot].sure = s.marks.arrivals if stays_first else NONE


@kernel
def take(t, p, s, w, log, robot, area, target):
    """Assign an area to a robot, which travels to `target` in it."""
    give(s, robot, area)
    make_first_choice(t, p, s, robot, area)
    moves(t, s, robot)
    head_for(t, s, w, robot, target)
    note(log, s, robot, ALLOCATED_EVENT, area, target)


@rare_kernel
def should_recharge(t, p, s, w, robot):
    """Whether the robot should recharge: it may, and an area is open to it if its range is ignored."""
    if not may_recharge(t, s, robot):
        return False
    s.marks.unlimited = 1
    area, _, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    s.marks.unlimited = 0
    return area != NONE


@rare_kernel
def share_or_rest(t, p, s, w, log, robot):
    """`Find Area To Share`, else done: GAINS if the robot got a part, RESTS if not, NO_ROOM."""
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
    # A refusal is recorded once, when the robot stops asking; a held robot waits for the cap, it refuses nothing.
    if p.robot_value and not s.robots[robot].held and s.robots[robot].doing != DONE:
        area, target, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))
        if area != NONE:
            note(log, s, robot, REFUSED_EVENT, area, target)
    s.robots[robot].doing = DONE
    if t.returns and should_recharge(t, p, s, w, robot):
        start_return(t, s, w, log, robot, True)
    else:
        waits(t, s, robot)
    return 0


@rare_kernel
def allocate_next(t, p, s, w, log, robot, idle):
    """`Allocate Next Area`, else `Find Area To Share`, else done; returns as `share_or_rest`.

    Args:
        idle: whether the robot had no area before; then, unless it is held, it does not try to share again.
    """
    if t.asks:
        area, target, cost = t.asks.area(t, s, w, robot)
    elif idle:
        area, target, cost = first_of_idle(t, p, s, w, robot)
    else:
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    # A robot without an area shares once, when it becomes idle; only a held one tries again.
    if area == NONE and idle and not s.robots[robot].held:
        if t.returns and should_recharge(t, p, s, w, robot):
            start_return(t, s, w, log, robot, True)
        return 0
    if area == NONE:
        return share_or_rest(t, p, s, w, log, robot)
    if has_to_wait(t, p, s, w, robot, area, cost):
        s.robots[robot].held = 1
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@rare_kernel
def reevaluate(t, p, s, w, log, robot):
    """Re-evaluate before danger: another area may be better, or none worth the risk. Returns as `share_or_rest`."""
    own = np.int64(s.robots[robot].area)
    if t.asks:
        area, target, cost = t.asks.area(t, s, w, robot, own)
    else:
        area, target, cost = first_area(t, p, s, w, robot, own, np.bool_(True))
    waits = p.preempts and area != NONE and has_to_wait(t, p, s, w, robot, area, cost)
    if area == own and not waits:
        make_first_choice(t, p, s, robot, own)
        return 0
    note(log, s, robot, LOOKED_AGAIN_EVENT, own, s.robots[robot].next)
    # Its own area becomes unassigned before it takes another: other robots compare it too.
    reopen(s, own)
    if waits:
        s.robots[robot].held = 1
    if area == NONE or waits:
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@kernel
def aim(t, s, w, how, robot):
    """Head for the next target in the robot's area, which has cells to do."""
    if s.robots[robot].doing == TRAVELING:
        costs = costs_from(t, s, w, robot)
        target, _ = see(t, s, costs, robot, np.int64(s.robots[robot].cell), np.int64(s.robots[robot].area))
        set_out(t, s, w, robot, target, t.searches)
    else:
        s.robots[robot].ahead = 0
        next_leg(t, s, w, how, robot)


@rare_kernel
def look_up(t, p, s, w, log, how, robot):
    """Re-evaluate before the move where needed; returns as `share_or_rest`."""
    robots, got = s.robots, 0
    if s.areas[robots[robot].area].left == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    me = robots[robot]
    # Without new unassigned areas (`arrivals`) an area once compared stays first, so nothing is compared again.
    wary = p.reevaluates and (p.preempts or me.doing == TRAVELING) and me.sure != s.marks.arrivals
    if wary and is_danger(t, p, s, robot, robots[robot].next) and hears(t, s, robot):
        got = reevaluate(t, p, s, w, log, robot)
        if got != 0 or not has_area(robots, robot):
            return got
    # Another robot has visited the target: the path would end in a cell that is done.
    if s.home[robots[robot].target] & VISITED:
        aim(t, s, w, how, robot)
    return got


@rare_kernel
def end_leg(t, p, s, w, log, how, robot):
    """At the end of a path or leg: the next leg, or the next area; returns as `share_or_rest`."""
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
    """After the robot entered the cell: the next leg, or the next area; returns as `share_or_rest`."""
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
    """Whether the robot has to re-evaluate: its target is visited (also if its area is done), or danger comes next."""
    return s.home[s.robots[robot].target] & VISITED != 0 or is_danger(t, p, s, robot, s.robots[robot].next)


@kernel
def visits_other_area(s, robot, cell):
    """Whether the robot, entering the cell, visits a cell to do in another area than its own."""
    home = np.int64(s.home[cell])
    return home & VISITED == 0 and home >> AREA_BITS != s.robots[robot].area


@kernel
def goes_on(t, p, s, robot):
    """Whether the robot just moves on, as in most of its turns: `act` would decide nothing."""
    return not t.returns and s.marks.step > 0 and holds(s.moving, robot) and not notices(t, p, s, robot)


@kernel
def passes(t, s, w, robot, cell):
    """Whether the cell is on the robot's way, with nothing to decide; the robot then has its next cell."""
    decides = t.returns or t.radio or cell == s.robots[robot].target or s.marks.step == 0
    if decides or own_turn(t, robot, s.marks.step) == s.robots[robot].until:
        return False
    go_on(t, s, w, robot)
    return True


@rare_kernel
def act(t, p, s, w, log, how, robot):
    """The robot's turn up to its move: MOVES, RESTS, GAINS (an area, no move), or NO_ROOM."""
    me, step, got = s.robots[robot], s.marks.step, RESTS
    if not holds(s.moving, robot):
        return MOVES if drives_back(t, s, robot) else allocate_next(t, p, s, w, log, robot, np.bool_(True))
    if t.returns and me.doing == CHARGING:
        s.marks.progress = 1
        if charge(t, s, log, robot, step):
            me.doing = IDLE
            got = allocate_next(t, p, s, w, log, robot, np.bool_(False))
        return got
    if step > 0 and me.doing != RETURNING and notices(t, p, s, robot):
        # The robot still moves in this step, so it has one move more than a robot whose turn is over.
        s.marks.now = 1
        got = look_up(t, p, s, w, log, how, robot)
        s.marks.now = 0
    if not holds(s.moving, robot):
        me.until += 1  # it did not move in this step
        return got
    if t.returns and step > 0:
        turn_kind = turns(t, s, robot, step) if has_area(s.robots, robot) else 0
        if turn_kind > 0 and (got == NO_ROOM or not start_return(t, s, w, log, robot, turn_kind > 1)):
            return NO_ROOM
        if not holds(s.moving, robot) or me.doing == CHARGING:
            return got
    return NO_ROOM if got == NO_ROOM else MOVES


@rare_kernel
def repair_plan(t, p, s, w, log, how, robot):
    """After a map update: a robot with no cells left decides, one with a changed path replans."""
    if s.areas[s.robots[robot].area].left == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    if is_lost(s, w, robot):
        aim(t, s, w, how, robot)
    return 0
