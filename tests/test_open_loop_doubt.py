"""The open loop where hazards are there or not, or the map is one of several: engines, traces, exact values."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_compare import assert_same_results
from doubt import WORLDS, expected, one_of, open_loop, persistent
from open_loop_reference import plan_of as external_plan

from analysis.theory.exact import open_loop_exact
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollout_sampling import Luck
from planner.rollouts.engine import Rolling, make_engine, open_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.settings import Settings
from planner.world.changing_maps import with_hazard, with_maps, with_spread
from planner.world.levels import place_starts
from planner.world.world import World

TINY = World.create([[0.0, 0.2, 0.0, 0.25, 0.0]])
PATHS = [[2, 3, 4, 3, 2, 1, 0], [2, 1, 0, 1, 2, 3, 4], [1, 0, 1, 2, 3]]


def plan_of(world: World) -> Plan:
    return make_plan(world, place_starts(world, 5)[0], Settings())


@pytest.mark.parametrize("name", WORLDS)
def test_engines_count_what_the_readable_luck_says(name: str) -> None:
    world = WORLDS[name]
    plan = plan_of(world)
    engine = make_engine(plan, world, Rolling("open", seed=4), "numba")
    tally, found = engine.run(0, 200)
    play = open_loop(plan, world)
    for rollout in range(60):
        visited, survived, alive = play(Luck(world, 4, rollout).hits)
        assert [found.visited[rollout], found.survived[rollout], found.alive[rollout]] == [visited, survived, alive]
    assert np.count_nonzero(tally.visited) > 4
    parts = open_loop_engine(compile_plan(plan, world), 4, "numba", threads=2)
    assert parts.tally(0, 77) + parts.tally(77, 123) == tally
    trace = next(iter(engine.traces([9])))
    assert len(np.unique(trace.cells)) == found.visited[9]


@pytest.mark.parametrize(
    "name", ["consumed", *(pytest.param(name, marks=pytest.mark.slow) for name in WORLDS if name != "consumed")]
)
def test_jax_counts_the_same(name: str) -> None:
    compiled = compile_plan(plan_of(WORLDS[name]), WORLDS[name])
    engines = [open_loop_engine(compiled, 4, engine) for engine in ("numba", "jax")]
    assert engines[1].tally(0, 777) + engines[1].tally(777, 9223) == engines[0].tally(0, 10_000)
    if name != "consumed":  # a program of its own
        assert_same_results(*(engine.results(70, 3000) for engine in engines))


@pytest.mark.parametrize("paths", [PATHS[:1], [[0, 1, 0, 1, 2]], PATHS], ids=["one", "to and fro", "three"])
@pytest.mark.parametrize("kind", ["persistent", "consumed", "maps"])
def test_exact_values_are_those_of_everything_that_can_happen(kind: str, paths: list[list[int]]) -> None:
    robots = len(paths)
    maps = [TINY.threat, np.where(TINY.threat > 0.2, np.float32(0.6), TINY.threat), 0 * TINY.threat]
    q, h = np.full(TINY.shape, 0.6), np.full(TINY.shape, 0.5)
    world = with_maps(TINY, maps) if kind == "maps" else with_hazard(TINY, kind, q, h)
    draw = (
        one_of([one.ravel() for one in maps])
        if kind == "maps"
        else persistent(world.doubt.q.ravel(), world.doubt.h.ravel(), kind == "consumed")
    )
    plan = external_plan(world, paths)
    visited, survived, alive = expected(open_loop(plan, world), draw)
    exact = open_loop_exact(plan, world)
    if kind == "consumed" and robots > 1:  # what one robot hits is gone for the others
        assert not exact.is_known
    else:
        assert exact.is_known
        np.testing.assert_allclose([exact.visited, exact.survived], [visited, survived], rtol=1e-9)
        np.testing.assert_allclose(exact.alive_chance @ np.arange(robots + 1), alive, rtol=1e-9)
        np.testing.assert_allclose(exact.stops_by_cell.sum(), robots - alive, rtol=1e-9)
    tally = make_engine(plan, world, Rolling("open", seed=2), "numba").tally(0, 40_000)
    for name, value in (("visited", visited), ("survived", survived), ("alive", alive)):
        counts = getattr(tally, name)
        mean = counts @ np.arange(len(counts)) / 40_000
        error = np.sqrt(counts @ (np.arange(len(counts)) - mean) ** 2) / 40_000
        assert abs(mean - value) <= 5 * error, name


def test_one_robot_is_exact_by_level_and_teams_are_known_robot_by_robot() -> None:
    world = with_spread(TINY, "lognormal", 0.5, "level")
    chances, column = world.doubt.chances.astype(float), world.doubt.column.ravel()
    low, high = ((1 - chances[:, column[cell]]) ** 2 for cell in (1, 3))  # PATHS[0] enters cell 1 once, cell 3 twice
    survival = np.sqrt(low).mean() * high.mean()
    exact = open_loop_exact(external_plan(world, PATHS[:1]), world)
    np.testing.assert_allclose(exact.survival, [survival], rtol=1e-9)
    np.testing.assert_allclose(exact.visited_by_cell[4], np.sqrt(high).mean(), rtol=1e-9)
    team = open_loop_exact(external_plan(world, PATHS), world)
    assert not team.is_known
    np.testing.assert_allclose(team.survival[0], survival, rtol=1e-9)
