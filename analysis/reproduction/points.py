"""What the paper's figures are drawn from: one setting of the experiments, averaged over maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate, over_maps
from planner.tally import Tally

LOOPS = ("closed", "first", "open")
"""closed: every visit checked; first: only the first visit of a cell by anybody; open: no reallocation, exact."""
MEANINGS = ("visited", "survived")
COVERAGE = tuple(f"{meaning}{of}" for meaning in MEANINGS for of in ("", "_free"))
"""Coverage of the accessible cells and, `_free`, of all free ones."""
TIME_BIN = 10
"""Steps."""
FIGURE4 = {4: (0.8033, 311), 10: (0.9733, 244)}
"""Robots: coverage and steps of the one run each that Fig. 4 shows; 241 and 292 of 300 cells, so of all free cells."""


@dataclass(frozen=True, eq=False)
class Point:
    """One setting over the same maps. Axis `M` = maps, in order of their seeds.

    Attributes:
        kind: "contiguous" or "scattered". robots: K. ratio: threats, of all cells.
        means: float64 `[M]` by (loop, figure): mean over a map's rollouts (open: the expected value) of each of
            COVERAGE (fractions) and "time" (steps); ("ideal", "visited"): the ideal of the team, of the accessible
            cells.
        squares: float64 `[M]` by (loop, figure), mean of the squares of single runs; not of the open loop.
        shares: float64 `[M]` by (loop, "coverage" or "time"): share of a map's single runs that cover no more of the
            free cells, or take no longer, than the run of Fig. 4 with so many robots; empty for other teams.
        runs: int64 by "coverage" `[101]` and "time" `[T]`: single runs (closed loop) by the per cent of the free cells
            that they cover, rounded down, and by TIME_BIN steps; all maps together.
        rollouts: of each map.
    """

    kind: str
    robots: int
    ratio: float
    means: dict[tuple[str, str], NDArray[np.float64]]
    squares: dict[tuple[str, str], NDArray[np.float64]]
    shares: dict[tuple[str, str], NDArray[np.float64]]
    runs: dict[str, NDArray[np.int64]]
    rollouts: int

    def estimate(self, loop: str, figure: str) -> Estimate:
        """Mean over maps; its interval is Student's from the spread between maps, rollouts' noise included."""
        return over_maps(self.means[loop, figure])

    def spread_of_a_run(self, loop: str, figure: str) -> float:
        """Standard deviation of a single run on a single map: what one run a map, as in the paper, varies by."""
        mean = float(self.means[loop, figure].mean())
        return float(np.sqrt(max(float(self.squares[loop, figure].mean()) - mean**2, 0.0)))


@dataclass(frozen=True)
class MapRuns:
    """What one map's rollouts of one loop came to, in numbers: the columns of a Point."""

    means: dict[str, float]
    squares: dict[str, float]
    shares: dict[str, float]
    runs: dict[str, NDArray[np.int64]]


def runs_of(tally: Tally, free: int) -> MapRuns:
    """The columns of one tally; `free`: free cells of its map."""
    n, means, squares, shares = tally.rollouts, {}, {}, {}
    for figure in (*COVERAGE, "time"):
        counts = tally.time if figure == "time" else getattr(tally, figure.removesuffix("_free"))
        unit = 1.0 if figure == "time" else 1.0 / (free if figure.endswith("_free") else tally.accessible)
        values = np.arange(len(counts)) * unit
        means[figure], squares[figure] = float(counts @ values) / n, float(counts @ values**2) / n
    if len(tally.alive) - 1 in FIGURE4:
        coverage, steps = FIGURE4[len(tally.alive) - 1]
        cells = int(np.floor(coverage * free + 0.5))
        shares = {
            "coverage": float(tally.visited[: cells + 1].sum()) / n,
            "time": float(tally.time[: steps + 1].sum()) / n,
        }
    per_cent = np.minimum(100 * np.arange(len(tally.visited)) // free, 100)
    in_bins = np.arange(len(tally.time)) // TIME_BIN
    runs = {
        "coverage": np.bincount(per_cent, weights=tally.visited, minlength=101).astype(np.int64),
        "time": np.bincount(in_bins, weights=tally.time).astype(np.int64),
    }
    return MapRuns(means, squares, shares, runs)
