"""The JAX closed loop against the compiled simulator, and its own contract."""

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle, product
from typing import Any

import jax
import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds, idle_at_start, survey_world, survey_worlds
from conftest import LANES
from drawn_worlds import drawn_compiled_mission
from helpers import (
    VisitLoop,
    assert_same_results,
    assert_same_tally,
    assert_same_trace,
    run_closed_chunks,
    run_python,
)  # fmt: skip
from test_failure_sampling import NAMES as WORN
from test_failure_sampling import worn_plan
from test_mission import case, obey
from test_mrac_jax_open_loop import FLAGS, flags_set
from test_planner_open_loop import map_of, wanderings
from test_return_home import KINDS, corridor, drawn
from test_return_home import small as ranged
from test_state import SETTINGS, STEPS, rest_of
from test_uncertain_maps import DOUBTS

from mrac_jax.closed_loop import book as book_module
from mrac_jax.closed_loop import engine as engine_module
from mrac_jax.closed_loop.book import HALVE, SPLIT, HostBook, mixed
from mrac_jax.closed_loop.engine import BATCH, MOST_LANES, JaxClosedLoop
from mrac_jax.functional import book, closed_rollouts, thresholds
from planner.errors import InputError, UsageError, WorldError
from planner.make_plan import allocated_plan, make_plan
from planner.mission.mission import Mission
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import Rolling, closed_loop_engine, make_engine
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import EventKind, Outcome
from planner.simulator.state import MOST_PASSES
from planner.tally import RolloutResults
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World


def assert_same_runs(engine: JaxClosedLoop, loop: ClosedLoop, rollouts: int, what: str = "") -> RolloutResults:
    """Tally and results of the engine are the compiled simulator's, of this loop; returns the results."""
    tally, results = engine.run(0, rollouts)
    expected, singles = run_range(loop, engine.seed, 0, rollouts, singles=True)
    assert_same_results(results, singles, what)
    assert_same_tally(tally, expected, what)
    return results


def same(loop: ClosedLoop, seed: int, rollouts: int, what: object, traced: Sequence[int] = ()) -> RolloutResults:
    """Tally, results and traces in JAX are the compiled simulator's; returns the results."""
    engine = JaxClosedLoop(loop, seed, lanes=LANES)
    results = assert_same_runs(engine, loop, rollouts, str(what))
    for mine, theirs in zip(engine.traces(traced), trace_rollouts(loop, seed, traced), strict=True):
        assert_same_trace(mine, theirs, str(what))
    return results


def compare(one: SurveyWorld, rollouts: int, traced: Sequence[int] = ()) -> RolloutResults:
    return same(one.loop(), one.seed, rollouts, one.name, traced)


def is_held(loop: ClosedLoop) -> bool:
    """Whether the book holds such missions."""
    try:
        JaxClosedLoop(loop, 0, lanes=LANES)
    except InputError:
        return False
    return True


@pytest.fixture(scope="module")
def loop() -> ClosedLoop:
    """A world in which robots share, with five of them."""
    return survey_world("crossings-2").loop()


# Rollout by rollout, count for count, event for event.


def test_equals_the_compiled_simulator_on_every_kind_of_world() -> None:
    worlds = first_worlds(18)
    shares = 0
    for number, one in enumerate(worlds):
        results = compare(one, 40, (0, 39))
        shares += int(results.bisected.sum() + results.divided.sum())
        if number % 6 == 0:  # straight on in safe areas
            order = ("boustrophedon", "columns")[number // 6 % 2]
            compare(replace(one, settings=replace(one.settings, in_area=order)), 40)
    assert len({one.kind for one in worlds}) >= 18
    assert shares > 200


@pytest.mark.parametrize(
    "numbers", [range(200), pytest.param(range(200, 2200), marks=pytest.mark.slow)], ids=["200", "2000"]
)
def test_drawn_missions(numbers: range) -> None:
    """With any of the options that the book holds: ranges, bases, wear, orders of cells, deadlines, levels."""
    ended = np.zeros(len(Outcome), dtype=np.int64)
    lost = shared = delivered = 0
    for number in numbers:
        loop = compile_closed_loop(*drawn_compiled_mission(number))
        results = same(loop, number, 20 if numbers[0] == 0 else 60, number, (0,) if number % 20 == 0 else ())
        ended += np.bincount(results.outcome, minlength=len(ended))
        lost += int((results.alive < loop.robots).sum())
        shared += int((results.bisected + results.divided).sum())
        delivered += int(((results.delivered > 0) & (results.delivered < results.visited)).sum())
    some = len(numbers) * 2
    assert lost > 2 * some and shared > some and delivered > some / 4
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS, Outcome.STEP_LIMIT):
        assert ended[outcome] > some / 4, outcome


