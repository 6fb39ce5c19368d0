"""Robots that learn the map and come home: by what is believed, as both engines and the plainest search say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import followed
from numpy.typing import NDArray
from test_planner_home import ways
from test_planner_unknown import POLICIES, drawn

from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.simulator.exact_tree import WHOLE, grow_tree
from planner.tally import Doing, EventKind, Trace
from planner.world.features import with_prior, with_truth
from planner.world.generate import Stream
from planner.world.world import World

Believed = Callable[[int], NDArray[Any]]
"""p `[N]`, NaN = obstacle, as robots believe the map at the end of a step; asked of steps in order."""
HOMES: list[dict[str, Any]] = [
    {"return_to": "home"},
    {"return_to": "nearest", "range": 12},
    {"return_to": "home", "range": 10, "recharge": 2},
    {"return_to": "nearest", "deadline": 18},
    {"return_to": "home", "range": 14, "recharge": 3, "deadline": 40},
]


def planned(number: int) -> tuple[World, World, Plan, dict[str, Any]]:
    """A drawn world, what is believed of it, a plan, and what robots see."""
    stream = Stream(number, 1515)
    believed, truth, starts, sense = drawn(number, stream)
    world, settings = with_truth(World.create(believed), truth, sense), Settings(**POLICIES[number % len(POLICIES)])
    settings = replace(settings, in_area="boustrophedon" if number % 4 == 1 else "nearest")
    return world, World.create(believed), make_plan(world, starts, replace(settings, **HOMES[number % 5])), sense


def agree(number: int, rollouts: int = 2) -> tuple[int, int]:
    """Both engines, in a drawn world; how often robots were surprised, and came home."""
    world, _, plan, sense = planned(number)
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    traces = trace_rollouts(loop, number, range(rollouts))
    runs, known = zip(*(followed(readable, number, rollout) for rollout in range(rollouts)), strict=True)
    assert traces == list(known), number
    _, singles = run_range(loop, number, 0, 64, threads=2, singles=True)
    assert singles is not None
    assert singles.home[:rollouts].tolist() == [int(run.home.sum()) for run in runs]
    if HOMES[number % 5] == {"return_to": "home"}:  # where it came from it can always go back
        np.testing.assert_array_equal(singles.home, singles.alive)
    for trace in traces if not sense["sight"] else ():
        check_ways(trace, world, plan, as_seen(trace, world, plan, sense))
    events = np.concatenate([trace.events[:, 2] for trace in traces])
    return int((events == EventKind.SURPRISED).sum()), int((events == EventKind.HOME).sum())


def as_seen(trace: Trace, world: World, plan: Plan, sense: dict[str, Any]) -> Believed:
    """What was seen from where robots were is as it is, all else as they were told."""
    cells = np.stack(np.indices(world.shape)).reshape(2, -1)
    true, belief = world.met.ravel(), world.threat.ravel().astype(np.float64).copy()

    def look(robots: list[int]) -> None:
        for place in np.stack(np.divmod(robots, world.shape[1]), axis=1):
            seen = ((cells - place[:, None]) ** 2).sum(axis=0) <= sense["range"] ** 2
            belief[seen] = true[seen]

    def believed(step: int) -> NDArray[np.float64]:
        look([cell for cell, doing in zip(trace.cells[step], trace.doing[step], strict=True) if doing != Doing.DEAD])
        return belief

    look((plan.starts @ [world.shape[1], 1]).tolist())
    return believed


def check_ways(trace: Trace, world: World, plan: Plan, believed: Believed) -> None:
    """Who is on its way home goes by the safest way, as the map is believed at the end of the step before."""
    problem, starts = prepare(world, plan.starts, plan.settings or Settings()), plan.starts
    assert problem.unknown is not None and problem.home is not None
    values = problem.levels.values
    for step in range(trace.time):
        free = {cell: float(p) for cell, p in enumerate(believed(step)) if not np.isnan(p)}
        level = {cell: int(np.abs(values - p).argmin()) for cell, p in free.items()}
        entry = {cell: int(problem.entry[of]) for cell, of in level.items() if abs(values[of] - free[cell]) < 1e-6}
        assert all(cell in entry for cell in free if problem.unknown.within[cell])  # others' p may have no price
        for robot in np.flatnonzero(trace.doing[step] == Doing.RETURNING):
            own = starts[robot : robot + 1] if plan.settings.return_to == "home" else starts  # type: ignore[union-attr]
            bases = [int(row * world.shape[1] + col) for row, col in own]
            found = ways(world, [base for base in bases if base in entry], entry)
            before, after = int(trace.cells[step, robot]), int(trace.cells[step + 1, robot])
            assert found[after] == (found[before][0] - entry[after], found[before][1] - 1)


def test_engines_agree_on_drawn_worlds_and_go_by_what_is_believed() -> None:
    found = np.array([agree(number) for number in range(60)])
    assert (found.sum(axis=0) > 100).all()


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_so_they_do_on_thousands_of_worlds(part: int) -> None:
    found = np.array([agree(number) for number in range(100 + part, 3100, 10)])
    assert (found.sum(axis=0) > 500).all()


def test_a_way_home_that_is_not_as_believed_by_hand() -> None:
    """A ring of eight cells around an obstacle: on the far side the robot sees that the way ahead is blocked."""
    blocked = np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, np.nan]])
    world = with_truth(World.create([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]), blocked, {"range": 1, "sight": False})
    plan = make_plan(world, [[0, 0]], Settings(return_to="home"))
    trace = trace_rollouts(compile_closed_loop(plan, world), 0, [0])[0]
    assert trace.cells[-1, 0] == 0 and len(np.unique(trace.cells)) == 7
    assert trace.events[-1, 2] == EventKind.HOME


def test_the_tree_of_robots_that_learn_and_come_home() -> None:
    world = with_prior(World.create([[0, 0.1, 0.1], [0, np.nan, 0.3], [0.2, 0, 0]]), 0.1, sense=1)
    plan = make_plan(world, [[0, 0], [2, 2]], Settings(return_to="nearest", range=14))
    loop = compile_closed_loop(plan, world)
    tree = grow_tree(loop, 0.0, 10**6)
    assert tree is not None and not tree.left
    chances, sampled = tree.counts.home / WHOLE, run_range(loop, 5, 0, 20_000)[0].home / 20_000
    assert (np.abs(sampled - chances) <= 5 * np.sqrt(chances * (1 - chances) / 20_000) + 1e-9).all()
    assert 0.05 < chances[2] < 0.95
