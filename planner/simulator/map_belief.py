"""Online missions: sensor range, map updates, and the repair of areas after them; also phases, and hazard estimates.

The team's map is part of a group's state, since it follows from the group's history: its rollouts share it until they
split. A cell in no area (an obstacle, out of reach, or left over) has the area NOWHERE. It looks visited, so that no
robot heads for it.
"""

import numpy as np

from .areas import SURPRISED_EVENT, close, has_area, note, reopen, room_of
from .codes import ALWAYS, COVERING, DEAD, DONE, NEVER, NONE, RETURNING
from .failure_sampling import own_word, threefry
from .jit import kernel, rare_kernel
from .range_budget import find_ways_to_base, moves_home
from .robot_types import own
from .state import (
    ALARM,
    AREA_BITS,
    BELIEF,
    DETECTS,
    ERRS,
    LESS,
    LOOKED,
    MORE,
    OUT,
    SEEN,
    SILENCE,
    SURVIVED,
    TO_DO,
    TRUTH,
    VISITED,
    WORD,
    drop,
    holds,
)

GONE, WHOLE, BROKEN, TOUCHED, OWNED = range(5)
"""`State.fate` of an area: completed; unassigned; to be split; to be joined; OWNED + robot: that robot's."""


@rare_kernel
def sensor_cells(t, s, w):
    """Update the map with the sensor range of live robots, from cells not looked from before.

    Returns:
        (number of changed cells, which `w.updated` lists; whether a cell was seen for the first time).
    """
    truth, count, fresh = t.truths[s.mind[TRUTH]], 0, False
    for robot in range(len(s.robots)):
        here = s.robots[robot].cell
        # The true map does not change, so a second look from a cell shows nothing new.
        if s.robots[robot].doing == DEAD or s.known[here] & LOOKED:
            continue
        s.known[here] |= LOOKED
        for place in range(t.view_begin[here], t.view_begin[here + 1]):
            cell = t.in_view[place]
            if s.known[cell] & SEEN == 0:
                s.known[cell] |= SEEN
                fresh = True
                count = believe(t, s, w, cell, truth[cell], count)
    return count, fresh


@kernel
def believe(t, s, w, cell, level, count):
    """Set a cell's level on the team's map; the number of changed cells by now, which `w.updated` lists."""
    if s.level[cell] == level:
        return count
    change_level(t, s, cell, level)
    w.updated[count] = cell
    return count + 1


@kernel
def change_level(t, s, cell, level):
    """Change a cell's level on the team's map; NONE: an obstacle."""
    blocked = level < 0
    s.level[cell], s.entry[cell] = level, 0 if blocked else t.price[level]
    for side in range(4):
        other = t.near[cell, side]
        if other < len(t.near):
            # Sides are N, W, E, S: the cell is on the opposite side of its neighbour.
            s.near[other, 3 - side] = len(t.near) if blocked else cell


@rare_kernel
def revise(t, s, w, log, count):
    """Repair the areas after `count` changed cells, marked in `w.gone`; False: the area registry is full."""
    # Order: paths to base and connected parts first, since both decide which cells stay in areas.
    note(log, s, NONE, SURPRISED_EVENT, NONE, count)
    for place in range(count):
        w.gone[w.updated[place]] = 1
    w.minds[0] += 1
    s.mind[BELIEF] = w.minds[0]
    recall(t, s, w)
    s.marks.robot = len(s.robots)  # all have had their turns
    for robot in range(len(s.robots)):
        if s.robots[robot].doing == RETURNING:
            head_home(t, s, robot)
    label_parts(t, s, w)
    set_fates(s)
    if not remove_changed(t, s, w) or not add_reachable(t, s, w):
        return False
    rebuild_order(s)
    s.marks.changes += 1
    return True


@kernel
def clear_changes(w, count):
    """Clear the marks of changed cells after the repair."""
    for place in range(count):
        w.gone[w.updated[place]] = 0


@kernel
def head_home(t, s, robot):
    """Update the next cell of a returning robot; a robot cut off from all bases stays."""
    here = np.int64(s.robots[robot].cell)
    if moves_home(t, robot, here) > 0:
        s.robots[robot].next = t.onward[t.home_of[robot], here]
    else:
        drop(s.moving, robot)
        s.robots[robot].doing = DONE


@rare_kernel
def recall(t, s, w):
    """Drop cached costs, and recompute ways to base, if the thread's are of another map."""
    # A thread runs several groups in turn; rows of costs are valid for one map only.
    if w.minds[1] != s.mind[BELIEF]:
        w.minds[1] = s.mind[BELIEF]
        for row in range(len(w.source_of)):
            if w.source_of[row] != NONE:
                w.row_of[w.source_of[row]] = w.source_of[row] = NONE
        w.last[0] = NONE
        if t.returns:
            find_ways_to_base(t, s, w)


