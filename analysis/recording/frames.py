"""A rollout's trace worked out step by step: who lives, what is covered, who holds which area. Pure NumPy.

Which areas robots hold that learn the map no trace tells (`analysis.recording.discovery`).

Axis letters: `T` = time + 1 steps, `K` robots, `N = H * W` cells, `A` areas, `V` entries of a cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from planner.none import NO_AREA, NO_ROBOT, NO_STEP
from planner.plans.plan import Area
from planner.plans.state import MissionState
from planner.trace import Doing, EventKind, Trace


class Held(IntEnum):
    """What has become of an area."""

    UNASSIGNED = 0
    ASSIGNED = 1
    COMPLETED = 2


@dataclass(frozen=True, eq=False)
class Frames:
    """What a trace implies at the end of each step.

    Attributes:
        trace: the rollout.
        moved: bool `[T, K]`: the robot entered its cell in this step.
        alive: bool `[T, K]`.
        visited_at, survived_at: int32 `[N]`: step at which the cell was first entered, and first entered by a robot
            that was not stopped there; NO_STEP.
        visited_by: int32 `[N]`, the robot that entered the cell first; NO_ROBOT.
        visited, survived: int64 `[T]`, cells so far. alive_count: int64 `[T]`.
    """

    trace: Trace
    moved: NDArray[np.bool_]
    alive: NDArray[np.bool_]
    visited_at: NDArray[np.int32]
    survived_at: NDArray[np.int32]
    visited_by: NDArray[np.int32]
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    alive_count: NDArray[np.int64]

    def events_by_step(self) -> NDArray[np.int64]:
        """int64 `[T + 1]`: the events of step t are `trace.events[at[t] : at[t + 1]]`."""
        return np.searchsorted(self.trace.events[:, 0], np.arange(self.trace.time + 2))


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Who holds which area at the end of a step.

    Attributes:
        step: the step.
        area: int32 `[N]`, the area of each cell; NO_AREA where there is none.
        held: int8 `[N]`, values of `Held` (UNASSIGNED where there is no area).
        robot: int32 `[N]`, the robot that has the cell's area, or had it last; NO_ROBOT.
        open: areas that nobody has and that are not completed.
    """

    step: int
    area: NDArray[np.int32]
    held: NDArray[np.int8]
    robot: NDArray[np.int32]
    open: int


def make_frames(trace: Trace, state: MissionState | None = None) -> Frames:
    """Work out a trace; `state`: of the mission that it goes on from."""
    cells, n = trace.cells, len(trace.area_of)
    moved = np.ones(cells.shape, dtype=np.bool_)
    moved[0] = state is None
    moved[1:] = cells[1:] != cells[:-1]
    alive = trace.doing != Doing.DEAD
    stopped_now = ~alive
    stopped_now[1:] &= alive[:-1]
    steps, robots = np.nonzero(moved)
    passed = ~stopped_now[steps, robots]
    entered = cells[steps, robots]
    visited_at = _first(steps, entered, n)
    survived_at = _first(steps[passed], entered[passed], n)
    if state is not None:
        visited_at[state.visited] = survived_at[state.survived] = 0
    count = len(cells)
    return Frames(
        trace=trace,
        moved=moved,
        alive=alive,
        visited_at=visited_at,
        survived_at=survived_at,
        visited_by=_first(robots, entered, n),
        visited=_so_far(visited_at, count),
        survived=_so_far(survived_at, count),
        alive_count=alive.sum(axis=1),
    )


