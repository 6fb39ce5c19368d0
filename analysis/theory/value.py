"""What cells are worth: the open loop's expected value covered and found, exactly, per cell (SPEC section 13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.theory.exact import robot_chances
from planner.plans.plan import Plan
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class Worth:
    """What the cells of a map are worth and show. Axis `N` = H * W cells; what nobody can reach is in them too.

    Attributes:
        value: float64 `[N]`. detect: float64 `[N]`, chance that a survived visit finds what is there.
    """

    value: NDArray[np.float64]
    detect: NDArray[np.float64]

    @classmethod
    def of(cls, world: World) -> Worth:
        """1 each where nobody said; 0 on obstacles."""
        free = world.free
        value, detect = (layer if layer is not None else free.astype(float) for layer in (world.value, world.detect))
        return cls(value.ravel(), detect.ravel())

    @property
    def is_plain(self) -> bool:
        """Whether one survived visit of a cell tells what more of them would: it finds all, or nothing, or no value."""
        return bool((((self.detect == 0) | (self.detect == 1)) | (self.value == 0)).all())

    @property
    def total(self) -> float:
        """Of all free cells."""
        return float(self.value.sum())


def open_loop_found(plan: Plan, world: World) -> NDArray[np.float64]:
    """P(found in c) of the open loop, float64 `[N]`: the chance that what is in the cell is found, if it is there.

    `P(found in c) = 1 - prod_i E[(1 - d)^(N_i)]`, N_i the survived visits of c by robot i: robots are stopped
    independently of each other, and every survived visit detects with d on its own. N_i is j or more iff the robot
    passes its j-th entry of c, which has chance s_ij: what it survives of its entries up to that one. So
    `E[(1 - d)^(N_i)] = 1 - sum_j s_ij ((1 - d)^(j - 1) - (1 - d)^j) = 1 - d sum_j s_ij (1 - d)^(j - 1)`.
    """
    detect = Worth.of(world).detect
    total, missed = np.zeros(world.threat.size), np.ones(world.threat.size)
    for number, path in enumerate(plan.robots):
        robot = robot_chances(path, world, plan.bearing, number)
        order = np.argsort(robot.cells, kind="stable")
        cells = robot.cells[order]
        first = np.flatnonzero(np.diff(cells, prepend=-1))
        turn = np.arange(len(cells)) - np.repeat(first, np.diff(first, append=len(cells)))
        found = np.zeros(world.threat.size)
        np.add.at(found, cells, detect[cells] * robot.passed[order] * (1.0 - detect[cells]) ** turn)
        total += missed * found  # 1 - missed would lose all below 1e-16
        missed *= 1.0 - found
    return np.minimum(total, 1.0)
