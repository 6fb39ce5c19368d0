"""Policies that count what cells are worth (SPEC section 13): `per_cell` and `worth` by value, `mrac` as ever."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_results, assert_same_tally
from closed_loop_worlds import first_worlds
from conftest import load_fixture
from test_planner_policies import LIMITED, compare_traces

from planner.errors import WorldError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.world.world import World


def values_of(world: World, seed: int) -> np.ndarray:
    """Many worth nothing, some a little, some much."""
    return np.random.default_rng(seed).choice([0, 0, 1, 5, 300.5, 1e5], world.shape)


def path_of(world: World, start: int, **asked: Any) -> list[int]:
    return make_plan(world, [[0, start]], Settings(policy="per_cell", **asked)).robots[0].path.tolist()


def test_the_next_area_is_the_one_of_least_cost_by_value() -> None:
    """A row: the robot's own safe area in the middle, dangerous cells to the left, others to the right."""
    row = [[0.2, 0.2, 0, 0, 0.1, 0.1]]
    world = World.create(row)
    assert path_of(world, 2)[:4] == [2, 3, 4, 5]  # the lower threats first
    left = World.create(row, value=[[9, 9, 1, 1, 1, 1]])
    assert path_of(left, 2)[:5] == [2, 3, 2, 1, 0]  # twice the danger, nine times the value
    worthless = World.create(row, value=[[9, 9, 1, 1, 0, 0]])
    assert path_of(worthless, 2)[-2:] == [4, 5]
    only = World.create(row, value=[[1, 1, 1, 1, 0, 0]])
    assert path_of(only, 2)[-2:] == [4, 5]  # whatever they cost


def test_worth_refuses_by_value() -> None:
    """n = 4 and p = 0.1: two cells next to the robot cost C = 8, theta = 40 / V: refused iff 8,000 > 40 U / V."""
    row = [[0, 0, 0.1, 0.1]]
    cases = ((5.0, 1.0, False), (9.9, 1.0, False), (10.1, 1.0, True), (4.9, 0.5, False), (5.1, 0.5, True))
    for worth, share, refused in cases:  # U = 2000 times the share
        world = World.create(row, value=[[7, 1, 7 * share, 7 * share]])
        plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", worth=worth))
        assert (plan.outcome == "not_worth_the_risk") is refused, (worth, share)
    row = [[0.1, 0.1, 0, 0, 0.1, 0.1]]
    cheap = World.create(row, value=[[1, 1, 1, 1, 0, 0]])
    plan = make_plan(cheap, [[0, 2]], Settings(policy="per_cell", worth=2.0))
    assert plan.outcome == "not_worth_the_risk"
    assert set(plan.robots[0].path.tolist()) == {0, 1, 2, 3}  # nothing is risked for cells worth nothing
    assert make_plan(World.create(row), [[0, 2]], Settings(policy="per_cell", worth=2.0)).outcome == "complete"


def test_whole_numbers_of_values() -> None:
    world = World.create([[0, 0, 0.1, 0, np.nan, 0]], value=[[2, 1e-9, 0, 1, 7, 50]])
    problem = prepare(world, [[0, 0]], Settings(policy="per_cell"))
    assert problem.value is not None
    assert problem.value.tolist() == [1000, 1, 0, 500, 0, 0]  # the last cell is out of reach
    assert prepare(world, [[0, 0]], Settings()).value is None
    nothing = World.create([[0, 0.1, np.nan, 0]], value=[[0, 0, 0, 3]])
    assert make_plan(nothing, [[0, 0]], Settings(policy="per_cell")).outcome == "complete"


@pytest.mark.parametrize("limits", LIMITED[:3], ids=str)
def test_compiled_runs_are_the_readable_ones_event_for_event(limits: dict[str, Any]) -> None:
    changed = 0
    for name, rollouts in (("contiguous-14x23-1000-k2", 2), ("scattered-14x23-1000-k8", 1)):
        fixture = load_fixture(name)
        world = fixture.world.with_values(values_of(fixture.world, 3))
        plan = make_plan(world, fixture.starts, Settings(**limits), fixture.allocation)
        compare_traces(world, plan, range(rollouts))
        plain = make_plan(fixture.world, fixture.starts, Settings(**limits), fixture.allocation)
        changed += any(
            one.path.tolist() != other.path.tolist() for one, other in zip(plan.robots, plain.robots, strict=True)
        )
    assert changed == 2


def test_mrac_ignores_values() -> None:
    fixture = load_fixture("contiguous-14x23-1000-k2")
    world = fixture.world.with_values(values_of(fixture.world, 1))
    plans = [make_plan(one, fixture.starts) for one in (world, fixture.world)]
    assert plans[0].to_json() == plans[1].to_json()
    loops = [compile_closed_loop(plan, one) for plan, one in zip(plans, (world, fixture.world), strict=True)]
    assert loops[0].identity == loops[1].identity
    by_value = [compile_closed_loop(plan_by_value(one), one) for one in (world, fixture.world)]
    assert by_value[0].identity != by_value[1].identity


def plan_by_value(world: World) -> Plan:
    return make_plan(world, load_fixture("contiguous-14x23-1000-k2").starts, Settings(policy="per_cell"))


@pytest.mark.slow
@pytest.mark.parametrize("limits", LIMITED, ids=str)
def test_the_lanes_count_the_same(limits: dict[str, Any]) -> None:
    from mrac_jax.closed_loop.engine import JaxClosedLoop

    seen = 0
    for number, one in enumerate(first_worlds(12)):
        world = one.world.with_values(values_of(one.world, number))
        try:
            plan = make_plan(world, one.starts, Settings(**limits))
            engine = JaxClosedLoop(compile_closed_loop(plan, world), 7, streams=1, lanes=64)
        except WorldError:
            continue
        tally, results = engine.run(0, 128)
        expected, singles = run_range(engine.loop, 7, 0, 128, singles=True)
        assert singles is not None
        assert_same_results(results, singles, one.name)
        assert_same_tally(tally, expected, one.name)
        seen += 1
    assert seen >= 9
