"""The closed loop of another planner's paths: who follows them, and what becomes of the cells of a stopped robot."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace
from numpy.typing import NDArray
from oracle_tree import closed_loop_exact

from planner.errors import PlanError
from planner.mrac.problem import ready_loop
from planner.mrac.simulate import ReferenceLoop, Run, simulate
from planner.plan.plan import Plan, RobotPlan
from planner.rollouts.engine import Rolling, make_engine
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import Doing, EventKind, Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

SEED = 20261122


def paths_plan(world: World, *paths: list[int]) -> Plan:
    """Another planner's plan: these cells."""
    robots = tuple(RobotPlan(np.array(path, dtype=np.int64)) for path in paths)
    return Plan(world.shape, world.sha256, None, robots, outcome="end_of_paths")


def wanderings(world: World, robots: int, steps: int, rng: np.random.Generator) -> Plan:
    """Paths that wander, wait now and then, cross each other, and leave cells out."""
    height, width = world.shape
    safe = np.flatnonzero(world.threat.ravel() == 0)

    def beside(cell: int) -> list[int]:
        row, col = divmod(cell, width)
        near = [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]
        inside = [r * width + c for r, c in near if 0 <= r < height and 0 <= c < width]
        return [cell, *(other for other in inside if not np.isnan(world.threat.ravel()[other]))]

    paths = []
    for _ in range(robots):
        path = [int(rng.choice(safe))]
        while len(path) <= steps:
            path.append(int(rng.choice(beside(path[-1]))))
        paths.append(path)
    return paths_plan(world, *paths)


def map_of(seed: int) -> World:
    return random_world(5, 7, ThreatPattern(areas=4, levels=(0.05, 0.2, 0.4), seed=seed), threats=0.4, obstacles=0.1)


def run_by_hand(plan: Plan, world: World, hits: set[tuple[int, int]]) -> Run:
    """The run in which just these (robot, step) are stopped."""
    problem, areas = ready_loop(plan, world)
    return simulate(problem, areas, hit=lambda robot, step, cell: (robot, step) in hits)


def routes(run: Run) -> list[list[int]]:
    return [path.tolist() for path in run.paths]


def test_without_a_hit_paths_are_followed_and_what_they_leave_out_is_done_after_them() -> None:
    world = World.create(np.zeros((2, 4)))
    plan = paths_plan(world, [0, 0, 1, 1, 2], [7])
    run = run_by_hand(plan, world, set())
    # robot 1, at its path's end from the start, takes the cells on nobody's path: first 3, beside it
    mine, other = routes(run)
    assert mine[:5] == [0, 0, 1, 1, 2] and other[:2] == [7, 3]
    assert run.outcome is Outcome.COMPLETE and run.visited.all()


def test_what_a_stopped_robot_leaves_is_taken_by_who_is_done_first() -> None:
    world = World.create([[0.0, 0.5, 0.0, 0.0, 0.0, 0.0]])
    plan = paths_plan(world, [0, 1, 2, 3], [5, 4])
    run = run_by_hand(plan, world, {(0, 1)})
    assert routes(run) == [[0, 1], [5, 4, 3, 2]]
    assert [area.cells.tolist() for area in run.areas_added] == [[2, 3]]
    assert run.outcome is Outcome.COMPLETE and run.alive.tolist() == [False, True]


def test_a_robot_on_its_given_path_neither_shares_nor_gives_way() -> None:
    world = World.create(np.zeros((3, 6)))
    whole = [0, 1, 2, 3, 4, 5, 11, 10, 9, 8, 7, 6, 12, 13, 14, 15, 16]
    run = run_by_hand(paths_plan(world, whole, [17]), world, set())
    assert routes(run) == [whole, [17]]
    assert run.shares == 0


def test_the_cells_left_are_cut_by_level_and_connection() -> None:
    world = World.create([[0.0, 0.1, 0.1, 0.0, 0.2, 0.0, 0.0]])
    plan = paths_plan(world, [0, 1, 2, 3, 4, 5], [6])
    run = run_by_hand(plan, world, {(0, 1)})
    assert [(area.level, area.cells.tolist()) for area in run.areas_added] == [(0, [3]), (0, [5]), (1, [2]), (2, [4])]


