"""What the compiled simulator writes down for a trace: `planner.trace` in plain arrays, empty where nothing is traced.

Part of `planner.kernels.rollouts`, which see.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.jit import kernel
from planner.kernels.state import AREA, CELL, COVERING, DOING, STARTING, STEP, TRAVELING
from planner.none import NONE
from planner.trace import EventKind

COMPLETED_EVENT, HIT_EVENT, REALLOCATED_EVENT = map(int, (EventKind.COMPLETED, EventKind.HIT, EventKind.REALLOCATED))
ALLOCATED_EVENT, SHARED_EVENT = int(EventKind.ALLOCATED), int(EventKind.SHARED)
LOOKED_AGAIN_EVENT, REFUSED_EVENT = int(EventKind.LOOKED_AGAIN), int(EventKind.REFUSED)
RANGE_ENDED_EVENT, SURPRISED_EVENT = int(EventKind.RANGE_ENDED), int(EventKind.SURPRISED)
TURNED_HOME_EVENT, HOME_EVENT, CHARGED_EVENT = map(int, (EventKind.TURNED_HOME, EventKind.HOME, EventKind.CHARGED))
FRAME_CELL, FRAME_DOING, FRAME_AREA, FRAME_ROWS = 0, 1, 2, 3


class Log(NamedTuple):
    """Room for what happens.

    Attributes:
        events: int32 `[E + 1, 5]`: row 0 holds how many happened (more than there is room for are counted, not kept),
            the others are the rows of `Trace.events`.
        frames: int32 `[T, FRAME_ROWS, K]`: cell, doing and area of each robot at the end of each step; later steps are
            not kept.
    """

    events: NDArray[np.int32]
    frames: NDArray[np.int32]


def make_log(steps: int, events: int, robots: int) -> Log:
    """Room for so many steps and events; none for no steps."""
    rows = events + 1 if steps else 0
    return Log(np.zeros((rows, 5), dtype=np.int32), np.zeros((steps, FRAME_ROWS, robots), dtype=np.int32))


@kernel
def note(log, s, robot, kind, area, other):
    """Write down that something happened."""
    if len(log.events) > 0:
        place = log.events[0, 0] + 1
        log.events[0, 0] = place
        if place < len(log.events):
            log.events[place, 0], log.events[place, 1], log.events[place, 2] = s.marks[STEP], robot, kind
            log.events[place, 3], log.events[place, 4] = area, other


@kernel
def has_area(robots, robot):
    """Whether the robot has an area."""
    doing = robots[robot, DOING]
    return doing in (TRAVELING, COVERING, STARTING)


@kernel
def look(log, s, step):
    """Write down where every robot is and what it does at the end of a step."""
    if step < len(log.frames):
        for robot in range(len(s.robots)):
            log.frames[step, FRAME_CELL, robot] = s.robots[robot, CELL]
            log.frames[step, FRAME_DOING, robot] = s.robots[robot, DOING]
            log.frames[step, FRAME_AREA, robot] = s.robots[robot, AREA] if has_area(s.robots, robot) else NONE
