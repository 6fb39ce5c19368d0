"""The open loop in JAX: one program for CPU and GPU, written for one rollout and batched in `_draw` and `_score`.

The stages are kept apart by barriers: XLA would otherwise draw every random word again for each word of event bits that
it helps to look up. Counts leave the device as sums over all batches, so its outputs do not grow with the rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, on_host
from mrac_jax.caches import keep_jax_programs
from mrac_jax.doubt import exposure_in_doubt
from mrac_jax.open_loop.joint_events import count_events, unite, weigh
from mrac_jax.open_loop.padding import ENTRIES_A_STEP, PaddedDraws, PaddedTables, pad_tables
from mrac_jax.process import fixed_flags
from mrac_jax.threefry import threefry2x32
from mrac_jax.two_words import is_reached, less, two_words
from planner.arguments import argument
from planner.errors import UsageError
from planner.rollouts.open_loop.compiled import CompiledPlan, Mode
from planner.rollouts.open_loop.counts import RangeCounts, available_cores, outcomes_of, share_out
from planner.rollouts.open_loop.events import WORD_BITS
from planner.tally import RolloutResults
from planner.tolerance import key_of_luck

LEAST_BATCH, MOST_BATCH = 1024, 16384
BATCH_WORDS = 2**20
"""32-bit words a rollout batch may pass from stage to stage: about a core's second cache."""
MOST_PER_CALL = 2**28
"""Rollouts a call of the compiled program: its sums are int32."""
CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA's default is 256 bits; 512 gives 1.4 times the random words a second where the CPU has them."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Score:
    """What a rollout came to, uint32: cells visited, cells survived, last step of a move, robots alive."""

    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Luck:
    """What decides who is stopped.

    Attributes:
        key: uint32 `[2]`, under which a robot's one number is drawn.
        left: uint32 `[S, B, 2]`, what robots bear in one batch, where the map is in doubt (`mrac_jax.two_words`);
            else None.
    """

    key: Array
    left: Array | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sums:
    """Counts so far, int32.

    Attributes:
        rows: `[R]`, rollouts by row. events: `[words * 32]`, rollouts by event bit.
        visited: `[2 * cells + 1]`, rollouts by (all robots stopped, cells visited); survived: `[cells + 1]`.
        time: `[steps + 1]`; alive: `[robots + 1]`.

    The last bin of each histogram is for rollouts that were not asked for.
    """

    rows: Array
    events: Array
    visited: Array
    survived: Array
    time: Array
    alive: Array


def outcome_of(tables: PaddedTables, word: jax.Array, slot: jax.Array) -> jax.Array:
    """One slot's outcome, int32 scalar, by inverse survival of its word (formula: `open_loop.guide.Guide`)."""
    mantissa, low_bits = tables.mantissa, 31 - tables.mantissa
    zeros = jax.lax.clz(word | jnp.uint32(1))
    normal = word << zeros
    bucket = (normal >> jnp.uint32(low_bits)) + ((jnp.uint32(31) - zeros) << jnp.uint32(mantissa))
    found = _at(tables.guide, slot * tables.guide.shape[1] + bucket.astype(jnp.int32))
    if tables.bisections == 0:
        low = jnp.uint32(2**low_bits - 1)
        return (found >> jnp.uint32(low_bits)).astype(jnp.int32) + ((normal & low) < (found & low)).astype(jnp.int32)
    outcome = found.astype(jnp.int32)
    for half in (2**step for step in reversed(range(tables.bisections))):
        beyond = _at(tables.threshold, slot * tables.threshold.shape[1] + outcome + half)
        outcome = outcome + jnp.where(word < beyond, half, 0)
    return outcome


