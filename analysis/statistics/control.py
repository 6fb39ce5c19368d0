"""Two figures of the same rollouts: the open loop as a control variate of the closed one, and differences of settings.

Rollout r of two loops, plans or teams meets the same luck, u(r, t, i) (SPEC section 6), so their figures go together.
Then the interval of their difference is narrower than that of independent runs. And where the expected value of one is
known (the open loop's closed form), the other's can be corrected by how far the first happened to be off:
`mean(X) - w (mean(Y) - E[Y])` with `w = cov(X, Y) / var(Y)` has the variance of X times `1 - corr(X, Y)**2`
(Glasserman, Monte Carlo Methods in Financial Engineering, section 4.1). Its inverse is the *gain*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from analysis.statistics.estimate import Z95, Estimate


@dataclass(frozen=True)
class Paired:
    """Sums over rollouts of two whole numbers, x and y: exact, so no figure depends on the order of adding."""

    rollouts: int = 0
    x: int = 0
    y: int = 0
    xx: int = 0
    xy: int = 0
    yy: int = 0

    @staticmethod
    def of(x: ArrayLike, y: ArrayLike) -> Paired:
        """The sums over rollouts of whole numbers `[B]`, 0 or above."""
        one, other = np.asarray(x, dtype=np.int64), np.asarray(y, dtype=np.int64)
        largest = max(int(one.max(initial=0)), int(other.max(initial=0)))
        if largest**2 * len(one) >= 2**63:
            one, other = one.astype(object), other.astype(object)
        return Paired(len(one), int(one.sum()), int(other.sum()), int(one @ one), int(one @ other), int(other @ other))

    def __add__(self, other: Paired) -> Paired:
        mine, theirs = self._sums(), other._sums()
        return Paired(*(a + b for a, b in zip(mine, theirs, strict=True)))

    def _sums(self) -> tuple[int, ...]:
        return (self.rollouts, self.x, self.y, self.xx, self.xy, self.yy)

    def moments(self) -> tuple[float, float, float]:
        """Sample variance of x, covariance, variance of y; NaN below two rollouts."""
        n = self.rollouts
        if n < 2:
            return math.nan, math.nan, math.nan
        spread = (n * self.xx - self.x**2, n * self.xy - self.x * self.y, n * self.yy - self.y**2)
        xx, xy, yy = (value / (n * (n - 1)) for value in spread)
        return xx, xy, yy


@dataclass(frozen=True)
class Controlled:
    """An expected value estimated with a control variate.

    Attributes:
        estimate: in the unit asked for. weight: of the control. gain: variance without the control / with it.
    """

    estimate: Estimate
    weight: float
    gain: float


def controlled(pairs: Paired, known: float, most: int, unit: float) -> Controlled:
    """E[x], with y of known expectation as the control.

    Args:
        pairs: two rollouts or more. known: E[y]. most: x and y lie in 0 .. most. unit: what one of x is worth.

    The interval is `z se`, but at least what the rule of three gives for a residual of that range.
    """
    n = pairs.rollouts
    xx, xy, yy = pairs.moments()
    weight = xy / yy if yy > 0 else 0.0
    left = max(xx - weight * xy, 0.0)
    mean = pairs.x / n - weight * (pairs.y / n - known)
    se = math.sqrt(left / n)
    half = max(Z95 * se, 3.0 * most * (1.0 + abs(weight)) / n)
    ci95 = (max(mean - half, 0.0) * unit, min(mean + half, most) * unit)
    gain = 1.0 if xx == 0 else math.inf if left == 0 else xx / left
    return Controlled(Estimate(mean * unit, se * unit, ci95), weight, gain)


@dataclass(frozen=True)
class Difference:
    """A difference of two means on common random numbers.

    Attributes:
        estimate: mean of (y's unit * y - x's unit * x), its standard error and 95 % interval.
        gain: variance of the difference on independent runs / on these.
    """

    estimate: Estimate
    gain: float


def difference(pairs: Paired, unit_x: float, unit_y: float, reach: float) -> Difference:
    """E[y] - E[x], each in its unit, with the interval `max(z se, 3 reach / n)`; `reach`: how far it may range."""
    n = pairs.rollouts
    mean = pairs.y / n * unit_y - pairs.x / n * unit_x
    xx, xy, yy = pairs.moments()
    apart = xx * unit_x**2 + yy * unit_y**2
    together = max(apart - 2 * xy * unit_x * unit_y, 0.0)
    se = math.sqrt(together / n) if n > 1 else math.nan
    half = reach if n == 1 else max(Z95 * se, 3.0 * reach / n)
    gain = 1.0 if not apart > 0 else math.inf if together == 0 else apart / together
    return Difference(Estimate(mean, se, (mean - half, mean + half)), gain)
