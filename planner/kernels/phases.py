"""Threats that change with time, compiled: `planner.mrac.forewarned` is the readable one.

Time is a function of the step, so a set's rollouts have it in common. Part of `planner.kernels.rollouts`, which see.
"""

from __future__ import annotations

from planner.jit import kernel, rare_kernel
from planner.kernels.believe import believe
from planner.kernels.own import own
from planner.kernels.state import ALIVE, STEP


@rare_kernel
def phase_at(t, step):
    """The phase that the step is in."""
    phase = len(t.phases) - 1
    while t.phases[phase] > step:
        phase -= 1
    return phase


@kernel
def visit_of(t, s, robot, cell):
    """Where `Tables.bound`, `exposure` and `chance` have a visit of the cell by the robot in this step."""
    return own(t, robot, cell) if len(t.phases) == 0 else cell + len(t.near) * phase_at(t, s.marks[STEP])


@rare_kernel
def foresee(t, s, w):
    """At the end of a step: how many cells surprise, which `w.news` lists, of the phase that the next one begins."""
    next_step, count = s.marks[STEP] + 1, 0
    phase = phase_at(t, next_step)
    if s.marks[ALIVE] > 0 and t.phases[phase] == next_step:
        for cell in range(len(t.near)):
            count = believe(t, s, w, cell, t.truths[phase, cell], count)
    return count
