"""Means, intervals and quantiles of histograms against SciPy and against their own promise."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Literal

import numpy as np
import pytest
from oracle_tree import closed_loop_exact
from rolling import uniform
from samples import samples
from scipy import stats

import mrac_jax as mrac
from analysis.evaluation.evaluate import half_width, until_enough
from analysis.evaluation.figures import Coverage, Covered
from analysis.sampling import RolloutChoices, Stage, make_engine_for, make_roll_out
from analysis.statistics.control_variate import tally_mean
from analysis.statistics.estimates import (
    FEW,
    FIRST_LOOK,
    Z95,
    Estimate,
    assured,
    looks,
    mean_estimate,
    proportion,
    quantile,
    quantiles,
)
from analysis.theory.exact import open_loop_exact
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.world.world import World


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
    chance = -np.log(0.025) / 4096  # of what was not seen in 4096 rollouts, at 97.5 %
    assert known.ci95 == (pytest.approx(1 - chance), 1.0)
    assert known.half_width == pytest.approx(chance)


def test_interval_holds_as_often_as_it_says() -> None:
    """10,000 samples of 400 values: 95 % of the intervals hold the mean, within 3 standard errors."""
    repeats, n = 10_000, 400
    sample, draw = np.arange(repeats)[:, None], np.arange(n)[None]
    values = np.floor((uniform(5, sample, draw, 0) + uniform(5, sample, draw, 1)) * 50).astype(int)
    truth = 49.5  # 50 times the mean of two uniforms, less the half that rounding down takes
    intervals = [mean_estimate(np.bincount(row, minlength=100), 1.0).ci95 for row in values]
    held = np.mean([low <= truth <= high for low, high in intervals])
    assert abs(held - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / repeats)


def held_by(samples: np.ndarray, truth: float) -> tuple[np.ndarray, np.ndarray]:
    """(whether each histogram's interval holds `truth`, its half-width over 1.96 standard errors), `[samples]`."""
    found = [mean_estimate(counts, 1.0) for counts in samples]
    held = np.array([e.ci95[0] - 1e-9 <= truth <= e.ci95[1] + 1e-9 for e in found])
    return held, np.array([e.half_width / (Z95 * e.se) if e.se > 0 else np.inf for e in found])


@pytest.mark.parametrize("n", [5, 20, 100, 400, 4096])
def test_intervals_of_all_or_nothing_hold_as_often_as_they_say(n: int) -> None:
    """Chances of .001 to .5, and 0.1 .. 100 expected events: summed over every sample there is, without sampling."""
    events = np.arange(n + 1)
    intervals = np.array([mean_estimate(np.array([n - count, count]), 1.0).ci95 for count in events])
    chances = np.union1d(np.geomspace(0.001, 0.5, 200), np.geomspace(0.1, min(100, n / 2), 200) / n)
    held = [stats.binom.pmf(events, n, p)[(intervals[:, 0] <= p) & (p <= intervals[:, 1])].sum() for p in chances]
    assert min(held) >= 0.944
    if n == 4096:
        often = [chance for chance, p in zip(held, chances, strict=True) if p > 0.1]
        assert np.mean(often) < 0.96  # nor much more often than they say, where there is enough to see


@pytest.mark.parametrize("jump", ["geometric", "uniform", "37"])
def test_intervals_of_rare_events_of_any_size_hold_as_often_as_they_say(jump: str) -> None:
    """1,000 samples of 4096 rollouts in which an event, expected 0.3 .. 100 times, costs cells; within 2 se."""
    most = 300
    sizes = np.zeros(most + 1)
    if jump == "geometric":
        sizes[1:] = 0.95 ** np.arange(most)
    elif jump == "uniform":
        sizes[1:] = 1.0
    else:
        sizes[37] = 1.0
    sizes /= sizes.sum()
    draw = np.random.default_rng(7)
    for expected in (0.3, 1, 3, 6, 12, 25, 100):
        chance = sizes * expected / 4096
        chance[0] += 1 - expected / 4096
        held, _ = held_by(draw.multinomial(4096, chance, 1000), chance @ np.arange(most + 1))
        assert held.mean() >= 0.944 - 2 * np.sqrt(0.944 * 0.056 / 1000), expected


REAL = {
    "bell": stats.norm.pdf(np.arange(301), 150, 20),
    "one-sided": stats.geom.pmf(np.arange(301), 0.03),
    "two humps": 0.93 * stats.norm.pdf(np.arange(301), 250, 8) + 0.07 * stats.norm.pdf(np.arange(301), 160, 20),
    "three values": np.array([0.6, 0.37, 0, 0, 0, 0, 0, 0, 0, 0, 0.03]),
}


@pytest.mark.parametrize("shape", REAL)
@pytest.mark.parametrize("repeats", [600, pytest.param(10_000, marks=pytest.mark.slow)])
def test_intervals_of_few_rollouts_hold_as_often_as_they_say(shape: str, repeats: int) -> None:
    chance = REAL[shape] / REAL[shape].sum()
    truth, draw = chance @ np.arange(len(chance)), np.random.default_rng(11)
    for n in (2, 5, 20, 50, 100, 400):
        held, _ = held_by(draw.multinomial(n, chance, repeats), truth)
        assert held.mean() >= 0.944 - 3 * np.sqrt(0.944 * 0.056 / repeats), n


def test_a_narrow_interval_where_100_rollouts_lie_on_each_side() -> None:
    """At most 1.1 times 1.96 se, whatever the shape, with more than FEW values; at 45 a side a bell comes close."""
    draw = np.random.default_rng(3)
    for _ in range(2000):
        values = draw.choice(300, size=draw.integers(FEW + 1, 40), replace=False)
        counts = np.zeros(301, dtype=np.int64)
        counts[values] = np.floor(np.exp(draw.uniform(0, 8, len(values))))
        counts[draw.integers(301)] += draw.choice([0, 10**5])
        n, total = int(counts.sum()), int(counts @ np.arange(301))
        sides = [int(counts[side].sum()) for side in (np.arange(301) * n < total, np.arange(301) * n > total)]
        if min(sides) >= 100:
            found = mean_estimate(counts, 1.0)
            assert found.half_width <= 1.1 * Z95 * found.se
    bell = np.round(100 * REAL["bell"]).astype(np.int64)
    _, wide = held_by(bell[None], 150.0)
    assert bell.sum() < 110 and wide[0] < 1.1


def stops(loop: Literal["open", "closed"], repeats: int) -> tuple[float, set[int], float]:
    """(how often the interval held the exact value, numbers of rollouts at which runs stopped, its standard error)."""
    threat = np.zeros((4, 5))
    threat[1:3, 1:4], threat[3, 4] = 0.15, 0.3
    world = World.create(threat)
    plan = make_plan(world, [[0, 0], [0, 4]])
    exact = open_loop_exact(plan, world)
    truth = exact.visited / 20 if loop == "open" else closed_loop_exact(plan, world).visited / 20
    engine = make_engine_for(world, plan, RolloutChoices(loop=loop))
    drawn = samples(engine, 41 + 2 * repeats, 0 if loop == "closed" else None)
    precision = float(np.median([half_width(tally) for tally in islice(drawn, 41)]))
    choices, held, lengths = RolloutChoices(precision=precision), 0, set()
    for first, more in zip(drawn, drawn, strict=True):
        stages = (Stage(tally, "numba", 0.0, 0.0) for tally in (first, first + more))
        for stage in until_enough(stages, choices, lambda *told: None):
            last = stage
        estimate = tally_mean(last.tally, "visited", 1.0 / last.tally.accessible)
        assert estimate.half_width < precision
        held += estimate.ci95[0] <= truth <= estimate.ci95[1]
        lengths.add(last.tally.rollouts)
    return held / repeats, lengths, np.sqrt(0.95 * 0.05 / repeats)


@pytest.mark.parametrize(
    ("loop", "repeats"),
    [
        ("open", 500),
        pytest.param("open", 10_000, marks=pytest.mark.slow),
        pytest.param("closed", 10_000, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_where_precision_decides_when_to_stop(loop, repeats: int) -> None:
    """About half of the runs stop at the first look, when their interval happens to be narrow enough."""
    held, lengths, se = stops(loop, repeats)
    assert lengths == {FIRST_LOOK, 2 * FIRST_LOOK}
    assert held <= 0.95 + 3 * se or loop == "closed"  # which allows for rare events that luck hides
    assert held >= 0.95 - 3 * se
    assert repeats < 10_000 or held >= 0.944


def test_what_is_made_for_one_seed_rolls_out_no_other() -> None:
    """It is bound to its engine: another seed was ignored without a word."""
    world, choices = World.create([[0.0, 0.2, 0.2]]), RolloutChoices(loop="open", rollouts=100)
    roll_out = make_roll_out(world, make_plan(world, [[0, 0]]), choices)
    (last,) = roll_out(replace(choices, rollouts=50), None)
    assert last.tally.rollouts == 50
    for other in (replace(choices, seed=1), replace(choices, loop="closed")):
        with pytest.raises(ValueError, match="made for"):
            next(roll_out(other, None))


def test_quantiles_are_numpy_s_inverted_cdf() -> None:
    counts = np.array([0, 4, 0, 1, 5, 2])
    sample = np.repeat(np.arange(6), counts)
    for q in (0.05, 0.1, 1 / 3, 0.5, 0.83, 0.95, 1.0):
        assert quantile(counts, q) == np.quantile(sample, q, method="inverted_cdf")


def test_coverage_is_told_in_fractions_of_the_accessible_cells() -> None:
    """By hand: 100 rollouts on a map of four cells."""
    counts, mean = np.array([0, 10, 0, 40, 50]), Estimate(0.825, 0.01, (0.8, 0.85))
    coverage = Coverage(**vars(mean), covered=Covered(counts, mean.times(4.0), False))
    assert [coverage.quantile(q) for q in (0.05, 0.1, 0.11, 0.5, 0.51, 1.0)] == [0.25, 0.25, 0.75, 0.75, 1.0, 1.0]
    assert [coverage.at_least(share).mean for share in (0.25, 0.26, 0.75, 0.76, 1.0)] == [1.0, 0.9, 0.9, 0.5, 0.5]
    assert coverage.cells == pytest.approx(3.3)
    with pytest.raises(UsageError, match="q"):
        coverage.quantile(1.5)


def test_probabilities_are_scipy_s() -> None:
    for successes, n, method in ((0, 50, "exact"), (3, 50, "exact"), (50, 50, "exact"), (499, 1000, "wilson")):
        known = stats.binomtest(successes, n).proportion_ci(method=method)
        found = proportion(successes, n)
        assert found.ci95 == pytest.approx((known.low, known.high))
        assert (found.mean, found.se) == pytest.approx((successes / n, stats.binom.std(n, successes / n) / n))


@pytest.mark.parametrize("n", [1, 2, 5, 20, 100, 400, pytest.param(4096, marks=pytest.mark.slow)])
def test_intervals_of_probabilities_hold_in_94_percent_wherever_they_are(n: int) -> None:
    """Just beside the ends of the intervals, where they hold least: summed over every sample there is."""
    low, high = np.array([proportion(successes, n).ci95 for successes in range(n + 1)]).T
    ends = np.concatenate([low[1:], high[:-1]])
    for p in np.concatenate([np.linspace(0, 1, 101), ends - 1e-9, ends + 1e-9]).clip(0, 1):
        assert stats.binom.pmf(np.flatnonzero((low <= p) & (p <= high)), n, p).sum() >= 0.94


def test_what_95_percent_of_runs_reach_is_sure_with_95_percent() -> None:
    """Of coins that show 1 with p = .8 (not 95 % of them do) 1 is said in 5 % of samples at most, and never of few."""
    assert assured(np.array([0, 58])) is None and assured(np.array([0, 59])) == 1
    for n in (59, 93, 200, 1000, 20_000):
        said = [zeros for zeros in range(n // 5) if assured(np.array([zeros, n - zeros])) == 1]
        assert said == list(range(len(said)))
        assert stats.binom.cdf(said[-1], n, 0.0500001) <= 0.05 < stats.binom.cdf(said[-1] + 1, n, 0.05)
    sample = np.random.default_rng(1).binomial(20, 0.5, size=(2000, 100))
    truth = stats.binom.ppf(0.05, 20, 0.5)
    assert np.mean([assured(np.bincount(row, minlength=21)) <= truth for row in sample]) >= 0.95
    assert assured(np.bincount([2**10] * 10, minlength=2000).astype(np.int64) * 2**28) == 2**10


def test_quantiles_of_few_rollouts_are_left_out() -> None:
    """All of 4 rollouts may well lie on one side of the median, all of 58 above the 5 % quantile."""
    known = {n: quantiles(np.array([0, n]), 1.0) for n in (4, 5, 58, 59)}
    assert np.isnan(list(known[4].values())).all()
    assert [np.isnan(value) for value in known[58].values()] == [True, False, True] and known[5][0.5] == 1
    assert set(known[59].values()) == {1} == set(quantiles(np.array([0, 1]), 1.0, certain=True).values())
    answer = mrac.evaluate(World.create([[0, 0.2, 0]]), 1, rollouts=5, exact="never", band=False, advice=False)
    assert "% of runs" not in str(answer).splitlines()[0] and "5 %" not in str(answer).splitlines()[1]
    told = answer.to_json()["coverage"]["visited"]
    assert told["quantiles"]["0.05"] is None
    chances = {x: answer.tally.visited[int(np.ceil(3 * x)) :].sum() / 5 for x in (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)}
    assert {share: chance["mean"] for share, chance in told["at_least"].items()} == {
        f"{x:g}": chances[x] for x in chances
    }


def test_looks_double() -> None:
    assert looks()[:4] == [1024, 2048, 4096, 8192]
    assert looks()[-1] == 2**32
