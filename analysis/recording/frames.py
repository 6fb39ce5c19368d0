"""State of a rollout step by step from its trace: live robots, coverage, and the robots of the areas. NumPy only.

A trace does not contain the areas of robots that learn the map; `learned_maps` simulates them.

Axis letters: `T` = time + 1 steps, `K` robots, `N = H * W` cells, `A` areas, `V` entries of a cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from planner.failure_model import PLAIN
from planner.formatting import chance, counted, share
from planner.plan.plan import Area, Plan
from planner.plan.state import MissionState
from planner.rollout_sampling import true_map
from planner.rollouts.single_run import SingleRun
from planner.simulator.codes import NO_AREA, NO_ROBOT, NO_STEP, Doing, EventKind, Outcome
from planner.tally import Trace
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World


class Held(IntEnum):
    """State of an area."""

    UNASSIGNED = 0
    ASSIGNED = 1
    COMPLETED = 2


@dataclass(frozen=True, eq=False)
class Frames:
    """Arrays computed from a trace, at the end of each step.

    Attributes:
        trace: the rollout.
        moved: bool `[T, K]`: the robot entered its cell in this step.
        alive: bool `[T, K]`.
        visited_at, survived_at: int32 `[N]`: step of the first entry of the cell, and of the first entry that a robot
            survived; NO_STEP.
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
    """The areas and the robots that hold them at the end of a step.

    Attributes:
        step: the step.
        area: int32 `[N]`, the area of each cell; NO_AREA.
        held: int8 `[N]`, values of `Held` (UNASSIGNED for cells without an area).
        robot: int32 `[N]`, the robot that holds the cell's area, or held it last; NO_ROBOT.
        open: number of areas that no robot holds and that are not completed.
    """

    step: int
    area: NDArray[np.int32]
    held: NDArray[np.int8]
    robot: NDArray[np.int32]
    open: int


def make_frames(trace: Trace, state: MissionState | None = None) -> Frames:
    """Compute the arrays of a trace; `state`: of the mission that it continues."""
    cells, n = trace.cells, len(trace.area_of)
    moved = np.ones(cells.shape, dtype=np.bool_)
    # At t = 0 robots enter their starts, unless a mission is resumed.
    moved[0] = state is None
    moved[1:] = cells[1:] != cells[:-1]
    alive = trace.doing != Doing.DEAD
    stopped_now = ~alive
    # A robot is lost in the step in which it is dead for the first time.
    stopped_now[1:] &= alive[:-1]
    steps, robots = np.nonzero(moved)
    passed = ~stopped_now[steps, robots]
    entered = cells[steps, robots]
    visited_at = _first(steps, entered, n)
    survived_at = _first(steps[passed], entered[passed], n)
    if state is not None:
        visited_at[state.visited] = survived_at[state.survived] = 0
    visited, survived = _so_far(visited_at, len(cells)), _so_far(survived_at, len(cells))
    visited_by, alive_count = _first(robots, entered, n), alive.sum(axis=1)
    return Frames(trace, moved, alive, visited_at, survived_at, visited_by, visited, survived, alive_count)


