"""Algorithm 2 compiled for attentive robots (`planner.policies.rule`): the program of `planner.simulator.rollouts` for
rules that look at what others have visited (SPEC section 11).

Sets, tables and the book of areas are the same; what a robot does in a step is stated here. From t = 0 on a robot with
an area is TRAVELING, its way known, and one without is IDLE. A robot's cells to do are the unvisited ones of its area:
a visit takes TO_DO from a cell. A program is compiled for each rule, when it is first used.
"""

from __future__ import annotations

import numpy as np

from planner.ids import NONE
from planner.jit import kernel, program, rare_kernel
from planner.policies.limits import is_dangerous
from planner.simulator.areas import (
    ALLOCATED_EVENT,
    LOOKED_AGAIN_EVENT,
    REFUSED_EVENT,
    costs_from,
    give,
    has_area,
    look,
    note,
    reopen,
    share_between,
)
from planner.simulator.map_belief import forget_news, is_lost, learns_of, recall, revise, take_note
from planner.simulator.moving_threats import is_meeting
from planner.simulator.next_area import (
    could_go_on,
    first_area,
    first_of_idle,
    first_to_share,
    has_to_wait,
    head_for,
    is_full,
    see,
)
from planner.simulator.paths import entry_of, go_on, list_to_do, next_leg, set_out
from planner.simulator.policy import is_danger, offer_of
from planner.simulator.return_home import call_home, charge, end_range, go_home, may_be_charged, stay, turn_home, turns
from planner.simulator.robot_types import came_back, drives_back, hears, on_turn, own, own_turn
from planner.simulator.rollouts import begin_next, go_on_with, level_of
from planner.simulator.runs import after_turns, end_of, is_over, moves_on, only_mover, waits
from planner.simulator.state import (
    ACTS,
    AHEAD,
    AREA,
    AREA_BITS,
    AREAS_FULL,
    CELL,
    CHANGES,
    CHARGING,
    COVERING,
    DOING,
    DONE,
    FIRST,
    HELD,
    HIT,
    IDLE,
    LAST,
    LEFT_IN,
    NEXT,
    NO_PROGRESS,
    NOT_WORTH_THE_RISK,
    NOW,
    ONE,
    OPEN,
    PARTED,
    PASSED,
    PROGRESS,
    QUIET,
    RETURNING,
    ROBOT,
    STARTING,
    STEP,
    SURE,
    SURVIVED,
    TARGET,
    TO_DO,
    TRAVELING,
    UNLIMITED,
    UNTIL,
    VERDICT,
    VISITED,
    WORD,
    holds,
    lowest_bit,
)
from planner.simulator.struct_pointers import hand
from planner.simulator.visits import count_new, enter, lose, survive


@kernel
def begin(t, s, w):
    """Before t = 0: who has an area knows the way to it. What is under way began long ago."""
    if s.marks[STEP] > 0 or s.marks[VERDICT] != ACTS:
        return
    for robot in range(len(s.robots)):
        if s.robots[robot, DOING] == STARTING:
            s.robots[robot, DOING] = TRAVELING
            target = entry_of(t, s, w, robot, np.int64(s.robots[robot, AREA]))
            set_out(t, s, w, robot, target, t.searches)
        else:
            s.robots[robot, DOING] = IDLE


@kernel
def moves(t, s, robot):
    """The robot has got an area, from which nothing holds it any more."""
    s.robots[robot, HELD] = 0
    moves_on(t, s, robot)


@kernel
def decide(p, s, robot, area):
    """The area is the robot's first. Of one cell it stays so, however often it looks again, until an area comes.

    A step on the way of cost e makes the area cheaper by e, others by e at most, and by less per cell where they have
    more cells; what others visit makes none better. Where areas are refused one may be accepted from nearby.
    """
    sure = p.by_price and not (p.limited or p.breaks_off)
    s.robots[robot, SURE] = sure and len(p.value) == 0 and s.areas[area, LEFT_IN] == 1


@kernel
def unsettle(s):
    """An area has come: everybody looks again."""
    for robot in range(len(s.robots)):
        s.robots[robot, SURE] = 0


@kernel
def take(t, p, s, w, log, robot, area, target):
    give(s, robot, area)
    decide(p, s, robot, area)
    moves(t, s, robot)
    head_for(t, s, w, robot, target)
    note(log, s, robot, ALLOCATED_EVENT, area, target)


@rare_kernel
def would_be_charged(t, p, s, w, robot):
    """Whether there is an area for the robot, if it is charged."""
    if not may_be_charged(t, s, robot):
        return False
    s.marks[UNLIMITED] = 1
    area, _, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    s.marks[UNLIMITED] = 0
    return area != NONE