@pytest.mark.parametrize("seed", range(12))
def test_the_compiled_simulator_follows_event_for_event(seed: int) -> None:
    rng, world = np.random.default_rng(seed), map_of(seed)
    plan = wanderings(world, int(rng.integers(1, 5)), int(rng.integers(0, 25)), rng)
    first_only = seed % 3 == 0
    reference = ReferenceLoop(plan, world, first_only=first_only)
    expected = [reference.trace(SEED, rollout) for rollout in range(12)]
    runs = [reference.run(SEED, rollout) for rollout in range(40)]
    for tabled in (True, False):
        loop = compile_closed_loop(plan, world, first_only=first_only, tabled=tabled)
        for trace, other in zip(trace_rollouts(loop, SEED, range(12)), expected, strict=True):
            assert_same_trace(trace, other, f"seed {seed}, rollout {other.rollout}")
        results = run_range(loop, SEED, 0, 300, threads=1, singles=True)[1]
        assert results is not None
        for rollout, run in enumerate(runs):
            found = (results.visited[rollout], results.survived[rollout], results.time[rollout])
            assert found == (run.visited.sum(), run.survived.sum(), run.time)
            assert results.outcome[rollout] == run.outcome


def test_every_rollout_covers_what_it_covers_open_loop_and_more() -> None:
    gained: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    for seed in range(8):
        world = map_of(seed)
        plan = wanderings(world, 3, 20, np.random.default_rng(seed))
        alone = make_engine(plan, world, Rolling("open", seed=SEED), "numba").results(0, 500)
        closed = make_engine(plan, world, Rolling("closed", seed=SEED), "numba").results(0, 500)
        gained = np.concatenate([gained, closed.visited - alone.visited])
    assert gained.min() >= 0
    assert np.median(gained) > 0


def test_sampled_values_are_those_of_enumeration() -> None:
    world = World.create([[0.0, 0.3, 0.0], [0.2, 0.0, 0.5], [0.0, 0.4, 0.0]])
    plan = paths_plan(world, [0, 1, 2, 5], [6, 3, 3, 4])
    exact = closed_loop_exact(plan, world)
    count = 40_000
    results = run_range(compile_closed_loop(plan, world), SEED, 0, count, singles=True)[1]
    assert results is not None
    for sampled, value in ((results.visited, exact.visited), (results.time, exact.time), (results.alive, exact.alive)):
        assert abs(sampled.mean() - value) <= 5 * sampled.std() / np.sqrt(count)
    chances = np.bincount(results.visited, minlength=10) / count
    assert np.abs(chances - exact.visited_chance).max() < 5 * 0.5 / np.sqrt(count)


def test_the_plan_need_not_name_its_map_but_must_not_name_another() -> None:
    world, other = map_of(1), map_of(2)
    plan = wanderings(world, 2, 9, np.random.default_rng(1))
    assert ready_loop(Plan(plan.shape, "", None, plan.robots, outcome="end_of_paths"), world)[1]
    with pytest.raises(PlanError, match="another map"):
        compile_closed_loop(plan, other)


def test_every_kind_of_event_comes_about() -> None:
    kinds, doing = set[int](), set[int]()
    for seed in range(8):
        world = map_of(seed)
        plan = wanderings(world, 3, 12, np.random.default_rng(seed))
        for trace in trace_rollouts(compile_closed_loop(plan, world), SEED, range(20)):
            kinds.update(trace.events[:, 2].tolist())
            doing.update(trace.doing.ravel().tolist())
    assert {EventKind.HIT, EventKind.REALLOCATED, EventKind.ALLOCATED, EventKind.SHARED, EventKind.COMPLETED} <= kinds
    assert doing == set(Doing) - {Doing.IDLE, Doing.RETURNING, Doing.CHARGING}
