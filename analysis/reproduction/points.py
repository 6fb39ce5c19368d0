"""What the paper's figures are drawn from: one setting of the experiments, averaged over maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.statistics import pooled_control
from analysis.statistics.estimate import Estimate, over_maps
from analysis.sweeps.rows import KEPT, figures_of
from analysis.sweeps.store.store import Run
from planner.tally import Tally

MEANINGS = ("visited", "survived")
COVERAGE = tuple(f"{meaning}{of}" for meaning in MEANINGS for of in ("", "_free"))
"""Coverage of the accessible cells and, `_free`, of all free ones."""
TIME_BIN = 10
"""Steps."""
FIGURE4 = {4: (0.8033, 311), 10: (0.9733, 244)}
"""Robots: coverage and steps of the one run each that Fig. 4 shows; 241 and 292 of 300 cells, so of all free cells."""


Key = tuple[str, str, str]
"""What it is ("mean", "run", "square", "share", "beside" luck, "errors"), the loop, the figure. Loops:
"closed", every visit checked; "first", only the first visit of a cell by anybody; "open", no reallocation, exact."""


@dataclass(frozen=True, eq=False)
class Point:
    """One setting over the same maps. Axis `M` = maps, in order of their seeds.

    Attributes:
        kind: "contiguous" or "scattered". robots: K. ratio: threats, of all cells.
        columns: float64 `[M]` each, of the numbers of `columns_of` and, as "mean", of the open loop's expected values
            and of ("ideal", "visited"), the ideal of the team, of the accessible cells.
        runs: int64 by "coverage" `[101]` and "time" `[T]`: single runs (closed loop) by the per cent of the free cells
            that they cover, rounded down, and by TIME_BIN steps; all maps together.
        rollouts: of each map.
    """

    kind: str
    robots: int
    ratio: float
    columns: dict[Key, NDArray[np.float64]]
    runs: dict[str, NDArray[np.int64]]
    rollouts: int

    @property
    def means(self) -> list[tuple[str, str]]:
        """The (loop, figure) whose means are known."""
        return [(loop, figure) for what, loop, figure in self.columns if what == "mean"]

    def estimate(self, loop: str, figure: str) -> Estimate:
        """Mean over maps; its interval is Student's from the spread between maps, rollouts' noise included."""
        return over_maps(self.columns["mean", loop, figure])

    def spread_of_a_run(self, loop: str, figure: str) -> float:
        """Standard deviation of a single run on a single map: what one run a map, as in the paper, varies by."""
        mean, square = (float(self.columns[what, loop, figure].mean()) for what in ("run", "square"))
        return float(np.sqrt(max(square - mean**2, 0.0)))


def columns_of(run: Run, tally: Tally, loop: str, free: int) -> dict[Key, Any]:
    """What one map's rollouts of a loop came to, a run and its tally; `free`: free cells of its map.

    run, square: mean and mean square of single runs, of each of COVERAGE (fractions) and "time" (steps). share: of
    those that cover no more of the free cells ("coverage"), or take no longer ("time"), than the run of Fig. 4 with so
    many robots.
    beside, errors: of `analysis.statistics.pooled_control.beside_luck`.
    """
    found: dict[Key, Any] = {}
    means, errors = figures_of(run)
    for figure in (*COVERAGE, "time"):
        counts = tally.time if figure == "time" else getattr(tally, figure.removesuffix("_free"))
        unit = 1.0 if figure == "time" else 1.0 / (free if figure.endswith("_free") else tally.accessible)
        often, values = counts.astype(np.float64), np.arange(len(counts)) * unit
        found["run", loop, figure] = float(often @ values) / tally.rollouts
        found["square", loop, figure] = float(often @ values**2) / tally.rollouts
        place = KEPT[figure.replace("_free", "_of_free")]
        found["beside", loop, figure], found["errors", loop, figure] = means[place], errors[place]
    if tally.robots in FIGURE4:
        coverage, steps = FIGURE4[tally.robots]
        cells = int(np.floor(coverage * free + 0.5))
        found["share", loop, "coverage"] = float(tally.visited[: cells + 1].sum()) / tally.rollouts
        found["share", loop, "time"] = float(tally.time[: steps + 1].sum()) / tally.rollouts
    return found


def put_right(columns: dict[Key, NDArray[np.float64]], rollouts: int) -> None:
    """Add each map's "mean" to its "run": less what its luck is worth, by all maps together; by step the same."""
    for _, loop, figure in [key for key in columns if key[0] == "beside"]:
        means, errors = columns["beside", loop, figure], columns["errors", loop, figure]
        columns["mean", loop, figure], _ = pooled_control.put_right(means, errors, len(means) * (rollouts - 1))


def runs_of(tally: Tally, free: int) -> dict[str, NDArray[np.int64]]:
    """Single runs of one map, as of `Point.runs`."""
    per_cent = np.minimum(100 * np.arange(len(tally.visited)) // free, 100)
    in_bins = np.arange(len(tally.time)) // TIME_BIN
    return {
        "coverage": np.bincount(per_cent, weights=tally.visited, minlength=101).astype(np.int64),
        "time": np.bincount(in_bins, weights=tally.time).astype(np.int64),
    }
