"""What the compiled simulator writes down for a trace: `planner.trace` in plain arrays.

Part of `planner.kernels.rollouts`, which see. `events` is int32 `[E + 1, 5]`: row 0 holds how many happened (more than
there is room for are counted, not kept), the others are the rows of `Trace.events`. `frames` is int32
`[T, FRAME_ROWS, K]`: cell, doing and area of each robot at the end of each step; later steps are not kept.
"""

from __future__ import annotations

from planner.jit import threaded
from planner.kernels.state import AREA, CELL, DOING
from planner.trace import EventKind

COMPLETED_EVENT, HIT_EVENT, REALLOCATED_EVENT = map(int, (EventKind.COMPLETED, EventKind.HIT, EventKind.REALLOCATED))
ALLOCATED_EVENT, SHARED_EVENT = int(EventKind.ALLOCATED), int(EventKind.SHARED)
FRAME_CELL, FRAME_DOING, FRAME_AREA, FRAME_ROWS = 0, 1, 2, 3


@threaded
def note(events, step, robot, kind, area, other):
    """Write down that something happened."""
    place = events[0, 0] + 1
    events[0, 0] = place
    if place < len(events):
        events[place, 0], events[place, 1], events[place, 2] = step, robot, kind
        events[place, 3], events[place, 4] = area, other


@threaded
def look(frames, step, robots):
    """Write down where every robot is and what it does at the end of a step."""
    if step < len(frames):
        frames[step, FRAME_CELL] = robots[CELL]
        frames[step, FRAME_DOING] = robots[DOING]
        frames[step, FRAME_AREA] = robots[AREA]