def _draw(tables: PaddedTables, luck: Luck, rollouts: jax.Array) -> jax.Array:
    """Outcomes, int32 `[S, B]`: the per-rollout draws, batched over rollouts here, slot after slot."""
    if tables.joint is not None and luck.left is not None:
        return _joint_outcomes(tables.joint, luck.left, rollouts)

    def draw(slot: jax.Array) -> jax.Array:
        return threefry2x32(luck.key, rollouts, tables.counter[slot])[0]

    slots = jnp.arange(tables.counter.shape[0], dtype=jnp.int32)
    words = jax.lax.map(draw, slots)  # a loop, so that XLA keeps the words: it would draw them twice
    return jax.vmap(jax.vmap(partial(outcome_of, tables), in_axes=(0, None)))(words, slots)


def _joint_outcomes(joint: PaddedDraws, left: jax.Array, rollouts: jax.Array) -> jax.Array:
    """Outcomes, int32 `[S, B]`, entry by entry of all robots; left: as in `Luck`."""
    Draws = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
    last = joint.last[:, None]

    def goes_on(state: Draws) -> jax.Array:
        entry, outcome, *_ = state
        return (entry < joint.count) & ((outcome == last) & (last > 0)).any()

    def next_entries(state: Draws) -> Draws:
        entry, outcome, left, spent = state
        for number in (entry + more for more in range(ENTRIES_A_STEP)):
            slot, spot = joint.slot[number], joint.spot[number]
            checked = (number < joint.count) & (outcome[slot] == joint.last[slot]) & ~spent[spot]
            exposure = exposure_in_doubt(joint.doubt, rollouts, number, joint.exposure[number])
            exposure = jnp.where(checked[:, None], exposure, jnp.uint32(0))
            hit = checked & is_reached(left[slot], exposure)
            left = left.at[slot].set(less(left[slot], exposure))
            outcome = outcome.at[slot].set(jnp.where(hit, joint.place[number], outcome[slot]))
            spent = spent.at[spot].set(spent[spot] | (hit & joint.doubt.spends))
        return entry + ENTRIES_A_STEP, outcome, left, spent

    batch = rollouts.shape[0]
    spent = jnp.zeros((joint.spent.shape[0], batch), dtype=jnp.bool_)
    whole = jnp.broadcast_to(last, (last.shape[0], batch))
    return jax.lax.while_loop(goes_on, next_entries, (jnp.int32(0), whole, left, spent))[1]


def _score(tables: PaddedTables, outcomes: jax.Array, asked: jax.Array) -> tuple[jax.Array, Score, jax.Array]:
    """Rows int32 `[G, B]`, scores `[B]`, and the event words uint32 `[B, words]`.

    Rollouts that are not `asked` for get rows that are empty.
    """
    groups, members = tables.stride.shape
    by_group = outcomes.reshape(groups, members, -1)
    rows = tables.first_row[:, None] + (by_group * tables.stride[:, :, None]).sum(axis=1, dtype=jnp.int32)
    rows = jax.lax.optimization_barrier(jnp.where(asked, rows, tables.drop_row))
    union = unite(tables.bits, rows)
    own = [_at(table, rows) for table in (tables.visited, tables.survived, tables.time, tables.alive)]
    visited, survived, alive = (own[place].sum(axis=0, dtype=jnp.uint32) for place in (0, 1, 3))
    visited, survived = visited + weigh(tables.visited_planes, union), survived + weigh(tables.survived_planes, union)
    return rows, Score(visited, survived, own[2].max(axis=0), alive), union


def _count(histogram: jax.Array, values: jax.Array, asked: jax.Array) -> jax.Array:
    """The histogram, int32 `[bins + 1]`, with the values 0 .. bins - 1 that were asked for entered; others go last."""
    places = jnp.where(asked, values.astype(jnp.int32), histogram.shape[0] - 1)
    return histogram.at[places].add(1, mode="promise_in_bounds")


