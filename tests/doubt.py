"""Worlds in doubt, and expected values of small ones, by playing everything that can happen: the oracle of tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from planner.mrac.problem import prepare
from planner.mrac.simulate import Run, simulate
from planner.plan.plan import Plan
from planner.world.changing_maps import with_hazard, with_maps, with_spread
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

BASE = random_world(9, 9, ThreatPattern("scattered", 4, (0.04, 0.12, 0.2), 5), obstacles=0.2, threats=0.3)
DANGER = np.where(BASE.threat > 0, 1.0, 0.0)
WORLDS = {
    "persistent": with_hazard(BASE, "persistent", 0.3 * DANGER, 0.5),
    "consumed": with_hazard(BASE, "consumed", 0.6 * DANGER, 0.9),
    "maps": with_maps(BASE, [BASE.threat, np.minimum(4 * BASE.threat, np.float32(0.9)), 0 * BASE.threat]),
    "level": with_spread(BASE, "beta", 4.0, "level"),
}
"""Of every kind one."""
Play = Callable[[Callable[[int, int, int], bool]], np.ndarray]
"""Plays a run with this judge of hits; what it comes to."""


def closed_loop(plan: Plan, world: World) -> Play:
    """Cells visited, survived, robots alive at the end, of a closed loop played by the readable simulator."""
    assert plan.settings is not None
    problem = prepare(world, plan.starts, plan.settings)

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        run: Run = simulate(problem, plan.areas, hit=hit)
        return np.array([run.visited.sum(), run.survived.sum(), run.alive.sum()], dtype=float)

    return play


def open_loop(plan: Plan, world: World) -> Play:
    """The same of an open loop: robots in index order, step by step, each along its path until it is stopped."""

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        visited, survived, alive = set(), set(), set(range(len(plan.robots)))
        for step in range(plan.makespan + 1):
            for robot, path in enumerate(one.path for one in plan.robots):
                if robot in alive and step < len(path) and (step == 0 or path[step] != path[step - 1]):
                    cell = int(path[step])
                    visited.add(cell)
                    if hit(robot, step, cell):
                        alive.remove(robot)
                    else:
                        survived.add(cell)
        return np.array([len(visited), len(survived), len(alive)], dtype=float)

    return play


def expected(play: Play, draw: Callable[[Callable[[float], bool], dict, int], bool]) -> np.ndarray:
    """The mean of what `play` gives over all that can happen.

    `draw(chance, memory, cell)` judges a visit; `chance(p)` is true with that chance; `memory` is the run's own.
    """
    total, left = np.zeros(()), [([], 1.0)]
    while left:
        decided, weight = left.pop()
        made: list[bool] = []
        memory: dict = {}

        def chance(p: float, decided: list[bool] = decided, made: list[bool] = made) -> bool:
            nonlocal weight
            if p in (0.0, 1.0):
                return p == 1.0
            if len(made) < len(decided):
                made.append(decided[len(made)])
            else:
                left.append(([*made, True], weight * p))
                weight *= 1 - p
                made.append(False)
            return made[-1]

        found = play(lambda robot, step, cell, chance=chance, memory=memory: draw(chance, memory, cell))
        total = total + weight * found
    return total


def persistent(q: np.ndarray, h: np.ndarray, consumed: bool = False) -> Callable[..., bool]:
    """Judges visits by hazards that are there or not, with q and h by cell."""

    def draw(chance: Callable[[float], bool], memory: dict, cell: int) -> bool:
        if cell not in memory:
            memory[cell] = chance(float(q[cell]))
        hit = memory[cell] and chance(float(h[cell]))
        if hit and consumed:
            memory[cell] = False
        return hit

    return draw


def one_of(maps: list[np.ndarray]) -> Callable[..., bool]:
    """Judges visits by one of equally likely maps of p by cell."""

    def draw(chance: Callable[[float], bool], memory: dict, cell: int) -> bool:
        if "map" not in memory:
            memory["map"] = next((n for n in range(len(maps) - 1) if chance(1 / (len(maps) - n))), len(maps) - 1)
        return chance(float(maps[memory["map"]][cell]))

    return draw
