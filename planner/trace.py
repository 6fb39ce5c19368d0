"""One closed-loop rollout in full: what every engine reports of a chosen rollout, equal event for event.

Plain types, shared by the simulators and the JAX engine. Axis letters: `T` = time + 1 steps, `K` robots, `E` events,
`N = H * W` cells.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from planner.tally import Outcome


class Doing(IntEnum):
    """What a robot is doing at the end of a step (paper, section 4.2)."""

    IDLE = 0
    TRAVELING = 1
    COVERING = 2
    DONE = 3
    DEAD = 4
    FOLLOWING = 5
    """It follows the path that another planner gave it."""
    RETURNING = 6
    """It is on its way home."""
    CHARGING = 7
    """It stands at a base until it has its range again."""


class EventKind(IntEnum):
    """What happened; the columns of `Trace.events` are (step, robot, kind, area, other)."""

    COMPLETED = 0
    """The robot entered the last unvisited cell of the area. other: that cell."""
    HIT = 1
    """The robot was stopped. area: its own, or NO_AREA. other: the cell that it had entered."""
    REALLOCATED = 2
    """The area of a robot stopped, or at the end of its range, had unvisited cells: they became new areas. other: how
    many (the next ids).
    """
    ALLOCATED = 3
    """The robot got the area and travels to it. other: the cell that it travels to."""
    SHARED = 4
    """The robot shares the area of another: it became new areas (the next ids). other: how many.

    Two ALLOCATED events follow: the owner's part, then the helper's.
    """
    LOOKED_AGAIN = 5
    """The robot gave its area back before a danger on its way. other: that cell. What it got instead follows."""
    REFUSED = 6
    """The robot is done: it is worth more than any area that it can reach. area: the first of them in the policy's
    order; other: the cell that it would have gone to.
    """
    RANGE_ENDED = 7
    """The robot has made its last move. area: its own. other: the cell where it stays."""
    SURPRISED = 8
    """At the end of the step robots saw cells that are not as they believed (SPEC section 15): areas and ways are set
    right. robot: NO_ROBOT. area: NO_AREA. other: how many cells.
    """
    TURNED_HOME = 9
    """The robot turns for home (SPEC section 19). area: its own, or NO_AREA. other: the base that it heads for."""
    HOME = 10
    """The robot has come home. other: the base."""
    CHARGED = 11
    """The robot has its range again. other: the cell where it is."""


@dataclass(frozen=True, eq=False)
class Trace:
    """One rollout, step by step.

    Attributes:
        rollout: its id.
        cells: int32 `[T, K]`, cell index (row * W + col) of each robot at the end of each step from t = 0.
        doing: int8 `[T, K]`, values of `Doing`, at the end of the step.
        areas: int32 `[T, K]`, id of each robot's area at the end of the step; NO_AREA for none (also once stopped).
        events: int32 `[E, 5]`, rows (step, robot, kind, area, other), in the order in which they happened.
        area_of: int32 `[N]`, id of the last area that each cell belonged to; NO_AREA where inaccessible. With the
            parts that `events` announce it tells every area's cells at every step.
        outcome: how it ended; its time is `T - 1`.
    """

    rollout: int
    cells: NDArray[np.int32]
    doing: NDArray[np.int8]
    areas: NDArray[np.int32]
    events: NDArray[np.int32]
    area_of: NDArray[np.int32]
    outcome: Outcome

    @property
    def time(self) -> int:
        """The step at which the rollout ended."""
        return len(self.cells) - 1

    def __eq__(self, other: object) -> bool:
        """Identical, event for event."""
        if not isinstance(other, Trace):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__ = None  # type: ignore[assignment]