@rare_kernel
def share_or_rest(t, p, s, w, log, robot):
    """`Find Area To Share`, else done: 1 if the robot got a part, 0 if not, NONE if there is no room."""
    owner, cost = first_to_share(t, p, s, w, robot)
    limited = owner != NONE and len(p.most) > 0
    if limited and is_dangerous(offer_of(t, p, s, robot, s.robots[owner, AREA], cost), p.cells):
        held = s.robots[robot, HELD] or is_full(t, p, s, robot)
        s.robots[robot, HELD] = held
        owner = NONE if held else owner
    if owner != NONE:
        if share_between(t, s, w, log, robot, owner, costs_from(t, s, w, robot)) == NONE:
            return NONE
        unsettle(s)
        moves(t, s, robot)
        return 1
    if p.worth and not s.robots[robot, HELD] and s.robots[robot, DOING] != DONE:
        area, target, _ = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(False))
        if area != NONE:
            note(log, s, robot, REFUSED_EVENT, area, target)
    s.robots[robot, DOING] = DONE
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
    if idle:
        area, target, cost = first_of_idle(t, p, s, w, robot)
    else:
        area, target, cost = first_area(t, p, s, w, robot, np.int64(NONE), np.bool_(True))
    if area == NONE and idle and not s.robots[robot, HELD]:
        if t.returns and would_be_charged(t, p, s, w, robot):
            turn_home(t, s, w, log, robot, True)
        return 0
    if area == NONE:
        return share_or_rest(t, p, s, w, log, robot)
    if has_to_wait(t, p, s, w, robot, area, cost):
        s.robots[robot, HELD] = 1
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@rare_kernel
def look_again(t, p, s, w, log, robot):
    """Before a danger: another area may be better by now, or none worth it; answers as `share_or_rest`."""
    own = np.int64(s.robots[robot, AREA])
    area, target, cost = first_area(t, p, s, w, robot, own, np.bool_(True))
    waits = p.breaks_off and area != NONE and has_to_wait(t, p, s, w, robot, area, cost)
    if area == own and not waits:
        decide(p, s, robot, own)
        return 0
    note(log, s, robot, LOOKED_AGAIN_EVENT, own, s.robots[robot, NEXT])
    # Its own area goes back into the pool before it takes another: somebody else may want it.
    reopen(s, own)
    unsettle(s)
    if waits:
        s.robots[robot, HELD] = 1
    if area == NONE or waits:
        return share_or_rest(t, p, s, w, log, robot)
    take(t, p, s, w, log, robot, area, target)
    return 1


@kernel
def aim(t, s, w, how, robot):
    """On to the next target of its area, in which cells are left."""
    if s.robots[robot, DOING] == TRAVELING:
        costs = costs_from(t, s, w, robot)
        target, _ = see(t, s, costs, robot, np.int64(s.robots[robot, CELL]), np.int64(s.robots[robot, AREA]))
        set_out(t, s, w, robot, target, t.searches)
    else:
        s.robots[robot, AHEAD] = 0
        next_leg(t, s, w, how, robot)


@rare_kernel
def look_up(t, p, s, w, log, how, robot):
    """What the robot notices before it moves; answers as `share_or_rest`."""
    robots, got = s.robots, 0
    if s.areas[robots[robot, AREA], LEFT_IN] == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    wary = p.looks_again and (p.breaks_off or robots[robot, DOING] == TRAVELING) and not robots[robot, SURE]
    if wary and is_danger(t, p, s, robot, robots[robot, NEXT]) and hears(t, s, robot):
        got = look_again(t, p, s, w, log, robot)
        if got != 0 or not has_area(robots, robot):
            return got
    if s.home[robots[robot, TARGET]] & VISITED:
        aim(t, s, w, how, robot)
    return got


@rare_kernel
def arrive(t, p, s, w, log, how, robot):
    """At the end of a way or leg: the next leg, or the next area; answers as `share_or_rest`."""
    robots = s.robots
    traveled = robots[robot, DOING] == TRAVELING
    robots[robot, DOING] = COVERING
    if s.areas[robots[robot, AREA], LEFT_IN] == 0:
        return allocate_next(t, p, s, w, log, robot, np.bool_(False))
    if traveled:
        list_to_do(s, robot)
    next_leg(t, s, w, how, robot)
    return 0


@rare_kernel
def go(t, p, s, w, log, how, robot, step, cell):
    """After entering a cell; answers as `share_or_rest`."""
    robots = s.robots
    if step > 0:
        if cell == robots[robot, TARGET]:
            return arrive(t, p, s, w, log, how, robot)
        go_on(t, s, w, robot)
        return 0
    if robots[robot, DOING] == IDLE:
        waits(t, s, robot)
        return 0
    area = np.int64(robots[robot, AREA])
    if np.int64(s.home[cell]) >> AREA_BITS == area or s.areas[area, LEFT_IN] == 0:
        return arrive(t, p, s, w, log, how, robot)
    if s.home[robots[robot, TARGET]] & VISITED:
        aim(t, s, w, how, robot)
    return 0


