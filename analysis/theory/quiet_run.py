"""One run of the readable simulator with chosen hits and no others, and everything that it decided on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.mrac.problem import Problem
from planner.mrac.recorder import Recorder
from planner.mrac.simulate import Run, simulate
from planner.plans.plan import Area, Plan
from planner.trace import EventKind

NEVER = np.iinfo(np.int64).max


class _Notes(Recorder):
    """A run's events alone."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[tuple[int, EventKind, int, int]] = []

    def note(self, step: int, robot: int, kind: EventKind, area: int, other: int) -> None:
        self.events.append((robot, kind, area, other))


@dataclass(frozen=True, eq=False)
class QuietRun:
    """A run in which the entries `hits`, and no others, stop their robot. Axis `E` = entries in order of action.

    Attributes:
        run: the simulator's own account. areas: every area as it was when it was made, in id order.
        hits: positions among the entries, rising.
        robot, step, cell: int64 `[E]`. threat: float64 `[E]`, p of the cell.
        noted: int64 `[E]`, events that came before the entry's hit check.
        events: (robot, kind, area, other) of `planner.trace.Trace.events`.
        first_visit, first_pass: int64 `[N]`, the first entry of each cell, and the first that did not stop its robot;
            NEVER if there is none.
    """

    run: Run
    areas: tuple[Area, ...]
    hits: tuple[int, ...]
    robot: NDArray[np.int64]
    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    threat: NDArray[np.float64]
    noted: NDArray[np.int64]
    events: list[tuple[int, EventKind, int, int]]
    first_visit: NDArray[np.int64]
    first_pass: NDArray[np.int64]

    @property
    def visited(self) -> int:
        """Cells visited at the end."""
        return int(self.run.visited.sum())

    @property
    def survived(self) -> int:
        """Cells at the end that some robot entered without being stopped there."""
        return int(self.run.survived.sum())

    def visited_by(self, entry: NDArray[np.int64]) -> NDArray[np.int64]:
        """Cells visited by each of these entries, it included."""
        return np.searchsorted(np.sort(self.first_visit), entry, side="right").astype(np.int64)

    def survived_before(self, entry: NDArray[np.int64]) -> NDArray[np.int64]:
        """Cells survived by each of these entries, it left out."""
        return np.searchsorted(np.sort(self.first_pass), entry, side="left").astype(np.int64)


def quiet_run(problem: Problem, plan: Plan, hits: tuple[int, ...]) -> QuietRun:
    """Run Algorithm 2 from the plan's allocation with hits at exactly these entries, counted from 0 in order."""
    notes, stopping = _Notes(), set(hits)
    entered: list[tuple[int, int, int, int]] = []

    def hit(robot: int, step: int, cell: int) -> bool:
        entered.append((robot, step, cell, len(notes.events)))
        return len(entered) - 1 in stopping

    run = simulate(problem, plan.areas, hit=hit, recorder=notes)
    robot, step, cell, noted = np.array(entered, dtype=np.int64).T
    passed = np.ones(len(cell), dtype=np.bool_)
    passed[list(hits)] = False
    return QuietRun(
        run=run,
        areas=plan.areas + run.areas_added,
        hits=hits,
        robot=robot,
        step=step,
        cell=cell,
        threat=problem.world.threat.ravel()[cell].astype(np.float64),
        noted=noted,
        events=notes.events,
        first_visit=_first(cell, np.arange(len(cell)), problem.costs.size),
        first_pass=_first(cell[passed], np.flatnonzero(passed), problem.costs.size),
    )


def _first(cell: NDArray[np.int64], entry: NDArray[np.int64], cells: int) -> NDArray[np.int64]:
    """The first entry of each cell, int64 `[cells]`."""
    first = np.full(cells, NEVER, dtype=np.int64)
    entered, at = np.unique(cell, return_index=True)
    first[entered] = entry[at]
    return first
