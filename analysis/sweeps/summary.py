"""Means over maps, with intervals from the spread between maps.

A map's mean is one observation: the interval of the mean over maps is Student's t of the map means, so the noise of the
rollouts within each map is in it too. The share of the variance that comes from within says what is worth more of:
maps, or rollouts on each.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from analysis.statistics.estimate import Z95, Estimate

MISSED = 3
"""Maps of a rare kind that an interval allows for beyond those that were seen."""


class Moments:
    """Map means of several figures, added map by map; constant memory.

    Attributes:
        maps: how many. mean: of the map means, float64 `[F]`, as the others are.
        scatter, lean: sums of the squares and of the cubes of their distances from it.
        within: sum of the squared standard errors of the single map means.
        shared: squared standard error of the mean by luck that the maps share, which their spread does not show.
    """

    def __init__(self, figures: int) -> None:
        self.maps = 0
        zeros: NDArray[np.float64] = np.zeros((5, figures))
        self.mean, self.scatter, self.lean, self.within, self.shared = zeros

    def add(self, means: ArrayLike, squared_errors: ArrayLike) -> None:
        """One more map: its means `[F]`, and the squares of their standard errors (from its rollouts)."""
        self.maps += 1
        step = means - self.mean
        share = step / self.maps
        grows = step * share * (self.maps - 1)
        self.mean += share
        self.lean += share * (grows * (self.maps - 2) - 3 * self.scatter)
        self.scatter += grows
        self.within += squared_errors

    def within_share(self, place: int) -> float | None:
        """Fraction of the variance of the map means that is noise of the rollouts within a map; None if unknown."""
        if self.maps < 2 or self.scatter[place] <= 0:
            return None
        return min(1.0, float(self.within[place] / self.maps / (self.scatter[place] / (self.maps - 1))))

    def estimate(self, place: int, low: float, high: float) -> Estimate:
        """Mean over maps of the figure at `place`, its standard error and 95 % interval, clipped to `low .. high`.

        Student's t over two maps or more, widened for maps of a rare kind as
        `analysis.statistics.estimate.mean_estimate` is for rare events; where every map gave the same, the rule of
        three. For a single map: the noise of its rollouts, and it speaks of that map alone.
        """
        maps, shared = self.maps, float(self.shared[place])
        mean, scatter, lean = (float(values[place]) for values in (self.mean, self.scatter, self.lean))
        if maps == 0:
            raise ValueError("no maps to estimate from")
        if maps == 1:
            se = math.sqrt(self.within[place])
            half = Z95 * se
        else:
            squared, half = scatter / (maps - 1) / maps, 3.0 * (high - low) / maps
            if scatter > 0:
                rare = lean / scatter / maps
                half = float(stdtrit(maps - 1, 0.975)) * math.sqrt(squared + MISSED * rare**2)
            se = math.hypot(math.sqrt(squared), math.sqrt(shared))
            half = math.hypot(half, Z95 * math.sqrt(shared))
        return Estimate(mean, se, (max(mean - half, low), min(mean + half, high)))
