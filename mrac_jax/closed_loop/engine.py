"""The closed loop in JAX: Algorithm 2 in every rollout, on CPU and GPU, on one device or several of a host.

The same contract as the compiled classical simulator (`planner.rollouts.closed_loop`), (plan, seed, rollout ids) ->
tally, results, traces; equal count for count and event for event. The program is `mrac_jax.closed_loop.engine`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, HostArrays, on_host, two_words
from mrac_jax.closed_loop import rules
from mrac_jax.closed_loop.areas import settle
from mrac_jax.closed_loop.beginning import COPIED, NO_HIT, first_lanes, halted, lanes_of, lanes_off, nominal_of
from mrac_jax.closed_loop.returning import charge
from mrac_jax.closed_loop.rules import judge
from mrac_jax.closed_loop.state import (
    ACT,
    ALIVE_COLUMN,
    CELL_KINDS,
    COLUMNS,
    END,
    NEW_SURVIVED,
    NEW_VISITED,
    OFF,
    OUTCOME_COLUMN,
    STEP_KINDS,
    STOPPED,
    SURVIVED_COLUMN,
    TIME_COLUMN,
    VISITED_COLUMN,
    Lanes,
    Log,
    Queue,
    Sums,
    choose_lanes,
    put_rows,
    robots_home,
    spread,
)
from mrac_jax.closed_loop.steps import micro_step
from mrac_jax.closed_loop.tables import PIECE_BITS, PIECES, VISITED, LaneTables, areas_at, lane_tables, step_bucket
from mrac_jax.process import fixed_flags
from mrac_jax.runtime import keep_jax_programs
from planner.ids import BLOCK
from planner.rollouts.closed_loop import results_from, tally_from, trace_from
from planner.rollouts.loop import ClosedLoop, known_cells
from planner.rollouts.open_loop import available_cores, share_out
from planner.rollouts.tables import first_frames
from planner.simulator.codes import NO_AREA, Outcome
from planner.simulator.state import MOST_PASSES, Counts, make_counts
from planner.tally import RolloutResults, Tally, Trace
from planner.world.world import World

# The closed loop as one program: lanes that begin, run, hand over their results and begin again, until none is left.
#
# Axis letters as in `mrac_jax.closed_loop.state`; `R` rollouts that a call has room for.

MOST_MOVES = 2**30
"""Moves after which a call ends, done or not: its counts are int32."""


@dataclass(frozen=True)
class Pace:
    """How often what is done, and for how many lanes at a time. No count depends on it.

    Attributes:
        micro_steps: between two rounds of what is dear. look: lanes that look among the nearest cells at a time; find:
            that search all cells; settle: whose areas are split and shared; begin: that begin a rollout.
    """

    micro_steps: int
    look: int
    find: int
    settle: int
    begin: int


def run(tables: LaneTables, snapshots: Lanes, lanes: Lanes, sums: Sums, queue: Queue, pace: Pace) -> tuple[Lanes, Sums]:
    """The rollouts of the queue: one loop, until every lane is off (or MOST_MOVES are counted).

    Args:
        tables, lanes, sums: lanes that are off begin the next rollout; those that are not go on.
        snapshots: lanes as rollouts begin, `[M]`.
        pace: static.
    """

    find = rules.search_find if tables.policy is None else rules.attentive_find

    def goes_on(state: tuple[Lanes, Sums]) -> jax.Array:
        lanes, sums = state
        return ((lanes.mode != OFF).any() | (sums.next < queue.count)) & (sums.moves < MOST_MOVES)

    def round_(state: tuple[Lanes, Sums]) -> tuple[Lanes, Sums]:
        # Dear things wait for the end of a round, so that several lanes that want them are served at once.
        lanes, sums = hand_over(tables, snapshots, *state, queue, pace.begin)
        lanes, sums = jax.lax.fori_loop(
            0, pace.micro_steps, lambda _, now: micro_step(tables, now[0], now[1], pace.look), (lanes, sums)
        )
        lanes = settle(tables, find(tables, lanes, pace.find), pace.settle)
        lanes = charge(tables, lanes, pace.settle)
        return lanes if tables.policy is None else judge(tables, lanes, pace.settle), sums

    return jax.lax.while_loop(goes_on, round_, (lanes, sums))


def hand_over(
    tables: LaneTables, snapshots: Lanes, lanes: Lanes, sums: Sums, queue: Queue, width: int
) -> tuple[Lanes, Sums]:
    """Up to `width` lanes at their end hand over their results and, like those that are off, begin the next rollout."""
    free = (lanes.mode == END) | ((lanes.mode == OFF) & (sums.next < queue.count))

    def change(state: tuple[Lanes, Sums]) -> tuple[Lanes, Sums]:
        lanes, sums = state
        lane, slot = choose_lanes(free, width)
        sums = replace(sums, results=_results(tables, lanes, sums.results, lane))
        chosen = lane < free.shape[0]
        # Ids are given out in the order of lanes; results go to the id's place, so the order shows nowhere.
        number = sums.next + jnp.cumsum(chosen, dtype=jnp.int32) - 1
        begins = chosen & (number < queue.count)
        place = jnp.minimum(number, queue.rollout.shape[0] - 1)
        lanes = _begin(snapshots, lanes, lane, slot, queue.begin_at[place])
        lanes = replace(
            lanes,
            mode=spread(lanes.mode, slot, jnp.where(begins, ACT, OFF)),
            number=spread(lanes.number, slot, number),
            rollout=spread(lanes.rollout, slot, queue.rollout[place]),
            left=put_rows(lanes, lanes.left, lane, queue.left[place]),
        )
        return lanes, replace(sums, next=sums.next + begins.sum(dtype=jnp.int32))

    return jax.lax.cond(free.any(), change, lambda state: state, (lanes, sums))


def _results(tables: LaneTables, lanes: Lanes, results: jax.Array, lane: jax.Array) -> jax.Array:
    """The results with those of the lanes at their end."""
    at = jnp.minimum(lane, lanes.mode.shape[0] - 1)
    alive = jax.lax.population_count(lanes.unharmed[:, at]).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)
    columns: tuple[jax.Array, ...] = (
        tables.accessible - lanes.unvisited[at],
        lanes.survived[at],
        lanes.step[at],
        alive,
        lanes.outcome[at],
        lanes.bisected[at],
        lanes.divided[at],
    )
    if tables.homes is not None:
        columns += (robots_home(tables, lanes, at),)
    if tables.weights is not None and lanes.passes is not None:
        columns += (*_worth(tables.weights, lanes, at),)
    # Lanes that were OFF are among the chosen too: they have no results yet.
    ended = (lane < lanes.mode.shape[0]) & (lanes.mode[at] == END)
    return results.at[jnp.where(ended, lanes.number[at], results.shape[0])].set(jnp.stack(columns, axis=1), mode="drop")


def _worth(weights: tuple[Array, Array], lanes: Lanes, at: jax.Array) -> jax.Array:
    """The weights of what was visited, then found, in the lanes `at`, by pieces: int32 `[2 * PIECES, S]`."""
    batch, (covered, found) = lanes.mode.shape[0], weights
    visited = (lanes.cells.reshape(batch, -1)[at] & VISITED) != 0
    passes = lanes.passes.reshape(batch, -1)[at].astype(jnp.int32)  # type: ignore[union-attr]
    each = jnp.arange(visited.shape[1], dtype=jnp.int32)
    weighed = jnp.concatenate([jnp.where(visited, covered[:, None], 0), found[:, each, passes]])
    return weighed.sum(axis=2, dtype=jnp.int32)


def _begin(snapshots: Lanes, lanes: Lanes, lane: jax.Array, slot: jax.Array, which: jax.Array) -> Lanes:
    """The lanes that were chosen as copies of these snapshots, int32 `[S]`."""
    batch, kept = lanes.mode.shape[0], snapshots.mode.shape[0]
    new: HostArrays = {}
    for name in COPIED:
        old, copied = getattr(lanes, name), getattr(snapshots, name)
        if old is None:
            continue
        # One value a lane is spread; a row of cells or robots is copied.
        if old.shape[-1] == batch:
            new[name] = spread(old, slot, copied[..., which])
        else:
            new[name] = put_rows(lanes, old, lane, copied.reshape(kept, -1)[which])
    return replace(lanes, **new)


def columns_of(tables: LaneTables) -> int:
    """Columns of the results that are not weights: where robots come home, those that are there are one."""
    return COLUMNS + (tables.homes is not None)


def no_sums(tables: LaneTables, steps: int, room: int) -> Sums:
    """Counts (NumPy) of no rollouts, with room for so many steps and results."""
    return on_host(
        Sums,
        by_cell=np.zeros(tables.size * CELL_KINDS, dtype=np.int32),
        by_step=np.zeros(steps * STEP_KINDS, dtype=np.int32),
        passes=None if tables.weights is None else np.zeros(tables.size * MOST_PASSES, dtype=np.int32),
        results=np.zeros((room, columns_of(tables) + (0 if tables.weights is None else 2 * PIECES)), dtype=np.int32),
        next=np.int32(0),
        moves=np.int32(0),
    )


def empty_log(tables: LaneTables, loop: ClosedLoop, batch: int, steps: int, events: int) -> Log:
    """A log (NumPy) with room for so many steps and events a lane."""
    robots, cell_ids = len(tables.starts), np.full(tables.size, NO_AREA, dtype=np.int32)
    cell_ids[: len(loop.cells)] = areas_at(loop)
    return on_host(
        Log,
        events=np.zeros((batch * events, 5), dtype=np.int32),
        count=np.zeros(batch, dtype=np.int32),
        frames=np.zeros((batch * steps, 3, robots), dtype=np.int32),
        cell_ids=np.tile(cell_ids, batch),
    )


BOARD_BYTES = {"cpu": 2**24, "gpu": 2**33}
"""What the lanes of a device may take up, about: on a CPU a core's share of the caches."""
LEAST_LANES, MOST_LANES = 64, {"cpu": 1024, "gpu": 2**18}
BYTES_A_CELL = 12
GENERATIONS = 8
"""Rollouts a lane that make a call worth while: at its end lanes run empty."""
ROBOTS_A_CALL = 2**19
"""Robots of all rollouts that a call of the program has room for on each device, or more where there are many lanes."""
MOST_SNAPSHOTS = 1024
"""Steps of the nominal run at which lanes begin; no more than there are lanes."""
TRACED = 16
"""Rollouts traced at a time."""
TRACE_CELLS, TRACE_ROBOTS, TRACE_STEPS, TRACE_EVENTS = 1120, 32, 4096, 4096
"""Room in the program that traces, so that it is compiled once for all smaller worlds; more is made where needed."""


