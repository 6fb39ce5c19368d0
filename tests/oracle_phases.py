"""Threats that change with time, by everything that can happen: a closed loop by the paper's rule, and given paths.

Written from docs/spec.md, sections 15 and 16, on the twin of section 15, which shares no code with the simulators. Maps
are float arrays, NaN = obstacle; cells are (row, col).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from oracle_unknown import Cell, Twin

Judge = Callable[[int, int, Cell], bool]
Areas = list[tuple[int, "int | None", list[Cell]]]


class Timed(Twin):
    """One run in which all robots know of each map when it begins; `maps`: [(first step, p)], the first from 0."""

    def __init__(self, maps: list[tuple[int, np.ndarray]], starts: list[Cell], areas: Areas, stopped: Judge) -> None:
        first = maps[0][1]
        super().__init__(first, first, starts, 0, False, areas, stopped)
        chances = {float(p[cell]) for _, p in maps for cell in self.goal}
        self.scale = sorted({0.0} | chances)
        self.levels = {begin: {c: self.level_of(p[c]) for c in np.ndindex(*p.shape)} for begin, p in maps}
        self.map, self.true = self.levels[0].copy(), self.levels[0]
        begins = sorted(self.levels)
        self.last_change = max(
            (now for before, now in pairwise(begins)
             if any(self.levels[before][c] != self.levels[now][c] for c in self.goal)),
            default=0,
        )  # fmt: skip

    def level_of(self, chance: float) -> int:
        return self.scale.index(float(chance)) if float(chance) in self.scale else -1

    def seen_from(self, at: Cell) -> set[Cell]:
        return self.goal

    def can_act(self, number: int) -> bool:
        return self.team[number].doing != "dead"

    def ended(self) -> str:
        """No team is stuck while a robot that can act waits for a change that is still to come."""
        waits = self.step + 1 < self.last_change and any(map(self.can_act, range(len(self.team))))
        end = super().ended()
        return "" if end == "no_progress" and waits else end

    def look_about(self) -> None:
        self.true = getattr(self, "levels", {}).get(self.step + 1, self.true)
        super().look_about()


def met(maps: list[tuple[int, np.ndarray]], step: int, cell: Cell) -> float:
    return float([p for begin, p in maps if begin <= step][-1][cell])


def mean_of(play: Callable[[Judge], tuple[float, ...]], maps: list[tuple[int, np.ndarray]]) -> np.ndarray:
    """Expected values of what `play` gives, and of cells survived after it, over all that can happen."""
    total, left = np.zeros(1), [([], 1.0)]
    while left:
        decided, weight = left.pop()
        made: list[bool] = []
        safely: set[Cell] = set()
        chance = [weight]

        def judge(
            robot: int, step: int, cell: Cell,
            decided: list[bool] = decided, made: list[bool] = made, safely: set[Cell] = safely,
            chance: list[float] = chance,
        ) -> bool:  # fmt: skip
            p = met(maps, step, cell)
            if p > 0:
                if len(made) < len(decided):
                    made.append(decided[len(made)])
                else:
                    left.append(([*made, True], chance[0] * p))
                    chance[0] *= 1 - p
                    made.append(False)
                if made[-1]:
                    return True
            safely.add(cell)
            return False

        told = play(judge)
        total = total + chance[0] * np.array([*told, len(safely)])
    return total


def closed_loop(maps: list[tuple[int, np.ndarray]], starts: list[Cell], areas: Areas, judge: Judge) -> tuple[int, int]:
    """(visited, alive) of one run."""
    run = Timed(maps, starts, areas, judge)
    run.run()
    return len(run.visited), sum(walker.doing != "dead" for walker in run.team)


def open_loop(paths: list[list[Cell]], judge: Judge) -> tuple[int, int]:
    """The same of given paths; who waits visits nothing."""
    visited, alive = set(), set(range(len(paths)))
    for step in range(max(map(len, paths))):
        for robot, path in enumerate(paths):
            if robot in alive and step < len(path) and (step == 0 or path[step] != path[step - 1]):
                visited.add(path[step])
                if judge(robot, step, path[step]):
                    alive.remove(robot)
    return len(visited), len(alive)
