"""Counts of rollouts from the logged walks of their lanes.

On the host by cell, by step and by rollout; on the device the sums by cell of a gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.closed_loop.book import BASE, COUNT, FIRST, LENGTH, HostBook
from mrac_jax.closed_loop.events import begin, ended, next_event
from mrac_jax.closed_loop.lanes import (
    DELIVERED,
    DONE,
    FINAL,
    HOME,
    OFF,
    RUN,
    STOPPED,
    Book,
    Ended,
    Lanes,
    Log,
    at,
    write,
)
from planner.rollouts.loop import ClosedLoop, known_cells
from planner.simulator.jit import threaded
from planner.simulator.state import MOST_PASSES, make_counts
from planner.simulator.thresholds import UNIT

NO_STEP = 2**30
"""The first visit of a cell that was not visited."""
MOVES = FINAL - 1


class Begun(NamedTuple):
    """The history of rollouts that begin at each snapshot. Axis `M`, snapshots.

    Attributes:
        first, safe: int32 `[M, A]`, steps of the first visit and the first survived one, NO_STEP if none.
        visits: int32 `[M, A]`; passes: uint8 `[M, A]`, survived ones, at most MOST_PASSES.
    """

    first: NDArray[np.int32]
    safe: NDArray[np.int32]
    visits: NDArray[np.int32]
    passes: NDArray[np.uint8]


def nothing_begun(loop: ClosedLoop, snapshots: int) -> Begun:
    """History of rollouts that have entered no cell."""
    size, (visited, survived) = (snapshots, len(loop.cells)), known_cells(loop)
    first, safe = np.full(size, NO_STEP, np.int32), np.full(size, NO_STEP, np.int32)
    passes = np.zeros(size, np.uint8)
    # Cells covered before a mission's state are not counted here: `tally_from` adds them.
    first[:, np.searchsorted(loop.cells, visited)] = -1
    safe[:, np.searchsorted(loop.cells, survived)] = -1
    passes[:, np.searchsorted(loop.cells, survived)] = 1
    return Begun(first, safe, np.zeros(size, np.int32), passes)


@threaded
def _sort(rows, size):  # type: ignore[no-untyped-def]
    """Group the log's rows by rollout: `order[begins[n]:begins[n + 1]]` are those of rollout n < size."""
    begins, order = np.zeros(size + 2, np.int64), np.empty(len(rows), np.int64)
    for row in range(len(rows)):
        begins[(rows[row, 0] >> np.uint32(10)) + np.uint32(2)] += 1
    begins[:] = np.cumsum(begins)
    for row in range(len(rows)):  # moves each begin to its end, the next one's begin
        number = (rows[row, 0] >> np.uint32(10)) + np.uint32(1)
        order[begins[number]] = row
        begins[number] += 1
    return begins, order


@threaded
def _follow(rows, entries, cell_at, flags, first, safe, visits, stops, passes):  # type: ignore[no-untyped-def]
    """Enter the cells of a rollout's walks; rows with one of the `flags` are left out."""
    for row in range(len(rows)):
        last = rows[row, 3]
        if last & flags:
            continue
        moves, stopped = np.int64(last & np.uint32(MOVES)), last & np.uint32(STOPPED) > 0
        since, begin = np.int64(np.int32(rows[row, 2])), np.int64(entries[rows[row, 1], BASE])
        for move in range(1, moves + 1):
            cell = cell_at[begin + move]
            if cell < 0:
                continue
            visits[cell] += 1
            step = np.int32(since + move)
            first[cell] = min(first[cell], step)
            if stopped and move == moves:
                stops[cell] += 1
            else:
                safe[cell] = min(safe[cell], step)
                if passes[cell] < MOST_PASSES:
                    passes[cell] += np.uint8(1)


