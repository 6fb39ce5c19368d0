"""The closed loop in JAX: Algorithm 2 in every rollout, on CPU and GPU, on one device or several of a host.

The same contract as the compiled classical simulator (`planner.rollouts.closed_loop`), (plan, seed, rollout ids) ->
tally, results, traces; equal count for count and event for event. `mrac_jax.closed_loop.events` has the program.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import NDArray

from mrac_jax.arrays import on_host, robot_words, threshold_pairs, uint64_pairs
from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import BASE, COUNT, FIRST, WORD_BITS, HostBook, padded_team
from mrac_jax.closed_loop.counting import Counting, follow_nominal, nothing_begun
from mrac_jax.closed_loop.events import begin, ended, next_event
from mrac_jax.closed_loop.lanes import Book, Homes, Lanes, Log, at, write
from mrac_jax.closed_loop.start import ENDLESS, check_supported, first_lane, stride_of
from mrac_jax.process import fixed_flags
from mrac_jax.runtime import keep_jax_programs
from planner.arguments import BLOCK
from planner.errors import UsageError
from planner.failure_model import threshold_key
from planner.rollouts.closed_loop import results_from, tally_from
from planner.rollouts.engine import Engine
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import SingleRun
from planner.tally import RolloutResults, Tally, Trace

LANES = {"cpu": 1024, "gpu": 2**16}
"""Rollouts at a time on a device."""
MOST_LANES = 2**18
"""The log has 22 bits for the number of a rollout; a batch has BATCH rollouts a lane."""
BATCH = 16
"""Rollouts a lane in a batch. Lanes are idle at the end of a batch, so it must not be small."""
EVENTS, BEGIN = 8, 3
"""Events of each lane between the rounds in which one lane in so many may begin its next rollout."""
WAITING = 4
"""One lane in so many may wait for the book before the host is asked."""
LOG_ROUNDS = 4
"""Least capacity of the log in rounds."""
ROOM, PARTS = 32, 8
"""Initial capacity: new areas of a rollout, and parts of a split."""
CHUNK = 512
"""Rows of a table sent to a device at a time."""
AXIS = "devices"
NEVER_MET = 2**63 - 1
"""A hazard that no robot has met: lanes do not begin at that snapshot."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Batch:
    """Queue of rollouts, and the results of those that ended. Axis `R`, rollouts.

    Attributes:
        left: uint32 `[R, K, 2]`, thresholds. count: int32 `[1]`, their number; next: number of those that began.
        begun: int32 `[R]`, the snapshot at which each began. numbers: int32 `[R, NUMBERS]`, results. log: walks.
    """

    left: jax.Array
    count: jax.Array
    next: jax.Array
    begun: jax.Array
    numbers: jax.Array
    log: Log


