"""What a robot on a given path survives among threats that move: the forward algorithm of each (SPEC section 16).

Given the path movers are independent, and so is what they do to the robot: its survival is the product of what it
survives of each. For a mover it carries the chance that the robot is not stopped by it and the mover is there; every
step the mover moves, and of its chance to be where the robot is h is lost. Axis `T` = steps of the path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.worlds.movers import ANYWHERE, Mover
from planner.worlds.world import World

SIDES = ((-1, 0), (0, -1), (0, 1), (1, 0))
MOST_WORK = 3 * 10**8
"""Cells times steps times kinds of walkers that are worth it: some seconds."""


def is_worth_it(world: World, steps: int) -> bool:
    """Whether `passed_movers` of a path of so many steps is."""
    assert world.movers is not None
    kinds = {mover for mover in world.movers.members if not mover.patrols}
    return len(kinds) * world.threat.size * steps <= MOST_WORK


def passed_movers(path: NDArray[np.int64], world: World) -> NDArray[np.float64]:
    """float64 `[T]`: the chance that no mover stops a robot at a step of its path `[T]`, if none did before.

    Cost O(T N) for each kind of walker, O(T L) for each kind of patrol.
    """
    passed, known = np.ones(len(path)), {}
    assert world.movers is not None
    for mover in world.movers.members:
        if mover not in known:
            known[mover] = _passed_patrol(path, mover) if mover.patrols else _passed_walker(path, mover, world)
        passed *= known[mover]
    return passed


def _passed_patrol(path: NDArray[np.int64], mover: Mover) -> NDArray[np.float64]:
    route = np.array(mover.route)
    chance = np.full(len(route), 1.0 / len(route))
    if mover.start != ANYWHERE:
        chance = (np.arange(len(route)) == mover.place).astype(np.float64)
    left = np.ones(len(path) + 1)
    for step, cell in enumerate(path):
        chance = np.roll(chance, 1)
        chance[route == cell] *= 1.0 - mover.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _passed_walker(path: NDArray[np.int64], mover: Mover, world: World) -> NDArray[np.float64]:
    free, (height, width) = world.free, world.shape
    around = np.pad(free, 1)

    def beside(padded: NDArray, side: tuple[int, int]) -> NDArray:
        return padded[1 + side[0] : 1 + side[0] + height, 1 + side[1] : 1 + side[1] + width]

    ways = sum(beside(around, side).astype(np.int64) for side in SIDES)
    stays = np.where(ways == 0, 1.0, mover.stay)
    goes = np.where(free, (1.0 - stays) / np.maximum(ways, 1), 0.0)
    if mover.start == ANYWHERE:
        weight = np.where(free, np.maximum(ways, 1), 0)
        chance = weight / weight.sum()
    else:
        chance = (np.arange(free.size) == mover.start).astype(np.float64).reshape(free.shape)
    left, gone = np.ones(len(path) + 1), np.zeros((height + 2, width + 2))
    for step, cell in enumerate(path):
        gone[1:-1, 1:-1] = chance * goes
        chance = np.where(free, chance * stays + sum(beside(gone, side) for side in SIDES), 0.0)
        chance.flat[cell] *= 1.0 - mover.hit
        left[step + 1] = chance.sum()
    return _ratios(left)


def _ratios(left: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is left of each step's chance, of `left` `[T + 1]`; 0 once nothing is."""
    return np.divide(left[1:], left[:-1], out=np.zeros(len(left) - 1), where=left[:-1] > 0)
