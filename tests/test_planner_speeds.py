"""Robots of several speeds: engines against each other, equal speeds against one, the tree of all that can happen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mixed_teams import assert_as_enumerated, assert_engines_agree, drawn
from movers import moving_world
from oracle_rows import everything

from analysis.theory.exact import open_loop_exact
from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.tally import Trace
from planner.world.levels import place_starts
from planner.world.world import World

KINDS: list[dict[str, Any]] = [
    {},
    {"policy": "per_cell"},
    {"policy": "per_cell", "reserve": 0.4, "worth": 30.0, "range": (40, 20, 60)},
    {"policy": "watchful", "reserve": 0.4},
    {"policy": "watchful", "types": ("a", "c", "b")},
    {"range": 30, "deadline": 45},
    {"return_to": "home", "range": 40, "deadline": 70},
    {"return_to": "nearest", "range": (25, 40, 60), "recharge": 7, "deadline": 140, "policy": "per_cell"},
    {"return_to": "home", "policy": "per_cell", "deadline": 60},
    {"transit": "area", "return_to": "nearest", "range": 30, "recharge": 4},
]
PACES = [(1, 2, 3), (2, 1, 1), (3, 2, 2), (1, 5, 1), (4, 6, 2)]


def check_engines(seed: int, rollouts: int) -> None:
    """The two engines agree on a drawn world, event for event; nobody moves out of turn."""
    world, starts, _ = drawn(seed)
    asked = {**KINDS[seed % len(KINDS)], "steps_per_move": PACES[seed // len(KINDS) % len(PACES)]}
    plan = make_plan(world, starts, Settings(**asked))
    assert plan.settings is not None
    for trace in assert_engines_agree(plan, world, seed, rollouts):
        check_turns(trace, plan.settings.paces)


def check_turns(trace: Trace, paces: tuple[int, ...]) -> None:
    steps, robots = np.nonzero(np.diff(trace.cells, axis=0))
    assert ((steps + 1) % np.array(paces)[robots] == 0).all()


@pytest.mark.parametrize("part", range(len(KINDS)))
def test_engines_agree(part: int) -> None:
    for seed in range(part, 40, len(KINDS)):
        check_engines(seed, 3)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(20))
def test_engines_agree_on_a_thousand_worlds(part: int) -> None:
    for seed in range(1000 + part, 2000, 20):
        check_engines(seed, 4)


def test_everything_that_can_happen_on_rows() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        size, robots = int(rng.integers(4, 8)), 2 + seed % 2
        p = np.float32(rng.choice([0, 0, 0.1, 0.2, 0.37], size))
        starts, paces = rng.integers(0, size, robots).tolist(), (1, *rng.integers(2, 4, robots - 1).tolist())
        world = World.create([p])
        settings = Settings(steps_per_move=paces, density=1e6)
        plan = make_plan(world, [[0, start] for start in starts], settings)
        assert_as_enumerated(plan, world, everything([p.tolist()] * robots, starts, list(paces)))


def test_threats_that_move_meet_robots_of_every_speed_at_every_step() -> None:
    for seed in range(6):
        world = moving_world(seed)
        starts = place_starts(world, 3)[0]
        asked = {"steps_per_move": (1, 3, 2), "radio": (None, 2.5)[seed % 2], "policy": ("mrac", "per_cell")[seed // 3]}
        assert_engines_agree(make_plan(world, starts, Settings(**asked)), world, seed, 3)


def test_one_speed_is_any_other() -> None:
    world, starts, _ = drawn(2)
    plain = make_plan(world, starts, Settings())
    for steps in (2, (3, 3, 3)):
        plan = make_plan(world, starts, Settings(steps_per_move=steps))
        assert [r.path.tolist() for r in plan.robots] == [r.path.tolist() for r in plain.robots]
        tallies = [run_range(compile_closed_loop(one, world), 1, 0, 500)[0] for one in (plan, plain)]
        assert replace(tallies[0], key="") == replace(tallies[1], key="")
    twice = make_plan(world, starts, Settings(steps_per_move=(2, 4, 2)))
    once = make_plan(world, starts, Settings(steps_per_move=(1, 2, 1)))
    assert [r.path.tolist() for r in twice.robots] == [r.path.tolist() for r in once.robots]


def test_a_corridor_by_hand() -> None:
    """Six cells each, one robot three times as fast: it has covered its own when four are left of the other's, gets two
    of these, and would be too late for more.
    """
    world = World.create(np.zeros((1, 12)))
    plan = make_plan(world, [[0, 0], [0, 11]], Settings(steps_per_move=(1, 3)))
    assert (plan.outcome, [len(np.unique(robot.path)) for robot in plan.robots]) == ("complete", [8, 4])
    moves = np.flatnonzero(np.diff(plan.robots[1].path)) + 1
    assert (moves.tolist(), plan.time) == ([3, 6, 9], 9)
    alone = make_plan(world, [[0, 0], [0, 11]], Settings(steps_per_move=(1, 3), deadline=4))
    assert alone.time == 4


def test_the_open_loop_of_slow_robots_covers_as_much_but_later() -> None:
    world, starts, _ = drawn(5)
    plan = make_plan(world, starts, Settings(steps_per_move=(1, 2, 4)))
    exact = open_loop_exact(plan, world)
    tally = make_engine(plan, world, Rolling("open", seed=5), "numba").tally(0, 40_000)
    cells = np.arange(len(tally.visited))
    middle = float(tally.visited @ cells / 40_000)
    se = float(np.sqrt(tally.visited @ (cells - middle) ** 2)) / 40_000
    assert abs(middle - exact.visited) <= 5 * se


def test_speeds_of_another_team_are_an_error() -> None:
    with pytest.raises(PlanError, match="steps_per_move of 2 robots for a team of 3"):
        make_plan(World.create(np.zeros((2, 3))), [[0, 0]] * 3, Settings(steps_per_move=(1, 2)))