@threaded
def _count(  # type: ignore[no-untyped-def]
    rows, begins, order, which, entries, cell_at, start, safe_start, passes_start, visits, stops, covered, unsurvived,
    new, late, by_passes, weights, found, value_sums,
):  # fmt: skip
    """Count rollouts, of which `which[n]` began at that snapshot; `passes` and `value_sums` where they have rows."""
    size = start.shape[1]
    first, safe, passes = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.uint8)
    for number in range(len(which)):
        first[:], safe[:], passes[:] = start[which[number]], safe_start[which[number]], passes_start[which[number]]
        mine = rows[order[begins[number] : begins[number + 1]]]
        _follow(mine, entries, cell_at, np.uint32(0), first, safe, visits, stops, passes)
        for cell in range(size):
            if 0 <= first[cell] < NO_STEP:
                covered[cell] += 1
                unsurvived[cell] += 1
                new[first[cell]] += 1
                late[first[cell]] -= 1
            if 0 <= safe[cell] < NO_STEP:
                unsurvived[cell] -= 1
                late[safe[cell]] += 1
        if len(by_passes):
            for cell in range(size):  # with at least so many
                for many in range(passes[cell]):
                    by_passes[cell, many] += 1
            for cell in range(size):
                if first[cell] < NO_STEP:
                    value_sums[number, 0] += weights[cell]
                    value_sums[number, 1] += found[cell, passes[cell]]


class Counting:
    """Counts of one call, added up over its batches."""

    def __init__(self, loop: ClosedLoop, begun: Begun) -> None:
        size, self.loop, self.begun, self.weighs = len(loop.cells), loop, begun, loop.weights is not None
        self.counts = make_counts(
            size, size, loop.robots, loop.max_steps, self.weighs, loop.comes_home, delivers=loop.delivers
        )

    def add(self, book: HostBook, rows: NDArray[np.uint32], which: NDArray[np.int32]) -> NDArray[np.int64]:
        """Count rollouts of a batch, which began at these snapshots `[n]`; the sums of their weights `[n, 2 or 0]`."""
        c, begun, weights, none = self.counts, self.begun, self.loop.weights, np.zeros(0, np.int64)
        covered, found = (none, none[:, None]) if weights is None else (weights.covered, weights.found)
        value_sums = np.zeros((len(which), 2 * self.weighs), np.int64)
        begins, order = _sort(rows, len(which))
        _count(
            rows, begins, order, which, book.entries.rows, book.cell_at.rows, begun.first, begun.safe, begun.passes,
            c.visits, c.stops, c.covered, c.unsurvived, c.new, c.late, c.passes, covered, found, value_sums,
        )  # fmt: skip
        c.visits[:] += np.bincount(which, minlength=len(begun.visits)) @ begun.visits
        return value_sums

    def add_numbers(self, numbers: NDArray[np.int32]) -> None:
        """Count the results of rollouts, int32 `[n, NUMBERS]`."""
        c = self.counts
        counted = dict(enumerate((c.visited, c.survived, c.time, c.alive, c.outcomes)))
        counted |= {HOME: c.home, DELIVERED: c.delivered}
        for column, counts in counted.items():
            if len(counts):  # else this mission does not count them
                counts[:] += np.bincount(numbers[:, column], minlength=len(counts))


def follow_nominal(book: HostBook, begun: Begun, rows: NDArray[np.uint32]) -> None:
    """Write the logs of lanes into `begun`; lane m is halted at snapshot m."""
    begins, order = _sort(rows, len(begun.first))
    none_lost = np.zeros(begun.first.shape[1], np.int64)
    for lane, (first, safe, visits, passes) in enumerate(zip(*begun, strict=True)):
        mine = rows[order[begins[lane] : begins[lane + 1]]]
        _follow(mine, book.entries.rows, book.cell_at.rows, np.uint32(FINAL), first, safe, visits, none_lost, passes)


# On the device: the gradient of expected coverage (`mrac_jax.functional.closed_gradient`).


