"""The JAX closed loop against the compiled simulator, the fixtures, and its own contract."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds, idle_at_start, survey_world, survey_worlds
from conftest import LANES
from helpers import assert_same_results, assert_same_tally, assert_same_trace, run_closed_chunks
from test_failure_sampling import NAMES as WORN
from test_failure_sampling import worn_plan
from test_mission import case
from test_mrac_jax_open_loop import FLAGS
from test_planner_open_loop import map_of, wanderings
from test_return_home import LIMITS
from test_return_home import small as ranged
from test_state import SETTINGS, STEPS, rest_of
from test_uncertain_maps import DOUBTS

from mrac_jax.arrays import MOST_MAPS, make_doubt
from mrac_jax.closed_loop import engine as engine_module
from mrac_jax.closed_loop import engine as lane_program
from mrac_jax.closed_loop.beginning import NO_HIT, nominal_of
from mrac_jax.closed_loop.engine import JaxClosedLoop
from mrac_jax.closed_loop.state import Sums
from mrac_jax.closed_loop.tables import LEAST_PATHS, LaneTables, lane_tables
from planner.errors import UsageError, WorldError
from planner.failure_model import tolerances
from planner.ids import MAX_STEP
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import Rolling, closed_loop_engine, make_engine
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import PythonLoop
from planner.rollouts.tables import luck_tables
from planner.settings import Settings
from planner.simulator.codes import EventKind, Outcome
from planner.simulator.state import MOST_PASSES
from planner.tally import RolloutResults
from planner.world.changing_maps import with_hazard
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.uncertain_maps import UNIT
from planner.world.world import World

# The JAX closed loop against the compiled classical simulator, the fixtures, and its own contract.

MOST_SHAPES = 12
TRACED = range(16)
"""As many as are traced at a time."""


def compare(one: SurveyWorld, rollouts: int, traced: Sequence[int] = ()) -> RolloutResults:
    """Every count, result and chosen trace of the JAX engine is the compiled simulator's; returns the results."""
    loop = one.loop()
    engine = JaxClosedLoop(loop, one.seed, streams=1, lanes=LANES)
    results = assert_same_runs(engine, loop, rollouts, one.name)
    for mine, theirs in zip(engine.traces(traced), trace_rollouts(loop, one.seed, traced), strict=True):
        assert_same_trace(mine, theirs, one.name)
    return results


def assert_same_runs(engine: JaxClosedLoop, loop: ClosedLoop, rollouts: int, what: str = "") -> RolloutResults:
    """Tally and results of the engine are the compiled simulator's, of this loop; returns the results."""
    tally, results = engine.run(0, rollouts)
    expected, singles = run_range(loop, engine.seed, 0, rollouts, singles=True)
    assert singles is not None
    assert_same_results(results, singles, what)
    assert_same_tally(tally, expected, what)
    return results


@pytest.mark.usefixtures("small_traces")
def test_equals_the_compiled_simulator_on_every_kind_of_world() -> None:
    worlds = first_worlds(18)
    shares = 0
    for one in worlds:
        results = compare(one, 100, TRACED)
        shares += int(results.bisected.sum() + results.divided.sum())
    assert len({one.kind for one in worlds}) >= 18
    assert shares > 500
    for number, one in enumerate(worlds[::3]):  # straight on in safe areas
        order = ("boustrophedon", "columns")[number % 2]
        compare(replace(one, settings=replace(one.settings, in_area=order)), 100, TRACED)


@pytest.mark.slow
def test_equals_the_compiled_simulator_on_the_whole_survey(capsys: pytest.CaptureFixture[str]) -> None:
    worlds, rollouts = survey_worlds(), 1000
    tables = [lane_tables(one.loop(), one.seed) for one in worlds]
    shapes = {(one.size, len(one.cell_at), len(one.starts), one.levels) for one in tables}
    counts = dict.fromkeys(("bisected", "divided", "stuck", "dead in the completing step", "idle at the start"), 0)
    events = 0
    for one in worlds:
        plan = one.plan()
        results = compare(one, rollouts, traced=(0, 1, 500, 999))
        counts["bisected"] += int((results.bisected > 0).sum())
        counts["divided"] += int((results.divided > 0).sum())
        counts["stuck"] += int((results.outcome == Outcome.NO_PROGRESS).sum())
        last = (results.outcome == Outcome.COMPLETE) & (results.alive == 0)
        counts["dead in the completing step"] += int(last.sum()) if one.accessible >= 10 else 0
        counts["idle at the start"] += rollouts if idle_at_start(plan) else 0
        events += sum(len(trace.events) for trace in trace_rollouts(one.loop(), one.seed, (0, 1, 500, 999)))
    with capsys.disabled():
        print(f"\n{len(worlds)} worlds x {rollouts} rollouts, {len(shapes)} + 1 shapes, {events} events: {counts}")  # noqa: T201
    assert len(worlds) >= 200 and len(shapes) + 1 <= MOST_SHAPES
    assert counts["bisected"] >= 10_000 and counts["divided"] >= 1_000
    assert all(counts[name] >= 100 for name in ("stuck", "dead in the completing step", "idle at the start"))


