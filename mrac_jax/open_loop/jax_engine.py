"""The open loop in JAX: one program for CPU and GPU, written for one rollout and batched in `_draw` and `_score`.

The stages are kept apart by barriers: XLA would otherwise draw every random word again for each word of event bits that
it helps to look up. Counts leave the device as sums over all batches, so its outputs do not grow with the rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, on_host
from mrac_jax.caches import keep_jax_programs
from mrac_jax.doubt import exposure_in_doubt
from mrac_jax.open_loop.joint_events import ROWS_A_STEP, WORD_BITS, count_events, rows_a_step, unite, weigh
from mrac_jax.open_loop.padding import (
    DATA_FIELDS,
    ENTRIES_A_STEP,
    STATIC_FIELDS,
    PaddedDraws,
    PaddedTables,
    pad_tables,
)
from mrac_jax.threefry import threefry2x32
from mrac_jax.two_words import is_reached, less, two_words
from planner.arguments import argument
from planner.errors import UsageError
from planner.rollouts.open_loop.compiled import CompiledPlan, Mode
from planner.rollouts.open_loop.counts import RangeCounts, available_cores, outcomes_of, share_out
from planner.tally import RolloutResults
from planner.tolerance import key_of_luck

jax.tree_util.register_dataclass(PaddedTables, data_fields=DATA_FIELDS, meta_fields=STATIC_FIELDS)
jax.tree_util.register_dataclass(PaddedDraws, data_fields=[one.name for one in fields(PaddedDraws)], meta_fields=[])

LEAST_BATCH, MOST_BATCH = 1024, 16384
BATCH_WORDS = 2**20
"""32-bit words a rollout batch may pass from stage to stage: about a core's second cache."""
MOST_PER_CALL = 2**28
"""Rollouts a call of the compiled program: its sums are int32."""
MOST_JOINT_BINS = 2**17
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


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["rows", "events", "cells", "time_alive"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Sums:
    """Counts so far, int32.

    Attributes:
        rows: `[R]`, rollouts by row. events: `[words * 32]` for each part of the event words, rollouts by event bit.
        cells: rollouts by (all robots stopped, cells visited, cells lost), flat `[2 * cells * robots + 1]`; lost:
            visited, not survived, at most one a robot. If that is not joint (`is_joint`): by (all robots stopped, cells
            visited) `[2 * cells + 1]`, and by cells survived `[cells + 1]`.
        time_alive: rollouts by (time, robots alive), flat `[time * robots + 1]`.

    The last bin of each histogram is for rollouts that were not asked for.
    """

    rows: Array
    events: tuple[Array, ...]
    cells: tuple[Array, ...]
    time_alive: Array


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


def own_scores(tables: PaddedTables, rows: jax.Array) -> Score:
    """Each rollout's score from its groups' own events, `[B]`, from its rows, int32 `[G, B]`."""
    *cell_tables, move_table = tables.own
    groups, batch = rows.shape
    if groups <= ROWS_A_STEP:  # reductions: as one expression, XLA would compute the rows again for every look-up
        moves = _at(move_table, rows)
        time, alive = (moves >> jnp.uint32(2)).max(axis=0), (moves & jnp.uint32(3)).sum(axis=0, dtype=jnp.uint32)
        cells = [_at(table, rows).sum(axis=0, dtype=jnp.uint32) for table in cell_tables]
    else:
        a_step = rows_a_step(groups)
        nothing = jnp.zeros(batch, dtype=jnp.uint32)

        def add(score: tuple[jax.Array, ...], several: jax.Array) -> tuple[tuple[jax.Array, ...], None]:
            time, alive, *cells = score
            for row in several:
                moves = _at(move_table, row)
                time, alive = jnp.maximum(time, moves >> jnp.uint32(2)), alive + (moves & jnp.uint32(3))
                cells = [sums + _at(table, row) for sums, table in zip(cells, cell_tables, strict=True)]
            return (time, alive, *cells), None

        start = (nothing, nothing, *(nothing for _ in cell_tables))
        time, alive, *cells = jax.lax.scan(add, start, rows.reshape(groups // a_step, a_step, batch))[0]
    visited, survived = cells if len(cells) == 2 else (cells[0] & jnp.uint32(0xFFFF), cells[0] >> jnp.uint32(16))
    return Score(visited, survived, time, alive)


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


def _score(
    tables: PaddedTables, outcomes: jax.Array, asked: jax.Array
) -> tuple[jax.Array, Score, tuple[jax.Array, ...]]:
    """Rows int32 `[G, B]`, scores `[B]`, and parts of the event words uint32 `[B, words]`.

    Rollouts that are not `asked` for get rows that are empty.
    """
    groups, members = tables.stride.shape
    by_group = outcomes.reshape(groups, members, -1)
    rows = tables.first_row[:, None] + (by_group * tables.stride[:, :, None]).sum(axis=1, dtype=jnp.int32)
    rows = jnp.where(asked, rows, tables.drop_row)
    scores = own_scores(tables, rows)
    union = unite(tables, rows)
    visited, survived = scores.visited, scores.survived
    weigh_all = jax.vmap(weigh, in_axes=(None, 0))
    for part, (start, stop), seen, passed in zip(
        union, tables.weighted, tables.visited_planes, tables.survived_planes, strict=True
    ):
        visited = visited + weigh_all(seen, part[:, start:stop])
        survived = survived + weigh_all(passed, part[:, start:stop])
    return rows, Score(visited, survived, scores.time, scores.alive), union


def _count(histogram: jax.Array, values: jax.Array, asked: jax.Array) -> jax.Array:
    """The histogram, int32 `[bins + 1]`, with the values 0 .. bins - 1 that were asked for entered; others go last."""
    places = jnp.where(asked, values.astype(jnp.int32), histogram.shape[0] - 1)
    return histogram.at[places].add(1, mode="promise_in_bounds")


def is_joint(tables: PaddedTables) -> bool:
    """Whether cells visited and lost are counted in one histogram: while it fits a core's second cache."""
    return tables.cell_bins * tables.robot_bins <= MOST_JOINT_BINS


def _count_cells(
    tables: PaddedTables, histograms: tuple[jax.Array, ...], scores: Score, asked: jax.Array
) -> tuple[jax.Array, ...]:
    """The histograms `cells` of Sums with these rollouts entered."""
    dead = (scores.alive == jnp.uint32(0)).astype(jnp.uint32)
    cells, robots = jnp.uint32(tables.cell_bins), jnp.uint32(tables.robot_bins)
    if is_joint(tables):
        places = [(dead * cells + scores.visited) * robots + (scores.visited - scores.survived)]
    else:
        places = [dead * cells + scores.visited, scores.survived]
    return tuple(_count(one, mine, asked) for one, mine in zip(histograms, places, strict=True))


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


def _add(
    tables: PaddedTables, sums: Sums, rows: jax.Array, scores: Score, union: tuple[jax.Array, ...], asked: jax.Array
) -> Sums:
    return Sums(
        rows=sums.rows.at[rows].add(1, mode="promise_in_bounds"),
        events=tuple(before + count_events(part) for before, part in zip(sums.events, union, strict=True)),
        cells=_count_cells(tables, sums.cells, scores, asked),
        time_alive=_count(sums.time_alive, scores.time * jnp.uint32(tables.robot_bins) + scores.alive, asked),
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

    def __init__(self, compiled: CompiledPlan, seed: int, mode: Mode, streams: int | None = None) -> None:
        """Raises UsageError for a mode that is not `tolerance`."""
        if mode != "tolerance":
            what, fix = f"{argument('engine', 'jax')} with luck by {mode}", f"use {argument('engine', 'numba')}"
            raise UsageError(what, expected=argument("luck", "tolerance"), fix=fix)
        keep_jax_programs()
        self.compiled, self.seed = compiled, seed
        self.padded, self._columns = pad_tables(compiled, seed)
        self.batch = batch_size(self.padded)
        devices = jax.local_devices()
        if streams is None:
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
        visited, survived = _cell_margins(self.padded, total.cells)
        time_alive = total.time_alive[:-1].reshape(-1, self.padded.robot_bins)
        events = (
            np.concatenate([np.zeros(0, np.int64), *total.events]).reshape(-1, WORD_BITS)[self._columns].reshape(-1)
        )
        return RangeCounts(
            rollouts=count,
            rows=total.rows[: tables.groups.row_count],
            events=events[: tables.events.count],
            visited=visited.sum(axis=0)[: compiled.accessible + 1],
            survived=survived[: compiled.accessible + 1],
            time=time_alive.sum(axis=1)[: compiled.last_step + 1],
            alive=time_alive.sum(axis=0)[: compiled.robots + 1],
            complete_dead=int(visited[1, compiled.accessible]),
        )

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
    words = 2 * (len(tables.counter) + len(tables.first_row)) + sum(part.shape[1] for part in tables.bits)
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

    joint = (2 * tables.cell_bins * tables.robot_bins,)
    apart = (2 * tables.cell_bins, tables.cell_bins)
    return on_host(
        Sums,
        rows=zeros(len(tables.own[0])),
        events=tuple(zeros(part.shape[1] * WORD_BITS) for part in tables.bits),
        cells=tuple(zeros(bins + 1) for bins in (joint if is_joint(tables) else apart)),
        time_alive=zeros(tables.time_bins * tables.robot_bins + 1),
    )


def _cell_margins(
    tables: PaddedTables, cells: tuple[NDArray[np.int64], ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rollouts by (all stopped, cells visited) `[2, cells]` and by cells survived `[cells]`, from `Sums.cells`."""
    if not is_joint(tables):
        return cells[0][:-1].reshape(2, -1), cells[1][:-1]
    by_all = cells[0][:-1].reshape(2, tables.cell_bins, tables.robot_bins)
    by_lost = by_all.sum(axis=0)
    survived = by_lost[:, 0].copy()
    for lost in range(1, tables.robot_bins):
        survived[:-lost] += by_lost[lost:, lost]
    return by_all.sum(axis=2), survived
