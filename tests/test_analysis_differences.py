"""Differences on common luck: exact sums, and intervals that hold as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from rolling import uniform
from scipy import stats

from analysis.statistics.differences import Paired, difference


def draws(rollouts: int) -> tuple[np.ndarray, np.ndarray]:
    """Two whole numbers 0 .. 40 a rollout that share half of their luck."""
    ids = np.arange(rollouts)
    own, other, shared = (uniform(3, ids, 0, robot) for robot in range(3))
    return (20 * (own + shared)).astype(int), (20 * (other + shared)).astype(int)


def test_sums_are_those_of_the_rollouts_however_they_are_added() -> None:
    x, y = draws(1000)
    whole = Paired.of(x, y)
    assert whole == Paired.of(x[:1], y[:1]) + Paired() + Paired.of(x[1:], y[1:])
    assert whole.moments() == pytest.approx((np.var(x, ddof=1), np.cov(x, y)[0, 1], np.var(y, ddof=1)), rel=1e-12)
    for large, small in ((2**31 - 1, 2**31 - 1), (2**31 - 1, 0), (3, 2**40), (2**20, 1)):  # beyond 64 bits, or just
        found = Paired.of(np.full(8, large), np.full(8, small))
        assert (found.xxx, found.xyy, found.yyy) == (8 * large**3, 8 * large * small**2, 8 * small**3)


def test_the_sums_know_the_third_moment_of_every_combination() -> None:
    x, y = draws(1000)
    apart = 2.0 * y - 0.5 * x
    sample = Paired.of(x, y).sample(-0.5, 2.0)
    assert sample.scatter == pytest.approx(((apart - apart.mean()) ** 2).sum())
    assert sample.lean == pytest.approx(((apart - apart.mean()) ** 3).sum(), rel=1e-6)
    assert Paired.of(x, x).sample(-1.0, 1.0).scatter == 0


def test_a_difference_seen_in_few_rollouts_holds_as_often_as_it_says() -> None:
    """0.1 .. 100 expected rollouts of 4096 in which a plan covers 30 cells more: summed over every sample there is."""
    n, x = 4096, np.full(4096, 100)
    events = np.arange(180)
    found = [difference(Paired.of(x, x + 30 * (np.arange(n) < k)), 1.0, 1.0, 200.0).estimate.ci95 for k in events]
    low, high = np.array(found).T / 30
    for expected in np.geomspace(0.1, 100, 60):
        chance = stats.binom.pmf(events, n, expected / n)
        assert chance[(low <= expected / n) & (expected / n <= high)].sum() >= 0.944


def test_a_difference_is_that_of_the_rollouts() -> None:
    x, y = draws(1000)
    found = difference(Paired.of(x, y), 0.5, 2.0, 80.0)
    apart = 2.0 * y - 0.5 * x
    assert found.estimate.mean == pytest.approx(apart.mean())
    assert found.estimate.se == pytest.approx(apart.std(ddof=1) / np.sqrt(1000))
    unseen = 40.0 * -np.log(0.025) / 1000  # no rollout differed: the rule of three
    assert difference(Paired.of(x, x), 1.0, 1.0, 40.0).estimate.ci95 == pytest.approx((-unseen, unseen))


def test_the_interval_of_a_difference_holds_as_often_as_it_says() -> None:
    """10,000 samples of 400: within 3 standard errors."""
    repeats, n = 10_000, 400
    ids, at = np.arange(repeats)[:, None], np.arange(n)[None]
    own, other, shared = (uniform(11, ids, at, robot) for robot in range(3))
    xs, ys = (20 * (own + shared)).astype(int), (30 * (other + shared)).astype(int)
    apart, held = 29.5 - 19.5, 0  # the uniforms' means, less the half that rounding down takes
    for x, y in zip(xs, ys, strict=True):
        low, high = difference(Paired.of(x, y), 1.0, 1.0, 59.0).estimate.ci95
        held += low <= apart <= high
    assert abs(held / repeats - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / repeats)
