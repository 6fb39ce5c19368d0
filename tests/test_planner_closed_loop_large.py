"""What 16 bits of areas and 64 bits of robots do not hold: the compiled simulator is the readable one's there too."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace

from planner.mrac.make_plan import allocated_plan, make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import EventKind, Trace
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

SEED = 3


def assert_same_rollouts(world: World, plan: Plan, rollouts: int) -> list[Trace]:
    """The readable simulator's traces are the compiled one's; in a set they come to the same."""
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    traces = trace_rollouts(loop, SEED, range(rollouts))
    for trace in traces:
        assert_same_trace(trace, readable.trace(SEED, trace.rollout))
    singles = run_range(loop, SEED, 0, rollouts, threads=1, singles=True)[1]
    assert singles is not None
    assert singles.time.tolist() == [trace.time for trace in traces]
    return traces


@pytest.mark.parametrize(("side", "robots"), [(20, 100), pytest.param(34, 1024, marks=pytest.mark.slow)])
def test_a_team_of_several_words(side: int, robots: int) -> None:
    world = random_world(side, side, ThreatPattern("scattered", side, seed=2))
    plan = make_plan(world, place_starts(world, robots)[0])
    happened = np.concatenate([trace.events for trace in assert_same_rollouts(world, plan, 4)])
    for kind in (EventKind.HIT, EventKind.SHARED):
        acted = happened[happened[:, 2] == kind, 1]
        assert acted.min() < 64 <= acted.max()


@pytest.mark.slow
def test_areas_of_more_than_16_bits() -> None:
    """A chessboard: every cell is an area, and robots in the last corner begin beyond the 65,536th."""
    threat = np.indices((362, 364)).sum(axis=0) % 2 * 0.2
    world = World.create(threat)
    plan = allocated_plan(world, [[361, 363], [361, 362], [360, 363]], Settings())
    assert len(plan.areas) == threat.size
    happened = np.concatenate([trace.events for trace in assert_same_rollouts(world, plan, 4)])
    for kind in (EventKind.HIT, EventKind.ALLOCATED):
        assert happened[happened[:, 2] == kind, 3].max() > 65_535
