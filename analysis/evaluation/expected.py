"""Expected values and bounds of an evaluated plan, as far as they are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.coverage import Amount
from planner.shown import Rows, html_of, text_of


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected values of the loop that was evaluated, for tables and pictures: exact ones where there are any.

    Attributes:
        visited_by_cell: float64 `[N]`, chance that each cell is visited. stops_by_cell: robots lost there.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
    """

    visited_by_cell: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]

    @property
    def visited(self) -> float:
        """Expected cells visited."""
        return float(self.visited_by_cell.sum())


@dataclass(frozen=True)
class Known:
    """Expected values that are known exactly: coverage in both meanings, robots alive at the end, steps; None: not."""

    visited: Amount | None
    survived: Amount | None
    alive: float | None
    time: float | None


LIMITS = {
    "least": "the smallest of those below that hold for this team",
    "any_strategy": "no strategy of this team exceeds it on this map (proven)",
    "ideal": "no strategy of this team exceeds it on any map with these p: ways cost nothing",
    "ideal_one": "the same for one robot, eq. (7) of the paper; a team may exceed it",
}
"""What the bounds of `Limits` mean, a line each."""


@dataclass(frozen=True, repr=False)
class Limits:
    """Expected coverage that no strategy exceeds; a single run may.

    Attributes:
        least: the least of the bounds that hold. any_strategy: the certified bound of this map; None: not worked out.
        ideal: of the team. ideal_one: of one robot, eq. (7).
    """

    least: Amount
    any_strategy: Amount | None
    ideal: Amount
    ideal_one: Amount

    def _brief(self) -> tuple[str, Rows]:
        """A line for each bound: its name, its value rounded upwards, and what it means."""
        rows = [(name, f"{_upwards(getattr(self, name))}: {meaning}") for name, meaning in LIMITS.items()]
        return "Limits: upper bounds of the mean coverage; a single mission may cover more", rows

    def __repr__(self) -> str:
        return text_of(*self._brief())

    def _repr_html_(self) -> str:
        return html_of(*self._brief())


def _upwards(bound: Amount | None) -> str:
    """A bound from above in two decimals, never less than it is but by what a float is wrong by."""
    if bound is None:
        return "not computed (bound=True computes it where it applies)"
    share, cells = (math.ceil(100 * value - 1e-9) / 100 for value in (100 * bound.mean, bound.cells))
    return f"{share:.2f} % ({cells:,.2f} cells)"
