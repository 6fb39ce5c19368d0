"""The compile step: thresholds, the guide, events, groups and padding, each against its definition."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from open_loop_reference import fixture, plan_of, walk
from rolling import rollouts, run_chunks

from mrac_jax.open_loop import jitted, pad_tables, size_bucket
from planner.errors import PlanError, UsageError
from planner.failure_model import exposure_of, least_word
from planner.rollouts import open_loop as compiled_module
from planner.rollouts.open_loop import CompiledPlan, OpenLoopTables, compile_plan, share_out
from planner.rollouts.open_loop_events import Guide, make_guide
from planner.rollouts.open_loop_numba import BLOCK_WORDS
from planner.rollouts.open_loop_trace import make_groups
from planner.world.uncertain_maps import bounds_of
from planner.world.world import World

THREATS = {
    "falling": np.full(38, 0.12),
    "long": np.full(500, 0.04),
    "faint": np.full(300, 0.001),
    "fainter": np.full(2000, 1e-5),
    "beyond 32 bits": np.array([1e-30, 1e-17, 0.5, 1e-20, 0.999999]),
    "deadly": np.full(33, 0.5),
    "none": np.zeros(0),
}


def guide_outcomes(guide: Guide, slot: int, words: np.ndarray) -> np.ndarray:
    """The formula in Guide's docstring, in Python's whole numbers."""
    found = []
    for word in words.tolist():
        zeros = 32 - max(word, 1).bit_length()
        normal, low = word << zeros, 2 ** (31 - guide.mantissa)
        entry = int(guide.table[slot][(normal >> (31 - guide.mantissa)) + ((31 - zeros) << guide.mantissa)])
        if guide.bisections == 0:
            found.append(entry // low + (normal % low < entry % low))
            continue
        for half in (2**step for step in reversed(range(guide.bisections))):
            entry += half if word < guide.threshold[slot][entry + half] else 0
        found.append(entry)
    return np.array(found)


@pytest.mark.parametrize("name", THREATS)
def test_guide_counts_thresholds_exactly(name: str) -> None:
    threat = THREATS[name].astype(np.float32)
    whole = least_word(np.cumsum(exposure_of(threat))).astype(np.uint64)
    sets = [whole, whole[: len(threat) // 2]]
    random = np.random.default_rng(0)
    near = [np.clip(sets[0].astype(np.int64) + shift, 0, 2**32 - 1) for shift in (-1, 0, 1)]
    powers = [2 ** np.arange(32, dtype=np.int64) + shift for shift in (-1, 0, 1)]
    words = np.concatenate(
        [random.integers(0, 2**32, 3000), np.arange(300), 2**32 - 1 - np.arange(300), *near, *powers]
    )
    guide = make_guide(sets)
    for slot, thresholds in enumerate(sets):
        expected = (words[:, None] < thresholds.astype(np.int64)[None, :]).sum(axis=1)
        assert np.array_equal(guide_outcomes(guide, slot, words), expected)


@pytest.mark.parametrize("threat", [0.0, 1e-30, 2.0**-24, 0.04, 0.3, 0.5, 1 - 2.0**-24])
def test_step_bound_is_the_float_comparison(threat: float) -> None:
    p = np.float32(threat)
    bound = int(bounds_of(np.array([p]))[0])
    words = np.unique(np.clip(np.array([0, bound - 1, bound, bound + 1, 2**24 - 1]), 0, 2**24 - 1))
    assert np.array_equal(words.astype(np.float32) * np.float32(2.0**-24) < p, words < bound)


def scores_of(tables: OpenLoopTables, outcomes: tuple[int, ...]) -> tuple[int, int, int, int]:
    """(visited, survived, time, alive) of one combination of the robots' outcomes, from the tables alone."""
    groups, events = tables.groups, tables.events
    rows = groups.first_row.copy()
    for robot, slot in enumerate(groups.slot_of):
        rows[slot // groups.members] += outcomes[robot] * groups.stride.reshape(-1)[slot]
    union = np.bitwise_or.reduce(events.bits[rows], axis=0)
    happened = np.unpackbits(union.view(np.uint8), bitorder="little")[: events.count].astype(bool)
    own = [events.own_visited[rows].sum(), events.own_survived[rows].sum()]
    joint = [events.visited_weight[happened].sum(), events.survived_weight[happened].sum()]
    return own[0] + joint[0], own[1] + joint[1], tables.time[rows].max(), tables.alive[rows].sum()


@pytest.mark.parametrize(("name", "robots"), [("tiny-3x6-21", 5), ("tiny-4x3-23", 4), ("tiny-2x6-08", 4)])
@pytest.mark.parametrize("pair_rows", [0, 2**14])
def test_every_combination_of_outcomes_scores_as_walked(name: str, robots: int, pair_rows: int) -> None:
    plan, world, _ = fixture(name, robots)
    compiled = compile_plan(plan, world)
    tables = tables_with_groups(compiled, pair_rows)
    for outcomes in itertools.product(*(range(len(steps) + 1) for steps in compiled.danger_step)):
        stop_steps = [int(np.append(s, -1)[o]) for s, o in zip(compiled.danger_step, outcomes, strict=True)]

        def stops(_rollout: int, robot: int, step: int, _cell: int, at: list[int] = stop_steps) -> bool:
            return step == at[robot]

        tally = walk(plan, world, range(1), stops, "")
        walked = [int(np.flatnonzero(getattr(tally, key))[0]) for key in ("visited", "survived", "time", "alive")]
        assert list(scores_of(tables, outcomes)) == walked


def tables_with_groups(compiled: CompiledPlan, most_pair_rows: int) -> OpenLoopTables:
    """The tables with robots paired or not, whatever the plan's size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_module, "make_groups", lambda depth: make_groups(depth, most_pair_rows))
        return compiled_module._make_tables(compiled)


@pytest.mark.parametrize("engine", ["numba", "jax"])
def test_single_robots_and_pairs_give_one_tally(engine: str) -> None:
    plan, world, _ = fixture("scattered-20x20-1000", 8)
    whole = rollouts(compile_plan(plan, world), seed=3, count=20_000, engine=engine)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_module, "make_groups", lambda depth: make_groups(depth, 0))
        patch.setattr("mrac_jax.open_loop.MOST_FUSED_WORDS", 0)
        patch.setattr("mrac_jax.open_loop.jitted", cache(jitted.__wrapped__))
        patch.setattr("planner.rollouts.open_loop_numba.BLOCK_WORDS", BLOCK_WORDS[:1])
        single = compile_plan(plan, world)
        assert single.tables.groups.members == 1
        assert rollouts(single, seed=3, count=20_000, engine=engine) == whole


def test_identity_is_of_threats_and_paths() -> None:
    world = World.create(np.array([[0.0, 0.1, 0.0]], np.float32))
    one, other = (compile_plan(plan_of(world, [path]), world).identity for path in ([0, 1, 2], [0, 1, 1]))
    assert one != other
    assert compile_plan(plan_of(world, [[0, 1, 2]]), world).identity == one


def test_plans_that_cannot_be_rolled_out() -> None:
    world = World.create(np.array([[0.0, 0.1, np.nan]], np.float32))
    other = World.create(np.array([[0.0, 0.2, np.nan]], np.float32))
    for paths, match in (([[0, 2]], "obstacle"), ([[0, 3]], "off the map"), ([[]], "0 entries")):
        with pytest.raises(PlanError, match=match):
            compile_plan(plan_of(world, paths), world)
    with pytest.raises(PlanError, match="another map"):
        compile_plan(plan_of(other, [[0, 1]]), world)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"engine": "torch"}, "engine"),
        ({"seed": -1}, "seed"),
        ({"start": 2**32 - 1, "count": 2}, "rollouts"),
        ({"chunk": 0}, "chunk"),
    ],
)
def test_usage_errors_name_the_value(options: dict, match: str) -> None:
    world = World.create(np.array([[0.0, 0.1]], np.float32))
    compiled = compile_plan(plan_of(world, [[0, 1]]), world)
    with pytest.raises(UsageError, match=match):
        list(run_chunks(compiled, **{"seed": 0, "count": 1, **options}))


def test_padding_keeps_few_sizes() -> None:
    sizes = {size_bucket(size) for size in range(1, 1000)}
    assert all(size <= size_bucket(size) <= max(8, 1.25 * size + 1) for size in range(1, 1000))
    assert len(sizes) < 40
    plans = [fixture(name, robots)[:2] for name, robots in (("tiny-3x6-21", 5), ("tiny-2x8-25", 5))]
    padded = [pad_tables(compile_plan(plan, world), 0) for plan, world in plans]
    assert padded[0].visited.shape == padded[1].visited.shape and padded[0].guide.shape == padded[1].guide.shape


@pytest.mark.parametrize(
    ("start", "count", "workers"), [(0, 10_000, 3), (4095, 2, 4), (100, 0, 2), (7, 1, 1), (0, 64, 8)]
)
def test_shares_cover_the_ids_once(start: int, count: int, workers: int) -> None:
    parts = share_out(start, count, workers, 64)
    assert len(parts) <= workers
    assert [i for first, many in parts for i in range(first, first + many)] == list(range(start, start + count))
    assert all(first % 64 == 0 for first, _ in parts[1:])
