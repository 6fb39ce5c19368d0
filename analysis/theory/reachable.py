"""Which cells a range leaves within a team's moves, whatever it does: what bounds for every strategy may leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.plans.plan import Plan
from planner.worlds.world import FOUR_NEIGHBOURS, World


def moves_left(plan: Plan) -> list[int] | None:
    """Of each robot, -1 of one that is lost; None: without end."""
    limit = None if plan.settings is None else plan.settings.range
    if limit is None or (plan.settings is not None and plan.settings.recharge is not None):
        return None
    moves = list(limit) if isinstance(limit, tuple) else [limit] * len(plan.robots)
    if plan.state is None:
        return moves
    return [most - robot.moves if robot.alive else -1 for most, robot in zip(moves, plan.state.robots, strict=True)]


def within(world: World, plan: Plan) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells that some robot alive could enter with the moves that it has left, were there no danger."""
    moves = moves_left(plan)
    if moves is None:
        return world.accessible(plan.starts)
    found = np.zeros(world.shape, dtype=bool)
    for (row, col), most in zip(plan.starts.tolist(), moves, strict=True):
        if most >= 0:
            own = np.zeros(world.shape, dtype=bool)
            own[row, col] = True
            steps = min(most, world.threat.size)  # iterations=0 would go on to the end
            found |= ndimage.binary_dilation(own, FOUR_NEIGHBOURS, steps, mask=world.free) if steps else own
    return found


def trimmed(world: World, plan: Plan) -> World:
    """`world` with obstacles where no robot has the moves to go: a bound for every strategy there is one here too."""
    if moves_left(plan) is None:
        return world
    return replace(world, threat=np.where(within(world, plan), world.threat, np.float32(np.nan)))