@pytest.mark.slow
def test_equals_the_compiled_simulator_on_the_whole_survey() -> None:
    worlds, rollouts = survey_worlds(), 1000
    counts = dict.fromkeys(("bisected", "divided", "no progress", "lost in the completing step", "idle"), 0)
    for one in worlds:
        if not is_held(one.loop()):
            assert one.kind == "extreme" or one.first_only
            continue
        results = compare(one, rollouts, traced=(0, 1, 500, 999))
        counts["bisected"] += int((results.bisected > 0).sum())
        counts["divided"] += int((results.divided > 0).sum())
        counts["no progress"] += int((results.outcome == Outcome.NO_PROGRESS).sum())
        last = (results.outcome == Outcome.COMPLETE) & (results.alive == 0)
        counts["lost in the completing step"] += int(last.sum()) if one.accessible >= 10 else 0
        counts["idle"] += rollouts if idle_at_start(one.plan()) else 0
    assert len(worlds) >= 200
    assert counts["bisected"] >= 10_000 and counts["divided"] >= 1_000
    assert all(counts[name] >= 100 for name in ("no progress", "lost in the completing step", "idle"))


@pytest.mark.parametrize(
    ("seeds", "rollouts", "traced"), [(8, 120, 2), pytest.param(24, 1000, 12, marks=pytest.mark.slow)]
)
def test_external_plans_are_taken_over(seeds: int, rollouts: int, traced: int) -> None:
    """Two robots and more on paths that wander."""
    taken_over = 0
    for seed in range(seeds):
        world, robots = map_of(seed), 2 + seed % 3
        plan = wanderings(world, robots, 6 * (seed % 5), np.random.default_rng(seed))
        results = same(compile_closed_loop(plan, world), 7, rollouts, seed, range(traced))
        taken_over += int(((results.alive < robots) & (results.alive > 0)).sum())
    assert taken_over > 60


def test_robots_that_wear_and_differ() -> None:
    lost = 0
    for seed, name in enumerate(WORN):
        world, plan = worn_plan(name)
        loop = compile_closed_loop(plan, world)
        lost += int((same(loop, seed, 200, name).alive < loop.robots).sum())
    assert lost > 50 * len(WORN)


def test_robots_that_wear_go_on_with_what_they_have_borne() -> None:
    world, plan = case(1)
    state = PythonLoop(plan, world).state_at(11, 4, 2)
    said = state.to_json()
    for number, robot in enumerate(said["robots"]):
        robot["exposure"] = 0.1 * number
    state, settings = parse_state(said, world, "state.json"), Settings(weibull_shape=2.0, hazard_multiplier=1.5)
    loop = compile_closed_loop(make_plan(world, state.starts, settings, state=state), world)
    assert any(loop.failure_model.begun)
    same(loop, 3, 200, "worn before", traced=(0, 1))


def states(name: str) -> list[tuple[World, Plan]]:
    """Missions cut at some steps, and their rests."""
    found = []
    for seed in range(3):
        world, plan = case(seed, **SETTINGS[name])
        whole = PythonLoop(plan, world)
        for rollout, step in product(range(2), STEPS):
            state = whole.state_at(step, seed, rollout)
            if state is not None:
                found.append((world, rest_of(world, state, **SETTINGS[name])))
    return found


def test_robots_with_a_range_from_the_start_and_from_a_state() -> None:
    for seed in range(2):
        world, plan = ranged(seed, 3, (9, 14, 40))
        results = same(compile_closed_loop(plan, world), seed, 100, seed, (0, 1))
        assert results.visited.max() <= 3 + 9 + 14 + 40
    rests = states("mrac, range")[::6]
    for number, (world, rest) in enumerate(rests):
        same(compile_closed_loop(rest, world), 3, 100, number)
    assert len(rests) > 2


