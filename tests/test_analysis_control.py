"""The control by total tolerance: exact sums, least squares, intervals that hold as often as they say."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
import pytest
from conftest import FOLDER
from numpy.typing import NDArray
from samples import samples
from scipy import stats

from analysis.cli.app import run
from analysis.comparison import compare, make_side
from analysis.evaluation.evaluate import evaluate
from analysis.sampling import RolloutChoices
from analysis.statistics.control_variate import (
    LEAST,
    complete_chance,
    controlled,
    expected_pieces,
    of_tally,
    tally_mean,
)
from analysis.statistics.estimates import Estimate, mean_estimate, proportion, sample_of
from planner.failure_model import UNIT, tolerances
from planner.mrac.make_plan import make_plan
from planner.rollouts.engine import Engine, Rolling, make_engine, run_by_luck, run_chunks
from planner.rollouts.threshold_classes import CLASSES_A_NAT, COLUMNS, luck_classes, sums_by_luck
from planner.settings import Settings
from planner.tally import Tally
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

CONTIGUOUS, SCATTERED = (FOLDER / f"{kind}-20x20-1000.npz" for kind in ("contiguous", "scattered"))
FIGURES = ("visited", "survived", "time", "alive", "complete")


def engine_of(world: World, robots: int, policy: str = "mrac", seed: int = 0) -> Engine:
    """Of the closed loop by tolerance."""
    plan = make_plan(world, place_starts(world, robots)[0], Settings(policy=policy))
    return make_engine(plan, world, Rolling(seed=seed), "numba")


def broken(total: NDArray[np.float64], robots: int) -> NDArray[np.float64]:
    """`[n, 6]`, luck in half classes and beyond the 2.3, 16, 50, 84, 98 % points of the total, to a half class."""
    bends = [round(16 * (stats.gamma.ppf(stats.norm.cdf(at), robots) - robots)) for at in (-2, -1, 0, 1, 2)]
    luck = 16 * (total - robots)
    return np.stack([luck, *(np.maximum(luck - bend, 0) for bend in bends)], axis=1)


def fitted(y: NDArray, total: NDArray[np.float64], robots: int) -> tuple[float, float, float]:
    """Least squares over rollouts: what y is where all pieces of the line are as expected, with its standard error;
    the residual variance."""
    pieces = np.column_stack([np.ones(len(y)), broken(total, robots) - expected_pieces(robots)])
    found, residual, *_ = np.linalg.lstsq(pieces, y, rcond=None)
    variance = float(residual[0]) / (len(y) - pieces.shape[1])
    return float(found[0]), float(np.sqrt(variance * np.linalg.inv(pieces.T @ pieces)[0, 0])), variance


@pytest.mark.parametrize(("start", "robots"), [(100, 5), (0, 40), (345_731_000, 8)])
def test_classes_are_of_the_tolerances(start: int, robots: int) -> None:
    """Also of rollout 345,731,376, whose total in whole units is in another class than the logarithm in floats."""
    expected = tolerances(7, np.arange(start, start + 500), robots).sum(axis=1) * CLASSES_A_NAT // UNIT
    assert np.array_equal(luck_classes(7, start, 500, robots), expected)


@pytest.mark.parametrize("robots", [1, 3, 8, 40])
def test_what_is_expected_of_a_class_is_what_is_met(robots: int) -> None:
    """Of 100,000 teams, within 5 standard errors; and close to what is known of the total itself."""
    middle = (luck_classes(1, 0, 100_000, robots) + 0.5) / CLASSES_A_NAT
    met, known = broken(middle, robots), expected_pieces(robots)
    assert (abs(met.mean(axis=0) - known) <= 5 * met.std(axis=0) / np.sqrt(len(met))).all()
    assert known[0] == pytest.approx(0.0, abs=0.021) and known[3] == pytest.approx(16 * above_median(robots), rel=0.02)


def above_median(robots: int) -> float:
    """E[max(S - median, 0)] of a Gamma variable, from tables: the mean above a point has shape K + 1."""
    median = stats.gamma.ppf(0.5, robots)
    return float(robots * stats.gamma.sf(median, robots + 1) - median / 2)


def test_sums_are_those_of_the_rollouts_however_they_are_shared_out() -> None:
    engine = engine_of(load_world_file(CONTIGUOUS), 4, seed=3)
    whole, results = run_by_luck(engine, 3, 0, 3000)
    *_, last = run_chunks(engine, 3000, chunk=700, by_luck=3)
    assert last.tally == whole
    assert [tally_mean(last.tally, figure) for figure in FIGURES[:4]] == [tally_mean(whole, f) for f in FIGURES[:4]]
    sums = whole.by_luck.reshape(-1, len(COLUMNS)).sum(axis=0)
    assert sums.tolist() == [3000, *(int(getattr(results, f).sum()) for f in FIGURES[:4]), int(whole.outcomes[0])]
    assert np.array_equal(whole.by_luck, sums_by_luck(results, 3, 4))


def test_means_and_errors_are_the_regression_s() -> None:
    tally, results = run_by_luck(engine_of(load_world_file(SCATTERED), 8), 0, 0, 2048)
    total = (luck_classes(0, 0, 2048, 8) + 0.5) / CLASSES_A_NAT
    for figure in FIGURES[:3]:
        y = getattr(results, figure).astype(float)
        mean, error, variance = fitted(y, total, 8)
        found = of_tally(tally, figure)
        assert found is not None
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
    found = controlled(by_class, (by_class * y).astype(float), sample_of(y, by_class), 4)
    assert found.mean == pytest.approx(16 * 4 + 1, abs=16 * 0.005) and found.gain > 1e9
    assert found.weights == pytest.approx((16,) * 6, abs=1e-9)
    alike = controlled(by_class, 5.0 * by_class, sample_of(np.array([5]), np.array([1210])), 4)
    assert (alike.mean, alike.gain, alike.sample.se) == (5, 1, 0)


def test_below_so_many_rollouts_and_without_the_sums_it_is_the_plain_mean() -> None:
    engine = engine_of(load_world_file(SCATTERED), 4)
    few, _ = run_by_luck(engine, 0, 0, LEAST - 1)
    assert tally_mean(few, "visited") == mean_estimate(few.visited, 1.0)
    half = run_by_luck(engine, 0, 0, LEAST)[0] + engine.tally(LEAST, LEAST)
    assert tally_mean(half, "time", 0.5, 10_000) == mean_estimate(half.time, 0.5, 10_000)
    assert complete_chance(half) == proportion(int(half.outcomes[0]), half.rollouts)


def test_what_was_not_seen_counts_as_without_the_control() -> None:
    """No run of 1,024 lost a robot, which one in a million does: the interval is as wide."""
    world = World.create([[0.0, 1e-6, 0.0]])
    tally, _ = run_by_luck(engine_of(world, 1), 0, 0, LEAST)
    assert int(tally.visited[3]) == LEAST
    for figure in ("visited", "survived", "time"):
        assert tally_mean(tally, figure).ci95 == pytest.approx(mean_estimate(getattr(tally, figure), 1.0).ci95)
    assert tally_mean(tally, "visited").half_width > 0


def estimates(tally: Tally) -> list[Estimate]:
    """Of all five figures."""
    return [*(tally_mean(tally, figure) for figure in FIGURES[:4]), complete_chance(tally)]


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
        whole, _ = run_by_luck(engine, 3, 500 + number * LEAST, LEAST)
        assert mine.ids == whole.ids and np.array_equal(mine.by_luck, whole.by_luck)
        assert estimates(mine) == estimates(whole)


def test_intervals_hold_and_are_sharper_on_one_world() -> None:
    """40 samples of 1,024 rollouts: within 3 standard errors below .95 in each figure."""
    share, gains = held(load_world_file(CONTIGUOUS), 8, "mrac", 40)
    assert (share >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / 40)).all(), dict(zip(FIGURES, share, strict=True))
    assert np.median(gains) > 10


def test_evaluate_goes_by_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", str(CONTIGUOUS), "--robots", "8", "--precision", "0.002", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["control"]["gain"]["visited"] > 10 and len(found["control"]["weights"]["visited"]) == 6
    tally = engine_of(load_world_file(CONTIGUOUS), 8).tally(0, found["rollouts"])
    plain = tally_mean(tally, "visited", 1.0 / tally.accessible)
    (low, high), (least, most) = plain.ci95, found["coverage"]["visited"]["ci95"]
    assert most - least <= 0.004 and 2 * (most - least) <= high - low and low < most and least < high
    assert found["best"]["visited"].items() <= found["coverage"]["visited"].items()


def test_the_deadline_s_and_other_threats_have_it_too() -> None:
    world = load_world_file(CONTIGUOUS)
    plan = make_plan(world, place_starts(world, 8)[0])
    choices = RolloutChoices(rollouts=2048, deadline=60)
    answer = evaluate(world, plan, choices, threat_scale=(0.5,))
    (scaled,), deadline = answer.outputs["threat_scale"].scaled, answer.outputs["deadline"]
    for tally, mine, least in (
        (scaled.tally, scaled.as_json()["coverage"]["visited"]["se"], 1.5),
        (deadline.tally, deadline.as_json()["visited"]["se"], 1.0),
    ):
        plain = replace(tally, by_luck=np.zeros(0, dtype=np.int64))
        assert mine < tally_mean(plain, "visited", 1.0 / tally.accessible).se / least


def test_differences_are_put_right_too() -> None:
    world = load_world_file(SCATTERED)
    starts = place_starts(world, 8)[0]
    plans = [make_plan(world, starts, Settings(policy=policy)) for policy in ("mrac", "per_cell")]
    answer = compare(*(make_side(world, plan, RolloutChoices(rollouts=4096)) for plan in plans))
    sums = [sides.reshape(-1, len(COLUMNS)) for sides in answer.by_luck]
    engines = [make_engine(plan, world, Rolling(), "numba").results(0, 4096) for plan in plans]
    y = (engines[1].visited - engines[0].visited) / answer.a.cells
    mean, error, variance = fitted(y, (luck_classes(0, 0, 4096, 8) + 0.5) / CLASSES_A_NAT, 8)
    found = answer.difference("visited")
    assert found.estimate.mean == pytest.approx(mean, rel=1e-9)
    assert found.estimate.se == pytest.approx(error, rel=1e-7) and variance < y.var()
    apart = answer.mean(answer.b, "visited") - answer.mean(answer.a, "visited")
    assert apart == pytest.approx(found.estimate.mean, rel=1e-9)
    assert found.gain > 10 and int(sums[0][:, 0].sum()) == 4096


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
    assert cells.shape == (13, 5)
    assert cells.min() >= 0.925, cells
    assert cells.mean() >= 0.945, cells
