"""What differs from robot to robot where they are of several types, or speeds (SPEC section 22).

Part of `planner.kernels.rollouts`, which see. Of several types tables by cell have the rows of each, one after the
other: `Tables.type_of` and `own_level`. Of several speeds a robot has a turn in every `pace`-th step, and what counts
its moves counts these turns. All empty where robots are alike.
"""

from __future__ import annotations

import numpy as np

from planner.jit import kernel, rare_kernel


@kernel
def own(t, robot, cell):
    """The row of the cell in tables that are by type."""
    return np.int64(cell) if len(t.type_of) == 0 else np.int64(cell) + t.type_of[robot] * len(t.near)


@kernel
def own_level(t, robot, level):
    """What an area of this level is to the robot, 0 = safe."""
    return np.int64(level) if len(t.type_of) == 0 else t.own_level[t.type_of[robot], level]


@kernel
def own_turn(t, robot, step):
    """The turns that the robot has had by the end of this step, that of t = 0 left out."""
    return np.int64(step) if len(t.pace) == 0 else np.int64(step) // t.pace[robot]


@kernel
def on_turn(t, step, word, bits):
    """Those of the robots, bits of a word of them, that have a turn in this step."""
    return bits if len(t.pace) == 0 else bits & turns_in(t, step, word)


@rare_kernel
def turns_in(t, step, word):
    """Bits of the robots of a word that have a turn in this step."""
    found = np.uint64(0)
    for number in range(len(t.ticks)):
        if step % t.ticks[number] == 0:
            found |= t.clock[number, word]
    return found


@kernel
def moves_until(t, helper, owner, moves):
    """The moves that the helper makes while the owner makes so many."""
    return moves if len(t.pace) == 0 else moves * t.pace[owner] // t.pace[helper]
