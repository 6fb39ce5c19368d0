"""What JAX's lanes do beside the paper's runs, against the compiled simulator: maps in doubt, ranges, given paths, and
missions under way.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace
from conftest import LANES
from test_mrac_jax_closed_loop import assert_same_runs
from test_planner_bearing import worn_plan
from test_planner_doubt import DOUBTS
from test_planner_luck import NAMES as WORN
from test_planner_mission import case
from test_planner_range import LIMITS
from test_planner_range import small as ranged
from test_planner_state import SETTINGS, STEPS, rest_of
from test_planner_takeover import map_of, wanderings

from mrac_jax.arrays import MOST_MAPS, make_doubt
from mrac_jax.closed_loop import engine as engine_module
from mrac_jax.closed_loop.engine import JaxClosedLoop
from mrac_jax.closed_loop.tables import LEAST_PATHS, LaneTables, lane_tables
from planner.errors import WorldError
from planner.ids import MAX_STEP
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, trace_rollouts
from planner.simulator.loop import ClosedLoop
from planner.simulator.tables import luck_tables
from planner.tally import RolloutResults
from planner.world.changing_maps import with_hazard
from planner.world.levels import place_starts
from planner.world.uncertain_maps import UNIT
from planner.world.world import World


def same(loop: ClosedLoop, seed: int, rollouts: int, what: object, traced: tuple[int, ...] = ()) -> RolloutResults:
    """Tally, results and traces in JAX are the compiled simulator's; returns the results."""
    engine = JaxClosedLoop(loop, seed, streams=1, lanes=LANES)
    results = assert_same_runs(engine, loop, rollouts, str(what))
    for mine, theirs in zip(engine.traces(traced), trace_rollouts(loop, seed, traced), strict=True):
        assert_same_trace(mine, theirs, str(what))
    return results


def in_doubt(name: str, **settings: Any) -> ClosedLoop:
    world = DOUBTS[name]()
    return compile_closed_loop(make_plan(world, place_starts(world, 3)[0], Settings(**settings)), world)


def given(world: World, seed: int) -> ClosedLoop:
    """Two robots and more on paths that wander."""
    plan = wanderings(world, 2 + seed % 3, 6 * (seed % 5), np.random.default_rng(seed))
    return compile_closed_loop(plan, world, first_only=seed % 3 == 0)


