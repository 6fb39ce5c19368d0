"""Algorithms 1-3 against an independent simulator's runs: every path, and seeded runs with hits, event counts equal."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture

from planner.mrac.make_plan import allocate, make_plan, nominal_run
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop, simulate
from planner.settings import Settings
from planner.tally import Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World


def test_nominal_run_is_the_fixtures(fixture: Fixture) -> None:
    known = fixture.answers["nominal"]
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    assert [robot.path.tolist() for robot in plan.robots] == known["paths"]
    assert (plan.time, plan.shares, Outcome[plan.outcome.upper()]) == (known["time"], known["shares"], known["outcome"])
    moves = [int(np.count_nonzero(np.diff(robot.path))) for robot in plan.robots]
    assert moves == known["moves"]
    assert len(np.unique(np.concatenate([robot.path for robot in plan.robots]))) == known["visited"]


@pytest.mark.parametrize("most", [3, pytest.param(None, marks=pytest.mark.slow)])
def test_threshold_runs_are_the_fixtures(fixture: Fixture, most: int | None) -> None:
    plan = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    readable = ReferenceLoop(plan, fixture.world)
    known = fixture.answers["threshold_runs"]
    for rollout, expected in enumerate(known["runs"][:most]):
        run = readable.run(known["seed"], rollout)
        found = [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum(), run.outcome]
        assert [int(value) for value in found] == expected, rollout


def test_own_allocation_of_one_robot_is_the_fixtures() -> None:
    for name in (name for name in NAMES if name.endswith("-k1")):
        fixture = load_fixture(name)
        own = allocate(prepare(fixture.world, fixture.starts, Settings()))
        assert [(a.level, a.robot, a.cells.tolist()) for a in own] == [
            (a.level, a.robot, a.cells.tolist()) for a in fixture.allocation
        ]


def test_the_last_step_leaves_time_for_the_paths_that_are_followed_first() -> None:
    """8 x levels x accessible cells + 64, and the moves of the longest path given, waits among them."""
    world = World.create([[0.0, 0.1, 0.3, 0.0, np.nan, 0.0]])
    for given, more in (
        ((), 0),
        ((np.array([0]), np.array([3])), 0),
        ((np.array([0, 1, 1]), np.array([3, 2, 2, 2])), 3),
    ):
        assert prepare(world, [[0, 0], [0, 3]], Settings(), given).max_steps == 8 * 3 * 4 + 64 + more


def test_transit_inside_the_area_never_leaves_it() -> None:
    assert legs_that_leave("area") == 0
    assert legs_that_leave("grid") >= 5


def legs_that_leave(transit: str) -> int:
    """Cover legs that enter cells outside their area, over a few random worlds."""
    found = 0
    for seed in range(6):
        world = random_world(9, 13, ThreatPattern(areas=4, seed=seed))
        plan = make_plan(world, place_starts(world, 2)[0], Settings(transit=transit))
        for robot in plan.robots:
            for leg in (leg for leg in robot.legs if leg.kind == "cover"):
                inside = set(plan.area(leg.area).cells.tolist())
                found += not set(robot.path[leg.start : leg.stop].tolist()) <= inside
    return found


def test_timeout_is_reported() -> None:
    plan = make_plan(World.create(np.zeros((3, 5))), [[0, 0]], Settings(max_steps=4))
    assert (plan.outcome, plan.time) == ("step_limit", 4)


def test_a_run_that_cannot_go_on_is_stuck_after_two_quiet_steps() -> None:
    # A stop in its own part of the map leaves cells that the other robot cannot reach.
    world = World.create([[0.0, 0.5, 0.0, np.nan, 0.0]])
    problem = prepare(world, [[0, 0], [0, 4]], Settings())
    run = simulate(problem, allocate(problem), max_steps=99, hit=lambda robot, step, cell: cell == 1)
    assert (run.outcome, run.time, run.alive.tolist()) == (Outcome.NO_PROGRESS, 3, [False, True])


def test_the_nominal_run_calls_no_luck() -> None:
    world = World.create(np.full((2, 3), 0.9))
    problem = prepare(world, [[0, 0]], Settings())
    assert nominal_run(problem, allocate(problem)).outcome is Outcome.COMPLETE