def run(book: Book, lanes: Lanes, batch: Batch) -> tuple[Lanes, Batch]:
    """Roll out the batch until it has ended, many lanes wait for the book, or the log is full."""
    B, K = lanes.key.shape
    width = max(B // BEGIN, 1)
    needed = rows_of_round(B, K)

    def goes_on(state: tuple[Lanes, Batch]) -> jax.Array:
        lanes, batch = state
        waits = (lanes.mode == ln.MISSING).sum(dtype=jnp.int32)
        rests = ((lanes.mode == ln.OFF) & (batch.next[0] >= batch.count[0])) | (
            (lanes.mode == ln.RUN) & (lanes.fuel <= 0)
        )
        rests = rests.sum(dtype=jnp.int32)
        fits = batch.log.used[0] + needed <= batch.log.rows.shape[0]
        return (waits * WAITING <= B) & (waits + rests < B) & fits & ~(lanes.mode == ln.FULL).any()

    def round_(state: tuple[Lanes, Batch]) -> tuple[Lanes, Batch]:
        lanes, batch = hand_over(book, *state, width)
        log = replace(batch.log, used=batch.log.used[0])
        lanes, log = jax.lax.fori_loop(0, EVENTS, lambda _, now: next_event(book, *now), (lanes, log))
        return lanes, replace(batch, log=replace(log, used=log.used[None]))

    return jax.lax.while_loop(goes_on, round_, (lanes, batch))


def rows_of_round(lanes: int, robots: int) -> int:
    """Rows of the log that a round may add: two an event, and one a robot if a rollout ends."""
    return EVENTS * lanes * 2 + max(lanes // BEGIN, 1) * robots


def hand_over(book: Book, lanes: Lanes, batch: Batch, width: int) -> tuple[Lanes, Batch]:
    """Up to `width` lanes at their end hand over their results and, like those that are off, begin the next rollout."""
    B, room = lanes.mode.shape[0], batch.left.shape[0]
    free = (lanes.mode == ln.DONE) | ((lanes.mode == ln.OFF) & (batch.next[0] < batch.count[0]))
    rank = jnp.cumsum(free, dtype=jnp.int32) - 1
    slot = jnp.where(free & (rank < width), rank, width)
    lane = jnp.full(width, B - 1, jnp.int32).at[slot].set(jnp.arange(B, dtype=jnp.int32), mode="drop")
    few = jax.tree.map(lambda of: at(of, lane), lanes)
    chosen = jnp.arange(width, dtype=jnp.int32) < free.sum(dtype=jnp.int32)
    is_done = chosen & (few.mode == ln.DONE)
    results, rows, there = ended(book, few)
    place = jnp.where(is_done, few.number, room)
    log = write(replace(batch.log, used=batch.log.used[0]), (there & is_done[:, None]).reshape(-1), rows.reshape(-1, 4))
    number = batch.next[0] + jnp.cumsum(chosen, dtype=jnp.int32) - 1
    begins = chosen & (number < batch.count[0])
    new, which = begin(book, at(batch.left, jnp.minimum(number, room - 1)), number)

    def put(old: jax.Array, new: jax.Array, of: jax.Array) -> jax.Array:
        return jnp.where(of.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    few = jax.tree.map(lambda old, new: put(old, new, begins), few, new)
    few = replace(few, mode=jnp.where(begins, few.mode, ln.OFF))
    back = jnp.minimum(slot, width - 1)
    lanes = jax.tree.map(lambda old, new: put(old, at(new, back), slot < width), lanes, few)
    return lanes, replace(
        batch,
        next=batch.next + begins.sum(dtype=jnp.int32),
        begun=batch.begun.at[jnp.where(begins, number, room)].set(which, mode="drop"),
        numbers=batch.numbers.at[place].set(results.numbers, mode="drop"),
        log=replace(log, used=log.used[None]),
    )


@partial(jax.jit, static_argnums=2)
def _thresholds(key: jax.Array, ids: jax.Array, robots: int) -> jax.Array:
    """Failure thresholds of rollouts `ids` `[B]`, uint32 `[B, robots, 2]`. `key`: of `failure_model.threshold_key`."""
    return threshold_pairs(robot_words(key, ids, robots))


@cache
def _program(mesh: Mesh) -> Any:
    """`run` on every device of the mesh with its own lanes and batch, which are donated to the outputs."""
    each, all_ = PartitionSpec(AXIS), PartitionSpec()
    mapped = jax.shard_map(run, mesh=mesh, in_specs=(all_, each, each), out_specs=(each, each), check_vma=False)
    return jax.jit(mapped, donate_argnums=(1, 2))


@partial(jax.jit, donate_argnums=0)
def _append(tables: dict[str, jax.Array], rows: dict[str, jax.Array], begins: dict[str, jax.Array]) -> Any:
    """Write rows into tables, each from a given index on."""
    return {
        name: jax.lax.dynamic_update_slice_in_dim(table, rows[name], begins[name], 0) for name, table in tables.items()
    }


class DeviceBook:
    """The tables of a `HostBook` on the devices, to which only new rows are sent."""

    def __init__(self, host: HostBook, sharding: NamedSharding) -> None:
        self.host, self._sharding, self._sent = host, sharding, dict[str, int]()
        self._tables: dict[str, jax.Array] = {}

    def tables(self) -> dict[str, jax.Array]:
        """The present content of the book."""
        host, put = self.host.tables, partial(jax.device_put, device=self._sharding)
        for name, table in host.items():
            if name not in self._tables or len(self._tables[name]) != len(table.rows):
                self._tables[name], self._sent[name] = put(_words_of(table.rows)), table.used
        while any(self._sent[name] < table.used for name, table in host.items()):
            rows, begins = {}, {}
            for name, table in host.items():
                size = min(CHUNK, len(table.rows))
                first = min(self._sent[name], len(table.rows) - size)
                rows[name], begins[name] = _words_of(table.rows[first : first + size]), np.int32(first)
                self._sent[name] = min(first + size, table.used)
            self._tables = _append(self._tables, rows, begins)
        # A new entry changes a bucket anywhere in the table; the table is small, so it is sent whole.
        return self._tables | {"buckets": put(self.host.buckets.copy())}


def _words_of(rows: NDArray) -> NDArray:
    """Rows for JAX: int64 as two words."""
    return uint64_pairs(rows) if rows.dtype == np.int64 else rows


class JaxClosedLoop(Engine):
    """The JAX engine for one closed loop and seed.

    Rollouts are shared out among devices; each runs the same program on its own lanes. Nothing is exchanged, and no
    count depends on the number of lanes or devices.
    """

    name = "jax"

    @fixed_flags()
    def __init__(
        self, loop: ClosedLoop, seed: int, *, lanes: int | None = None, devices: int | None = None, room: int = ROOM,
        parts: int = PARTS,
    ) -> None:  # fmt: skip
        """Raises WorldError or UsageError for missions that the book does not support, and without JAX.

        Args:
            loop: the closed loop. seed: 0 <= seed < 2**64.
            lanes: rollouts at a time on each device; None: by kind of device. devices: None: all of this host.
            room, parts: initial capacity: new areas of a rollout and parts of a split.
        """
        check_supported(loop)
        if lanes is not None and not 0 < lanes <= MOST_LANES:
            raise UsageError(f"lanes is {lanes}", expected=f"1 to {MOST_LANES:,} on each device")
        keep_jax_programs()
        self.loop, self.seed, self.accessible = loop, seed, loop.accessible
        local = jax.local_devices()[:devices]
        platform = "cpu" if local[0].platform == "cpu" else "gpu"
        self.lanes, self._devices = lanes or LANES[platform], len(local)
        self.least = -(-BATCH * self.lanes * self._devices // BLOCK) * BLOCK
        self._mesh = Mesh(np.array(local), (AXIS,))
        self._whole, self._shared = (NamedSharding(self._mesh, PartitionSpec(*axis)) for axis in ((), (AXIS,)))
        self.host = HostBook(loop)
        self._room, self._parts = room, parts
        self._start()

    def _start(self) -> None:
        """Compute the snapshots at which lanes begin; the capacity grows if necessary."""
        try:
            self._find_snapshots()
        except _NoRoom:
            self._grow()

    def _grow(self) -> None:
        """Start again with twice the capacity."""
        self._room, self._parts = 2 * self._room, 2 * self._parts
        self._start()

    def _find_snapshots(self) -> None:
        """Roll out the run without losses: one lane halts after each event."""
        loop, host, D, B = self.loop, self.host, self._devices, self.lanes
        K, lane = padded_team(loop.robots), first_lane(host, self._room)
        homes: Homes | None = None
        next_of = np.full(len(host.bits.rows), -1, np.int32)
        for robot in range(loop.robots):
            mine = np.flatnonzero(loop.tables.owner == robot)  # several on an external path
            next_of[mine[:-1]] = mine[1:]
        self._device_book = DeviceBook(host, self._whole)
        self._fixed: dict[str, Any] = {
            "mask": np.int32((1 << host.shift) - 1),
            "every": host.row_of(np.arange(host.cells)),
            "max_steps": np.int32(loop.max_steps),
            "quiet": np.int32(loop.tables.quiet_steps),
            "next_of": next_of,
            "first": jax.tree.map(lambda of: np.broadcast_to(of, (B, *of.shape)).copy(), lane),
            "met": np.zeros((B, K, 2), np.uint32),
        }
        if loop.comes_home:
            t, pad = loop.tables, (0, K - loop.robots)
            more = host.need.rows.shape[1] - len(t.home_steps), host.words * WORD_BITS - host.cells
            homes = on_host(
                Homes,
                of=np.pad(t.home_of, pad).astype(np.int32),
                steps=np.pad(t.home_steps, [(0, size) for size in more], constant_values=-1).astype(np.int32),
                range=np.pad(np.minimum(t.range, ln.LIMITLESS), pad).astype(np.int32),
                last=np.int32(t.last_step),
                recharge=np.int32(t.recharge),
            )
        self._fixed = jax.device_put(self._fixed | {"homes": homes}, self._whole)
        count = np.arange(D * B, dtype=np.int32) % B
        given = jax.tree.map(lambda of: np.broadcast_to(of, (D * B, *of.shape)).copy(), lane)
        self._lanes = jax.device_put(replace(given, fuel=count, number=count), self._shared)
        self._begun = nothing_begun(loop, B)
        _, (rows, *_) = self._roll_out(self._batch(np.zeros(0, np.int64))[0])
        halted = jax.tree.map(lambda of: np.array(of[:B]), self._lanes)
        ends = halted.mode == ln.OFF
        last = int(ends.argmax()) if ends.any() else B - 1
        follow_nominal(host, self._begun, rows)
        left = (halted.left[..., 0].astype(np.int64) << 32) + halted.left[..., 1]
        halted = replace(
            halted, mode=np.where(ends, ln.DONE, ln.RUN), fuel=np.full(B, 2**30, np.int32),
            left=uint64_pairs(ENDLESS - left),
        )  # fmt: skip
        met = np.full((B, K), NEVER_MET)
        met[: last + 1] = ENDLESS - left[: last + 1] + self._met_on_walks(halted, last)
        self._fixed |= jax.device_put({"first": halted, "met": uint64_pairs(met)}, self._whole)
        self._lanes = replace(self._lanes, mode=jax.device_put(np.full(D * B, ln.OFF, np.int32), self._shared))

    def _met_on_walks(self, halted: Lanes, last: int) -> NDArray[np.int64]:
        """The hazard that robots have met on their walks by the event before each snapshot, `[last + 1, K]`."""
        host, keys = self.host, halted.key.min(axis=1)[:last]
        # The return of all robots is an event at the end of a step, visible in the next key only.
        before = np.append(-1, np.minimum.accumulate(keys[::-1])[::-1])
        met = np.zeros((last + 1, halted.key.shape[1]), np.int64)
        for snapshot, robot in np.ndindex(met.shape):
            me = halted.robots[snapshot, robot]
            moves = min((before[snapshot] - robot) // stride_of(self.loop) - me[ln.SINCE], me[ln.LAST])
            first, count = host.entries.rows[me[ln.WALK], [FIRST, COUNT]]
            visits = np.searchsorted(host.at.rows[first : first + count], moves, "right")
            met[snapshot, robot] = host.sums.rows[first - 1 + visits]
        return met

    def book(self) -> Book:
        """The present book on the devices."""
        halvings = max(6, (self.host.most_visits.bit_length() + 2) // 2 * 2)
        turnings = max(8, (self.host.longest.bit_length() + 4) // 4 * 4) if self.loop.comes_home else 0
        fields: dict[str, Any] = self._device_book.tables() | self._fixed
        return Book(**fields, halvings=halvings, turnings=turnings, parts=self._parts)

    def _batch(self, ids: NDArray[np.int64]) -> tuple[Batch, NDArray[np.int64]]:
        """A batch of these rollouts, distributed over the devices, and the index of each."""
        D, K, B = self._devices, padded_team(self.loop.robots), self.lanes
        room, each = BATCH * B, -(-len(ids) // D)
        number = np.arange(len(ids))
        places = number // max(each, 1) * room + number % max(each, 1)
        queue = np.zeros(D * room, np.int64)
        queue[places] = ids
        put = partial(jax.device_put, device=self._shared)
        if self.loop.failure_model.is_even:
            key = np.array(threshold_key(self.seed), np.uint32)
            left = put(_thresholds(key, put(queue.astype(np.uint32)), K))
        else:  # a Weibull shape other than 1, or different hazard multipliers
            drawn = self.loop.failure_model.thresholds(self.seed, queue, self.loop.robots)
            left = put(uint64_pairs(np.pad(drawn, ((0, 0), (0, K - drawn.shape[1])))))
        rows = (LOG_ROUNDS + 1) * rows_of_round(B, K)
        zeros = partial(jnp.zeros, device=self._shared)  # allocated on the device: they may be gigabytes
        made = on_host(
            Batch,
            left=left,
            count=np.clip(len(ids) - each * np.arange(D), 0, each).astype(np.int32),
            next=np.zeros(D, np.int32),
            begun=zeros(D * room, jnp.int32),
            numbers=zeros((D * room, ln.NUMBERS), jnp.int32),
            log=on_host(Log, rows=zeros((D * rows, 4), jnp.uint32), used=np.zeros(D, np.int32)),
        )
        return put(made), places

    def _roll_out(self, batch: Batch) -> tuple[Batch, list[NDArray[np.uint32]]]:
        """Roll out a batch: with its results, and the rows of each device's log. Raises _NoRoom."""
        program = _program(self._mesh)
        logs: list[list[NDArray[np.uint32]]] = [[] for _ in range(self._devices)]
        while True:
            self._lanes, batch = program(self.book(), self._lanes, batch)
            # Results are copied before use: the buffers are donated to the next call.
            used, mode, fuel = (np.array(of) for of in (batch.log.used, self._lanes.mode, self._lanes.fuel))
            for device, log in enumerate(logs):
                log.append(_first_rows(batch.log.rows.addressable_data(device), int(used[device])))
            if (mode == ln.FULL).any():
                raise _NoRoom
            missing = mode == ln.MISSING
            goes_on = (((mode == ln.RUN) & (fuel > 0)) | missing | (mode == ln.DONE)).any()
            if not goes_on and (np.asarray(batch.next) >= np.asarray(batch.count)).all():
                return batch, [np.concatenate(log) for log in logs]
            if missing.any():
                for *row, salt in np.unique(np.asarray(self._lanes.asked)[missing], axis=0).tolist():
                    self.host.look_up(salt, np.array(row, np.uint32))
                mode = jax.device_put(np.where(missing, ln.RUN, mode), self._shared)
                self._lanes = replace(self._lanes, mode=mode)
            none = jax.device_put(np.zeros(self._devices, np.int32), self._shared)
            batch = replace(batch, log=replace(batch.log, used=none))

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the single results of those rollouts: one pass gives both."""
        counting = Counting(self.loop, self._begun)
        numbers, value_sums = np.zeros((count, ln.NUMBERS), np.int32), np.zeros((count, 2 * counting.weighs), np.int64)
        room = BATCH * self.lanes * self._devices
        for first in range(0, count, room):
            some = slice(first, min(first + room, count))
            numbers[some], begun, logs, device = self._batch_of(np.arange(start + some.start, start + some.stop))
            for one, rows in enumerate(logs):
                mine = np.flatnonzero(device == one) + first
                value_sums[mine] = counting.add(self.host, rows, begun[mine - first])
        counting.add_numbers(numbers)
        tally = tally_from(self.loop, self.seed, start, count, [counting.counts])
        return tally, results_from(start, numbers[:, : ln.NUMBERS - (not self.loop.delivers)], value_sums)

    @fixed_flags()
    def _batch_of(self, ids: NDArray[np.int64]) -> tuple[NDArray, NDArray, list[NDArray[np.uint32]], NDArray]:
        """Of a batch: results `[n, NUMBERS]`, snapshots `[n]`, the log of each device, and the device of each."""
        given, places = self._batch(ids)
        try:
            batch, logs = self._roll_out(given)
        except _NoRoom:
            self._grow()
            return self._batch_of(ids)
        return (
            np.asarray(batch.numbers)[places],
            np.asarray(batch.begun)[places],
            logs,
            places // (BATCH * self.lanes),
        )

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given, a few at a time.

        A trace comes from the simulator in Python with the losses of the lane. Moves that differ from the lane's raise
        an AssertionError.
        """
        waiting = iter(rollouts)
        while few := list(itertools.islice(waiting, BATCH * self.lanes * self._devices)):
            numbers, _, logs, device = self._batch_of(np.array(few))
            for place, rollout in enumerate(few):
                rows = logs[device[place]]
                number = place - int(np.argmax(device == device[place]))
                yield self._trace(rollout, rows[rows[:, 0] >> 10 == number], numbers[place])

    def _trace(self, rollout: int, rows: NDArray[np.uint32], numbers: NDArray[np.int32]) -> Trace:
        robot, since = (rows[:, 0] & 1023).astype(np.int64), rows[:, 2].astype(np.int32).astype(np.int64)
        moves, stopped = (rows[:, 3] & (ln.FINAL - 1)).astype(np.int64), rows[:, 3] & ln.STOPPED > 0
        lost = set(zip(robot[stopped].tolist(), (since + moves)[stopped].tolist(), strict=True))
        run = SingleRun(self.loop, self.seed, rollout, hit=lambda robot, step, _: (robot, step) in lost)
        trace = run.play().trace
        cell = self.host.cell_at.rows[self.host.entries.rows[rows[:, 1], BASE] + moves]
        differ = (trace.cells[since + moves, robot] != self.loop.cells[cell]) & (cell >= 0)  # below 0: it waits
        if len(trace.cells) != numbers[ln.TIME] + 1 or differ.any():
            raise AssertionError(f"rollout {rollout}: the lane's walks are not those of the simulator")
        return trace

    def rolling(self, loop: ClosedLoop) -> JaxClosedLoop:
        """Another loop in as many lanes and on as many devices."""
        return JaxClosedLoop(loop, self.seed, lanes=self.lanes, devices=self._devices)


def _first_rows(rows: jax.Array, count: int) -> NDArray[np.uint32]:
    """The first rows of one device. From a GPU at most twice as many are fetched, by few programs."""
    if jax.default_backend() != "cpu":  # the memory of a CPU is read in place
        rows = rows[: 1 << max(count - 1, 0).bit_length()]
    return np.asarray(rows)[:count].copy()


class _NoRoom(Exception):
    """A rollout made more areas than its capacity."""
