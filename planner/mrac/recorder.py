"""What the readable simulator writes down of a run, for its trace."""

from __future__ import annotations

import numpy as np

from planner.none import NO_AREA
from planner.tally import Outcome
from planner.trace import Doing, EventKind, Trace


class Recorder:
    """Collects one run's events, and where every robot is at the end of each step."""

    def __init__(self) -> None:
        self._events: list[tuple[int, int, EventKind, int, int]] = []
        self._steps: list[list[tuple[int, Doing, int]]] = []

    def note(self, step: int, robot: int, kind: EventKind, area: int, other: int) -> None:
        """Something happened; the columns of `Trace.events`."""
        self._events.append((step, robot, kind, area, other))

    def look(self, robots: list[tuple[int, Doing, int]]) -> None:
        """A step ended: (cell, what it is doing, its area) of each robot. A stopped robot has no area."""
        self._steps.append([(c, doing, NO_AREA if doing is Doing.DEAD else area) for c, doing, area in robots])

    def trace(self, rollout: int, area_of: np.ndarray, outcome: Outcome) -> Trace:
        """The trace of the run, once it has ended. `area_of`: int32 `[N]`, as in `Trace`."""
        steps = np.array(self._steps, dtype=np.int32)
        return Trace(
            rollout=rollout,
            cells=steps[:, :, 0],
            doing=steps[:, :, 1].astype(np.int8),
            areas=steps[:, :, 2],
            events=np.array(self._events, dtype=np.int32).reshape(-1, 5),
            area_of=area_of,
            outcome=outcome,
        )
