"""The open-loop engines, their compile step and their generator."""

import itertools
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same_results, rollout_results, rollouts, run_chunks, run_python
from open_loop_reference import fixture, plan_of, tolerance_stops, walk
from test_failure_sampling import KNOWN

from analysis.policy_evaluation.policy_evaluation import roll_policy
from mrac_jax import runtime as accelerators
from mrac_jax.arrays import threefry2x32 as jax_threefry
from mrac_jax.env.coverage_env import CoverageEnv
from mrac_jax.open_loop import JaxOpenLoop, advance, jitted, pad_tables, size_bucket
from planner.errors import PlanError, UsageError
from planner.failure_model import exposure_of, key_of, least_word
from planner.plan.plan import Plan
from planner.rollouts import open_loop as compiled_module
from planner.rollouts.engine import choose_engine
from planner.rollouts.open_loop import CompiledPlan, OpenLoopTables, compile_plan, share_out
from planner.rollouts.open_loop_events import Guide, make_groups, make_guide
from planner.rollouts.open_loop_numba import BLOCK_WORDS, _words
from planner.simulator.codes import Outcome
from planner.simulator.failure_sampling import threefry
from planner.simulator.jit import program
from planner.simulator.thresholds import threefry2x32
from planner.tally import Tally, tally_key
from planner.world.uncertain_maps import bounds_of
from planner.world.world import World

# The open-loop engines against a plain walk, the closed form, each other, and their own contract.

ENGINES = ("numba", "jax")
STANDARD_ERRORS = 5.0
FIGURES = ("visited", "survived", "time", "alive")
WALKED = [
    ("waiting", 3), ("tiny-2x8-25", 5), ("tiny-3x3-15", 4), ("tiny-4x3-23", 4), ("tiny-3x6-21", 5), ("tiny-2x6-08", 4),
    ("tiny-6x7-09", 2), ("tiny-2x4-04", 3), ("tiny-5x4-11", 1), ("contiguous-14x23-1001", 8),
    ("scattered-14x23-1000", 2), ("scattered-20x20-1000", 8),
]  # fmt: skip
"""Among them: waits and returns, starts on threats and shared starts, a team that does not move, no threat."""
COMPILED_ALONE = [("tiny-3x3-15", 4), ("scattered-14x23-1000", 2), ("scattered-20x20-1000", 8)]
"""Plans for which JAX compiles a program that no other quick test runs."""


def waiting_plan() -> tuple[Plan, World]:
    """Three robots that wait, turn back and share a start on a threat; a 2 x 4 world with one obstacle."""
    threat = np.array([[0.3, 0.0, 0.2, 0.4], [0.0, np.nan, 0.25, 0.0]], dtype=np.float32)
    world = World.create(threat)
    paths = [[0, 0, 1, 1, 2, 1, 2, 3], [0, 4, 4, 0, 1, 2, 6, 6, 7, 6], [7, 7]]
    return plan_of(world, paths), world


def plan_in(name: str, robots: int) -> tuple[Plan, World]:
    """A fixture's plan and world, or the waiting plan's."""
    return waiting_plan() if name == "waiting" else fixture(name, robots)[:2]


def compiled_fixture(name: str, robots: int) -> CompiledPlan:
    return compile_plan(*plan_in(name, robots))


SEED = 7 * 2**32 + 5


@cache
def walked(name: str, robots: int) -> Tally:
    """The plain walk, which no engine has a part in, and which takes longer than all of them."""
    plan, world = plan_in(name, robots)
    stops = tolerance_stops(plan, world, SEED)
    key = tally_key(compile_plan(plan, world).identity, "open", SEED)
    ids = range(4000, 4400) if name.startswith(("tiny", "waiting")) else range(4089, 4105)  # from two blocks
    return walk(plan, world, ids, stops, key)


