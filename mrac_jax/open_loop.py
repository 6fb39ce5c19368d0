"""The open loop in JAX: one program for CPU and GPU, written for one rollout and batched in `_draw` and `_score`.

The stages are kept apart by barriers: XLA would otherwise draw every random word again for each word of event bits that
it helps to look up. Counts leave the device as sums over all batches, so its outputs do not grow with the rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from numpy.typing import NDArray

from mrac_jax.compiled import CompiledPlan, Mode
from mrac_jax.counts import RangeCounts, outcomes_of
from mrac_jax.padding import DATA_FIELDS, STATIC_FIELDS, PaddedTables, pad_tables
from mrac_jax.threefry import threefry2x32
from planner.tally import RolloutResults
from planner.threefry import key_of

jax.tree_util.register_dataclass(PaddedTables, data_fields=DATA_FIELDS, meta_fields=STATIC_FIELDS)

WORD_BITS = 32
MOST_UNROLLED_WORDS = 8
"""Words whose weights are added in one expression: faster than a reduction, as long as they are few."""
CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA's default is 256 bits; 512 gives 1.4 times the random words a second where the CPU has them."""


@partial(jax.tree_util.register_dataclass, data_fields=["visited", "survived", "time", "alive"], meta_fields=[])
@dataclass(frozen=True)
class Score:
    """What a rollout came to, uint32: cells visited, cells survived, last step of a move, robots alive."""

    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["rows", "events", "visited", "survived", "time", "alive", "complete_dead"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Sums:
    """Counts so far, int32: `[R]`, `[W * 32]`, histograms of the padded sizes, and a scalar (see RangeCounts)."""

    rows: jax.Array
    events: jax.Array
    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array
    complete_dead: jax.Array


def fast_word(tables: PaddedTables, key: jax.Array, rollout: jax.Array, slot: jax.Array) -> jax.Array:
    """The random word that decides one slot's fate in one rollout, uint32 scalar."""
    return threefry2x32(key, rollout, tables.counter[slot])[1]


def fast_outcome(tables: PaddedTables, word: jax.Array, slot: jax.Array) -> jax.Array:
    """One slot's outcome, int32 scalar, by inverse survival of its word (formula: `mrac_jax.guide.Guide`)."""
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


def step_hit(tables: PaddedTables, key: jax.Array, entry: jax.Array, rollout: jax.Array, slot: jax.Array) -> jax.Array:
    """Whether one slot is stopped at its dangerous entry number `entry` in one rollout, bool scalar."""
    word = threefry2x32(key, rollout, tables.step_base[entry, slot])[0]
    return word >> jnp.uint32(8) < tables.step_bound[entry, slot]


def score(tables: PaddedTables, rows: jax.Array) -> tuple[Score, jax.Array]:
    """One rollout's score from its groups' own events, and all its joint events, uint32 `[W]`; rows int32 `[G]`."""
    union = jax.lax.reduce(_rows_at(tables.bits, rows), jnp.uint32(0), jax.lax.bitwise_or, (0,))
    cells = [_at(mine, rows).sum(dtype=jnp.uint32) for mine in tables.cells]
    if len(cells) == 1:
        cells = [cells[0] & jnp.uint32(0xFFFF), cells[0] >> jnp.uint32(16)]
    moves = _at(tables.moves, rows)
    alive = (moves & jnp.uint32(3)).sum(dtype=jnp.uint32)
    return Score(cells[0], cells[1], (moves >> jnp.uint32(2)).max(), alive), union


def weigh(planes: jax.Array, union: jax.Array) -> jax.Array:
    """Sum of the weights of one rollout's joint events, uint32 scalar; planes uint32 `[planes, leading words]`."""
    bits = jax.lax.population_count(union[: planes.shape[1]] & planes)
    weights = bits << jnp.arange(planes.shape[0], dtype=jnp.uint32)[:, None]
    if planes.shape[1] > MOST_UNROLLED_WORDS:
        return weights.sum(dtype=jnp.uint32)
    return sum((weights[plane, word] for plane, word in np.ndindex(planes.shape)), start=jnp.uint32(0))


def _draw(tables: PaddedTables, mode: Mode, key: jax.Array, rollouts: jax.Array) -> jax.Array:
    """Outcomes, int32 `[S, B]`: the per-rollout draws, batched over rollouts (innermost) and slots."""
    slots = jnp.arange(tables.counter.shape[0], dtype=jnp.int32)

    def batched(draw: Callable[[jax.Array, jax.Array], jax.Array]) -> jax.Array:
        return jax.vmap(jax.vmap(draw, in_axes=(0, None)), in_axes=(None, 0))(rollouts, slots)

    if mode == "fast":
        words = jax.lax.map(lambda slot: jax.vmap(partial(fast_word, tables, key), (0, None))(rollouts, slot), slots)
        return jax.vmap(jax.vmap(partial(fast_outcome, tables), in_axes=(0, None)))(words, slots)

    def more(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (state[0] < tables.step_base.shape[0]) & state[1].any()

    def next_entry(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        entry, going, outcome = state
        going = going & ~batched(partial(step_hit, tables, key, entry))
        return entry + 1, going, outcome + going.astype(jnp.int32)

    shape = (slots.shape[0], rollouts.shape[0])
    start = (jnp.int32(0), jnp.ones(shape, dtype=bool), jnp.zeros(shape, dtype=jnp.int32))
    return jax.lax.while_loop(more, next_entry, start)[2]


def _score(tables: PaddedTables, outcomes: jax.Array, asked: jax.Array) -> tuple[jax.Array, Score, jax.Array]:
    """Rows int32 `[G, B]`, scores `[B]` and event bits uint32 `[B, W]`; of rollouts not `asked` for: rows that are empty."""
    groups, members = tables.stride.shape
    by_group = outcomes.reshape(groups, members, -1)
    rows = tables.first_row[:, None] + (by_group * tables.stride[:, :, None]).sum(axis=1, dtype=jnp.int32)
    rows = jax.lax.optimization_barrier(jnp.where(asked, rows, tables.drop_row))
    scores, union = jax.vmap(partial(score, tables), in_axes=1)(rows)
    if union.shape[1] == 0:
        return rows, scores, union
    union = jax.lax.optimization_barrier(union)
    add = jax.vmap(weigh, in_axes=(None, 0))
    visited = scores.visited + add(tables.visited_planes, union)
    survived = scores.survived + add(tables.survived_planes, union)
    return rows, Score(visited, survived, scores.time, scores.alive), union


def _histogram(bins: int, values: jax.Array, asked: jax.Array) -> jax.Array:
    """How often each value 0 .. bins - 1 was asked for, int32 `[bins]`; the rest go into a bin that is cut off."""
    places = jnp.where(asked, values.astype(jnp.int32), bins)
    return jnp.zeros(bins + 1, dtype=jnp.int32).at[places].add(1, mode="promise_in_bounds")[:bins]


def count_events(union: jax.Array) -> jax.Array:
    """Rollouts in which each event happened, int32 `[W * 32]`, from uint32 `[B, W]`, B a multiple of 128.

    Sums in growing fields: four bits an event over 8 rollouts, eight bits over 128, then 32 bits.
    """
    batch, words = union.shape
    eight = union.reshape(8, batch // 8, words)
    nibbles = [((eight >> jnp.uint32(place)) & jnp.uint32(0x11111111)).sum(axis=0, dtype=jnp.uint32) for place in range(4)]
    pairs = jnp.stack(nibbles).reshape(4, 16, batch // 128, words)
    low = (pairs & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    high = ((pairs >> jnp.uint32(4)) & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    octets = jnp.stack([low, high])  # [2, 4, B / 128, W]: bit 8 * octet + 4 * half + place
    counts = jnp.stack(
        [((octets >> jnp.uint32(8 * octet)) & jnp.uint32(0xFF)).sum(axis=2, dtype=jnp.uint32) for octet in range(4)]
    )
    return counts.transpose(3, 0, 1, 2).reshape(words * WORD_BITS).astype(jnp.int32)


def advance(
    tables: PaddedTables, sums: Sums, key: jax.Array, first: jax.Array, low: jax.Array, high: jax.Array, *,
    mode: Mode, batch: int
) -> Sums:  # fmt: skip
    """`sums` with the rollouts `first + low .. first + high - 1` of the batch that begins at id `first` added."""
    place = jnp.arange(batch, dtype=jnp.int32)
    asked = (place >= low) & (place < high)
    outcomes = _draw(tables, mode, key, first + place.astype(jnp.uint32))
    rows, scores, union = _score(tables, outcomes, asked)
    scores = jax.lax.optimization_barrier(scores)
    full = (scores.visited == tables.accessible) & (scores.alive == jnp.uint32(0)) & asked
    return Sums(
        rows=sums.rows.at[rows].add(1, mode="promise_in_bounds"),
        events=sums.events + count_events(union) if union.shape[1] else sums.events,
        visited=sums.visited + _histogram(tables.cell_bins, scores.visited, asked),
        survived=sums.survived + _histogram(tables.cell_bins, scores.survived, asked),
        time=sums.time + _histogram(tables.time_bins, scores.time, asked),
        alive=sums.alive + _histogram(tables.robot_bins, scores.alive, asked),
        complete_dead=sums.complete_dead + full.sum(dtype=jnp.int32),
    )


def _at(table: jax.Array, places: jax.Array) -> jax.Array:
    return table.reshape(-1).at[places].get(mode="promise_in_bounds")


def _rows_at(table: jax.Array, rows: jax.Array) -> jax.Array:
    return table.at[rows].get(mode="promise_in_bounds")


class JaxOpenLoop:
    """The JAX engine for one plan, seed and mode (see `mrac_jax.counts.OpenLoopEngine`)."""

    name = "jax"

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode) -> None:
        self.compiled, self.mode = compiled, mode
        self.padded = pad_tables(compiled, mode)
        self.batch = 16384
        self._tables = jax.device_put(self.padded)
        self._key = jnp.array(key_of(seed), dtype=jnp.uint32)
        self._advance = jitted(advance, mode, self.batch)
        self._singles = jitted(singles, mode, self.batch)

    def counts(self, start: int, count: int) -> RangeCounts:
        """The counts of rollouts `start .. start + count - 1`."""
        sums = jax.device_put(_no_sums(self.padded))
        for first, low, high in _batches(start, count, self.batch):
            sums = self._advance(self._tables, sums, self._key, first, low, high)
        done = jax.tree.map(lambda leaf: np.asarray(leaf).astype(np.int64), sums)
        compiled, tables = self.compiled, self.compiled.tables(self.mode)
        return RangeCounts(
            rollouts=count,
            rows=done.rows[: tables.groups.row_count],
            events=done.events[: tables.events.count],
            visited=done.visited[: compiled.accessible + 1],
            survived=done.survived[: compiled.accessible + 1],
            time=done.time[: compiled.last_step + 1],
            alive=done.alive[: compiled.robots + 1],
            complete_dead=int(done.complete_dead),
        )

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        parts = []
        for first, low, high in _batches(start, count, self.batch):
            scores = self._singles(self._tables, self._key, first)
            parts.append(jax.tree.map(lambda leaf: np.asarray(leaf)[low:high].astype(np.int32), scores))
        columns = {
            name: np.concatenate([np.zeros(0, np.int32), *(getattr(part, name) for part in parts)])
            for name in ("visited", "survived", "time", "alive")
        }
        outcome = outcomes_of(columns["visited"], columns["alive"], self.compiled.accessible)
        return RolloutResults(start=start, **columns, outcome=outcome)


def singles(tables: PaddedTables, key: jax.Array, first: jax.Array, *, mode: Mode, batch: int) -> Score:
    """The score of every rollout of the batch that begins at id `first`, uint32 `[B]` each."""
    place = jnp.arange(batch, dtype=jnp.uint32)
    outcomes = _draw(tables, mode, key, first + place)
    return _score(tables, outcomes, jnp.ones(batch, dtype=bool))[1]


_JITTED: dict[tuple[Callable, Mode, int], Callable] = {}


def jitted(function: Callable, mode: Mode, batch: int) -> Callable:
    """The compiled form of `advance` or `singles`, one per mode and batch: plans of one bucket share it."""
    place = (function, mode, batch)
    if place not in _JITTED:
        options = CPU_OPTIONS if jax.default_backend() == "cpu" else None
        donated = ("sums",) if function is advance else ()
        _JITTED[place] = jax.jit(
            partial(function, mode=mode, batch=batch), donate_argnames=donated, compiler_options=options
        )
    return _JITTED[place]


def _batches(start: int, count: int, batch: int) -> list[tuple[np.uint32, np.int32, np.int32]]:
    """(first id, low, high) of the aligned batches that hold `start .. start + count - 1`."""
    stop = start + count
    return [
        (np.uint32(first), np.int32(max(start - first, 0)), np.int32(min(stop - first, batch)))
        for first in range(start // batch * batch, stop, batch)
    ]


def _no_sums(tables: PaddedTables) -> Sums:
    def zeros(*shape: int) -> NDArray[np.int32]:
        return np.zeros(shape, dtype=np.int32)

    return Sums(
        zeros(tables.bits.shape[0]), zeros(tables.bits.shape[1] * WORD_BITS), zeros(tables.cell_bins),
        zeros(tables.cell_bins), zeros(tables.time_bins), zeros(tables.robot_bins), zeros(),
    )  # type: ignore[arg-type]  # fmt: skip
