"""Algorithm 2 compiled with Numba: the runs of `planner.mrac.simulate`, counted into tallies set by set.

A run is the same for all rollouts as long as they are hit alike. So one simulation carries a set of rollouts; where a
robot enters a dangerous cell each of them draws, and the set parts: who is not hit waits with a copy of the state,
the others go on. At the end of a run the set is counted, and those who came to wait last go on, depth first. No count
depends on the order.

Event for event the same as the readable simulator, with which it shares the one search of `planner.mrac.costs` and no
other code: next-hop tables instead of paths (searches where there are no tables, and for legs kept inside their area),
legs found one at a time (no leg crosses a cell still to do, so Algorithm 3's path can be found as it is driven), and
areas as segments of one permutation of the cells. Cells are renumbered 0 .. A - 1 in rising index (the accessible ones
alone), which keeps every tie; cell A stands for all that is blocked. Axis letters as in `planner.kernels.state`.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, program
from planner.kernels.areas import close, give, look_up_next_area, replace, search_next_area, share
from planner.kernels.bits import ONE, drop, holds, lowest_bit, put
from planner.kernels.luck import part
from planner.kernels.paths import entry_of, go_on, list_to_do, next_leg, set_out
from planner.kernels.state import (
    ACTS,
    AHEAD,
    ALIVE,
    AREA,
    AREA_BITS,
    AREAS,
    AREAS_FULL,
    BISECTED,
    CELL,
    COMPLETE,
    COVERING,
    DEAD,
    DIVIDED,
    DOING,
    FINISHED,
    FIRST,
    HIT,
    IDLE,
    LANDING,
    LAST,
    LEFT,
    LEFT_IN,
    NEXT,
    NONE,
    OPEN,
    PARTED,
    PASSED,
    PROGRESS,
    QUIET,
    ROBOT,
    STARTING,
    STEP,
    STOPPED,
    STUCK,
    SURVIVED,
    TARGET,
    TIMEOUT,
    TO_DO,
    TRAVELING,
    UNFINISHED,
    VERDICT,
    VISITED,
    WORD,
    State,
)
from planner.kernels.trace import ALLOCATED_EVENT, COMPLETED_EVENT, HIT_EVENT, REALLOCATED_EVENT, has_area, look, note


@kernel
def level_of(stack, level):
    """One level of the stack."""
    return State(
        stack.home[level], stack.order[level], stack.areas[level], stack.robots[level], stack.legs[level],
        stack.marks[level], stack.movers[level], stack.waiting[level], stack.open[level],
    )  # fmt: skip


@kernel
def copy_row(of, to, count):
    for place in range(count):
        to[place] = of[place]


@kernel
def copy_state(of, to):
    """Copy what is in use of a level."""
    areas = of.marks[AREAS]
    copy_row(of.home, to.home, len(of.home))
    copy_row(of.order, to.order, len(of.order))
    for row in range(of.areas.shape[0]):
        copy_row(of.areas[row], to.areas[row], areas)
    for row in range(of.robots.shape[0]):
        copy_row(of.robots[row], to.robots[row], of.robots.shape[1])
    for robot in range(of.legs.shape[0]):
        copy_row(of.legs[robot], to.legs[robot], of.robots[AHEAD, robot])
    copy_row(of.marks, to.marks, len(of.marks))
    copy_row(of.movers, to.movers, len(of.movers))
    copy_row(of.waiting, to.waiting, len(of.waiting))
    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)


@kernel
def visit(s, c, log, step, robot, cell, size, flags):
    """The cell, which was not visited, is; the last one of an area completes it."""
    home = s.home[cell]
    s.home[cell] = home | flags
    c.new[step] += size
    holder = home >> AREA_BITS
    left = s.areas[LEFT_IN, holder] - 1
    s.areas[LEFT_IN, holder] = left
    if left == 0:
        s.marks[UNFINISHED] -= 1
        close(s, holder)
        note(log, s, robot, COMPLETED_EVENT, holder, cell)


@kernel
def lose(t, s, c, w, log, robot, size):
    """The robot is stopped in its cell, and what it leaves unvisited of its area becomes areas. False: no room."""
    cell, area = s.robots[CELL, robot], s.robots[AREA, robot]
    owns = has_area(s.robots, robot)
    c.stops[cell] += size
    s.marks[ALIVE] -= 1
    drop(s.movers, robot)
    s.robots[DOING, robot] = DEAD
    note(log, s, robot, HIT_EVENT, area if owns else NONE, cell)
    if owns:
        first, parts = replace(t, s, w, area, False)
        if first == NONE:
            return False
        if parts > 0:
            note(log, s, robot, REALLOCATED_EVENT, area, parts)
    return True


@kernel
def survive(s, c, step, cell, size):
    """A dangerous cell has been entered by a robot that was not stopped."""
    if s.home[cell] & SURVIVED == 0:
        s.home[cell] |= SURVIVED
        c.late[step] += size


@kernel
def take_next_area(t, s, w, log, robot):
    """`Allocate Next Area`: whether the robot got one."""
    if s.marks[OPEN] == 0:
        return False
    searched = len(t.cost_to) == 0
    if searched:
        area, cell = search_next_area(t, s, w, s.robots[CELL, robot])
    else:
        area, cell = look_up_next_area(t, s, s.robots[CELL, robot])
    if area == NONE:
        return False
    give(s, robot, area)
    set_out(t, s, w, robot, cell, searched)
    note(log, s, robot, ALLOCATED_EVENT, area, cell)
    return True


@kernel
def settle(t, s, w, log, how, robot):
    """What a robot does at the end of its path or leg, or while it waits, all of it in the same step.

    1 if it got an area, 0 if not, NONE if there is no room for more areas.
    """
    robots = s.robots
    got = 0
    while True:
        doing = robots[DOING, robot]
        if doing == LANDING:
            robots[DOING, robot] = IDLE
            drop(s.movers, robot)
            put(s.waiting, robot)
            return got
        if doing == STARTING:
            robots[DOING, robot] = TRAVELING
            target = entry_of(t, s, w, robot, robots[AREA, robot])
            set_out(t, s, w, robot, target, len(t.cost_to) == 0)
        if doing in (STARTING, TRAVELING):
            if robots[CELL, robot] != robots[TARGET, robot]:
                return got
            robots[DOING, robot] = COVERING
            list_to_do(s, robot)
        if doing not in (IDLE, FINISHED) and robots[LEFT, robot] > 0:
            next_leg(t, s, w, how, robot)
            return got
        if take_next_area(t, s, w, log, robot):
            got = 1
        elif doing in (IDLE, FINISHED):
            return got
        else:
            shared = share(t, s, w, log, robot)
            if shared == NONE:
                return NONE
            if shared == 0:
                robots[DOING, robot] = FINISHED
                drop(s.movers, robot)
                put(s.waiting, robot)
                return got
            got = 1
        if doing in (IDLE, FINISHED):
            drop(s.waiting, robot)
            put(s.movers, robot)


@kernel
def actors(s, word, after):
    """Bits of the robots of a word that still act in this step, those after this one."""
    bits = s.movers[word]
    if s.marks[OPEN] > 0:
        bits |= s.waiting[word]
    return bits & (~np.uint64(1) << np.uint64(after)) if after >= 0 else bits


@kernel
def end_of(s, how, step):
    """How the run ends after this step, NONE if it goes on (SPEC section 5's order)."""
    if s.marks[UNFINISHED] == 0:
        return COMPLETE
    if s.marks[ALIVE] == 0:
        return STOPPED
    if s.marks[QUIET] >= 2:
        return STUCK
    return TIMEOUT if step >= how.max_steps else NONE


@kernel
def advance(t, s, c, w, log, how, ids):
    """Go on with a set until its end, an Outcome, or until some of it are hit: PARTED. AREAS_FULL: no room."""
    marks, robots = s.marks, s.robots
    size, step, robot, verdict = marks[LAST] - marks[FIRST], marks[STEP], marks[ROBOT], marks[VERDICT]
    word, cell = robot // WORD, robots[CELL, robot]
    bits = actors(s, word, robot % WORD if verdict != ACTS else -1)
    while True:
        if verdict == ACTS:
            while bits == 0:
                word += 1
                if word == len(s.movers):
                    look(log, s, step)
                    marks[QUIET] = 0 if marks[PROGRESS] else marks[QUIET] + 1
                    outcome = end_of(s, how, step)
                    if outcome != NONE:
                        return outcome
                    step += 1
                    marks[STEP], marks[PROGRESS], word = step, 0, 0
                bits = actors(s, word, -1)
            robot = word * WORD + lowest_bit(bits)
            bits &= bits - ONE
            if holds(s.movers, robot):
                cell = robots[NEXT, robot]
                robots[CELL, robot] = cell
                marks[PROGRESS] = 1
                c.visits[cell] += size
                fresh = s.home[cell] & VISITED == 0
                if t.bound[cell] == 0:
                    if fresh:
                        visit(s, c, log, step, robot, cell, size, VISITED | SURVIVED)
                else:
                    verdict = PASSED
                    if fresh:
                        visit(s, c, log, step, robot, cell, size, VISITED)
                        c.late[step] -= size
                    if fresh or not how.first_only:
                        first, last = marks[FIRST], marks[LAST]
                        counter = np.uint32(step * 1024 + robot)
                        hit_from = part(ids, w.words, how, first, last, counter, t.bound[cell])
                        if hit_from == first:
                            verdict = HIT
                        elif hit_from < last:
                            marks[ROBOT], marks[LAST] = robot, hit_from
                            return PARTED
        if verdict == HIT:
            verdict = ACTS
            if not lose(t, s, c, w, log, robot, size):
                return AREAS_FULL
            bits = actors(s, word, robot % WORD)
            continue
        if verdict == PASSED:
            verdict = ACTS
            survive(s, c, step, cell, size)
        if holds(s.movers, robot):
            if cell != robots[TARGET, robot]:
                go_on(t, s, robot)
                continue
            if robots[DOING, robot] == COVERING:
                s.home[cell] ^= TO_DO
                robots[LEFT, robot] -= 1
                if robots[LEFT, robot] > 0:
                    next_leg(t, s, w, how, robot)
                    continue
        got = settle(t, s, w, log, how, robot)
        if got == NONE:
            return AREAS_FULL
        marks[PROGRESS] |= got
        bits = actors(s, word, robot % WORD)


@kernel
def count_set(s, c, ids, start, singles, outcome):
    """Add a set at the end of its run."""
    marks, first, last = s.marks, s.marks[FIRST], s.marks[LAST]
    size, covered, safely = last - first, 0, 0
    for cell in range(len(s.order)):
        visited, survived = np.int64(s.home[cell] & VISITED), np.int64(s.home[cell] >> 1 & 1)
        c.covered[cell] += -visited & size
        c.safely[cell] += -survived & size
        covered += visited
        safely += survived
    c.visited[covered] += size
    c.survived[safely] += size
    c.time[marks[STEP]] += size
    c.alive[marks[ALIVE]] += size
    c.outcomes[outcome] += size
    if len(singles) > 0:
        for place in range(first, last):
            single = singles[ids[place] - start]
            single[0], single[1], single[2], single[3] = covered, safely, marks[STEP], marks[ALIVE]
            single[4], single[5], single[6] = outcome, marks[BISECTED], marks[DIVIDED]


@program
def run_set(t, c, stack, w, log, how, ids, start, singles):
    """Rollouts `ids`, uint32 `[B]`, which become disordered, with a stack of `planner.kernels.state.State`.

    `singles`: int32 `[.., SINGLES]`, the numbers of each rollout by id from `start` on, or no rows. Returns False if
    one needed more areas than the state has room for (the counts are then void).
    """
    copy_state(level_of(stack, 0), level_of(stack, 1))
    stack.marks[1, FIRST], stack.marks[1, LAST] = 0, len(ids)
    level = 1
    while level > 0:
        s = level_of(stack, level)
        last = s.marks[LAST]
        found = advance(t, s, c, w, log, how, ids)
        if found == AREAS_FULL:
            return False
        if found == PARTED:
            s.marks[VERDICT] = PASSED
            level += 1
            hit = level_of(stack, level)
            copy_state(s, hit)
            hit.marks[FIRST], hit.marks[LAST], hit.marks[VERDICT] = s.marks[LAST], last, HIT
        else:
            count_set(s, c, ids, start, singles, found)
            level -= 1
    return True
