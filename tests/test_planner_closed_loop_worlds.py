"""The survey of closed-loop worlds: it holds what it must, Theorem 2 holds on it, and the comparisons compare."""

from __future__ import annotations

import hashlib
from collections import Counter

import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds, idle_at_start, survey_worlds

from planner.mrac.problem import prepare
from planner.mrac.simulate import Run, simulate
from planner.plan.plan import Plan
from planner.rollout_sampling import Luck
from planner.simulator.closed_loop import run_range
from planner.tally import Outcome, RolloutResults

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


@pytest.mark.slow
def test_the_survey_holds_what_is_rare(rolled: list[tuple[SurveyWorld, Plan, RolloutResults]]) -> None:
    counts: Counter[str] = Counter()
    for one, plan, results in rolled:
        completes = results.outcome == Outcome.COMPLETE
        counts["bisected"] += int((results.bisected > 0).sum())
        counts["divided"] += int((results.divided > 0).sum())
        counts["stuck"] += int((results.outcome == Outcome.NO_PROGRESS).sum())
        # A map of one cell or two would make it too easy.
        counts["all dead as it completes"] += int((completes & (results.alive == 0)).sum()) * (one.accessible >= 10)
        counts["idle at start"] += ROLLOUTS * (idle_at_start(plan) > 0)
        counts["timeout"] += int((results.outcome == Outcome.STEP_LIMIT).sum())
    print(f"{len(rolled)} worlds x {ROLLOUTS} rollouts: {dict(counts)}")  # noqa: T201
    for name, least in DEMANDED.items():
        assert counts[name] >= least, name


# --- Theorem 2: complete, unless every robot that can reach the rest was stopped ---


def check_theorem_2(one: SurveyWorld, results: RolloutResults) -> None:
    """On every rollout, as far as its results tell; `check_stuck` has the rest."""
    everything = results.visited == one.accessible
    expected = {
        Outcome.COMPLETE: everything,
        Outcome.ALL_ROBOTS_LOST: ~everything & (results.alive == 0),
        Outcome.NO_PROGRESS: ~everything & (results.alive > 0) & (one.parts > 1),
        Outcome.STEP_LIMIT: ~everything & (results.alive > 0) & (results.time == (one.settings.max_steps or -1)),
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
    sample = np.flatnonzero(results.outcome == Outcome.NO_PROGRESS)[:SAMPLED]
    part = one.world.components.ravel()
    accessible = one.world.accessible(one.starts).ravel()
    for rollout in sample.tolist():
        run = readable_run(one, plan, rollout)
        assert run.outcome is Outcome.NO_PROGRESS
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
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS, Outcome.STEP_LIMIT):
        number = np.array([1], dtype=np.int32)
        results = RolloutResults(0, number, number, number, number, np.array([outcome], dtype=np.int8))
        with pytest.raises(AssertionError, match=rf"{one.name} rollout 0 ends {outcome.name}"):
            check_theorem_2(one, results)
