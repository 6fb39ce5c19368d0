"""The closed loop by enumeration against the fixtures' own enumeration, the closed form, and the rollouts."""

from __future__ import annotations

import pytest
from conftest import NAMES, Fixture, load_fixture

from analysis.enumeration import ClosedLoopExact, closed_loop_exact
from analysis.exact import open_loop_exact
from planner.planner import make_plan

ENUMERATED = [name for name in NAMES if "closed_loop_exact" in load_fixture(name).answers]
QUICK = [name for name in ENUMERATED if name.startswith("tiny") or name.endswith("k1")]


def enumerate_fixture(fixture: Fixture) -> ClosedLoopExact:
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    return closed_loop_exact(plan, fixture.world)


def check(name: str) -> None:
    fixture = load_fixture(name)
    found, known = enumerate_fixture(fixture), fixture.answers["closed_loop_exact"]
    for key, value in known.items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key
    assert found.remainder == 0


@pytest.mark.parametrize("name", QUICK)
def test_enumeration_is_the_fixtures(name: str) -> None:
    check(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ENUMERATED if name not in QUICK])
def test_enumeration_of_two_robots_is_the_fixtures(name: str) -> None:
    check(name)


def test_one_robot_has_the_closed_form() -> None:
    fixture = load_fixture("scattered-14x23-1000-k1")
    plan = make_plan(fixture.world, fixture.starts)
    found, exact = closed_loop_exact(plan, fixture.world), open_loop_exact(plan, fixture.world)
    assert found.visited == pytest.approx(exact.visited, abs=1e-9)
    assert found.survived == pytest.approx(exact.survived, abs=1e-9)


def test_stopping_early_says_what_is_left_out() -> None:
    fixture = load_fixture("contiguous-14x23-1000-k1")
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    known = fixture.answers["closed_loop_exact"]["visited"]
    for short in (
        closed_loop_exact(plan, fixture.world, most_runs=20),
        closed_loop_exact(plan, fixture.world, least=1e-3),
    ):
        assert 0 < short.remainder < 1
        assert short.visited <= known <= short.visited + short.remainder * 232
        total = short.complete + short.stopped + short.stuck + short.timeout + short.remainder
        assert total == pytest.approx(1.0, abs=1e-12)
