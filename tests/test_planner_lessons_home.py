"""Robots that come home while hazards teach them, or threats change: both engines, by what is believed by then."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import test_planner_experience
from closed_loop_compare import followed
from numpy.typing import NDArray
from test_planner_phases import POLICIES, changing
from test_planner_unknown_home import HOMES, Believed, check_ways

from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import Doing, EventKind, Trace
from planner.world.changing_maps import with_phases
from planner.world.generate import Stream
from planner.world.world import World

LEVELS = 512
"""More than a world of hazards has values: none is quantised, and what is believed can be told by its p."""


def hazards(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world of robots that learn, with a detector or without one."""
    world, starts, settings = test_planner_experience.drawn(number)
    return world, starts, replace(settings, range=None, levels=LEVELS)


def phases(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world of threats that change, and that robots are told of."""
    world, starts = changing(3 * number, Stream(number, 1616))
    return world, starts, Settings(**POLICIES[number % len(POLICIES)] | {"range": None})


def as_happened(trace: Trace, world: World, *_: Any) -> Believed:
    """p by Bayes' rule, of what visits and stops told: three survived visits of a cell at most."""
    hazard: Any = world.doubt
    hits, sure = hazard.h.ravel().astype(np.float64), {0.0, 1.0}
    first = hazard.q.ravel().astype(np.float64)
    chance, passed = first.copy(), np.zeros(first.size, dtype=int)

    def believed(step: int) -> NDArray[np.float64]:
        for robot, (cell, doing) in enumerate(zip(trace.cells[step].tolist(), trace.doing[step].tolist(), strict=True)):
            was = trace.doing[step - 1, robot] if step else None
            if doing == Doing.DEAD != was:
                chance[cell] = float(hazard.kind == "persistent")
            elif doing != Doing.DEAD and (step == 0 or cell != trace.cells[step - 1, robot]):
                passed[cell] += 1
                if chance[cell] not in sure and passed[cell] <= 3:
                    chance[cell] = chance[cell] * (1 - hits[cell]) / (1 - chance[cell] * hits[cell])
        p = np.where(np.isnan(world.threat.ravel()), np.nan, chance * hits)
        return np.where(p == 1, np.nan, p)

    return believed


def as_told(trace: Trace, world: World, *_: Any) -> Believed:
    """p of the phase that the next step is in."""
    changes: Any = world.phases

    def believed(step: int) -> NDArray[np.float32]:
        return changes.threats[max(n for n, begin in enumerate(changes.begins) if begin <= step + 1)].ravel()

    return believed


DRAWN = {"hazards": (hazards, as_happened), "phases": (phases, as_told)}


def agree(kind: str, number: int, rollouts: int = 2) -> NDArray[np.int64]:
    """Both engines, in a drawn world; how often robots were surprised, came home, and went there as was checked."""
    make, by = DRAWN[kind]
    world, starts, settings = make(number)
    given = HOMES[number // 3 % len(HOMES)]
    plan = make_plan(world, starts, replace(settings, **given))
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    traces = trace_rollouts(loop, number, range(rollouts))
    runs, known = zip(*(followed(readable, number, rollout) for rollout in range(rollouts)), strict=True)
    assert traces == list(known), number
    tally, singles = run_range(loop, number, 0, 64, threads=2, singles=True)
    assert singles is not None
    assert singles.home[:rollouts].tolist() == [int(run.home.sum()) for run in runs]
    np.testing.assert_array_equal(tally.home, np.bincount(singles.home, minlength=len(starts) + 1))
    if given == {"return_to": "home"} and kind == "phases":  # where it came from it can always go back
        np.testing.assert_array_equal(singles.home, singles.alive)
    events = np.concatenate([trace.events[:, 2] for trace in traces])
    found = [int((events == event).sum()) for event in (EventKind.SURPRISED, EventKind.HOME)]
    learns: Any = world.doubt
    if kind == "hazards" and (learns.detector is not None or not loop.learns):
        return np.array([*found, 0])
    for trace in traces if loop.learns else ():
        check_ways(trace, world, plan, by(trace, world))
    return np.array([*found, sum(int((trace.doing == Doing.RETURNING).sum()) for trace in traces)])


@pytest.mark.parametrize("kind", DRAWN)
def test_engines_agree_on_drawn_worlds_and_go_by_what_is_believed(kind: str) -> None:
    assert (sum(agree(kind, number) for number in range(60)) > 30).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", DRAWN)
@pytest.mark.parametrize("part", range(4))
def test_so_they_do_on_a_thousand_worlds(kind: str, part: int) -> None:
    assert (sum(agree(kind, number) for number in range(60 + part, 1060, 4)) > 100).all()


def test_a_phase_that_begins_turns_who_is_on_its_way_home_by_hand() -> None:
    """Two by six cells, all visited at step 11 in [1, 0], home in [0, 5]: from step 14 on danger is above."""
    later = np.zeros((2, 6))
    later[0, 2:5] = 0.5
    world = with_phases(World.create(np.zeros((2, 6))), [(14, later)])
    plan = make_plan(world, [[0, 0]], Settings(return_to=((0, 5),)))
    assert plan.robots[0].path.tolist() == [0, 1, 2, 3, 4, 5, 11, 10, 9, 8, 7, 6, 0, 1, 7, 8, 9, 10, 11, 5]