@pytest.fixture
def one_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lanes that can do all of it, so that one program is compiled: a part that is not there has no effect."""

    def able(loop: ClosedLoop, seed: int, least: tuple[int, int] = (1, 1)) -> LaneTables:
        tables = lane_tables(loop, seed, least)
        size, robots = tables.size, np.zeros(len(tables.starts), dtype=np.int32)
        no_doubt = luck_tables((with_hazard(World.create([[0.0]]), "persistent", 0.0),), np.zeros(size, dtype=np.int64))
        drawn = loop.tables._replace(**no_doubt | {"there": np.full(size, UNIT, dtype=np.uint32)})
        return replace(
            tables,
            doubt=tables.doubt or make_doubt(drawn, (0, 0), False, size),
            range=robots + MAX_STEP + 1 if tables.range is None else tables.range,
            paths=tables.paths or (np.zeros(LEAST_PATHS, dtype=np.uint16), robots, robots - 1),
        )

    monkeypatch.setattr(engine_module, "lane_tables", able)


@pytest.mark.usefixtures("one_program")
def test_given_paths_are_taken_over_on_maps_in_doubt() -> None:
    taken_over, means = 0, set()
    for seed, name in enumerate(DOUBTS):
        results = same(given(DOUBTS[name](), seed), 7, 120, (name, seed))
        taken_over += int(((results.alive < 2 + seed % 3) & (results.alive > 0)).sum())
        means.add(results.visited.mean())
    assert taken_over > 60
    assert len(means) == len(DOUBTS)


@pytest.mark.usefixtures("one_program")
def test_robots_that_wear_and_differ() -> None:
    lost = 0
    for seed, name in enumerate(WORN):
        world, plan = worn_plan(name)
        loop = compile_closed_loop(plan, world, first_only=seed % 3 == 0)
        results = same(loop, seed, 200, name)
        lost += int((results.alive < loop.robots).sum())
    assert lost > 50 * len(WORN)


@pytest.mark.usefixtures("one_program")
def test_robots_that_wear_go_on_with_what_they_have_borne() -> None:
    world, plan = case(1)
    state = ReferenceLoop(plan, world).state_at(11, 4, 2)
    assert state is not None
    said = state.to_json()
    for number, robot in enumerate(said["robots"]):
        robot["exposure"] = 0.1 * number
    state, settings = parse_state(said, world, "state.json"), Settings(wear=2.0, susceptibility=1.5)
    rest = make_plan(world, state.starts, settings, state=state)
    loop = compile_closed_loop(rest, world)
    assert any(loop.bearing.begun)
    same(loop, 3, 200, "worn before", traced=(0, 1))


def states(name: str) -> list[tuple[World, Plan]]:
    """Missions cut at some steps, and their rests."""
    found = []
    for seed in range(3):
        world, plan = case(seed, **SETTINGS[name])
        whole = ReferenceLoop(plan, world)
        for rollout, step in product(range(2), STEPS):
            state = whole.state_at(step, seed, rollout)
            if state is not None:
                found.append((world, rest_of(world, state, **SETTINGS[name])))
    return found


@pytest.mark.usefixtures("one_program")
def test_robots_with_a_range_from_the_start_and_from_a_state() -> None:
    for seed in range(2):
        world, plan = ranged(seed, 3, (9, 14, 40))
        results = same(compile_closed_loop(plan, world), seed, 100, seed)
        assert results.visited.max() <= 3 + 9 + 14 + 40
    rests = states("mrac, range")[::6]
    for number, (world, rest) in enumerate(rests):
        same(compile_closed_loop(rest, world, first_only=number % 2 == 1), 3, 100, number)
    assert len(rests) > 2


def test_a_way_that_is_not_the_safest_one_is_an_error() -> None:
    """Of a state by hand: lanes know no other ways."""
    world = World.create(np.zeros((2, 6)))
    seen = {"cell": 0, "status": "traveling", "area": 1, "ahead": [6, 7, 1, 2, 3, 4], "moves": 0}
    areas = [
        {"level": 0, "robot": -1, "state": "completed", "cells": [0]},
        {"level": 0, "robot": 0, "state": "assigned", "cells": [*range(1, 12)]},
    ]
    said = {
        "format": "mrac-state", "version": 1, "world": {"shape": [2, 6], "sha256": world.sha256}, "step": 0,
        "visited": [0], "survived": [0], "robots": [seen], "areas": areas, "to_do": [[]], "held": [], "quiet": 0,
    }  # fmt: skip
    state = parse_state(said, world, "state.json")
    plan = make_plan(world, state.starts, Settings(), state=state)
    with pytest.raises(WorldError, match="robot 0 is not on the safest way to cell 4"):
        make_engine(plan, world, Rolling("closed"), "jax")
    assert make_engine(plan, world, Rolling("closed")).name == "numba"


def test_more_maps_than_numbers_of_24_bits_are_an_error() -> None:
    tables = in_doubt("maps").tables
    many = np.broadcast_to(np.zeros((1, 1), dtype=np.int64), (MOST_MAPS + 1, 1))
    with pytest.raises(WorldError, match="16777217 maps"):
        make_doubt(tables._replace(doses=many), (0, 0), False, 256)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_maps_in_doubt_event_for_event(policy: str) -> None:
    for name in DOUBTS:
        loop = in_doubt(name, policy=policy)
        same(loop, 5, 2000, name, traced=(0, 7, 1999))
        same(loop.under(DOUBTS["maps"]()), 5, 500, f"{name}, by the luck of maps")


@pytest.mark.slow
@pytest.mark.parametrize("more", LIMITS, ids=["mrac", "per_cell", "reserve", "worth"])
def test_ranges_event_for_event(more: dict[str, Any]) -> None:
    for seed in range(6):
        robots = 1 + seed % 4
        for moves in (1, 9, tuple(range(5, 5 + 9 * robots, 9))):
            world, plan = ranged(seed, robots, moves, **more)
            same(compile_closed_loop(plan, world), seed, 300, (seed, moves), traced=(0, 1))


@pytest.mark.slow
def test_given_paths_event_for_event() -> None:
    for seed in range(24):
        same(given(map_of(seed), seed), 7, 1000, seed, traced=tuple(range(12)))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, given in SETTINGS.items() if given.get("transit") != "area"])
def test_missions_go_on_event_for_event(name: str) -> None:
    for number, (world, rest) in enumerate(states(name)):
        same(compile_closed_loop(rest, world), 3, 300, (name, number), traced=(0, 1, 299))
