"""Robots that learn about hazards, compiled: `planner.mrac.experience` is the readable one.

Part of `planner.kernels.rollouts`, which see. What a set's rollouts have in common is what happened to its robots, so
they share log odds until they part; readings of detectors differ, and then each rollout is a set by itself.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel
from planner.kernels.believe import believe, look_about
from planner.kernels.bits import holds
from planner.kernels.luck import own_word, threefry
from planner.kernels.phases import foresee
from planner.kernels.state import (
    ALARM,
    ALIVE,
    CELL,
    DEAD,
    DETECTS,
    DOING,
    ERRS,
    FIRST,
    LESS,
    MORE,
    SILENCE,
    STEP,
)
from planner.worlds.evidence import ALWAYS, NEVER


@kernel
def learns_of(t, s, w, how, ids):
    """`look_about`, or the same of the evidence or of phases, by which nothing is ever seen."""
    if len(t.phases) > 0:
        return foresee(t, s, w), False
    return look_about(t, s, w) if len(s.odds) == 0 else (reckon(t, s, w, how, ids), False)


@kernel
def add(s, cell, said):
    """Something speaks for a hazard in the cell; what is certain stays so."""
    if s.odds[cell] != ALWAYS and s.odds[cell] != NEVER:
        sure = abs(said) == ALWAYS
        s.odds[cell] = said if sure else s.odds[cell] + said


@rare_kernel
def take_note(t, s, cell):
    """A robot has survived a visit of the cell."""
    add(s, cell, -t.survival[cell])


@rare_kernel
def reckon(t, s, w, how, ids):
    """How many cells surprise, which `w.news` lists: of robots' own, and of those in range of their detectors."""
    if s.marks[ALIVE] == 0:
        return 0
    reads, count = t.lessons[DETECTS] > 0, 0
    for robot in range(len(s.robots)):
        if reads and s.robots[robot, DOING] != DEAD:
            read(t, s, how, ids[s.marks[FIRST]], robot)
    for robot in range(len(s.robots)):
        here = np.int64(s.robots[robot, CELL])
        count = heed(t, s, w, here, count)
        if reads and s.robots[robot, DOING] != DEAD:
            for place in range(t.view_begin[here], t.view_begin[here + 1]):
                count = heed(t, s, w, np.int64(t.in_view[place]), count)
    return count


@kernel
def read(t, s, how, rollout, robot):
    """A robot's readings of a step."""
    key0, key1 = threefry(how.read0, how.read1, rollout, np.uint32(s.marks[STEP]))
    here = s.robots[robot, CELL]
    for place in range(t.view_begin[here], t.view_begin[here + 1]):
        cell = np.int64(t.in_view[place])
        there = own_word(t, how, rollout, cell) < t.there[cell] and not (len(s.spent) > 0 and holds(s.spent, cell))
        word = threefry(key0, key1, np.uint32(robot), t.own_counter[cell])[0] >> np.uint32(8)
        alarm = np.int64(word) < t.lessons[DETECTS if there else ERRS]
        add(s, cell, t.lessons[ALARM] if alarm else -t.lessons[SILENCE])


@kernel
def heed(t, s, w, cell, count):
    """Believe what the evidence says of a cell; how many surprise by now."""
    return believe(t, s, w, cell, t.truths[class_of(t, s, cell), cell], count)


@kernel
def class_of(t, s, cell):
    """`planner.worlds.evidence.Evidence.class_of` one cell."""
    odds = s.odds[cell]
    if odds == NEVER:
        return np.int64(0)
    if odds == ALWAYS:
        return np.int64(1)
    lost = t.odds[cell] - odds
    steps = min(lost // t.step[cell], t.lessons[LESS]) if lost >= 0 else -min(-lost // t.step[cell], t.lessons[MORE])
    return 2 + t.lessons[MORE] + steps
