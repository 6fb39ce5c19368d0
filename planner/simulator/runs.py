"""One run of a set of rollouts, compiled with Numba: that of `planner.mrac.simulate`, up to where it parts.

Event for event the same as the readable simulator, with which it shares the one search of `planner.mrac.paths` and no
other code: next-hop tables instead of paths (searches where there are no tables, and for legs kept inside their area),
legs found one at a time (no leg crosses a cell still to do, so Algorithm 3's path can be found as it is driven), and
areas as segments of one permutation of the cells. Cells are renumbered 0 .. A - 1 in rising index (the accessible ones
alone), which keeps every tie; cell A stands for all that is blocked. Part of `planner.simulator.rollouts`, which see.
"""

from __future__ import annotations

import numpy as np

from planner.ids import NONE
from planner.jit import kernel, rare_kernel
from planner.simulator.areas import ALLOCATED_EVENT, find_next_area, give, has_area, look, note, share
from planner.simulator.failure_sampling import fresh
from planner.simulator.map_belief import forget_news, is_lost, learns_of, recall, revise, take_note
from planner.simulator.moving_threats import has_entered, is_meeting, meet
from planner.simulator.paths import (
    adjacent,
    entry_of,
    go_on,
    list_to_do,
    next_leg,
    set_out,
    set_out_far,
    to_do_in,
)
from planner.simulator.return_home import (
    call_home,
    can_be_remembered,
    charge,
    count_home,
    end_range,
    go_home,
    is_away,
    may_be_charged,
    remember,
    stay,
    turn_home,
    turns,
)
from planner.simulator.robot_types import came_back, drives_back, on_turn, own, own_turn
from planner.simulator.state import (
    ACTS,
    AHEAD,
    ALIVE,
    ALL_ROBOTS_LOST,
    AREA,
    AREA_BITS,
    AREAS_FULL,
    BEARS,
    BEGIN,
    BORNE,
    CELL,
    CHARGING,
    COMPLETE,
    COVERING,
    DOING,
    DONE,
    END,
    FIRST,
    FOLLOWING,
    HIT,
    IDLE,
    LANDING,
    LAST,
    LAST_UPDATE,
    LEFT,
    LEFT_IN,
    NEXT,
    NO_PROGRESS,
    ONE,
    OPEN,
    OVER,
    PARTED,
    PASSED,
    PATH,
    PROGRESS,
    QUIET,
    QUIET_STEPS,
    RETURNING,
    ROBOT,
    STARTING,
    STEP,
    STEP_LIMIT,
    SURVIVED,
    TARGET,
    TO_DO,
    TRAVELING,
    UNLIMITED,
    UNTIL,
    VERDICT,
    VISITED,
    WORD,
    drop,
    holds,
    lowest_bit,
    put,
)
from planner.simulator.visits import count_new, enter, is_complete, lose, survive

UNSAFE = VISITED | SURVIVED
"""Flags of a cell of which VISITED alone is there where only robots that were stopped have been."""


@kernel
def waits(t, s, robot):
    """The robot, which moved, has no area from here on."""
    if holds(s.movers, robot):
        drop(s.movers, robot)
        put(s.waiting, robot)
        # Moves that are left do not run out with the turns: a number of them, not the turn of the last one.
        s.team[robot, UNTIL] -= own_turn(t, robot, s.marks[STEP])


@kernel
def moves_on(t, s, robot):
    """The robot, which waited, has an area and moves from the next step on."""
    if holds(s.waiting, robot):
        drop(s.waiting, robot)
        put(s.movers, robot)
        s.team[robot, UNTIL] += own_turn(t, robot, s.marks[STEP])


@rare_kernel
def after_turns(t, s, c, w, how, ids, size):
    """After the robots' turns: `planner.simulator.moving_threats.meet`; at the end of it is said who has survived."""
    verdict = meet(t, s, w, how, ids)
    if verdict == ACTS:
        for robot in range(len(s.robots)):
            if has_entered(s, robot):
                survive(s, c, s.marks[STEP], s.robots[robot, CELL], size)
        s.entered[:] = np.uint64(0)
    return verdict


@kernel
def take_next_area(t, s, w, log, robot):
    """`Allocate Next Area`: whether the robot got one."""
    if s.marks[OPEN] == 0:
        return False
    area, cell = find_next_area(t, s, w, robot)
    if area == NONE:
        return False
    give(s, robot, area)
    set_out(t, s, w, robot, cell, t.searches)
    note(log, s, robot, ALLOCATED_EVENT, area, cell)
    return True


