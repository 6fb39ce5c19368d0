"""Robots that learn about hazards: what happened to them in a step, and what follows from it (SPEC section 15).

During a step they only take note. At its end what they believe of the cells concerned is that of the evidence's class;
where that is another level than before, it surprises as what is seen does (`planner.mrac.believe`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.believe import Learning
from planner.mrac.executive import Split
from planner.mrac.problem import Problem
from planner.mrac.recorder import Recorder
from planner.plans.plan import Area
from planner.worlds.evidence import Evidence, Readings, added


class Experienced(Learning):
    """A run whose robots learn from survived visits, stops, and detectors.

    Attributes:
        odds: int64 `[N]`, log odds of a hazard in each cell.
    """

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        split: Split,
        recorder: Recorder | None,
        evidence: Evidence,
        readings: Readings | None,
    ) -> None:
        assert problem.unknown is not None
        super().__init__(problem, allocation, split, recorder, None, problem.unknown.belief)
        self.odds, self.evidence, self._readings = evidence.prior.copy(), evidence, readings

    def stop(self, number: int) -> None:
        """The robot is stopped: there is, or was, a hazard in its cell."""
        super().stop(number)
        self.odds[self.robots[number].cell] = self.evidence.stop

    def survive(self, number: int) -> None:
        """The robot goes on: less speaks for a hazard in the cell that it has entered."""
        cell = np.array([self.robots[number].cell])
        super().survive(number)
        self.odds[cell] = added(self.odds[cell], -self.evidence.survival[cell])

    def looked_at(self) -> NDArray[np.int64]:
        """Cells that robots are in, stopped or not, and those in range of their detectors."""
        cells = np.array([robot.cell for robot in self.robots], dtype=np.int64)
        if not any(robot.alive for robot in self.robots):
            return cells[:0]
        return np.union1d(cells, self._read()) if self.evidence.detector else np.unique(cells)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """The levels `[n]` of what the evidence says by now."""
        assert self.problem.unknown is not None
        return self.problem.unknown.truths[self.evidence.class_of(self.odds, cells), cells]

    def _read(self) -> NDArray[np.int64]:
        """Every live robot reads its detector; the cells in range."""
        assert self.problem.unknown is not None
        assert self._readings is not None
        inside = [np.zeros(0, dtype=np.int64)]
        for robot in self.robots:
            if robot.alive:
                cells = self.problem.unknown.view(robot.cell).astype(np.int64)
                self.odds[cells] = self.evidence.read(self.odds, cells, self._readings(robot.number, self.step, cells))
                inside.append(cells)
        return np.unique(np.concatenate(inside))
