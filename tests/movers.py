"""Worlds with movers, drawn anew for tests: walkers and patrols of all kinds on small maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from oracle_movers import Threat

import mrac_jax as mrac
from planner.world.features import PlannedOn, with_movers
from planner.world.generate import PAPER_LEVELS, ThreatPattern, random_world
from planner.world.moving_threats import ANYWHERE, Mover
from planner.world.world import World

PRESUME_THREATS_THAT_STAY: list[Callable[[World], Any]] = [
    lambda world: mrac.check(world, 2),
    lambda world: mrac.size(world, target=0.9),
    lambda world: mrac.starts(world, robots=2),
    lambda world: mrac.clear(world, robots=2),
    lambda world: mrac.evaluate(world, 2, threat_scale=(0.5,)),
    lambda world: mrac.mission(world, 2).outlook(),
]
"""What refuses threats over time."""


def rounds(world: World) -> list[tuple[int, ...]]:
    """Patrols round every free square of two by two cells."""
    width, free = world.shape[1], world.free
    corners = np.argwhere(free[:-1, :-1] & free[1:, :-1] & free[:-1, 1:] & free[1:, 1:])
    return [
        tuple(int(row + r) * width + int(col + c) for r, c in ((0, 0), (0, 1), (1, 1), (1, 0))) for row, col in corners
    ]


def moving_world(
    seed: int, levels: Sequence[float] = PAPER_LEVELS, most: int = 10, plan_on: PlannedOn = "joined"
) -> World:
    """A map of up to `most` x `most` cells with one to five movers, some of whom start where they are told."""
    random = np.random.default_rng(seed)
    height, width = random.integers(4, most + 1, 2).tolist()
    pattern = ThreatPattern(("contiguous", "scattered")[seed % 2], 4, tuple(levels), seed)
    world = random_world(height, width, pattern, obstacles=(0.2, 0.35)[seed // 2 % 2], threats=0.3)
    free, routes, movers = np.flatnonzero(world.free), rounds(world), []
    for _ in range(int(random.integers(1, 6))):
        hit, told = float(random.choice([0.05, 0.3, 0.9])), random.random() < 0.5
        if routes and random.random() < 0.4:
            route = routes[int(random.integers(len(routes)))]
            movers.append(Mover(hit, 0.0, route[2] if told else ANYWHERE, route))
        else:
            start = int(random.choice(free)) if told else ANYWHERE
            movers.append(Mover(hit, float(random.choice([0, 0.2, 0.5])), start))
    return with_movers(world, movers, plan_on)


def in_rows(world: World) -> tuple[list[list[float | None]], list[Threat]]:
    """The world as the oracle has it."""
    movers, width = world.movers, world.shape[1]
    assert movers is not None
    grid = [[None if np.isnan(p) else float(p) for p in row] for row in movers.own]

    def cell(number: int) -> tuple[int, int]:
        return divmod(number, width)

    return grid, [
        Threat(one.hit, one.stay, None if one.start == ANYWHERE else cell(one.start), tuple(map(cell, one.route)))
        for one in movers.members
    ]