@rare_kernel
def would_be_charged(t, s, w, robot):
    """Whether there is an area for the robot, if it is charged."""
    if not may_be_charged(t, s, robot):
        return False
    s.marks[UNLIMITED] = 1
    area, _ = find_next_area(t, s, w, robot)
    s.marks[UNLIMITED] = 0
    return area != NONE


@rare_kernel
def settle(t, s, w, log, how, robot):
    """What a robot does at the end of its path or leg, or while it waits, all of it in the same step.

    1 if it got an area, 0 if not, NONE if there is no room for more areas.
    """
    robots = s.robots
    got = 0
    while True:
        doing = robots[robot, DOING]
        if doing == LANDING:
            robots[robot, DOING] = IDLE
            waits(t, s, robot)
            return got
        if doing == STARTING:
            robots[robot, DOING] = TRAVELING
            target = entry_of(t, s, w, robot, robots[robot, AREA])
            set_out(t, s, w, robot, target, t.searches)
        if doing in (STARTING, TRAVELING):
            if robots[robot, CELL] != robots[robot, TARGET]:
                return got
            robots[robot, DOING] = COVERING
            # Before cells are marked as to do: of a remembered path the last one alone is.
            if can_be_remembered(s, w, robot) and remember(t, s, w, robot):
                return got
            list_to_do(s, robot)
        if doing not in (IDLE, DONE) and robots[robot, LEFT] > 0:
            next_leg(t, s, w, how, robot)
            return got
        if take_next_area(t, s, w, log, robot):
            got = 1
        elif doing in (IDLE, DONE):
            if t.returns and would_be_charged(t, s, w, robot):
                turn_home(t, s, w, log, robot, True)
            return got
        else:
            shared = share(t, s, w, log, robot)
            if shared == NONE:
                return NONE
            if shared == 0:
                robots[robot, DOING] = DONE
                if t.returns and would_be_charged(t, s, w, robot):
                    turn_home(t, s, w, log, robot, True)
                else:
                    waits(t, s, robot)
                return got
            got = 1
        if doing in (IDLE, DONE):
            moves_on(t, s, robot)


@rare_kernel
def set_right(t, s, w, log, how, robot):
    """Who has nothing left to do decides, whose way is not as it was sets out anew; answers as `settle`."""
    me = s.robots[robot]
    area = np.int64(me[AREA])
    if s.areas[area, LEFT_IN] == 0:
        me[DOING], me[LEFT] = COVERING, 0
    elif not is_lost(s, w, robot):
        return 0
    elif me[DOING] == TRAVELING:
        set_out(t, s, w, robot, entry_of(t, s, w, robot, area), True)
    else:
        for place in range(s.areas[area, BEGIN], s.areas[area, END]):
            s.home[s.order[place]] &= VISITED | SURVIVED | np.int64(-1) << AREA_BITS
        list_to_do(s, robot)
        next_leg(t, s, w, how, robot)
        return 0
    return settle(t, s, w, log, how, robot)


@rare_kernel
def learn(t, s, w, log, how, ids):
    """At the end of a step: what robots see, and what follows; 1 if the map changed, else 0; NONE: no room."""
    count, _ = learns_of(t, s, w, how, ids)
    if count == 0:
        return 0
    # A map update is progress (SPEC section 15): robots without an area look again in the next step.
    got = 1 if revise(t, s, w, log, count) else NONE
    for robot in range(len(s.robots)):
        if got != NONE and has_area(s.robots, robot):
            more = set_right(t, s, w, log, how, robot)
            got = NONE if more == NONE else got
    forget_news(w, count)
    return got


@kernel
def actors(t, s, word, after):
    """Bits of the robots of a word that still act in this step, those after this one."""
    bits = s.movers[word]
    if s.marks[OPEN] > 0:
        bits |= s.waiting[word]
    bits = on_turn(t, s.marks[STEP], word, bits)
    # Read anew after every robot that changed something: later ones see at once what earlier ones did.
    return bits & (~np.uint64(1) << np.uint64(after)) if after >= 0 else bits


@kernel
def is_over(t, s):
    """How there is nothing more to be done, NONE: there is (SPEC section 5's order)."""
    if is_complete(t, s):
        return COMPLETE
    if s.marks[ALIVE] == 0:
        return ALL_ROBOTS_LOST
    return NO_PROGRESS if s.marks[QUIET] >= t.limits[QUIET_STEPS] and not awaits_update(t, s) else NONE


@rare_kernel
def awaits_update(t, s):
    """Whether a robot that can move waits for an announced phase that changes the map."""
    if s.marks[STEP] + 1 >= t.limits[LAST_UPDATE]:
        return False
    able = np.uint64(0)
    for word in range(len(s.movers)):
        able |= s.movers[word] | s.waiting[word]
    return able != 0


