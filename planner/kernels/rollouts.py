"""Algorithm 2 compiled with Numba: sets of rollouts that part where a robot is hit, counted into tallies.

A run is the same for all rollouts as long as they are hit alike. So one simulation carries a set of rollouts; where a
robot enters a dangerous cell each of them draws, and the set parts: who is not hit waits with a copy of the state,
the others go on. At the end of a run the set is counted, and those who came to wait last go on, depth first. No count
depends on the order. How a set runs: `planner.kernels.runs`. Axis letters as in `planner.kernels.state`.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, program, rare_kernel
from planner.kernels.handed import flat, hand
from planner.kernels.runs import advance
from planner.kernels.state import (
    AHEAD,
    ALIVE,
    AREA_WORDS,
    AREAS,
    AREAS_FULL,
    BISECTED,
    COVERED,
    DIVIDED,
    FIRST,
    HIT,
    LAST,
    PARTED,
    PASSED,
    ROBOT_WORDS,
    STEP,
    UNSURVIVED,
    VERDICT,
    VISITED,
    WORD,
    State,
)


@kernel
def level_of(stack, level):
    """One level of the stack."""
    return State(
        stack.home[level], stack.order[level], stack.areas[level], stack.robots[level], stack.legs[level],
        stack.marks[level], stack.last[level], stack.movers[level], stack.waiting[level], stack.open[level],
        stack.lowest[level], stack.spent[level], stack.passes[level],
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
    copy_row(flat(of.areas), flat(to.areas), areas * AREA_WORDS)
    copy_row(flat(of.robots), flat(to.robots), len(of.robots) * ROBOT_WORDS)
    for robot in range(of.legs.shape[0]):
        copy_row(of.legs[robot], to.legs[robot], of.robots[robot, AHEAD])
    copy_row(of.marks, to.marks, len(of.marks))
    copy_row(of.last, to.last, len(of.last))
    copy_row(of.movers, to.movers, len(of.movers))
    copy_row(of.waiting, to.waiting, len(of.waiting))
    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)
    copy_row(of.lowest, to.lowest, (areas + WORD - 1) // WORD)
    copy_row(of.spent, to.spent, len(of.spent))
    copy_row(of.passes, to.passes, len(of.passes))


@rare_kernel
def count_passes(s, c, ids, start, singles):
    """Add a set's survived visits by cell, and what its cells add up to in each of its rollouts."""
    first, last, covered, found = s.marks[FIRST], s.marks[LAST], np.int64(0), np.int64(0)
    for cell in range(len(s.passes)):
        passes = np.int64(s.passes[cell])
        for times in range(passes):
            c.passes[cell, times] += last - first
        if s.home[cell] & VISITED:
            covered += singles.covered[cell]
            found += singles.found[cell, passes]
    if len(singles.worth) > 0:
        for place in range(first, last):
            worth = singles.worth[ids[place] - start]
            worth[0], worth[1] = covered, found


@kernel
def count_set(s, c, ids, start, singles, outcome):
    """Add a set at the end of its run."""
    marks, first, last = s.marks, s.marks[FIRST], s.marks[LAST]
    size, covered, safely = last - first, marks[COVERED], marks[COVERED] - marks[UNSURVIVED]
    c.visited[covered] += size
    c.survived[safely] += size
    c.time[marks[STEP]] += size
    c.alive[marks[ALIVE]] += size
    c.outcomes[outcome] += size
    if len(s.passes) > 0:
        count_passes(s, c, ids, start, singles)
    if len(singles.numbers) > 0:
        for place in range(first, last):
            single = singles.numbers[ids[place] - start]
            single[0], single[1], single[2], single[3] = covered, safely, marks[STEP], marks[ALIVE]
            single[4], single[5], single[6] = outcome, marks[BISECTED], marks[DIVIDED]


@kernel
def go_on_with(s, c, stack, ids, start, singles, level, last, found):
    """The level of the set that goes on after `found`: those who were hit, with a copy of the state, while the others
    wait in `s`; or, since the run has ended, who came to wait last. `last`: where the set ended before it parted.
    """
    if found == PARTED:
        s.marks[VERDICT] = PASSED
        hit = hand(level_of(stack, level + 1))
        copy_state(s, hit)
        hit.marks[FIRST], hit.marks[LAST], hit.marks[VERDICT] = s.marks[LAST], last, HIT
        return level + 1
    count_set(s, c, ids, start, singles, found)
    return level - 1


@program
def run_set(t, c, stack, w, log, how, ids, start, singles):
    """Rollouts `ids`, uint32 `[B]`, which become disordered, with a stack of `planner.kernels.state.State`.

    `singles`: what is kept of each rollout by id from `start` on. Returns False if one needed more areas than the state
    has room for (the counts are then void).
    """
    tables, counts, work, logged, options = hand(t), hand(c), hand(w), hand(log), hand(how)
    copy_state(hand(level_of(stack, 0)), hand(level_of(stack, 1)))
    stack.marks[1, FIRST], stack.marks[1, LAST] = 0, len(ids)
    level = 1
    while level > 0:
        s = hand(level_of(stack, level))
        last = s.marks[LAST]
        found = advance(tables, s, counts, work, logged, options, ids)
        if found == AREAS_FULL:
            return False
        level = go_on_with(s, counts, stack, ids, start, singles, level, last, found)
    return True
