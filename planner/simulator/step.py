"""One step of Algorithm 2 for a group of rollouts with the same history.

In each step the robots act in index order: a robot decides, enters its next cell, and survives or is lost. Then threats
move, the map is updated, and the run may end. A rollout is a function of its failure thresholds. Rollouts that lose the
same robots at the same visits are one run, so they are simulated as one group. `advance` returns where a visit
destroys a robot in some of them and not in others: the group splits, and each part continues from there.

Arguments, in all modules of this package: `t` tables (read by every rollout), `p` policy (None: the rule of the paper),
`s` state of the group, `c` counts, `w` scratch arrays of the thread, `log` trace, `how` options, `ids` rollouts,
`robot` and `cell` indices. A feature that the mission does not use is None in `t`: no code is compiled for it.
"""

import numpy as np

from . import fixed_paths, replanning
from .areas import compare_again, has_area, note_leg, write_frame
from .codes import (
    ACTS,
    ALL_ROBOTS_LOST,
    AREAS_FULL,
    COMPLETE,
    GAINS,
    GROUP_SPLITS,
    HIT,
    MOVES,
    NO_PROGRESS,
    NO_ROOM,
    NONE,
    NOT_WORTH_THE_RISK,
    PASSED,
    RESTS,
    RETURNING,
    STEP_LIMIT,
)
from .jit import kernel, rare_kernel
from .map_belief import clear_changes, recall, revise, update_belief, update_map
from .moving_threats import has_entered, is_meeting, meet
from .next_area import could_go_on
from .replanning import begin, goes_on, passes, visits_other_area
from .return_home import count_at_base, end_range, is_away, move_to_base, start_returns, stay
from .robot_types import came_back, on_turn, own_turn
from .solo import only_moving_robot, walk_alone
from .state import ONE, TO_DO, WORD, lowest_bit
from .visits import enter, is_complete, lose, survive


@rare_kernel
def advance(t, p, s, c, w, log, how, ids):
    """Run the group until it ends or splits.

    It starts a step if the group's verdict is ACTS. HIT, PASSED: it resumes after the visit of `group.robot`.
    Returns the Outcome, GROUP_SPLITS, CUT (all of a tree's mass is below the cut) or AREAS_FULL (no room for areas).
    """
    group, robots, verdict = s.marks, s.robots, s.marks.verdict
    # Kept in registers: LLVM cannot know that no array overlaps the record.
    step, size = group.step, group.last - group.first
    robot, cell = np.int64(group.robot), np.int64(robots[group.robot].cell)
    word = robot // WORD
    left = acting(t, p, s, word, robot % WORD if verdict != ACTS else NONE)  # robots that still act in this step
    if verdict == ACTS and p is not None:
        begin(t, s, w)
    forget(t, p, s, w)
    if t.moving and is_meeting(s):  # the robots have acted in this step already
        word, left, verdict = len(s.moving) - 1, np.uint64(0), ACTS if verdict == PASSED else verdict
    while True:
        if verdict == ACTS:
            while left == 0:
                word += 1
                if word == len(s.moving):
                    if t.moving:
                        verdict = encounter(t, s, c, w, how, ids)
                        if verdict != ACTS:
                            break
                    if t.learns is None:
                        outcome = end_step(t, p, s, c, w, log, how)
                    else:
                        outcome = learn_and_end(t, p, s, c, w, log, how, ids)
                    if outcome != NONE or how.pause:
                        return outcome
                    step, word = group.step, 0
                left = acting(t, p, s, word, NONE)
            if verdict == GROUP_SPLITS:
                return verdict
            if verdict == HIT:  # a moving threat destroys a robot; the other encounters of the step follow
                robot, word = np.int64(group.robot), word - 1
                continue
            robot = word * WORD + lowest_bit(left)
            left &= left - ONE
            if t.returns:
                group.robot = robot
            # Decisions of a rule that re-evaluates are called, not inlined: LLVM takes minutes over one larger loop.
            if p is None:
                turn = fixed_paths.act(t, s, w, log, how, robot)
            else:
                turn = MOVES if goes_on(t, p, s, robot) else replanning.act(t, p, s, w, log, how, robot)
            if turn == NO_ROOM:
                return AREAS_FULL
            if turn != MOVES:
                group.progress |= turn
                left = acting(t, p, s, word, robot % WORD)
                continue
            group.progress = 1
            if log.noted:
                note_leg(t, s, log, robot)
            # t = 0 enters the start; a robot on an external path may wait, which is no visit.
            cell = np.int64(robots[robot].next if step > 0 else robots[robot].cell)
            if p is not None:
                # A visit in another robot's area makes that area a worse offer: cached offers are void.
                group.changes += visits_other_area(s, robot, cell)
                s.home[cell] = np.int64(s.home[cell]) & ~TO_DO
            if p is not None or step == 0 or cell != robots[robot].cell:
                verdict = enter(t, s, c, w, log, how, ids, step, robot, cell, size)
            if verdict != ACTS:
                if verdict < ACTS:  # GROUP_SPLITS or CUT
                    return verdict
                size = group.last - group.first  # a tree's branch may have been cut
        if verdict == HIT:
            verdict = ACTS
            if not lose(t, s, c, w, log, robot):
                return AREAS_FULL
            compare_again(s)  # prices may depend on the robots alive
            left = np.uint64(0) if t.moving and is_meeting(s) else acting(t, p, s, word, robot % WORD)
            continue
        if verdict == PASSED:
            verdict = ACTS
            if not t.moving:  # else it survives at the end of the step
                survive(t, s, c, step, robot, cell, size)
                if t.estimates:
                    update_belief(t, s, cell)
        if p is None:
            turn = arrive(t, p, s, w, log, how, robot, cell)
        else:
            turn = RESTS if passes(t, s, w, robot, cell) else arrive_called(t, p, s, w, log, how, robot, cell)
        if turn == NO_ROOM:
            return AREAS_FULL
        if turn != MOVES:  # later robots of this step see what has changed
            left = acting(t, p, s, word, robot % WORD)


