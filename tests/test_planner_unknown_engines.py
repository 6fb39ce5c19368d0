"""Robots that are not told the map: the compiled closed loop is the readable one, event for event."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from closed_loop_worlds import survey_worlds
from test_planner_unknown import POLICIES, drawn, mixed_up

from planner.errors import WorldError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop
from planner.rollouts.engine import Rolling, closed_loop_engine, make_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.simulator.exact_tree import WHOLE, grow_tree
from planner.tally import Outcome
from planner.world.changing_maps import with_maps, with_spread
from planner.world.features import with_prior, with_sense, with_truth
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World


def paper_like(policy="mrac", sense=2, side=12, robots=4, **more):
    world = with_prior(random_world(side, side, ThreatPattern(seed=5)), 0.04, sense=sense)
    starts, _ = place_starts(world, robots)
    return world, make_plan(world, starts, Settings(policy=policy, **more))


def agree(number, rollouts=2):
    """Both engines, in a drawn world; how often robots were surprised."""
    stream = Stream(number, 1515)
    believed, truth, starts, sense = drawn(number, stream)
    world, settings = with_truth(World.create(believed), truth, sense), Settings(**POLICIES[number % len(POLICIES)])
    if number % 5 == 0:
        settings = replace(settings, range=4 + stream.below(12))
    settings = replace(settings, in_area="boustrophedon" if number % 4 == 1 else "nearest")
    plan = make_plan(world, starts, settings)
    first_only = number % 3 == 0
    loop = compile_closed_loop(plan, world, first_only=first_only)
    traces = trace_rollouts(loop, number, range(rollouts))
    readable = ReferenceLoop(plan, world, first_only=first_only)
    expected = [readable.trace(number, rollout) for rollout in range(rollouts)]
    assert traces == expected, number
    return sum(int((trace.events[:, 2] == 8).sum()) for trace in traces)


def test_events_are_those_of_the_readable_simulator():
    assert sum(agree(number) for number in range(250)) > 1000


@pytest.mark.slow
def test_so_they_are_in_two_thousand_worlds():
    assert sum(agree(number) for number in range(250, 2250)) > 5000


def other_map(one, sense):
    """A survey world whose robots believe its threats in other places."""
    mixed = mixed_up(one.world, Stream(12, 1516))
    world = with_truth(replace(one.world, threat=mixed, starts=None), one.world.threat, sense)
    return world, make_plan(world, one.starts, one.settings)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["mrac", "per_cell", "frontier", "watchful"])
def test_so_they_are_on_the_survey_and_who_sees_everything_runs_as_told(policy):
    for one in survey_worlds():
        if one.settings.transit == "area":
            continue
        one = replace(one, settings=replace(one.settings, policy=policy))
        world, plan = other_map(one, 2)
        loop = compile_closed_loop(plan, world, first_only=one.first_only)
        readable = ReferenceLoop(plan, world, first_only=one.first_only)
        assert trace_rollouts(loop, one.seed, range(2)) == [readable.trace(one.seed, rollout) for rollout in range(2)]
        known, plan = other_map(one, inf)
        problem, told = (prepare(w, one.starts, one.settings) for w in (known, one.world))
        if len(problem.levels.values) == len(told.levels.values):  # else on another scale of costs
            sees_all = compile_closed_loop(plan, known, first_only=one.first_only)
            assert trace_rollouts(sees_all, one.seed, range(4)) == trace_rollouts(one.loop(), one.seed, range(4))


@pytest.mark.parametrize("policy", ["mrac", "per_cell", "frontier"])
def test_counts_add_up_whatever_the_threads_and_chunks(policy):
    world, plan = paper_like(policy)
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    tally, results = run_range(loop, 3, 0, 20_000, threads=2, singles=True)
    assert tally == sum((run_range(loop, 3, first, 4000, threads=1)[0] for first in range(4000, 20_000, 4000)),
                        run_range(loop, 3, 0, 4000, threads=1)[0])  # fmt: skip
    assert len(tally.visited) == loop.accessible + 1 == int(world.accessible(plan.starts).sum()) + 1
    for rollout in range(6):
        run = readable.run(3, rollout)
        found = (results.visited[rollout], results.survived[rollout], results.time[rollout], results.outcome[rollout])
        assert found == (run.visited.sum(), run.survived.sum(), run.time, run.outcome)


@pytest.mark.parametrize("policy", ["mrac", "per_cell", "frontier"])
def test_robots_learn_which_of_several_maps_is_true(policy):
    base = random_world(8, 8, ThreatPattern(areas=3, seed=1))
    maps = [random_world(8, 8, ThreatPattern(areas=3, seed=seed)).threat for seed in range(1, 5)]
    maps = [np.where(base.free, np.nan_to_num(one), np.nan) for one in maps]
    starts, _ = place_starts(with_maps(base, maps), 3)
    for world in (
        with_maps(base, maps),
        with_prior(with_maps(base, maps), 0.04, sense=2),
        with_spread(base, "beta", 9),
    ):
        world = with_sense(world, 1.5)
        plan = make_plan(world, starts, Settings(policy=policy))
        loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
        assert trace_rollouts(loop, 2, range(8)) == [readable.trace(2, rollout) for rollout in range(8)]
        tally, results = run_range(loop, 2, 0, 30, threads=1, singles=True)
        assert results.visited.tolist() == [readable.run(2, rollout).visited.sum() for rollout in range(30)]
        assert tally.visited @ np.arange(len(tally.visited)) == results.visited.sum()


def test_robots_that_are_told_look_ahead_at_nothing():
    """Then `frontier` is `per_cell`."""
    for seed in range(6):
        world = random_world(9, 9, ThreatPattern(seed=seed))
        starts, _ = place_starts(world, 3)
        loops = [
            compile_closed_loop(make_plan(world, starts, Settings(policy=name)), world)
            for name in ("per_cell", "frontier")
        ]
        one, other = (trace_rollouts(loop, seed, range(10)) for loop in loops)
        assert one == other


def test_a_tree_of_what_robots_learn_is_what_rollouts_come_to():
    world, plan = paper_like(side=9, robots=2, sense=1)
    loop = compile_closed_loop(plan, world)
    tree = grow_tree(loop, 1e-3, 10**7)
    low, high = tree.covered("visited")
    results = run_range(loop, 1, 0, 20_000, singles=True)[1]
    error = results.visited.std() / np.sqrt(20_000)
    assert low - 5 * error < results.visited.mean() < high + 5 * error
    complete = tree.counts.outcomes[Outcome.COMPLETE] / WHOLE
    share = (results.outcome == Outcome.COMPLETE).mean()
    assert abs(share - complete) < 5 * np.sqrt(complete * (1 - complete) / 20_000) + 1e-6


def test_what_a_sensor_is_worth():
    """The order of a trial with 120 rollouts: three cells are worth nearly the map, and not to look costs much."""
    world = random_world(pattern=ThreatPattern(seed=1))
    starts, _ = place_starts(world, 8)
    covered = {}
    for name, one in {
        "told": with_prior(world, 0.04, sense=inf), 1: with_prior(world, 0.04, sense=1),
        3: with_prior(world, 0.04, sense=3), "blind": with_prior(world, 0.04, "known"),
    }.items():  # fmt: skip
        loop = compile_closed_loop(make_plan(one, starts), one)
        tally = run_range(loop, 1, 0, 500)[0]
        covered[name] = tally.visited @ np.arange(len(tally.visited)) / 500 / loop.accessible
    assert covered["told"] - 0.04 < covered[3] < covered["told"] + 0.02
    assert covered["blind"] + 0.1 < covered[1] < covered[3]


def test_knowledge_is_part_of_the_identity_and_jax_says_no():
    world, plan = paper_like()
    loops = [compile_closed_loop(plan, with_sense(world, sense)) for sense in (2, 3, {"range": 2, "sight": True})]
    assert len({loop.identity for loop in loops}) == 3
    assert make_engine(plan, world, Rolling(), "numba").accessible == loops[0].accessible
    pytest.importorskip("jax")
    with pytest.raises(WorldError, match="robots that learn the map"):
        closed_loop_engine(loops[0], 0, "jax")


@pytest.mark.parametrize("settings", [{"transit": "area"}])
def test_what_robots_that_learn_do_not_do(settings):
    world, plan = paper_like()
    plan = make_plan(world, plan.starts, Settings(**settings))
    with pytest.raises(WorldError, match="legs that stay in their area, presumes a map that robots are told"):
        compile_closed_loop(plan, world)