def with_hazards(book: Book, p: jax.Array) -> tuple[Book, jax.Array]:
    """The same decisions with these probabilities `[A]` that a visit destroys a robot; lanes begin at the first step.

    A cell that is safe in the book's map may be dangerous, so every move counts as a dangerous visit. Also returns the
    cell that the move of each row enters, int32 `[R]`; A: none.
    """
    row, moves = jnp.arange(len(book.cell_at), dtype=jnp.int32), book.entries[:, LENGTH]
    begins = jnp.zeros(row.shape, bool).at[book.entries[:, BASE]].set(True)
    base = jax.lax.cummax(jnp.where(begins, row, 0))
    cell = jnp.where(begins | (book.cell_at < 0), len(p), book.cell_at)
    with jax.enable_x64(True):  # only for values traced here
        own = jnp.rint(-jnp.log1p(-p.astype(jnp.float64)) * UNIT).astype(jnp.int64)
        total = jnp.cumsum(jnp.append(own, 0)[cell])
        total = total - total[base]
        sums = jnp.stack([total >> 32, total & (2**32 - 1)], axis=-1).astype(jnp.uint32)
    entries = book.entries.at[:, FIRST].set(book.entries[:, BASE] + 1).at[:, COUNT].set(moves)
    first, met = jax.tree.map(lambda of: of[:1], (book.first, book.met))
    halvings = len(row).bit_length()
    return replace(book, entries=entries, sums=sums, at=row - base, first=first, met=met, halvings=halvings), cell


def roll_out(book: Book, left: jax.Array, asked: jax.Array, log: Log | None) -> tuple[Lanes, Ended, Log | None]:
    """Rollouts with these thresholds `[B, K, 2]` where `asked`, until the book lacks a decision."""
    lanes = begin(book, left, jnp.arange(len(left), dtype=jnp.int32))[0]
    state = replace(lanes, mode=jnp.where(asked, lanes.mode, OFF)), log
    lanes, log = jax.lax.while_loop(
        lambda state: (state[0].mode == RUN).any(), lambda state: next_event(book, *state), state
    )
    results, rows, there = ended(book, replace(lanes, last=jnp.maximum(lanes.last, 0)))
    return lanes, results, log and write(log, there.reshape(-1), rows.reshape(-1, 4))


def scores(p: jax.Array, decisions: tuple[Book, jax.Array], left: jax.Array, asked: jax.Array) -> Any:
    """Sums over rollouts of d log(probability of the rollout) / dp: `losses_c / p_c - passes_c / (1 - p_c)`.

    decisions: of `with_hazards`. left, asked: as of `roll_out`.

    Returns: the number of rollouts; their cells visited; by cell `[A]` the losses, the scores, and the scores times
    the cells visited.
    """
    book, cell = decisions
    # An area is travelled to and covered at most once; robots that recharge return a few times more.
    room = len(left) * 2 * (book.first.slots.shape[1] + book.met.shape[1])
    lanes, results, log = roll_out(book, left, asked, Log(jnp.zeros((room, 4), jnp.uint32), jnp.int32(0)))
    assert log is not None
    counts = (lanes.mode == DONE) & (log.used <= room)
    number, entry, moves = (log.rows[:, column] for column in (0, 1, 3))
    walk, lost = at(book.entries, entry.astype(jnp.int32))[:, BASE], moves >> 31 > 0
    end, which = walk + (moves & jnp.uint32(MOVES)).astype(jnp.int32), (number >> 10).astype(jnp.int32)
    there = at(counts, which) & (jnp.arange(room) < log.used)

    def log_chance(p: jax.Array) -> jax.Array:
        survives = jnp.cumsum(jnp.append(jnp.log1p(-p), 0)[cell])
        return survives[end - lost] - survives[walk] + jnp.where(lost, jnp.append(jnp.log(p), 0)[cell[end]], 0)

    covered, score = jnp.where(counts, results.numbers[:, 0], 0).astype(p.dtype), jax.vjp(log_chance, p)[1]
    each, weighed = (score(there * at(weight, which))[0] for weight in (jnp.ones_like(covered), covered))
    losses = jnp.zeros(len(p) + 1, p.dtype).at[cell[end]].add(there & lost)[:-1]
    return counts.sum(dtype=jnp.int32), covered.sum(), losses, each, weighed
