"""Traces: the compiled simulator's and the readable one's are equal, event for event, and tell what the counts tell."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from conftest import NAMES, load_fixture

from planner.errors import PlanError
from planner.ids import NO_AREA, NO_ROBOT
from planner.mrac.areas import bisect, metis_parts
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop, Run, Split, simulate
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import Doing, EventKind, Outcome, Trace
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

TEAMS = ((6, 9, 1), (9, 6, 3), (7, 7, 6), (3, 14, 4), (5, 8, 20))
KINDS: tuple[Kind, ...] = ("contiguous", "scattered")


def compare(
    world: World, plan: Plan, ids: range, seed: int = 5, first_only: bool = False, tabled: bool = True
) -> list[Trace]:
    """Compiled traces, each equal to the readable simulator's."""
    reference = ReferenceLoop(plan, world, first_only=first_only)
    traces = trace_rollouts(compile_closed_loop(plan, world, first_only=first_only, tabled=tabled), seed, ids)
    for rollout, trace in zip(ids, traces, strict=True):
        assert trace == reference.trace(seed, rollout), rollout
    return traces


def random_case(seed: int, settings: Settings | None = None) -> tuple[World, Plan]:
    height, width, robots = TEAMS[seed % len(TEAMS)]
    world = random_world(height, width, ThreatPattern(KINDS[seed % 2], 4, seed=seed))
    return world, make_plan(world, place_starts(world, robots)[0], settings or Settings())


def test_traces_of_the_fixtures() -> None:
    for name in (name for name in NAMES if name.startswith("tiny")):
        fixture = load_fixture(name)
        compare(fixture.world, make_plan(fixture.world, fixture.starts, allocation=fixture.allocation), range(3, 23))


def test_traces_of_random_worlds_and_all_that_happens_in_them() -> None:
    seen: Counter[str] = Counter()
    for seed in range(20):
        world, plan = random_case(seed)
        for trace in compare(world, plan, range(8), first_only=seed % 3 == 0):
            seen.update(EventKind(kind).name for kind in trace.events[:, 2])
            seen.update(Doing(doing).name for doing in np.unique(trace.doing))
            seen[trace.outcome.name] += 1
    of_mrac = set(EventKind) - {EventKind.LOOKED_AGAIN, EventKind.REFUSED, EventKind.RANGE_ENDED, EventKind.SURPRISED}
    stays = of_mrac - {EventKind.TURNED_HOME, EventKind.HOME, EventKind.CHARGED}
    doings = set(Doing) - {Doing.FOLLOWING, Doing.RETURNING, Doing.CHARGING}
    assert {kind.name for kind in stays} | {doing.name for doing in doings} <= seen.keys()
    assert {"COMPLETE", "ALL_ROBOTS_LOST"} <= seen.keys()


def test_traces_without_tables_and_inside_areas() -> None:
    for seed in range(10):
        transit = "area" if seed % 4 < 2 else "grid"
        world, plan = random_case(seed, Settings(transit=transit))  # type: ignore[arg-type]
        compare(world, plan, range(6), tabled=False)
        compare(world, plan, range(6), tabled=True)


def test_a_stuck_rollout_and_one_that_runs_out_of_time() -> None:
    world = World.create([[0.0, 0.4, 0.0, np.nan, 0.0, 0.3], [0.2, 0.0, 0.4, np.nan, 0.0, 0.3]])
    stuck = compare(world, make_plan(world, [[0, 0], [0, 4]]), range(60))
    assert Outcome.NO_PROGRESS in {trace.outcome for trace in stuck}
    late = compare(world, make_plan(world, [[0, 0], [0, 4]], Settings(max_steps=3)), range(10))
    assert Outcome.STEP_LIMIT in {trace.outcome for trace in late}
    assert max(trace.time for trace in late) == 3


