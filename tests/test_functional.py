"""`mrac_jax.functional`: exact values, rollouts equal to the other engines', the contract of transformations."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LANES
from helpers import run_python
from open_loop_reference import fixture, plan_of
from test_mrac_jax_open_loop import waiting_plan

import mrac_jax as mrac
from analysis.evaluation.outputs import what_if
from analysis.theory.exact import coverage_gradient, open_loop_exact
from mrac_jax import functional as F
from planner.errors import InputError, PlanError, UsageError, WorldError
from planner.failure_model import exp1_thresholds
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.coverage_gradient import MOST_HISTORIES, CoverageGradient, closed_loop_gradient
from planner.rollouts.engine import open_loop_engine
from planner.rollouts.exact_tree import WHOLE
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.runners import Runner
from planner.settings import Settings
from planner.simulator.jit import interpreted
from planner.world.generate import random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

N = 3000
"""Rollouts of a test: no multiple of any batch size."""
B = 64
"""Rollouts at a time: one size, since each is a program to compile."""
KINDS = ("contiguous", "shared", "waits", "both")
coverage_of, survival_of = jax.jit(F.expected_coverage), jax.jit(F.survival)  # one program each, not one an operation
gradient_of = jax.jit(jax.grad(F.expected_coverage, argnums=1))


def case(kind: str) -> tuple[World, Plan]:
    """Plans whose robots share starts, wait, or wear out and differ in their hazard multiplier; no map is square."""
    if kind == "waits":
        plan, world = waiting_plan()
        return world, plan
    plan, world, _ = fixture(*(("tiny-2x8-25", 5) if kind == "shared" else ("contiguous-14x23-1001", 8)))
    multiplier = tuple(1.0 + 0.5 * robot for robot in range(len(plan.robots)))
    return world, plan.of_robots(weibull_shape=1.5, hazard_multiplier=multiplier) if kind == "both" else plan


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def small() -> tuple[F.PlanArrays, np.ndarray, World, Plan]:
    world, plan = case("shared")
    return F.arrays(world, plan), world.threat, world, plan


# Exact values.


@pytest.mark.parametrize("kind", KINDS)
def test_coverage_and_survival_are_exact(kind: str) -> None:
    world, plan = case(kind)
    exact = open_loop_exact(plan, world)
    single = coverage_of(F.arrays(world, plan), world.threat)
    assert single.dtype == jnp.float32
    assert single == pytest.approx(exact.visited, rel=1e-5)
    with jax.enable_x64(True):
        arrays, p = F.arrays(world, plan), world.threat.astype(np.float64)
        assert coverage_of(arrays, p) == pytest.approx(exact.visited, rel=1e-12)
        by_cell = 1.0 - np.prod(1.0 - np.asarray(survival_of(arrays, p)), axis=0)
        np.testing.assert_allclose(by_cell.ravel(), exact.visited_by_cell, rtol=0, atol=1e-12)
        if kind != "both":  # as docs/jax.md says
            passed = np.asarray(survival_of(arrays, p)) * (1 - np.nan_to_num(p))
            survived = 1.0 - np.prod(1.0 - passed, axis=0)
            np.testing.assert_allclose(survived.ravel(), exact.survived_by_cell, rtol=0, atol=1e-12)
        value = np.arange(by_cell.size, dtype=np.float64).reshape(by_cell.shape)
        value[~world.free] = np.nan
        expected = np.nansum(value.ravel() * exact.visited_by_cell)
        assert coverage_of(arrays, p, value) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", ["contiguous", "shared", "waits"])
def test_the_gradient_is_that_of_the_closed_form(kind: str) -> None:
    world, plan = case(kind)
    arrays, p = F.arrays(world, plan), jnp.asarray(world.threat)
    gradient = np.asarray(gradient_of(arrays, p))
    expected = coverage_gradient(plan, world)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    assert (gradient[~world.free] == 0).all()


def test_the_gradient_of_robots_that_wear_is_the_limit_of_differences() -> None:
    world, plan = case("both")
    row, col = np.argwhere(world.threat > 0)[3]
    step = np.zeros(world.shape, np.float32)
    step[row, col] = 2.0**-8  # float32 has p + step exactly
    near = (World.create(world.threat + sign * step) for sign in (1, -1))
    more, less = (open_loop_exact(at(plan, one), one).visited for one in near)
    with jax.enable_x64(True):
        gradient = gradient_of(F.arrays(world, plan), world.threat.astype(np.float64))
    assert gradient[row, col] == pytest.approx((more - less) / 2.0**-7, rel=1e-3)


def at(plan: Plan, world: World) -> Plan:
    return replace(plan, sha256=world.sha256)


# Rollouts.


@pytest.mark.parametrize("kind", KINDS)
def test_counts_are_those_of_the_other_engines(kind: str) -> None:
    world, plan = case(kind)
    counts = F.rollouts(2**63 + 5, F.arrays(world, plan), world.threat, N, batch_size=B, start=70)
    tally = open_loop_engine(compile_plan(plan, world), 2**63 + 5, "numba", 1).tally(70, N)
    assert counts.rollouts == N
    for name, theirs in (
        ("visits", tally.visits), ("losses", tally.stops), ("visited", tally.covered_visited),
        ("survived", tally.covered_survived), ("cells_visited", tally.visited), ("cells_survived", tally.survived),
        ("time", tally.time), ("alive", tally.alive),
    ):  # fmt: skip
        mine = np.asarray(getattr(counts, name)).ravel()
        np.testing.assert_array_equal(mine[: len(theirs)], theirs, name)
        assert not mine[len(theirs) :].any(), name


def test_one_rollout_is_that_of_its_id_in_the_counts() -> None:
    arrays, p, _, plan = small()
    one = jax.jit(jax.vmap(partial(F.rollout, 3, arrays, p)))(jnp.arange(40, dtype=jnp.uint32))
    counts = F.rollouts(3, arrays, p, 40, batch_size=B)
    np.testing.assert_array_equal(one.visited.sum(axis=0), counts.visited)
    np.testing.assert_array_equal(one.survived.sum(axis=0), counts.survived)
    lost = np.asarray(one.lost_in)
    np.testing.assert_array_equal(np.bincount(lost[lost >= 0], minlength=p.size), np.asarray(counts.losses).ravel())
    assert ((np.asarray(one.lost_at) == F.NOT_LOST) == (lost == F.NOT_LOST)).all()
    for rollout, robot in np.argwhere(lost >= 0)[:20]:
        assert plan.robots[robot].path[one.lost_at[rollout, robot]] == lost[rollout, robot]


def test_chunks_and_batches_change_no_count() -> None:
    arrays, p, _, _ = small()
    whole = F.rollouts(1, arrays, p, N, batch_size=B)
    parts = [F.rollouts(1, arrays, p, count, 128, start) for start, count in ((0, 1), (1, 1999), (2000, 1000))]
    added = jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *parts)
    same(whole, added)
    same(F.rollouts(1, arrays, p, 0, B), jax.tree.map(jnp.zeros_like, whole))


def test_keys_of_jax_draw_the_seed() -> None:
    arrays, p, world, plan = small()
    key = jax.random.key(8)
    low, high = np.asarray(jax.random.bits(key, (2,), dtype=jnp.uint32)).tolist()
    counts = F.rollouts(key, arrays, p, N, batch_size=B)
    same(counts, F.rollouts(low + (high << 32), arrays, p, N, batch_size=B))
    same(counts, F.rollouts(jax.random.PRNGKey(8), arrays, p, N, batch_size=B))
    seeded = jax.jit(partial(F.rollouts, batch_size=B))(7, arrays, p, N)  # under jit a seed is an array
    same(seeded, F.rollouts(7, arrays, p, N, batch_size=B))
    exact, covered = open_loop_exact(plan, world), np.arange(p.size + 1)
    mean = np.asarray(counts.cells_visited) @ covered / N
    error = np.sqrt((np.asarray(counts.cells_visited) @ (covered - mean) ** 2) / N / N)
    assert abs(mean - exact.visited) < 5 * error


def test_thresholds_are_those_of_every_engine() -> None:
    ids = jnp.arange(90, 130, dtype=jnp.uint32).reshape(4, 10)
    found = np.asarray(jax.jit(partial(F.thresholds, 2**40 + 7, robots=6))(ids=ids)).astype(np.int64)
    expected = exp1_thresholds(2**40 + 7, np.asarray(ids).ravel(), 6).reshape(4, 10, 6)
    np.testing.assert_array_equal((found[..., 0] << 32) + found[..., 1], expected)
    edges = np.array([0, 1, 77, 2**32 - 1])
    for seed in (0, 5, 2**64 - 1):
        found = np.asarray(F.thresholds(seed, edges, 3)).astype(np.int64)
        np.testing.assert_array_equal((found[..., 0] << 32) + found[..., 1], exp1_thresholds(seed, edges, 3))
    drawn = jax.vmap(lambda key: F.thresholds(key, 0, 3))(jax.random.split(jax.random.key(2), 2000))
    nats = np.asarray(drawn, dtype=np.float64) @ [1, 2.0**-32]
    assert abs(nats.mean() - 1) < 5 / np.sqrt(nats.size)
    assert abs((nats > 1).mean() - np.exp(-1)) < 5 * np.sqrt(0.2325 / nats.size)


def same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


# The contract.


def test_transformations_change_nothing() -> None:
    """jit, vmap of jit, and a loop; over keys and over maps."""
    arrays, p, _, _ = small()
    maps = jnp.stack([jnp.asarray(p), jnp.asarray(p) * 0.5, jnp.asarray(p) * 0.0])
    plain = [F.rollouts(4, arrays, each, 100, batch_size=B) for each in maps]
    run = partial(F.rollouts, 4, arrays, n=100, batch_size=B)
    for run_all in (jax.vmap(jax.jit(run)), jax.jit(jax.vmap(run))):
        for number, one in enumerate(plain):
            same(jax.tree.map(lambda leaf, number=number: leaf[number], run_all(maps)), one)
    keys = jax.random.split(jax.random.key(0), 5)
    together = jax.jit(jax.vmap(lambda key: F.rollout(key, arrays, p)))(keys)
    same(jax.tree.map(lambda leaf: leaf[3], together), F.rollout(keys[3], arrays, p))


def test_rollouts_stand_inside_a_function_that_is_differentiated() -> None:
    arrays, p, _, _ = small()

    def both(p: jax.Array) -> tuple[jax.Array, jax.Array]:
        return F.expected_coverage(arrays, p), F.rollouts(1, arrays, p, 100, batch_size=B).visited

    plain = F.rollouts(1, arrays, p, 100, batch_size=B).visited
    for run in (jax.jit(jax.value_and_grad(both, has_aux=True)), jax.value_and_grad(jax.jit(both), has_aux=True)):
        (_, visited), gradient = run(jnp.asarray(p))
        np.testing.assert_array_equal(visited, plain)
        np.testing.assert_allclose(gradient, gradient_of(arrays, jnp.asarray(p)), rtol=1e-5)


def test_it_is_traced_once_a_shape() -> None:
    arrays, p, _, _ = small()
    traced = []

    @jax.jit
    def run(key: jax.Array, arrays: F.PlanArrays, p: jax.Array, n: int, start: int) -> Any:
        traced.append(n)
        return F.expected_coverage(arrays, p), F.rollouts(key, arrays, p, n, B, start).visited.sum()

    for seed, scale, n, start in ((0, 1.0, 10, 0), (1, 0.5, 200, 7), (2, 0.1, 3, 1)):
        found = run(jax.random.key(seed), arrays, p * np.float32(scale), n, start)
        assert found[1] > 0
    assert len(traced) == 1


def test_a_thousand_maps() -> None:
    arrays, p, world, plan = small()
    maps = jnp.asarray(np.random.default_rng(1).uniform(0, 0.5, (1000, *p.shape)).astype(np.float32))
    coverage = jax.jit(jax.vmap(F.expected_coverage, (None, 0)))(arrays, maps)
    gradient = jax.jit(jax.vmap(jax.grad(F.expected_coverage, 1), (None, 0)))(arrays, maps)
    for number in (0, 500, 999):
        near = World.create(np.where(world.free, maps[number], np.nan))
        assert coverage[number] == pytest.approx(open_loop_exact(at(plan, near), near).visited, rel=1e-5)
        expected = coverage_gradient(at(plan, near), near)
        np.testing.assert_allclose(gradient[number], expected, rtol=1e-4, atol=1e-4)


def test_stacked_plans_are_their_plans() -> None:
    """Teams of 2 and of 5: robots and entries are padded."""
    world, plan = case("shared")
    plans = [replace(plan, robots=plan.robots[:robots]) for robots in (2, 5)]
    alone = [F.arrays(world, one) for one in plans]
    stacked = F.stack(alone)
    coverage = jax.jit(jax.vmap(F.expected_coverage, (0, None)))(stacked, world.threat)
    counts = jax.jit(jax.vmap(lambda one: F.rollouts(6, one, world.threat, 300, batch_size=B)))(stacked)
    for number, arrays in enumerate(alone):
        assert coverage[number] == pytest.approx(float(coverage_of(arrays, world.threat)), rel=1e-6)
        expected = F.rollouts(6, arrays, world.threat, 300, batch_size=B)
        for name in vars(expected):
            mine, theirs = (np.asarray(getattr(of, name)) for of in (counts, expected))
            np.testing.assert_array_equal(mine[number].ravel()[: theirs.size], theirs.ravel(), name)
            assert not mine[number].ravel()[theirs.size :].any()


def test_obstacles_are_ignored() -> None:
    world, plan = case("waits")
    arrays = F.arrays(world, plan)
    clean = jnp.asarray(np.nan_to_num(world.threat))
    for odd in (np.nan, 7.0, -1.0):
        p = jnp.where(world.free, clean, np.float32(odd))
        same(F.rollouts(1, arrays, p, 50, batch_size=B), F.rollouts(1, arrays, clean, 50, batch_size=B))
        gradient = gradient_of(arrays, p)
        assert coverage_of(arrays, p) == coverage_of(arrays, clean)
        assert np.isfinite(gradient).all()
        assert (np.asarray(gradient)[~world.free] == 0).all()


def test_importing_changes_no_setting() -> None:
    """And the package alone does not import JAX."""
    alone = "import sys, mrac_jax as mrac; assert 'jax' not in sys.modules; import jax; old = dict(jax.config.values)"
    run_python(f"{alone}; assert mrac.functional.arrays and jax.config.values == old")


# Bad input.


@pytest.mark.parametrize("p", [np.nan, 1.0, -0.25, np.inf])
def test_probabilities_are_checked_where_they_are_concrete(p: float) -> None:
    words = f"p: {p} at [0, 3]; expected 0 <= p < 1 in every free cell; only obstacles may be NaN"
    arrays, threat, _, _ = small()
    bad = np.where(np.arange(threat.size).reshape(threat.shape) == 3, np.float32(p), threat)
    for call in (F.expected_coverage, F.survival, partial(F.rollout, 1), partial(F.rollouts, 1, n=8)):
        with pytest.raises(InputError) as error:
            call(arrays=arrays, p=bad)
        assert words in str(error.value)
    jax.jit(F.expected_coverage)(arrays, bad)  # undefined, and no error


@pytest.mark.parametrize("shape", [(16,), (8, 2), (1, 2, 8), ()])
def test_shapes_are_checked_under_a_trace_too(shape: tuple[int, ...]) -> None:
    arrays, threat, _, _ = small()
    bad = np.zeros(shape, np.float32)
    with pytest.raises(InputError, match=r"p: shape .* expected \[2, 8\]"):
        jax.jit(F.expected_coverage)(arrays, bad)
    with pytest.raises(InputError, match=r"value: shape .* expected \[2, 8\]"):
        jax.jit(F.expected_coverage)(arrays, threat, bad)


@pytest.mark.parametrize("key", [-1, 2**64, 1.5, True, "0", None, np.zeros(3, np.uint32), jnp.zeros(2), jnp.int32(-1)])
def test_what_is_no_key_is_refused(key: Any) -> None:
    arrays, p, _, _ = small()
    for call in (partial(F.rollout, key, arrays, p), partial(F.thresholds, key, 0, 2)):
        with pytest.raises(InputError, match=r"key: .*expected a seed \(0 .. 2\*\*64 - 1\) or one key of jax.random"):
            call()
    with pytest.raises(InputError, match=r"jax\.vmap"):
        F.rollout(jax.random.split(jax.random.key(0), 2), arrays, p)


def test_numbers_are_checked() -> None:
    arrays, p, _, _ = small()
    for ids, words in ((jnp.arange(3), "one id; use jax.vmap"), (0.5, "whole numbers")):
        with pytest.raises(InputError, match=f"rollout_id: .*{words}"):
            F.rollout(1, arrays, p, ids)
    for given in ({"n": -1}, {"n": 2**31}, {"n": 1, "batch_size": 0}, {"n": 1, "start": -1}):
        with pytest.raises(InputError, match=f"{list(given)[-1]}: "):
            F.rollouts(1, arrays, p, **given)
    value = np.full(p.shape, np.nan, np.float32)
    with pytest.raises(InputError, match="value: nan at"):
        F.expected_coverage(arrays, p, value)


def test_plans_that_are_not_of_this_map_or_model_are_refused() -> None:
    _, _, world, plan = small()
    other = World.create(world.threat * np.float32(0.5), starts=world.starts)
    doubtful = world.with_latent_hazard("persistent", 0.5)
    with pytest.raises(PlanError, match="plan for another map"):
        F.arrays(other, plan)
    with pytest.raises(WorldError, match="requires one known map"):
        F.arrays(doubtful, at(plan, doubtful))
    with pytest.raises(PlanError, match="robot 0"):
        F.arrays(world, plan_of(world, [[99]]))
    with pytest.raises(InputError, match="maps of one shape"):
        F.stack([F.arrays(*case("shared")), F.arrays(*case("waits"))])
    with pytest.raises(InputError, match="plans: none"):
        F.stack([])


# The gradient of the closed loop, decisions held (`planner.rollouts.coverage_gradient`).


def truth_of(world: World) -> np.ndarray:
    """Another map than the plan's: a cell that is believed safe is not, and one that is believed dangerous is safe."""
    p = np.where(world.threat > 0, world.threat * np.float32(0.5) + np.float32(0.125), world.threat)
    safe, dangerous = np.argwhere(world.threat == 0), np.argwhere(world.threat > 0)
    p[tuple(safe[len(safe) // 2])], p[tuple(dangerous[0])] = 0.25, 0.0
    return p


def team(world: World, robots: int, policy: str) -> Plan:
    return make_plan(world, place_starts(world, robots)[0], Settings(policy=policy))


def expected_visited(loop: ClosedLoop) -> float:
    counts = Runner(loop, 0, loop.robots + 1).grow(WHOLE, 1, 10**6)
    assert not counts.left_visited.any()
    return float(counts.visited @ np.arange(len(counts.visited))) / WHOLE


def check_against_differences(
    world: World, plan: Plan, most: int | None = None
) -> tuple[Plan, np.ndarray, CoverageGradient]:
    """The exact gradient is the limit of differences of exact trees, whose robots decide by the map of the plan.

    `most`: cells that are looked at; None: all.
    """
    p, loop = truth_of(world), compile_closed_loop(plan, world)
    exact = closed_loop_gradient(world, plan, p, exact=True)
    assert exact.coverage == pytest.approx(expected_visited(loop.with_threat(World.create(p))), rel=1e-12)
    np.testing.assert_array_equal(np.isnan(exact.mean), ~(p > 0))
    for row, col in np.argwhere((p > 0) & (exact.losses > 0))[:most]:
        step = np.zeros(world.shape, np.float32)
        step[row, col] = 2.0**-9
        more, less = (expected_visited(loop.with_threat(World.create(p + sign * step))) for sign in (1, -1))
        assert exact.mean[row, col] == pytest.approx((more - less) / 2.0**-8, rel=1e-3, abs=1e-3)
    return plan, p, exact


def check_sampled(sampled: CoverageGradient, exact: CoverageGradient) -> None:
    seen = sampled.standard_error > 0
    scores = (sampled.mean - exact.mean)[seen] / sampled.standard_error[seen]
    assert seen.sum() >= 3
    assert np.abs(scores).max() < 5
    assert 0.2 < np.sqrt((scores**2).mean()) < 2


@contextmanager
def simulated_as_python() -> Iterator[None]:
    """The simulator as Python: a program that counts these sums takes 20 CPU seconds to compile."""
    program = "planner.rollouts.runners.run_group_tasks"
    with patch(program, interpreted("rollouts").run_group_tasks), np.errstate(over="ignore"):
        yield


as_python = pytest.fixture(simulated_as_python.__wrapped__)


@pytest.mark.parametrize(("robots", "policy"), [(1, "mrac"), (2, "mrac"), (2, "per_cell")])
def test_the_closed_loop_gradient_is_that_of_exact_trees(robots: int, policy: str, as_python: None) -> None:
    plan, p, exact = check_against_differences(random_world(4, 5), team(random_world(4, 5), robots, policy), 2)
    assert (exact.standard_error[p > 0] == 0).all()
    assert exact.rollouts == 0
    sampled = closed_loop_gradient(random_world(4, 5), plan, p, rollouts=1024, seed=3, threads=1)
    check_sampled(sampled, exact)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
@pytest.mark.parametrize("robots", [1, 2, 3])
def test_the_compiled_gradient_is_that_of_exact_trees(robots: int, policy: str) -> None:
    for height, width in ((4, 5), (6, 9), (9, 7)):
        world = random_world(height, width)
        plan, p, exact = check_against_differences(world, team(world, robots, policy))
        sampled = closed_loop_gradient(world, plan, p, rollouts=100_000, seed=2)
        check_sampled(sampled, exact)
        tally = run_range(compile_closed_loop(plan, world).with_threat(World.create(p)), 2, 0, 100_000)[0]
        assert sampled.coverage == pytest.approx(tally.visited @ np.arange(len(tally.visited)) / 100_000, rel=1e-12)
        np.testing.assert_array_equal(np.rint(sampled.losses * 100_000).ravel(), tally.stops)
        few = closed_loop_gradient(world, plan, p, rollouts=2000, threads=2)
        with simulated_as_python():
            same(vars(few), vars(closed_loop_gradient(world, plan, p, rollouts=2000, threads=1)))


def test_the_gradient_of_a_resumed_mission_counts_only_later_visits(as_python: None) -> None:
    world = World.create([[0, 0.2, 0, 0.1], [0.3, 0, 0.2, 0], [0, 0.1, 0, 0.2]])
    said: dict[str, Any] = {"format": "mrac-state", "version": 1, "world": {"shape": [3, 4], "sha256": world.sha256}}
    said |= {"visited": [[0, 0], [0, 1], [0, 2], [2, 1], [2, 2]], "step": 20}
    state = parse_state(said | {"robots": [{"cell": [0, 2]}, {"cell": [2, 2]}]}, world, "")
    check_against_differences(world, make_plan(world, state.starts, Settings(), state=state))


def test_evaluate_says_what_a_percent_more_costs(as_python: None, monkeypatch: pytest.MonkeyPatch) -> None:
    world, quiet = random_world(4, 5), {"advice": False, "band": False, "bound": False, "rollouts": 64, "seed": 3}
    plan = team(world, 2, "mrac")
    exact = closed_loop_gradient(world, plan, exact=True)
    found = mrac.evaluate(world, plan, marginal_risk=True, **quiet).to_json()["marginal_risk"]
    costs = {tuple(one["cell"]): one["cost"] for one in found["cells"]}
    assert found["how"] == "closed loop, exact" and found["cells"][0]["cost"] == max(costs.values())
    assert costs == {tuple(at): exact.mean[*at] / -100 for at in np.argwhere(np.nan_to_num(exact.mean)).tolist()}
    asked: list[Any] = []
    monkeypatch.setattr(what_if, "closed_loop_gradient", lambda *_, **how: asked.append(how) or exact)
    rolled = mrac.evaluate(world, plan, marginal_risk=True, exact="never", **quiet)
    how = rolled.outputs["marginal_risk"].how
    assert (asked, how) == ([{"rollouts": 1024, "seed": 3, "exact": False}], "closed loop, 1,024 rollouts")
    found = mrac.evaluate(world, plan, loop="open", marginal_risk=True, **quiet).outputs["marginal_risk"]
    np.testing.assert_array_equal(found.cost[world.free], coverage_gradient(plan, world)[world.free] / -100)
    with pytest.raises(UsageError, match="requires one p for all visits of a cell, each of them checked"):
        mrac.evaluate(world, plan, marginal_risk=True, threat_checks="first_visit", **quiet)


def test_the_closed_loop_gradient_on_the_device(as_python: None) -> None:
    """Under another map than that of the plan. A book of the same rollouts has all their decisions."""
    world, p = random_world(4, 5), truth_of(random_world(4, 5))
    plan = make_plan(world, place_starts(world, 2)[0])
    exact = closed_loop_gradient(world, plan, p, exact=True)
    decisions = F.book(world, plan, p=p, seed=2, rollouts=4096, lanes=LANES)
    found = F.closed_gradient(2, decisions, p, 4096)
    assert int(found.missing) == 0
    obstacles, mean, error = ~world.free, np.asarray(found.mean), np.asarray(found.standard_error)
    assert obstacles.any() and (mean[obstacles] == 0).all() and (error[obstacles] == 0).all()
    np.testing.assert_array_equal(np.isnan(mean), world.free & (p <= 0))
    check_sampled(replace(exact, mean=mean, standard_error=np.where(obstacles, 0, error)), exact)
    few = F.book(world, plan, rollouts=0, lanes=LANES)
    assert int(F.closed_gradient(2, few, p, 4096).missing) > 100
    with pytest.raises(InputError, match=r"n: 127; expected 128"):
        F.closed_gradient(2, few, p, 127)
    with pytest.raises(InputError, match=r"p: shape \[2\]; expected \[4, 5\]"):
        F.closed_gradient(2, few, p[0, :2], 4096)
    worn = replace(few, plain=np.bool_(False))
    with pytest.raises(PlanError, match="the book's Weibull shape is not 1, or its robots differ"):
        F.closed_gradient(2, worn, p, 4096)


def test_what_has_no_closed_loop_gradient_is_refused(monkeypatch: pytest.MonkeyPatch, as_python: None) -> None:
    world = random_world(4, 5)
    plan = make_plan(world, place_starts(world, 2)[0])
    doubtful = world.with_latent_hazard("persistent", 0.5)
    with pytest.raises(WorldError, match="requires one known map"):
        closed_loop_gradient(doubtful, at(plan, doubtful))
    with pytest.raises(PlanError, match=r"Weibull shape 2; leave `weibull_shape`"):
        closed_loop_gradient(world, plan.of_robots(weibull_shape=2.0))
    with pytest.raises(WorldError, match=r"p: shape \[4, 4\]; expected \[4, 5\]"):
        closed_loop_gradient(world, plan, world.threat[:, :4])
    bad = np.where(world.free, np.float32(1.0), np.nan)
    with pytest.raises(WorldError, match=r"p: 1.0 at \[0, .\]; expected 0 <= p < 1"):
        closed_loop_gradient(world, plan, bad)
    with pytest.raises(UsageError, match=r"rollouts=100; expected at least 1,024"):
        closed_loop_gradient(world, plan, rollouts=100)
    monkeypatch.setattr("planner.rollouts.coverage_gradient.MOST_HISTORIES", MOST_HISTORIES / 1e8)
    with pytest.raises(UsageError, match="the exact tree of 2 robots has more than"):
        closed_loop_gradient(world, plan, exact=True)
