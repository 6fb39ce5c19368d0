"""Means of rollouts, put right by how lucky the teams were: the control by total tolerance.

What a team covers goes with how much its robots bear together, S, and E[S] is known. So where the rollouts happened to
be luckier than they should, their mean is taken down by what that luck is worth: `mean(y) - b (mean(g(S)) - E[g(S)])`,
b by least squares (Glasserman, Monte Carlo Methods in Financial Engineering, section 4.1.2). g are the pieces of a
broken line with BENDS: coverage rises with S up to all there is and rises no more, which powers of S follow badly, and
the few largest S would weigh most. S goes in by classes (`planner.rollouts.threshold_classes`), of which the
expectation is that
of classes too: nothing is lost but the little that S says within its class.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincc, gammaincinv, ndtr

from analysis.statistics.estimates import FIRST_LOOK, RARE, Estimate, Sample, mean_estimate, proportion, sample_of
from planner.rollouts.threshold_classes import CLASSES_A_NAT, COLUMNS
from planner.tally import Outcome, Tally

LEAST = FIRST_LOOK
"""Rollouts below which intervals with the control are too narrow."""
BENDS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Where the line bends: at the quantiles of S that a bell has so many standard deviations from its mean."""
PIECES = 1 + len(BENDS)
HALVES = 2 * CLASSES_A_NAT
"""Half classes a nat: the middle of a class is a whole number of them."""
NOTHING_NEW = 1e-11
"""Share of the largest below which a spread is rounding: where no rollout lies beyond a bend, say."""


@dataclass(frozen=True)
class Controlled:
    """A mean with the control.

    Attributes:
        mean: of one figure. sample: what its interval follows from. weights: of a nat more of S, in each of PIECES.
        gain: variance of the mean without the control / with it.
    """

    mean: float
    sample: Sample
    weights: tuple[float, ...]
    gain: float


def controlled(by_class: NDArray[np.int64], sums: NDArray[np.float64], plain: Sample, robots: int) -> Controlled:
    """The mean of a figure of LEAST rollouts or more of which `sums` float64 `[C]` are known by class of S.

    `by_class`: int64 `[C]`, rollouts in each. `plain`: of the figure. `robots`: whose tolerances S holds.
    """
    held = np.flatnonzero(by_class)
    often, sums, n = by_class[held].astype(np.float64), sums[held], plain.n
    luck = pieces(held, robots) - expected_pieces(robots)
    off, mean = np.einsum("c,cp->p", often, luck) / n, float(sums.sum()) / n
    luck = luck - off
    inverse, rank = inverse_of(np.einsum("c,cp,cq->pq", often, luck, luck))
    along = np.einsum("c,cp->p", sums - mean * often, luck)
    slope = inverse @ along
    left = max(plain.scatter - float((slope * along).sum()), 0.0)
    left *= 1.0 + n * float(off @ inverse @ off)  # the slopes are not known exactly
    lean = plain.lean * (left / plain.scatter if plain.scatter > 0 else 0.0)  # so that rare events weigh as without
    sample = replace(plain, scatter=left, lean=lean, fitted=1 + rank)
    gain = 1.0 if plain.scatter == 0 else math.inf if left == 0 else (plain.se / sample.se) ** 2
    return Controlled(mean - float((slope * off).sum()), sample, tuple((HALVES * np.cumsum(slope)).tolist()), gain)


def pieces(classes: NDArray[np.int64], robots: int) -> NDArray[np.int64]:
    """`[C, PIECES]`, whole half classes: how far the class's middle is from the mean, and how far beyond each bend."""
    luck = 2 * classes + 1 - HALVES * robots
    return np.column_stack([luck, np.maximum(luck[:, None] - np.array(_bends(robots)), 0)])


@cache
def _bends(robots: int) -> tuple[int, ...]:
    """BENDS in half classes from the mean: S is a sum of so many Exp(1), a Gamma variable."""
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
    """The inverse of a symmetric matrix as far as it has one (Moore & Penrose's), and its rank."""
    values, axes = np.linalg.eigh(spread)
    kept = values > NOTHING_NEW * values[-1]
    return (axes[:, kept] / values[kept]) @ axes[:, kept].T, int(kept.sum())


def of_tally(tally: Tally, figure: str) -> Controlled | None:
    """The mean of "visited", "survived", "time", "alive" or "complete"; None without the sums, or of too few rollouts.

    Raises ValueError where nothing was rolled out.
    """
    by_luck = tally.by_luck.reshape(-1, len(COLUMNS))
    if tally.rollouts < LEAST or int(by_luck[:, 0].sum()) != tally.rollouts:
        return None
    counts = _complete(tally) if figure == "complete" else getattr(tally, figure)
    values = np.flatnonzero(counts)
    plain = sample_of(values, counts[values])
    return controlled(by_luck[:, 0], by_luck[:, COLUMNS.index(figure)].astype(np.float64), plain, tally.robots)


def tally_mean(
    tally: Tally, figure: str, unit: float = 1.0, most: int | None = None, certain: bool = False
) -> Estimate:
    """The mean of "visited", "survived", "time" or "alive", or robots "lost": with the control where the tally has it.

    `unit`, `most`, `certain`: as of `analysis.statistics.estimates.mean_estimate`, whose guards against what was not
    seen hold here too. Else it is that mean.
    """
    if figure == "lost":
        alive = tally_mean(tally, "alive", certain=certain)
        (low, high), robots = alive.ci95, tally.robots
        return Estimate((robots - alive.mean) * unit, alive.se * unit, ((robots - high) * unit, (robots - low) * unit))
    counts = getattr(tally, figure)
    found = None if certain else of_tally(tally, figure)
    if found is None:
        return mean_estimate(counts, unit, most, certain)
    return _estimate(found, len(counts) - 1 if most is None else most, unit)