@rare_kernel
def adopt_map(t, s, w):
    """Give the map of a group from another thread a new index; 0 is the prior map, which all threads share."""
    # Indices of maps are counted per thread, so another thread's index may be in use here for another map.
    if s.mind[BELIEF] > 0:
        w.minds[0] += 1
        s.mind[BELIEF] = w.minds[0]
    recall(t, s, w)


@kernel
def label_parts(t, s, w):
    """`w.part`: index, from 1, of the connected part of the map of each cell that a live robot can reach, else 0."""
    part, stack, parts = w.part, w.stack, 0
    for cell in range(len(part)):
        part[cell] = 0
    part[len(t.near)] = NONE  # blocked neighbours end the search
    for robot in range(len(s.robots)):
        first = s.robots[robot].cell
        if s.robots[robot].doing == DEAD or part[first] > 0:
            continue
        parts += 1
        part[first], stack[0], top = parts, first, 1
        while top > 0:
            top -= 1
            here = stack[top]
            for side in range(4):
                cell = s.near[here, side]
                if part[cell] == 0:
                    part[cell], stack[top] = parts, cell
                    top += 1


@kernel
def set_fates(s):
    """Set `State.fate` of every area; `root` of unassigned areas: no part of the map yet."""
    for area in range(s.marks.areas):
        s.fate[area], s.areas[area].root = WHOLE if holds(s.open, area) else GONE, 0
    s.fate[room_of(s)] = GONE
    for robot in range(len(s.robots)):
        area = s.robots[robot].area
        if has_area(s.robots, robot) and s.areas[area].left > 0:
            s.fate[area] = OWNED + robot


@kernel
def remove_from_area(s, cell):
    """Remove the cell from its area."""
    home, flags = s.home[cell], VISITED | SURVIVED
    # A visited cell keeps its flags, so that it still counts; an unvisited one may join an area later (OUT).
    if home & VISITED:
        flags &= home
    else:
        s.areas[home >> AREA_BITS].left -= 1
        s.known[cell] |= OUT
    s.home[cell] = room_of(s) << AREA_BITS | flags


@kernel
def remove_changed(t, s, w):
    """Remove changed and unreachable cells from their areas; False: the area registry is full."""
    for cell in range(len(t.near)):
        fate = s.fate[s.home[cell] >> AREA_BITS]
        if fate == GONE:
            continue
        if fate >= OWNED:
            robot = fate - OWNED
            # An owned area stays one area, even if disconnected: only cells out of the robot's reach leave it.
            if w.gone[cell] or w.part[cell] != w.part[s.robots[robot].cell]:
                if s.home[cell] & TO_DO and s.robots[robot].doing == COVERING:
                    s.robots[robot].left -= 1
                remove_from_area(s, cell)
            continue
        area = s.home[cell] >> AREA_BITS
        if s.areas[area].root == 0:
            s.areas[area].root = w.part[cell]
        if w.gone[cell] or w.part[cell] == 0 or w.part[cell] != s.areas[area].root:
            s.fate[area] = BROKEN
    room = True
    for area in range(s.marks.areas):
        if room and s.fate[area] == BROKEN:
            room = split_area(t, s, w, area)
    return room


@kernel
def split_area(t, s, w, area):
    """Split an unassigned area into the components of its remaining cells; the first keeps the id. False: full."""
    begin, end = s.areas[area].begin, s.areas[area].end
    for place in range(begin, end):
        cell = s.order[place]
        if s.home[cell] & VISITED or w.gone[cell] or w.part[cell] == 0:
            remove_from_area(s, cell)
        else:
            s.home[cell] = area << AREA_BITS  # clears TO_DO of a robot that gave the area back
    w.stamp[0] += 1
    stamp, wanted, number = w.stamp[0], area << AREA_BITS, area
    for place in range(begin, end):
        first = s.order[place]
        # The component of the lowest cell is met first and keeps the area's id.
        if s.home[first] != wanted or w.seen[first] == stamp:
            continue
        w.seen[first], w.stack[0], head, tail = stamp, first, 0, 1
        while head < tail:
            here = w.stack[head]
            head += 1
            for side in range(4):
                cell = t.near[here, side]
                if s.home[cell] == wanted and w.seen[cell] != stamp:
                    w.seen[cell], w.stack[tail] = stamp, cell
                    tail += 1
        if number == NONE:
            new = append(s, s.areas[area].level)
            if new == NONE:
                return False
            hold(s, w, new, tail)
            s.areas[area].left -= tail
            if t.notes:
                t.notes.areas(s)
        number = NONE
    s.fate[area] = WHOLE
    if number != NONE:
        s.fate[area] = GONE
        close(s, area)
    return True


