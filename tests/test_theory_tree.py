"""The tree of everything that can happen against the fixtures' enumeration, runs from the start, and rollouts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture, worlds_with_starts
from doubt import expected
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle_tree import ClosedLoopExact, closed_loop_exact
from test_house import imports_of

from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import simulate
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.tally import Outcome
from planner.world.world import World

QUICK = ("tiny", "contiguous-14x23-1001", "scattered-20x20-1001-k1")
ENUMERATED = [
    pytest.param(name, marks=() if name.startswith(QUICK) else pytest.mark.slow)
    for name in NAMES
    if "closed_loop_exact" in load_fixture(name).answers
]


def plan_of(fixture: Fixture) -> Plan:
    return make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)


@cache
def exact_of(name: str) -> ClosedLoopExact:
    """Of a fixture's plan, all of it."""
    fixture = load_fixture(name)
    return closed_loop_exact(plan_of(fixture), fixture.world)


class TooMany(Exception):
    """More patterns of hits than a test plays."""


def chances_from_the_start(plan: Plan, world: World, first_only: bool, most: int) -> tuple[list[np.ndarray], int]:
    """Chances by outcome, cells visited, survived, time and robots alive, each pattern of hits a run from t = 0.

    And how many patterns there are. Raises TooMany of more than `most`.
    """
    problem, threat = prepare(world, plan.starts, plan.settings or Settings()), world.threat.ravel()
    sizes = (len(Outcome), threat.size + 1, threat.size + 1, problem.max_steps + 1, len(plan.robots) + 1)
    played = 0

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        nonlocal played
        played += 1
        if played > most:
            raise TooMany
        run = simulate(problem, plan.areas, hit=hit)
        found = (run.outcome, run.visited.sum(), run.survived.sum(), run.time, run.alive.sum())
        return np.concatenate([np.eye(size)[int(value)] for size, value in zip(sizes, found, strict=True)])

    def draw(chance: Callable[[float], bool], entered: dict, cell: int) -> bool:
        again = cell in entered
        entered[cell] = True
        return not (first_only and again) and chance(float(threat[cell]))

    return np.split(expected(play, draw), np.cumsum(sizes)[:-1]), played


def assert_exactly(found: ClosedLoopExact, known: dict[str, float]) -> None:
    for key, value in known.items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key


@pytest.mark.parametrize("name", ENUMERATED)
def test_enumeration_is_the_fixtures(name: str) -> None:
    found = exact_of(name)
    assert_exactly(found, load_fixture(name).answers["closed_loop_exact"])
    for chance, value in (
        (found.visited_chance, found.visited),
        (found.survived_chance, found.survived),
        (found.alive_chance, found.alive),
        (found.time_chance, found.time),
    ):
        assert chance.sum() == pytest.approx(1.0, abs=1e-9)
        assert chance @ np.arange(len(chance)) == pytest.approx(value, abs=1e-9)


@settings(max_examples=70)
@given(
    worlds_with_starts(most_side=5, most_robots=4),
    st.sampled_from([None, 1, 2, 3, 5, 8]),
    st.sampled_from(["grid", "area"]),
    st.booleans(),
)
def test_forking_is_running_every_pattern_from_the_start(given_world, max_steps, transit, first_only) -> None:
    world, starts = given_world
    plan = make_plan(world, starts, Settings(max_steps=max_steps, transit=transit))
    try:
        (outcomes, *columns), played = chances_from_the_start(plan, world, first_only, most=150)
    except TooMany:
        return
    found = closed_loop_exact(plan, world, first_only=first_only)
    assert found.ends <= played
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS, Outcome.STEP_LIMIT):
        assert getattr(found, outcome.word) == pytest.approx(outcomes[outcome], abs=1e-12)
    chances = (found.visited_chance, found.survived_chance, found.time_chance, found.alive_chance)
    for chance, column in zip(chances, columns, strict=True):
        np.testing.assert_allclose(chance, column[: len(chance)], rtol=0, atol=1e-12)
        assert not column[len(chance) :].any()


def test_equal_states_are_joined() -> None:
    """tiny-2x8-25: 115 patterns, many of which lead to the same state."""
    fixture = load_fixture("tiny-2x8-25-k5")
    _, played = chances_from_the_start(plan_of(fixture), fixture.world, False, most=1000)
    assert closed_loop_exact(plan_of(fixture), fixture.world).ends < played == 115


def test_plans_that_have_no_closed_loop_are_refused() -> None:
    world = World.create([[0.0, 0.1]])
    with pytest.raises(PlanError, match="another map"):
        closed_loop_exact(make_plan(world, [[0, 0]]), World.create([[0.0, 0.2]]))


def test_the_oracles_see_no_engine() -> None:
    """`test_house` looks at those of `analysis.theory`."""
    for path in Path(__file__).parent.glob("oracle_*.py"):
        engines = ("planner.rollouts", "planner.simulator", "mrac_jax", "jax")
        assert not [module for module in imports_of(path) if module.startswith(engines)]
