"""The compiled classical simulator against it as Python, the fixtures and exact values; and its own contract."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import pytest
from closed_loop_worlds import walled
from conftest import Fixture, load_fixture, worlds_with_starts
from helpers import assert_same_results, play_both_ways, run_closed_chunks
from hypothesis import given
from numba import typeof

from planner.errors import PlanError
from planner.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, new_cells, run_range
from planner.rollouts.loop import FEATURES, PROGRAMS, ClosedLoop, typed, with_features
from planner.rollouts.runners import KNOWN, LEAST_SHARED, _in_rounds
from planner.rollouts.single_run import PythonLoop
from planner.rollouts.tables import most_cost
from planner.settings import Settings
from planner.simulator import return_home as cache_path
from planner.simulator.codes import BLOCKED, EventKind, Outcome
from planner.simulator.searches import neighbour_table
from planner.simulator.state import first_room, largest_group, make_state, make_work
from planner.tally import RolloutResults, Tally, Trace
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World


def fed(fixture: Fixture) -> ClosedLoop:
    return compile_closed_loop(fixture.plan, fixture.world)


def counted(traces: list[Trace], cells: int) -> dict[str, np.ndarray]:
    """Counts per cell and step of these rollouts, entry by entry."""
    counts = {name: np.zeros(cells, int) for name in ("visits", "stops", "covered_visited", "covered_survived")}
    counts |= {name: np.zeros(max(trace.time for trace in traces) + 1, int) for name in ("new_visited", "new_survived")}
    for trace in traces:
        hits = {(step, robot) for step, robot, kind, *_ in trace.events.tolist() if kind == EventKind.HIT}
        covered = {"visited": set[int](), "survived": set[int]()}
        for step, robot in np.ndindex(trace.cells.shape):
            cell = int(trace.cells[step, robot])
            if step > 0 and cell == trace.cells[step - 1, robot]:
                continue
            counts["visits"][cell] += 1
            counts["stops"][cell] += (step, robot) in hits
            for name in ("visited", "survived")[: 1 if (step, robot) in hits else 2]:
                counts[f"new_{name}"][step] += cell not in covered[name]
                covered[name].add(cell)
        for name, found in covered.items():
            counts[f"covered_{name}"][list(found)] += 1
    return counts


def compare(
    world: World, plan: Plan, rollouts: int, seed: int = 3, first_only: bool = False, tabled: bool = True
) -> Tally:
    """Compiled runs, and those as Python, of the same ids: every outcome and every count equal."""
    runs = play_both_ways(plan, world, seed, rollouts, first_only=first_only, tabled=(tabled,))
    loop = compile_closed_loop(plan, world, first_only=first_only, tabled=tabled)
    tally, _ = run_range(loop, seed, 0, rollouts)
    for name, values in counted([run.trace for run in runs], world.threat.size).items():
        np.testing.assert_array_equal(getattr(tally, name).ravel(), values, err_msg=name)
    return tally


def test_threshold_runs_are_the_fixtures(fixture: Fixture) -> None:
    known = fixture.answers["threshold_runs"]
    _, singles = run_range(fed(fixture), known["seed"], 0, len(known["runs"]), singles=True)
    columns = [getattr(singles, name) for name in known["columns"]]
    assert np.stack(columns, axis=1).tolist() == known["runs"]
    run = PythonLoop(fixture.plan, fixture.world).run(known["seed"], 0)
    found = run.visited.sum(), run.survived.sum(), run.step, run.alive.sum(), run.outcome
    assert [int(value) for value in found] == known["runs"][0]


def test_robots_in_different_parts_get_stuck_alike() -> None:
    world = World.create([[0.0, 0.4, 0.0, np.nan, 0.0, 0.3], [0.2, 0.0, 0.4, np.nan, 0.0, 0.3]])
    tally = compare(world, make_plan(world, [[0, 0], [0, 4]]), 200)
    assert tally.outcomes[Outcome.NO_PROGRESS] >= 20
    assert tally.outcomes[Outcome.COMPLETE] >= 5


def test_both_kinds_of_share_happen_and_are_counted() -> None:
    world = random_world(7, 7, ThreatPattern("contiguous", 4, seed=2))
    plan = make_plan(world, place_starts(world, 6)[0])
    compare(world, plan, 40)
    loop = compile_closed_loop(plan, world)
    whole, first, rest = (run_range(loop, 3, *ids, singles=True)[1] for ids in ((0, 40), (0, 15), (15, 25)))
    assert whole.bisected.sum() > whole.divided.sum() > 0
    joined = RolloutResults.join([first, rest])
    assert [joined.bisected.tolist(), joined.divided.tolist()] == [whole.bisected.tolist(), whole.divided.tolist()]


def test_rollouts_that_cannot_share_have_no_shares() -> None:
    numbers = np.arange(3, dtype=np.int32)
    results = RolloutResults(0, numbers, numbers, numbers, numbers, np.zeros(3, np.int8))
    assert (results.bisected.tolist(), results.divided.tolist()) == ([0, 0, 0], [0, 0, 0])


def test_first_visit_checks_are_alike_and_kinder() -> None:
    world = random_world(8, 11, ThreatPattern("scattered", seed=5))
    starts, _ = place_starts(world, 3)
    plan = make_plan(world, starts)
    first = compare(world, plan, 30, first_only=True)
    every = compare(world, plan, 30)
    assert first.stops.sum() < every.stops.sum()


def test_a_made_up_limit_ends_as_timeout() -> None:
    world = World.create(np.zeros((4, 6)))
    plan = make_plan(world, [[0, 0]])
    tally, _ = run_range(compile_closed_loop(plan, world).truncated_at(5), 0, 0, 10)
    assert tally.outcomes[Outcome.STEP_LIMIT] == 10
    assert tally.visited[6] == 10
    assert tally.time[5] == 10


def test_chunks_threads_and_parts_do_not_matter() -> None:
    loop = fed(load_fixture("contiguous-14x23-1000-k8"))
    whole, _ = run_range(loop, 9, 0, 10_000, threads=1)
    assert run_range(loop, 9, 0, 10_000, threads=3)[0] == whole
    assert run_range(loop, 9, 0, 4096)[0] + run_range(loop, 9, 4096, 5904)[0] == whole
    *_, last = run_closed_chunks(loop, seed=9, count=10_000, chunk=4096)
    assert last.tally == whole
    chunks = run_closed_chunks(loop, seed=9, count=9000, chunk=8192, checkpoints=[4096, 8192])
    looked = [chunk.tally.rollouts for chunk in chunks]
    assert looked == [4096, 8192, 9000]


@pytest.fixture(params=[1, LEAST_SHARED], ids=["histories", "ids"])
def shared(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What threads share out of a few rollouts."""
    monkeypatch.setattr("planner.rollouts.runners.LEAST_SHARED", request.param)