@pytest.mark.parametrize(
    ("name", "robots", "engine"),
    [
        pytest.param(*one, engine, marks=pytest.mark.slow if engine == "jax" and one in COMPILED_ALONE else ())
        for one in WALKED
        for engine in ENGINES
    ],
)
def test_equals_a_plain_walk_count_for_count(name: str, robots: int, engine: str) -> None:
    compiled = compiled_fixture(name, robots)
    expected = walked(name, robots)
    [(start, stop)] = expected.ids
    assert rollouts(compiled, seed=SEED, start=start, count=stop - start, engine=engine) == expected
    if name == "tiny-5x4-11":  # nothing is dangerous
        assert expected.outcomes[Outcome.COMPLETE] == expected.alive[1] == expected.rollouts


def ways_to_end(plan: Plan, world: World) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Each combination of the robots' outcomes with its (visited, survived, time, alive), walked plainly."""
    danger = [[*steps, -1] for steps in compile_plan(plan, world).danger_step]  # -1: is not lost
    for outcomes in itertools.product(*map(range, map(len, danger))):
        at = [steps[outcome] for steps, outcome in zip(danger, outcomes, strict=True)]
        tally = walk(plan, world, range(1), lambda _rollout, robot, step, _cell, at=at: step == at[robot], "")
        yield outcomes, tuple(int(np.flatnonzero(getattr(tally, name))[0]) for name in FIGURES)


@pytest.mark.parametrize("engine", ENGINES)
def test_frequencies_of_every_hit_pattern(engine: str) -> None:
    plan, world = waiting_plan()
    compiled = compile_plan(plan, world)
    chances: Counter[tuple[int, ...]] = Counter()
    threat = [world.threat.ravel()[cells].astype(float) for cells in compiled.danger_cell]
    for outcomes, end in ways_to_end(plan, world):
        chance = 1.0
        for mine, outcome in zip(threat, outcomes, strict=True):
            chance *= float(np.prod(1 - mine[:outcome])) * (mine[outcome] if outcome < len(mine) else 1.0)
        chances[end] += chance
    count = 200_000
    found = rollout_results(compiled, seed=11, count=count, engine=engine)
    seen = Counter(zip(found.visited, found.survived, found.time, found.alive, strict=True))
    assert set(seen) <= set(chances)
    assert sum(chances.values()) == pytest.approx(1.0)
    for end, chance in chances.items():
        error = np.sqrt(chance * (1 - chance) / count)
        assert abs(seen[end] / count - chance) <= STANDARD_ERRORS * error + 1e-12


def test_coverage_of_every_cell_is_the_closed_form() -> None:
    plan, world, _ = fixture("contiguous-14x23-1000", 8)
    missed = np.ones((2, world.threat.size))
    for robot in plan.robots:
        survival, seen = 1.0, set()
        for step, cell in enumerate(robot.path.tolist()):
            if step and cell == robot.path[step - 1]:
                continue
            passed = survival * (1.0 - float(world.threat.reshape(-1)[cell]))
            if cell not in seen:
                missed[:, cell] *= 1.0 - np.array([survival, passed])
            seen.add(cell)
            survival = passed
    count = 300_000
    tally = rollouts(compile_plan(plan, world), seed=4, count=count, engine="numba")
    for chance, covered in zip(1.0 - missed, (tally.covered_visited, tally.covered_survived), strict=True):
        error = np.sqrt(chance * (1 - chance) / count)
        assert (np.abs(covered / count - chance) <= STANDARD_ERRORS * error + 1e-9).all()


@pytest.mark.parametrize(
    ("name", "robots"),
    [("contiguous-20x20-1001", 8), ("scattered-20x20-1000", 2), ("contiguous-20x20-1000", 1), ("tiny-6x3-20", 5)],
)
def test_engines_and_chunks_agree_count_for_count(name: str, robots: int) -> None:
    compiled = compiled_fixture(name, robots)
    start = 3 * 4096 + 100
    numba, jax = (40_000, "numba", (4096, 12_345)), (3000, "jax", (None, 2000))
    for count, engine, chunks in (numba, jax):
        whole = rollouts(compiled, seed=9, start=start, count=count, engine="numba")
        assert whole.rollouts == count and whole.outcomes.sum() == count
        for chunk in chunks:
            again = rollouts(compiled, seed=9, start=start, count=count, engine=engine, chunk=chunk)
            assert again == whole


