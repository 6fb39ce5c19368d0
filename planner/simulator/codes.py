"""Numbers that stand for outcomes, events, and what robots do; and for no id. Needs nothing but Python."""

from __future__ import annotations

from enum import IntEnum
from typing import Self

NONE = -1
"""None of whatever is meant; the kernels, where one number may be of several kinds, say only this."""
NO_CELL = NO_AREA = NO_ROBOT = NO_STEP = NO_ROLLOUT = NONE
ALWAYS, NEVER = 2**62, -(2**62)
"""That a hazard is there, and that none is."""
BLOCKED = 0
"""Entry cost of a cell that cannot be entered."""


class Outcome(IntEnum):
    """How a rollout or a mission ended; the values are the positions in `Tally.outcomes`."""

    clause: str
    """What users read beside the word, after "the mission"."""

    def __new__(cls, code: int, clause: str = "") -> Self:
        """The member with this code."""
        member = int.__new__(cls, code)
        member._value_, member.clause = code, clause
        return member

    COMPLETE = 0, "visits every accessible cell"
    """Also when the last robot is lost in that very step."""
    ALL_ROBOTS_LOST = 1, "loses all robots"
    """With cells left."""
    NO_PROGRESS = 2, "ends because no robot can go on"
    """Closed loop: robots are alive, but none can move or get an area."""
    STEP_LIMIT = 3, "is cut off at the step limit"
    """Closed loop: `t = T_max`. Counts and recordings hold this code for a deadline too (`by_deadline`)."""
    END_OF_PATHS = 4, "ends with its paths"
    """Open loop: robots are alive at the end of their paths, with cells left."""
    NOT_WORTH_THE_RISK = 5, "ends because the rest is not worth the risk"
    """Closed loop: none moves on, though a robot alive could reach an area that nobody has (`robot_value`)."""
    ENDED_BY_OPERATOR = 6, "is ended by its operator"
    """A mission under way that a command ended."""
    DEADLINE = 7, "is cut off at the deadline"
    """Closed loop: `t` is the deadline of the plan. No count holds it: see STEP_LIMIT."""

    @property
    def word(self) -> str:
        """What files, JSON and pages call it."""
        return self.name.lower()

    def by_deadline(self, deadline: bool) -> Outcome:
        """DEADLINE for a run that was cut off, if a `deadline` did it, not the step limit; others unchanged."""
        return Outcome.DEADLINE if deadline and self is Outcome.STEP_LIMIT else self


# One closed-loop rollout in full: what every engine reports of a chosen rollout, equal event for event.
#
# Plain types, shared by the simulators and the JAX engine. Axis letters: `T` = time + 1 steps, `K` robots, `E` events,
# `N = H * W` cells.


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
