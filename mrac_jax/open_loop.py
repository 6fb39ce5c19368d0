"""The open loop in JAX: one program for CPU and GPU, written for one rollout and batched in `_draw` and `_score`.

Barriers separate the stages: without them XLA repeats the sampling of random words for each word of event bits. Counts
leave the device as sums over all batches, so that outputs do not grow with the number of rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import (
    STATIC,
    Array,
    Uncertainty,
    is_reached,
    less,
    make_map_uncertainty,
    on_host,
    threefry2x32,
    uint64_pairs,
    uncertain_hazard,
)
from mrac_jax.process import fixed_flags
from mrac_jax.runtime import keep_jax_programs
from planner.failure_model import own_key, threshold_key
from planner.rollouts.open_loop import (
    CompiledPlan,
    RangeCounts,
    available_cores,
    outcomes_of,
    plane_count,
    share_out,
    weight_planes,
    words_of,
)
from planner.rollouts.open_loop_events import WORD_BITS, JointDraws
from planner.tally import RolloutResults

# Joint events of a batch: unite the event bits of the groups' rows by OR, sum weights, and count every event.
#
# The nesting of the loops determines the speed. For short rows XLA makes one fused reduction over the groups, several
# times as fast as a loop. For long rows that reduction looks up one word at a time (40 us a rollout for 64 robots on
# 256x256 cells), so a loop over groups looks up whole rows (under 1 us).

MOST_FUSED_WORDS = 16
"""Largest number of words in a row for one fused reduction."""
ROWS_A_STEP = 8
"""Rows that one step of the loop over groups unites: the union is read and written once for all of them."""


def unite(bits: jax.Array, rows: jax.Array) -> jax.Array:
    """Joint events of each rollout, uint32 `[B, W]`, from its rows, int32 `[G, B]`; bits: uint32 `[R, W]`."""
    groups, batch = rows.shape
    if bits.shape[1] <= MOST_FUSED_WORDS:
        # Short rows: XLA fuses the lookup with the reduction.
        return jax.vmap(lambda mine: jax.lax.reduce_or(_rows_at(bits, mine), axes=(0,)), in_axes=1)(rows)
    # A divisor of the number of groups, so that no padding is needed.
    a_step = next(size for size in range(min(ROWS_A_STEP, groups), 0, -1) if groups % size == 0)

    def add(union: jax.Array, several: jax.Array) -> tuple[jax.Array, None]:
        for row in several:
            union = union | _rows_at(bits, row)
        return union, None

    nothing = jnp.zeros((batch, bits.shape[1]), dtype=jnp.uint32)
    return jax.lax.scan(add, nothing, rows.reshape(groups // a_step, a_step, batch))[0]


def _rows_at(bits: jax.Array, rows: jax.Array) -> jax.Array:
    return bits.at[rows].get(mode="promise_in_bounds")


def weigh(planes: jax.Array, union: jax.Array) -> jax.Array:
    """Sum of the weights of each rollout's joint events, uint32 `[B]`; planes `[planes, W']`, union `[B, W]`."""
    weighted, total = union[:, : planes.shape[1]], jnp.zeros(len(union), dtype=jnp.uint32)
    for place, plane in enumerate(planes):
        total += jax.lax.population_count(weighted & plane).sum(axis=1, dtype=jnp.uint32) << jnp.uint32(place)
    return total


def count_events(union: jax.Array) -> jax.Array:
    """Number of rollouts with each event, int32 `[W * 32]`, from uint32 `[B, W]`, B a multiple of 128.

    Sums in fields of growing width: four bits over 8 rollouts, eight bits over 128, then 32 bits.
    """
    batch, words = union.shape
    eight = union.reshape(8, batch // 8, words)
    nibbles = [
        ((eight >> jnp.uint32(place)) & jnp.uint32(0x11111111)).sum(axis=0, dtype=jnp.uint32) for place in range(4)
    ]
    pairs = jnp.stack(nibbles).reshape(4, 16, batch // 128, words)
    low = (pairs & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    high = ((pairs >> jnp.uint32(4)) & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    octets = jnp.stack([low, high])  # [2, 4, B / 128, W]: bit 8 * octet + 4 * half + place
    counts = jnp.stack(
        [((octets >> jnp.uint32(8 * octet)) & jnp.uint32(0xFF)).sum(axis=2, dtype=jnp.uint32) for octet in range(4)]
    )
    return counts.transpose(3, 0, 1, 2).reshape(words * WORD_BITS).astype(jnp.int32)


# Padding of the JAX engine's tables: sizes are rounded up to few values, so that many plans share one compilation.

ENTRIES_A_STEP = 4
"""Threat entries of uncertain maps that are sampled between two checks whether any rollout continues."""
LEAST_PLANES = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PaddedDraws:
    """`open_loop_events.JointDraws` with rounded sizes; padding entries destroy no robot.

    Attributes:
        slot, place, spot: `[E]`. exposure: uint32 `[E, 2]`, largest hazard of the entry.
        uncertainty: the actual hazard.
        count: int32 scalar, E without padding.
        last: int32 `[S]`. spent: `[spots]`, only its size is used: number of cells tracked in each rollout, at least 1.
    """

    slot: Array
    place: Array
    exposure: Array
    spot: Array
    uncertainty: Uncertainty
    count: Array
    last: Array
    spent: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PaddedTables:
    """Input of the JAX engine; axis letters as in `planner.rollouts.open_loop`, sizes padded (see `pad_tables`).

    Attributes:
        counter: uint32 `[S]`, second counter word of each slot's random number.
        guide, threshold: uint32 `[S, buckets]` and `[S, D]`, table and thresholds of
            `planner.rollouts.open_loop_events.Guide`; empty for uncertain maps.
        first_row: int32 `[G]`; stride: int32 `[G, A]`.
        visited, survived: uint32 `[R]`, cells of the group's own events. time: uint32 `[R]`, last step at which one of
            its robots moves; alive: uint32 `[R]`, number of its live robots.
        bits: uint32 `[R, words]`, the joint events of every row.
        visited_planes, survived_planes: uint32 `[planes, weighted words]`: bit p of the weights of the first words'
            events; other words have weight 0.
        joint: sampling tables of uncertain maps, else None.
        drop_row: int32 scalar, the first row without counts, for rollouts out of range.
        mantissa, bisections: static, of the guide.
        cell_bins, time_bins, robot_bins: static, sizes of the histograms.
    """

    counter: Array
    guide: Array
    threshold: Array
    first_row: Array
    stride: Array
    visited: Array
    survived: Array
    time: Array
    alive: Array
    bits: Array
    visited_planes: Array
    survived_planes: Array
    joint: PaddedDraws | None
    drop_row: Array
    mantissa: int = field(metadata=STATIC)
    bisections: int = field(metadata=STATIC)
    cell_bins: int = field(metadata=STATIC)
    time_bins: int = field(metadata=STATIC)
    robot_bins: int = field(metadata=STATIC)


def size_bucket(size: int) -> int:
    """The smallest of 1 .. 8 and their doublings that is at least `size`: at most a quarter larger."""
    if size <= 8:
        return max(size, 1)
    unit = 1 << ((size - 1).bit_length() - 3)
    return -(-size // unit) * unit


def power_bucket(size: int, least: int = 1) -> int:
    """The smallest power of two that is at least `size` and `least`."""
    return max(least, 1 << max(size - 1, 0).bit_length())


def pad_tables(compiled: CompiledPlan, seed: int) -> PaddedTables:
    """The tables with every size rounded up.

    Content of the padding, and why it changes no count:

    - rows (to a power of two, at least one spare): all zero: no cells, time, live robots or events. Padding groups (G
      rounded up) stay in the first spare row, `drop_row`, with stride 0; its count is never read.
    - words (to 2, 4, 6, 8, ...): no event has these bits; weights 0.
    - planes (to 3, 4, ...): no weight has these bits.
    - slots of padding groups: guide and thresholds 0 (no word is below): outcome 0, and their stride is 0.
    - entries of uncertain maps after the last one: not counted, no robot is lost.
    - histogram bins beyond the largest value: never reached.
    """
    tables = compiled.tables
    groups, events, guide = tables.groups, tables.events, tables.guide
    group_pad = size_bucket(groups.count) - groups.count
    slot_pad = group_pad * groups.members
    row_pad = power_bucket(groups.row_count + 1, 256) - groups.row_count
    words, weighted = (2 * size_bucket(-(-many // 2)) for many in (events.bits.shape[1], events.weighted_words))
    weights = (events.visited_weight, events.survived_weight)
    planes = size_bucket(max(LEAST_PLANES, *(plane_count(weight) for weight in weights)))
    shown = [weight_planes(weight, max(words, weighted), planes)[:, :weighted] for weight in weights]
    counter, draws = words_of(groups), compiled.world.draws
    nothing = np.zeros((len(counter), 1), np.uint32)
    return on_host(
        PaddedTables,
        counter=_grow(counter, slot_pad),
        guide=_grow(nothing if guide is None else guide.table, slot_pad, 0),
        threshold=_grow(nothing if guide is None else guide.threshold, slot_pad, 0),
        first_row=_grow(groups.first_row, group_pad, fill=groups.row_count, dtype=np.int32),
        stride=_grow(groups.stride, group_pad, 0, dtype=np.int32),
        visited=_grow(events.own_visited, row_pad),
        survived=_grow(events.own_survived, row_pad),
        time=_grow(tables.time, row_pad),
        alive=_grow(tables.alive, row_pad),
        bits=_grow(events.bits, row_pad, words - events.bits.shape[1]),
        visited_planes=shown[0],
        survived_planes=shown[1],
        joint=None
        if tables.joint is None or draws is None
        else pad_draws(tables.joint, own_key(seed, draws.purpose), slot_pad),
        drop_row=np.int32(groups.row_count),
        mantissa=0 if guide is None else guide.mantissa,
        bisections=0 if guide is None else guide.bisections,
        cell_bins=power_bucket(compiled.accessible + 1, 256),
        time_bins=power_bucket(compiled.last_step + 1, 256),
        robot_bins=power_bucket(compiled.robots + 1, 16),
    )


def pad_draws(joint: JointDraws, key: tuple[int, int], slot_pad: int) -> PaddedDraws:
    """The sampling tables with every size rounded up, and `slot_pad` slots of no robot."""
    size = power_bucket(len(joint.slot), 64)
    slot, place, exposure, spot = (
        np.pad(each, (0, size - len(joint.slot))) for each in (joint.slot, joint.place, joint.exposure, joint.spot)
    )
    spends = joint.spots > 0
    return on_host(
        PaddedDraws,
        slot=slot,
        place=place,
        exposure=uint64_pairs(exposure.astype(np.int64)),
        spot=spot if spends else np.zeros_like(spot),
        uncertainty=make_map_uncertainty(joint, key, spends, size),
        count=np.int32(len(joint.slot)),
        last=_grow(joint.last, slot_pad, dtype=np.int32),
        spent=np.zeros(power_bucket(joint.spots), dtype=np.bool_),
    )


def _grow(array: NDArray, *pads: int, fill: int = 0, dtype: type = np.uint32) -> NDArray:
    """`array`, extended at the end of each axis."""
    return np.pad(array, [(0, pad) for pad in pads], constant_values=fill).astype(dtype)


LEAST_BATCH, MOST_BATCH = 1024, 16384
BATCH_WORDS = 2**20
"""32-bit words per batch that may pass between stages: about the size of a core's second-level cache."""
MOST_PER_CALL = 2**28
"""Rollouts in one call of the compiled program: its sums are int32."""
CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA's default is 256 bits; 512 gives 1.4 times the random words per second on CPUs that have them."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Score:
    """Results of a rollout, uint32: cells visited, cells survived, last step of a move, robots alive."""

    visited: jax.Array
    survived: jax.Array
    time: jax.Array
    alive: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Failures:
    """Random numbers of failures.

    Attributes:
        key: uint32 `[2]`, of the robots' random words.
        left: uint32 `[S, B, 2]`, failure thresholds in one batch, for uncertain maps (`mrac_jax.arrays`); else None.
    """

    key: Array
    left: Array | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sums:
    """Counts so far, int32.

    Attributes:
        rows: `[R]`, rollouts by row. events: `[words * 32]`, rollouts by event bit.
        visited: `[2 * cells + 1]`, rollouts by (all robots lost, cells visited); survived: `[cells + 1]`.
        time: `[steps + 1]`; alive: `[robots + 1]`.

    The last bin of each histogram is for rollouts out of range.
    """

    rows: Array
    events: Array
    visited: Array
    survived: Array
    time: Array
    alive: Array


def outcome_of(tables: PaddedTables, word: jax.Array, slot: jax.Array) -> jax.Array:
    """One slot's outcome, int32 scalar, by inverse survival of its word (`planner.rollouts.open_loop_events.Guide`)."""
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


def _draw(tables: PaddedTables, draws: Failures, rollouts: jax.Array) -> jax.Array:
    """Outcomes, int32 `[S, B]`: sampling for each rollout, batched over rollouts, slot after slot."""
    if tables.joint is not None and draws.left is not None:
        return _joint_outcomes(tables.joint, draws.left, rollouts)

    def draw(slot: jax.Array) -> jax.Array:
        return threefry2x32(draws.key, rollouts, tables.counter[slot])[0]

    slots = jnp.arange(tables.counter.shape[0], dtype=jnp.int32)
    words = jax.lax.map(draw, slots)  # a loop, so that XLA keeps the words instead of sampling them twice
    return jax.vmap(jax.vmap(partial(outcome_of, tables), in_axes=(0, None)))(words, slots)


def _joint_outcomes(joint: PaddedDraws, left: jax.Array, rollouts: jax.Array) -> jax.Array:
    """Outcomes, int32 `[S, B]`, entry by entry of all robots; left: see `Failures`."""
    Draws = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
    last = joint.last[:, None]

    def goes_on(state: Draws) -> jax.Array:
        entry, outcome, *_ = state
        return (entry < joint.count) & ((outcome == last) & (last > 0)).any()

    def next_entries(state: Draws) -> Draws:
        entry, outcome, left, spent = state
        for number in (entry + more for more in range(ENTRIES_A_STEP)):
            slot, spot = joint.slot[number], joint.spot[number]
            # Only live robots are tested, and only where no hazard was removed in this rollout.
            checked = (number < joint.count) & (outcome[slot] == joint.last[slot]) & ~spent[spot]
            exposure = uncertain_hazard(joint.uncertainty, rollouts, number, joint.exposure[number])
            exposure = jnp.where(checked[:, None], exposure, jnp.uint32(0))
            hit = checked & is_reached(left[slot], exposure)
            left = left.at[slot].set(less(left[slot], exposure))
            outcome = outcome.at[slot].set(jnp.where(hit, joint.place[number], outcome[slot]))
            spent = spent.at[spot].set(spent[spot] | (hit & joint.uncertainty.spends))
        return entry + ENTRIES_A_STEP, outcome, left, spent

    batch = rollouts.shape[0]
    spent = jnp.zeros((joint.spent.shape[0], batch), dtype=jnp.bool_)
    whole = jnp.broadcast_to(last, (last.shape[0], batch))
    return jax.lax.while_loop(goes_on, next_entries, (jnp.int32(0), whole, left, spent))[1]


def _score(tables: PaddedTables, outcomes: jax.Array, asked: jax.Array) -> tuple[jax.Array, Score, jax.Array]:
    """Rows int32 `[G, B]`, scores `[B]`, and event words uint32 `[B, words]`.

    Rollouts out of range (not `asked`) get empty rows.
    """
    groups, members = tables.stride.shape
    by_group = outcomes.reshape(groups, members, -1)
    rows = tables.first_row[:, None] + (by_group * tables.stride[:, :, None]).sum(axis=1, dtype=jnp.int32)
    # The barrier keeps XLA from recomputing the rows for every lookup.
    rows = jax.lax.optimization_barrier(jnp.where(asked, rows, tables.drop_row))
    union = unite(tables.bits, rows)
    own = [_at(table, rows) for table in (tables.visited, tables.survived, tables.time, tables.alive)]
    visited, survived, alive = (own[place].sum(axis=0, dtype=jnp.uint32) for place in (0, 1, 3))
    visited, survived = visited + weigh(tables.visited_planes, union), survived + weigh(tables.survived_planes, union)
    return rows, Score(visited, survived, own[2].max(axis=0), alive), union


def _count(histogram: jax.Array, values: jax.Array, asked: jax.Array) -> jax.Array:
    """The histogram, int32 `[bins + 1]`, plus the values 0 .. bins - 1 of rollouts in range; others go last."""
    # Masking by an extra bin keeps the shapes static.
    places = jnp.where(asked, values.astype(jnp.int32), histogram.shape[0] - 1)
    return histogram.at[places].add(1, mode="promise_in_bounds")


def advance(tables: PaddedTables, sums: Sums, draws: Failures, ids: jax.Array, batch: int) -> Sums:
    """`sums` plus rollouts `ids[0]` to `ids[1]` inclusive, batch after batch; ids uint32 `[2]`.

    The first id of a batch is a multiple of the batch size; ids of a batch that are out of range are not counted.
    """
    place = jnp.arange(batch, dtype=jnp.uint32)
    size = jnp.uint32(batch)

    def add_batch(number: jax.Array, sums: Sums) -> Sums:
        rollouts = number * size + place
        asked = (rollouts >= ids[0]) & (rollouts <= ids[1])
        rows, scores, union = _score(tables, _draw(tables, draws, rollouts), asked)
        return _add(tables, sums, rows, scores, union, asked)

    return jax.lax.fori_loop(ids[0] // size, ids[1] // size + jnp.uint32(1), add_batch, sums)


def _add(tables: PaddedTables, sums: Sums, rows: jax.Array, scores: Score, union: jax.Array, asked: jax.Array) -> Sums:
    # Complete rollouts without survivors have another outcome, so they are counted separately.
    dead = (scores.alive == jnp.uint32(0)).astype(jnp.uint32)
    return Sums(
        rows=sums.rows.at[rows].add(1, mode="promise_in_bounds"),
        events=sums.events + count_events(union),
        visited=_count(sums.visited, dead * jnp.uint32(tables.cell_bins) + scores.visited, asked),
        survived=_count(sums.survived, scores.survived, asked),
        time=_count(sums.time, scores.time, asked),
        alive=_count(sums.alive, scores.alive, asked),
    )


def singles(tables: PaddedTables, draws: Failures, first: jax.Array, batch: int) -> Score:
    """The score of every rollout of the batch that begins at id `first`, uint32 `[B]` each."""
    outcomes = _draw(tables, draws, first + jnp.arange(batch, dtype=jnp.uint32))
    return _score(tables, outcomes, jnp.ones(batch, dtype=bool))[1]


def _at(table: jax.Array, places: jax.Array) -> jax.Array:
    return table.reshape(-1).at[places].get(mode="promise_in_bounds")


class JaxOpenLoop:
    """The JAX engine for one plan and seed (see `planner.rollouts.open_loop.MakeKernel`).

    Ids are divided among *streams*: one for each GPU, or for each core of a CPU. Each stream runs the same program on
    its own ids with its own sums. Streams exchange nothing, so counts do not depend on their number or on the devices.
    """

    @fixed_flags()
    def __init__(self, compiled: CompiledPlan, seed: int) -> None:
        """Raises UsageError if JAX cannot run."""
        keep_jax_programs()
        self.compiled, self.seed = compiled, seed
        self.padded = pad_tables(compiled, seed)
        self.batch = batch_size(self.padded)
        devices = jax.local_devices()
        streams = max(len(devices), available_cores()) if devices[0].platform == "cpu" else len(devices)
        self._devices = [devices[stream % len(devices)] for stream in range(streams)]
        # Thresholds of uncertain maps come from the host, one batch for each call.
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
        compiled, tables = self.compiled, self.compiled.tables
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
        """The results of each of these rollouts."""
        run, parts = jitted(singles, self.batch), []
        for first in range(start // self.batch * self.batch, start + count, self.batch):
            scores = run(self._tables[self._devices[0]], self._failures(first), np.uint32(first))
            low, high = max(start - first, 0), min(start + count - first, self.batch)
            parts.append(jax.tree.map(lambda leaf, low=low, high=high: np.asarray(leaf)[low:high], scores))
        columns = {
            name: np.concatenate([np.zeros(0, np.uint32), *(getattr(part, name) for part in parts)]).astype(np.int32)
            for name in ("visited", "survived", "time", "alive")
        }
        outcome = outcomes_of(columns["visited"], columns["alive"], self.compiled.accessible)
        return RolloutResults(start=start, **columns, outcome=outcome)

    def _failures(self, first: int) -> Failures:
        """The random numbers of failures of the batch that begins with this id (NumPy)."""
        key, joint = np.array(threshold_key(self.seed), dtype=np.uint32), self.compiled.tables.joint
        if joint is None:
            return on_host(Failures, key=key, left=None)
        ids = np.arange(first, first + self.batch)
        thresholds = self.compiled.plan.failure_model.thresholds(self.seed, ids, self.compiled.robots)[:, joint.robot]
        empty = len(self.padded.counter) - len(joint.robot)
        return on_host(Failures, key=key, left=uint64_pairs(np.pad(thresholds.T, ((0, empty), (0, 0)))))

    @fixed_flags()  # flags are set for each thread
    def _part(self, stream: int, start: int, count: int) -> Sums:
        """One stream's sums, int64 on the host."""
        run, device, total = jitted(advance, self.batch), self._devices[stream], None
        for first in range(start // self._a_call * self._a_call, start + count, self._a_call):
            last = min(first + self._a_call, start + count) - 1
            ids = np.array([max(first, start), last], dtype=np.uint32)
            given = jax.device_put((_no_sums(self.padded), self._failures(first), ids), device)
            sums = run(self._tables[device], *given)
            done = jax.tree.map(lambda leaf: np.asarray(leaf).astype(np.int64), sums)
            total = done if total is None else jax.tree.map(np.add, total, done)
        return total if total is not None else jax.tree.map(lambda leaf: leaf.astype(np.int64), _no_sums(self.padded))


def batch_size(tables: PaddedTables) -> int:
    """Rollouts in a batch: as many as keep the data between stages in a core's second-level cache."""
    words = 2 * (len(tables.counter) + len(tables.first_row)) + tables.bits.shape[1]
    words += 0 if tables.joint is None else len(tables.joint.spent) // 4
    return min(MOST_BATCH, max(LEAST_BATCH, 1 << (BATCH_WORDS // (words + 8)).bit_length() - 1))


@cache
def jitted(function: Callable, batch: int) -> Callable:
    """The compiled form of `advance` or `singles`, one for each batch size: plans of equal padded sizes share it."""
    options = CPU_OPTIONS if jax.default_backend() == "cpu" else None
    # Donated sums are updated in place.
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