def test_a_way_that_is_not_the_safest_one_is_an_error() -> None:
    """Of a state by hand: the compiled simulator follows its tables from the next cell on."""
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


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_missions_go_on_event_for_event(name: str) -> None:
    rests = [(number, compile_closed_loop(rest, world)) for number, (world, rest) in enumerate(states(name))]
    for number, loop in rests:
        if is_held(loop):
            same(loop, 3, 300, (name, number), traced=(0, 1, 299))
    assert rests


# Robots that return to base (SPEC section 19).

RETURNS: list[dict[str, Any]] = [asked for asked in KINDS if not asked.keys() & {"transit", "policy"}]
RETURNS += [
    {"return_to": "nearest", "range": (12, 20, 40), "recharge": 2},
    {"return_to": "home", "range": (12, 30, 21), "weibull_shape": 2.0},
    {"return_to": "home", "deadline": 50},
    {"return_to": "nearest", "range": (25, 40, 60), "recharge": 7, "deadline": 90},
]


def returning(asked: dict[str, Any], seed: int, robots: int = 3) -> ClosedLoop:
    world, starts = drawn(seed, robots)
    if isinstance(asked.get("range"), tuple):
        asked = asked | {"range": (asked["range"] * 2)[:robots]}
    return compile_closed_loop(make_plan(world, starts, Settings(**asked)), world)


@pytest.mark.parametrize(
    ("seeds", "rollouts", "traced"), [(3, 60, 1), pytest.param(12, 300, 16, marks=pytest.mark.slow)]
)
def test_robots_that_return(seeds: int, rollouts: int, traced: int) -> None:
    """In the last world of all, some cannot return from their own area."""
    home = alive = 0
    ended = np.zeros(len(Outcome), dtype=np.int64)
    cases = product(RETURNS, range(seeds)) if rollouts > 60 else zip(RETURNS, cycle(range(seeds)), strict=False)
    for asked, seed in (*cases, ({"return_to": "home", "range": 9}, 11)):
        loop = returning(asked, seed, 3 + seed % 3 if rollouts > 60 else 3)  # a number of bases is a program
        results = same(loop, seed, rollouts, (asked, seed), range(traced if rollouts > 60 or seed == 0 else 0))
        home, alive = home + int(results.home.sum()), alive + int(results.alive.sum())
        ended += np.bincount(results.outcome, minlength=len(ended))
    assert home == alive > 500
    assert ended[[Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS]].min() > 20


@pytest.mark.slow
def test_a_list_of_bases_and_more_robots_than_a_word_has_bits() -> None:
    bases = tuple(map(tuple, drawn(2, 40)[1][:2].tolist()))
    for asked in ({"return_to": bases}, {"return_to": "home", "range": 20}):
        assert (same(returning(asked, 2, 40), 1, 200, asked, traced=(0, 1)).home > 33).any()


