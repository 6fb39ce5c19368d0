"""Threats that change with time (docs/spec.md, section 16)."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from closed_loop_compare import assert_same_trace

from planner.kernels.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.kernels.nominal import with_nominal_run
from planner.mrac.make_plan import allocated_plan, make_plan
from planner.mrac.reference import ReferenceLoop
from planner.settings import Settings
from planner.trace import EventKind
from planner.worlds.changing import with_phases
from planner.worlds.generate import Stream, ThreatPattern, random_world
from planner.worlds.phases import PLAN_ON
from planner.worlds.world import World

POLICIES = (
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "reserve": 0.5}, {"policy": "frontier"},
    {"policy": "per_cell", "worth": 3.0}, {"policy": "watchful"}, {"wear": 3.0}, {"range": 12},
)  # fmt: skip


def changing(number: int, stream: Stream) -> tuple[World, np.ndarray]:
    """A small map, up to three others that follow, starts."""
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    free = np.array([stream.below(5) > 0 for _ in range(height * width)]).reshape(height, width)
    free.flat[stream.below(height * width)] = True
    levels, maps, begins = np.array([0.0, 0.0, 0.0, 0.1, 0.3]), [], [0]
    for _ in range(2 + stream.below(3)):
        drawn = levels[[stream.below(5) for _ in range(height * width)]].reshape(height, width)
        maps.append(np.where(free, np.where(stream.below(3) > 0, drawn, maps[-1] if maps else 0), np.nan))
        begins.append(begins[-1] + 1 + stream.below(12))
    world = with_phases(World.create(maps[0]), list(zip(begins[1:], maps[1:], strict=False)), PLAN_ON[number % 3])
    places = np.argwhere(free)
    return world, places[[stream.below(len(places)) for _ in range(1 + stream.below(5))]]


def agree(number: int) -> int:
    """Both engines, in a drawn world, and both plans; how often robots were surprised."""
    stream = Stream(number, 1616)
    world, starts = changing(number, stream)
    settings = Settings(**POLICIES[number % len(POLICIES)])
    if number % 5 == 0:
        settings = replace(settings, in_area="boustrophedon")
    plan, first_only = make_plan(world, starts, settings), number % 4 == 1
    luck = "step" if number % 7 == 0 and settings.wear == 1 else "tolerance"
    loop = compile_closed_loop(plan, world, first_only=first_only, luck=luck)
    readable, traces = ReferenceLoop(plan, world, first_only=first_only, luck=luck), trace_rollouts(loop, number, (0, 1))
    for trace in traces:
        assert_same_trace(trace, readable.trace(number, trace.rollout))
    quick = with_nominal_run(allocated_plan(world, starts, settings), loop)
    assert [robot.path.tolist() for robot in quick.robots] == [robot.path.tolist() for robot in plan.robots], number
    runs, tally = [readable.run(number, rollout) for rollout in range(4)], run_range(loop, number, 0, 4, threads=1)[0]
    assert tally.covered_survived.tolist() == sum(run.survived.astype(int) for run in runs).tolist(), number
    return sum(int((trace.events[:, 2] == EventKind.SURPRISED).sum()) for trace in traces)


def test_events_are_those_of_the_readable_simulator() -> None:
    assert sum(agree(number) for number in range(48)) > 20
