"""Robots that return to base in JAX's closed loop (SPEC section 19) against the compiled simulator."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from conftest import LANES
from helpers import VisitLoop
from test_mission import obey
from test_mrac_jax_closed_loop import same
from test_return_home import KINDS, corridor, drawn

from mrac_jax.closed_loop.engine import JaxClosedLoop
from planner.make_plan import allocated_plan, make_plan
from planner.mission.mission import Mission
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import EventKind, Outcome

EVERY: list[dict[str, Any]] = [asked for asked in KINDS if not asked.keys() & {"transit", "policy"}]
EVERY += [
    KINDS[7] | {"deadline": 90},
    {"return_to": "nearest", "range": (12, 20, 40), "recharge": 2},
    {"return_to": "home", "range": (12, 30, 21), "wear": 2.0},
]


def loop_of(asked: dict[str, Any], seed: int, robots: int = 3) -> ClosedLoop:
    world, starts = drawn(seed, robots)
    if isinstance(asked.get("range"), tuple):
        asked = asked | {"range": (asked["range"] * 2)[:robots]}
    return compile_closed_loop(make_plan(world, starts, Settings(**asked)), world)


def test_counts_are_the_compiled_simulator_s() -> None:
    home = alive = 0
    ended = np.zeros(len(Outcome), dtype=np.int64)
    for asked, seed in product(EVERY, range(3)):
        results = same(loop_of(asked, seed), seed, 40, (asked, seed), (0,) if seed == 0 else ())
        home, alive = home + int(results.home.sum()), alive + int(results.alive.sum())
        ended += np.bincount(results.outcome, minlength=len(ended))
    assert home == alive > 500
    assert ended[[Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS]].min() > 20


def test_robots_that_cannot_return_from_their_own_area() -> None:
    same(loop_of({"return_to": "home", "range": 9}, 11, 5), 11, 60, "9 moves")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(EVERY)))
def test_drawn_worlds_event_for_event(number: int) -> None:
    for seed in range(12):
        robots = 3 + seed % 3
        same(loop_of(EVERY[number], seed, robots), seed, 300, (EVERY[number], seed), traced=tuple(range(16)))


@pytest.mark.slow
def test_a_list_of_bases_and_more_robots_than_a_word_has_bits() -> None:
    world, starts = drawn(2, 40)
    for more in ({"return_to": tuple(map(tuple, starts[:2].tolist()))}, {"return_to": "home", "range": 20}):
        plan = make_plan(world, starts, Settings(**more))
        results = same(compile_closed_loop(plan, world), 1, 200, more, traced=(0, 1))
        assert (results.home > 33).any()


@pytest.mark.slow
def test_missions_under_way_go_on_and_robots_that_are_cut_off_stay() -> None:
    returning = 0
    for number, seed in product((0, 2, 1), (4, 5)):
        world, starts = drawn(seed)
        settings = Settings(**KINDS[number])
        whole = VisitLoop(make_plan(world, starts, settings), world)
        last = whole.trace(0, 0).time
        for step in {4, last // 2, last - 5, last - 1}:
            state = whole.state_at(step, 0, 0)
            if state is None:
                continue
            read = parse_state(state.to_json(), world, "state")
            rest = allocated_plan(world, read.starts, settings, read)
            same(compile_closed_loop(rest, world), seed, 60, (number, seed, step), traced=(0, 1))
            returning += any(robot.status == "returning" for robot in read.robots)
    assert returning > 1


def test_robots_that_are_cut_off_from_their_base() -> None:
    mission = Mission(corridor(8, 0.01), make_plan(corridor(8, 0.01), [[0, 0]], Settings(return_to="home")))
    for _ in range(4):
        obey(mission)
    mission.close([[0, 1]])
    world, plan = mission.world, mission.rest()
    trace = PythonLoop(plan, world).trace(0, 0)
    assert (trace.events[:, 2] == EventKind.TURNED_HOME).any() and not (trace.events[:, 2] == EventKind.HOME).any()
    same(compile_closed_loop(plan, world), 0, 60, "cut off", traced=(0, 1))


def test_a_rest_in_which_nothing_is_entered_counts_nothing() -> None:
    world, starts = drawn(4)
    settings = Settings(**KINDS[2])
    state = VisitLoop(make_plan(world, starts, settings), world).state_at(34, 0, 0)
    assert state is not None
    read = parse_state(state.to_json(), world, "state")
    loop = compile_closed_loop(allocated_plan(world, read.starts, settings, read), world)
    tally = JaxClosedLoop(loop, 0, lanes=LANES).tally(0, 60)
    assert tally == run_range(loop, 0, 0, 60)[0] and not tally.visits.any()
