"""Expected values and bounds of an evaluated plan, as far as they are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.coverage import Amount


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


@dataclass(frozen=True)
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