def estimate_of(
    values: NDArray[np.int64], often: NDArray[np.int64], by_class: NDArray[np.int64], sums: NDArray[np.float64],
    robots: int, unit: float, most: int,
) -> Estimate:  # fmt: skip
    """As `analysis.statistics.estimates.mean_of`, with the control. `by_class`, `sums`, `robots`: as of
    `controlled`."""
    return _estimate(controlled(by_class, sums, sample_of(values, often), robots), most, unit)


def complete_chance(tally: Tally, certain: bool = False) -> Estimate:
    """The chance that every accessible cell is visited, with the control where the tally has it."""
    done = int(tally.outcomes[Outcome.COMPLETE])
    found = None if certain or min(done, tally.rollouts - done) <= RARE else of_tally(tally, "complete")
    return proportion(done, tally.rollouts, certain) if found is None else _estimate(found, 1, 1.0)


def _complete(tally: Tally) -> NDArray[np.int64]:
    done = int(tally.outcomes[Outcome.COMPLETE])
    return np.array([tally.rollouts - done, done])


def _estimate(found: Controlled, most: int, unit: float) -> Estimate:
    """`found` of values that lie in `0 .. most`."""
    mean = min(max(found.mean, 0.0), float(most))
    low, high = found.sample.interval(mean, 0.0, most)
    return Estimate(mean * unit, found.sample.se * unit, (low * unit, high * unit))


# The control by total tolerance where no map alone has the rollouts for it: slopes that all maps tell together.
#
# A figure stands *beside* its luck: axis `L` = (figure, pieces of its broken line by the total tolerance, less what is
# expected of them: `analysis.statistics.control_variate`). The mean of a map's rollouts is one such vector,
# with the covariance of its error. For any b, `figure - luck b` has the figure's mean; the b that leaves least of the
# rollouts' noise in a mean over maps follows from the sum of these covariances, as each map's own mean tells nothing of
# it (analysis of covariance: Cochran, Biometrics 1957). What a map's own rollouts add to b bends its mean by a share of
# 1 / all rollouts; and where all maps have other luck, the put-right means are a sample of one from each, so their
# interval is that of any means over maps.

BESIDE = 1 + PIECES
FIGURES = COLUMNS[1:]
TRIANGLE = np.triu_indices(PIECES)


def luck_sums(tally: Tally) -> list[int]:
    """Whole numbers that add: rollouts, sums of the pieces, of their products, and of each of FIGURES times each piece.

    Of a block of rollouts, so that int64 holds them. Empty without sums by luck.
    """
    by_luck = tally.by_luck.reshape(-1, len(COLUMNS))
    held = np.flatnonzero(by_luck[:, 0])
    if not len(held):
        return []
    often, luck = by_luck[held, 0], pieces(held, tally.robots)
    products, along = (often[:, None] * luck).T @ luck, by_luck[held, 1:].T @ luck
    return np.concatenate([[often.sum()], often @ luck, products[TRIANGLE], along.ravel()]).tolist()


def beside_luck(
    rollouts: int, figures: Sequence[tuple[int, int]], luck: Sequence[int], robots: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A map's means `[F, L]` of FIGURES and the covariances `[F, L, L]` of their errors.

    `figures`: sums over its rollouts and sums of squares, whole numbers. `luck`: of `luck_sums`; of other rollouts than
    these, or of a single one, it says nothing: zeros.
    """
    means, errors = np.zeros((len(figures), BESIDE)), np.zeros((len(figures), BESIDE, BESIDE))
    means[:, 0] = [total / rollouts for total, _ in figures]
    if rollouts == 1:
        return means, errors
    pairs = (rollouts - 1) * rollouts
    errors[:, 0, 0] = [(square * rollouts - total * total) / rollouts / pairs for total, square in figures]
    if not luck or luck[0] != rollouts:
        return means, errors
    sums, products, along = np.split(np.array(luck[1:], dtype=np.float64), [PIECES, PIECES + len(TRIANGLE[0])])
    spread, met = np.zeros((PIECES, PIECES)), sums / rollouts
    spread[TRIANGLE] = spread.T[TRIANGLE] = products
    means[:, 1:] = met - expected_pieces(robots)
    errors[:, 1:, 1:] = (spread - rollouts * np.outer(met, met)) / pairs
    errors[:, 0, 1:] = errors[:, 1:, 0] = (along.reshape(-1, PIECES) - means[:, :1] * rollouts * met) / pairs
    return means, errors


def weights_of(errors: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """`[L]`, (1, -b) of one figure: what its vectors are to be multiplied with; b = 0 where the rollouts are too few.

    `errors`: `[L, L]`, the sum of its maps' covariances. `freedom`: rollouts that tell of b, of each map one less.
    """
    weights = np.zeros(len(errors))
    weights[0] = 1.0
    if freedom >= LEAST and errors[1:, 1:].any():
        weights[1:] = -inverse_of(errors[1:, 1:])[0] @ errors[1:, 0]
    return weights


def put_right(
    means: NDArray[np.float64], errors: NDArray[np.float64], freedom: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A figure's means `[M]` on all maps without what their luck is worth, and their standard errors `[M]`.

    `means`, `errors`: `[M, L]`, `[M, L, L]`, of one figure of `beside_luck`. `freedom`: as of `weights_of`.
    """
    weights = weights_of(errors.sum(axis=0), freedom)
    return means @ weights, np.sqrt(np.maximum(weights @ errors @ weights, 0.0))
