"""Robots that are told of threats that change, as they do (SPEC section 16).

At the end of the step before a phase begins every cell whose level changes surprises as what is seen does
(`planner.mrac.believe`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.believe import Learning
from planner.mrac.executive import Split
from planner.mrac.problem import Problem
from planner.mrac.recorder import Recorder
from planner.plans.plan import Area
from planner.worlds.phases import Phases


class Forewarned(Learning):
    """A run whose robots believe the map of the phase that the next step is in."""

    def __init__(
        self,
        problem: Problem,
        allocation: tuple[Area, ...],
        split: Split,
        recorder: Recorder | None,
        phases: Phases,
    ) -> None:
        assert problem.unknown is not None
        super().__init__(problem, allocation, split, recorder, None, problem.unknown.belief)
        self._phases = phases

    def looked_at(self) -> NDArray[np.int64]:
        """All cells before a phase begins, else none."""
        assert self.problem.unknown is not None
        changes = (self._phases.begins == self.step + 1).any()
        return np.flatnonzero(self.problem.unknown.within & changes)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """Their levels `[n]` from the next step on."""
        assert self.problem.unknown is not None
        return self.problem.unknown.truths[self._phases.number_at(self.step + 1), cells]