@kernel
def forget(t, p, s, w):
    """Reset the scratch arrays, which another group may have used."""
    if p is not None:
        for robot in range(len(s.robots)):
            w.kept[robot, 0] = NONE
    if t.learns:
        recall(t, s, w)


@kernel
def acting(t, p, s, word, after):
    """Bits of the robots of a word, with index above `after`, that act in this step: they move or may take an area."""
    robots = s.moving[word]
    if s.marks.open > 0 or (p is not None and len(p.most) > 0):  # a held robot asks again in every step
        robots |= s.waiting[word]
    robots = on_turn(t, s.marks.step, word, robots)
    return robots & (~np.uint64(1) << np.uint64(after)) if after >= 0 else robots


@rare_kernel
def arrive_called(t, p, s, w, log, how, robot, cell):
    """`arrive` as a call that is not inlined."""
    return arrive(t, p, s, w, log, how, robot, cell)


@kernel
def arrive(t, p, s, w, log, how, robot, cell):
    """Act on the cell that the robot entered and survived: MOVES on, or another result of a turn; NO_ROOM."""
    if t.returns and s.robots[robot].doing == RETURNING:
        move_to_base(t, s, log, robot)
        return RESTS
    if t.radio and came_back(t, s, robot):
        return RESTS if end_range(t, s, w, log, robot) else NO_ROOM
    if own_turn(t, robot, s.marks.step) == s.robots[robot].until:
        return RESTS if stay(t, s, w, log, robot) else NO_ROOM
    if p is None:
        return fixed_paths.arrive(t, s, w, log, how, robot, cell)
    return replanning.arrive(t, p, s, w, log, how, robot, cell)


@rare_kernel
def encounter(t, s, c, w, how, ids):
    """Let moving threats move and meet robots (`meet`); robots that are not lost survive in their cells."""
    verdict = meet(t, s, w, how, ids)
    if verdict == ACTS:
        for robot in range(len(s.robots)):
            if has_entered(s, robot):
                survive(t, s, c, s.marks.step, robot, s.robots[robot].cell, s.marks.last - s.marks.first)
        s.entered[:] = np.uint64(0)
    return verdict


