"""The open loop's distribution of coverage against every combination of fates, the closed form, and rollouts."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import NAMES, load_fixture, worlds_with_starts
from hypothesis import given
from oracle_distribution import coverage_chances
from rolling import rollouts
from test_analysis_exact import fates_of
from test_theory_tree import excess

from analysis.theory.exact import open_loop_exact
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan, RobotPlan
from planner.rollouts.open_loop.compiled import compile_plan
from planner.worlds.world import World

SLOW = [name for name in NAMES if name.startswith("scattered") and name.endswith("k8")]


@given(worlds_with_starts(most_side=4, most_robots=4))
def test_distribution_is_the_sum_over_every_luck(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    plan = make_plan(world, starts)
    fates = [fates_of(robot, world.threat.ravel().astype(np.float64)) for robot in plan.robots]
    if np.prod([len(f) for f in fates]) > 1000:
        return
    found = coverage_chances(plan, world)
    assert found is not None
    visited, survived = np.zeros(len(found.visited)), np.zeros(len(found.visited))
    for combination in product(*fates):
        chance = float(np.prod([fate[0] for fate in combination]))
        visited[len({cell for _, _, cells, _ in combination for cell in cells})] += chance
        passed = {cell for _, _, cells, stopped in combination for cell in (cells[:-1] if stopped else cells)}
        survived[len(passed)] += chance
    np.testing.assert_allclose(found.visited, visited, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.survived, survived, rtol=0, atol=1e-12)


def check_means(name: str) -> None:
    fixture = load_fixture(name)
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    found, exact = coverage_chances(plan, fixture.world), open_loop_exact(plan, fixture.world)
    assert found is not None
    cells = np.arange(len(found.visited))
    for chance, mean in ((found.visited, exact.visited), (found.survived, exact.survived)):
        assert chance.min() >= 0
        assert chance.sum() == pytest.approx(1.0, abs=1e-9)
        assert chance @ cells == pytest.approx(mean, abs=1e-9)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in SLOW])
def test_means_are_the_closed_form(name: str) -> None:
    check_means(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_means_of_teams_that_share_much_are_the_closed_form(name: str) -> None:
    check_means(name)


@pytest.mark.parametrize("name", ["contiguous-20x20-1000-k2", "contiguous-14x23-1002-k8"])
def test_samples_of_the_engine_are_from_the_distribution(name: str) -> None:
    fixture = load_fixture(name)
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    found = coverage_chances(plan, fixture.world)
    assert found is not None
    tally = rollouts(compile_plan(plan, fixture.world), seed=11, count=100_000, mode="step", engine="numba")
    for chance, counts in ((found.visited, tally.visited), (found.survived, tally.survived)):
        cells = np.arange(len(chance))
        mean = chance @ cells
        error = np.sqrt((chance @ cells**2 - mean**2) / tally.rollouts)
        assert abs(counts @ cells / tally.rollouts - mean) < 5 * error
        assert abs(excess(chance, counts)) < 5


def paths(world: World, *given: list[int]) -> Plan:
    return Plan(world.shape, world.sha256, None, tuple(RobotPlan(np.array(path)) for path in given))


def test_robots_that_share_nothing_are_a_convolution() -> None:
    """Two rows, one robot each: the coverage is the sum of two independent numbers, whatever the work allowed."""
    threat = np.full((2, 6), 0.25)
    threat[:, 0] = 0.0
    world = World.create(threat)
    rows = [list(range(6)), list(range(6, 12))]
    both = coverage_chances(paths(world, *rows), world, most_work=2)
    one = coverage_chances(paths(world, rows[0]), world, most_work=1)
    assert both is not None
    assert one is not None
    np.testing.assert_allclose(both.visited, np.convolve(one.visited, one.visited)[:13], atol=1e-15)
    np.testing.assert_allclose(both.survived, np.convolve(one.survived, one.survived)[:13], atol=1e-15)
    assert both.at_least(12) == pytest.approx(0.75**8)
    assert both.at_least(12, "survived") == pytest.approx(0.75**10)
    assert both.at_least(0) == pytest.approx(1.0)


def test_too_much_work_is_refused() -> None:
    """Two robots meet head on in a corridor of 6 dangerous cells: 6 x 6 (visited) and 7 x 7 (survived) joinings."""
    world = World.create(np.full((1, 6), 0.5))
    plan = paths(world, [0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0])
    assert coverage_chances(plan, world, most_work=7 + 49) is not None
    assert coverage_chances(plan, world, most_work=7 + 48) is None