@rare_kernel
def learn(t, p, s, w, log, how, ids):
    """At the end of a step: what robots see, and what follows; 1 if the map changed, else 0; NONE: no room."""
    count, fresh = learns_of(t, s, w, how, ids)
    if fresh and len(p.view_begin) > 0:
        s.marks[CHANGES] += 1  # areas would show less: what is kept of offers is void
    if count == 0:
        return 0
    got = 1 if revise(t, s, w, log, count) else NONE  # a map update is progress
    unsettle(s)
    for robot in range(len(s.robots)):
        if got == NONE or not has_area(s.robots, robot):
            continue
        if s.areas[s.robots[robot, AREA], LEFT_IN] == 0:
            more = allocate_next(t, p, s, w, log, robot, np.bool_(False))
            got = NONE if more == NONE else got
        elif is_lost(s, w, robot):
            aim(t, s, w, how, robot)
    forget_news(w, count)
    return got


@kernel
def notices(t, p, s, robot):
    """Whether something is to be looked at before the robot moves: an area without cells to do has no target either."""
    return s.home[s.robots[robot, TARGET]] & VISITED != 0 or is_danger(t, p, s, robot, s.robots[robot, NEXT])


@kernel
def actors(t, p, s, word, after):
    """Bits of the robots of a word that still act in this step, those after this one; who is held asks in each."""
    bits = s.movers[word]
    if s.marks[OPEN] > 0 or len(p.most) > 0:
        bits |= s.waiting[word]
    bits = on_turn(t, s.marks[STEP], word, bits)
    return bits & (~np.uint64(1) << np.uint64(after)) if after >= 0 else bits


@kernel
def is_news(s, robot, cell):
    """Whether the robot, which enters the cell, visits one that is to do in another area than its own."""
    home = np.int64(s.home[cell])
    return home & VISITED == 0 and home >> AREA_BITS != s.robots[robot, AREA]


@kernel
def walk_alone(t, p, s, c, w, how, robot, step, size):
    """Steps after `step` in which a robot just moves over safe cells, nobody else does; the last of them.

    Before whatever else can happen, or has to be noticed, it stops.
    """
    me, stop = s.robots[robot], min(how.max_steps, s.team[robot, UNTIL])
    while step + 1 < stop and not notices(t, p, s, robot):
        cell, arrives = np.int64(me[NEXT]), me[NEXT] == me[TARGET]
        home = np.int64(s.home[cell]) & ~TO_DO
        if t.bound[own(t, robot, cell)] > 0 or (arrives and me[DOING] == TRAVELING):
            break
        if home & VISITED == 0:
            if s.areas[home >> AREA_BITS, LEFT_IN] == 1:
                break
            s.areas[home >> AREA_BITS, LEFT_IN] -= 1
            s.marks[CHANGES] += is_news(s, robot, cell)
            home |= VISITED | SURVIVED
            count_new(s, c, step + 1, cell, size)
        step += 1
        c.visits[cell] += size
        s.home[cell], me[CELL] = home, cell
        if arrives:
            next_leg(t, s, w, how, robot)
        else:
            go_on(t, s, w, robot)
    return step


@rare_kernel
def how_over(t, p, s, w):
    """How there is nothing more to be done, NONE: there is."""
    over = np.int64(is_over(t, s))
    return np.int64(NOT_WORTH_THE_RISK) if over == NO_PROGRESS and could_go_on(t, p, s, w) else over


@kernel
def ending(t, p, s, w, how, step):
    """How the run ends after this step, NONE if it goes on."""
    outcome = end_of(t, s, how, step)
    return NOT_WORTH_THE_RISK if outcome == NO_PROGRESS and could_go_on(t, p, s, w) else outcome


