"""The open loop as a control variate: right on average, sharper, and a pure function of what was run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from analysis.evaluation.outputs.control_variate import ControlVariate
from conftest import FOLDER
from scipy import stats

from analysis.cli.app import run
from analysis.evaluation.evaluate import evaluate
from analysis.sampling import RolloutChoices
from analysis.statistics.control import Paired, controlled, difference
from analysis.statistics.estimate import mean_estimate
from analysis.theory.enumeration import closed_loop_exact
from planner.mrac.make_plan import make_plan
from planner.threefry import uniform
from planner.worlds.starts import place_starts
from planner.worlds.world import World, load_world_file

WORLD = FOLDER / "contiguous-14x23-1000.npz"


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
    large = np.full(4, 2**31 - 1)
    assert Paired.of(large, large).xx == 4 * (2**31 - 1) ** 2


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


def test_the_controlled_mean_is_the_regression_s() -> None:
    x, y = draws(1000)
    known = 19.5
    found = controlled(Paired.of(x, y), known, 40, 0.5)
    slope, intercept = np.polyfit(y, x, 1)
    assert found.weight == pytest.approx(slope)
    assert found.estimate.mean == pytest.approx(0.5 * (intercept + slope * known))
    assert found.gain == pytest.approx(1 / (1 - np.corrcoef(x, y)[0, 1] ** 2))


def test_a_difference_is_that_of_the_rollouts() -> None:
    x, y = draws(1000)
    found = difference(Paired.of(x, y), 0.5, 2.0, 80.0)
    apart = 2.0 * y - 0.5 * x
    assert found.estimate.mean == pytest.approx(apart.mean())
    assert found.estimate.se == pytest.approx(apart.std(ddof=1) / np.sqrt(1000))
    unseen = 40.0 * -np.log(0.025) / 1000  # no rollout differed: the rule of three
    assert difference(Paired.of(x, x), 1.0, 1.0, 40.0).estimate.ci95 == pytest.approx((-unseen, unseen))


def test_the_interval_of_a_controlled_mean_holds_as_often_as_it_says() -> None:
    """10,000 samples of 400: both the controlled mean's interval and the difference's, within 3 standard errors."""
    repeats, n = 10_000, 400
    ids, at = np.arange(repeats)[:, None], np.arange(n)[None]
    own, other, shared = (uniform(11, ids, at, robot) for robot in range(3))
    xs, ys = (20 * (own + shared)).astype(int), (30 * (other + shared)).astype(int)
    mean_x, mean_y = 19.5, 29.5  # the two uniforms' mean, less the half that rounding down takes
    held = np.zeros(2)
    for x, y in zip(xs, ys, strict=True):
        pairs = Paired.of(x, y)
        low, high = controlled(pairs, mean_y, 59, 1.0).estimate.ci95
        held[0] += low <= mean_x <= high
        low, high = difference(pairs, 1.0, 1.0, 59.0).estimate.ci95
        held[1] += low <= mean_y - mean_x <= high
    assert np.all(np.abs(held / repeats - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / repeats)), held


def test_two_robots_halve_the_variance_and_keep_the_mean() -> None:
    world = load_world_file(WORLD)
    plan = make_plan(world, place_starts(world, 2)[0])
    answer = evaluate(world, plan, RolloutChoices(rollouts=16_384, seed=5, control=True))
    truth = closed_loop_exact(plan, world)
    sharper = answer.output(ControlVariate)
    assert sharper is not None
    for found, meaning in zip(sharper.means, ("visited", "survived"), strict=True):
        exact = getattr(truth, meaning).middle / answer.tally.accessible
        assert found.gain > 1.5
        assert abs(found.estimate.mean - exact) <= 4 * found.estimate.se
    assert sharper.means[0].estimate.se < mean_estimate(answer.tally.visited, 1 / answer.tally.accessible).se / 1.2


def test_one_robot_needs_no_luck() -> None:
    world = load_world_file(WORLD)
    plan = make_plan(world, place_starts(world, 1)[0])
    answer = evaluate(world, plan, RolloutChoices(rollouts=4096, control=True))
    sharper = answer.output(ControlVariate)
    assert sharper is not None and answer.closed is not None
    visited = sharper.means[0]
    assert (visited.weight, visited.gain) == (1.0, np.inf)
    assert visited.estimate.mean * answer.tally.accessible == pytest.approx(answer.closed.visited.value, rel=1e-12)


@pytest.mark.usefixtures("few_lanes")
def test_the_control_is_the_same_in_both_engines() -> None:
    world = World.create(np.where(np.indices((5, 6)).sum(axis=0) % 3 == 1, 0.2, 0.0))
    plan = make_plan(world, [[0, 0], [4, 5], [0, 5]])
    found = [
        evaluate(world, plan, RolloutChoices(rollouts=512, seed=2, control=True, engine=engine)).output(ControlVariate)
        for engine in ("numba", "jax")
    ]
    assert found[0] == found[1]


def test_the_command_reports_the_gain_and_stops_earlier(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", str(WORLD), "--robots", "2", "--precision", "0.0008", "--seed", "1"]
    assert run([*words, "--json"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert run([*words, "--json", "--control-variate"]) == 0
    sharper = json.loads(capsys.readouterr().out)
    assert sharper["rollouts"] < plain["rollouts"]
    control = sharper["control_variate"]["visited"]
    assert control["gain"] > 1.5
    assert (control["ci95"][1] - control["ci95"][0]) / 2 < 0.0008
    assert run(["evaluate", str(WORLD), "--robots", "3", "--rollouts", "512", "--control-variate"]) == 0
    assert "times smaller" in capsys.readouterr().out
    assert run(["evaluate", str(WORLD), "--loop", "open", "--control-variate"]) == 2
    assert "leave it out" in capsys.readouterr().err