@pytest.mark.parametrize("engine", ENGINES)
def test_parts_in_any_order_add_to_the_whole(engine: str) -> None:
    compiled = compiled_fixture("scattered-14x23-1002", 8)

    def part(start: int, stop: int) -> Tally:
        return rollouts(compiled, seed=1, start=start, count=stop - start, engine=engine)

    parts = part(9000, 9001) + part(0, 4096) + part(9001, 20_000) + part(4096, 9000)
    assert parts == part(0, 20_000)
    assert parts.ids == ((0, 20_000),)


def test_single_rollouts_add_up_to_the_tally_to_the_last_id() -> None:
    compiled, start = compiled_fixture("contiguous-20x20-1002", 8), 2**32 - 9000
    how: dict[str, Any] = {"seed": 6, "start": start, "count": 9000}
    tally, other = (rollouts(compiled, engine=engine, **how) for engine in ENGINES)
    assert tally == other and tally.ids == ((start, 2**32),)
    found, same = (rollout_results(compiled, engine=engine, **how) for engine in ENGINES)
    assert_same_results(found, same)
    for name in (*FIGURES, "outcome"):
        histogram = tally.outcomes if name == "outcome" else getattr(tally, name)
        counts = np.bincount(getattr(found, name).astype(np.int64), minlength=len(histogram))
        np.testing.assert_array_equal(counts, histogram)
    assert found.start == start


def test_chunks_report_where_the_run_stands() -> None:
    compiled = compiled_fixture("tiny-4x8-12", 2)
    marks = [4096 * 2**j for j in range(3)]
    chunks = list(run_chunks(compiled, seed=0, count=30_000, engine="numba", checkpoints=marks, results=True))
    sizes = [chunk.tally.rollouts for chunk in chunks]
    assert set(marks) <= set(sizes) and sizes[-1] == 30_000 and sizes == sorted(set(sizes))
    assert sum(len(chunk.results.visited) for chunk in chunks if chunk.results) == 30_000
    assert chunks[-1].seconds > 0


def test_one_compilation_serves_plans_of_one_bucket() -> None:
    of_shape, *others = (compiled_fixture(*one) for one in (("tiny-4x3-23", 4), ("tiny-3x6-21", 5), ("tiny-2x8-25", 5)))
    run = jitted(advance, JaxOpenLoop(of_shape, 0).batch)
    rollouts(others[0], seed=0, count=10, engine="jax")
    before = run._cache_size()
    for seed in (0, 1, 2):
        for compiled in others:
            rollouts(compiled, seed=seed, count=5000 * (seed + 1), engine="jax")
    assert run._cache_size() == before


TWO_DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
from open_loop_reference import fixture
from helpers import rollouts
from planner.rollouts.open_loop import compile_plan
compiled = compile_plan(*fixture("tiny-6x3-20", 5)[:2])
assert len(jax.devices()) == 2
whole = rollouts(compiled, seed=5, start=77, count=40_000, engine="numba")
assert rollouts(compiled, seed=5, start=77, count=40_000, engine="jax") == whole
"""


def test_two_devices_equal_one() -> None:
    run_python(TWO_DEVICES, JAX_PLATFORMS="cpu")


FLAGS: dict[str, Any] = dict.fromkeys(
    ("enable_x64", "disable_jit", "debug_nans", "debug_infs", "check_tracer_leaks"), True
) | {
    "numpy_rank_promotion": "raise", "numpy_dtype_promotion": "strict", "transfer_guard": "disallow",
    "threefry_partitionable": False, "default_prng_impl": "rbg",
}  # fmt: skip
"""Flags of JAX's that a user may have set, and values that would stop the programs, or change what they draw."""


@contextmanager
def flags_set(*names: str) -> Iterator[None]:
    """These flags have their values of FLAGS, all at once."""
    with ExitStack() as flags:
        for name in names:
            flags.enter_context(getattr(jax, name)(FLAGS[name]))
        yield