@pytest.mark.slow
def test_missions_under_way_go_on_and_robots_that_are_cut_off_stay() -> None:
    going_home = 0
    for number, seed in product((0, 1), (4, 5)):
        world, starts = drawn(seed)
        whole = VisitLoop(make_plan(world, starts, Settings(**KINDS[number])), world)
        last = whole.trace(0, 0).time
        for state in (whole.state_at(step, 0, 0) for step in {4, last // 2, last - 5, last - 1}):
            if state is not None:
                rest = compile_closed_loop(rest_of(world, state, **KINDS[number]), world)
                same(rest, seed, 60, (number, seed, state.step), traced=(0, 1))
                going_home += any(robot.status == "returning" for robot in state.robots)
    assert going_home > 1


def test_robots_that_are_cut_off_from_their_base() -> None:
    mission = Mission(corridor(8, 0.01), make_plan(corridor(8, 0.01), [[0, 0]], Settings(return_to="home")))
    for _ in range(4):
        obey(mission)
    mission.close([[0, 1]])
    world, plan = mission.world, mission.rest()
    trace = PythonLoop(plan, world).trace(0, 0)
    assert (trace.events[:, 2] == EventKind.TURNED_HOME).any() and not (trace.events[:, 2] == EventKind.HOME).any()
    same(compile_closed_loop(plan, world), 0, 60, "cut off", traced=(0, 1))


# What changes no count: chunks, lanes, devices, room, flags.


def test_chunks_and_lanes_change_nothing(loop: ClosedLoop) -> None:
    engine = JaxClosedLoop(loop, 5, lanes=LANES)
    whole, results = engine.run(100, 120)
    parts = [engine.run(start, count) for start, count in ((100, 1), (101, 79), (180, 40))]
    assert parts[0][0] + (parts[1][0] + parts[2][0]) == whole
    assert_same_results(RolloutResults.join(part for _, part in parts), results)
    assert parts[0][0] != parts[1][0]
    few = JaxClosedLoop(loop, 5, lanes=7)  # fewer than events of the run without losses, and several batches
    assert few.run(100, 120)[0] == whole


@pytest.mark.parametrize("engine", ["numba", "jax"])
@pytest.mark.usefixtures("few_lanes")
def test_chunks_add_up_under_one_contract(loop: ClosedLoop, engine: str) -> None:
    *_, last = run_closed_chunks(loop, seed=5, start=10, count=200, engine=engine, checkpoints=(7, 99))  # type: ignore[arg-type]
    assert last.tally == run_range(loop, 5, 10, 200)[0]
    runner = closed_loop_engine(loop, 5, engine)  # type: ignore[arg-type]
    assert runner.tally(10, 200) == last.tally
    assert_same_results(runner.results(10, 20), run_range(loop, 5, 10, 20, singles=True)[1])  # type: ignore[arg-type]
    assert [trace.rollout for trace in runner.traces((4, 2))] == [4, 2]


DEVICES = """
import jax
from closed_loop_worlds import survey_world
from helpers import assert_same_results, assert_same_tally
from mrac_jax.closed_loop.engine import JaxClosedLoop
from planner.rollouts.closed_loop import run_range
loop = survey_world("crossings-2").loop()
four = JaxClosedLoop(loop, 5, lanes=16, devices=4)
assert len(jax.devices()) == 4 and len(four._lanes.mode.sharding.device_set) == 4
(tally, results), (expected, singles) = four.run(3, 301), run_range(loop, 5, 3, 301, singles=True)
assert_same_tally(tally, expected, "tally")
assert_same_results(results, singles, "results")
assert tally.visits.sum() > 0
"""


def test_four_devices_count_as_the_compiled_simulator_does() -> None:
    run_python(DEVICES, XLA_FLAGS=f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4")


def test_room_that_is_too_small_grows(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mrac_jax.closed_loop.start.AREAS", 1)
    engine = JaxClosedLoop(loop, 5, lanes=LANES, room=16, parts=32)
    assert_same_runs(engine, loop, 100)
    assert engine._room > 16 and engine._parts > 32


def test_a_book_that_grows_while_lanes_wait(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "CHUNK", 16)
    engine = JaxClosedLoop(loop, 5, lanes=LANES)
    before = engine.host.entries.used
    assert_same_runs(engine, loop, 100)
    assert engine.host.entries.used > before + 20
    assert len(engine.host.prefix.rows) >= engine.host.prefix.used


def test_flags_of_jax_change_no_count(loop: ClosedLoop) -> None:
    """All flags that would stop the program, or change what it means, at once."""
    with flags_set(*FLAGS):
        assert_same_runs(JaxClosedLoop(loop, 5, lanes=LANES), loop, 100)


def test_compiled_once_for_a_shape(loop: ClosedLoop) -> None:
    one = JaxClosedLoop(loop, 5, lanes=LANES)
    one.tally(0, 10)
    program = engine_module._program(one._mesh)
    before = program._cache_size()
    for seed in (6, 7):
        JaxClosedLoop(loop, seed, lanes=LANES).tally(seed, 5 * seed)
    assert program._cache_size() == before


# Sets of cells: compared themselves, not by their hashes alone.


def test_sets_with_one_hash_are_told_apart(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """By tags of three bits: many look-ups meet another set with their tag in their bucket."""

    def poor(words: Any, salt: Any) -> Any:
        bucket, tag = mixed(words, salt)
        return bucket, (tag & 15) | 1

    for module in ("book", "lanes"):
        monkeypatch.setattr(f"mrac_jax.closed_loop.{module}.mixed", poor)
    engine_module._program.cache_clear()
    try:
        assert_same_runs(JaxClosedLoop(loop, 5, lanes=LANES), loop, 60)
    finally:
        engine_module._program.cache_clear()


def test_numpy_and_jax_hash_alike() -> None:
    random = np.random.default_rng(1)
    words, salts = (random.integers(0, 2**32, size, dtype=np.uint32) for size in ((50, 5), 50))
    for mine, theirs in zip(mixed(words, salts), jax.jit(mixed)(words, salts), strict=True):
        assert mine.tolist() == np.asarray(theirs).tolist()
    assert len(set(mixed(words, salts)[0].tolist())) == 50


def test_entries_are_those_of_the_planner(loop: ClosedLoop) -> None:
    """A split has the connected components, a walk covers its set; what is known is not added again."""
    host, cells = HostBook(loop), np.arange(len(loop.cells))
    row = host.row_of(cells)
    halves = host.entries.rows[host.look_up(HALVE, row)]
    one, two = (host.cells_of(host.bits.rows[halves[5] + part]) for part in range(2))
    assert halves[6:].tolist() == [2, 1] and abs(len(one) - len(two)) <= len(cells) // 2
    assert np.array_equal(np.sort(np.concatenate([one, two])), cells)
    whole = host.entries.rows[host.look_up(SPLIT, row)]
    assert whole[6:].tolist() == [1, 0]
    walk = host.entries.rows[host.look_up(0, host.row_of(cells[1:]))]
    used = host.entries.used
    assert host.cells_of(host.prefix.rows[walk[0] + walk[1]]).tolist() in (cells.tolist(), cells[1:].tolist())
    assert host.look_up(SPLIT, row) and host.entries.used == used


# Deadlines, other threats, weights.


def test_a_made_up_limit_is_a_timeout(loop: ClosedLoop) -> None:
    results = assert_same_runs(JaxClosedLoop(loop.truncated_at(7), 5, lanes=LANES), loop.truncated_at(7), 200)
    assert (results.outcome == Outcome.STEP_LIMIT).sum() > 150


@pytest.mark.parametrize("name", ["crossings-0", pytest.param("deadly-7", marks=pytest.mark.slow), "rooms-4"])
def test_deadlines_and_other_threats(name: str) -> None:
    one = survey_world(name)
    loop, safer = one.loop(), World.create(one.world.threat * np.float32(0.1))
    engine = JaxClosedLoop(loop, 3, lanes=LANES)
    last = int(run_range(loop, 3, 0, 60, singles=True)[1].time.max())  # type: ignore[union-attr]
    for cut in (0, 1, last // 2, last - 1, last):
        assert_same_runs(engine.truncated_at(cut), loop.truncated_at(cut), 60, f"{name} {cut}")
    results = assert_same_runs(engine.with_threat(safer), loop.with_threat(safer), 100, name)
    assert (results.alive == loop.robots).sum() > 5


def test_survived_visits_are_counted_and_weighed(loop: ClosedLoop) -> None:
    random, size = np.random.default_rng(3), loop.shape[0] * loop.shape[1]
    weights = random.integers(0, 2**40, size), random.integers(0, 2**40, (size, MOST_PASSES + 1))
    engine = JaxClosedLoop(loop, 5, lanes=LANES).with_cell_weights(*weights)
    results = assert_same_runs(engine, loop.with_cell_weights(*weights), 200)
    assert results.value_found.min() > 0


def test_what_is_derived_has_as_many_lanes(loop: ClosedLoop) -> None:
    engine, none = JaxClosedLoop(loop, 5, lanes=16, devices=1), np.zeros(loop.shape[0] * loop.shape[1], np.int64)
    safe = World.create(np.where(np.isin(np.arange(none.size), loop.cells), 0.0, np.nan).reshape(loop.shape))
    found = np.zeros((none.size, MOST_PASSES + 1), np.int64)
    for other in (engine.truncated_at(7), engine.with_threat(safe), engine.with_cell_weights(none, found)):
        assert (other.lanes, other._devices) == (16, 1)


# Pure functions.


def test_rollouts_as_a_pure_function() -> None:
    one = survey_world("crossings-2")
    loop, size = one.loop(), 120
    decisions = book(one.world, one.plan(), seed=one.seed, rollouts=size, lanes=LANES)
    drawn = thresholds(one.seed, np.arange(size), loop.robots)
    singles = run_range(loop, one.seed, 0, size, singles=True)[1]
    run = jax.jit(closed_rollouts)

    def check(found: Any) -> None:
        assert not np.asarray(found.missing).any()
        for name in ("time", "alive", "outcome"):
            assert np.asarray(getattr(found, name)).ravel().tolist() == getattr(singles, name).tolist(), name
        for name in ("visited", "survived"):
            cells = np.bitwise_count(np.asarray(getattr(found, name))).sum(axis=-1)
            assert cells.ravel().tolist() == getattr(singles, name).tolist(), name

    check(jax.jit(jax.vmap(closed_rollouts, (None, 0)))(decisions, drawn.reshape(3, 40, *drawn.shape[1:])))
    with jax.enable_x64(True):
        check(run(decisions, drawn))
    few = book(one.world, one.plan(), seed=one.seed, rollouts=0, lanes=LANES)
    missing = np.asarray(run(few, drawn).missing)
    assert 0 < missing.sum() <= size
    for wrong in (drawn[0], drawn.astype("int32"), drawn[..., :1], np.zeros((3, 9, 2), np.uint32)):
        with pytest.raises(UsageError, match=r"thresholds are .*expected uint32\[B, K, 2\], K up to 8"):
            jax.eval_shape(closed_rollouts, decisions, wrong)


# What the book does not hold.


@pytest.mark.parametrize(
    ("name", "value"),
    [("transit", "area"), ("policy", "per_cell"), ("policy", "watchful"), ("radio", 3.0),
     ("steps_per_move", (1, 2, 1, 2, 1, 2, 1, 2))],
)  # fmt: skip
def test_options_that_are_left_out_are_numba_s(name: str, value: Any) -> None:
    one = survey_world("crossings-2")
    loop = compile_closed_loop(make_plan(one.world, one.starts, Settings(**{name: value})), one.world)
    said = f"{name}={value!r}" if isinstance(value, str) else name
    with pytest.raises(UsageError, match=rf"engine='jax' with .*{said}.*; use engine='numba'"):
        closed_loop_engine(loop, 5, "jax")
    assert closed_loop_engine(loop, 5).name == "numba"


def test_first_visits_and_uncertain_maps_are_numba_s() -> None:
    one = survey_world("crossings-2")
    with pytest.raises(UsageError, match="threat_checks='first_visit'"):
        closed_loop_engine(compile_closed_loop(one.plan(), one.world, first_only=True), 5, "jax")
    world = DOUBTS["maps"]()
    uncertain = compile_closed_loop(make_plan(world, place_starts(world, 3)[0]), world)
    with pytest.raises(WorldError, match="an uncertain map"):
        closed_loop_engine(uncertain, 5, "jax")


def test_what_is_too_large_is_a_clear_error(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="engine"):
        closed_loop_engine(loop, 5, "fast")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="seed"):
        closed_loop_engine(loop, -1, "jax")
    world = World.create(np.zeros((2, 5001), dtype=np.float32))
    wide = compile_closed_loop(allocated_plan(world, np.array([[0, 0]]), Settings()), world, tabled=False)
    with pytest.raises(WorldError, match=r"10002 of them accessible; expected at most 10000 .*engine='numba'"):
        JaxClosedLoop(wide, 1)
    with pytest.raises(UsageError, match=r"lanes is 0; expected 1 to 262,144 on each device"):
        JaxClosedLoop(loop, 5, lanes=0)
    last = np.int32(BATCH * MOST_LANES - 1)
    assert int(engine_module.ln.log_row(last, np.int32(1023), np.zeros(11), last, np.uint32(0))[0]) == 2**32 - 1
    with pytest.raises(WorldError, match=r"8 robots that may run for 268,435,456 steps; .*engine='numba'"):
        JaxClosedLoop(replace(loop, max_steps=2**28), 5)
    monkeypatch.setattr(book_module, "MOST_BYTES", 2**10)
    with pytest.raises(WorldError, match=r"the decisions of this mission take up .* GiB; expected .*engine='numba'"):
        closed_loop_engine(loop, 5, "jax")
    monkeypatch.undo()
    monkeypatch.setattr(book_module, "NEVER", 2)
    with pytest.raises(WorldError, match=r"costs of up to .* levels; expected a product below"):
        HostBook(loop)


def test_more_robots_than_a_word_has_bits() -> None:
    world = random_world(11, 13, ThreatPattern("scattered", seed=4), threats=0.1)
    loop = compile_closed_loop(make_plan(world, place_starts(world, 45)[0]), world)
    results = assert_same_runs(JaxClosedLoop(loop, 5, lanes=LANES), loop, 100)
    assert results.bisected.sum() > 100
