"""Robots that learn about hazards, once more: a twin written from docs/spec.md alone, by Bayes' rule in floats.

It shares no code with the simulators; what robots do with what they believe is `oracle_unknown`'s.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from oracle_unknown import WALL, Cell, Twin, Walker


class Pupil(Twin):
    """One run. `q`, `h`: `[H, W]`, NaN = obstacle; `detector`: (range, detect, false alarm) or None.

    `alarm(robot, step, cell)`: its readings. Other arguments as of `Twin`.
    """

    def __init__(
        self, q: np.ndarray, h: np.ndarray, consumed: bool, starts: list[Cell],
        areas: list[tuple[int, int | None, list[Cell]]], stopped: Callable[[int, int, Cell], bool],
        detector: tuple[float, float, float] | None = None, alarm: Callable[[int, int, Cell], bool] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(q * h, q * h, starts, 0, False, areas, stopped)
        self.hits, self.consumed, self.detector, self.alarm = h, consumed, detector, alarm
        self.first = {c: float(q[c]) for c in self.true if not math.isnan(q[c])}
        self.chance, self.passed = dict(self.first), dict.fromkeys(self.first, 0)
        near = {c for c in self.goal if self.first[c] > 0}
        values = {self.planned(c, k) for c in near for k in self.classes()} | {
            h[c] for c in near if self.may_be_sure(c)
        }
        self.scale = [0.0, *sorted({float(f"{value:.5g}") for value in values if 0 < value < 1})]
        self.true = {c: self.level(c) for c in self.true}
        self.map = dict(self.true)

    def classes(self) -> range:
        return range(-4, 5) if self.detector else range(4)

    def may_be_sure(self, cell: Cell) -> bool:
        surely = self.detector is not None and self.detector[2] == 0
        return self.first[cell] == 1 or not self.consumed or surely

    def planned(self, cell: Cell, k: int) -> float:
        """p of the class k of a cell: k survived visits, or k nats less."""
        q, h = self.first[cell], float(self.hits[cell])
        if q in (0, 1):
            return q * h
        if self.detector:
            odds = q / (1 - q) * math.exp(-k)
            return h * odds / (1 + odds)
        for _ in range(k):
            q = q * (1 - h) / (1 - q * h)
        return q * h

    def level(self, cell: Cell) -> int:
        """That of what robots believe of the cell by now."""
        if cell not in self.first:
            return WALL
        q, now, h = self.first[cell], self.chance[cell], float(self.hits[cell])
        if now in (0, 1) or q in (0, 1):
            p = now * h
        elif self.detector:
            nats = math.log(q / (1 - q)) - math.log(now / (1 - now))
            p = self.planned(cell, max(-4, min(4, math.trunc(nats + math.copysign(1e-6, nats)))))
        else:
            p = self.planned(cell, min(3, self.passed[cell]))
        if p == 1:
            return WALL
        return min(range(len(self.scale)), key=lambda level: abs(self.scale[level] - p))

    def seen_from(self, at: Cell) -> set[Cell]:
        return set(self.true)  # what is known all know: `true` is what the evidence says

    def enter(self, number: int, walker: Walker, cell: Cell) -> None:
        super().enter(number, walker, cell)
        q, h = self.chance[cell], float(self.hits[cell])
        if walker.doing == "dead":
            self.chance[cell] = 0.0 if self.consumed else 1.0
        elif q < 1:
            self.chance[cell] = q * (1 - h) / (1 - q * h)
            self.passed[cell] += 1

    def look_about(self) -> None:
        for number, walker in enumerate(self.team):
            if self.detector and walker.doing != "dead":
                self.read(number, walker)
        self.true |= {c: self.level(c) for c in self.chance}
        super().look_about()

    def read(self, number: int, walker: Walker) -> None:
        reach, b, a = self.detector
        for cell, q in self.chance.items():
            if cell in self.goal and (cell[0] - walker.at[0]) ** 2 + (cell[1] - walker.at[1]) ** 2 <= reach**2:
                right, wrong = (b, a) if self.alarm(number, self.step, cell) else (1 - b, 1 - a)
                if 0 < q < 1:
                    self.chance[cell] = q * right / (q * right + (1 - q) * wrong)
