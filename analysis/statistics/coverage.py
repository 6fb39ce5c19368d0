"""What a tally says of a mission: coverage as a distribution, chances of it, losses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import tally_mean
from analysis.statistics.estimate import Estimate, exactly, proportion, quantile
from analysis.statistics.words import between, lost_words, meant_fraction
from planner.arguments import FRACTION, Numbers
from planner.tally import Tally

AT_LEAST = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
"""Fractions x for which P(coverage >= x) is reported."""


@dataclass(frozen=True)
class Amount:
    """A known amount of coverage: `mean`, a fraction of the accessible cells, and the same in `cells`."""

    mean: float
    cells: float

    @staticmethod
    def of(cells: float, accessible: int) -> Amount:
        """So many of the accessible cells."""
        return Amount(cells / accessible, cells)

    def __str__(self) -> str:
        return f"{100 * self.mean:.2f} % ({self.cells:,.2f} cells)"


@dataclass(frozen=True, eq=False)
class Coverage(Estimate):
    """Coverage of a loop: its mean, a fraction of the accessible cells, and how single runs scatter around it.

    Attributes:
        counts: int64 `[accessible + 1]`, rollouts by cells covered.
    """

    counts: NDArray[np.int64]

    @staticmethod
    def of(tally: Tally, meaning: str, known: Amount | None = None) -> Coverage:
        """Of "visited" or "survived" coverage; `known`: the mean, where it is exact."""
        mean = tally_mean(tally, meaning, 1.0 / tally.accessible) if known is None else exactly(known.mean)
        return Coverage(mean.mean, mean.se, mean.ci95, getattr(tally, meaning))

    @property
    def cells(self) -> float:
        """The mean in cells."""
        return self.mean * (len(self.counts) - 1)

    def quantile(self, q: float) -> float:
        """The least fraction that a share `q` of the runs does not exceed: 0.05 for what 95 % of runs reach."""
        _check_fraction("q", q)
        return quantile(self.counts, q) / (len(self.counts) - 1)

    def at_least(self, fraction: float) -> Estimate:
        """The chance to cover that fraction or more."""
        _check_fraction("fraction", fraction)
        return at_least(self.counts, fraction)


TARGETS = Numbers(0, 1, "a fraction of the accessible cells", above=True)
"""What a user may want covered."""


def _check_fraction(name: str, value: object) -> None:
    FRACTION.check(name, value, fix=meant_fraction(value))


def at_least(counts: NDArray[np.int64], fraction: float, certain: bool = False) -> Estimate:
    """P(coverage >= fraction) from a histogram of covered cells `[accessible + 1]`, as of `proportion`."""
    needed = math.ceil(fraction * (len(counts) - 1) - 1e-9)
    return proportion(int(counts[needed:].sum()), int(counts.sum()), certain)


def losses_shown(losses: Estimate, robots: int) -> tuple[str, str]:
    """Robots lost of so many, and the interval: ("1.87 of 5", "1.85 .. 1.89"), ("next to all 5", "4.98 or more")."""
    (low, high), digits = losses.ci95, min(losses.digits(), 2)
    ends = between(low, high, digits).split(" .. ")
    interval = "exact" if low == high else " .. ".join(ends)
    if low < high == robots and low > 0:
        interval = f"{ends[0]} or more"
    elif 0 == low < high < robots:
        interval = f"{ends[-1]} or fewer"
    return lost_words(losses.mean, robots, digits), interval