def _first(values: NDArray[np.int64], cells: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    """The first of `values` for each cell, int32 `[n]`; NO_STEP (equal to NO_ROBOT)."""
    first = np.full(n, NO_STEP, dtype=np.int32)
    # In reverse order the first value is written last.
    first[cells[::-1]] = values[::-1]
    return first


def _so_far(first: NDArray[np.int32], steps: int) -> NDArray[np.int64]:
    return np.cumsum(np.bincount(first[first != NO_STEP], minlength=steps))[:steps]


def area_maps(trace: Trace, areas: Sequence[Area], state: MissionState | None = None) -> Iterator[AreaMap]:
    """The areas at the end of step 0, and of every later step that changes their state or robot.

    `areas`: those at t = 0, in id order. Raises ValueError if the events of the trace do not fit them.
    """
    book = AreaBook(trace, areas, state)
    for step in book.steps():
        yield book.map(step)


def no_areas(cells: int) -> AreaMap:
    """The map without areas, before the first step."""
    none = np.full(cells, NO_AREA, dtype=np.int32)
    return AreaMap(0, none, np.zeros(cells, dtype=np.int8), none, 0)


class AreaBook:
    """The areas of a rollout as its events change them. An area made of another one stores that one as its parent.

    Attributes:
        held: int8 `[A]`, values of `Held`. robot: int32 `[A]`, the robot that holds the area or held it last.
    """

    def __init__(self, trace: Trace, given: Sequence[Area], state: MissionState | None = None) -> None:
        """`given`: areas at t = 0, in id order; or in the `state` that the rollout continues.

        Raises ValueError for events that do not fit the areas.
        """
        self._trace = trace
        # Only these events create areas; ids are given in the order of events.
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
        self._next = len(given)  # areas from this id on do not exist yet
        self._parents = np.append(np.full(len(given), NO_AREA), parents).astype(np.int32)
        for child, parent in enumerate(parents.tolist(), start=len(given)):
            if not 0 <= parent < child:
                raise ValueError(f"area {child} was made of area {parent}")

    def steps(self) -> Iterator[int]:
        """Step 0 and every later step with an event, after its events."""
        at, events = self._trace.events[:, 0], self._trace.events
        for step in np.union1d(0, at).tolist():
            for _, robot, kind, area, other in events[slice(*np.searchsorted(at, (step, step + 1)))].tolist():
                self._apply(robot, kind, area, other)
            yield step

    def _apply(self, robot: int, kind: int, area: int, other: int) -> None:
        """Apply an event."""
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
        """The areas at present."""
        now = np.arange(len(self.held), dtype=np.int32)  # current area of a cell whose final area is i
        # Follow parents up to an area that exists already.
        while (later := now >= self._next).any():
            now[later] = self._parents[now[later]]
        area = np.append(now, np.int32(NO_AREA))[self._trace.area_of]
        held, robot = np.append(self.held, Held.UNASSIGNED), np.append(self.robot, NO_ROBOT)
        unassigned = int((self.held[: self._next] == Held.UNASSIGNED).sum())
        return AreaMap(step, area, held[area], robot[area], unassigned)


# Events of a rollout as text.

_EVENTS = {
    EventKind.COMPLETED: (Log.INFO, "robot {robot} completes area {area}", "{short} at {cell}"),
    EventKind.HIT: (Log.ERROR, "robot {robot} is lost at {cell}", "{short}, {threat}{its_area}"),
    EventKind.REALLOCATED: (
        Log.WARNING, "area {area} is free again, in {parts}", "area {area} of robot {robot} is free again, in {parts}",
    ),
    EventKind.ALLOCATED: (Log.INFO, "robot {robot} gets area {area}", "{short} and goes to {cell}"),
    EventKind.SHARED: (Log.WARNING, "robot {robot} shares area {area}, in {other} parts", "{short}"),
    EventKind.LOOKED_AGAIN: (Log.INFO, "robot {robot} re-evaluates", "{short} before {cell} and releases area {area}"),
    EventKind.REFUSED: (
        Log.WARNING, "area {area} is not worth the risk",
        "robot {robot} is done: area {area}, at {cell}, and all others in reach are not worth the risk",
    ),
    EventKind.RANGE_ENDED: (
        Log.WARNING, "robot {robot} stays at {cell}",
        "{short}: that was the last move of its range; its area was {area}",
    ),
    EventKind.TURNED_HOME: (Log.INFO, "robot {robot} starts the return", "{short}, to {cell}{its_area}"),
    EventKind.HOME: (Log.INFO, "robot {robot} is at the base", "{short}, at {cell}"),
    EventKind.CHARGED: (Log.INFO, "robot {robot} is charged", "{short}, at {cell}"),
    EventKind.SURPRISED: (Log.INFO, "map update: {cells}", "map update: {cells} differ from the prior map"),
}  # fmt: skip
"""For each kind: foxglove.Log's level, a short text (pictures have little space), and the full text."""
ENDS_WITH_ERROR = (Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS, Outcome.STEP_LIMIT)
"""Outcomes that a recording logs as errors."""


@dataclass(frozen=True)
class Line:
    """An event as text: step, robot, foxglove.Log's level, full and short text."""

    step: int
    robot: int
    kind: EventKind
    level: int
    text: str
    short: str
    json_keys = "step kind=kind_name robot text"

    @property
    def kind_name(self) -> str:
        """The kind of the event as a word."""
        return self.kind.name.lower()


def event_line(row: NDArray, world: World, plan: Plan | None = None) -> Line:
    """One row of `Trace.events` as text. Raises ValueError, IndexError for an invalid row.

    `plan`: its failure model gives the robot's probability of loss; None: the map's threat.
    """
    step, robot, number, area, other = (int(value) for value in row)
    kind = EventKind(number)
    level, short, full = _EVENTS[kind]
    cell, its_area = list(divmod(other, world.shape[1])), "" if area == NO_AREA else f"; its area was {area}"
    threat = _stopped_by(robot, step, row[4], world, plan) if kind == EventKind.HIT else ""
    facts = {"robot": robot, "area": area, "other": other, "cell": cell, "threat": threat, "its_area": its_area}
    facts |= {"parts": counted(other, "part"), "cells": counted(other, "cell")}
    short = short.format(**facts)
    return Line(step, robot, kind, level, full.format(short=short, **facts), short)


def _stopped_by(robot: int, step: int, cell: NDArray, world: World, plan: Plan | None) -> str:
    """Possible causes of a robot's loss: the p of its visit (with a Weibull shape, the map's), or a moving threat."""
    failure_model = PLAIN if plan is None else plan.failure_model
    own = world if plan is None else world.of_robots(failure_model.types, len(plan.robots))[robot]
    p = float(own.by_phase.flat[own.visits(cell, step)])
    if failure_model.shape == 1 and not failure_model.is_even:
        p = failure_model.first_chance(p, robot)
    if world.moving_threats is None:
        return f"threat {chance(p)}"
    return f"threat {chance(p)}, or a moving threat" if p else "by a moving threat"


def end_text(trace: Trace, outcome: Outcome, visited: int, survived: int, accessible: int, alive: int) -> str:
    """The end of a rollout as text; the plan derives `outcome` from the trace's (`Plan.ending`)."""
    seen, passed = share(visited, accessible), share(survived, accessible)
    return (
        f"rollout {trace.rollout} ends: {outcome.word} at step {trace.time}, {seen} visited, "
        f"{passed} survived, {alive} of {trace.cells.shape[1]} robots alive"
    )


# Robots that learn the map: cells seen by a step of a rollout, and the areas made of the updated map.


@dataclass(frozen=True, eq=False)
class Discovery:
    """Map knowledge of a rollout's team.

    Attributes:
        prior: float32 `[H, W]`, prior map; NaN: an obstacle.
        truth: float32 `[H, W]`, true map.
        when: int32 `[H, W]`, the step at the end of which each cell is first seen; NO_STEP.
    """

    prior: NDArray[np.float32]
    truth: NDArray[np.float32]
    when: NDArray[np.int32]

    def seen(self, step: int) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that some robot has seen by the end of a step."""
        return (self.when != NO_STEP) & (self.when <= step)

    def believed(self, step: int) -> NDArray[np.float32]:
        """float32 `[H, W]`, the team's map at the end of a step: the true map in seen cells, else the prior map."""
        return np.where(self.seen(step), self.truth, self.prior)


def discovery_of(world: World, seed: int, trace: Trace) -> Discovery:
    """The map knowledge in a rollout of the seed, for a team that does not know the true map."""
    assert world.knowledge is not None
    when = world.knowledge.first_seen(trace.cells, trace.doing != Doing.DEAD).reshape(world.shape)
    truth = true_map(world.uncertainty, seed, trace.rollout) if isinstance(world.uncertainty, Uncertain) else world.met
    return Discovery(world.threat, truth, when)


def learned_maps(runs: Iterable[SingleRun]) -> Iterator[AreaMap]:
    """The areas at the end of step 0, and of every later step that changes their state or robot, by simulation."""
    before: tuple[bytes, bytes, bytes] | None = None
    robot = np.zeros(0, dtype=np.int32)
    for run in runs:
        if not len(robot):
            robot = run.loop.tables.owner.astype(np.int32)
        count = int(run.raw.marks["areas"])
        robot = np.append(robot, np.full(count - len(robot), NO_ROBOT, dtype=np.int32))
        for _, who, kind, number, _ in run.new_events.tolist():
            if kind in (EventKind.ALLOCATED, EventKind.LOOKED_AGAIN):
                robot[number] = who if kind == EventKind.ALLOCATED else NO_ROBOT
        held = np.full(count, Held.COMPLETED, dtype=np.int8)
        held[(owned := run.frame()[2])[owned != NO_AREA]] = Held.ASSIGNED
        held[run.raw.areas["left"][:count] == 0] = Held.COMPLETED
        held[run.open] = Held.UNASSIGNED
        area = run.area_of
        now = area.tobytes(), held.tobytes(), robot.tobytes()
        if now != before:
            before = now
            of_area, of_robot = np.append(held, Held.UNASSIGNED), np.append(robot, NO_ROBOT)  # NO_AREA is the last
            yield AreaMap(run.step, area, of_area[area].astype(np.int8), of_robot[area], len(run.open))