def beyond_a_word() -> ClosedLoop:
    """More robots than a word has bits."""
    world = random_world(11, 13, ThreatPattern("scattered", seed=4), threats=0.1)
    return compile_closed_loop(make_plan(world, place_starts(world, 45)[0]), world)


@pytest.fixture(scope="module")
def loop() -> ClosedLoop:
    """A world in which robots share, with five of them."""
    return survey_world("crossings-2").loop()


def test_chunks_streams_and_lanes_change_nothing(loop: ClosedLoop) -> None:
    whole, results = JaxClosedLoop(loop, 5, streams=1, lanes=LANES).run(100, 300)
    split = JaxClosedLoop(loop, 5, streams=2, lanes=LANES)
    parts = [split.run(start, count) for start, count in ((100, 1), (101, 199), (300, 100))]
    assert parts[0][0] + (parts[1][0] + parts[2][0]) == whole
    assert_same_results(RolloutResults.join(part for _, part in parts), results)
    assert parts[0][0] != parts[1][0]


def test_what_is_derived_has_as_many_lanes_and_streams(loop: ClosedLoop) -> None:
    engine, none = JaxClosedLoop(loop, 5, streams=1, lanes=LANES), np.zeros(loop.shape[0] * loop.shape[1], np.int64)
    safe = World.create(np.where(np.isin(np.arange(none.size), loop.cells), 0.0, np.nan).reshape(loop.shape))
    found = np.zeros((none.size, MOST_PASSES + 1), np.int64)
    for other in (engine.until(7), engine.under(safe), engine.weighing(none, found)):
        assert (other.lanes, len(other._states)) == (LANES, 1)


