"""The best strategy of one robot, by iteration over (where it is, what it has visited): no search, no state joined."""

from __future__ import annotations

import numpy as np

from planner.worlds.world import World


def best_of_one_robot(world: World) -> float:
    """The most that a robot from [0, 0] can cover on average, however it decides: value, or cells where none has it."""
    width, count = world.shape[1], world.threat.size
    passed = 1.0 - np.nan_to_num(world.threat.ravel(), nan=1.0).astype(float)
    value = np.ones(count) if world.value is None else world.value.ravel()
    places = np.argwhere(world.free)
    moves = [(a, b) for a in places for b in places if np.abs(a - b).sum() == 1]
    best, masks = np.zeros((count, 2**count)), np.arange(2**count)
    while True:
        new = np.zeros_like(best)
        for here, there in np.array(moves).reshape(-1, 2, 2) @ (width, 1):
            gained = np.where(masks >> there & 1, 0.0, value[there])
            new[here] = np.maximum(new[here], gained + passed[there] * best[there][masks | 1 << there])
        if np.abs(new - best).max() < 1e-12:
            return float(value[0] + passed[0] * best[0, 1])
        best = new
