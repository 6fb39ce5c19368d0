"""Moving threats (SPEC section 16): they move after the robots' turns, and a group splits where a robot is lost.

Positions of threats differ from rollout to rollout and do not depend on the robots. So they are kept for each rollout,
at the step of its group.
"""

import numpy as np

from .codes import ACTS, DEAD, GROUP_SPLITS, HIT
from .failure_sampling import split_ids, threefry
from .jit import kernel, rare_kernel
from .state import HITS, ROUTE, ROUTE_LENGTH, STAYS, holds


@kernel
def is_meeting(s):
    """Whether threats have moved in this step: the robots have had their turns."""
    return s.marks.threats_moved > s.marks.step


@kernel
def moved(t, cell, number):
    """The free neighbour, of N, W, E, S, that a 24-bit random number selects; the cell itself if none is free."""
    blocked, ways = len(t.near), np.int64(0)
    if cell == blocked:
        return cell
    for side in range(4):
        ways += np.int64(t.near[cell, side]) != blocked
    # 24 random bits scaled by a multiplication: no division, and the same in every engine.
    way = number * ways >> 24
    for side in range(4):
        neighbour = np.int64(t.near[cell, side])
        if neighbour != blocked:
            if way == 0:
                return neighbour
            way -= 1
    return cell


@kernel
def move_threats(t, s, w, how, ids, step):
    """Move the threats in all rollouts of the group."""
    count = len(t.moving_threats)
    stays, where = w.moves[0], w.moves[1]
    for place in range(s.marks.first, s.marks.last):
        at = w.at[ids[place] - w.begin[0]]
        # A separate loop over the draws, so that LLVM vectorises it.
        for number in range(count):
            # Addressed by (rollout, step, threat): positions do not depend on how the group has split.
            counter = np.uint32((step + 1) * count + number)
            stays[number], where[number] = threefry(how.move0, how.move1, ids[place], counter)
        for number in range(count):
            length = t.moving_threats[number, ROUTE_LENGTH]
            if length > 0:
                at[number] = at[number] + 1 if at[number] + 1 < length else 0
            elif np.int64(stays[number] >> np.uint32(8)) >= t.moving_threats[number, STAYS]:
                at[number] = moved(t, np.int64(at[number]), np.int64(where[number] >> np.uint32(8)))


@kernel
def first_met(t, s, w, how, rollout, step, after):
    """The lowest robot above `after` that a threat destroys in a rollout, K if none.

    `w.here` holds for each cell the lowest robot in it, plus 1.
    """
    robots, count, at = s.robots, len(t.moving_threats), w.at[rollout - w.begin[0]]
    least = np.int64(len(robots))
    for number in range(count):
        cell = np.int64(at[number])
        if t.moving_threats[number, ROUTE_LENGTH] > 0:
            cell = np.int64(t.routes[t.moving_threats[number, ROUTE] + cell])
        # Most threats meet no robot: one lookup per threat instead of a loop over the robots.
        if w.here[cell] == 0:
            continue
        for robot in range(max(w.here[cell] - 1, after + 1), least):
            if robots[robot].cell == cell and robots[robot].doing != DEAD:
                counter = np.uint32((step * count + number) * len(robots) + robot)
                word = threefry(how.meet0, how.meet1, rollout, counter)[0] >> np.uint32(8)
                if np.int64(word) < t.moving_threats[number, HITS]:
                    least = robot
                    break
    return least


@kernel
def find_losses(t, s, w, how, ids, first, last, after):
    """Find the next robot above `after` that is lost in each of the rollouts `ids[first:last]`."""
    robots = s.robots
    # Downwards, so that the lowest robot of a cell is written last.
    for back in range(len(robots)):
        robot = len(robots) - 1 - back
        if robots[robot].doing != DEAD:
            w.here[robots[robot].cell] = robot + 1
    for place in range(first, last):
        w.met[ids[place] - w.begin[0]] = first_met(t, s, w, how, ids[place], s.marks.step, after)
    for robot in range(len(robots)):
        w.here[robots[robot].cell] = 0


@rare_kernel
def meet(t, s, w, how, ids):
    """Continue the encounters of a step: HIT or GROUP_SPLITS for the next loss; ACTS after the last one."""
    marks = s.marks
    first, last = marks.first, marks.last
    if not is_meeting(s):
        move_threats(t, s, w, how, ids, marks.step)
        marks.threats_moved = marks.step + 1
        find_losses(t, s, w, how, ids, first, last, np.int64(-1))
    next_one = np.int64(len(s.robots))
    for place in range(first, last):
        next_one = min(next_one, np.int64(w.met[ids[place] - w.begin[0]]))
    if next_one == len(s.robots):
        return ACTS
    mine, room = ids[first:last], w.words[: last - first]
    for index in range(len(mine)):
        # Robots are lost in index order, as in a loop over robots: rollouts that lose this one split off now.
        room[index] = w.met[mine[index] - w.begin[0]] != next_one
    lost_from = first + split_ids(mine, room, 1)
    find_losses(t, s, w, how, ids, lost_from, last, next_one)
    marks.robot = next_one
    if lost_from == first:
        return HIT
    marks.last = lost_from
    return GROUP_SPLITS


@kernel
def has_entered(s, robot):
    """Whether the robot is alive and has entered its cell in this step."""
    return holds(s.entered, robot) and s.robots[robot].doing != DEAD
