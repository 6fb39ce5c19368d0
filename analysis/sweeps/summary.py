"""Means over maps, with intervals from the spread between maps.

A map's mean is one observation: the interval of the mean over maps is Student's t of the map means, so the noise of the
rollouts within each map is in it too. That noise is taken down by the rollouts' luck, which is known
(`analysis.statistics.pooled_control`). The share of the variance that comes from within says what is worth more of:
maps, or rollouts on each.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from analysis.statistics.differences import NEGLIGIBLE
from analysis.statistics.estimate import MISSED, Z95, Estimate
from analysis.statistics.pooled_control import BESIDE, weights_of


class Moments:
    """Map means of several figures beside their luck, added map by map; constant memory. Axes `F` figures, `L` BESIDE.

    Attributes:
        maps: how many. mean: of the map means, float64 `[F, L]`.
        scatter, lean: sums of the products of two and of three of their distances from it, `[F, L, L]`, `[F, L, L, L]`.
        within: sum of the covariances of the errors of the single map means, `[F, L, L]`.
        freedom: rollouts that tell what luck is worth, of each map one less.
        shared: squared standard error of the mean by luck that the maps share, which their spread does not show, `[F]`.
    """

    def __init__(self, figures: int, beside: int = BESIDE) -> None:
        """`beside`: L."""
        self.maps = self.freedom = 0
        self.mean, self.scatter, self.lean = (np.zeros((figures, *(beside,) * power)) for power in (1, 2, 3))
        self.within, self.shared = np.zeros_like(self.scatter), np.zeros(figures)

    def add(self, means: NDArray[np.float64], errors: NDArray[np.float64] | float, freedom: int = 0) -> None:
        """One more map: its means `[F, L]`, the covariances of their errors `[F, L, L]`, and its share of `freedom`."""
        self.maps += 1
        self.freedom += freedom
        step = means - self.mean
        share = step / self.maps
        grows = np.einsum("fa,fb->fab", step, share) * (self.maps - 1)
        turned = np.einsum("fa,fbc->fabc", share, self.scatter)
        self.mean += share
        self.lean += np.einsum("fa,fbc->fabc", share, grows) * (self.maps - 2)
        self.lean -= turned + turned.transpose(0, 2, 1, 3) + turned.transpose(0, 2, 3, 1)
        self.scatter += grows
        self.within += errors

    def weights(self, place: int) -> NDArray[np.float64]:
        """(1, -b) `[L]` of the figure at `place`; no control where maps share their luck."""
        return weights_of(self.within[place], 0 if self.shared.any() else self.freedom)

    def within_share(self, place: int) -> float | None:
        """Fraction of the variance of the map means that is noise of the rollouts within a map; None if unknown."""
        weights = self.weights(place)
        scatter, within = (float(weights @ of[place] @ weights) for of in (self.scatter, self.within))
        if self.maps < 2 or scatter <= 0:
            return None
        return min(1.0, within / self.maps / (scatter / (self.maps - 1)))

    def estimate(self, place: int, low: float, high: float, weights: NDArray[np.float64] | None = None) -> Estimate:
        """Mean over maps of the figure at `place`, its standard error and 95 % interval, clipped to `low .. high`.

        Student's t over two maps or more, widened for maps of a rare kind, by the figure with the control or without,
        as `analysis.statistics.estimate.mean_estimate` is for rare events; where every map gave the same, the rule of
        three. For a single map: the noise of its rollouts, and it speaks of that map alone. `weights`: in the place of
        the figure's own.
        """
        if self.maps == 0:
            raise ValueError("no maps to estimate from")
        maps, shared = self.maps, float(self.shared[place])
        by = self.weights(place) if weights is None else weights
        mean, terms = float(self.mean[place] @ by), self.scatter[place] * np.outer(by, by)
        scatter = 0.0 if terms.sum() <= NEGLIGIBLE * abs(terms).sum() else float(terms.sum())
        if maps == 1:
            se = math.sqrt(by @ self.within[place] @ by)
            half = Z95 * se
        else:
            squared, half = scatter / (maps - 1) / maps, 3.0 * (high - low) / maps
            if scatter > 0:
                rare = float(np.einsum("abc,a,b,c", self.lean[place], by, by, by)) / scatter / maps
                alone = self.lean[place, 0, 0, 0] / max(self.scatter[place, 0, 0], NEGLIGIBLE * scatter) / maps
                missed = MISSED * max(rare**2, alone**2)  # what luck explains does not make a rare map likelier seen
                half = float(stdtrit(maps - 1, 0.975)) * math.sqrt(squared + missed)
            se = math.hypot(math.sqrt(squared), math.sqrt(shared))
            half = math.hypot(half, Z95 * math.sqrt(shared))
        mean = min(max(mean, low), high)
        return Estimate(mean, se, (max(mean - half, low), min(mean + half, high)))
