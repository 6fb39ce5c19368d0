"""Events of a rollout in words."""

from __future__ import annotations

from dataclasses import dataclass

from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from planner.none import NO_AREA
from planner.shown import counted
from planner.tally import Outcome
from planner.trace import EventKind, Trace
from planner.worlds.world import World

LEVELS = {
    EventKind.COMPLETED: Log.INFO,
    EventKind.HIT: Log.ERROR,
    EventKind.REALLOCATED: Log.WARNING,
    EventKind.ALLOCATED: Log.INFO,
    EventKind.SHARED: Log.WARNING,
    EventKind.LOOKED_AGAIN: Log.INFO,
    EventKind.REFUSED: Log.WARNING,
    EventKind.RANGE_ENDED: Log.WARNING,
}
END_LEVELS = {Outcome.COMPLETE: Log.INFO, Outcome.PATH_END: Log.INFO, Outcome.CALLED_OFF: Log.INFO}
"""Of the line that tells how a rollout ended; others are errors."""


@dataclass(frozen=True)
class Line:
    """An event in words: the step, whom it is about, foxglove.Log's level, what happened."""

    step: int
    robot: int
    kind: EventKind
    level: int
    text: str


def event_line(row: NDArray, world: World) -> Line:
    """One row of `Trace.events` in words."""
    step, robot, number, area, other = (int(value) for value in row)
    kind = EventKind(number)

    def cell(index: int) -> str:
        return str(list(divmod(index, world.shape[1])))

    if kind == EventKind.COMPLETED:
        text = f"robot {robot} completes area {area} at {cell(other)}"
    elif kind == EventKind.HIT:
        threat = 100 * float(world.threat.reshape(-1)[other])
        where = "" if area == NO_AREA else f"; its area was {area}"
        text = f"robot {robot} is lost at {cell(other)}, threat {threat:.3g} %{where}"
    elif kind == EventKind.REALLOCATED:
        text = f"area {area} of robot {robot} is free again, in {counted(other, 'part')}"
    elif kind == EventKind.ALLOCATED:
        text = f"robot {robot} gets area {area} and goes to {cell(other)}"
    elif kind == EventKind.SHARED:
        text = f"robot {robot} shares area {area}, in {other} parts"
    elif kind == EventKind.LOOKED_AGAIN:
        text = f"robot {robot} looks again before {cell(other)} and gives area {area} back"
    elif kind == EventKind.RANGE_ENDED:
        text = f"robot {robot} stays at {cell(other)}: that was the last move of its range; its area was {area}"
    else:
        text = f"robot {robot} is done: it refuses area {area}, at {cell(other)}, and all others that it can reach"
    return Line(step, robot, kind, LEVELS[kind], text)


def end_text(trace: Trace, visited: int, survived: int, accessible: int, alive: int) -> str:
    """How a rollout ended."""
    share, passed = 100 * visited / accessible, 100 * survived / accessible
    return (
        f"rollout {trace.rollout} ends: {trace.outcome.name.lower()} at step {trace.time}, {share:.1f} % visited, "
        f"{passed:.1f} % survived, {alive} of {trace.cells.shape[1]} robots alive"
    )