@kernel
def end_of(t, s, how, step):
    """How the run ends after this step, NONE if it goes on."""
    if t.returns:
        return end_at_home(t, s, how, step)
    over = is_over(t, s)
    return STEP_LIMIT if over == NONE and step >= how.max_steps else over


@rare_kernel
def end_at_home(t, s, how, step):
    """The same where robots come home."""
    over = s.marks[OVER] - 1
    if s.marks[ALIVE] == 0:  # on the way home too, whatever ended the mission
        over = ALL_ROBOTS_LOST
    elif over == NONE or is_away(s):
        over = STEP_LIMIT if step >= how.max_steps else NONE
    if over == NONE:
        return over
    count_home(t, s)
    return COMPLETE if is_complete(t, s) else over


@kernel
def only_mover(t, s, log):
    """The robot that alone can do something until the next hit, NONE if there are several, or none.

    Also NONE where robots are of several speeds or types, what it does is written down, its visits are counted, threats
    move or change, or it looks about, or for its way home, every step.
    """
    bits = s.movers[0]
    # bits & (bits - 1) takes the lowest bit away: 0 if it was the only one. One word of robots is enough for most
    # teams.
    alone = bits != 0 and bits & (bits - ONE) == 0 and (s.marks[OPEN] == 0 or s.waiting[0] == 0)
    noted = len(log.frames) > 0 or len(s.passes) > 0 or t.moving or t.learns
    differ = len(t.pace) + len(t.type_of) + t.phased
    if not alone or len(s.movers) != 1 or noted or t.returns or differ:
        return NONE
    robot = lowest_bit(bits)
    return robot if s.robots[robot, DOING] != FOLLOWING else NONE


@kernel
def bears(t, s, how, robot, cell):
    """Whether it is known that a visit of the dangerous cell stops nobody of the set; the robot has then borne it."""
    if len(t.exposure) == 0 or t.doubtful or how.first_only or s.home[cell] & UNSAFE == VISITED:
        return False
    # The robot's own sum decides, not this visit: below the least tolerance of the set nobody is looked at.
    borne = s.team[robot, BORNE] + t.exposure[own(t, robot, cell)]
    if fresh(t, robot, borne) >= s.team[robot, BEARS]:
        return False
    s.team[robot, BORNE] = borne
    return True


@kernel
def walk_alone(t, s, c, w, how, robot, step, size):
    """Steps after `step` in which a robot just moves, nobody else does; the last of them.

    Before whatever else can happen (a hit, the end of an area or of a path) it stops.
    """
    # What changes at every step is kept in registers, and written back where somebody else reads it.
    me = s.robots[robot]
    covering, left, wanted = me[DOING] == COVERING, np.int64(me[LEFT]), to_do_in(me[AREA])
    here, cell, target = np.int64(me[CELL]), np.int64(me[NEXT]), np.int64(me[TARGET])
    stop, kept = min(how.max_steps, s.team[robot, UNTIL]), me[PATH] > 0
    ahead, end = np.int64(me[AHEAD]) if kept else 0, w.ends[me[PATH]] if kept else 0
    while step + 1 < stop:
        home = np.int64(s.home[cell])
        arrives = cell == target
        fresh = home & VISITED == 0
        # The end of a path, of an area or of a range is a decision: the full loop takes it.
        if (arrives and (not covering or left == 1)) or (fresh and s.areas[home >> AREA_BITS, LEFT_IN] == 1):
            break
        if t.bound[own(t, robot, cell)] > 0 and not bears(t, s, how, robot, cell):
            break
        if fresh:
            s.areas[home >> AREA_BITS, LEFT_IN] -= 1
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
            me[CELL] = here
            set_out_far(t, s, w, how, robot)
            target = np.int64(me[TARGET])
        else:
            s.home[cell] = home
            if ahead > 0:
                cell = np.int64(w.paths[end - ahead])
                ahead -= 1
                continue
            me[CELL] = here
            go_on(t, s, w, robot)
        cell = np.int64(me[NEXT])
    if kept:
        me[AHEAD] = ahead
    me[CELL], me[NEXT], me[TARGET], me[LEFT] = here, cell, target, left
    return step


