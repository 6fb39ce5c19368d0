"""The survey of closed-loop worlds: it holds what it must, Theorem 2 holds on it, and the comparisons compare."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest
from closed_loop_compare import assert_same_results, assert_same_tally, assert_same_trace
from closed_loop_worlds import CELL_BUCKETS, KINDS, SurveyWorld, first_worlds, idle_at_start, survey_worlds

from planner.kernels.closed_loop import run_range
from planner.luck import Luck
from planner.mrac.problem import prepare
from planner.mrac.simulate import Run, simulate
from planner.plans.plan import Plan
from planner.tally import Outcome, RolloutResults, Tally
from planner.trace import Doing, EventKind, Trace

ROLLOUTS = 1000
SAMPLED = 3
"""Stuck rollouts of a world that the readable simulator runs again."""
DEMANDED = {"bisected": 10_000, "divided": 1_000, "stuck": 100, "all dead as it completes": 100, "idle at start": 100}
HASH = "d2d410c7212b302e31d81affb06791e0f86abaa7754e9b05602b181b7521443c"


@pytest.fixture(scope="module")
def survey() -> tuple[SurveyWorld, ...]:
    return survey_worlds()


def roll(one: SurveyWorld, plan: Plan, rollouts: int) -> RolloutResults:
    _, singles = run_range(one.loop(plan), one.seed, 0, rollouts, singles=True)
    assert singles is not None
    return singles


@pytest.fixture(scope="module")
def rolled(survey: tuple[SurveyWorld, ...]) -> list[tuple[SurveyWorld, Plan, RolloutResults]]:
    plans = [(one, one.plan()) for one in survey]
    return [(one, plan, roll(one, plan, ROLLOUTS)) for one, plan in plans]


# --- what the survey holds ---


def test_the_survey_is_the_same_everywhere(survey: tuple[SurveyWorld, ...]) -> None:
    assert hashlib.sha256("".join(one.digest() for one in survey).encode()).hexdigest() == HASH
    assert [one.digest() for one in survey_worlds.__wrapped__()] == [one.digest() for one in survey]


def test_the_survey_holds_every_kind_and_team_in_few_shapes(survey: tuple[SurveyWorld, ...]) -> None:
    assert len(survey) >= 200
    assert (
        len({one.name for one in survey}) == len({one.world.sha256 + str(one.starts) for one in survey}) == len(survey)
    )
    assert min(Counter(one.kind for one in survey).values()) >= 6
    assert {one.kind for one in survey} == set(KINDS)
    assert {one.robots for one in survey} == set(range(1, 21))
    assert {one.settings.risk for one in survey} == {"paper", "log"}
    assert {one.first_only for one in survey} == {True, False}
    assert len({one.settings.density for one in survey}) >= 4
    assert len({one.bucket for one in survey}) <= 9
    assert sum(one.bucket[0] < CELL_BUCKETS[-1] for one in survey) > len(survey) / 2


def test_every_kind_is_what_it_says(survey: tuple[SurveyWorld, ...]) -> None:
    def of(kind: str) -> list[SurveyWorld]:
        return [one for one in survey if one.kind == kind]

    def on_threat(one: SurveyWorld) -> bool:
        return bool((one.world.threat[tuple(one.starts.T)] > 0).all())

    assert all(one.accessible == 1 for one in of("one-cell"))
    assert all(one.robots > one.accessible for one in of("crowded"))
    assert all(np.nanmax(one.world.threat) == 0 for one in of("safe"))
    assert all(np.nanmin(one.world.threat) > 0 for one in of("deadly"))
    assert all(on_threat(one) for one in of("threatened"))
    assert all(len(np.unique(one.starts, axis=0)) < min(3, one.robots) for one in of("shared"))
    assert all(one.parts > 1 for one in of("disconnected"))
    assert all(max(one.world.shape) >= 4 * min(one.world.shape) for one in of("strips"))
    assert all(len(np.unique(one.world.threat)) > 16 for one in of("many-levels"))
    assert all((one.settings.max_steps is None) == (one.kind != "short") for one in survey)
    assert sum(one.world.shape[0] != one.world.shape[1] for one in survey) >= 100


def test_the_first_worlds_are_small_and_of_every_kind(survey: tuple[SurveyWorld, ...]) -> None:
    first = first_worlds(40)
    assert len(first) == 40
    assert {one.kind for one in first} == set(KINDS)
    assert {one.digest() for one in first} <= {one.digest() for one in survey}
    assert max(one.accessible for one in first) < CELL_BUCKETS[1]
    assert max(one.robots for one in first_worlds(30, robots=4)) == 4


@pytest.mark.slow
def test_the_survey_holds_what_is_rare(rolled: list[tuple[SurveyWorld, Plan, RolloutResults]]) -> None:
    counts: Counter[str] = Counter()
    for one, plan, results in rolled:
        completes = results.outcome == Outcome.COMPLETE
        counts["bisected"] += int((results.bisected > 0).sum())
        counts["divided"] += int((results.divided > 0).sum())
        counts["stuck"] += int((results.outcome == Outcome.STUCK).sum())
        # A map of one cell or two would make it too easy.
        counts["all dead as it completes"] += int((completes & (results.alive == 0)).sum()) * (one.accessible >= 10)
        counts["idle at start"] += ROLLOUTS * (idle_at_start(plan) > 0)
        counts["timeout"] += int((results.outcome == Outcome.TIMEOUT).sum())
    print(f"{len(rolled)} worlds x {ROLLOUTS} rollouts: {dict(counts)}")  # noqa: T201
    for name, least in DEMANDED.items():
        assert counts[name] >= least, name


# --- Theorem 2: complete, unless every robot that can reach the rest was stopped ---


def check_theorem_2(one: SurveyWorld, results: RolloutResults) -> None:
    """On every rollout, as far as its results tell; `check_stuck` has the rest."""
    everything = results.visited == one.accessible
    expected = {
        Outcome.COMPLETE: everything,
        Outcome.STOPPED: ~everything & (results.alive == 0),
        Outcome.STUCK: ~everything & (results.alive > 0) & (one.parts > 1),
        Outcome.TIMEOUT: ~everything & (results.alive > 0) & (results.time == (one.settings.max_steps or -1)),
    }
    for outcome, holds in expected.items():
        wrong = np.flatnonzero((results.outcome == outcome) & ~holds)
        assert len(wrong) == 0, f"{one.name} rollout {wrong[0]} ends {outcome.name}\n{one.world.threat.tolist()}"


def readable_run(one: SurveyWorld, plan: Plan, rollout: int) -> Run:
    problem = prepare(one.world, one.starts, one.settings)
    luck = Luck(one.world, one.seed, rollout)
    entered = np.zeros(one.world.threat.size, dtype=np.bool_)

    def hit(robot: int, step: int, cell: int) -> bool:
        fresh = not entered[cell]
        entered[cell] = True
        return (fresh or not one.first_only) and luck.hits(robot, step, cell)

    return simulate(problem, plan.areas, hit=hit)


def check_stuck(one: SurveyWorld, plan: Plan, results: RolloutResults) -> int:
    """In a sample of the stuck rollouts no robot left can reach an unvisited cell; how many were looked at."""
    sample = np.flatnonzero(results.outcome == Outcome.STUCK)[:SAMPLED]
    part = one.world.components().ravel()
    accessible = one.world.accessible(one.starts).ravel()
    for rollout in sample.tolist():
        run = readable_run(one, plan, rollout)
        assert run.outcome is Outcome.STUCK
        assert run.visited.sum() == results.visited[rollout]
        alive = {int(part[path[-1]]) for path, lives in zip(run.paths, run.alive, strict=True) if lives}
        left = set(part[accessible & ~run.visited].tolist())
        assert alive, (one.name, rollout)
        assert left, (one.name, rollout)
        assert not alive & left, f"{one.name} rollout {rollout}\n{one.world.threat.tolist()}"
    return len(sample)


def test_theorem_2_on_the_first_worlds() -> None:
    looked = 0
    for one in first_worlds(40):
        plan = one.plan()
        results = roll(one, plan, 200)
        check_theorem_2(one, results)
        looked += check_stuck(one, plan, results)
    assert looked >= SAMPLED


@pytest.mark.slow
def test_theorem_2_on_the_survey(rolled: list[tuple[SurveyWorld, Plan, RolloutResults]]) -> None:
    looked = 0
    for one, plan, results in rolled:
        check_theorem_2(one, results)
        looked += check_stuck(one, plan, results)
    assert looked >= 10 * SAMPLED


def test_theorem_2_is_not_taken_for_granted(survey: tuple[SurveyWorld, ...]) -> None:
    one = next(one for one in survey if one.parts == 1 and one.kind == "contiguous")
    for outcome in (Outcome.COMPLETE, Outcome.STOPPED, Outcome.STUCK, Outcome.TIMEOUT):
        number = np.array([1], dtype=np.int32)
        results = RolloutResults(0, number, number, number, number, np.array([outcome], dtype=np.int8))
        with pytest.raises(AssertionError, match=rf"{one.name} rollout 0 ends {outcome.name}"):
            check_theorem_2(one, results)


# --- the comparisons ---


def some_rollouts() -> tuple[Tally, RolloutResults]:
    one = next(one for one in first_worlds(40) if one.kind == "rooms")
    tally, singles = run_range(one.loop(), one.seed, 0, 50, singles=True)
    assert singles is not None
    return tally, singles


def changed(values: np.ndarray, at: int | tuple[int, ...]) -> np.ndarray:
    values = values.copy()
    values[at] += 1
    return values


def test_every_array_of_a_tally_is_compared() -> None:
    tally, _ = some_rollouts()
    later = replace(tally, time=np.pad(tally.time, (0, 5)), new_visited=np.pad(tally.new_visited, (0, 7)))
    assert_same_tally(tally, later)
    for name, counts in tally.counts().items():
        with pytest.raises(AssertionError, match=rf"here\n  {name}\[1\]: {counts[1]} and {counts[1] + 1} \(1 of \d+"):
            assert_same_tally(tally, replace(tally, **{name: changed(counts, 1)}), "here")
    for name, other in (("key", "no"), ("shape", (1, 2)), ("ids", ((0, 51),))):
        with pytest.raises(AssertionError, match=rf"  {name}: .* and .*{other if name == 'key' else ''}"):
            assert_same_tally(tally, replace(tally, **{name: other}))
    with pytest.raises(AssertionError, match=r"visited: shapes \(\d+,\) and \(\d+,\)"):
        assert_same_tally(tally, replace(tally, visited=tally.visited[:-1]))


def test_every_column_of_results_is_compared() -> None:
    _, results = some_rollouts()
    assert_same_results(results, replace(results))
    for name in [f.name for f in fields(RolloutResults)[1:]]:
        was = getattr(results, name)[7]
        with pytest.raises(AssertionError, match=rf"\n  {name}\[7\]: {was} and {was + 1} \(1 of 50"):
            assert_same_results(results, replace(results, **{name: changed(getattr(results, name), 7)}))
    with pytest.raises(AssertionError, match="start: 0 and 1"):
        assert_same_results(results, replace(results, start=1))


def test_every_part_of_a_trace_is_compared() -> None:
    cells, doing = np.array([[0, 3], [1, 4], [2, 4]], dtype=np.int32), np.full((3, 2), Doing.TRAVELING, dtype=np.int8)
    events = np.array([[1, 0, EventKind.COMPLETED, 2, 4], [2, 1, EventKind.HIT, 0, 4]], dtype=np.int32)
    trace = Trace(6, cells, doing, cells // 2, events, np.zeros(6, dtype=np.int32), Outcome.COMPLETE)
    assert_same_trace(trace, replace(trace, cells=cells.copy()))
    for changes, message in (
        ({"cells": changed(cells, (1, 0))}, r"rollout 6\n  cells \(step, robot\)\[1, 0\]: 1 and 2 \(1 of 6 differ\)"),
        ({"doing": changed(doing, (2, 1))}, r"doing .*\[2, 1\]: TRAVELING and COVERING"),
        ({"areas": changed(trace.areas, (0, 1))}, r"areas .*\[0, 1\]: 1 and 2"),
        ({"events": changed(events, (1, 3))}, r"events\[1\]: \(step 2, robot 1, HIT, area 0, other 4\) and .* area 1"),
        ({"events": events[:1]}, r"events\[1\]: \(step 2, .* and none"),
        ({"area_of": changed(trace.area_of, 5)}, r"area_of\[5\]: 0 and 1"),
        ({"outcome": Outcome.STOPPED}, "outcome: 'COMPLETE' and 'STOPPED'"),
        ({"rollout": 7}, "rollout: 6 and 7"),
        ({name: getattr(trace, name)[:2] for name in ("cells", "doing", "areas")}, "time: 2 and 1"),
    ):
        with pytest.raises(AssertionError, match=message):
            assert_same_trace(trace, replace(trace, **changes))  # type: ignore[arg-type]
