"""Means over maps, with intervals from the spread between maps, and differences between settings on the same maps.

A map's mean is one observation: the interval of the mean over maps is Student's t of the map means, so the noise of the
rollouts within each map is in it too. The share of the variance that comes from within says what is worth more of:
maps, or rollouts on each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from analysis.statistics.estimate import Z95, Estimate
from analysis.sweeps.store.store import Run

FRACTIONS = ("visited", "survived", "visited_of_free", "survived_of_free")
FIGURES = (*FRACTIONS, "complete", "time", "alive")
"""What runs are summed up in: coverage as a fraction of the accessible or of the free cells, the fraction of rollouts
that covered everything, time in steps, robots alive at the end."""
MISSED = 3
"""Maps of a rare kind that an interval allows for beyond those that were seen."""


@dataclass
class Moments:
    """Map means added one by one; constant memory.

    Attributes:
        maps: how many. mean: of the map means. scatter: sum of their squared distances from it.
        lean: sum of the cubes of those distances.
        within: sum of the squared standard errors of the single map means.
        shared: squared standard error of the mean by luck that the maps share, which their spread does not show.
    """

    maps: int = 0
    mean: float = 0.0
    scatter: float = 0.0
    lean: float = 0.0
    within: float = 0.0
    shared: float = 0.0

    def add(self, mean: float, squared_error: float) -> None:
        """One more map: its mean, and the square of that mean's standard error (from its rollouts)."""
        self.maps += 1
        step = mean - self.mean
        share = step / self.maps
        grows = step * share * (self.maps - 1)
        self.mean += share
        self.lean += share * (grows * (self.maps - 2) - 3 * self.scatter)
        self.scatter += grows
        self.within += squared_error

    @property
    def variance(self) -> float:
        """Of the map means; NaN for less than two maps."""
        return self.scatter / (self.maps - 1) if self.maps > 1 else math.nan

    @property
    def within_share(self) -> float | None:
        """Fraction of the variance of the map means that is noise of the rollouts within a map; None if unknown."""
        if self.maps < 2 or self.variance <= 0:
            return None
        return min(1.0, self.within / self.maps / self.variance)

    def estimate(self, low: float, high: float) -> Estimate:
        """Mean over maps with its standard error and 95 % interval, clipped to `low .. high`.

        Student's t over two maps or more, widened for maps of a rare kind as
        `analysis.statistics.estimate.mean_estimate` is for rare events; where every map gave the same, the rule of
        three. For a single map: the noise of its rollouts, and it speaks of that map alone.
        """
        if self.maps == 0:
            raise ValueError("no maps to estimate from")
        if self.maps == 1:
            se = math.sqrt(self.within)
            half = Z95 * se
        else:
            se = math.sqrt(max(self.variance, 0.0) / self.maps)
            maps, scatter, lean = np.array([[self.maps], [self.scatter], [self.lean]], dtype=np.float64)
            half = math.hypot(widest_half(maps, scatter, lean, high - low), Z95 * math.sqrt(self.shared))
            se = math.hypot(se, math.sqrt(self.shared))
        return Estimate(self.mean, se, (max(self.mean - half, low), min(self.mean + half, high)))


def widest_half(
    maps: NDArray[np.float64], scatter: NDArray[np.float64], lean: NDArray[np.float64], reach: float
) -> float:
    """The largest half-width of the intervals of means over maps, arrays `[groups]`, two maps or more in each.

    Args:
        maps, scatter, lean: as of Moments. reach: what the figure can span, or infinity. Returns NaN without a group.
    """
    if len(maps) == 0:
        return math.nan
    apart = scatter > 0
    jump = np.divide(lean, scatter, out=np.zeros(len(maps)), where=apart)
    wide = np.sqrt(scatter / (maps - 1) / maps + MISSED * (jump / maps) ** 2)
    alike = 3.0 * reach / maps
    return float(np.where(apart, stdtrit(maps - 1, 0.975) * wide, alike).max())


def figure_of(run: Run, name: str) -> tuple[float, float]:
    """(mean over a run's rollouts, square of that mean's standard error) of a figure; 0 for a single rollout."""
    assert run.sums is not None
    n = run.sums["rollouts"]
    if name == "complete":
        p = run.sums["outcomes"][0] / n
        return p, p * (1 - p) / max(n - 1, 1)
    first, second = run.sums[name.removesuffix("_of_free")]
    mean, unit = first / n, unit_of(run, name)
    scatter = (second * n - first * first) / n  # whole numbers: exact until divided
    return mean * unit, scatter / max(n - 1, 1) / n * unit * unit


def exact_of(run: Run, name: str) -> float:
    """The open loop's exact mean of a figure of a run."""
    return float(run.facts["exact"][name.removesuffix("_of_free")]) * unit_of(run, name)


def unit_of(run: Run, name: str) -> float:
    """What one cell, step or robot of a figure counts."""
    if name not in FRACTIONS:
        return 1.0
    cells = run.facts["cells"]
    return 1.0 / float(cells["free" if name.endswith("_of_free") else "accessible"])
