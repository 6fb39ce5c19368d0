"""Differences of two figures of the same rollouts: settings, plans, teams or maps on common luck.

Rollout r of both meets the same luck (SPEC sections 6 and 14), so their figures go together. Then the interval of their
difference is narrower than that of independent runs.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.control_variate import LEAST, controlled
from analysis.statistics.estimates import NONE_SEEN, Z95, Estimate, Sample, exactly

NEGLIGIBLE = 1e-12
"""A variance that is less than this share of what it is the difference of is none."""


@dataclass(frozen=True)
class Paired:
    """Sums over rollouts of two whole numbers, x and y: exact, so no figure depends on the order of adding.

    `xxy` is the sum of x * x * y, and so on; `differ` counts the rollouts in which x is not y.
    """

    rollouts: int = 0
    x: int = 0
    y: int = 0
    xx: int = 0
    xy: int = 0
    yy: int = 0
    xxx: int = 0
    xxy: int = 0
    xyy: int = 0
    yyy: int = 0
    differ: int = 0

    @staticmethod
    def of(x: ArrayLike, y: ArrayLike) -> Paired:
        """The sums over rollouts of whole numbers `[B]`, 0 or above."""
        one, other = np.asarray(x, dtype=np.int64), np.asarray(y, dtype=np.int64)
        differ = int((one != other).sum())
        largest = max(int(one.max(initial=0)), int(other.max(initial=0)))
        if largest**3 * len(one) >= 2**63:
            one, other = one.astype(object), other.astype(object)
        xx, yy = one * one, other * other
        sums = (one.sum(), other.sum(), xx.sum(), one @ other, yy.sum(), xx @ one, xx @ other, one @ yy, yy @ other)
        return Paired(len(one), *map(int, (*sums, differ)))

    def __add__(self, other: Paired) -> Paired:
        return Paired(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def moments(self) -> tuple[float, float, float]:
        """Sample variance of x, covariance, variance of y; NaN below two rollouts."""
        n = self.rollouts
        if n < 2:
            return math.nan, math.nan, math.nan
        spread = (n * self.xx - self.x**2, n * self.xy - self.x * self.y, n * self.yy - self.y**2)
        xx, xy, yy = (value / (n * (n - 1)) for value in spread)
        return xx, xy, yy

    def sample(self, of_x: float, of_y: float, step: float = 0.0) -> Sample:
        """Of `of_x * x + of_y * y`, two rollouts or more; `step`: what all its values are multiples of, 0 if nothing.

        How many lie on the thinner side of the mean is not kept: it is that of two values of the same skewness, and no
        more than the rollouts in which x is not y.
        """
        n, x, y = self.rollouts, self.x, self.y
        xx, xy, yy = self.moments()
        apart = of_x**2 * xx + of_y**2 * yy
        variance = apart + 2 * of_x * of_y * xy
        if variance <= NEGLIGIBLE * apart:
            return Sample(n, 0.0, 0.0, 0.0, step, few=False)
        cubes = (
            n * n * self.xxx - 3 * n * x * self.xx + 2 * x**3,
            n * n * self.xxy - n * y * self.xx - 2 * n * x * self.xy + 2 * x * x * y,
            n * n * self.xyy - n * x * self.yy - 2 * n * y * self.xy + 2 * x * y * y,
            n * n * self.yyy - 3 * n * y * self.yy + 2 * y**3,
        )
        weights = (of_x**3, 3 * of_x**2 * of_y, 3 * of_x * of_y**2, of_y**3)
        lean = sum(weight * (cube / n**2) for weight, cube in zip(weights, cubes, strict=True))
        skewness = lean / n / variance**1.5
        thin = n / 2 * (1 - abs(skewness) / math.sqrt(skewness**2 + 4))
        return Sample(n, variance * (n - 1), lean, min(thin, self.differ), step, few=False)


@dataclass(frozen=True)
class Difference:
    """A difference of two means on common random numbers.

    Attributes:
        estimate: mean of (y's unit * y - x's unit * x), its standard error and 95 % interval.
        gain: variance of the difference on independent runs / on these.
    """

    estimate: Estimate
    gain: float


class CommonLuck(NamedTuple):
    """The luck of both sides' rollouts by class of the total tolerance of so many `robots`: rollouts, sums of x, y.

    `[C]` each.
    """

    robots: int
    by_class: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]

    @classmethod
    def of(cls, robots: int, classes: NDArray[np.int64], x: NDArray[np.int64], y: NDArray[np.int64]) -> CommonLuck:
        """Of single rollouts, int64 `[B]` each; `classes`: as of `planner.rollouts.threshold_classes.luck_classes`."""
        sums = (np.bincount(classes, weights=column) for column in (x, y))
        return cls(robots, np.bincount(classes), *sums)


def difference(
    pairs: Paired, unit_x: float, unit_y: float, reach: float, certain: bool = False, luck: CommonLuck | None = None
) -> Difference:
    """E[y] - E[x], each in its unit, with the interval of `analysis.statistics.estimates.mean_estimate`.

    `reach`: how far it may range to either side. `certain`: every run of both is the same, so the interval is a point.
    `luck`: of the rollouts, by which the difference is put right (`analysis.statistics.control_variate`).
    """
    n = pairs.rollouts
    mean = pairs.y / n * unit_y - pairs.x / n * unit_x
    if certain:
        return Difference(exactly(mean), 1.0)
    if n < 2:
        return Difference(Estimate(mean, math.nan, (-reach, reach)), 1.0)
    xx, _, yy = pairs.moments()
    found = pairs.sample(-unit_x, unit_y, step=unit_x if unit_x == unit_y else 0.0)
    if luck is not None and n >= LEAST:
        put_right = controlled(luck.by_class, unit_y * luck.y - unit_x * luck.x, found, luck.robots)
        mean, found = min(max(put_right.mean, -reach), reach), put_right.sample
    apart = (xx * unit_x**2 + yy * unit_y**2) / n
    gain = 1.0 if apart == 0 else math.inf if found.scatter == 0 else apart / found.se**2
    return Difference(Estimate(mean, found.se, found.interval(mean, -reach, reach)), gain)


# One-way components of variance: how much of a scatter lies between groups (maps), and how much within them (luck).
#
# Rollouts fall on maps that are drawn independently, each alike, and know theirs. Then the sample variance of all of
# them
# is unbiased for the whole, and the pooled sample variance within maps for the part within, as no map is favoured;
# what is left is the part between, however unequal the numbers of rollouts are (Searle, Casella & McCulloch, Variance
# Components, 1992, section 3.6). Intervals: the jackknife over what was drawn independently, the rollouts, or the maps
# where each was given equally many (Efron & Stein, Annals of Statistics 1981: its variance is not too small on
# average).

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Components:
    """Standard deviations with their intervals, in the unit of the values.

    Attributes:
        between: of the groups' means, without the noise of their rollouts. within: of single values in a group.
        means: float64 `[groups]`, rising: the groups' means, drawn together so that they scatter by `between`.
    """

    between: Estimate
    within: Estimate
    means: Array


def of_values(group: ArrayLike, value: ArrayLike, reach: float) -> Components:
    """Of values `[B]` in groups `[B]` that were drawn for each; `reach`: how far values can lie apart."""
    value = np.asarray(value, dtype=np.float64)
    _, place, often = np.unique(np.asarray(group), return_inverse=True, return_counts=True)
    n, count = len(value), often[place]
    means = np.bincount(place, value) / often
    far, off = (value - value.mean()) ** 2, (value - means[place]) ** 2
    total, inside = float(far.sum()), float(off.sum())
    free = n - len(often)
    left_total = (total - n / (n - 1) * far) / (n - 2)
    shared = count > 1
    less = np.where(shared, count / np.maximum(count - 1, 1) * off, 0.0)
    left_inside = (inside - less) / np.maximum(free - shared, 1)
    whole, within = total / (n - 1), inside / free
    between = _root(whole - within, left_total - left_inside, n, reach)
    return Components(between, _root(within, left_inside, n, reach), _drawn_together(means, between.mean))


def of_means(means: Array, within: Array, each: int, reach: float) -> Components:
    """Of groups `[G]` drawn independently: their means of `each` values, and the sample variances of these."""
    groups = len(means)
    far, inside = (means - means.mean()) ** 2, float(within.mean())
    left_inside = (within.sum() - within) / (groups - 1)
    left_between = (far.sum() - groups / (groups - 1) * far) / (groups - 2) - left_inside / each
    variance = float(far.sum()) / (groups - 1) - inside / each
    between, luck = _root(variance, left_between, groups, reach), _root(inside, left_inside, groups, reach)
    return Components(between, luck, _drawn_together(means, between.mean))


def known_between(means: Array, all_of_them: bool, counts: NDArray[np.int64]) -> Components:
    """Of groups whose means `[G]` are exact, all that there are or some drawn independently.

    `counts`: int64 `[C + 1]`, a histogram of values 0, 1/C, ... 1 that fell on all groups: the scatter of everything.
    """
    groups, n, values = len(means), int(counts.sum()), np.linspace(0.0, 1.0, len(counts))
    far = (means - means.mean()) ** 2
    between = exactly(float(means.std()))
    if not all_of_them:
        left = (far.sum() - groups / (groups - 1) * far) / (groups - 2)
        between = _root(float(far.sum()) / (groups - 1), left, groups, 1.0)
    off = (values - counts @ values / n) ** 2
    whole = float(counts @ off) / max(n - 1, 1)
    error = math.sqrt(float(counts @ (off - whole) ** 2)) / n
    return Components(between, _deviation(whole - between.mean**2, error, n, 1.0), np.sort(means))


def _root(variance: float, left: Array, n: int, reach: float) -> Estimate:
    """A standard deviation from a variance, and its values with one of `n` draws left out, float64 `[n]`."""
    return _deviation(variance, math.sqrt((n - 1) / n * float(((left - left.mean()) ** 2).sum())), n, reach)


def _deviation(variance: float, error: float, n: int, reach: float) -> Estimate:
    """A standard deviation from a variance with its standard error of `n` draws.

    The upper half is longer, as on a scale of logarithms: a sample that met few of a long tail's values shows neither
    them nor how much they scatter. Where none of the draws made a difference: the rule of three, of what lies `reach`
    away.
    """
    half, mean = Z95 * error, math.sqrt(max(variance, 0.0))
    if error == 0:
        half = min(NONE_SEEN / n, 0.25) * reach**2
    lean = math.expm1(ratio) / ratio if (ratio := min(half / variance, 1.0) if variance > 0 else 1.0) else 1.0
    ends = (math.sqrt(max(variance - half, 0.0)), math.sqrt(max(variance + half * lean, 0.0)))
    return Estimate(mean, error / (2 * mean) if mean > 0 else math.nan, ends)


def _drawn_together(means: Array, deviation: float) -> Array:
    """Means that scatter by `deviation`, as the true ones do (Louis, JASA 1984), not by that and their noise."""
    spread = float(means.std())
    if spread == 0:
        return np.sort(means)
    return np.sort(means.mean() + (means - means.mean()) * min(deviation / spread, 1.0))
