"""Algorithm 2 compiled with Numba: groups of rollouts that split where a robot is lost, counted into tallies.

Rollouts with the same losses are the same run, so they are simulated as one group. Where a visit destroys a robot in
some rollouts and not in others, the group splits: those in which the robot survives wait with the old state, the others
go on with a copy. At the end of a run the group is counted, and the group that waited last goes on, depth first. No
count depends on the order. `planner.simulator.step` runs a group. Axis letters as in `planner.simulator.state`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, overload

from .codes import AREAS_FULL, CUT, GROUP_SPLITS, HIT, NONE, PASSED
from .jit import kernel, program, rare_kernel, spliced
from .map_belief import adopt_map
from .state import MOST_PASSES, NOWHERE_LEVEL, OUT, VISITED, WORD, State
from .step import advance
from .struct_pointers import flat, hand
from .visits import count_scores


def take(taken):
    """Index of the next task, taken atomically: no two threads get the same one."""
    taken[0] += 1
    return int(taken[0]) - 1


@intrinsic
def _add_one(typing_context: Any, taken: Any) -> Any:
    def add(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(taken), add


@overload(take)
def _compiled_take(taken):
    return lambda taken: _add_one(taken)


@spliced
def level_of(stack, level):
    """One level of the stack."""
    return State(
        stack.home[level], stack.order[level], stack.areas[level], stack.robots[level], stack.marks[level],
        stack.moving[level], stack.waiting[level], stack.open[level], stack.lowest[level],
        stack.passes[level], stack.legs[level], stack.spent[level], stack.entered[level], stack.heard[level],
        stack.near[level], stack.entry[level], stack.level[level], stack.known[level], stack.fate[level],
        stack.mind[level], stack.odds[level], stack.undelivered[level],
    )  # fmt: skip


@kernel
def copy_row(of, to, count):
    """Copy the first `count` elements of a row."""
    for place in range(count):
        to[place] = of[place]


@kernel
def copy_state(t, of, to):
    """Copy the used part of a level, without its `marks`: Numba copies records only as array elements."""
    areas = of.marks.areas
    copy_row(of.home, to.home, len(of.home))
    copy_row(of.order, to.order, len(of.order))
    copy_row(of.areas, to.areas, areas)
    copy_row(of.robots, to.robots, len(of.robots))
    for robot in range(of.legs.shape[0]):
        # A cached path is in `Work`, which all levels of a thread share.
        if of.robots[robot].path == 0:
            copy_row(of.legs[robot], to.legs[robot], of.robots[robot].ahead)
    copy_row(of.moving, to.moving, len(of.moving))
    copy_row(of.waiting, to.waiting, len(of.waiting))
    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)
    copy_row(of.lowest, to.lowest, (areas + WORD - 1) // WORD)
    copy_row(of.spent, to.spent, len(of.spent))
    copy_row(of.passes, to.passes, len(of.passes))
    copy_row(of.entered, to.entered, len(of.entered))
    if t.returns:
        copy_row(flat(of.undelivered), flat(to.undelivered), len(of.undelivered) * of.undelivered.shape[1])
    if t.learns:
        copy_mind(of, to)


@rare_kernel
def copy_mind(of, to):
    """Copy the team's map in an online mission."""
    copy_row(flat(of.near), flat(to.near), 4 * len(of.near))
    copy_row(of.entry, to.entry, len(of.entry))
    copy_row(of.level, to.level, len(of.level))
    copy_row(of.known, to.known, len(of.known))
    copy_row(of.mind, to.mind, len(of.mind))
    copy_row(of.odds, to.odds, len(of.odds))
    to.areas[len(to.areas) - 1].level = NOWHERE_LEVEL


@rare_kernel
def count_passes(s, c, ids, singles):
    """Count a group's survived visits by cell, and the value of its cells in each of its rollouts."""
    first, last, covered, found = s.marks.first, s.marks.last, np.int64(0), np.int64(0)
    for cell in range(len(s.passes)):
        passes = min(np.int64(s.passes[cell]), MOST_PASSES)
        for times in range(passes):
            c.passes[cell, times] += last - first
        if s.home[cell] & VISITED and (len(s.known) == 0 or s.known[cell] & OUT == 0):
            covered += singles.covered[cell]
            found += singles.found[cell, passes]
    if len(singles.value_sums) > 0:
        for place in range(first, last):
            value_sums = singles.value_sums[ids[place] - singles.start]
            value_sums[0], value_sums[1] = covered, found


