"""The smallest worlds known on which each of the paper's formulas fails: one row of cells, to be followed by hand.

And one in which a robot is shut in, on which the readings of Theorem 3 differ.
"""

import math
from dataclasses import dataclass

from planner.world.world import World


@dataclass(frozen=True)
class Counterexample:
    """A world on which a formula fails.

    Attributes:
        name: of the world. threat: p of each cell of its one row. starts: column of each robot's start.
        fails: key of the check (`analysis.theory.verdicts`). value, truth: what the formula says, and what is exact.
        why: in one sentence.
    """

    name: str
    threat: tuple[float, ...]
    starts: tuple[int, ...]
    fails: str
    value: float
    truth: float
    why: str

    @property
    def world(self) -> World:
        """The world with its starts."""
        return World.create([self.threat], starts=[(0, col) for col in self.starts], source=self.name)


COUNTEREXAMPLES = tuple(Counterexample(*one) for one in (
    ("both into danger", (0.5, 0.5), (0, 0), "eq2_printed/open", 0.75, 0.625,
     "It asks that both are never hit in one step; they can be lost one after the other."),
    ("a gate, two robots", (0.0, 0.0, 0.5, 0.0), (0, 1), "eq2_printed/open", 1.0, 0.75,
     "Both pass the gate, one step apart: no step has both in danger."),
    ("a gate", (0.0, 0.0, 0.5, 0.0), (3,), "eq5_printed/survived/open", 3.0, 2.5,
     "C_0,0, the way out of the start's area, leads through the gate and is left out."),
    ("one cell each, safe", (0.0, 0.0), (0, 1), "eq5_with_c00/survived/open", 2.0, 1.0,
     "|A| counts a cell that another robot visited first: its owner never goes there."),
    ("a row with an end", (0.0, 0.0, 0.0, 0.5), (1, 2), "eq5_with_c00/survived/open", 3.0, 2.0,
     "The same where both robots cover an area: robot 1 starts on a cell of robot 0's."),
    ("both on one cell", (0.0,), (0, 0), "theorem3_interior_set/visited/open", 2.0, 1.0,
     "A cell visited by two robots that is on no connecting path."),
    ("both on one cell", (0.0,), (0, 0), "theorem3_interior_multiset/visited/open", 2.0, 1.0,
     "Counting cells as often as they are travelled does not help: C is empty."),
    ("three on one cell", (0.0,), (0, 0, 0), "theorem3_travel_set/visited/open", 2.0, 1.0,
     "Three visits of a cell, and C as a set takes off one."),
    ("a safe row", (0.0, 0.0, 0.0, 0.0), (0, 1), "theorem3_interior_set/visited/open", 5.0, 4.0,
     "Robot 0 covers the cell from which robot 1 starts: twice visited, never travelled."),
    ("a safe row", (0.0, 0.0, 0.0, 0.0), (0, 1), "theorem3_interior_multiset/survived/open", 5.0, 4.0,
     "The same: no cell of C is visited twice."),
    ("three in a row", (0.0, 0.125, 0.0, 0.0, 0.5), (3, 2, 0), "theorem3_travel_set/visited/open", 5.5, 4.875,
     "All three pass the cells between them; C as a set takes each off once."),
    ("three in a row", (0.0, 0.125, 0.0, 0.0, 0.5), (3, 2, 0), "theorem3_travel_set/survived/open",
     4.6875, 4.435546875, "The same for cells that a robot leaves alive."),
    ("one cell each, dangerous", (0.5, 0.5), (0, 1), "eq7_team/visited/open", 1.5, 2.0,
     "The ideal of one robot: two robots reach more."),
    ("two gates", (0.0, 0.5, 0.0, 0.5), (0, 2), "eq7_team/visited/open", 3.5, 4.0,
     "The same from safe starts."),
    ("a safe row, side by side", (0.0, 0.0, 0.0, 0.0), (1, 2), "theorem4_least/nominal", 2.0, 1.0,
     "From the middle outwards nobody drives back: faster than T_1 / k."),
    ("slower together", (0.5, 0.25, 0.0, 0.0, 0.0, 0.25, 0.0), (6, 3), "theorem4_most/nominal", 6.0, 7.0,
     "The areas fall to the robots so that one drives there and back: slower than alone."),
))  # fmt: skip

SHUT_IN = World.create(
    [[0.0, 0.0, 0.3], [math.nan] * 3, [0.0, math.nan, 0.0]], starts=[(0, 0), (2, 0)], source="shut in"
)
"""A robot that cannot move, by itself on one cell: there Theorem 3 holds, by far, where C is what is travelled.

Eq. (4): 3 + 1 = 4, which is the coverage too. C = {0, 6, 2}, cell 6 being the start of the robot that never moves.
"""