def test_a_call_cut_off_in_the_middle_is_taken_up_again(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = JaxClosedLoop(loop, 5, streams=1, lanes=LANES).tally(0, 300)
    no_sums = engine_module.no_sums

    def nearly_full(*size: Any) -> Sums:
        return replace(no_sums(*size), moves=np.int32(lane_program.MOST_MOVES - 500))

    monkeypatch.setattr(engine_module, "no_sums", nearly_full)
    calls = count_dispatches(monkeypatch)
    assert JaxClosedLoop(loop, 5, streams=1, lanes=LANES).tally(0, 300) == whole
    assert len(calls) > 3


def count_dispatches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows with every dispatch of the program."""
    calls: list[int] = []
    program = engine_module._program

    def counting(*key: object):  # type: ignore[no-untyped-def]
        def call(*args: object) -> object:
            calls.append(1)
            return program(*key)(*args)

        return call

    counting.cache_clear = program.cache_clear  # type: ignore[attr-defined]
    monkeypatch.setattr(engine_module, "_program", counting)
    return calls


def primitives(jaxpr: jax.core.Jaxpr) -> list[str]:  # type: ignore[name-defined]
    """Every primitive in it, those of inner programs included."""
    found = []
    for equation in jaxpr.eqns:
        found.append(equation.primitive.name)
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda leaf: hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                found += primitives(inner)
    return found


def test_one_dispatch_a_block_and_no_callback(loop: ClosedLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = JaxClosedLoop(loop, 5, streams=1, lanes=LANES)
    engine.tally(0, 1)
    calls = count_dispatches(monkeypatch)
    engine.tally(0, 4096)
    assert len(calls) == 1
    nobody = np.zeros((0, loop.robots), dtype=np.int64)
    queue = engine_module.queue_of(engine._room, len(engine._tables.starts), nobody[:, 0], nobody[:, 0], nobody)
    sums = lane_program.no_sums(engine._tables, engine._steps, engine._room)
    monkeypatch.undo()
    program = engine_module._program(engine.pace)
    traced = program.trace(engine._tables, engine._start[0], engine._states[0], sums, queue)
    names = primitives(traced.jaxpr)
    assert len(names) > 500
    assert not [name for name in names if "callback" in name or "infeed" in name or "outfeed" in name]
    assert names.count("while") > 5


def test_compiled_once_for_a_shape(loop: ClosedLoop) -> None:
    JaxClosedLoop(loop, 5, streams=1, lanes=LANES).tally(0, 10)
    one = JaxClosedLoop(loop, 5, streams=1, lanes=LANES)
    program = engine_module._program(one.pace)
    before = program._cache_size()
    for seed in (6, 7):
        JaxClosedLoop(loop, seed, streams=1, lanes=LANES).tally(seed, 20 * seed)
    assert program._cache_size() == before


@pytest.mark.usefixtures("small_traces")
def test_traces_of_any_ids_in_any_room(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = survey_world("mazes-2").loop()
    ids = (2**32 - 1, 0, *range(40, 57), 45)
    expected = trace_rollouts(loop, 9, ids)
    for few in (expected[:16], expected[16:]):  # traced in one call each: both need the room that the others have
        assert 128 <= max(len(trace.cells) for trace in few) < 256
        assert 64 <= max(len(trace.events) for trace in few) < 128
    monkeypatch.setattr(engine_module, "TRACE_STEPS", 16)
    monkeypatch.setattr(engine_module, "TRACE_EVENTS", 16)
    for mine, theirs in zip(JaxClosedLoop(loop, 9, streams=1, lanes=LANES).traces(ids), expected, strict=True):
        assert_same_trace(mine, theirs)


def test_a_made_up_limit_is_a_timeout(loop: ClosedLoop) -> None:
    cut = loop.until(7)
    tally = JaxClosedLoop(cut, 5, streams=1, lanes=LANES).tally(0, 200)
    assert tally.outcomes[Outcome.STEP_LIMIT] > 150
    assert tally == run_range(cut, 5, 0, 200)[0]


def test_lanes_begin_at_the_first_hit(loop: ClosedLoop) -> None:
    engine = JaxClosedLoop(loop, 5, streams=1, lanes=LANES)
    results = assert_same_runs(engine, loop, 600)
    nominal, first = engine._nominal, engine._nominal.first_hits(tolerances(5, range(600), loop.robots))
    hit = first < NO_HIT
    np.testing.assert_array_equal(hit, results.alive < loop.robots)
    for rollout, (trace, found) in enumerate(zip(trace_rollouts(loop, 5, range(600)), first, strict=True)):
        hits = trace.events[trace.events[:, 2] == EventKind.HIT]
        if not hit[rollout]:
            assert len(hits) == 0
            continue
        step, robot = hits[0, :2]
        assert found in nominal.own[robot]
        begins = nominal.begins[nominal.begin_of[found]]
        assert begins <= step < min(nominal.begins[nominal.begins > begins], default=step + 1)
    assert 30 < hit.sum() < 600


@pytest.mark.parametrize(
    "name", ["crossings-0", "deadly-7", "rooms-4", pytest.param("many-levels-4", marks=pytest.mark.slow)]
)
@pytest.mark.usefixtures("few_lanes")
def test_few_snapshots_deadlines_and_other_threats_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = survey_world(name)
    loop, safer = one.loop(), World.create(one.world.threat * np.float32(0.1))
    steps = nominal_of(loop, LANES).begins
    for cut in (0, 1, int(steps[len(steps) // 2]), int(steps[-1])):
        assert_same_runs(
            JaxClosedLoop(loop, 3, streams=1, lanes=LANES).until(cut), loop.until(cut), 60, f"{name} {cut}"
        )
    engine = JaxClosedLoop(loop, 3, streams=1, lanes=LANES).under(safer)
    results = assert_same_runs(engine, loop.under(safer), 100, name)
    assert (results.alive == loop.robots).sum() > 5
    monkeypatch.setattr(engine_module, "nominal_of", lambda loop, most: nominal_of(loop, 5))
    few = JaxClosedLoop(loop, 3, streams=1, lanes=LANES)
    assert len(few._nominal.begins) == 5 < len(steps)
    assert_same_runs(few, loop, 100, f"{name}, 5 snapshots")


def test_where_nobody_is_hit_no_lane_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    safe = survey_world("safe-1")
    calls = count_dispatches(monkeypatch)
    assert_same_runs(JaxClosedLoop(safe.loop(), 5, streams=1, lanes=LANES), safe.loop(), 10_000)
    assert len(calls) == 1  # the nominal run


def test_tables_are_as_large_as_what_is_accessible() -> None:
    threat = np.full((400, 400), np.nan, dtype=np.float32)
    threat[0, :], threat[:, 399] = 0.0, 0.001
    world = World.create(threat)
    loop = compile_closed_loop(make_plan(world, np.array([[0, 0], [0, 5]])), world)
    tables = lane_tables(loop, 0)
    assert len(loop.cells) == 799 and tables.size == 896
    assert sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(tables)) < 7 * 896**2 + 2**20


@pytest.mark.parametrize("optimised", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_two_devices_are_one(optimised: bool) -> None:
    expected, results = run_range(beyond_a_word(), 5, 3, 200, singles=True)
    assert results is not None and results.bisected.sum() > 200
    script = (
        "import jax; from test_mrac_jax_closed_loop import JaxClosedLoop, beyond_a_word;"
        "assert len(jax.devices()) == 2;"
        "engine = JaxClosedLoop(beyond_a_word(), 5, lanes=64); tally = engine.tally(3, 200);"
        "print(len(set(engine._devices)), tally.visits.tolist(), tally.time.tolist(), tally.visited.tolist())"
    )
    flags = "" if optimised else os.environ.get("XLA_FLAGS", "")
    environment = {
        **os.environ,
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=2",
        "PYTHONPATH": str(Path(__file__).parent),
    }
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    counts = (expected.visits.tolist(), expected.time.tolist(), expected.visited.tolist())
    assert done.stdout.strip() == f"2 {counts[0]} {counts[1]} {counts[2]}"


@pytest.mark.parametrize("engine", ["numba", "jax"])
@pytest.mark.usefixtures("few_lanes", "small_traces")
def test_chunks_add_up_under_one_contract(loop: ClosedLoop, engine: str) -> None:
    *_, last = run_closed_chunks(loop, seed=5, start=10, count=200, engine=engine, checkpoints=(7, 99))  # type: ignore[arg-type]
    assert last.tally == run_range(loop, 5, 10, 200)[0]
    runner = closed_loop_engine(loop, 5, engine)  # type: ignore[arg-type]
    assert runner.tally(10, 200) == last.tally
    assert_same_results(runner.results(10, 20), run_range(loop, 5, 10, 20, singles=True)[1])  # type: ignore[arg-type]
    assert [trace.rollout for trace in runner.traces((4, 2))] == [4, 2]


def test_what_the_lanes_cannot_do_is_a_clear_error(loop: ClosedLoop) -> None:
    with pytest.raises(UsageError, match="engine"):
        closed_loop_engine(loop, 5, "fast")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="seed"):
        closed_loop_engine(loop, -1, "jax")
    wide = np.zeros((2, 5001), dtype=np.float32)
    world = World.create(wide)
    with pytest.raises(WorldError, match=r"10002 of them accessible; expected at most 10000 .*engine='numba'"):
        JaxClosedLoop(compile_closed_loop(make_plan(world, np.array([[0, 0]])), world, tabled=False), 1)
    one = survey_world("crossings-2")
    inside = replace(one, settings=replace(one.settings, transit="area")).loop()
    with pytest.raises(UsageError, match=r"engine='jax' with transit='area'; expected .*; use engine='numba'"):
        closed_loop_engine(inside, 5, "jax")
    assert closed_loop_engine(inside, 5).name == "numba"


def test_flags_of_jax_change_no_count() -> None:
    """All flags that would stop the program, or change what it means, at once."""
    with ExitStack() as flags:
        for name, value in FLAGS.items():
            flags.enter_context(getattr(jax, name)(value))
        results = compare(first_worlds(1)[0], 100)
    assert len(results.visited) == 100


# What JAX's lanes do beside the paper's runs, against the compiled simulator: maps in doubt, ranges, given paths, and
# missions under way.


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
    state = PythonLoop(plan, world).state_at(11, 4, 2)
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
        whole = PythonLoop(plan, world)
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