@kernel
def count_group(t, s, c, ids, singles, outcome):
    """Count a group at the end of its run.

    Args:
        ids: uint32 `[B]`, rollouts.
        singles: results of single rollouts, changed in place.
        outcome: of the run.
    """
    marks, first, last = s.marks, s.marks.first, s.marks.last
    size, covered, safely = last - first, marks.covered, marks.covered - marks.unsurvived
    c.visited[covered] += size
    c.survived[safely] += size
    c.time[marks.step] += size
    c.alive[marks.alive] += size
    c.outcomes[outcome] += size
    if len(c.home) > 0:
        c.home[marks.at_home] += size
    if len(c.delivered) > 0:
        c.delivered[marks.delivered] += size
    c.histories[0] += 1
    if t.scores:
        count_scores(s, c, covered, size)
    elif len(s.passes) > 0:
        count_passes(s, c, ids, singles)
    if len(singles.numbers) > 0:
        for place in range(first, last):
            single = singles.numbers[ids[place] - singles.start]
            single[0], single[1], single[2], single[3] = covered, safely, marks.step, marks.alive
            single[4], single[5], single[6], single[7] = outcome, marks.bisected, marks.divided, marks.at_home
            single[8] = marks.delivered


@kernel
def begin_next(t, stack, waiting, tasks, taken, w):
    """Load the next task into level 0 of the stack; False if all tasks are taken."""
    task = take(taken)
    if task >= len(tasks):
        return False
    first = hand(level_of(stack, 0))
    copy_state(t, hand(level_of(waiting, tasks[task, 0])), first)
    stack.marks[0] = waiting.marks[tasks[task, 0]]
    first.marks.first, first.marks.last = tasks[task, 1], tasks[task, 2]
    if t.learns:
        adopt_map(t, first, w)
    return True


@kernel
def go_on_with(t, s, c, stack, level, ids, singles, how, top, last, found):
    """Choose the level that goes on after `advance` returned `found`.

    After a split the rollouts that lost the robot get a copy of the state in a new level. They go on, or are deferred;
    the others stay in `s`. At the end of a run the group that waited last goes on.

    Args:
        stack: of states; level: that of `s`; top: topmost level in use.
        last: end of the group's ids before the split.
        found: result of `advance`.

    Returns:
        (level, NONE if none goes on; topmost level in use).
    """
    if found != GROUP_SPLITS:
        if found != CUT:
            count_group(t, s, c, ids, singles, found)
        # Its ids are counted: the level is empty.
        s.marks.last = s.marks.first
        return (top - 1, top - 1) if how.deferred == 0 else (NONE, top)
    # Survivors keep the level and wait; the others go on first, so levels never outnumber the robots.
    s.marks.verdict, top = PASSED, top + 1
    lost = hand(level_of(stack, top))
    copy_state(t, s, lost)
    stack.marks[top] = stack.marks[level]
    lost.marks.first, lost.marks.last, lost.marks.verdict = s.marks.last, last, HIT
    if how.deferred == 0:
        return top, top
    return 0 if top < how.deferred and s.marks.last > s.marks.first else NONE, top


@program
def run_group_tasks(t, p, c, waiting, tasks, taken, stack, w, log, how, ids, singles):
    """Run rollouts, with a stack of states.

    Args:
        p: the policy, None for the paper's rule.
        waiting: stack of states to start from.
        tasks: int64 `[N, 3]`, a level of `waiting`, and the begin and end of its rollouts in `ids`.
        taken: int64 `[1]`, tasks taken so far by all threads.
        stack: scratch stack of `planner.simulator.state.State`.
        ids: uint32 `[B]`, rollouts; reordered.
        singles: results of single rollouts.

    Returns:
        0, or with `how.deferred` the number of deferred groups: those that lose their first robot, in levels 1, 2, ...
        of the stack; level 0 keeps the rest. NONE if a rollout needed more areas than the state has room for; then the
        counts are void.
    """
    tables, counts, work, logged, options = hand(t), hand(c), hand(w), hand(log), hand(how)
    policy = hand(p)
    top = 0
    # Threads raise `taken` atomically: no task is run twice.
    while begin_next(tables, stack, waiting, tasks, taken, work):
        level = top = 0
        while level >= 0:
            # By address: passing fifty arrays by value would take longer than most kernels.
            s = hand(level_of(stack, level))
            last = s.marks.last
            found = advance(tables, policy, s, counts, work, logged, options, ids)
            if found == AREAS_FULL:
                return NONE
            level, top = go_on_with(tables, s, counts, stack, level, ids, singles, options, top, last, found)
    return max(top, 0)
