"""The smallest worlds known on which each of the paper's formulas fails: one row of cells, to be followed by hand.

And one in which a robot is shut in, on which the readings of Theorem 3 differ.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import yaml

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
    threat: list[float]
    starts: list[int]
    fails: str
    value: float
    truth: float
    why: str

    @property
    def world(self) -> World:
        """The world with its starts."""
        return World.create([self.threat], starts=[(0, col) for col in self.starts], source=self.name)


FILE = Path(__file__).parent / "fixtures" / "counterexamples.yaml"
COUNTEREXAMPLES = tuple(Counterexample(**one) for one in yaml.safe_load(FILE.read_text()))
SHUT_IN = World.create(
    [[0.0, 0.0, 0.3], [math.nan] * 3, [0.0, math.nan, 0.0]], starts=[(0, 0), (2, 0)], source="shut in"
)
"""A robot that cannot move, by itself on one cell: there Theorem 3 holds, by far, where C is what is travelled.

Eq. (4): 3 + 1 = 4, which is the coverage too. C = {0, 6, 2}, cell 6 being the start of the robot that never moves.
"""
