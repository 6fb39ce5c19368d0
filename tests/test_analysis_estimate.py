"""Means, intervals and quantiles of histograms against SciPy and against their own promise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy import stats

from analysis.evaluation.evaluate import half_width, until_enough
from analysis.sampling import RollOut, RolloutChoices, Stage, make_roll_out
from analysis.statistics.control import controlled
from analysis.statistics.estimate import looks, mean_estimate, proportion, quantile
from analysis.theory.enumeration import closed_loop_exact
from analysis.theory.exact import open_loop_exact
from planner.mrac.make_plan import make_plan
from planner.threefry import uniform
from planner.worlds.world import World


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


@pytest.mark.parametrize("n", [400, 4096])
def test_intervals_of_rare_events_hold_as_often_as_they_say(n: int) -> None:
    """All or nothing with n p = 0.1 .. 100 expected events: summed over every sample there is, without sampling."""
    events = np.arange(n + 1)
    intervals = np.array([mean_estimate(np.array([n - count, count]), 1.0).ci95 for count in events])
    expected = np.geomspace(0.1, 100, 300)
    held = [stats.binom.pmf(events, n, p)[(intervals[:, 0] <= p) & (p <= intervals[:, 1])].sum() for p in expected / n]
    assert min(held) > 0.94
    assert np.mean([chance for chance, count in zip(held, expected, strict=True) if count > 20]) < 0.955


def stops(loop: Literal["open", "closed"], control: bool, repeats: int) -> tuple[float, set[int], float]:
    """(how often the interval held the exact value, numbers of rollouts at which runs stopped, its standard error)."""
    threat = np.zeros((4, 5))
    threat[1:3, 1:4], threat[3, 4] = 0.15, 0.3
    world = World.create(threat)
    plan = make_plan(world, [[0, 0], [0, 4]])
    exact = open_loop_exact(plan, world)
    truth = exact.visited / 20 if loop == "open" else closed_loop_exact(plan, world).visited.middle / 20
    choices = RolloutChoices(loop=loop, control=control, rollouts=4096)
    roll_out = make_roll_out(world, plan, choices)
    precision = float(np.median([half_width(s, exact) for s in first_stages(roll_out, choices, 101)]))
    choices, held, lengths = replace(choices, precision=precision), 0, set()
    for seed in range(1000, 1000 + repeats):
        for stage in until_enough(roll_out(replace(choices, seed=seed), None), choices, exact, None):
            last = stage
        pairs, cells = last.pairs, last.tally.accessible
        estimate = mean_estimate(last.tally.visited, 1.0 / cells)
        if pairs is not None:
            estimate = controlled(pairs[0], exact.visited, cells, 1.0 / cells).estimate
        held += estimate.ci95[0] <= truth <= estimate.ci95[1]
        lengths.add(last.tally.rollouts)
    return held / repeats, lengths, np.sqrt(0.95 * 0.05 / repeats)


def first_stages(roll_out: RollOut, choices: RolloutChoices, count: int) -> Iterator[Stage]:
    for seed in range(count):
        yield from roll_out(replace(choices, seed=seed), None)


@pytest.mark.parametrize(
    ("loop", "control", "repeats"),
    [
        ("open", False, 2_000),
        pytest.param("open", False, 10_000, marks=pytest.mark.slow),
        pytest.param("closed", False, 10_000, marks=pytest.mark.slow),
        pytest.param("closed", True, 10_000, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_where_precision_decides_when_to_stop(loop, control: bool, repeats: int) -> None:
    """About half of the runs stop at the first look, when their interval happens to be narrow enough."""
    held, lengths, se = stops(loop, control, repeats)
    assert lengths == {4096, 8192}
    assert abs(held - 0.95) <= 5 * se


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
