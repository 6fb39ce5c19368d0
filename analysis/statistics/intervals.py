"""Intervals that hold together, for any number of rollouts looked at: means and chances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import betaincinv

ALPHA = 0.05
"""Chance that any of the verdicts of one search is wrong, at most."""
ROUNDING = 1e-9
"""What is short of a threshold by less than this reaches it: exact values are sums of many roundings."""


def is_at_least(interval: tuple[float, float], wanted: float, slack: float = ROUNDING) -> bool | None:
    """Whether what lies in the interval is `wanted` or more, to `slack`; None: that depends on where it lies."""
    low, high = interval
    return True if low >= wanted - slack else False if high < wanted - slack else None


def share_of_doubt(teams: int, looks: int) -> float:
    """The chance of error of a single look at a single team: ALPHA shared by Bonferroni among all that may be taken.

    Every team that the search may look at is looked at up to `looks` times, and the search goes where the verdicts
    lead it; the union bound over all `teams * looks` of them holds whatever the order and the stopping.
    """
    return ALPHA / (teams * looks)


def mean_interval(counts: NDArray[np.int64], alpha: float) -> tuple[float, float]:
    """An interval that misses the mean of `0, 1, ..., len(counts) - 1` drawn as `counts` with chance <= `alpha`.

    The empirical Bernstein bound of Maurer & Pontil (COLT 2009, Theorem 4), alpha/2 for each end:
    `mean +- (sqrt(2 V L / n) + 7 range L / (3 (n - 1)))`, `L = ln(4 / alpha)`, V the sample variance. It holds for
    every n and every distribution, where a normal interval so far out in the tail would rest on the sample's shape.
    """
    n, most = int(counts.sum()), len(counts) - 1
    if n < 2:
        return 0.0, float(most)
    values = np.arange(most + 1)
    mean = int(counts @ values) / n
    variance = float(counts @ (values - mean) ** 2) / (n - 1)
    weight = np.log(4.0 / alpha)
    half = float(np.sqrt(2.0 * variance * weight / n) + 7.0 * most * weight / (3.0 * (n - 1)))
    return max(mean - half, 0.0), min(mean + half, float(most))


def chance_interval(successes: int, n: int, alpha: float) -> tuple[float, float]:
    """The exact binomial interval of Clopper & Pearson: it misses the probability with chance <= `alpha`, for every n.

    Wilson's, which the tables show of chances far from 0 and 1, is the closer one at 95 %, but covers less than it says
    far out in the tails.
    """
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, alpha / 2))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - alpha / 2))
    return low, high


BETS = np.array([0.99, 0.9, 0.75, *(0.5 ** np.arange(1.0, 12.0))])
"""Shares of what one has that may be lost on a value in `bet_interval`, float64 `[14]`."""


def bet_interval(values: NDArray[np.float64], alpha: float) -> tuple[float, float]:
    """An interval for the mean of `values` `[n]` in -1 .. 1 that misses it with chance <= `alpha`, whenever one looks.

    The mean may lie above m unless somebody who bets that it does grows rich: who holds 1 and puts the share b of it on
    every value has `prod (1 - b + b (1 + x) / (1 + m))`, a supermartingale if the mean is m or below, which ever comes
    to 2 / alpha with chance <= alpha / 2 (Ville's inequality), for any distribution. So does the mean over BETS. The
    interval holds what is refuted from neither side (Waudby-Smith & Ramdas, "Estimating means of bounded random
    variables by betting", JRSS B 2024). Below a thousand values that scatter little, an empirical Bernstein bound is
    many times as wide.
    """
    enough = np.log(2.0 / alpha) + np.log(len(BETS))
    different, times = np.unique(values, return_counts=True)  # shares of cells: few of many

    def least(values: NDArray[np.float64]) -> float:
        def rich(mean: float) -> float:
            fortune = np.log1p(BETS[:, None] * ((1.0 + values) / (1.0 + mean) - 1.0)) @ times
            return float(np.logaddexp.reduce(fortune) - enough)

        mean, lowest = float(values @ times / times.sum()), -1.0 + 1e-9
        return -1.0 if mean <= lowest or rich(lowest) <= 0 else float(brentq(rich, lowest, mean))

    return least(different), -least(-different)