@kernel
def append(s, level):
    """A new unassigned area, without cells yet; NONE: the area registry is full."""
    new = s.marks.areas
    # The index `room_of` stands for "in no area".
    if new + 1 >= room_of(s):
        return NONE
    s.areas[new].begin = s.areas[new].end = s.areas[new].left = s.areas[new].root = 0
    s.areas[new].level, s.fate[new] = level, WHOLE
    if new % WORD == 0:
        s.open[new // WORD] = s.lowest[new // WORD] = 0
    s.marks.areas = new + 1
    reopen(s, new)
    return new


@kernel
def hold(s, w, area, count):
    """Add the first `count` cells of the stack to the area."""
    for place in range(count):
        cell = w.stack[place]
        s.home[cell] = area << AREA_BITS
        s.known[cell] &= SEEN | LOOKED
    s.areas[area].left += count


@kernel
def add_reachable(t, s, w):
    """Add reachable unvisited cells in no area to adjacent unassigned areas, or to new ones; False: registry full."""
    w.stamp[0] += 1
    stamp = w.stamp[0]
    for first in range(len(t.near)):
        # In increasing order of cells, so new ids do not depend on which robot saw a cell.
        if s.known[first] & OUT == 0 or w.part[first] == 0 or w.seen[first] == stamp:
            continue
        level = s.level[first]
        w.seen[first], w.stack[0], head, tail, touched = stamp, first, 0, 1, 0
        while head < tail:
            here = w.stack[head]
            head += 1
            for side in range(4):
                cell = s.near[here, side]
                if cell == len(t.near) or s.level[cell] != level:
                    continue
                area = s.home[cell] >> AREA_BITS
                if s.known[cell] & OUT:
                    if w.seen[cell] != stamp:
                        w.seen[cell], w.stack[tail] = stamp, cell
                        tail += 1
                elif s.fate[area] == WHOLE:
                    s.fate[area], w.listed[touched] = TOUCHED, area
                    touched += 1
        area = join(s, w, touched) if touched > 0 else append(s, level)
        if area == NONE:
            return False
        hold(s, w, area, tail)
        if t.notes:
            t.notes.areas(s)
    return True


@kernel
def join(s, w, count):
    """Join the listed areas to the one of lowest id."""
    # The oldest id is kept: ties by id stay as they were.
    lowest = np.int64(w.listed[0])
    for place in range(1, count):
        lowest = min(lowest, np.int64(w.listed[place]))
    for place in range(count):
        area = np.int64(w.listed[place])
        if area != lowest:
            merge(s, area, lowest)
    s.fate[lowest] = WHOLE
    return lowest


@kernel
def merge(s, area, into):
    """Move all cells of an unassigned area to another one."""
    for cell in range(len(s.level)):
        if s.home[cell] >> AREA_BITS == area:
            s.home[cell] = into << AREA_BITS | s.home[cell] & (VISITED | SURVIVED)
    s.areas[into].left += s.areas[area].left
    s.areas[area].left, s.fate[area] = 0, GONE
    close(s, area)


@kernel
def rebuild_order(s):
    """Rebuild `order`, the cells of every area increasing."""
    for area in range(s.marks.areas):
        s.areas[area].end = 0
    out = room_of(s)
    for cell in range(len(s.level)):
        area = s.home[cell] >> AREA_BITS
        if area != out:
            s.areas[area].end += 1
    begin = 0
    for area in range(s.marks.areas):
        size = s.areas[area].end
        s.areas[area].begin = s.areas[area].end = begin
        begin += size
    for cell in range(len(s.level)):
        area = s.home[cell] >> AREA_BITS
        if area != out:
            s.order[s.areas[area].end] = cell
            s.areas[area].end += 1


@kernel
def is_lost(s, w, robot):
    """Whether a cell of the robot's leg has changed, or cannot be reached any more."""
    me, mine = s.robots[robot], w.part[s.robots[robot].cell]
    lost = w.gone[me.next] != 0 or w.part[me.next] != mine
    for place in range(me.ahead):
        cell = s.legs[robot, place]
        lost = lost or w.gone[cell] != 0 or w.part[cell] != mine
    return lost


# Threats that change by phases: a function of the step, so all rollouts of a group have the same phase.


@rare_kernel
def phase_at(t, step):
    """The phase of the step."""
    phase = len(t.phases) - 1
    while t.phases[phase] > step:
        phase -= 1
    return phase


@kernel
def visit_of(t, s, robot, cell):
    """Index of the robot's visit to the cell in this step, in `Tables.bound`, `exposure` and `chance`."""
    return own(t, robot, cell) if not t.phased else cell + len(t.near) * phase_at(t, s.marks.step)


@rare_kernel
def update_to_phase(t, s, w):
    """Update the map at the last step before a phase; the number of changed cells, which `w.updated` lists."""
    next_step, count = s.marks.step + 1, 0
    phase = phase_at(t, next_step)
    if s.marks.alive > 0 and t.phases[phase] == next_step:
        for cell in range(len(t.near)):
            count = believe(t, s, w, cell, t.truths[phase, cell], count)
    return count


# Estimates of latent hazards.
#
# Rollouts of a group have the same losses and survived visits, so they share log odds until they split. Detector
# readings differ between rollouts: then each rollout is a group.


@kernel
def update_map(t, s, w, how, ids):
    """Update the map by phases, sensor range or estimates: (changed cells, whether a cell was seen first)."""
    if t.phased:
        return update_to_phase(t, s, w), False
    return sensor_cells(t, s, w) if not t.estimates else (update_from_estimates(t, s, w, how, ids), False)


@kernel
def add(s, cell, said):
    """Add evidence to the log odds of a hazard in the cell; certain states stay."""
    # Certain evidence would overflow the sums, and nothing outweighs it.
    if s.odds[cell] != ALWAYS and s.odds[cell] != NEVER:
        sure = abs(said) == ALWAYS
        s.odds[cell] = said if sure else s.odds[cell] + said


@rare_kernel
def update_belief(t, s, cell):
    """Update the estimate after a robot survived a visit of the cell."""
    add(s, cell, -t.survival[cell])


@rare_kernel
def update_from_estimates(t, s, w, how, ids):
    """Update the map by the estimates at robots and in detector range; the number of changed cells, in `w.updated`."""
    if s.marks.alive == 0:
        return 0
    reads, count = t.evidence[DETECTS] > 0, 0
    for robot in range(len(s.robots)):
        if reads and s.robots[robot].doing != DEAD:
            read(t, s, how, ids[s.marks.first], robot)
    for robot in range(len(s.robots)):
        here = np.int64(s.robots[robot].cell)
        count = apply_estimate(t, s, w, here, count)
        if reads and s.robots[robot].doing != DEAD:
            for place in range(t.view_begin[here], t.view_begin[here + 1]):
                count = apply_estimate(t, s, w, np.int64(t.in_view[place]), count)
    return count


@kernel
def read(t, s, how, rollout, robot):
    """Draw the detector readings of a robot in this step, and add them to the estimates."""
    # Addressed by (rollout, step, robot, cell): a reading does not depend on which other readings were drawn.
    key0, key1 = threefry(how.read0, how.read1, rollout, np.uint32(s.marks.step))
    here = s.robots[robot].cell
    for place in range(t.view_begin[here], t.view_begin[here + 1]):
        cell = np.int64(t.in_view[place])
        there = own_word(t, how, rollout, cell) < t.there[cell] and not (t.spends and holds(s.spent, cell))
        word = threefry(np.uint32(key0), np.uint32(key1), np.uint32(robot), t.own_counter[cell])[0] >> np.uint32(8)
        alarm = np.int64(word) < t.evidence[DETECTS if there else ERRS]
        add(s, cell, t.evidence[ALARM] if alarm else -t.evidence[SILENCE])


@kernel
def apply_estimate(t, s, w, cell, count):
    """Set the level of a cell by its estimate; the number of changed cells by now."""
    level = t.truths[class_of(t, s, cell), cell]
    return count if level < 0 and is_occupied(s, cell) else believe(t, s, w, cell, level, count)


@kernel
def is_occupied(s, cell):
    """Whether a live robot is in the cell, which then does not become an obstacle yet."""
    found = False
    for robot in range(len(s.robots)):
        found = found or (s.robots[robot].cell == cell and s.robots[robot].doing != DEAD)
    return found


@kernel
def class_of(t, s, cell):
    """The class of a cell's estimate (`planner.world.map_knowledge.Evidence.class_of`)."""
    odds = s.odds[cell]
    if odds == NEVER:
        return np.int64(0)
    if odds == ALWAYS:
        return np.int64(1)
    lost = t.odds[cell] - odds
    # There are finitely many classes; beyond the last one estimates saturate.
    steps = min(lost // t.step[cell], t.evidence[LESS]) if lost >= 0 else -min(-lost // t.step[cell], t.evidence[MORE])
    return 2 + t.evidence[MORE] + steps
