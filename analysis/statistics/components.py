"""One-way components of variance: how much of a scatter lies between groups (maps), and how much within them (luck).

Rollouts fall on maps that are drawn independently, each alike, and know theirs. Then the sample variance of all of them
is unbiased for the whole, and the pooled sample variance within maps for the part within, as no map is favoured;
what is left is the part between, however unequal the numbers of rollouts are (Searle, Casella & McCulloch, Variance
Components, 1992, section 3.6). Intervals: the jackknife over what was drawn independently, the rollouts, or the maps
where each was given equally many (Efron & Stein, Annals of Statistics 1981: its variance is not too small on average).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.estimate import NONE_SEEN, Z95, Estimate, exactly

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
