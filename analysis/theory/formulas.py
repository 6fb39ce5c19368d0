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
        name, reading: in words; the paper's numbers. plain: what it is about, for who does not know them; readings of
            one statement have it in common. direction: what it says of the truth.
        unit: of its value. paper: the paper's, in this reading; else ours.
        proven: a failure would be a fault of a proof or of this program, not a finding.
        loops: of which it says something.
    """

    name: str
    reading: str
    plain: str
    direction: Direction
    unit: Literal["cells", "chance", "steps"] = "cells"
    paper: bool = True
    proven: bool = False
    loops: tuple[str, ...] = ("open", "closed")

    @property
    def title(self) -> str:
        """Name and reading."""
        return f"{self.name}, {self.reading}" if self.reading else self.name

    @property
    def source(self) -> str:
        """Where it stands: the paper's number, or "ours"."""
        return self.name if self.paper else "ours"


LOWER, UPPER, EQUAL = Direction.LOWER, Direction.UPPER, Direction.EQUAL
OPEN, CLOSED, NOMINAL = ("open",), ("closed",), ("nominal",)


def _ours(
    name: str, reading: str, plain: str, direction: Direction, loops: tuple[str, ...] = ("open", "closed")
) -> Formula:
    return Formula(name, reading, plain, direction, paper=False, proven=True, loops=loops)


FORMULAS = {
    "eq1": Formula("eq. (1)", "a robot's survival", "survival of one robot", EQUAL, "chance", proven=True, loops=OPEN),
    "eq2_printed": Formula("eq. (2)", "as printed", "chance that a robot is left, as printed", EQUAL, "chance"),
    "eq2_event": Formula(
        "eq. (2)", "the event as stated", "chance that a robot is left", EQUAL, "chance", proven=True, loops=OPEN
    ),
    "eq4": Formula("eq. (4)", "one robot", "coverage of one robot alone", EQUAL, proven=True, loops=OPEN),
    "eq5_printed": Formula("eq. (5)", "as printed", "lower bound on coverage, one robot", LOWER, loops=OPEN),
    "eq5_with_c00": Formula("eq. (5)", "with C_0,0", "lower bound on coverage, one robot", LOWER, loops=OPEN),
    **{
        f"theorem3_{c}_{kind}": Formula("Theorem 3", f"C {c}, {kind}", "lower bound on coverage, the team", LOWER)
        for c in ("interior", "travel")
        for kind in ("set", "multiset")
    },
    "eq7_robot": Formula("eq. (7)", "one robot", "upper bound on coverage, one robot", UPPER, proven=True, loops=OPEN),
    "eq7_team": Formula("eq. (7)", "for the team", "the bound of one robot, held against the team", UPPER),
    "theorem1": Formula(
        "Theorem 1", "all cells visited", "cells visited if no robot is lost", EQUAL, proven=True, loops=NOMINAL
    ),
    "theorem2": Formula(
        "Theorem 2",
        "complete or all lost",
        "every run ends complete, or with all robots lost",
        Direction.EVERY_RUN,
        "chance",
        proven=True,
        loops=CLOSED,
    ),
    "theorem4_least": Formula(
        "Theorem 4", "time >= T_1 / k", "least time if no robot is lost", LOWER, "steps", loops=NOMINAL
    ),
    "theorem4_most": Formula(
        "Theorem 4", "time <= T_1", "most time if no robot is lost", UPPER, "steps", loops=NOMINAL
    ),
    "ideal_team": _ours("ideal of the team", "", "upper bound on coverage, the team on any map", UPPER),
    "ideal_connected": _ours("ideal on this map", "", "upper bound on coverage, the team on this map", UPPER),
    "any_strategy": _ours("any strategy", "certified", "upper bound on coverage, every strategy", UPPER),
    "optimum": _ours("optimum", "of every strategy", "coverage of the best strategy", UPPER),
    **{
        f"mended_{form}": _ours(
            "Theorem 3 mended", reading, "lower bound on coverage, the team, corrected", LOWER, loops=OPEN
        )
        for form, reading in (("count", "counts"), ("largest", "chances"), ("spread", "spread"))
    },
    "until_first_loss": _ours("until the first loss", "", "coverage before the first loss", LOWER),
    "eq4_sum": _ours("eq. (4) summed", "", "upper bound on coverage, the robots' own summed", UPPER, loops=OPEN),
}
"""Every formula, in the order of tables."""
