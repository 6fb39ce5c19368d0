"""Smaller errors from as many rollouts: the control variate by total tolerance, and common random numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammainc, gammaincc, gammaincinv, ndtr

from analysis.statistics.estimates import (
    FIRST_LOOK,
    NONE_SEEN,
    RARE,
    Z95,
    Estimate,
    Sample,
    exactly,
    mean_estimate,
    proportion,
    sample_of,
)
from planner.rollouts.threshold_classes import CLASSES_A_NAT, COLUMNS
from planner.simulator.codes import Outcome
from planner.tally import Tally

# The control variate: the sum S of the team's failure thresholds.
#
# Coverage is correlated with S, and E[S] is known. The estimate is `mean(y) - b (mean(g(S)) - E[g(S)])` with b by least
# squares (Glasserman, Monte Carlo Methods in Financial Engineering, section 4.1.2). g is a piecewise linear function
# with knots at BENDS, because coverage rises with S and saturates; powers of S fit that badly and give the largest S
# too much weight. S is grouped into classes (`planner.rollouts.threshold_classes`), and E[g(S)] is computed for the
# same classes, so that grouping adds no bias.

LEAST = FIRST_LOOK
"""Fewest rollouts for which intervals with the control variate are valid."""
BENDS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Knots of g, as standard normal quantiles of the distribution of S."""
PIECES = 1 + len(BENDS)
HALVES = 2 * CLASSES_A_NAT
"""Half classes a nat: the midpoint of a class is a whole number of half classes."""
NOTHING_NEW = 1e-11
"""Ratio to the largest eigenvalue below which an eigenvalue is rounding error, as when no rollout passes a knot."""


@dataclass(frozen=True)
class Controlled:
    """A mean with the control variate.

    Attributes:
        mean: of one figure. sample: the statistics for its interval. weights: slope by S in each of PIECES, a nat.
        gain: variance of the mean without the control variate / with it.
    """

    mean: float
    sample: Sample
    weights: tuple[float, ...]
    gain: float


def controlled(by_class: NDArray[np.int64], sums: NDArray[np.float64], plain: Sample, robots: int) -> Controlled:
    """The mean of a figure with the control variate, from at least LEAST rollouts.

    Args:
        by_class: int64 `[C]`, rollouts in each class of S. sums: float64 `[C]`, sum of the figure in each class.
        plain: the figure's sample without the control variate. robots: number of thresholds in S.

    Source: Glasserman, section 4.1.2.
    """
    held = np.flatnonzero(by_class)
    often, sums, n = by_class[held].astype(np.float64), sums[held], plain.n
    controls = pieces(held, robots) - expected_pieces(robots)
    off, mean = np.einsum("c,cp->p", often, controls) / n, float(sums.sum()) / n
    controls = controls - off
    inverse, rank = inverse_of(np.einsum("c,cp,cq->pq", often, controls, controls))
    along = np.einsum("c,cp->p", sums - mean * often, controls)
    slope = inverse @ along
    left = max(plain.scatter - float((slope * along).sum()), 0.0)
    left *= 1.0 + n * float(off @ inverse @ off)  # variance of the estimated slopes
    lean = plain.lean * (left / plain.scatter if plain.scatter > 0 else 0.0)  # keeps the skewness of the plain sample
    sample = replace(plain, scatter=left, lean=lean, fitted=1 + rank)
    gain = 1.0 if plain.scatter == 0 else math.inf if left == 0 else (plain.se / sample.se) ** 2
    return Controlled(mean - float((slope * off).sum()), sample, tuple((HALVES * np.cumsum(slope)).tolist()), gain)


def pieces(classes: NDArray[np.int64], robots: int) -> NDArray[np.int64]:
    """`[C, PIECES]`, in half classes: distance of the class's midpoint from E[S], and from each knot that it passes."""
    controls = 2 * classes + 1 - HALVES * robots
    return np.column_stack([controls, np.maximum(controls[:, None] - np.array(_bends(robots)), 0)])


@cache
def _bends(robots: int) -> tuple[int, ...]:
    """BENDS in half classes from the mean. S is a sum of `robots` Exp(1) variables, hence Gamma."""
    return tuple(round(HALVES * (quantile - robots)) for quantile in gammaincinv(robots, ndtr(BENDS)).tolist())


@cache
def expected_pieces(robots: int) -> NDArray[np.float64]:
    """E of `pieces`, `[PIECES]`."""
    classes = np.arange(math.ceil(CLASSES_A_NAT * (robots + 12 * math.sqrt(robots) + 40)))
    edges = np.arange(len(classes) + 1) / CLASSES_A_NAT
    below, above = gammainc(robots, edges), gammaincc(robots, edges)
    chance = np.where(edges[1:] < robots, np.diff(below), -np.diff(above))
    return np.einsum("c,cp->p", chance, pieces(classes, robots))


