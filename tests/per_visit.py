"""A random number for every visit, in the place of a failure threshold a robot.

So release 0.3 could draw, and so fixtures were made that have no runs with thresholds. A rollout drawn like this goes
on from a state as if it had not been cut, where a threshold is drawn anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.failure_model import key_of, threefry2x32
from planner.mrac.simulate import ReferenceLoop
from planner.rollout_sampling import Luck


def uniform(seed: int, rollout: ArrayLike, step: ArrayLike, robot: ArrayLike) -> NDArray[np.float32]:
    """u(r, t, i) in [0, 1), float32: a visit of threat p by robot i at step t destroys it iff u < p."""
    counter = np.asarray(step, np.uint32) * np.uint32(1024) + np.asarray(robot, np.uint32)
    word, _ = threefry2x32(key_of(seed), np.asarray(rollout, np.uint32), counter)
    return (word >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


class VisitDraws(Luck):
    """Failures of one rollout, visit by visit."""

    _step = 0

    def hits(self, robot: int, step: int, cell: int) -> bool:
        self._step = step
        return super().hits(robot, step, cell)

    def _reaches_threshold(self, robot: int, chance: np.float32) -> bool:
        return bool(uniform(self._seed, self._rollout, self._step, robot) < chance)


class VisitLoop(ReferenceLoop):
    """The closed loop of the readable simulator by these draws."""

    def _luck_of(self, seed: int, rollout: int) -> Luck:
        return VisitDraws(self._world, seed, rollout, self._bearing)
