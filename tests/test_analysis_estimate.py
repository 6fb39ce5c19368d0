"""Means, intervals and quantiles of histograms against SciPy and against their own promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from analysis.estimate import looks, mean_estimate, proportion, quantile
from planner.threefry import uniform


def test_mean_and_standard_error_are_scipy_s() -> None:
    counts = np.array([3, 0, 5, 7, 1])
    sample = np.repeat(np.arange(5), counts)
    known = mean_estimate(counts, 0.25)
    assert known.mean == pytest.approx(sample.mean() * 0.25)
    assert known.se == pytest.approx(stats.sem(sample) * 0.25)


def test_large_counts_stay_exact() -> None:
    counts = np.zeros(50_001, dtype=np.int64)
    counts[[49_999, 50_000]] = 2**31
    assert mean_estimate(counts, 1.0).mean == 49_999.5
    assert mean_estimate(counts, 1.0).se == pytest.approx(0.5 / np.sqrt(2.0**32), rel=1e-6)


def test_interval_does_not_collapse_without_variance() -> None:
    counts = np.array([0, 0, 4096])
    known = mean_estimate(counts, 0.5)
    assert (known.mean, known.se) == (1.0, 0.0)
    assert known.ci95 == (pytest.approx(1 - 3 / 4096), 1.0)
    assert known.half_width == pytest.approx(3 / 4096)


def test_interval_holds_as_often_as_it_says() -> None:
    """10,000 samples of 400 values: 95 % of the intervals hold the mean, within 5 standard errors."""
    repeats, n = 10_000, 400
    sample, draw = np.arange(repeats)[:, None], np.arange(n)[None]
    values = np.floor((uniform(5, sample, draw, 0) + uniform(5, sample, draw, 1)) * 50).astype(int)
    truth = 49.5  # 50 times the mean of two uniforms, less the half that rounding down takes
    intervals = [mean_estimate(np.bincount(row, minlength=100), 1.0).ci95 for row in values]
    held = np.mean([low <= truth <= high for low, high in intervals])
    assert abs(held - 0.95) <= 5 * np.sqrt(0.95 * 0.05 / repeats)


def test_quantiles_are_numpy_s_inverted_cdf() -> None:
    counts = np.array([0, 4, 0, 1, 5, 2])
    sample = np.repeat(np.arange(6), counts)
    for q in (0.05, 0.1, 1 / 3, 0.5, 0.83, 0.95, 1.0):
        assert quantile(counts, q) == np.quantile(sample, q, method="inverted_cdf")


def test_wilson_is_scipy_s() -> None:
    for successes, n in ((0, 50), (3, 50), (50, 50), (499, 1000)):
        known = stats.binomtest(successes, n).proportion_ci(method="wilson")
        assert proportion(successes, n).ci95 == pytest.approx((known.low, known.high))


def test_looks_double_from_one_block() -> None:
    assert looks()[:4] == [4096, 8192, 16384, 32768]
    assert looks()[-1] == 2**32