@rare_kernel
def advance(t, p, s, c, w, log, how, ids):
    """Go on with a set until its end, an Outcome, or until some of it are hit: PARTED. CUT, AREAS_FULL: as they say."""
    marks, robots = s.marks, s.robots
    size, step, robot, verdict = marks[LAST] - marks[FIRST], marks[STEP], marks[ROBOT], marks[VERDICT]
    word, cell, progress = robot // WORD, np.int64(robots[robot, CELL]), marks[PROGRESS]
    bits = actors(t, p, s, word, robot % WORD if verdict != ACTS else NONE)
    if is_meeting(s):
        word, bits, verdict = len(s.movers) - 1, np.uint64(0), ACTS if verdict == PASSED else verdict
    # What `first_of_idle` keeps is of one level of the stack, and scratch is of the thread.
    for other in range(len(robots)):
        w.kept[other, 0] = NONE
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
                        got = learn(t, p, s, w, log, how, ids)
                        if got == NONE:
                            return AREAS_FULL
                        progress |= got
                    marks[QUIET] = 0 if progress else marks[QUIET] + 1
                    if t.returns:
                        if not call_home(t, s, w, log, how_over(t, p, s, w)):
                            return AREAS_FULL
                        unsettle(s)
                    look(log, s, step)
                    outcome = ending(t, p, s, w, how, step)
                    if outcome != NONE:
                        return outcome
                    if len(p.most) == 0 or s.waiting[0] == 0:
                        robot = only_mover(t, s, log)
                        if robot != NONE:
                            step = walk_alone(t, p, s, c, w, how, robot, step, size)
                    step, word, progress = step + 1, 0, 0
                    marks[STEP] = step
                bits = actors(t, p, s, word, NONE)
            if verdict == PARTED:
                return verdict
            if verdict == HIT:
                robot, word = marks[ROBOT], word - 1
                continue
            robot = word * WORD + lowest_bit(bits)
            bits &= bits - ONE
            marks[ROBOT] = robot if t.returns else marks[ROBOT]
            got = 0
            if not holds(s.movers, robot):
                stays = not drives_back(t, s, robot)
                if stays:
                    got = allocate_next(t, p, s, w, log, robot, np.bool_(True))
            else:
                charging = t.returns and robots[robot, DOING] == CHARGING
                if charging:
                    progress = np.int64(1)
                    if charge(t, s, log, robot, step):
                        robots[robot, DOING] = IDLE
                        got = allocate_next(t, p, s, w, log, robot, np.bool_(False))
                elif step > 0 and robots[robot, DOING] != RETURNING and notices(t, p, s, robot):
                    marks[NOW] = 1
                    got = look_up(t, p, s, w, log, how, robot)
                    marks[NOW] = 0
                stays = charging or not holds(s.movers, robot)
                s.team[robot, UNTIL] += stays and not charging  # it has not moved in this step
                if t.returns and not stays and step > 0:
                    how_turns = turns(t, s, robot, step) if has_area(robots, robot) else 0
                    if how_turns > 0:
                        if got == NONE or not turn_home(t, s, w, log, robot, how_turns > 1):
                            return AREAS_FULL
                        unsettle(s)
                    stays = not holds(s.movers, robot) or robots[robot, DOING] == CHARGING
            if got == NONE:
                return AREAS_FULL
            progress |= got
            if stays:
                bits = actors(t, p, s, word, robot % WORD)
                continue
            cell, progress = np.int64(robots[robot, NEXT if step > 0 else CELL]), np.int64(1)
            # A visit of another's cell makes that area a worse offer: what is kept of offers is void.
            marks[CHANGES] += is_news(s, robot, cell)
            s.home[cell] = np.int64(s.home[cell]) & ~TO_DO
            verdict = enter(t, s, c, w, log, how, ids, step, robot, cell, size)
            if verdict != ACTS:
                if verdict < ACTS:
                    return verdict
                size = marks[LAST] - marks[FIRST]
        if verdict == HIT:
            verdict = np.int64(ACTS)
            if not lose(t, s, c, w, log, robot, size):
                return AREAS_FULL
            unsettle(s)
            if is_meeting(s):
                bits = np.uint64(0)
                continue
        else:
            if verdict == PASSED:
                verdict = np.int64(ACTS)
                if not t.moving:
                    survive(s, c, step, cell, size)
                    if t.estimates:
                        take_note(t, s, cell)
            if robots[robot, DOING] == RETURNING:
                go_home(t, s, log, robot)
            elif came_back(t, s, robot):
                if not end_range(t, s, w, log, robot):
                    return AREAS_FULL
            elif own_turn(t, robot, step) == s.team[robot, UNTIL]:
                if not stay(t, s, w, log, robot):
                    return AREAS_FULL
                unsettle(s)
            elif go(t, p, s, w, log, how, robot, step, cell) == NONE:
                return AREAS_FULL
        bits = actors(t, p, s, word, robot % WORD)


@program
def run_attentive(t, p, c, waiting, tasks, taken, stack, w, log, how, ids, singles):
    """As `planner.simulator.rollouts.run_set`, by the policy `p`."""
    tables, policy, counts, work, logged, options = hand(t), hand(p), hand(c), hand(w), hand(log), hand(how)
    top = 0
    while begin_next(tables, stack, waiting, tasks, taken, work):
        begin(tables, hand(level_of(stack, 0)), work)
        level = top = 0
        while level >= 0:
            s = hand(level_of(stack, level))
            last = s.marks[LAST]
            found = advance(tables, policy, s, counts, work, logged, options, ids)
            if found == AREAS_FULL:
                return NONE
            level, top = go_on_with(tables, s, counts, stack, ids, singles, options, top, last, found)
    return max(top, 0)