def inverse_of(spread: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """The Moore-Penrose inverse of a symmetric matrix, and its rank."""
    values, axes = np.linalg.eigh(spread)
    kept = values > NOTHING_NEW * values[-1]
    return (axes[:, kept] / values[kept]) @ axes[:, kept].T, int(kept.sum())


def of_tally(tally: Tally, figure: str) -> Controlled | None:
    """The mean of "visited", "survived", "time", "alive" or "complete" with the control variate.

    Returns None if the tally lacks the sums by class or has fewer than LEAST rollouts. Raises ValueError for an empty
    tally.
    """
    by_threshold = tally.by_threshold.reshape(-1, len(COLUMNS))
    if tally.rollouts < LEAST or int(by_threshold[:, 0].sum()) != tally.rollouts:
        return None
    counts = _complete(tally) if figure == "complete" else getattr(tally, figure)
    values = np.flatnonzero(counts)
    plain = sample_of(values, counts[values])
    return controlled(
        by_threshold[:, 0], by_threshold[:, COLUMNS.index(figure)].astype(np.float64), plain, tally.robots
    )


def tally_mean(
    tally: Tally, figure: str, unit: float = 1.0, most: int | None = None, certain: bool = False
) -> Estimate:
    """The mean of "visited", "survived", "delivered", "time", "alive" or "lost", by the control variate if possible.

    `unit`, `most`, `certain`: as in `analysis.statistics.estimates.mean_estimate`, which is used otherwise. Its guards
    against unseen values hold here too.
    """
    if figure == "lost":
        alive = tally_mean(tally, "alive", certain=certain)
        (low, high), robots = alive.ci95, tally.robots
        return Estimate((robots - alive.mean) * unit, alive.se * unit, ((robots - high) * unit, (robots - low) * unit))
    counts = getattr(tally, figure)
    found = None if certain or figure not in FIGURES else of_tally(tally, figure)
    if found is None:
        return mean_estimate(counts, unit, most, certain)
    return _estimate(found, len(counts) - 1 if most is None else most, unit)


def estimate_of(
    values: NDArray[np.int64], often: NDArray[np.int64], by_class: NDArray[np.int64], sums: NDArray[np.float64],
    robots: int, unit: float, most: int,
) -> Estimate:  # fmt: skip
    """`analysis.statistics.estimates.mean_of` with the control variate; arguments as in `controlled`."""
    return _estimate(controlled(by_class, sums, sample_of(values, often), robots), most, unit)


def complete_chance(tally: Tally, certain: bool = False) -> Estimate:
    """The probability that every accessible cell is visited, with the control variate if the tally allows it."""
    done = int(tally.outcomes[Outcome.COMPLETE])
    found = None if certain or min(done, tally.rollouts - done) <= RARE else of_tally(tally, "complete")
    return proportion(done, tally.rollouts, certain) if found is None else _estimate(found, 1, 1.0)


def _complete(tally: Tally) -> NDArray[np.int64]:
    done = int(tally.outcomes[Outcome.COMPLETE])
    return np.array([tally.rollouts - done, done])


def _estimate(found: Controlled, most: int, unit: float) -> Estimate:
    """The estimate of a mean of values in `0 .. most`."""
    mean = min(max(found.mean, 0.0), float(most))
    low, high = found.sample.interval(mean, 0.0, most)
    return Estimate(mean * unit, found.sample.se * unit, (low * unit, high * unit))


# The control variate over many maps, where no single map has enough rollouts: slopes pooled over the maps.
#
# A figure is kept with its controls in one vector, axis `L` = (figure, the pieces of g(S) less their expectations). The
# mean over a map's rollouts is one such vector, with the covariance of its error. For any b, `figure - b controls` has
# the figure's mean. The b that minimises the rollouts' noise in a mean over maps follows from the sum of the
# covariances (analysis of covariance: Cochran, Biometrics 1957). A map's own rollouts bias its mean through b by a
# share of 1 / all rollouts. Where the maps have independent random numbers, the controlled means are a sample of one
# from each map, and their interval is that of any mean over maps.

TERMS = 1 + PIECES
FIGURES = COLUMNS[1:]
TRIANGLE = np.triu_indices(PIECES)


def control_sums(tally: Tally) -> list[int]:
    """Additive integer sums: rollouts, the pieces, their products, and each of FIGURES times each piece.

    They fit int64 for one block of rollouts. Empty if the tally lacks the sums by class.
    """
    by_threshold = tally.by_threshold.reshape(-1, len(COLUMNS))
    held = np.flatnonzero(by_threshold[:, 0])
    if not len(held):
        return []
    often, controls = by_threshold[held, 0], pieces(held, tally.robots)
    products, along = (often[:, None] * controls).T @ controls, by_threshold[held, 1:].T @ controls
    return np.concatenate([[often.sum()], often @ controls, products[TRIANGLE], along.ravel()]).tolist()


def with_controls(
    rollouts: int, figures: Sequence[tuple[int, int]], controls: Sequence[int], robots: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A map's means `[F, L]` of FIGURES and the covariances `[F, L, L]` of their errors.

    `figures`: (sum, sum of squares) over the map's rollouts, integers. `controls`: from `control_sums`. They are 0
    for a
    single rollout, and if `controls` covers other rollouts.
    """
    means, errors = np.zeros((len(figures), TERMS)), np.zeros((len(figures), TERMS, TERMS))
    means[:, 0] = [total / rollouts for total, _ in figures]
    if rollouts == 1:
        return means, errors
    pairs = (rollouts - 1) * rollouts
    errors[:, 0, 0] = [(square * rollouts - total * total) / rollouts / pairs for total, square in figures]
    if not controls or controls[0] != rollouts:
        return means, errors
    sums, products, along = np.split(np.array(controls[1:], dtype=np.float64), [PIECES, PIECES + len(TRIANGLE[0])])
    spread, met = np.zeros((PIECES, PIECES)), sums / rollouts
    spread[TRIANGLE] = spread.T[TRIANGLE] = products
    means[:, 1:] = met - expected_pieces(robots)
    errors[:, 1:, 1:] = (spread - rollouts * np.outer(met, met)) / pairs
    errors[:, 0, 1:] = errors[:, 1:, 0] = (along.reshape(-1, PIECES) - means[:, :1] * rollouts * met) / pairs
    return means, errors


def weights_of(errors: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """The weights (1, -b), `[L]`, of one figure's vectors; b = 0 for too few rollouts.

    `errors`: `[L, L]`, sum of the maps' covariances. `freedom`: degrees of freedom of b, rollouts less one a map.
    """
    weights = np.zeros(len(errors))
    weights[0] = 1.0
    if freedom >= LEAST and errors[1:, 1:].any():
        weights[1:] = -inverse_of(errors[1:, 1:])[0] @ errors[1:, 0]
    return weights


def controlled_means(
    means: NDArray[np.float64], errors: NDArray[np.float64], freedom: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A figure's controlled means `[M]` on all maps, and their standard errors `[M]`.

    `means`, `errors`: `[M, L]` and `[M, L, L]` of one figure, from `with_controls`. `freedom`: as in `weights_of`.
    """
    weights = weights_of(errors.sum(axis=0), freedom)
    return means @ weights, np.sqrt(np.maximum(weights @ errors @ weights, 0.0))


# Differences of two figures on common random numbers: settings, plans, teams or maps.
#
# Rollout r of both has the same failure thresholds (SPEC sections 6 and 14), so their figures are correlated, and the
# interval of the difference is narrower than for independent runs.

NEGLIGIBLE = 1e-12
"""Ratio to the sum of two variances below which the variance of the difference is rounding error."""


@dataclass(frozen=True)
class Paired:
    """Sums over rollouts of two integers, x and y. They are exact, so that no result depends on the order of adding.

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
        """The sums over rollouts of non-negative integers `[B]`."""
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
        """The sample of `of_x * x + of_y * y`, from at least two rollouts; `step`: the lattice of its values, or 0.

        The number of values on the thinner side of the mean is not kept. It is taken from a two-point distribution of
        the same skewness, and is at most the number of rollouts in which x and y differ.
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
        gain: variance of the difference of independent runs / of these.
    """

    estimate: Estimate
    gain: float
    json_keys = "*estimate gain"


class CommonThresholds(NamedTuple):
    """Rollouts and sums of x and y by class of the sum of the thresholds of `robots`, `[C]` each."""

    robots: int
    by_class: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]

    @classmethod
    def of(
        cls, robots: int, classes: NDArray[np.int64], x: NDArray[np.int64], y: NDArray[np.int64]
    ) -> CommonThresholds:
        """From single rollouts, int64 `[B]` each; `classes`: from
        `planner.rollouts.threshold_classes.classes_by_threshold`."""
        sums = (np.bincount(classes, weights=column) for column in (x, y))
        return cls(robots, np.bincount(classes), *sums)


def difference(
    pairs: Paired,
    unit_x: float,
    unit_y: float,
    reach: float,
    certain: bool = False,
    controls: CommonThresholds | None = None,
) -> Difference:
    """E[y] - E[x], each in its unit, with the interval of `analysis.statistics.estimates.mean_estimate`.

    `reach`: the largest absolute difference. `certain`: all runs of each side are equal, so that the interval is a
    point. `controls`: the rollouts by class of S, for the control variate.
    """
    n = pairs.rollouts
    mean = pairs.y / n * unit_y - pairs.x / n * unit_x
    if certain:
        return Difference(exactly(mean), 1.0)
    if n < 2:
        return Difference(Estimate(mean, math.nan, (-reach, reach)), 1.0)
    xx, _, yy = pairs.moments()
    found = pairs.sample(-unit_x, unit_y, step=unit_x if unit_x == unit_y else 0.0)
    if controls is not None and n >= LEAST:
        adjusted = controlled(controls.by_class, unit_y * controls.y - unit_x * controls.x, found, controls.robots)
        mean, found = min(max(adjusted.mean, -reach), reach), adjusted.sample
    apart = (xx * unit_x**2 + yy * unit_y**2) / n
    gain = 1.0 if apart == 0 else math.inf if found.scatter == 0 else apart / found.se**2
    return Difference(Estimate(mean, found.se, found.interval(mean, -reach, reach)), gain)


# One-way components of variance: between groups (maps) and within groups (rollouts on one map).
#
# Every rollout has a map that is drawn independently from one distribution. The sample variance of all rollouts is
# unbiased for the total, and the pooled sample variance within maps for the part within. Their difference estimates the
# part between, also for unequal numbers of rollouts (Searle, Casella & McCulloch, Variance Components, 1992, section
# 3.6). Intervals are by the jackknife over the independent draws: the rollouts, or the maps where each has equally many
# rollouts (Efron & Stein, Annals of Statistics 1981: its variance is not too small on average).

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Components:
    """Standard deviations with their intervals, in the unit of the values.

    Attributes:
        between: of the groups' true means. within: of single values in a group.
        means: float64 `[groups]`, sorted: the groups' means, shrunk so that their standard deviation is `between`.
    """

    between: Estimate
    within: Estimate
    means: Array


def of_values(group: ArrayLike, value: ArrayLike, reach: float) -> Components:
    """Components of values `[B]` whose groups `[B]` were drawn independently; `reach`: the largest difference."""
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
    """Components from the means `[G]` of `each` values and their sample variances `[G]`, groups drawn independently."""
    groups = len(means)
    far, inside = (means - means.mean()) ** 2, float(within.mean())
    left_inside = (within.sum() - within) / (groups - 1)
    left_between = (far.sum() - groups / (groups - 1) * far) / (groups - 2) - left_inside / each
    variance = float(far.sum()) / (groups - 1) - inside / each
    between, within_sd = _root(variance, left_between, groups, reach), _root(inside, left_inside, groups, reach)
    return Components(between, within_sd, _drawn_together(means, between.mean))


def known_between(means: Array, all_of_them: bool, counts: NDArray[np.int64]) -> Components:
    """Components from exact means `[G]` of all groups, or of some that were drawn independently.

    `counts`: int64 `[C + 1]`, histogram of the values 0, 1/C, ... 1 over all groups, for the total variance.
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
    """A standard deviation from a variance and its jackknife values, float64 `[n]`."""
    return _deviation(variance, math.sqrt((n - 1) / n * float(((left - left.mean()) ** 2).sum())), n, reach)


def _deviation(variance: float, error: float, n: int, reach: float) -> Estimate:
    """A standard deviation from a variance with its standard error from `n` draws.

    The upper half of the interval is longer, as on a logarithmic scale, because a sample with few values from a long
    tail underestimates both the tail and its variance. Where no draw differs, the rule of three applies to a value
    that is `reach` away.
    """
    half, mean = Z95 * error, math.sqrt(max(variance, 0.0))
    if error == 0:
        half = min(NONE_SEEN / n, 0.25) * reach**2
    lean = math.expm1(ratio) / ratio if (ratio := min(half / variance, 1.0) if variance > 0 else 1.0) else 1.0
    ends = (math.sqrt(max(variance - half, 0.0)), math.sqrt(max(variance + half * lean, 0.0)))
    return Estimate(mean, error / (2 * mean) if mean > 0 else math.nan, ends)


def _drawn_together(means: Array, deviation: float) -> Array:
    """The means shrunk towards their mean to the standard deviation `deviation` (Louis, JASA 1984)."""
    spread = float(means.std())
    if spread == 0:
        return np.sort(means)
    return np.sort(means.mean() + (means - means.mean()) * min(deviation / spread, 1.0))