@rare_kernel
def advance(t, s, c, w, log, how, ids):
    """Go on with a set until its end, an Outcome, or until some of it are hit: PARTED. CUT, AREAS_FULL: as they say."""
    marks, robots = s.marks, s.robots
    size, step, robot, verdict = marks[LAST] - marks[FIRST], marks[STEP], marks[ROBOT], marks[VERDICT]
    # A set goes on in the middle of a step: after the check of the robot at which it parted.
    word, cell, progress, moves = robot // WORD, robots[robot, CELL], marks[PROGRESS], True
    bits = actors(t, s, word, robot % WORD if verdict != ACTS else NONE)
    returns = t.returns
    if is_meeting(s):
        word, bits, verdict = len(s.movers) - 1, np.uint64(0), ACTS if verdict == PASSED else verdict
    if t.learns:
        recall(t, s, w)
    while True:
        if verdict == ACTS:
            while bits == 0:
                word += 1
                if word == len(s.movers):
                    if t.moving:
                        marks[PROGRESS] = progress
                        verdict = after_turns(t, s, c, w, how, ids, size)
                        if verdict != ACTS:
                            break
                    if t.learns:
                        got = learn(t, s, w, log, how, ids)
                        if got == NONE:
                            return AREAS_FULL
                        progress |= got
                    marks[STEP], marks[QUIET] = step, 0 if progress else marks[QUIET] + 1
                    if returns and not call_home(t, s, w, log, np.int64(is_over(t, s))):
                        return AREAS_FULL
                    look(log, s, step)
                    outcome = end_of(t, s, how, step)
                    if outcome != NONE:
                        return outcome
                    robot = only_mover(t, s, log)
                    if robot != NONE:
                        step = walk_alone(t, s, c, w, how, robot, step, size)
                    step, word, progress = step + 1, 0, 0
                    marks[STEP] = step
                bits = actors(t, s, word, NONE)
            if verdict == PARTED:
                return verdict
            if verdict == HIT:
                robot, word = marks[ROBOT], word - 1
                continue
            robot = word * WORD + lowest_bit(bits)
            bits &= bits - ONE
            marks[ROBOT] = robot if returns else marks[ROBOT]
            charged = False
            if returns and robots[robot, DOING] == CHARGING:
                progress, charged = 1, charge(t, s, log, robot, step)
                if not charged:
                    continue
                robots[robot, DOING], robots[robot, LEFT] = COVERING, 0  # as one that has covered its area
            elif returns and step > 0 and has_area(robots, robot):
                how_turns = turns(t, s, robot, step)
                if how_turns > 0:
                    if not turn_home(t, s, w, log, robot, how_turns > 1):
                        return AREAS_FULL
                    bits = actors(t, s, word, robot % WORD)
                    if robots[robot, DOING] != RETURNING:
                        continue
            moves = not charged and robots[robot, DOING] != IDLE and robots[robot, DOING] != DONE
            moves = moves or drives_back(t, s, robot)
            if moves:
                cell, progress = robots[robot, NEXT], 1
                # t = 0 enters the start; later the same cell again is a wait, which is no visit.
                if step == 0 or cell != robots[robot, CELL]:  # else it waits, as its given path says
                    verdict = enter(t, s, c, w, log, how, ids, step, robot, cell, size)
                if verdict != ACTS:
                    if verdict < ACTS:
                        return verdict
                    size = marks[LAST] - marks[FIRST]  # of a tree's branch less than before
        if verdict == HIT:
            verdict = ACTS
            if not lose(t, s, c, w, log, robot, size):
                return AREAS_FULL
            bits = np.uint64(0) if is_meeting(s) else actors(t, s, word, robot % WORD)
            continue
        if verdict == PASSED:
            verdict = ACTS
            if not t.moving:
                survive(s, c, step, cell, size)
                if t.estimates:
                    take_note(t, s, cell)
        if returns and moves and robots[robot, DOING] == RETURNING:
            go_home(t, s, log, robot)
            continue
        if moves and came_back(t, s, robot):
            if not end_range(t, s, w, log, robot):
                return AREAS_FULL
            continue
        if moves and own_turn(t, robot, step) == s.team[robot, UNTIL]:
            if not stay(t, s, w, log, robot):
                return AREAS_FULL
            bits = actors(t, s, word, robot % WORD)
            continue
        if moves:
            if robots[robot, DOING] == FOLLOWING:
                if step < t.length[robot]:
                    robots[robot, NEXT] = t.given[robot, step + 1]
                    continue
            elif cell != robots[robot, TARGET]:
                go_on(t, s, w, robot)
                continue
            if robots[robot, DOING] == COVERING:
                # The target of a coverage leg is always a cell to do.
                s.home[cell] ^= TO_DO
                robots[robot, LEFT] -= 1
                if robots[robot, LEFT] > 0:
                    next_leg(t, s, w, how, robot)
                    continue
        got = settle(t, s, w, log, how, robot)
        if got == NONE:
            return AREAS_FULL
        progress |= got
        bits = actors(t, s, word, robot % WORD)