def _first(values: NDArray[np.int64], cells: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    """The first of `values` that each cell comes with, int32 `[n]`; NO_STEP (which is NO_ROBOT)."""
    first = np.full(n, NO_STEP, dtype=np.int32)
    first[cells[::-1]] = values[::-1]
    return first


def _so_far(first: NDArray[np.int32], steps: int) -> NDArray[np.int64]:
    return np.cumsum(np.bincount(first[first != NO_STEP], minlength=steps))[:steps]


def area_maps(trace: Trace, areas: Sequence[Area], state: MissionState | None = None) -> Iterator[AreaMap]:
    """The areas at the end of step 0, and of every later step that changes who holds what.

    `areas`: those at t = 0, in id order. Raises ValueError if the events of the trace do not fit them.
    """
    book = AreaBook(trace, areas, state)
    for step in book.steps():
        yield book.map(step)


def no_areas(cells: int) -> AreaMap:
    """That there are none, before the first step."""
    none = np.full(cells, NO_AREA, dtype=np.int32)
    return AreaMap(0, none, np.zeros(cells, dtype=np.int8), none, 0)


class AreaBook:
    """The areas of a run as its events change them. A part made of an area knows which one it came from.

    Attributes:
        held: int8 `[A]`, values of `Held`. robot: int32 `[A]`, who has it or had it last.
    """

    def __init__(self, trace: Trace, given: Sequence[Area], state: MissionState | None = None) -> None:
        """`given`: at t = 0, in id order; or in the `state` that the rollout goes on from.

        Raises ValueError for events that announce other areas than there are.
        """
        self._trace = trace
        made = np.isin(trace.events[:, 2], (EventKind.REALLOCATED, EventKind.SHARED))
        parents = np.repeat(trace.events[made, 3], np.maximum(trace.events[made, 4], 0))
        count = len(given) + len(parents)
        if int(trace.area_of.max(initial=NO_AREA)) >= count:
            raise ValueError(f"{count} areas, but a cell of area {int(trace.area_of.max())}")
        self.held = np.full(count, Held.UNASSIGNED, dtype=np.int8)
        self.robot = np.array([area.robot for area in given] + [NO_ROBOT] * len(parents), dtype=np.int32)
        self.held[self.robot != NO_ROBOT] = Held.ASSIGNED
        for number, area in enumerate(() if state is None else state.areas):
            if area.state == "completed":
                self.held[number], self.robot[number] = Held.COMPLETED, area.robot
        self._next = len(given)  # those from it on are not made yet
        self._parents = np.append(np.full(len(given), NO_AREA), parents).astype(np.int32)
        for child, parent in enumerate(parents.tolist(), start=len(given)):
            if not 0 <= parent < child:
                raise ValueError(f"area {child} was made of area {parent}")

    def steps(self) -> Iterator[int]:
        """Step 0 and every later one with an event, when it has happened."""
        at, events = self._trace.events[:, 0], self._trace.events
        for step in np.union1d(0, at).tolist():
            for _, robot, kind, area, other in events[slice(*np.searchsorted(at, (step, step + 1)))].tolist():
                self._apply(robot, kind, area, other)
            yield step

    def _apply(self, robot: int, kind: int, area: int, other: int) -> None:
        """Let an event happen."""
        if kind == EventKind.COMPLETED:
            self.held[area] = Held.COMPLETED
        elif kind == EventKind.ALLOCATED:
            self.held[area], self.robot[area] = Held.ASSIGNED, robot
        elif kind == EventKind.LOOKED_AGAIN:
            self.held[area] = Held.UNASSIGNED
        elif kind in (EventKind.REALLOCATED, EventKind.SHARED):
            self.held[area] = Held.COMPLETED
            self._next += other

    def map(self, step: int) -> AreaMap:
        """Who holds what now."""
        now = np.arange(len(self.held), dtype=np.int32)  # the area that a cell of final area i is in
        while (later := now >= self._next).any():
            now[later] = self._parents[now[later]]
        area = np.append(now, np.int32(NO_AREA))[self._trace.area_of]
        held, robot = np.append(self.held, Held.UNASSIGNED), np.append(self.robot, NO_ROBOT)
        nobodys = int((self.held[: self._next] == Held.UNASSIGNED).sum())
        return AreaMap(step, area, held[area], robot[area], nobodys)