def test_a_trace_tells_what_was_counted() -> None:
    for seed in range(6):
        world, plan = random_case(seed)
        loop = compile_closed_loop(plan, world)
        _, singles = run_range(loop, 5, 0, 12, singles=True)
        assert singles is not None
        for trace in trace_rollouts(loop, 5, range(12)):
            one = trace.rollout
            assert len(np.unique(trace.cells)) == singles.visited[one]
            assert (trace.time, int(trace.outcome)) == (singles.time[one], singles.outcome[one])
            assert np.count_nonzero(trace.doing[-1] != Doing.DEAD) == singles.alive[one]
            kinds = trace.events[:, 2].tolist()
            assert kinds.count(EventKind.SHARED) == singles.bisected[one] + singles.divided[one]
            assert kinds.count(EventKind.HIT) == plan.starts.shape[0] - singles.alive[one]


def test_events_announce_every_area() -> None:
    """Ids follow one another: those of t = 0, then as many as REALLOCATED and SHARED say."""
    for seed in range(10):
        world, plan = random_case(seed)
        for trace in trace_rollouts(compile_closed_loop(plan, world), 5, range(8)):
            made = np.isin(trace.events[:, 2], (EventKind.REALLOCATED, EventKind.SHARED))
            total = len(plan.areas) + int(trace.events[made, 4].sum())
            assert trace.area_of.max() < total
            assert np.array_equal(trace.area_of == NO_AREA, ~world.accessible(plan.starts).ravel())
            assert (trace.areas[trace.doing == Doing.DEAD] == NO_AREA).all()
            got = trace.events[trace.events[:, 2] == EventKind.ALLOCATED, 3]
            given = [number for number, area in enumerate(plan.areas) if area.robot != NO_ROBOT]
            assert set(trace.areas[trace.areas != NO_AREA].tolist()) <= set(got.tolist()) | set(given)


def test_traces_need_no_order_and_no_neighbours() -> None:
    world, plan = random_case(3)
    loop = compile_closed_loop(plan, world)
    whole = trace_rollouts(loop, 5, range(9))
    assert trace_rollouts(loop, 5, [7, 2]) == [whole[7], whole[2]]
    assert whole[7] != whole[2]
    assert trace_rollouts(loop, 5, []) == []


def test_a_plan_of_another_map_has_no_reference() -> None:
    _, plan = random_case(0)
    with pytest.raises(PlanError, match="another map"):
        ReferenceLoop(plan, World.create(np.zeros((2, 2))))


def test_areas_may_be_bisected_by_metis_instead() -> None:
    """The nominal run with METIS covers everything without a hit, and some robots go another way."""
    bisected = others = 0
    for seed in range(12):
        world = random_world(10, 10, ThreatPattern(seed=seed), threats=0.1)
        plan = make_plan(world, place_starts(world, 8)[0])
        usual, run = (nominal(plan, world, split) for split in (bisect, lambda *area: metis_parts(*area, 2)))
        assert run.outcome is Outcome.COMPLETE
        assert np.array_equal(run.visited, world.accessible(plan.starts).ravel())
        bisected += run.bisected
        others += any(not np.array_equal(mine, theirs) for mine, theirs in zip(run.paths, usual.paths, strict=True))
    assert bisected >= 10
    assert others >= 2


def nominal(plan: Plan, world: World, split: Split) -> Run:
    problem = prepare(world, plan.starts, plan.settings or Settings())
    return simulate(problem, plan.areas, split=split)


def test_an_owner_that_shares_before_it_has_entered_its_start() -> None:
    nan = np.nan
    for threat, starts in (
        ([[nan, 0, nan], [0, 0, 0]], [(0, 1), (1, 0)]),
        ([[0, nan, 0], [0, 0.2, 0]], [(0, 0), (1, 0)]),
    ):
        world = World.create(np.array(threat, dtype=np.float32))
        plan = make_plan(world, np.array(starts))
        loop, reference = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
        for trace in trace_rollouts(loop, 3, range(20)):
            assert trace == reference.trace(3, trace.rollout)
