"""The closed loop as a Markov chain: solved here two ways and by Storm, against the enumeration and the fixtures."""

from __future__ import annotations

from dataclasses import asdict, astuple
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, load_fixture
from oracle_markov import REWARDS, Chain, closed_loop_chain, solve_chain, write_drn
from oracle_tree import OUTCOMES, ClosedLoopExact, closed_loop_exact

from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.world.world import World

TINY = [name for name in NAMES if name.startswith("tiny")]
DEAR = pytest.param("contiguous-14x23-1001-k2", marks=pytest.mark.slow)
SHARING = 24
"""Random tiny worlds in which areas are shared and robots may be lost."""
NUMBERS = [pytest.param(number, marks=pytest.mark.slow if number % 2 == 0 else ()) for number in range(SHARING)]


def fixture_case(name: str) -> tuple[Plan, World]:
    fixture = load_fixture(name)
    return make_plan(fixture.world, fixture.starts, allocation=fixture.allocation), fixture.world


@cache
def fixture_chain(name: str) -> Chain:
    return closed_loop_chain(*fixture_case(name))


@cache
def sharing_cases() -> list[tuple[Plan, World]]:
    """The first SHARING random worlds, seed after seed, whose nominal run shares and in which somebody may die."""
    cases: list[tuple[Plan, World]] = []
    seed = 0
    while len(cases) < SHARING:
        luck = np.random.default_rng(seed)
        seed += 1
        shape = tuple(luck.integers(3, 6, size=2))
        threat = luck.choice([np.nan, 0.0, 0.1, 0.35], p=[0.1, 0.62, 0.14, 0.14], size=shape)
        free = np.argwhere(~np.isnan(threat))
        starts = free[luck.integers(len(free), size=luck.integers(2, 5))]
        world = World.create(threat)
        plan = make_plan(world, starts)
        if plan.shares > 0 and (world.threat[world.accessible(starts)] > 0).any():
            cases.append((plan, world))
    return cases


@cache
def sharing_chain(number: int) -> tuple[Chain, ClosedLoopExact]:
    """One of them as a chain and enumerated."""
    plan, world = sharing_cases()[number]
    return closed_loop_chain(plan, world), closed_loop_exact(plan, world)


def is_near(values: object, others: object) -> bool:
    pairs = zip(astuple(values), astuple(others), strict=True)  # type: ignore[call-overload]
    return all(abs(float(a) - float(b)) <= 1e-9 for a, b in pairs)


@pytest.mark.parametrize("name", [*TINY, "contiguous-20x20-1000-k1", DEAR])
def test_the_solved_chain_is_the_fixtures(name: str) -> None:
    chain = fixture_chain(name)
    assert not chain.timed
    values = asdict(solve_chain(chain))
    for key, value in load_fixture(name).answers["closed_loop_exact"].items():
        assert values[key] == pytest.approx(value, rel=0, abs=1e-9), key


@pytest.mark.parametrize("number", NUMBERS)
def test_the_solved_chain_is_the_enumeration_where_areas_are_shared(number: int) -> None:
    chain, found = sharing_chain(number)
    assert found.alive < len(sharing_cases()[number][0].robots)
    for key, value in asdict(solve_chain(chain)).items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key


@pytest.mark.parametrize("max_steps", [1, 2, 4, pytest.param(7, marks=pytest.mark.slow)])
def test_the_step_is_part_of_the_state_where_the_limit_is_in_reach(max_steps: int) -> None:
    fixture = load_fixture("tiny-4x3-23-k4")
    plan = make_plan(fixture.world, fixture.starts, Settings(max_steps=max_steps), allocation=fixture.allocation)
    chain, found = closed_loop_chain(plan, fixture.world), closed_loop_exact(plan, fixture.world)
    assert chain.timed
    assert found.step_limit > 0
    for key, value in asdict(solve_chain(chain)).items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key


def test_first_visit_checks_make_another_chain() -> None:
    plan, world = fixture_case("tiny-6x4-22-k3")
    values = solve_chain(closed_loop_chain(plan, world, first_only=True))
    found = closed_loop_exact(plan, world, first_only=True)
    for key, value in asdict(values).items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key
    assert values.alive > solve_chain(closed_loop_chain(plan, world)).alive + 0.1


