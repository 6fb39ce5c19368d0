"""Means, intervals and quantiles, differences, the control variate, components of variance."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from itertools import islice
from operator import add
from typing import Literal

import numpy as np
import pytest
from conftest import FOLDER
from helpers import answer_of, samples, uniform
from numpy.typing import NDArray
from oracle_tree import closed_loop_exact
from scipy import stats

import mrac_jax as mrac
from analysis.comparison import compare, make_side
from analysis.evaluation.evaluate import evaluate, half_width, until_enough
from analysis.evaluation.figures import Coverage, Covered
from analysis.sampling import RolloutChoices, Stage, make_engine_for, make_roll_out
from analysis.statistics import variance_reduction
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
    sample_of,
)
from analysis.statistics.variance_reduction import LEAST, Paired, difference, of_tally, of_values, tally_mean
from analysis.theory.exact import open_loop_exact
from analysis.theory.verdicts import longest_mission, longest_run
from planner.errors import UsageError
from planner.failure_model import exp1_thresholds
from planner.json_objects import as_json
from planner.make_plan import make_plan
from planner.rollouts.engine import Engine, Rolling, make_engine, run_chunks, run_with_threshold_sums
from planner.rollouts.threshold_classes import CLASSES_A_NAT, COLUMNS, classes_by_threshold, sums_by_threshold
from planner.settings import Settings
from planner.simulator.thresholds import UNIT
from planner.tally import Tally
from planner.world.world import World, load_world_file

# Means, intervals and quantiles of histograms against SciPy and against their own promise.


def test_mean_and_standard_error_are_scipy_s() -> None:
    counts = np.array([3, 0, 5, 7, 1])
    sample, known = np.repeat(np.arange(5), counts), mean_estimate(counts, 0.25)
    assert (known.mean, known.se) == pytest.approx((sample.mean() * 0.25, stats.sem(sample) * 0.25))


def test_large_counts_stay_exact() -> None:
    counts = np.zeros(50_001, dtype=np.int64)
    counts[[49_999, 50_000]] = 2**31
    known = mean_estimate(counts, 1.0)
    assert known.mean == 49_999.5 and known.se == pytest.approx(0.5 / np.sqrt(2.0**32), rel=1e-6)


def test_interval_does_not_collapse_without_variance() -> None:
    known = mean_estimate(np.array([0, 0, 4096]), 0.5)
    chance = -np.log(0.025) / 4096  # of what was not seen in 4096 rollouts, at 97.5 %
    assert (known.mean, known.se, known.ci95) == (1.0, 0.0, (pytest.approx(1 - chance), 1.0))
    assert known.half_width == pytest.approx(chance)


def test_interval_holds_as_often_as_it_says() -> None:
    """4,000 samples of 400 values: 95 % of the intervals hold the mean, within 3 standard errors."""
    repeats, n = 4_000, 400
    sample, draw = np.arange(repeats)[:, None], np.arange(n)[None]
    values = np.floor((uniform(5, sample, draw, 0) + uniform(5, sample, draw, 1)) * 50).astype(int)
    truth = 49.5  # 50 times the mean of two uniforms, less the half that rounding down takes
    intervals = [mean_estimate(np.bincount(row, minlength=100), 1.0).ci95 for row in values]
    held = np.mean([low <= truth <= high for low, high in intervals])
    assert abs(held - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / repeats)


def held_by(samples: np.ndarray, truth: float) -> tuple[np.ndarray, np.ndarray]:
    """(whether each histogram's interval holds `true_map`, its half-width over 1.96 standard errors), `[samples]`."""
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


SIZES = {"geometric": 0.95 ** np.arange(300), "uniform": np.ones(300), "37": np.arange(300) == 36}
"""How often an event costs 1, 2, ... cells."""


@pytest.mark.parametrize("jump", SIZES)
def test_intervals_of_rare_events_of_any_size_hold_as_often_as_they_say(jump: str) -> None:
    """1,000 samples of 4096 rollouts in which an event, expected 0.3 .. 100 times, costs cells; within 2 se."""
    sizes, draw = np.append(0.0, SIZES[jump] / SIZES[jump].sum()), np.random.default_rng(7)
    for expected in (0.3, 1, 3, 6, 12, 25, 100):
        chance = sizes * expected / 4096
        chance[0] += 1 - expected / 4096
        held, _ = held_by(draw.multinomial(4096, chance, 1000), chance @ np.arange(301))
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
    truth = (open_loop_exact if loop == "open" else closed_loop_exact)(plan, world).visited / 20
    engine = make_engine_for(world, plan, RolloutChoices(loop=loop))
    drawn = samples(engine, 41 + 2 * repeats, 0 if loop == "closed" else None)
    precision = float(np.median([half_width(tally) for tally in islice(drawn, 41)]))
    choices, held, lengths = RolloutChoices(precision=precision), 0, set()
    for first, more in zip(drawn, drawn, strict=True):
        stages = (Stage(tally, "numba", 0.0, 0.0) for tally in (first, first + more))
        (last,) = deque(until_enough(stages, choices, lambda *told: None), maxlen=1)
        estimate = tally_mean(last.tally, "visited", 1.0 / last.tally.accessible)
        assert estimate.half_width < precision
        held += estimate.ci95[0] <= truth <= estimate.ci95[1]
        lengths.add(last.tally.rollouts)
    return held / repeats, lengths, np.sqrt(0.95 * 0.05 / repeats)


@pytest.mark.parametrize(
    "loop, repeats",
    [("open", 500), *(pytest.param(loop, 10_000, marks=pytest.mark.slow) for loop in ("open", "closed"))],
)
def test_intervals_hold_where_precision_decides_when_to_stop(loop, repeats: int) -> None:
    """About half of the runs stop at the first look, when their interval happens to be narrow enough."""
    held, lengths, se = stops(loop, repeats)
    assert lengths == {FIRST_LOOK, 2 * FIRST_LOOK}
    assert held <= 0.95 + 3 * se or loop == "closed"  # which allows for rare events that luck hides
    assert held >= max(0.95 - 3 * se, 0.944 * (repeats == 10_000))


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
    for q in (0.05, 0.1, 1 / 3, 0.5, 0.83, 0.95, 1.0):
        assert quantile(counts, q) == np.quantile(np.repeat(np.arange(6), counts), q, method="inverted_cdf")


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
    first, second, *_ = str(answer).splitlines()
    told = answer.to_json()["coverage"]["visited"]
    assert "% of runs" not in first and "5 %" not in second and told["quantiles"]["0.05"] is None
    chances = {f"{x:g}": answer.tally.visited[int(np.ceil(3 * x)) :].sum() / 5 for x in (0.5, 0.75, 0.9, 0.95, 0.99, 1)}
    assert {share: chance["mean"] for share, chance in told["at_least"].items()} == chances


def test_looks_double() -> None:
    assert looks()[:4] == [1024, 2048, 4096, 8192] and looks()[-1] == 2**32


# Differences on common luck: exact sums, and intervals that hold as often as they say.


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
    apart, sample = 2.0 * y - 0.5 * x, Paired.of(x, y).sample(-0.5, 2.0)
    off = apart - apart.mean()
    assert (sample.scatter, sample.lean) == (pytest.approx((off**2).sum()), pytest.approx((off**3).sum(), rel=1e-6))
    assert Paired.of(x, x).sample(-1.0, 1.0).scatter == 0
    found = difference(Paired.of(x, y), 0.5, 2.0, 80.0).estimate
    assert (found.mean, found.se) == pytest.approx((apart.mean(), apart.std(ddof=1) / np.sqrt(1000)))
    unseen = 40.0 * -np.log(0.025) / 1000  # no rollout differed: the rule of three
    assert difference(Paired.of(x, x), 1.0, 1.0, 40.0).estimate.ci95 == pytest.approx((-unseen, unseen))


def test_a_difference_seen_in_few_rollouts_holds_as_often_as_it_says() -> None:
    """0.1 .. 100 expected rollouts of 4096 in which a plan covers 30 cells more: summed over every sample there is."""
    n, x = 4096, np.full(4096, 100)
    events = np.arange(180)
    found = [difference(Paired.of(x, x + 30 * (np.arange(n) < k)), 1.0, 1.0, 200.0).estimate.ci95 for k in events]
    low, high = np.array(found).T / 30
    for expected in np.geomspace(0.1, 100, 60):
        chance = stats.binom.pmf(events, n, expected / n)
        assert chance[(low <= expected / n) & (expected / n <= high)].sum() >= 0.944


def test_the_interval_of_a_difference_holds_as_often_as_it_says() -> None:
    """4,000 samples of 400: within 3 standard errors."""
    repeats, n = 4_000, 400
    ids, at = np.arange(repeats)[:, None], np.arange(n)[None]
    own, other, shared = (uniform(11, ids, at, robot) for robot in range(3))
    xs, ys = (20 * (own + shared)).astype(int), (30 * (other + shared)).astype(int)
    apart, held = 29.5 - 19.5, 0  # the uniforms' means, less the half that rounding down takes
    for x, y in zip(xs, ys, strict=True):
        low, high = difference(Paired.of(x, y), 1.0, 1.0, 59.0).estimate.ci95
        held += low <= apart <= high
    assert abs(held / repeats - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / repeats)


# The control by total tolerance: exact sums, least squares, intervals that hold as often as they say.

CONTIGUOUS, SCATTERED = (FOLDER / f"{kind}-20x20-1000.npz" for kind in ("contiguous", "scattered"))
FIGURES = ("visited", "survived", "time", "alive", "complete")


def engine_of(world: World, robots: int, policy: str = "mrac", seed: int = 0) -> Engine:
    """Of the closed loop by tolerance."""
    return make_engine(mrac.plan(world, robots, policy=policy), world, Rolling(seed=seed), "numba")


def broken(total: NDArray[np.float64], robots: int) -> NDArray[np.float64]:
    """`[n, 6]`, luck in half classes and beyond the 2.3, 16, 50, 84, 98 % points of the total, to a half class."""
    bends = [round(16 * (stats.gamma.ppf(stats.norm.cdf(at), robots) - robots)) for at in (-2, -1, 0, 1, 2)]
    luck = 16 * (total - robots)
    return np.stack([luck, *(np.maximum(luck - bend, 0) for bend in bends)], axis=1)


def fitted(y: NDArray, total: NDArray[np.float64], robots: int) -> tuple[float, float, float]:
    """Least squares over rollouts: what y is where all pieces of the line are as expected, with its standard error;
    the residual variance."""
    pieces = np.column_stack([np.ones(len(y)), broken(total, robots) - variance_reduction.expected_pieces(robots)])
    found, residual, *_ = np.linalg.lstsq(pieces, y, rcond=None)
    variance = float(residual[0]) / (len(y) - pieces.shape[1])
    return float(found[0]), float(np.sqrt(variance * np.linalg.inv(pieces.T @ pieces)[0, 0])), variance


@pytest.mark.parametrize(("start", "robots"), [(100, 5), (0, 40), (345_731_000, 8)])
def test_classes_are_of_the_tolerances(start: int, robots: int) -> None:
    """Also of rollout 345,731,376, whose total in whole units is in another class than the logarithm in floats."""
    expected = exp1_thresholds(7, np.arange(start, start + 500), robots).sum(axis=1) * CLASSES_A_NAT // UNIT
    assert np.array_equal(classes_by_threshold(7, start, 500, robots), expected)


@pytest.mark.parametrize("robots", [1, 3, 8, 40])
def test_what_is_expected_of_a_class_is_what_is_met(robots: int) -> None:
    """Of 100,000 teams, within 5 standard errors; and close to what is known of the total itself."""
    middle = (classes_by_threshold(1, 0, 100_000, robots) + 0.5) / CLASSES_A_NAT
    met, known = broken(middle, robots), variance_reduction.expected_pieces(robots)
    assert (abs(met.mean(axis=0) - known) <= 5 * met.std(axis=0) / np.sqrt(len(met))).all()
    assert known[0] == pytest.approx(0.0, abs=0.021) and known[3] == pytest.approx(16 * above_median(robots), rel=0.02)


def above_median(robots: int) -> float:
    """E[max(S - median, 0)] of a Gamma variable, from tables: the mean above a point has shape K + 1."""
    median = stats.gamma.ppf(0.5, robots)
    return float(robots * stats.gamma.sf(median, robots + 1) - median / 2)


def test_sums_are_those_of_the_rollouts_however_they_are_shared_out() -> None:
    engine = engine_of(load_world_file(CONTIGUOUS), 4, seed=3)
    whole, results = run_with_threshold_sums(engine, 3, 0, 3000)
    *_, last = run_chunks(engine, 3000, chunk=700, by_threshold=3)
    assert last.tally == whole
    assert [tally_mean(last.tally, figure) for figure in FIGURES[:4]] == [tally_mean(whole, f) for f in FIGURES[:4]]
    sums = whole.by_threshold.reshape(-1, len(COLUMNS)).sum(axis=0)
    assert sums.tolist() == [3000, *(int(getattr(results, f).sum()) for f in FIGURES[:4]), int(whole.outcomes[0])]
    assert np.array_equal(whole.by_threshold, sums_by_threshold(results, 3, 4))


def test_means_and_errors_are_the_regression_s() -> None:
    tally, results = run_with_threshold_sums(engine_of(load_world_file(SCATTERED), 8), 0, 0, 2048)
    total = (classes_by_threshold(0, 0, 2048, 8) + 0.5) / CLASSES_A_NAT
    for figure in FIGURES[:3]:
        y, found = getattr(results, figure).astype(float), of_tally(tally, figure)
        mean, error, variance = fitted(y, total, 8)
        assert found.mean == pytest.approx(mean, rel=1e-9)
        assert found.sample.se == pytest.approx(error, rel=1e-7)  # with that of the slopes
        assert found.gain == pytest.approx((y.var(ddof=1) / 2048) / found.sample.se**2)
        steeper = np.diff(found.weights, prepend=0.0) / 16
        assert np.var(y - broken(total, 8) @ steeper) == pytest.approx(variance, rel=0.01)
    lost, alive = tally_mean(tally, "lost"), tally_mean(tally, "alive")
    assert lost.mean == 8 - alive.mean and lost.ci95 == (8 - alive.ci95[1], 8 - alive.ci95[0])


def test_a_figure_that_the_luck_tells_is_known() -> None:
    """y = 16 S + 1 of teams of four, by class: its mean is 65, whatever teams the rollouts happened to have."""
    classes = np.array([4, 12, 20, 28, 36, 44, 52, 60, 80, 90])
    by_class, y = np.zeros(96, dtype=np.int64), 2 * np.arange(96) + 2
    by_class[classes] = [30, 50, 300, 200, 200, 150, 150, 100, 10, 20]
    found = variance_reduction.controlled(by_class, (by_class * y).astype(float), sample_of(y, by_class), 4)
    assert found.mean == pytest.approx(16 * 4 + 1, abs=16 * 0.005) and found.gain > 1e9
    assert found.weights == pytest.approx((16,) * 6, abs=1e-9)
    alike = variance_reduction.controlled(by_class, 5.0 * by_class, sample_of(np.array([5]), np.array([1210])), 4)
    assert (alike.mean, alike.gain, alike.sample.se) == (5, 1, 0)


def test_below_so_many_rollouts_and_without_the_sums_it_is_the_plain_mean() -> None:
    engine = engine_of(load_world_file(SCATTERED), 4)
    few, _ = run_with_threshold_sums(engine, 0, 0, LEAST - 1)
    assert tally_mean(few, "visited") == mean_estimate(few.visited, 1.0)
    half = run_with_threshold_sums(engine, 0, 0, LEAST)[0] + engine.tally(LEAST, LEAST)
    assert tally_mean(half, "time", 0.5, 10_000) == mean_estimate(half.time, 0.5, 10_000)
    assert variance_reduction.complete_chance(half) == proportion(int(half.outcomes[0]), half.rollouts)


def test_what_was_not_seen_counts_as_without_the_control() -> None:
    """No run of 1,024 lost a robot, which one in a million does: the interval is as wide."""
    world = World.create([[0.0, 1e-6, 0.0]])
    tally, _ = run_with_threshold_sums(engine_of(world, 1), 0, 0, LEAST)
    assert int(tally.visited[3]) == LEAST
    for figure in ("visited", "survived", "time"):
        assert tally_mean(tally, figure).ci95 == pytest.approx(mean_estimate(getattr(tally, figure), 1.0).ci95)
    assert tally_mean(tally, "visited").half_width > 0


def estimates(tally: Tally) -> list[Estimate]:
    """Of all five figures."""
    return [*(tally_mean(tally, figure) for figure in FIGURES[:4]), variance_reduction.complete_chance(tally)]


def held(world: World, robots: int, policy: str, seeds: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How often the interval of each figure holds the mean of all, from samples of 1,024; and the control's gains.

    The mean of all is that of 2**18 rollouts or more, the samples' among them.
    """
    found = list(samples(engine_of(world, robots, policy), max(seeds, 2**18 // LEAST), 0))
    truth = [one.mean for one in estimates(reduce(add, found))]
    intervals = np.array([[one.ci95 for one in estimates(tally)] for tally in found[:seeds]])
    hits = (intervals[..., 0] - 1e-12 <= truth) & (truth <= intervals[..., 1] + 1e-12)
    gains = [of_tally(tally, "visited") for tally in found[:seeds]]
    return hits.mean(axis=0), np.array([one.gain for one in gains if one is not None])


def test_samples_of_a_long_run_are_the_runs_by_themselves() -> None:
    engine = engine_of(load_world_file(CONTIGUOUS), 4, seed=3)
    for number, mine in enumerate(samples(engine, 3, 3, first=500)):
        whole, _ = run_with_threshold_sums(engine, 3, 500 + number * LEAST, LEAST)
        assert mine.ids == whole.ids and np.array_equal(mine.by_threshold, whole.by_threshold)
        assert estimates(mine) == estimates(whole)


def test_intervals_hold_and_are_sharper_on_one_world() -> None:
    """40 samples of 1,024 rollouts: within 3 standard errors below .95 in each figure."""
    share, gains = held(load_world_file(CONTIGUOUS), 8, "mrac", 40)
    assert (share >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / 40)).all(), dict(zip(FIGURES, share, strict=True))
    assert np.median(gains) > 10


def test_evaluate_goes_by_it(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer_of(capsys, "evaluate", str(CONTIGUOUS), "--robots", "8", "--precision", "0.002")
    assert found["control"]["gain"]["visited"] > 10 and len(found["control"]["weights"]["visited"]) == 6
    tally = engine_of(load_world_file(CONTIGUOUS), 8).tally(0, found["rollouts"])
    plain = tally_mean(tally, "visited", 1.0 / tally.accessible)
    (low, high), (least, most) = plain.ci95, found["coverage"]["visited"]["ci95"]
    assert most - least <= 0.004 and 2 * (most - least) <= high - low and low < most and least < high
    assert found["best"]["visited"].items() <= found["coverage"]["visited"].items()


def test_the_deadline_s_and_other_threats_have_it_too() -> None:
    world = load_world_file(CONTIGUOUS)
    answer = evaluate(world, mrac.plan(world, 8), RolloutChoices(rollouts=2048, deadline=60), threat_scale=(0.5,))
    (scaled,), deadline = answer.outputs["threat_scale"].scaled, answer.outputs["deadline"]
    for tally, figures, least in (
        (scaled.tally, as_json(scaled)["coverage"], 1.5), (deadline.tally, as_json(deadline), 1.0)
    ):  # fmt: skip
        plain = replace(tally, by_threshold=np.zeros(0, dtype=np.int64))
        assert figures["visited"]["se"] < tally_mean(plain, "visited", 1.0 / tally.accessible).se / least


def test_differences_are_put_right_too() -> None:
    world = load_world_file(SCATTERED)
    plans = [mrac.plan(world, 8, policy=policy) for policy in ("mrac", "per_cell")]
    answer = compare(*(make_side(world, plan, RolloutChoices(rollouts=4096)) for plan in plans))
    a, b = (make_engine(plan, world, Rolling(), "numba").results(0, 4096).visited for plan in plans)
    y, found = (b - a) / answer.a.cells, answer.difference("visited")
    mean, error, variance = fitted(y, (classes_by_threshold(0, 0, 4096, 8) + 0.5) / CLASSES_A_NAT, 8)
    assert found.estimate.mean == pytest.approx(mean, rel=1e-9)
    assert found.estimate.se == pytest.approx(error, rel=1e-7) and variance < y.var()
    apart = answer.mean(answer.b, "visited") - answer.mean(answer.a, "visited")
    assert apart == pytest.approx(found.estimate.mean, rel=1e-9)
    assert found.gain > 10 and int(answer.by_threshold[0].reshape(-1, len(COLUMNS))[:, 0].sum()) == 4096


KINDS = [f"{kind}-{side}" for kind in ("contiguous", "scattered") for side in ("20x20", "14x23")]
WORLDS = (
    *((f"{kind}-{number}", 8, "mrac") for kind in KINDS for number in (1000, 1001)),
    ("contiguous-20x20-1000", 4, "mrac"), ("scattered-20x20-1000", 20, "mrac"), ("contiguous-20x20-1002", 2, "mrac"),
    ("contiguous-20x20-1000", 8, "per_cell"), ("scattered-20x20-1000", 8, "per_cell"),
)  # fmt: skip


@pytest.mark.slow
def test_intervals_hold_on_thirteen_worlds() -> None:
    """1,000 samples of each, five figures: no cell below .925, all together .945 or more."""
    found = [held(load_world_file(FOLDER / f"{name}.npz"), *team, 1000) for name, *team in WORLDS]
    cells = np.array([share for share, _ in found])
    assert cells.shape == (13, 5) and cells.min() >= 0.925 and cells.mean() >= 0.945, cells


# Components of variance against plain twins: variances from their definitions, errors by leaving one out at a time.


def jackknife(figure: Callable[[np.ndarray], float], kept: int) -> tuple[float, float]:
    """(figure of all, its standard error): `figure` takes the indices that stay."""
    left = np.array([figure(np.delete(np.arange(kept), one)) for one in range(kept)])
    return figure(np.arange(kept)), float(np.sqrt((kept - 1) / kept * ((left - left.mean()) ** 2).sum()))


def is_deviation(found: Estimate, variance: float, error: float) -> bool:
    """A standard deviation with error and interval of its variance: below as it is, above on a scale of logarithms."""
    half = stats.norm.ppf(0.975) * error
    ratio = half / variance
    high = variance * np.exp(ratio) if ratio <= 1 else variance + half * np.expm1(1.0)
    ends = np.sqrt([max(variance - half, 0.0), high])
    return (found.mean, found.se, *found.ci95) == pytest.approx(
        (np.sqrt(variance), error / (2 * np.sqrt(variance)), *ends), rel=1e-9
    )


@pytest.mark.parametrize(
    ("apart", "sizes"), [(0.5, range(1, 10)), (3.0, range(1, 10)), (30.0, range(1, 10)), (3.0, [3, 1])]
)
def test_of_groups_of_unequal_size_each_value_is_left_out_once(apart: float, sizes: Sequence[int]) -> None:
    draw = np.random.default_rng(30)
    group = np.repeat(np.arange(len(sizes)), sizes)
    value = draw.normal(size=len(group)) + apart * draw.normal(size=len(sizes))[group]

    def within(kept: np.ndarray) -> float:
        sums = [((part := value[kept][group[kept] == one]) - part.mean()) ** 2 for one in np.unique(group[kept])]
        return sum(map(np.sum, sums)) / (len(kept) - len(sums))

    found = of_values(group, value, 100.0)
    assert is_deviation(found.within, *jackknife(within, len(group)))
    both = jackknife(lambda kept: float(np.var(value[kept], ddof=1)) - within(kept), len(group))
    assert is_deviation(found.between, *both)
    means = np.array([value[group == one].mean() for one in range(len(sizes))])
    drawn = means.mean() + (means - means.mean()) * min(found.between.mean / means.std(), 1)
    assert found.means == pytest.approx(np.sort(drawn))


def test_of_means_of_equally_many_each_group_is_left_out_once() -> None:
    draw = np.random.default_rng(31)
    values = draw.normal(size=(12, 40)) + draw.normal(size=12)[:, None]
    found = variance_reduction.of_means(values.mean(axis=1), values.var(axis=1, ddof=1), 40, 100.0)
    assert is_deviation(found.within, *jackknife(lambda kept: float(values[kept].var(axis=1, ddof=1).mean()), 12))

    def between(kept: np.ndarray) -> float:
        return float(values[kept].mean(axis=1).var(ddof=1) - values[kept].var(axis=1, ddof=1).mean() / 40)

    assert is_deviation(found.between, *jackknife(between, 12))
    assert found.means.std() == pytest.approx(min(found.between.mean, values.mean(axis=1).std()))


@pytest.mark.parametrize("all_of_them", [True, False])
def test_of_means_that_are_exact_the_rest_of_the_scatter_is_luck(all_of_them: bool) -> None:
    means, counts = np.array([0.2, 0.4, 0.7, 0.5]), np.array([9, 20, 41, 17, 13])
    found = variance_reduction.known_between(means, all_of_them, counts)
    values = np.repeat(np.arange(5) / 4, counts)
    if all_of_them:
        assert (found.between.mean, found.between.se) == (means.std(), 0)
    else:
        assert is_deviation(found.between, *jackknife(lambda kept: float(means[kept].var(ddof=1)), 4))
    off = (values - values.mean()) ** 2
    error = np.sqrt(((off - values.var(ddof=1)) ** 2).sum()) / len(values)
    assert is_deviation(found.within, values.var(ddof=1) - found.between.mean**2, error)
    assert found.means.tolist() == [0.2, 0.4, 0.5, 0.7]


def test_where_no_draw_made_a_difference_the_rule_of_three_holds() -> None:
    """Of `n` values alike: a chance of -ln(.025) / n or less (a quarter at most of what two values can scatter)."""
    for n in (8, 400):
        found = of_values(np.arange(n) % 2, np.ones(n), 10.0)
        chance = min(-np.log(0.025) / n, 0.25)
        assert found.within.mean == 0 == found.within.ci95[0]
        assert found.within.ci95[1] == pytest.approx(10 * np.sqrt(chance * np.expm1(1.0)))


# Intervals of mean time reach for what was not seen: they hold as often as they say, and none is a point by luck.

QUICK, ALL = 30, pytest.param(300, marks=pytest.mark.slow)
ENDS = [(0, 0), (0, 30)]


def row(length: int, p: float) -> World:
    """A row of cells; the second stops a robot with chance p."""
    return World.create([[0.0, p, *[0.0] * (length - 2)]])


def hold(found: list[Estimate], truth: float) -> None:
    """Each of these intervals has a width, and at least 94 % of them hold the truth."""
    ends = np.array([one.ci95 for one in found])
    assert (ends[:, 0] < ends[:, 1]).all()
    assert not any("exact" in one.describe() for one in found)
    assert ((ends[:, 0] <= truth) & (truth <= ends[:, 1])).mean() >= 0.94


@pytest.mark.parametrize(("p", "q", "rollouts"), [(0.02, 0.01, 20), (0.02, 0.01, 100), (1e-4, 2e-4, 4096)])
@pytest.mark.parametrize("seeds", [QUICK, ALL])
def test_a_difference_of_times(p: float, q: float, rollouts: int, seeds: int) -> None:
    """One robot on 20 cells is stopped at step 1 or drives for 19 steps; most samples see no rollout that differs."""
    a, b = row(20, p), row(20, q)
    sides = (a, mrac.plan(a, 1)), (b, mrac.plan(b, 1))
    found = [mrac.compare(*sides, rollouts=rollouts, seed=seed).difference("time").estimate for seed in range(seeds)]
    hold(found, (float(np.float32(p)) - float(np.float32(q))) * 18)


@pytest.mark.parametrize("rollouts", [50, 100, 400, 1000])
@pytest.mark.parametrize("seeds", [QUICK, ALL])
def test_a_time_that_rare_losses_make_longer(rollouts: int, seeds: int) -> None:
    """Two robots from the ends of a row: 15 steps, but 28 if the first is lost at step 1, and 15 if the other is."""
    world = row(31, 0.002)
    plan = mrac.plan(world, starts=ENDS)
    most = longest_run(world, plan, "closed")
    assert most == longest_mission(world, ENDS, Settings()) == 8 * 2 * 31 + 64
    truth = mrac.evaluate(world, plan, rollouts=1, advice=False, band=False).closed.time
    assert truth == pytest.approx(15.026, abs=5e-4)
    engines = [make_engine(plan, world, Rolling(seed=seed), "numba") for seed in range(seeds)]
    hold([mean_estimate(engine.tally(0, rollouts).time, 1.0, most) for engine in engines], truth)


def test_every_answer_s_time_reaches_so_far() -> None:
    """evaluate, front, size: none of 40 rollouts met the loss that makes missions longer; the interval knows it."""
    world, sampled = row(31, 0.002).with_starts(ENDS), {"rollouts": 40, "exact": "never"}
    plain = {"advice": False, "band": False, "engine": "numba"}
    evaluated = mrac.evaluate(world, **sampled, **plain)
    points = mrac.front(world, losses=2.0, risk_caps=[], robot_values=[4.0], engine="numba", **sampled).points
    teams = mrac.size(world, target=0.99, **sampled).points
    times = [evaluated.figures.time, *(point.time for point in points if point.setting.deadline is None)]
    times += [point.time for point in teams if point.robots == 2 and point.time is not None]
    assert len(times) >= 4 and all(time.ci95[1] > time.mean + 1 for time in times)
    assert np.count_nonzero(evaluated.tally.time) == 1 and evaluated.to_json()["time"]["ci95"][1] > 16
    known = mrac.evaluate(world, rollouts=40, **plain)
    assert known.time.ci95 == (pytest.approx(15.026, abs=5e-4),) * 2


def test_of_one_robot_and_of_the_open_loop_a_proven_largest_time() -> None:
    world = World.create([[0, 0, 0.5, 0, np.nan, 0], [0, 0, 0.1, 0, 0, 0]])
    for robot_value in (None, 30.0):
        plan = mrac.plan(world, starts=[(0, 0)], policy="per_cell", robot_value=robot_value)
        most = longest_run(world, plan, "closed")
        tally = make_engine(plan, world, Rolling(), "numba").tally(0, 2000)
        assert np.flatnonzero(tally.time).max() == most < longest_mission(world, [(0, 0)], Settings())
        assert longest_run(world, plan, "open") == plan.makespan <= most
