"""The formulas that `mrac-jax check` judges, by key: what each is, says, and where; values are made elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Direction(StrEnum):
    """What a formula says of its truth."""

    LOWER = "lower bound"
    UPPER = "upper bound"
    EQUAL = "equality"
    EVERY_RUN = "in every run"


@dataclass(frozen=True)
class Formula:
    """One formula in one reading.

    Attributes:
        name, reading: in words; the paper's numbers. direction: what it says of the truth.
        unit: of its value. paper: the paper's, in this reading; else ours.
        proven: a failure would be a fault of a proof or of this program, not a finding.
        loops: of which it says something.
    """

    name: str
    reading: str
    direction: Direction
    unit: Literal["cells", "chance", "steps"] = "cells"
    paper: bool = True
    proven: bool = False
    loops: tuple[str, ...] = ("open", "closed")

    @property
    def title(self) -> str:
        """Name and reading."""
        return f"{self.name}, {self.reading}" if self.reading else self.name


LOWER, UPPER, EQUAL = Direction.LOWER, Direction.UPPER, Direction.EQUAL
OPEN, CLOSED, NOMINAL = ("open",), ("closed",), ("nominal",)
FORMULAS = {
    "eq1": Formula("eq. (1)", "a robot's survival", EQUAL, "chance", proven=True, loops=OPEN),
    "eq2_printed": Formula("eq. (2)", "as printed", EQUAL, "chance"),
    "eq2_event": Formula("eq. (2)", "the event as stated", EQUAL, "chance", proven=True, loops=OPEN),
    "eq4": Formula("eq. (4)", "one robot", EQUAL, proven=True, loops=OPEN),
    "eq5_printed": Formula("eq. (5)", "as printed", LOWER, loops=OPEN),
    "eq5_with_c00": Formula("eq. (5)", "with C_0,0", LOWER, loops=OPEN),
    "theorem3_interior_set": Formula("Theorem 3", "C interior, set", LOWER),
    "theorem3_interior_multiset": Formula("Theorem 3", "C interior, multiset", LOWER),
    "theorem3_travel_set": Formula("Theorem 3", "C travel, set", LOWER),
    "theorem3_travel_multiset": Formula("Theorem 3", "C travel, multiset", LOWER),
    "eq7_robot": Formula("eq. (7)", "one robot", UPPER, proven=True, loops=OPEN),
    "eq7_team": Formula("eq. (7)", "for the team", UPPER),
    "theorem1": Formula("Theorem 1", "all cells visited", EQUAL, proven=True, loops=NOMINAL),
    "theorem2": Formula("Theorem 2", "complete or all lost", Direction.EVERY_RUN, "chance", proven=True, loops=CLOSED),
    "theorem4_least": Formula("Theorem 4", "time >= T_1 / k", LOWER, "steps", loops=NOMINAL),
    "theorem4_most": Formula("Theorem 4", "time <= T_1", UPPER, "steps", loops=NOMINAL),
    "ideal_team": Formula("ideal of the team", "", UPPER, paper=False, proven=True),
    "ideal_connected": Formula("ideal on this map", "", UPPER, paper=False, proven=True),
    "any_strategy": Formula("any strategy", "certified", UPPER, paper=False, proven=True),
    "optimum": Formula("optimum", "of every strategy", UPPER, paper=False, proven=True),
    "mended_count": Formula("Theorem 3 mended", "counts", LOWER, paper=False, proven=True, loops=OPEN),
    "mended_largest": Formula("Theorem 3 mended", "chances", LOWER, paper=False, proven=True, loops=OPEN),
    "mended_spread": Formula("Theorem 3 mended", "spread", LOWER, paper=False, proven=True, loops=OPEN),
    "until_first_loss": Formula("until the first loss", "", LOWER, paper=False, proven=True),
    "eq4_sum": Formula("eq. (4) summed", "", UPPER, paper=False, proven=True, loops=OPEN),
}
"""Every formula, in the order of tables."""