def test_fractions_are_exact() -> None:
    """p = 1/4 on each of 3 cells after a safe start: coverage 1 + 1 + 3/4 + 9/16, alive 27/64."""
    world = World.create([[0.0, 0.25, 0.25, 0.25]])
    chain = closed_loop_chain(make_plan(world, [[0, 0]]), world, exact=True)
    values = solve_chain(chain)
    assert values.visited == 1 + 1 + Fraction(3, 4) + Fraction(9, 16)
    assert values.survived == 1 + Fraction(3, 4) + Fraction(9, 16) + Fraction(27, 64)
    assert (values.alive, values.complete, values.all_robots_lost) == (
        Fraction(27, 64),
        Fraction(9, 16),
        Fraction(7, 16),
    )


@pytest.mark.parametrize("name", ["tiny-3x6-17-k3", "tiny-6x3-27-k5", "tiny-4x8-12-k2"])
def test_rows_of_exact_chains_add_up_to_one(name: str) -> None:
    plan, world = fixture_case(name)
    exact, rounded = closed_loop_chain(plan, world, exact=True), closed_loop_chain(plan, world)
    assert all(sum(row.values()) == 1 for row in exact.moves[: exact.inner])
    assert [list(row) for row in exact.moves] == [list(row) for row in rounded.moves]
    values = solve_chain(exact)
    assert values.complete + values.all_robots_lost + values.no_progress + values.step_limit == 1
    assert is_near(values, solve_chain(rounded))


def test_a_chain_that_grows_too_large_is_refused() -> None:
    with pytest.raises(PlanError, match="more than 100 states"):
        closed_loop_chain(*fixture_case("tiny-4x3-23-k4"), most_states=100)


def read_drn(path: Path) -> tuple[list[dict[int, float]], list[list[float]], list[list[str]]]:
    """(moves, rewards, labels) of the states of a file in Storm's explicit format."""
    moves: list[dict[int, float]] = []
    rewards, labels = [], []
    for line in path.read_text().partition("@model\n")[2].splitlines():
        if line.startswith("state"):
            said, _, rest = line.partition("[")[2].partition("]")
            rewards.append([float(reward) for reward in said.split(",")])
            labels.append(rest.split())
            moves.append({})
        elif ":" in line:
            target, _, chance = line.partition(":")
            moves[-1][int(target)] = float(chance)
    return moves, rewards, labels


def test_the_file_for_storm_says_what_the_chain_is(tmp_path: Path) -> None:
    chain = closed_loop_chain(*fixture_case("tiny-3x7-01-k3"))
    write_drn(chain, tmp_path / "chain.drn")
    moves, rewards, labels = read_drn(tmp_path / "chain.drn")
    assert moves[: chain.inner] == list(chain.moves[: chain.inner])
    assert moves[chain.inner :] == [{state: 1.0} for state in range(chain.inner, chain.states)]
    assert rewards == [list(reward) for reward in chain.rewards]
    assert labels[0] == ["init"]
    assert labels[chain.inner :] == [[outcome, "over"] for outcome in OUTCOMES]
    assert not any(labels[1 : chain.inner])
    assert " ".join(REWARDS) in (tmp_path / "chain.drn").read_text().splitlines()


def storm(chain: Chain):  # type: ignore[no-untyped-def]
    pytest.importorskip("stormpy", reason="the extra `oracle` is not installed")
    from oracle_storm import storm_values

    return storm_values(chain)


@pytest.mark.parametrize("name", [*TINY, pytest.param("contiguous-20x20-1000-k2", marks=pytest.mark.slow)])
def test_storm_finds_the_fixtures(name: str) -> None:
    values = asdict(storm(fixture_chain(name)))
    for key, value in load_fixture(name).answers["closed_loop_exact"].items():
        assert values[key] == pytest.approx(value, rel=0, abs=1e-9), key


@pytest.mark.parametrize("number", NUMBERS)
def test_storm_finds_the_enumeration_where_areas_are_shared(number: int) -> None:
    chain, found = sharing_chain(number)
    for key, value in asdict(storm(chain)).items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key


@pytest.mark.parametrize("name", ["tiny-2x5-06-k1", "tiny-3x6-17-k3", "tiny-6x3-27-k5", "tiny-2x8-25-k5"])
def test_storm_finds_the_very_fractions(name: str) -> None:
    chain = closed_loop_chain(*fixture_case(name), exact=True)
    assert storm(chain) == solve_chain(chain)
