"""The compiled classical simulator against the fixtures' exact means and an independent simulator's samples, at length.

All five means that the fixtures give: cells visited and survived, time, robots alive, and the share of rollouts that
cover everything; where they are exact, also the shares of the other two endings.
"""

from __future__ import annotations

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture
from numpy.typing import NDArray

from analysis.statistics.estimates import mean_estimate
from planner.mrac.make_plan import make_plan
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.tally import Outcome, Tally

EXACT = [name for name in NAMES if "closed_loop_exact" in load_fixture(name).answers]
SAMPLED = [name for name in NAMES if "closed_loop_sampled" in load_fixture(name).answers]
TEAMS = [name for name in SAMPLED if name.endswith("k8")]
SIGMAS = 5


def histograms(tally: Tally) -> dict[str, NDArray[np.int64]]:
    """Rollouts by value, of everything whose mean a fixture may give."""
    counts = {name: getattr(tally, name) for name in ("visited", "survived", "time", "alive")}
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS):
        count = int(tally.outcomes[outcome])
        counts[outcome.word] = np.array([tally.rollouts - count, count])
    return counts


def z_scores(fixture: Fixture, rollouts: int) -> dict[str, float]:
    """How far our means are from the fixture's, in (combined) standard errors.

    Ours is at least what one rollout may make: otherwise a value that never varied would forbid the rarest event.
    """
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    tally, _ = run_range(compile_closed_loop(plan, fixture.world), 14, 0, rollouts)
    known = fixture.answers.get("closed_loop_exact") or fixture.answers["closed_loop_sampled"]
    scores = {}
    for name, counts in histograms(tally).items():
        if name in known:
            mean, se = known[name] if isinstance(known[name], list) else (known[name], 0.0)
            mine, one_rollout = mean_estimate(counts, 1.0), max(len(counts) - 1, 1) / rollouts
            scores[name] = (mine.mean - mean) / float(np.hypot(max(mine.se, one_rollout), se))
    return scores


def largest(names: list[str], rollouts: int) -> tuple[float, str]:
    """The largest z-score of all means of these fixtures, without its sign, and whose it is. Each gives at least five.

    Raises AssertionError if a fixture gives fewer.
    """
    scores = {}
    for name in names:
        found = z_scores(load_fixture(name), rollouts)
        assert {"visited", "survived", "time", "alive", "complete"} <= set(found), name
        scores |= {f"{name}, {meaning}": abs(score) for meaning, score in found.items()}
    worst = max(scores, key=scores.__getitem__)
    return scores[worst], worst


def test_two_teams_are_as_sampled() -> None:
    for kind in ("contiguous", "scattered"):
        score, whose = largest([next(name for name in TEAMS if name.startswith(kind))], 16_384)
        assert score <= SIGMAS, whose


def test_hand_sized_worlds_are_exact() -> None:
    score, whose = largest([name for name in EXACT if name.startswith("tiny")], 65_536)
    assert score <= SIGMAS, whose


def test_another_world_s_means_are_not_accepted() -> None:
    one, other = (load_fixture(f"contiguous-14x23-100{number}-k8") for number in (0, 1))
    answers = {**other.answers, "starts": one.answers["starts"]}
    scores = z_scores(Fixture(one.name, one.world, one.allocation, answers), 4096)
    assert min(abs(scores[meaning]) for meaning in ("visited", "survived", "time")) > SIGMAS


AT_LENGTH = {
    "teams of eight": (TEAMS, 200_000),
    "one robot": ([name for name in EXACT if name.endswith("k1") and not name.startswith("tiny")], 1_000_000),
    "two robots": ([name for name in EXACT if name.endswith("k2") and not name.startswith("tiny")], 1_000_000),
    "hand-sized worlds": ([name for name in EXACT if name.startswith("tiny")], 1_000_000),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", AT_LENGTH)
def test_means_at_length(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    names, rollouts = AT_LENGTH[what]
    assert len(names) >= 12
    score, whose = largest(names, rollouts)
    with capsys.disabled():
        print(f"\n{what}, {len(names)} x {rollouts:,} rollouts: the largest |z| is {score:.2f} ({whose})")  # noqa: T201
    assert score <= SIGMAS, whose
