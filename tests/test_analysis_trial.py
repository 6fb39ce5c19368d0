"""What searches compare: exact against everything that can happen, sampled beside exact, the control, wear."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from oracle_tree import ClosedLoopExact, closed_loop_exact

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.estimators.trial import Trial
from analysis.sampling import RolloutChoices
from analysis.search.pareto import Ladders, find_front, settings_of
from analysis.search.place_reports import clear_headline as clear_said
from analysis.search.place_reports import starts_headline as starts_said
from analysis.search.reports import front_headline as front_said
from analysis.search.reports import size_headline as size_said
from analysis.search.start_positions import find_starts
from analysis.search.team_size import find_size, make_goal
from analysis.search.threat_removal import find_clearing
from analysis.statistics.estimates import Estimate
from analysis.theory.exact import Worth
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

RISKS = np.zeros((4, 6))
RISKS[1:3, 2:4], RISKS[3, 4:], RISKS[0, 5], RISKS[3, 1] = 0.3, 0.1, np.nan, 0.2
TINY = World.create(RISKS, starts=[[0, 0], [3, 0]])
CELLS = 23
WORLD = random_world(14, 14, ThreatPattern("contiguous", 4, (0.05, 0.1, 0.2), 3))
SAMPLED, AUTO = RolloutChoices(rollouts=4096, exact="never"), RolloutChoices(rollouts=4096)


@cache
def everything(starts: tuple[tuple[int, int], ...], settings: Settings, world: World = TINY) -> ClosedLoopExact:
    """By the readable simulator, which shares no code with the compiled tree."""
    return closed_loop_exact(make_plan(world, np.array(starts), settings), world)


def placed(starts: np.ndarray) -> tuple[tuple[int, int], ...]:
    return tuple(map(tuple, starts.tolist()))


def close(one: Estimate, other: Estimate, slack: float = 0.0) -> bool:
    """Within 4 standard errors, and what an exact value leaves open."""
    return abs(one.mean - other.mean) <= 4 * np.hypot(one.se, other.se) + slack


def test_a_front_is_everything_that_can_happen() -> None:
    found = find_front(TINY, TINY.starts, Settings(), AUTO, ladders=Ladders((0.5,), (3.0, 8.0), (0.4, 0.7)))
    assert not found.engine
    assert found.to_json()["exact"] is True
    assert front_said(found).endswith("on average (exact).")
    assert len(found.points) > 5
    for point in found.points:
        settings = settings_of(Settings(), point.setting)
        truth = everything(placed(TINY.starts), settings)
        assert point.coverage.mean == pytest.approx(truth.visited / CELLS, abs=1e-6)
        assert point.losses.mean == pytest.approx(2 - truth.alive, abs=1e-6)
        assert point.time.mean == pytest.approx(truth.time, abs=1e-4)
        assert point.coverage.half_width == point.losses.half_width == 0
    assert found.priced == found.corners()


@pytest.mark.parametrize("depot", [True, False])
def test_starts_are_everything_that_can_happen(depot: bool) -> None:
    found = find_starts(TINY, 2, Settings(), AUTO, depot=depot, candidates=[[0, 0], [3, 0], [2, 5], [1, 3]])
    assert not found.rolled
    assert "(exact)" in starts_said(found)
    means = {}
    for place in found.places:
        truth = everything(placed(place.starts), Settings())
        means[place.starts.tobytes()] = truth.visited / CELLS
        assert place.coverage is not None
        assert place.losses is not None
        assert place.coverage.mean == pytest.approx(truth.visited / CELLS, abs=1e-6)
        assert place.losses.mean == pytest.approx(2 - truth.alive, abs=1e-6)
    best = found.places[found.best]
    able = [place for place in found.places if place.is_depot or not depot]
    top = max(means[place.starts.tobytes()] for place in able)
    assert means[best.starts.tobytes()] == pytest.approx(top, abs=1e-6)
    for place in found.places:
        gap = means[best.starts.tobytes()] - means[place.starts.tobytes()]
        assert place is best or place.behind == pytest.approx((gap, gap), abs=1e-6)
    assert found.confirmed is None or found.confirmed.rollouts == 0


def test_what_to_clear_is_everything_that_can_happen() -> None:
    found = find_clearing(TINY, TINY.starts, Settings(), AUTO)
    at, plan = placed(TINY.starts), make_plan(TINY, TINY.starts, Settings())
    base = everything(at, Settings())
    assert not found.engine
    assert "(exact)" in clear_said(found)
    gains = []
    for one in found.options:
        cleared = one.threat.cleared(TINY)
        anew = everything(at, Settings(), cleared)
        assert one.known is not None
        assert one.known.cells.mean == pytest.approx(anew.visited - base.visited, abs=1e-5)
        assert one.known.robots.mean == pytest.approx(anew.alive - base.alive, abs=1e-5)
        assert one.known.rollouts == one.unknown.rollouts == 0
        old = Trial(TINY, plan, replace(SAMPLED, rollouts=60_000)).under(cleared).sample(0, 60_000)
        was = Trial(TINY, plan, SAMPLED).sample(0, 60_000)
        assert close(one.unknown.cells, old.ahead(was, "visited"))
        gains.append(anew.visited)
    assert found.gain is not None
    assert found.gain.cells.mean == pytest.approx(max(gains) - base.visited, abs=1e-5)
    hits = sum(one.hits for one in found.options)
    assert hits == pytest.approx(2 - base.alive, abs=1e-5)


@pytest.mark.parametrize("meaning", ["visited", "survived"])
@pytest.mark.parametrize("confidence", [None, 0.5])
def test_the_size_of_a_team_is_everything_that_can_happen(meaning: str, confidence: float | None) -> None:
    goal = make_goal(0.8, confidence, False, meaning, most=2)  # type: ignore[arg-type]
    found = find_size(TINY, Settings(), goal, AUTO)
    looked_at = [point for point in found.points if point.coverage is not None]
    assert looked_at
    for point in looked_at:
        truth = everything(placed(TINY.starts[: point.robots]), Settings())
        assert point.exact
        assert point.rollouts == 0
        assert point.coverage is not None
        assert point.chance is not None
        assert point.coverage.mean == pytest.approx(getattr(truth, meaning) / CELLS, abs=1e-6)
        often = getattr(truth, f"{meaning}_chance")[found.needed :].sum()
        assert point.chance.mean == pytest.approx(often, abs=1e-6)
        wanted = often if confidence else getattr(truth, meaning) / CELLS
        assert (point.verdict.value == "enough") == (wanted >= goal.wanted)
    assert "exact" in size_said(found)
    assert found.confirmed is None


@pytest.mark.parametrize("robots", [2, 3])
def test_exact_answers_are_those_that_are_sampled(robots: int) -> None:
    starts = place_starts(WORLD, robots)[0]
    for ladders in (Ladders((0.5,), (5.0, 20.0), (0.5,)),):
        exact, rolled = (find_front(WORLD, starts, Settings(), how, ladders=ladders) for how in (AUTO, SAMPLED))
        known = {point.setting: point for point in exact.points}
        both = [(known[point.setting], point) for point in rolled.points if point.setting in known]
        assert len(both) > 4
        for one, other in both:
            assert one.exact
            assert other.exact == (other.losses.mean == 0)
            assert close(one.coverage, other.coverage, 1e-4)
            assert close(one.losses, other.losses, 1e-4)
            assert close(one.time, other.time, 0.1)
            assert one.least >= other.least - 1e-4
            assert one.most <= other.most + 1e-4
    exact_places, rolled_places = (find_starts(WORLD, robots, Settings(), how, depot=True) for how in (AUTO, SAMPLED))
    for one_place, other_place in zip(exact_places.places, rolled_places.places, strict=True):
        if one_place.coverage is not None and other_place.coverage is not None:
            assert close(one_place.coverage, other_place.coverage, 1e-4)
    cleared, uncleared = (find_clearing(WORLD, starts, Settings(), how) for how in (AUTO, SAMPLED))
    assert not cleared.engine
    assert uncleared.engine
    for one_gain, other_gain in zip(cleared.options, uncleared.options, strict=True):
        assert one_gain.hits == pytest.approx(other_gain.hits, abs=0.05)
        assert close(one_gain.unknown.cells, other_gain.unknown.cells, 0.02)
        if other_gain.known is not None and one_gain.known is not None:
            assert close(one_gain.known.cells, other_gain.known.cells, 0.02)
    goal = make_goal(0.99, None, False, most=robots)
    sizes = [find_size(WORLD, Settings(), goal, how) for how in (AUTO, SAMPLED)]
    for one_point, other_point in zip(*(size.points for size in sizes), strict=True):
        if one_point.coverage is not None and other_point.coverage is not None:
            assert one_point.chance is not None
            assert other_point.chance is not None
            assert close(one_point.coverage, other_point.coverage, 1e-4)
            assert close(one_point.chance, other_point.chance, 1e-4)


def test_value_is_known_too() -> None:
    value = np.where(np.arange(14) >= 7, 7.5, 1.0) * np.ones((14, 1))
    valued = WORLD.with_values(value)
    plan = make_plan(valued, place_starts(valued, 2)[0], Settings())
    trial, worth = Trial(valued, plan, AUTO), Worth.of(valued)
    known, rolled = trial.known(), trial.sample(0, 20_000)
    assert known is not None
    assert known.counted == rolled.counted == "value"
    assert close(known.mean("value"), rolled.mean("value"))
    by_cell = rolled.tally.covered_visited / rolled.rollouts @ worth.value / worth.total
    assert rolled.share == pytest.approx(by_cell, abs=1e-9)
    other = Trial(valued, make_plan(valued, plan.starts, Settings(policy="per_cell")), AUTO)
    apart = other.known()
    assert apart is not None
    assert close(apart.ahead(known, "value"), other.sample(0, 20_000).ahead(rolled, "value"))


def test_what_is_sampled_is_put_right_by_its_luck() -> None:
    """Means, value and differences: nearer to the exact ones than their own rollouts, and closer intervals."""
    valued = WORLD.with_values(np.arange(196.0).reshape(14, 14))
    starts = place_starts(valued, 3)[0]
    plans = [make_plan(valued, starts, Settings(policy=policy)) for policy in ("mrac", "per_cell")]
    one, other = (Trial(valued, plan, AUTO).sample(0, 4096) for plan in plans)
    plain = replace(one, seed=None)
    assert one.mean("value").se < 0.8 * plain.mean("value").se
    apart, raw = one.ahead(other, "value"), plain.ahead(replace(other, seed=None), "value")
    assert apart.se < raw.se
    exact = [Trial(valued, plan, AUTO).known() for plan in plans]
    assert exact[0] is not None
    assert exact[1] is not None
    assert close(exact[0].mean("value"), one.mean("value"), 1e-4)
    assert close(exact[0].ahead(exact[1], "value"), apart, 2e-4)
    assert close(exact[0].ahead(exact[1], "visited"), one.ahead(other, "visited"), 0.04)
    few = one.__class__(one.tally, one.results, None)
    assert few.ahead(other, "visited").se >= one.ahead(other, "visited").se


def test_how_long_exact_values_are_looked_for() -> None:
    starts = place_starts(WORLD, 3)[0]
    trial = Trial(WORLD, make_plan(WORLD, starts, Settings()), AUTO)
    assert trial.known(1e-4) is None
    assert trial.known() is not None
    assert Trial(WORLD, trial.plan, SAMPLED).known() is None
    clear = Trial(World.create(np.zeros((3, 4))), make_plan(World.create(np.zeros((3, 4))), [[0, 0]]), SAMPLED)
    assert clear.known() is not None
    quick = find_starts(WORLD, 3, Settings(), replace(AUTO, exact=0.001), depot=True)
    assert all(place.rollouts for place in quick.simulated)


def test_robots_that_wear_and_differ(capsys: pytest.CaptureFixture[str], tmp_path) -> None:  # type: ignore[no-untyped-def]
    """By starts and clear too; exact and sampled alike, in Python and on the command line."""
    bears = {"wear": 2.0, "susceptibility": (1.0, 3.0)}
    for search in (
        lambda how: mrac.starts(WORLD, 2, candidates=[[0, 0], [0, 5], [13, 13]], exact=how, **bears),
        lambda how: mrac.clear(WORLD, 2, exact=how, **bears),
    ):
        exact, rolled = search("auto"), search("never")
        assert exact.engine == ""
        assert rolled.engine
        assert any("screened as if it were not for robots that wear" in note for note in exact.notes)
        if isinstance(exact.to_json().get("gain"), dict) and "threats" in exact.to_json():
            for one, other in zip(exact.options, rolled.options, strict=True):
                assert close(one.unknown.cells, other.unknown.cells, 0.02)
        else:
            for one, other in zip(exact.places, rolled.places, strict=True):
                assert close(one.coverage, other.coverage, 1e-4)
    front = mrac.front(WORLD, 2, worths=[8], reserves=[], **bears)
    plain = mrac.front(WORLD, 2, worths=[8], reserves=[])
    assert front.points[0].coverage.mean != plain.points[0].coverage.mean
    sampled = mrac.front(WORLD, 2, worths=[8], reserves=[], exact="never", rollouts=2000)
    truth = {point.setting: point for point in plain.points}
    same = [point for point in sampled.points if point.setting in truth]
    assert same
    assert all(close(truth[point.setting].coverage, point.coverage, 1e-4) for point in same)
    WORLD.save(tmp_path / "world.npz")
    words = ["starts", str(tmp_path / "world.npz"), "--robots", "2", "--wear", "2", "--susceptibility", "1,3", "--json"]
    assert run(words) == 0
    assert json.loads(capsys.readouterr().out)["exact"] is True


def test_what_an_exact_tree_knows_of_cells_is_shown() -> None:
    """Beside an exact mean no cell's chance, no curve is one of rollouts; Theorem 2 holds of all that was followed."""
    world = random_world(12, 12, ThreatPattern("scattered", 5, (0.05, 0.1, 0.2), 3))
    for robots in (1, 2, 3):
        exact, rolled = (
            mrac.evaluate(world, robots, rollouts=20_000, exact=how, advice=False, band=False, bound=False)  # type: ignore[arg-type]
            for how in ("auto", "never")
        )
        assert exact.how_known == "closed loop, exact"
        known, seen = exact.expected, rolled.tally
        chance, n = known.visited_by_cell, seen.rollouts
        error = np.sqrt(np.maximum(chance * (1 - chance), 1e-4) / n)
        assert (np.abs(seen.covered_visited / n - chance) <= 5 * error + 1e-4).all()
        assert (np.abs(seen.stops / n - known.stops_by_cell) <= 5 * np.sqrt(1e-4 + known.stops_by_cell / n)).all()
        curve = np.cumsum(seen.new_visited) / n
        shared = min(len(curve), len(known.visited_curve))
        assert known.visited_curve[:shared] == pytest.approx(curve[:shared], abs=0.6)
        assert exact.closed is not None
        assert known.visited == pytest.approx(exact.closed.visited.value, abs=0.01)
        theorem = [check for check in mrac.check(world, mrac.plan(world, robots)).checks if check.formula == "theorem2"]
        assert [str(check.verdict) for check in theorem] == ["holds"]
