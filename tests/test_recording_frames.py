"""Traces worked out step by step, against the readable simulator's own books."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds
from recordings import small_task
from rolling import rollout_results

from analysis.recording.frames import AreaMap, Held, area_maps, make_frames
from planner.ids import NO_AREA, NO_ROBOT, NO_STEP
from planner.mrac.board import State
from planner.mrac.executive import Executive
from planner.mrac.problem import prepare
from planner.mrac.simulate import play_step
from planner.plan.plan import Plan
from planner.rollout_sampling import Luck
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.open_loop_trace import open_loop_trace
from planner.simulator.closed_loop import compile_closed_loop, trace_rollouts
from planner.tally import Doing, EventKind, Outcome, Trace
from planner.world.world import World

HELD = {State.UNASSIGNED: Held.UNASSIGNED, State.ASSIGNED: Held.ASSIGNED, State.COMPLETED: Held.COMPLETED}
SURVEY = [one for one in first_worlds(30) if not one.first_only][:14]


def check_against_simulation(plan: Plan, world: World, seed: int, trace: Trace) -> None:
    """Drive the readable simulator through the same rollout, and compare its state at the end of every step."""
    assert plan.settings is not None
    problem = prepare(world, plan.starts, plan.settings)
    run, hit = Executive(problem, plan.areas), Luck(world, seed, trace.rollout).hits
    frames = make_frames(trace)
    maps = {areas.step: areas for areas in area_maps(trace, plan.areas)}
    areas = maps[0]
    for step in range(trace.time + 1):
        play_step(run, hit)
        assert frames.visited[step] == run.visited.sum()
        assert frames.survived[step] == run.survived.sum()
        assert frames.alive[step].tolist() == [robot.alive for robot in run.robots]
        areas = maps.get(step, areas)
        assert areas.open == sum(area.state is State.UNASSIGNED for area in run.areas)
        check_areas(areas, run)
    assert np.array_equal(frames.visited_at != NO_STEP, run.visited)
    assert np.array_equal(frames.survived_at != NO_STEP, run.survived)


def check_areas(areas: AreaMap, run: Executive) -> None:
    assert np.array_equal(areas.area, run.area_of)
    inside = areas.area != NO_AREA
    for number in np.unique(areas.area[inside]).tolist():
        cells = areas.area == number
        assert set(areas.held[cells].tolist()) == {HELD[run.areas[number].state]}, number
        assert set(areas.robot[cells].tolist()) == {run.areas[number].robot}
    assert (areas.robot[~inside] == NO_ROBOT).all()


@pytest.mark.parametrize("one", SURVEY, ids=lambda one: one.name)
def test_frames_are_the_simulators_state_at_every_step(one: SurveyWorld) -> None:
    plan = one.plan()
    for trace in trace_rollouts(one.loop(plan), one.seed, range(2)):
        check_against_simulation(plan, one.world, one.seed, trace)


@pytest.mark.slow
@pytest.mark.parametrize("one", [one for one in first_worlds(90) if not one.first_only], ids=lambda one: one.name)
def test_frames_on_many_worlds(one: SurveyWorld) -> None:
    plan = one.plan()
    for trace in trace_rollouts(one.loop(plan), one.seed, range(3, 9)):
        check_against_simulation(plan, one.world, one.seed, trace)


def test_first_visitors() -> None:
    world, plan = small_task()
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), 3, [11])
    frames = make_frames(trace)
    for cell in range(world.threat.size):
        entered = np.argwhere((trace.cells == cell) & frames.moved)
        if len(entered):
            assert (frames.visited_at[cell], frames.visited_by[cell]) == tuple(entered[0])
        else:
            assert frames.visited_at[cell] == frames.visited_by[cell] == NO_STEP


def test_events_that_do_not_fit_are_refused() -> None:
    world, plan = small_task()
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), 3, [11])
    with pytest.raises(ValueError, match="areas, but"):
        next(area_maps(trace, plan.areas[:1]))


# --- the open loop ---


@pytest.mark.parametrize("robots", [1, 4])
def test_open_loop_traces_come_to_what_the_engine_counts(robots: int) -> None:
    world, plan = small_task(robots, (9, 14), seed=6)
    results = rollout_results(compile_plan(plan, world), seed=9, start=100, count=60)
    for place, rollout in enumerate(range(100, 160)):
        trace = open_loop_trace(plan, world, 9, rollout)
        frames = make_frames(trace)
        assert trace.time == results.time[place]
        assert frames.visited[-1] == results.visited[place]
        assert frames.survived[-1] == results.survived[place]
        assert frames.alive_count[-1] == results.alive[place]
        assert trace.outcome == results.outcome[place]
        hits = trace.events[trace.events[:, 2] == EventKind.HIT]
        assert len(hits) == robots - results.alive[place]
        assert [trace.doing[step, robot] for step, robot, *_ in hits.tolist()] == [Doing.DEAD] * len(hits)


def test_one_robot_does_the_same_in_both_loops() -> None:
    """But for what it plans after it has been stopped, and for how an end is called."""
    for seed in range(6):
        world, plan = small_task(1, (7, 10), seed=seed)
        loop = compile_closed_loop(plan, world)
        for closed in trace_rollouts(loop, 1, range(8)):
            opened = open_loop_trace(plan, world, 1, closed.rollout)
            last = opened.time + 1
            assert np.array_equal(opened.cells, closed.cells[:last])
            ended = closed.outcome == Outcome.COMPLETE
            upto = last - 1 if ended else last  # a complete closed loop ends before it turns to what is next
            assert np.array_equal(opened.doing[:upto], closed.doing[:upto]), (seed, closed.rollout)
            assert np.array_equal(opened.areas[:upto], closed.areas[:upto])
            told = [EventKind.COMPLETED, EventKind.HIT, EventKind.ALLOCATED]
            kept = closed.events[np.isin(closed.events[:, 2], told) & (closed.events[:, 0] < last)]
            kinds = kept[kept[:, 2] != EventKind.COMPLETED], opened.events[opened.events[:, 2] != EventKind.COMPLETED]
            assert np.array_equal(kinds[0][:, [0, 1, 2, 3]], kinds[1][:, [0, 1, 2, 3]]), (seed, closed.rollout)
