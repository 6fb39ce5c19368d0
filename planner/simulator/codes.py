"""Codes of outcomes, events and activities, and the sentinel for "no id". Standard library only."""

from __future__ import annotations

from enum import IntEnum
from typing import Self

NONE = -1
"""Sentinel for "no id" (-1), of any kind; kernels use this name, since one number may be of several kinds."""
NO_CELL = NO_AREA = NO_ROBOT = NO_STEP = NO_ROLLOUT = NONE
ALWAYS, NEVER = 2**62, -(2**62)
"""Log odds of a hazard that certainly exists, and of one that certainly does not."""
BLOCKED = 0
"""Entry cost of a cell that cannot be entered."""


class Outcome(IntEnum):
    """How a rollout or a mission ended; the values are the positions in `Tally.outcomes`."""

    clause: str
    """Text after "the mission" in messages."""

    def __new__(cls, code: int, clause: str = "") -> Self:
        """The member with this code."""
        member = int.__new__(cls, code)
        member._value_, member.clause = code, clause
        return member

    COMPLETE = 0, "visits every accessible cell"
    """Also if the last robot is lost in that very step."""
    ALL_ROBOTS_LOST = 1, "loses all robots"
    """With unvisited cells left."""
    NO_PROGRESS = 2, "ends because no robot can go on"
    """Closed loop: robots are alive, but none can move or get an area."""
    STEP_LIMIT = 3, "is cut off at the step limit"
    """Closed loop: `t = T_max`. Counts and recordings hold this code for a deadline too (`by_deadline`)."""
    END_OF_PATHS = 4, "ends with its paths"
    """Open loop: robots are alive at the end of their paths, with cells left."""
    NOT_WORTH_THE_RISK = 5, "ends because the rest is not worth the risk"
    """Closed loop: no robot goes on, though one could reach an unassigned area (`robot_value`)."""
    ENDED_BY_OPERATOR = 6, "is ended by its operator"
    """A running mission that a command ended."""
    DEADLINE = 7, "is cut off at the deadline"
    """Closed loop: `t` is the deadline of the plan. No count holds it: see STEP_LIMIT."""

    @property
    def word(self) -> str:
        """Its name in files, JSON and pages."""
        return self.name.lower()

    def by_deadline(self, deadline: bool) -> Outcome:
        """DEADLINE if the run was cut off by a deadline (`deadline`) instead of the step limit; others unchanged."""
        return Outcome.DEADLINE if deadline and self is Outcome.STEP_LIMIT else self


# One closed-loop rollout in full: every engine reports a chosen rollout in these codes, event for event.
#
# Plain types, shared by the simulator and the JAX engine.


class Doing(IntEnum):
    """Activity of a robot at the end of a step (paper, section 4.2)."""

    IDLE = 0
    TRAVELING = 1
    COVERING = 2
    DONE = 3
    DEAD = 4
    FOLLOWING = 5
    """On the path of another planner."""
    RETURNING = 6
    """On the way to base."""
    CHARGING = 7
    """At a base until it is recharged."""


class EventKind(IntEnum):
    """Kinds of events; the columns of `Trace.events` are (step, robot, kind, area, other)."""

    COMPLETED = 0
    """The robot entered the last unvisited cell of the area. other: that cell."""
    HIT = 1
    """The robot was lost. area: its own, or NO_AREA. other: the cell that it had entered."""
    REALLOCATED = 2
    """The area of a robot that was lost, or at the end of its range, had unvisited cells: they became new areas. other:
    how many (the next ids).
    """
    ALLOCATED = 3
    """The robot got the area and travels to it. other: the cell that it travels to."""
    SHARED = 4
    """The robot shares the area of another: it became new areas (the next ids). other: how many.

    Two ALLOCATED events follow: the owner's part, then the helper's.
    """
    LOOKED_AGAIN = 5
    """The robot re-evaluated before a danger and gave its area back. other: that cell. Its next area follows."""
    REFUSED = 6
    """The robot is done: no area that it can reach is worth the risk. area: the first of them in the policy's order;
    other: the cell that it would have gone to.
    """
    RANGE_ENDED = 7
    """The robot has made its last move. area: its own. other: the cell where it stays."""
    SURPRISED = 8
    """At the end of the step robots saw cells that differ from their map (SPEC section 15): areas and paths are
    updated. robot: NO_ROBOT. area: NO_AREA. other: how many cells.
    """
    TURNED_HOME = 9
    """The robot starts its return to base (SPEC section 19). area: its own, or NO_AREA. other: the base."""
    HOME = 10
    """The robot is at base. other: the base."""
    CHARGED = 11
    """The robot is recharged. other: its cell."""


# The same numbers for kernels, and further codes of the simulator's functions.

IDLE, TRAVELING, COVERING, DONE, DEAD, FOLLOWING, RETURNING, CHARGING = map(int, Doing)
LANDING, STARTING = range(len(Doing), len(Doing) + 2)
"""States of a robot that has not entered its start yet: without an area, and with one."""
COMPLETE, ALL_ROBOTS_LOST, NO_PROGRESS, STEP_LIMIT, _, NOT_WORTH_THE_RISK, _, _ = map(int, Outcome)
GROUP_SPLITS, CUT, AREAS_FULL = -2, -3, -4  # none of them is NONE
"""Why `advance` returns before the end of a run: the group splits; all its mass is below the cut; no room for areas."""
RESTS, GAINS, MOVES, NO_ROOM = 0, 1, 2, -1
"""Results of a turn: no move; an area and no move; a move; the area registry is full."""
ACTS, HIT, PASSED = range(3)
"""Verdicts: the next robot acts; the robot is lost in the cell that it entered; it survived there."""
