"""Robots that come home in JAX's lanes (SPEC section 19) against the compiled simulator."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from helpers import VisitLoop
from mrac_jax.closed_loop.beginning import nominal_of
from mrac_jax.closed_loop.state import CELL_KINDS, STEP_KINDS
from mrac_jax.closed_loop.tables import LaneTables, lane_tables
from test_mission import obey
from test_mrac_jax_closed_loop import same
from test_return_home import KINDS, WATCHFUL, corridor, drawn

from mrac_jax.closed_loop import engine as engine_module
from planner.errors import WorldError
from planner.make_plan import allocated_plan, make_plan
from planner.mission.mission import Mission
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import EventKind
from planner.world.world import World

PAPERS, LOOKING = KINDS[7] | {"deadline": 90}, KINDS[3] | {"reserve": 0.5, "worth": 60.0}
BREAKS_OFF = [*WATCHFUL[:2], {"return_to": "home", "policy": "watchful", "worth": 20.0, "range": 35, "recharge": 3}]
EVERY = [asked for asked in (*KINDS, PAPERS, LOOKING, *BREAKS_OFF) if "transit" not in asked]


@pytest.fixture(autouse=True)
def one_shape(small_traces: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few programs are compiled."""

    def roomy(loop: ClosedLoop, seed: int, least: tuple[int, int] = (150, 8)) -> LaneTables:
        return lane_tables(loop, seed, least)

    monkeypatch.setattr(engine_module, "lane_tables", roomy)


def loop_of(asked: dict[str, Any], seed: int, robots: int = 3) -> ClosedLoop:
    world, starts = drawn(seed, robots)
    if isinstance(asked.get("range"), tuple):
        asked = asked | {"range": (asked["range"] * 2)[:robots]}
    return compile_closed_loop(make_plan(world, starts, Settings(**asked)), world)


@pytest.mark.parametrize("asked", [PAPERS, LOOKING], ids=["mrac", "per_cell"])
def test_counts_are_the_compiled_simulator_s(asked: dict[str, Any]) -> None:
    home = alive = 0
    for seed in range(6):
        results = same(loop_of(asked, seed), seed, 60, (asked, seed))
        home, alive = home + int(results.home.sum()), alive + int(results.alive.sum())
    assert home == alive > 100


@pytest.mark.parametrize("number", [5, pytest.param(8, marks=pytest.mark.slow)])
def test_who_looks_up_may_not_afford_its_own_area_and_turns_in_the_same_step(number: int) -> None:
    same(loop_of(KINDS[number], 11, 5), 11, 60, number)


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
def test_missions_under_way_go_on_and_who_is_cut_off_stays() -> None:
    returning = 0
    for number, seed in product((0, 2, 5), (4, 5)):
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
    nominal = nominal_of(compile_closed_loop(allocated_plan(world, read.starts, settings, read), world), 8)
    cells, steps = np.zeros(world.threat.size * CELL_KINDS, np.int64), np.zeros(8 * STEP_KINDS, np.int64)
    nominal.count(np.zeros(0, np.int64), 60, cells, steps)
    assert len(nominal.step) == 0 and not cells.any() and not steps.any()


def test_too_many_bases_for_themselves_are_a_clear_error() -> None:
    world = World.create(np.zeros((60, 60), dtype=np.float32))
    plan = make_plan(world, [[0, col] for col in range(8)], Settings(return_to="home"))
    with pytest.raises(
        WorldError, match=r"8 bases for themselves on 3,600 cells; .*engine='numba'.*return_to='nearest'"
    ):
        lane_tables(compile_closed_loop(plan, world), 0)
