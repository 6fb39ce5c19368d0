"""The tree of everything that can happen against the fixtures' enumeration, runs from the start, and rollouts."""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture, worlds_with_starts
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle_tree import ClosedLoopExact, closed_loop_exact
from test_house import imports_of

from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import Run, simulate
from planner.plans.plan import Plan
from planner.settings import Settings
from planner.worlds.world import World

QUICK = ("tiny", "contiguous-14x23-1001", "scattered-20x20-1001-k1")
ENUMERATED = [
    pytest.param(name, marks=() if name.startswith(QUICK) else pytest.mark.slow)
    for name in NAMES
    if "closed_loop_exact" in load_fixture(name).answers
]
Pattern = tuple[float, str, int, int, int, int]
"""(chance, outcome, visited, survived, time, alive) of one pattern of hits."""


def plan_of(fixture: Fixture) -> Plan:
    return make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)


@cache
def exact_of(name: str) -> ClosedLoopExact:
    """Of a fixture's plan, all of it."""
    fixture = load_fixture(name)
    return closed_loop_exact(plan_of(fixture), fixture.world)


def patterns_from_the_start(plan: Plan, world: World, first_only: bool, most: int) -> list[Pattern] | None:
    """Every pattern of hits, each a run of its own from t = 0; None if there are more than `most`."""
    assert plan.settings is not None
    problem = prepare(world, plan.starts, plan.settings)
    branches: list[tuple[tuple[int, ...], float]] = [((), 1.0)]
    patterns: list[Pattern] = []
    while branches:
        hits, chance = branches.pop()
        run, threats = scripted_run(problem, plan, hits, first_only)
        for check in range(hits[-1] + 1 if hits else 0, len(threats)):
            branches.append(((*hits, check), chance * threats[check]))
            chance *= 1.0 - threats[check]
        covered = int(run.visited.sum()), int(run.survived.sum())
        patterns.append((chance, run.outcome.name.lower(), *covered, run.time, int(run.alive.sum())))
        if len(patterns) + len(branches) > most:
            return None
    return patterns


def scripted_run(problem, plan: Plan, hits: tuple[int, ...], first_only: bool) -> tuple[Run, list[float]]:
    """The run in which exactly the hit checks `hits` stop a robot, and the threat of every check that it made."""
    threat = problem.world.threat.ravel().astype(np.float64)
    checked: list[float] = []
    entered: set[int] = set()

    def hit(robot: int, step: int, cell: int) -> bool:
        again = cell in entered
        entered.add(cell)
        if threat[cell] == 0 or (first_only and again):
            return False
        checked.append(float(threat[cell]))
        return len(checked) - 1 in hits

    run = simulate(problem, plan.areas, hit=hit)
    return run, checked


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
    patterns = patterns_from_the_start(plan, world, first_only, most=150)
    if patterns is None:
        return
    found = closed_loop_exact(plan, world, first_only=first_only)
    assert found.ends <= len(patterns)
    outcomes: Counter[str] = Counter()
    columns = (Counter[int](), Counter[int](), Counter[int](), Counter[int]())
    for chance, outcome, *values in patterns:
        outcomes[outcome] += chance  # type: ignore[assignment]
        for column, value in zip(columns, values, strict=True):
            column[value] += chance  # type: ignore[assignment]
    for outcome in ("complete", "stopped", "stuck", "timeout"):
        assert getattr(found, outcome) == pytest.approx(outcomes[outcome], abs=1e-12)
    chances = (found.visited_chance, found.survived_chance, found.time_chance, found.alive_chance)
    for chance, column in zip(chances, columns, strict=True):
        expected = np.zeros(len(chance))
        expected[list(column)] = list(column.values())
        np.testing.assert_allclose(chance, expected, rtol=0, atol=1e-12)


def test_equal_states_are_joined() -> None:
    """tiny-2x8-25: 115 patterns, many of which lead to the same state."""
    fixture = load_fixture("tiny-2x8-25-k5")
    patterns = patterns_from_the_start(plan_of(fixture), fixture.world, False, most=1000)
    assert patterns is not None
    assert closed_loop_exact(plan_of(fixture), fixture.world).ends < len(patterns) == 115


def test_plans_that_have_no_closed_loop_are_refused() -> None:
    world = World.create([[0.0, 0.1]])
    with pytest.raises(PlanError, match="another map"):
        closed_loop_exact(make_plan(world, [[0, 0]]), World.create([[0.0, 0.2]]))


def test_the_oracles_see_no_engine() -> None:
    """`test_house` looks at those of `analysis.theory`."""
    for path in Path(__file__).parent.glob("oracle_*.py"):
        engines = ("planner.rollouts", "planner.kernels", "mrac_jax", "jax")
        assert not [module for module in imports_of(path) if module.startswith(engines)]
