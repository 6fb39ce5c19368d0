"""Robots that are told of threats that change, as they do (SPEC section 16).

At the end of the step before a phase begins every cell whose level changes surprises as what is seen does
(`planner.mrac.believe`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.believe import Learning


class Forewarned(Learning):
    """A run whose robots believe the map of the phase that the next step is in."""

    def looked_at(self) -> NDArray[np.int64]:
        """All cells before a phase begins, else none."""
        assert self.problem.unknown is not None and self.problem.unknown.phases is not None
        changes = (self.problem.unknown.phases.begins == self.step + 1).any()
        return np.flatnonzero(self.problem.unknown.within & changes)

    def found(self, cells: NDArray[np.int64]) -> NDArray[np.int16]:
        """Their levels `[n]` from the next step on."""
        assert self.problem.unknown is not None and self.problem.unknown.phases is not None
        return self.problem.unknown.truths[self.problem.unknown.phases.number_at(self.step + 1), cells]