@rare_kernel
def learn_and_end(t, p, s, c, w, log, how, ids):
    """Update the map, then `end_step`; a call, since LLVM takes minutes if it is inlined."""
    if t.learns:
        got = learn(t, p, s, w, log, how, ids)
        if got == NO_ROOM:
            return np.int64(AREAS_FULL)
        s.marks.progress |= got
    return end_step(t, p, s, c, w, log, how)


@kernel
def end_step(t, p, s, c, w, log, how):
    """End the step: the run may end. Returns the Outcome, NONE to go on, or AREAS_FULL."""
    group = s.marks
    group.quiet = 0 if group.progress else group.quiet + 1
    if t.returns and not call_back(t, p, s, w, log):
        return np.int64(AREAS_FULL)
    if group.step < len(log.frames):
        write_frame(log, s, group.step)
    outcome = over_by(t, p, s, w, np.int64(end_of(t, s, how)))
    if outcome != NONE:
        return outcome
    robot = only_moving_robot(t, p, s, log)
    if robot != NONE:
        group.step = walk_alone(t, p, s, c, w, how, robot)
    group.step += 1
    group.progress = 0
    return outcome


@rare_kernel
def call_back(t, p, s, w, log):
    """Send robots back to base that would be late, and all robots once the mission is over. False: no room."""
    return start_returns(t, s, w, log, over_by(t, p, s, w, np.int64(is_over(t, s))))


@kernel
def over_by(t, p, s, w, outcome):
    """The outcome; NOT_WORTH_THE_RISK for no progress where robots refuse an area within reach."""
    if p is not None and outcome == NO_PROGRESS and could_go_on(t, p, s, w):
        return np.int64(NOT_WORTH_THE_RISK)
    return outcome


@rare_kernel
def learn(t, p, s, w, log, how, ids):
    """Update the map: GAINS if it changed (progress: robots without an area ask again), else RESTS; NO_ROOM."""
    count, fresh = update_map(t, s, w, how, ids)
    if p is not None and fresh and len(p.view_begin) > 0:
        s.marks.changes += 1  # areas would reveal fewer cells: cached offers are void
    if count == 0:
        return RESTS
    got = GAINS if revise(t, s, w, log, count) else NO_ROOM
    compare_again(s)
    for robot in range(len(s.robots)):
        if got != NO_ROOM and has_area(s.robots, robot):
            if p is None:
                more = fixed_paths.repair_plan(t, s, w, log, how, robot)
            else:
                more = replanning.repair_plan(t, p, s, w, log, how, robot)
            got = NO_ROOM if more == NO_ROOM else got
    clear_changes(w, count)
    return got


@kernel
def is_over(t, s):
    """The outcome if nothing is left to do, in the order of SPEC section 5; else NONE."""
    if is_complete(t, s):
        return COMPLETE
    if s.marks.alive == 0:
        return ALL_ROBOTS_LOST
    return NO_PROGRESS if s.marks.quiet >= t.quiet_steps and not awaits_update(t, s) else NONE


@rare_kernel
def awaits_update(t, s):
    """Whether a robot that can move waits for an announced phase that changes the map."""
    if s.marks.step + 1 >= t.last_update:
        return False
    able = np.uint64(0)
    for word in range(len(s.moving)):
        able |= s.moving[word] | s.waiting[word]
    return able != 0


@kernel
def end_of(t, s, how):
    """The outcome if the run ends after this step, else NONE."""
    if t.returns:
        return end_at_home(t, s, how)
    over = is_over(t, s)
    return STEP_LIMIT if over == NONE and s.marks.step >= how.max_steps else over


@rare_kernel
def end_at_home(t, s, how):
    """`end_of` for a mission in which robots return to base."""
    over = s.marks.over - 1
    if s.marks.alive == 0:  # also on the way to base, whatever ended the mission
        over = ALL_ROBOTS_LOST
    elif over == NONE or is_away(s):
        over = STEP_LIMIT if s.marks.step >= how.max_steps else NONE
    if over == NONE:
        return over
    count_at_base(t, s)
    return COMPLETE if is_complete(t, s) else over
