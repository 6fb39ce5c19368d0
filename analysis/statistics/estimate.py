"""Estimates from tallies: means, standard errors, intervals and quantiles of integer histograms.

Every figure comes from integer counts, so it depends on which rollouts were run and on nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from planner.tally import BLOCK, MOST_ROLLOUTS

Z95 = float(norm.ppf(0.975))
QUANTILES = (0.05, 0.5, 0.95)
MISSED = 3
"""Rare events that an interval allows for beyond those that were seen."""


@dataclass(frozen=True)
class Estimate:
    """A mean with its standard error and 95 % interval, all in the unit of the mean."""

    mean: float
    se: float
    ci95: tuple[float, float]

    @property
    def half_width(self) -> float:
        """Half the width of the interval before it was clipped to what is possible."""
        return max(self.ci95[1] - self.mean, self.mean - self.ci95[0])

    def to_json(self) -> dict[str, Any]:
        """Mean, standard error and interval; None for what one value alone does not tell."""
        se = self.se if math.isfinite(self.se) else None
        return {"mean": self.mean, "se": se, "ci95": list(self.ci95) if all(map(math.isfinite, self.ci95)) else None}


@dataclass(frozen=True)
class Spread:
    """An estimate of a mean with quantiles of the single rollouts."""

    estimate: Estimate
    quantiles: dict[float, float]


def mean_estimate(counts: NDArray[np.int64], unit: float, bounded: bool = True) -> Estimate:
    """Mean of the values `0, 1, 2, ...` (times `unit`) of a histogram `counts`, with its interval.

    The interval is `mean +- max(z sqrt(se^2 + 3 (jump / n)^2), 3 range / n)`. The jump is the third central moment
    over the second: next to nothing for a bell, the size of the event where rare events make the variance, of which
    the sample may have met a few too few; three more of them are counted in. So the interval of a rare event holds as
    often as it says too (`tests/test_analysis_estimate.py`). The last part is the rule of three: no collapse to a
    point while every rollout so far gave the same value. `bounded` values lie in `[0, len(counts) - 1]`; the interval
    is clipped to that. Raises ValueError on an empty histogram.
    """
    n = int(counts.sum())
    if n == 0:
        raise ValueError("no rollouts to estimate from")
    values = np.arange(len(counts))
    mean = int(counts @ values) / n
    most = len(counts) - 1
    if n == 1:
        return Estimate(mean * unit, float("nan"), (0.0, most * unit))
    scatter, lean = (float(counts @ (values - mean) ** power) for power in (2, 3))
    se = float(np.sqrt(scatter / (n - 1) / n))
    jump = lean / scatter if scatter > 0 else 0.0
    half = Z95 * float(np.sqrt(se**2 + MISSED * (jump / n) ** 2))
    if bounded:
        half = max(half, 3.0 * most / n)
    low, high = max(mean - half, 0.0), mean + half
    return Estimate(mean * unit, se * unit, (low * unit, (min(high, most) if bounded else high) * unit))


def spread(counts: NDArray[np.int64], unit: float) -> Spread:
    """Mean and quantiles of a histogram."""
    return Spread(mean_estimate(counts, unit), {q: quantile(counts, q) * unit for q in QUANTILES})


def quantile(counts: NDArray[np.int64], q: float) -> int:
    """The smallest value that at least a fraction `q` of the rollouts do not exceed."""
    total = np.cumsum(counts)
    return int(np.searchsorted(total, q * total[-1] - 1e-9 * total[-1], side="left"))


def proportion(successes: int, n: int) -> Estimate:
    """A probability with Wilson's 95 % interval, which stays sensible at 0 and 1."""
    p, z2 = successes / n, Z95**2
    centre, spread_ = (
        (p + z2 / (2 * n)) / (1 + z2 / n),
        Z95 / (1 + z2 / n) * np.sqrt(p * (1 - p) / n + z2 / (4 * n * n)),
    )
    low, high = max(0.0, float(centre - spread_)), min(1.0, float(centre + spread_))
    return Estimate(p, float(np.sqrt(p * (1 - p) / n)), (min(low, p), max(high, p)))


def looks(start: int = BLOCK) -> list[int]:
    """The numbers of rollouts after which `--precision` looks: BLOCK * 2**j, up to the ids that exist."""
    return [start << j for j in range(32) if start << j <= MOST_ROLLOUTS]