@pytest.mark.parametrize("jit", [True, False], ids=["compiled", "disable_jit"])
def test_flags_of_jax_change_no_count(jit: bool) -> None:
    """All at once: without `jit` some are not looked at."""
    plan, world = waiting_plan()
    compiled = compile_plan(plan, world)
    walk_of = jax.jit(lambda seen: seen[:, 3].argmax().astype("int32").repeat(2) % 5) if jit else None  # east, ...
    with flags_set(*(name for name in FLAGS if not jit or name != "disable_jit")):
        found = rollouts(compiled, seed=3, count=400, engine="jax")
        judged = roll_policy(CoverageEnv(world, 2), walk_of, 1, 40)
    assert found == rollouts(compiled, seed=3, count=400, engine="numba")
    same = roll_policy(CoverageEnv(world, 2), walk_of, 1, 40)
    assert all((one == other).all() for one, other in zip(judged, same, strict=True))


@pytest.mark.parametrize(("plugin", "device", "may"), [
    ("xla_cuda13", "no-such-device", False),  # jax[cuda13] on a machine without a GPU
    ("xla_cuda13", "null", True),
    ("rocm", "no-such-device", True),  # whose device files are not looked for
])  # fmt: skip
def test_jax_is_not_started_where_its_plugin_has_no_device(
    plugin: str, device: str, may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "jax_plugins" / plugin).mkdir(parents=True)
    (tmp_path / "jax_plugins" / plugin / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(accelerators, "DEVICES", (device,))
    monkeypatch.setattr(accelerators, "entry_points", lambda group: ())
    assert accelerators._may_be_one() is may


@pytest.mark.parametrize(("platforms", "notes"), [("cpu", 0), ("cpu,cuda", 0), ("cuda", 1), ("tpu,cpu", 1)])
def test_platforms_that_cannot_be_are_noted_once(
    platforms: str, notes: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(accelerators, "_platforms", lambda: platforms)
    monkeypatch.setattr(accelerators, "_may_be_one", lambda: False)
    accelerators.accelerator.cache_clear()
    try:
        assert [choose_engine("auto").name for _ in range(3)] == ["numba"] * 3
    finally:
        accelerators.accelerator.cache_clear()
    assert [record.getMessage().endswith("the engine is Numba") for record in caplog.records] == [True] * notes


def test_a_jax_that_cannot_start_is_an_error_where_it_is_asked_for(tmp_path: Path) -> None:
    """One line and status 2 on the command line; Numba, and one note, where no engine is named."""
    np.save(tmp_path / "w.npy", np.pad(np.full((3, 3), 0.1), 1))
    words = [sys.executable, "-m", "mrac_jax", "evaluate", "w.npy", "--rollouts", "64", "--no-advice", "--loop", "open"]

    def run(*more: str, **flags: str) -> subprocess.CompletedProcess[str]:
        root = str(Path(__file__).parent.parent)
        given = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
        return subprocess.run(
            [*words, *more], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False,
            env=given | {"PYTHONPATH": root} | flags,
        )  # fmt: skip

    for flags, said in (({"JAX_PLATFORMS": "cuda"}, "with JAX_PLATFORMS=cuda"), ({"JAX_ENABLE_X64": "maybe"}, "maybe")):
        asked = run("--engine", "jax", **flags)
        assert asked.returncode == 2 and not asked.stdout
        *_, line = asked.stderr.splitlines()  # after what it was doing, on a slow machine
        assert "Traceback" not in asked.stderr and said in line
        assert line.startswith("error: JAX cannot start") and line.endswith("use --engine numba")
    auto = run(JAX_PLATFORMS="cuda")
    assert auto.returncode == 0 and auto.stdout
    assert auto.stderr.count("JAX cannot start with JAX_PLATFORMS=cuda") == 1


# The compile step: thresholds, the guide, events, groups and padding, each against its definition.

THREATS = {
    "falling": np.full(38, 0.12), "long": np.full(500, 0.04), "faint": np.full(300, 0.001),
    "fainter": np.full(2000, 1e-5), "beyond 32 bits": np.array([1e-30, 1e-17, 0.5, 1e-20, 0.999999]),
    "deadly": np.full(33, 0.5), "none": np.zeros(0),
}  # fmt: skip


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
    near = np.concatenate([whole.astype(np.int64), 2 ** np.arange(32, dtype=np.int64)])
    words = np.concatenate([near - 1, near, near + 1, np.arange(300), 2**32 - 1 - np.arange(300)]).clip(0, 2**32 - 1)
    words = np.concatenate([words, np.random.default_rng(0).integers(0, 2**32, 3000)])
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
def test_every_combination_of_outcomes_scores_as_walked(
    name: str, robots: int, pair_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With robots paired or not, whatever the plan's size."""
    plan, world, _ = fixture(name, robots)
    monkeypatch.setattr(compiled_module, "make_groups", lambda depth: make_groups(depth, pair_rows))
    tables = compile_plan(plan, world).tables
    for outcomes, end in ways_to_end(plan, world):
        assert scores_of(tables, outcomes) == end


@pytest.mark.parametrize("engine", ["numba", "jax"])
def test_single_robots_and_pairs_give_one_tally(engine: str) -> None:
    plan, world = plan_in("scattered-20x20-1000", 8)
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
    [({"engine": "torch"}, "engine"), ({"seed": -1}, "seed"), ({"chunk": 0}, "chunk"),
     ({"start": 2**32 - 1, "count": 2}, "rollouts")],
)  # fmt: skip
def test_usage_errors_name_the_value(options: dict, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        list(run_chunks(compiled_fixture("tiny-4x8-12", 2), **{"seed": 0, "count": 1, **options}))


def test_padding_keeps_few_sizes() -> None:
    sizes = {size_bucket(size) for size in range(1, 1000)}
    assert all(size <= size_bucket(size) <= max(8, 1.25 * size + 1) for size in range(1, 1000))
    assert len(sizes) < 40
    padded = [pad_tables(compiled_fixture(name, 5), 0) for name in ("tiny-3x6-21", "tiny-2x8-25")]
    assert padded[0].visited.shape == padded[1].visited.shape and padded[0].guide.shape == padded[1].guide.shape


@pytest.mark.parametrize(
    ("start", "count", "workers"), [(0, 10_000, 3), (4095, 2, 4), (100, 0, 2), (7, 1, 1), (0, 64, 8)]
)
def test_shares_cover_the_ids_once(start: int, count: int, workers: int) -> None:
    parts = share_out(start, count, workers, 64)
    assert len(parts) <= workers
    assert [i for first, many in parts for i in range(first, first + many)] == list(range(start, start + count))
    assert all(first % 64 == 0 for first, _ in parts[1:])


# The generator in jnp and Numba against the published vectors and the NumPy one.


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_published_vectors(counter: tuple[int, int], key: tuple[int, int], words: tuple[int, int]) -> None:
    of_jax = jax_threefry(jnp.array(key, jnp.uint32), *np.array(counter, np.uint32))
    of_numba = threefry(*np.array((*key, *counter), np.uint32))
    for found in (of_jax, of_numba):
        assert tuple(int(word) for word in found) == words


def test_equal_to_numpy_on_many_counters() -> None:
    key = key_of(0x0123456789ABCDEF)
    counters = np.arange(2**32 - 500, 2**32 + 500, dtype=np.uint64).astype(np.uint32)
    expected = threefry2x32(key, counters, 77)
    found = jax.vmap(jax_threefry, in_axes=(None, 0, None))(jnp.array(key, jnp.uint32), counters, np.uint32(77))
    np.testing.assert_array_equal(found, expected)
    words = np.zeros(1000, np.uint32)

    @program
    def draw(*of):  # type: ignore[no-untyped-def]
        _words(*of)

    draw(*np.array((*key, counters[0], 77), np.uint32), words)
    np.testing.assert_array_equal(words, expected[0])