def advance(tables: PaddedTables, sums: Sums, luck: Luck, ids: jax.Array, batch: int) -> Sums:
    """`sums` with the rollouts from `ids[0]` to `ids[1]`, the last included, added batch after batch; ids uint32 `[2]`.

    The first id of a batch is a multiple of the batch's size; rollouts of it that are not asked for are not counted.
    """
    place = jnp.arange(batch, dtype=jnp.uint32)
    size = jnp.uint32(batch)

    def add_batch(number: jax.Array, sums: Sums) -> Sums:
        rollouts = number * size + place
        asked = (rollouts >= ids[0]) & (rollouts <= ids[1])
        rows, scores, union = _score(tables, _draw(tables, luck, rollouts), asked)
        return _add(tables, sums, rows, scores, union, asked)

    return jax.lax.fori_loop(ids[0] // size, ids[1] // size + jnp.uint32(1), add_batch, sums)


def _add(tables: PaddedTables, sums: Sums, rows: jax.Array, scores: Score, union: jax.Array, asked: jax.Array) -> Sums:
    dead = (scores.alive == jnp.uint32(0)).astype(jnp.uint32)
    return Sums(
        rows=sums.rows.at[rows].add(1, mode="promise_in_bounds"),
        events=sums.events + count_events(union),
        visited=_count(sums.visited, dead * jnp.uint32(tables.cell_bins) + scores.visited, asked),
        survived=_count(sums.survived, scores.survived, asked),
        time=_count(sums.time, scores.time, asked),
        alive=_count(sums.alive, scores.alive, asked),
    )


def singles(tables: PaddedTables, luck: Luck, first: jax.Array, batch: int) -> Score:
    """The score of every rollout of the batch that begins at id `first`, uint32 `[B]` each."""
    outcomes = _draw(tables, luck, first + jnp.arange(batch, dtype=jnp.uint32))
    return _score(tables, outcomes, jnp.ones(batch, dtype=bool))[1]


def _at(table: jax.Array, places: jax.Array) -> jax.Array:
    return table.reshape(-1).at[places].get(mode="promise_in_bounds")


class JaxOpenLoop:
    """The JAX engine for one plan and seed (see `planner.rollouts.open_loop.counts.OpenLoopKernel`).

    Ids are shared out among *streams*: one a GPU, or one a core of a CPU. Each runs the same program on its own ids,
    with sums of its own; nothing is exchanged, so neither their number nor that of devices can change a count.
    """

    @fixed_flags()
    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode) -> None:
        """Raises UsageError for a mode that is not `tolerance`, and where JAX cannot run."""
        if mode != "tolerance":
            what, fix = f"{argument('engine', 'jax')} with luck by {mode}", f"use {argument('engine', 'numba')}"
            raise UsageError(what, expected=argument("luck", "tolerance"), fix=fix)
        keep_jax_programs()
        self.compiled, self.seed = compiled, seed
        self.padded = pad_tables(compiled, seed)
        self.batch = batch_size(self.padded)
        devices = jax.local_devices()
        streams = max(len(devices), available_cores()) if devices[0].platform == "cpu" else len(devices)
        self._devices = [devices[stream % len(devices)] for stream in range(streams)]
        self._a_call = MOST_PER_CALL if self.padded.joint is None else self.batch
        self._tables = {device: jax.device_put(self.padded, device) for device in set(self._devices)}

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        parts = share_out(start, count, len(self._devices), self.batch)
        if len(parts) == 1:
            done = [self._part(0, *parts[0])]
        else:
            with ThreadPoolExecutor(len(parts)) as pool:
                done = list(pool.map(lambda stream: self._part(stream, *parts[stream]), range(len(parts))))
        total = jax.tree.map(lambda *leaves: sum(leaves), *done)
        compiled, tables = self.compiled, self.compiled.tables("tolerance")
        visited = total.visited[:-1].reshape(2, -1)
        return RangeCounts(
            rollouts=count,
            rows=total.rows[: tables.groups.row_count],
            events=total.events[: tables.events.count],
            visited=visited.sum(axis=0)[: compiled.accessible + 1],
            survived=total.survived[: compiled.accessible + 1],
            time=total.time[: compiled.last_step + 1],
            alive=total.alive[: compiled.robots + 1],
            complete_dead=int(visited[1, compiled.accessible]),
        )

    @fixed_flags()
    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        run, parts = jitted(singles, self.batch), []
        for first in range(start // self.batch * self.batch, start + count, self.batch):
            scores = run(self._tables[self._devices[0]], self._luck(first), np.uint32(first))
            low, high = max(start - first, 0), min(start + count - first, self.batch)
            parts.append(jax.tree.map(lambda leaf, low=low, high=high: np.asarray(leaf)[low:high], scores))
        columns = {
            name: np.concatenate([np.zeros(0, np.uint32), *(getattr(part, name) for part in parts)]).astype(np.int32)
            for name in ("visited", "survived", "time", "alive")
        }
        outcome = outcomes_of(columns["visited"], columns["alive"], self.compiled.accessible)
        return RolloutResults(start=start, **columns, outcome=outcome)

    def _luck(self, first: int) -> Luck:
        """Of the batch that begins with this id, where each has its own (NumPy)."""
        key, joint = np.array(key_of_luck(self.seed), dtype=np.uint32), self.compiled.tables("tolerance").joint
        if joint is None:
            return on_host(Luck, key=key, left=None)
        ids = np.arange(first, first + self.batch)
        bears = self.compiled.plan.bearing.tolerances(self.seed, ids, self.compiled.robots)[:, joint.robot]
        empty = len(self.padded.counter) - len(joint.robot)
        return on_host(Luck, key=key, left=two_words(np.pad(bears.T, ((0, empty), (0, 0)))))

    @fixed_flags()  # a thread has its own
    def _part(self, stream: int, start: int, count: int) -> Sums:
        """One stream's sums, int64 on the host."""
        run, device, total = jitted(advance, self.batch), self._devices[stream], None
        for first in range(start // self._a_call * self._a_call, start + count, self._a_call):
            last = min(first + self._a_call, start + count) - 1
            ids = np.array([max(first, start), last], dtype=np.uint32)
            given = jax.device_put((_no_sums(self.padded), self._luck(first), ids), device)
            sums = run(self._tables[device], *given)
            done = jax.tree.map(lambda leaf: np.asarray(leaf).astype(np.int64), sums)
            total = done if total is None else jax.tree.map(np.add, total, done)
        return total if total is not None else jax.tree.map(lambda leaf: leaf.astype(np.int64), _no_sums(self.padded))


def batch_size(tables: PaddedTables) -> int:
    """Rollouts a batch: as many as keep what passes between the stages in a core's second cache."""
    words = 2 * (len(tables.counter) + len(tables.first_row)) + tables.bits.shape[1]
    words += 0 if tables.joint is None else len(tables.joint.spent) // 4
    return min(MOST_BATCH, max(LEAST_BATCH, 1 << (BATCH_WORDS // (words + 8)).bit_length() - 1))


@cache
def jitted(function: Callable, batch: int) -> Callable:
    """The compiled form of `advance` or `singles`, one per batch: plans of one bucket share it."""
    options = CPU_OPTIONS if jax.default_backend() == "cpu" else None
    donated = ("sums",) if function is advance else ()
    return jax.jit(partial(function, batch=batch), donate_argnames=donated, compiler_options=options)


def _no_sums(tables: PaddedTables) -> Sums:
    def zeros(*shape: int) -> NDArray[np.int32]:
        return np.zeros(shape, dtype=np.int32)

    return on_host(
        Sums,
        rows=zeros(len(tables.visited)),
        events=zeros(tables.bits.shape[1] * WORD_BITS),
        visited=zeros(2 * tables.cell_bins + 1),
        survived=zeros(tables.cell_bins + 1),
        time=zeros(tables.time_bins + 1),
        alive=zeros(tables.robot_bins + 1),
    )
