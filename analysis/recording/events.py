"""Events of a rollout in words."""

from __future__ import annotations

from dataclasses import dataclass

from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from planner.bearing import PLAIN
from planner.none import NO_AREA
from planner.plans.plan import Plan
from planner.shown import chance, counted, share
from planner.tally import Outcome
from planner.trace import EventKind, Trace
from planner.worlds.world import World

_EVENTS = {
    EventKind.COMPLETED: (Log.INFO, "robot {robot} completes area {area}", "{short} at {cell}"),
    EventKind.HIT: (Log.ERROR, "robot {robot} is lost at {cell}", "{short}, {threat}{its_area}"),
    EventKind.REALLOCATED: (
        Log.WARNING, "area {area} is free again, in {parts}", "area {area} of robot {robot} is free again, in {parts}",
    ),
    EventKind.ALLOCATED: (Log.INFO, "robot {robot} gets area {area}", "{short} and goes to {cell}"),
    EventKind.SHARED: (Log.WARNING, "robot {robot} shares area {area}, in {other} parts", "{short}"),
    EventKind.LOOKED_AGAIN: (Log.INFO, "robot {robot} looks again", "{short} before {cell} and gives area {area} back"),
    EventKind.REFUSED: (
        Log.WARNING, "robot {robot} refuses area {area}",
        "robot {robot} is done: it refuses area {area}, at {cell}, and all others that it can reach",
    ),
    EventKind.RANGE_ENDED: (
        Log.WARNING, "robot {robot} stays at {cell}",
        "{short}: that was the last move of its range; its area was {area}",
    ),
    EventKind.TURNED_HOME: (Log.INFO, "robot {robot} turns for home", "{short}, to {cell}{its_area}"),
    EventKind.HOME: (Log.INFO, "robot {robot} is home", "{short}, at {cell}"),
    EventKind.CHARGED: (Log.INFO, "robot {robot} is charged", "{short}, at {cell}"),
    EventKind.SURPRISED: (Log.INFO, "{cells} are not as believed", "robots see that {cells} are not as they believed"),
}  # fmt: skip
"""Of each kind foxglove.Log's level, what happened in short (on a picture there is little room), and in full."""
END_LEVELS = {Outcome.COMPLETE: Log.INFO, Outcome.PATH_END: Log.INFO, Outcome.CALLED_OFF: Log.INFO}
"""Of the line that tells how a rollout ended; others are errors."""


@dataclass(frozen=True)
class Line:
    """An event in words: the step, whom it is about, foxglove.Log's level, what happened, in full and in short."""

    step: int
    robot: int
    kind: EventKind
    level: int
    text: str
    short: str


def event_line(row: NDArray, world: World, plan: Plan | None = None) -> Line:
    """One row of `Trace.events` in words. Raises ValueError, IndexError for one that means nothing.

    `plan`: says what threats are to a robot; None: what they are on the map.
    """
    step, robot, number, area, other = (int(value) for value in row)
    kind = EventKind(number)
    level, short, full = _EVENTS[kind]
    facts = {
        "robot": robot,
        "area": area,
        "other": other,
        "parts": counted(other, "part"),
        "cells": counted(other, "cell"),
        "cell": list(divmod(other, world.shape[1])),
        "threat": _stopped_by(robot, step, row[4], world, plan) if kind == EventKind.HIT else "",
        "its_area": "" if area == NO_AREA else f"; its area was {area}",
    }
    short = short.format(**facts)
    return Line(step, robot, kind, level, full.format(short=short, **facts), short)


def _stopped_by(robot: int, step: int, cell: NDArray, world: World, plan: Plan | None) -> str:
    """What may have stopped a robot there: the p of its visit (of who wears, the map's), or a mover."""
    bearing = PLAIN if plan is None else plan.bearing
    own = world if plan is None else world.of_robots(bearing.types, len(plan.robots))[robot]
    p = float(own.by_phase.flat[own.visits(cell, step)])
    if bearing.shape == 1 and not bearing.is_even:
        p = bearing.first_chance(p, robot)
    if world.movers is None:
        return f"threat {chance(p)}"
    return f"threat {chance(p)}, or a mover" if p else "by a mover"


def end_text(trace: Trace, visited: int, survived: int, accessible: int, alive: int) -> str:
    """How a rollout ended."""
    seen, passed = share(visited, accessible), share(survived, accessible)
    return (
        f"rollout {trace.rollout} ends: {trace.outcome.name.lower()} at step {trace.time}, {seen} visited, "
        f"{passed} survived, {alive} of {trace.cells.shape[1]} robots alive"
    )