@cache
def _program(pace: Pace) -> Callable[..., tuple[Lanes, Sums]]:
    """`run` at a pace, jitted; its lanes and sums are given up for those that it returns."""
    return jax.jit(partial(run, pace=pace), donate_argnames=("lanes", "sums"))


def pace_of(lanes: int, cells: int, *, attentive: bool = False) -> Pace:
    """The pace at which so many lanes of so many cells were measured to be fastest.

    On large maps robots drive far between two deaths, and what is dear is dearer. Attentive robots search often.
    """
    find = 1 if attentive and lanes <= MOST_LANES["cpu"] else 4
    micro_steps, settle, begin = (4, 4, 16) if cells <= 448 else (8, 16, 64)
    few = (max(lanes // share, 1) for share in (4, find, settle, begin))
    return Pace(micro_steps, *few)


class JaxClosedLoop:
    """The JAX engine for one closed loop and seed.

    Ids are shared out among *streams*: one a device, or one a core of a CPU. Each runs the same program on its own ids,
    in one dispatch a block. Nothing is exchanged: neither their number nor that of devices can change a count.
    """

    name = "jax"

    @fixed_flags()
    def __init__(self, loop: ClosedLoop, seed: int, *, streams: int | None = None, lanes: int | None = None) -> None:
        """Raises WorldError for a world that the lanes have no room for, UsageError for legs that stay in their
        area, and where JAX cannot run.

        Args:
            loop: what to roll out. seed: 0 <= seed < 2**64.
            streams: None: one a device, or on a CPU one a core.
            lanes: rollouts at a time on each; None: what suits the device.
        """
        keep_jax_programs()
        self.loop, self.seed = loop, seed
        devices = jax.local_devices()
        platform = "cpu" if devices[0].platform == "cpu" else "gpu"
        streams = streams or (max(len(devices), available_cores()) if platform == "cpu" else len(devices))
        self._devices = [devices[stream % len(devices)] for stream in range(streams)]
        self.accessible = len(loop.cells)
        self._tables = lane_tables(loop, seed)
        self._steps = step_bucket(loop.max_steps, self._tables.size)
        fit = BOARD_BYTES[platform] // (BYTES_A_CELL * self._tables.size)
        lanes = lanes or 1 << (min(max(fit, LEAST_LANES), MOST_LANES[platform]).bit_length() - 1)
        self.pace = pace_of(lanes, self._tables.size, attentive=loop.policy is not None)
        self.lanes, self._streams = lanes, streams
        self.least = -(-GENERATIONS * lanes * streams // BLOCK) * BLOCK
        self._room = max(ROBOTS_A_CALL // len(self._tables.starts), GENERATIONS * lanes)
        self._on_device = {device: jax.device_put(self._tables, device) for device in set(self._devices)}
        off = lanes_off(self._tables, loop, lanes)
        self._states = [jax.device_put(off, device) for device in self._devices]
        self._snapshots = min(lanes, MOST_SNAPSHOTS)
        self._nominal = nominal_of(loop, self._snapshots - 1)

    def tally(self, start: int, count: int) -> Tally:
        """The tally of rollouts `start .. start + count - 1`."""
        return self.run(start, count)[0]

    def results(self, start: int, count: int) -> RolloutResults:
        """What each of those rollouts came to."""
        return self.run(start, count)[1]

    def run(self, start: int, count: int) -> tuple[Tally, RolloutResults]:
        """The tally and the single results of those rollouts: one pass gives both."""
        parts = share_out(start, count, self._streams, 1)
        _ = self._start  # before the streams, which share it
        with ThreadPoolExecutor(max(len(parts), 1)) as pool:
            done = list(pool.map(lambda stream: self._stream(stream, *parts[stream]), range(len(parts))))
        rows = np.concatenate([rows for _, rows in done])
        tally = tally_from(self.loop, self.seed, start, count, [counts for counts, _ in done])
        own = columns_of(self._tables)
        return tally, results_from(start, rows[:, :own], _whole(rows[:, own:]))

    @cached_property
    @fixed_flags()
    def _start(self) -> tuple[Lanes, NDArray[np.int32]]:
        """Lanes (NumPy) at the steps at which rollouts begin, and what one comes to that is never hit.

        One call, with threats that stop nobody; the last snapshot is that of the whole run, and nobody begins there.
        """
        tables, nominal = self._tables, self._nominal
        halts = np.zeros(self.lanes, dtype=np.int32)
        halts[: len(nominal.begins)], halts[self._snapshots - 1] = nominal.begins, -1
        lanes = halted(tables, self.loop, halts)
        no_threats: HostArrays = {"exposure": np.zeros_like(tables.exposure)}
        nobody = np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, self.loop.robots), np.int64)
        given = replace(tables, **no_threats), first_lanes(lanes, self._snapshots), lanes
        safe, snapshots, lanes = jax.device_put(given, self._devices[0])
        lanes, results = self._call(safe, snapshots, lanes, nobody, self._nothing())
        return first_lanes(jax.tree.map(np.asarray, lanes), self._snapshots), results[self._snapshots - 1]

    def _nothing(self) -> tuple[NDArray[np.int64], ...]:
        """Visits by cell and kind, and by step and kind: none; and survived visits, where they are counted."""
        none = no_sums(self._tables, self._steps, 1)
        return tuple(jax.tree.leaves(jax.tree.map(np.int64, (none.by_cell, none.by_step, none.passes))))

    @fixed_flags()  # a thread has its own
    def _stream(self, stream: int, start: int, count: int) -> tuple[Counts, NDArray[np.int32]]:
        """One stream's ids: those that are hit run in lanes, call after call."""
        (snapshots, never_hit), device = self._start, self._devices[stream]
        given = self._on_device[device], jax.device_put(snapshots, device)
        counts, rows, nominal = self._nothing(), np.tile(never_hit, (count, 1)), self._nominal
        begun = np.zeros(len(nominal.begins), dtype=np.int64)
        for at in range(0, count, self._room):
            ids = np.arange(start + at, start + min(at + self._room, count))
            left = self.loop.bearing.tolerances(self.seed, ids, self.loop.robots)
            first = nominal.first_hits(left)
            hit = first < NO_HIT
            begin_at = nominal.begin_of[first[hit]]
            begun += np.bincount(begin_at, minlength=len(begun))
            # Who is never hit did what the nominal run does, and is counted with it.
            if hit.any():
                waiting = ids[hit], begin_at, left[hit] - nominal.before[begin_at]
                self._states[stream], results = self._call(*given, self._states[stream], waiting, counts)
                rows[ids[hit] - start] = results[: len(begin_at)]
        nominal.count(begun, count - int(begun.sum()), *counts)
        return self._counted(rows, *counts), rows

    def _call(
        self,
        tables: LaneTables,
        snapshots: Lanes,
        lanes: Lanes,
        waiting: tuple[NDArray[np.int64], NDArray, NDArray[np.int64]],
        counts: tuple[NDArray[np.int64], ...],
    ) -> tuple[Lanes, NDArray[np.int32]]:
        """One dispatch (more only after MOST_MOVES) for the rollouts that wait: lanes, and results.

        Visits are added to `counts`, by cell and by step. `waiting`: ids, snapshots, and what robots still bear.
        """
        queue = queue_of(self._room, len(self._tables.starts), *waiting)
        none = sums = no_sums(self._tables, self._steps, self._room)
        while True:
            lanes, sums = _program(self.pace)(tables, snapshots, lanes, sums, queue)
            for total, one in zip(counts, (sums.by_cell, sums.by_step, sums.passes), strict=False):
                total += np.asarray(one)
            if (np.asarray(lanes.mode) == OFF).all() and sums.next >= queue.count:
                return lanes, np.asarray(sums.results)
            # Counts are 32 bits wide: they are taken over, and the call goes on from empty ones.
            sums = replace(none, results=sums.results, next=sums.next)

    def _counted(
        self,
        rows: NDArray[np.int32],
        by_cell: NDArray[np.int64],
        by_step: NDArray[np.int64],
        passes: NDArray[np.int64] | None = None,
    ) -> Counts:
        """What the compiled simulator counts of the same rollouts; rows int32 `[count, COLUMNS]`."""
        loop, accessible = self.loop, len(self.loop.cells)
        cells, steps = by_cell.reshape(-1, CELL_KINDS)[:accessible], by_step.reshape(-1, STEP_KINDS)

        def of_kind(visits: NDArray[np.int64], bit: int) -> NDArray[np.int64]:
            return visits[:, (np.arange(visits.shape[1]) & bit) != 0].sum(axis=1)

        def histogram(column: int, bins: int) -> NDArray[np.int64]:
            return np.bincount(rows[:, column], minlength=bins).astype(np.int64)

        counts = make_counts(accessible, accessible, loop.robots, self._steps - 1)
        covered, new = of_kind(cells, NEW_VISITED), of_kind(steps, NEW_VISITED)
        if passes is not None:
            kept = passes.reshape(-1, MOST_PASSES)[:accessible]
            kept[:, 0] += len(rows) * np.isin(loop.cells, known_cells(loop)[1])
            counts = counts._replace(passes=kept)
        if loop.comes_home:
            counts = counts._replace(home=histogram(COLUMNS, loop.robots + 1))
        return counts._replace(
            visits=cells.sum(axis=1),
            stops=of_kind(cells, STOPPED),
            covered=covered,
            unsurvived=covered - of_kind(cells, NEW_SURVIVED),
            time=histogram(TIME_COLUMN, self._steps),
            new=new,
            late=of_kind(steps, NEW_SURVIVED) - new,
            visited=histogram(VISITED_COLUMN, accessible + 1),
            survived=histogram(SURVIVED_COLUMN, accessible + 1),
            alive=histogram(ALIVE_COLUMN, loop.robots + 1),
            outcomes=histogram(OUTCOME_COLUMN, len(Outcome)),
        )

    def traces(self, rollouts: Iterable[int]) -> Iterator[Trace]:
        """Those rollouts in full, in the order given, a few at a time."""
        waiting, tables = iter(rollouts), lane_tables(self.loop, self.seed, least=(TRACE_CELLS, TRACE_ROBOTS))
        while few := list(itertools.islice(waiting, TRACED)):
            yield from _traces(self.loop, tables, self.seed, few)

    def until(self, step: int) -> JaxClosedLoop:
        """The same rollouts cut off at the end of `step`."""
        return self._rolling(self.loop.until(step))

    def under(self, truth: World) -> JaxClosedLoop:
        """The same decisions under the threats of `truth`."""
        return self._rolling(self.loop.under(truth))

    def weighing(self, covered: NDArray[np.int64], found: NDArray[np.int64]) -> JaxClosedLoop:
        """The same rollouts, survived visits counted: `ClosedLoop.weighing`."""
        return self._rolling(self.loop.weighing(covered, found))

    def _rolling(self, loop: ClosedLoop) -> JaxClosedLoop:
        """Another loop in as many lanes and streams."""
        return JaxClosedLoop(loop, self.seed, streams=self._streams, lanes=self.lanes)


def _whole(columns: NDArray[np.int32]) -> NDArray[np.int64]:
    """Sums of weights `[B, 2]`, covered and found, from the columns `[B, 2 * PIECES]` of their pieces; or none."""
    pieces = columns.astype(np.int64).reshape(len(columns), columns.shape[1] // PIECES, PIECES)
    return (pieces << (PIECE_BITS * np.arange(PIECES))).sum(axis=2)


def queue_of(room: int, team: int, ids: NDArray[np.int64], begin_at: NDArray, left: NDArray[np.int64]) -> Queue:
    """So many rollouts at most of so many robots at most (NumPy): what they still bear, int64 `[R', K']`, in words."""
    more = (0, room - len(ids))
    return on_host(
        Queue,
        rollout=np.pad(ids, more).astype(np.uint32),
        begin_at=np.pad(begin_at, more).astype(np.int32),
        left=two_words(np.pad(left, (more, (0, team - left.shape[1])))).reshape(room, -1),
        count=np.int32(len(ids)),
    )


@fixed_flags()
def _traces(loop: ClosedLoop, tables: LaneTables, seed: int, rollouts: Sequence[int]) -> list[Trace]:
    """At most TRACED rollouts on one device, with a log that is made larger until everything fits."""
    ids, team = np.resize(np.array(rollouts, dtype=np.int64), TRACED), len(tables.starts)
    mine = queue_of(TRACED, team, ids, ids, loop.bearing.tolerances(seed, ids, loop.robots))
    nobody = queue_of(TRACED, team, ids[:0], ids[:0], np.zeros((0, 0), np.int64))
    pace = pace_of(TRACED, tables.size, attentive=loop.policy is not None)
    steps, events = TRACE_STEPS, TRACE_EVENTS
    while True:
        lanes = lanes_of(tables, loop, ids.astype(np.uint32), empty_log(tables, loop, TRACED, steps, events))
        sums = no_sums(tables, step_bucket(loop.max_steps, tables.size), TRACED)
        begun = replace(lanes, left=mine.left.reshape(-1))
        lanes, sums = jax.tree.map(np.asarray, _program(pace)(tables, lanes, begun, sums, nobody))
        longest, most = int(sums.results[:, TIME_COLUMN].max()) + 1, int(lanes.log.count.max())
        # What did not fit was counted, not kept.
        if longest <= steps and most <= events:
            return [_trace(loop, lanes.log, lane, one, sums.results[lane]) for lane, one in enumerate(rollouts)]
        steps, events = 1 << max(longest, steps).bit_length(), 1 << max(most, events).bit_length()


def _trace(loop: ClosedLoop, log: Log, lane: int, rollout: int, result: NDArray[np.int32]) -> Trace:
    """One lane's log (NumPy) as a trace."""
    frames, events, cell_ids = (
        np.array(flat).reshape(TRACED, -1, *flat.shape[1:])[lane] for flat in (log.frames, log.events, log.cell_ids)
    )
    frames = frames[: int(result[TIME_COLUMN]) + 1, :, : loop.robots]
    if loop.state is not None:
        frames[: loop.state.step + 1] = first_frames(loop.state, loop.cells)
    happened, area_of = events[: log.count[lane]], cell_ids[: len(loop.cells)]
    return trace_from(loop, rollout, frames, happened, area_of, Outcome(int(result[OUTCOME_COLUMN])))