def rolled(loop: ClosedLoop, start: int = 0, count: int = 3000, threads: int = 1) -> tuple[Tally, RolloutResults]:
    tally, singles = run_range(loop, 9, start, count, threads=threads, singles=True)
    return tally, singles


def test_sets_of_any_size_count_the_same(shared: None, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("contiguous-14x23-1000-k8", "scattered-14x23-1000-k8", "tiny-4x8-12-k2"):
        loop = fed(load_fixture(name))
        whole, singles = rolled(loop)
        parts = [rolled(loop, start, count, threads=2) for start, count in ((0, 1), (1, 2), (3, 1000), (1003, 1997))]
        assert sum((tally for tally, _ in parts[1:]), parts[0][0]) == whole
        assert_same_results(RolloutResults.join([found for _, found in parts]), singles)
        for most in (1, 33):
            with monkeypatch.context() as patch:
                patch.setattr("planner.rollouts.runners.LARGEST_GROUP", most)
                tally, found = rolled(loop, threads=3)
            assert tally == whole
            assert_same_results(found, singles)


def test_sets_are_as_small_as_memory_for_those_who_wait(shared: None, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = fed(load_fixture("contiguous-14x23-1000-k8"))
    whole, _ = rolled(loop)
    for room in (1, 60_000):
        monkeypatch.setattr("planner.simulator.state.STATE_BYTES", room)
        state = make_state(loop.first_state(first_room(loop.tables)), 3000)
        assert largest_group(state, 3000) == len(state.marks) < loop.robots
        assert rolled(loop)[0] == rolled(loop, threads=2)[0] == whole


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_threads_that_share_histories_count_as_one(monkeypatch: pytest.MonkeyPatch, policy: str) -> None:
    """However many sets are put aside, in however many rounds; where one thread's rollouts are all hit sooner, too."""
    fixture = load_fixture("contiguous-14x23-1000-k8")
    threat = fixture.world.threat.copy()
    threat[*np.transpose(fixture.starts)] = 0.1
    world = World.create(threat)
    loop = compile_closed_loop(make_plan(world, fixture.starts, Settings(policy=policy)), world)
    in_rounds: list[bool] = []

    def noted(*given: object) -> object:
        runners = _in_rounds(*given)  # type: ignore[arg-type]
        in_rounds.append(runners is not None)
        return runners

    monkeypatch.setattr("planner.rollouts.runners._in_rounds", noted)
    monkeypatch.setattr("planner.rollouts.runners.LEAST_SHARED", 1)
    for count in (3000, 41):
        whole, singles = rolled(loop, 7, count)
        for aside, threads, most in ((1, 2, 7), (2, 3, 500), (5, 2, 900), (19, 16, 9), (256, 2, 999), (256, 13, 9999)):
            monkeypatch.setattr("planner.rollouts.runners.MOST_DEFERRED", aside)
            monkeypatch.setattr("planner.rollouts.runners.LARGEST_GROUP", most)
            tally, found = rolled(loop, 7, count, threads)
            assert tally == whole
            assert_same_results(found, singles)
    assert in_rounds == 2 * [False, *[True] * 6]


def test_no_count_depends_on_the_coverage_paths_that_are_remembered(
    shared: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None; until words, or numbers, are used up; with hashes that meet; all."""
    loop = fed(load_fixture("contiguous-14x23-1000-k8"))
    whole, singles = rolled(loop)
    for room in (0, 2**6, 2**9, 2**11, 2**14):
        monkeypatch.setattr("planner.simulator.state.REMEMBERED", room)
        for threads in (1, 3):
            KNOWN.clear()
            tally, found = rolled(loop, threads=threads)
            assert tally == whole
            assert_same_results(found, singles)


def test_a_coverage_path_is_remembered_by_all_of_its_key() -> None:
    """Hashes hardly ever meet on the worlds of these tests."""
    loop = fed(load_fixture("tiny-4x8-12-k2"))
    work = make_work(loop.tables, 1, True)
    work.paths[3:8] = 5, 3, 1, 2, 9
    for here, listed, same in ((5, [1, 2, 9], 1), (4, [1, 2, 9], 0), (5, [1, 2], 0), (5, [1, 2, 8], 0)):
        work.listed[: len(listed)] = listed
        assert cache_path.is_of.py_func(work, 3, here, len(listed)) == same


def test_areas_get_more_room_when_it_proves_too_small(shared: None, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = fed(load_fixture("contiguous-14x23-1000-k8"))
    whole, singles = rolled(loop)
    monkeypatch.setattr("planner.rollouts.runners.first_room", lambda tables: len(tables.level) + 2)
    tally, found = rolled(loop, threads=2)
    assert tally == whole
    assert_same_results(found, singles)
    curves = new_cells(loop, 9, 0, 40, threads=2)
    assert [curve.sum() for curve in curves] == singles.visited[:40].tolist()
    assert [len(curve) - 1 for curve in curves] == singles.time[:40].tolist()


@pytest.mark.slow
def test_a_state_of_32_bits_counts_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, singles = rolled(fed(load_fixture("contiguous-14x23-1000-k8")))
    monkeypatch.setattr("planner.simulator.state.MOST_NARROW", 10)
    loop = fed(load_fixture("contiguous-14x23-1000-k8"))
    assert loop.first_state(first_room(loop.tables)).home.dtype == np.uint32
    tally, found = rolled(loop)
    assert tally == whole
    assert_same_results(found, singles)


def test_costs_take_64_bits_only_where_a_path_may_need_them() -> None:
    for walls, cost in ((1, np.int32), (4, np.int64)):
        world = walled(walls)
        plan = make_plan(world, place_starts(world, 3)[0])
        loop = compile_closed_loop(plan, world)
        entry = prepare(world, plan.starts, plan.settings or Settings()).costs
        assert entry.sum() > 2**32
        assert loop.tables.cost_to.dtype == compile_closed_loop(plan, world, tabled=False).tables.cost_to.dtype == cost
        assert (loop.tables.cost_to.max() > 2**31) == (walls == 4)


@given(worlds_with_starts())
def test_no_path_costs_more_than_is_said(drawn: tuple[World, np.ndarray]) -> None:
    world, starts = drawn
    plan = make_plan(world, starts)
    problem = prepare(world, plan.starts, Settings())
    near = neighbour_table(world.shape, problem.costs != BLOCKED)
    cost_to = compile_closed_loop(plan, world).tables.cost_to
    assert cost_to.max() <= most_cost(near, problem.costs, problem.starts)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_costs_of_64_bits_come_to_the_same(policy: Any) -> None:
    world = walled(4)
    plan = make_plan(world, place_starts(world, 3)[0], Settings(policy=policy))
    assert compile_closed_loop(plan, world).tables.cost_to.dtype == np.int64
    tallies = [compare(world, plan, 30, tabled=tabled) for tabled in (True, False)]
    assert tallies[0] == tallies[1]
    assert tallies[0].visited[1:-1].sum() > 20


def test_large_seeds_address_other_rollouts() -> None:
    loop = fed(load_fixture("tiny-4x8-12-k2"))
    assert run_range(loop, 5, 0, 500)[0].visited.tolist() != run_range(loop, 5 + (7 << 32), 0, 500)[0].visited.tolist()


def worlds_and_plans(transit: Literal["grid", "area"]) -> Iterator[tuple[World, Plan]]:
    for seed, (height, width, robots) in enumerate([(6, 9, 1), (9, 6, 3), (7, 7, 6), (3, 14, 4), (5, 8, 20)]):
        world = random_world(height, width, ThreatPattern("contiguous", 4, seed=seed))
        yield world, make_plan(world, place_starts(world, robots)[0], Settings(transit=transit))


def test_distances_searched_for_are_the_tables_and_legs_within_areas_differ() -> None:
    visits: dict[Any, list[Any]] = {"grid": [], "area": []}
    for transit in visits:
        for world, plan in worlds_and_plans(transit):
            tabled, searched = (compile_closed_loop(plan, world, tabled=tabled) for tabled in (True, False))
            assert tabled.tabled and not searched.tabled
            tally = run_range(tabled, 3, 0, 500)[0]
            assert run_range(searched, 3, 0, 500)[0] == tally
            visits[transit].append(tally.visits)
            compare(world, plan, 10, tabled=False)
    assert sum(not np.array_equal(*both) for both in zip(*visits.values(), strict=True)) >= 3


def test_too_large_for_tables_is_searched_in_small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    world = random_world(20, 20, ThreatPattern(seed=1))
    plan = make_plan(world, place_starts(world, 4)[0])
    whole, _ = run_range(compile_closed_loop(plan, world), 1, 0, 5000)
    monkeypatch.setattr("planner.rollouts.closed_loop.MOST_TABLED", 100)
    loop = compile_closed_loop(plan, world)
    assert not loop.tabled
    tallies = [chunk.tally for chunk in run_closed_chunks(loop, seed=1, count=5000, checkpoints=[4096])]
    assert tallies[-1] == whole
    assert tallies[0].rollouts == 1
    assert 4096 in [tally.rollouts for tally in tallies]


def test_a_plan_for_another_map_is_refused() -> None:
    plan = make_plan(World.create(np.zeros((2, 3))), [[0, 0]])
    with pytest.raises(PlanError, match="another map"):
        compile_closed_loop(plan, World.create(np.zeros((3, 2))))


def features_of(loop: ClosedLoop) -> int:
    """How many features the program of the loop has."""
    tables = with_features(loop.tables)
    return sum(getattr(tables, name) is not None for name in FEATURES)


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_the_programs_of_common_and_of_plain_missions_are_the_whole_one(
    policy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = random_world(pattern=ThreatPattern(seed=3))
    plan = make_plan(world, place_starts(world, 4)[0], Settings(policy=policy))
    assert features_of(compile_closed_loop(plan, world)) == 0
    found = run_range(compile_closed_loop(plan, world), 7, 0, 3000, singles=True)
    for program in PROGRAMS[1:]:
        monkeypatch.setattr("planner.rollouts.loop.PROGRAMS", (program,))
        again = run_range(compile_closed_loop(plan, world), 7, 0, 3000, singles=True)
        assert found[0] == again[0]
        assert all(map(np.array_equal, vars(found[1]).values(), vars(again[1]).values()))


@pytest.mark.parametrize(
    ("settings", "tabled", "program"),
    [(Settings(), None, PROGRAMS[0]), (Settings(), False, PROGRAMS[1]), (Settings(transit="area"), None, PROGRAMS[1])],
)
def test_common_missions_search_for_nothing(settings: Settings, tabled: bool | None, program: int) -> None:
    world = random_world()
    plan = make_plan(world, place_starts(world, 4)[0], settings)
    assert features_of(compile_closed_loop(plan, world, tabled=tabled)) == program


@pytest.mark.parametrize("settings", [Settings(return_to="home"), Settings(radio=5.0)])
def test_other_missions_share_the_whole_program(settings: Settings) -> None:
    world = random_world()
    starts = place_starts(world, 4)[0]
    loops = [compile_closed_loop(make_plan(world, starts, of), world) for of in (settings, Settings())]
    assert list(map(features_of, loops)) == [PROGRAMS[-1], PROGRAMS[0]]
    others = (Settings(steps_per_move=(1, 2, 1, 1)), Settings(weibull_shape=2.0))
    more = [compile_closed_loop(make_plan(world, starts, of), world) for of in others]
    assert len({typeof(typed(with_features(loop.tables))) for loop in (loops[0], *more)}) == 1
