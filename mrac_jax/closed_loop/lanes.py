"""A rollout as a lane: its state, the book on the device, and how a robot's walk ends.

A threshold is one number, so the place of a loss on a walk is known when the walk begins: a bisection in the walk's
running sum of hazards. What is visited by a step is the cells of the walks that have ended, and a row of `prefix` for
each robot. Axis letters: `B` lanes, `K` robots, `G` capacity for areas, `S` any of them; the others as
in `mrac_jax.closed_loop.book`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from mrac_jax.arrays import STATIC, is_reached, less
from mrac_jax.closed_loop.book import BUCKET, COUNT, FIRST, NEVER, NOWHERE, mixed

START, FOLLOW, TRAVEL, COVER, LAND, RETURN, RECALL, CHARGE, IDLE, OUT, DEAD = range(11)
"""State of a robot: enters its start and has an area; follows an external path; travels; covers; enters its start and
has none; returns to base for good, or to be recharged; is recharged; waits; neither moves nor waits; is lost."""
ARRIVES, DIES, ENDS, TURNS = range(4)
"""End of a walk: at its last cell, at a visit, with the last move of the robot's range, or with its return to base."""
OFF, RUN, MISSING, DONE, FULL = range(5)
"""Mode of a lane: no rollout; next event; an entry is missing in the book; at its end; capacity exceeded."""
DOING, FATE, HERE, AREA, IDENT, WALK, ROW, SINCE, LAST, UNTIL, FIELDS = range(11)
"""Of a robot: its fate, the cell at which its walk ends, its piece (NONE) and the id of that area, its walk's entry and
first row, the step before its first move, its number of moves, and the step of the last move of its range (for a
waiting robot, moves left)."""
TIME, HOME, DELIVERED, NUMBERS = 2, 7, 8, 9
"""Numbers of a rollout: visited, survived, time, alive, outcome, bisected, divided, robots at a base, delivered."""
LIMITLESS = 2**28
"""The range of a robot with unlimited range."""
STOPPED, FINAL = 2**31, 2**30
"""Flags of a log's row above the moves: the last one destroyed the robot; the rollout ended before the walk."""
HALVINGS = 23
"""Number of bits for the steps of a run."""

hold = jax.lax.optimization_barrier


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Lanes:
    """Rollouts in progress. All int32 but sets and thresholds, uint32.

    Attributes:
        mode, number: `[B]`, of the lane, and of its rollout in the queue. fuel: `[B]`, events after which it halts.
        visited, survived: `[B, W]`, by walks that have ended; now: visited by the last event.
        slots: `[B, G]`, the piece of each unassigned area by its id, NONE of others; made: `[B]`, areas so far.
        key: `[B, K]`, step * K + robot of each robot's next event, NEVER: none. robots: `[B, K, FIELDS]`.
        left: `[B, K, 2]`, the threshold that is left as the walk begins, leading word first.
        shared: `[B, 2]`, areas bisected, and divided. last: `[B]`, the last step with progress, or that of the end.
            outcome: `[B]`. over: `[B]`, 0, or the outcome plus 1 once all robots return to base.
        asked: `[B, W + 1]`, the set and the salt of the entry that is missing.
        undelivered: `[B, K + 1, W]`, cells visited by each robot, in walks that have ended, and in the last row the
            cells delivered; None: these are not counted.
    """

    mode: jax.Array
    number: jax.Array
    fuel: jax.Array
    visited: jax.Array
    survived: jax.Array
    now: jax.Array
    slots: jax.Array
    made: jax.Array
    key: jax.Array
    robots: jax.Array
    left: jax.Array
    shared: jax.Array
    last: jax.Array
    outcome: jax.Array
    over: jax.Array
    asked: jax.Array
    undelivered: jax.Array | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Homes:
    """Bases of the robots. All int32, `S` sets of bases.

    Attributes:
        of: `[K]`, the bases of each robot. steps: `[S, A']`, moves of the path there, below 0 without a path.
        range: `[K]`, moves that a robot can make. last: step by which they must be there. recharge: steps that
            restore the range of a robot, 0: never.
    """

    of: jax.Array
    steps: jax.Array
    range: jax.Array
    last: jax.Array
    recharge: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Book:
    """The decisions of a closed loop on a device: a frozen pytree. Lanes report missing entries.

    Attributes:
        entries .. buckets: as of `HostBook`; sums: uint32 `[D, 2]`, leading word first.
        mask: int32, costs without their level. every: uint32 `[W]`, all cells. max_steps, quiet: int32, T_max, and the
            steps in a row without progress after which a run ends. next_of: int32 `[P']`, of an external plan's area
            the next one of the same robot, NONE after the last.
        first: Lanes `[M]`, snapshots of the run without losses, at which lanes begin; their `left`: the hazard that
            robots have met by then, without the walk that they are on. met: uint32 `[M, K, 2]`, with it: a robot whose
            threshold that reaches is lost before.
        homes: None if robots do not return.
        halvings, turnings, parts: static: bits of the largest number of visits and of moves of a walk; maximum parts of
            a split.
        free: bool `[H, W]`, cells that robots can reach; cells: int32 `[A]`, the index of each in the map. plain: bool,
            robots are alike, of Weibull shape 1. None in the engine, which compiles one program for many maps.
    """

    entries: jax.Array
    sets: jax.Array
    salts: jax.Array
    prefix: jax.Array
    cell_at: jax.Array
    sums: jax.Array
    at: jax.Array
    bits: jax.Array
    cost: jax.Array
    target: jax.Array
    steps: jax.Array
    need: jax.Array
    brought: jax.Array
    buckets: jax.Array
    homes: Homes | None
    mask: jax.Array
    every: jax.Array
    max_steps: jax.Array
    quiet: jax.Array
    next_of: jax.Array
    first: Lanes
    met: jax.Array
    halvings: int = field(metadata=STATIC)
    turnings: int = field(metadata=STATIC)
    parts: int = field(metadata=STATIC)
    free: Any = None
    cells: Any = None
    plain: Any = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Log:
    """Walks that have ended, of all lanes: uint32 `[L, 4]` rows (number * 1024 + robot, entry, step before its first
    move, moves and flags), and how many, int32."""

    rows: jax.Array
    used: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Ended:
    """Results of lanes: int32 `[.., NUMBERS]`, and sets of the visited and the survived cells, uint32 `[.., W]`."""

    numbers: jax.Array
    visited: jax.Array
    survived: jax.Array


def at(table: jax.Array, place: jax.Array) -> jax.Array:
    """Rows of a table; every index is in range."""
    return table.at[place].get(mode="promise_in_bounds")


def pick(rows: jax.Array, robot: jax.Array) -> jax.Array:
    """The entry of one robot in each lane, `[B, ..]` of `[B, K, ..]`."""
    return jnp.take_along_axis(rows, robot.reshape(-1, *[1] * (rows.ndim - 1)), axis=1)[:, 0]


def robot_fields(  # type: ignore[no-untyped-def]
    like, *, doing, here, area, ident, since, until, fate=ARRIVES, walk=NOWHERE, row=0, last=0
) -> jax.Array:
    """`Lanes.robots` of robots, int32 `[.., FIELDS]`, each field a number or an array like `like` `[..]`."""
    fields = doing, fate, here, area, ident, walk, row, since, last, until
    return jnp.stack([jnp.broadcast_to(one, like.shape).astype(jnp.int32) for one in fields], axis=-1)


def entered(book: Book, row: jax.Array) -> jax.Array:
    """The cells of walks up to these rows, int32 `[B, K]`, of all robots: uint32 `[B, W]`."""
    if row.shape[1] > 16:
        return jnp.bitwise_or.reduce(at(book.prefix, row), axis=1)
    total = at(book.prefix, row[:, 0])
    for robot in range(1, row.shape[1]):
        total = total | at(book.prefix, row[:, robot])
    return total


def moves_by(lanes: Lanes, step: jax.Array) -> jax.Array:
    """Moves of their walks that robots have made by the end of these steps, `[B, K]` of `[B, 1 or K]`."""
    return jnp.clip(step - lanes.robots[:, :, SINCE], 0, lanes.robots[:, :, LAST])


def is_covered(book: Book, lanes: Lanes, step: jax.Array) -> jax.Array:
    """Whether all cells are visited by the end of these steps, bool `[B]` of `[B]`."""
    visited = lanes.visited | entered(book, lanes.robots[:, :, ROW] + moves_by(lanes, step[:, None]))
    return (visited == book.every).all(axis=1)


def first_that(fits: Callable[[jax.Array], jax.Array], low: jax.Array, high: jax.Array, halvings: int) -> jax.Array:
    """Bisection: the least of `low` .. `high` - 1 that fits, as all above it do; `high`: none. All `[S]`.

    `halvings`: number of bits of `high - low`.
    """

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        beyond = (low < high) & ~fits(middle)
        # A barrier: XLA would compute a chain of gathers anew for each of its readers.
        return hold((jnp.where(beyond, middle + 1, low), jnp.where(beyond, high, middle)))

    return jax.lax.fori_loop(0, halvings, halve, (low, high))[0]


def walk(
    book: Book, entry: jax.Array, left: jax.Array, budget: jax.Array, halvings: int | None = None
) -> tuple[jax.Array, ...]:
    """(first row, moves, fate, last cell) of walks `[S]` that begin with thresholds `[S, 2]` and moves left."""
    base, length, end, first, count = hold(at(book.entries, entry)).T[:5]
    survived = first_that(
        lambda visit: is_reached(left, at(book.sums, first + visit)), jnp.zeros_like(count), count,
        halvings or book.halvings,
    )  # fmt: skip
    lost = jnp.where(survived < count, at(book.at, first + survived), NEVER)
    last = jnp.minimum(lost, length)
    ends = (budget < lost) & (budget <= length)
    fate = jnp.where(ends, ENDS, jnp.where(lost < NEVER, DIES, ARRIVES))
    return hold((base, jnp.where(ends, budget, last), fate, end))


def left_after(book: Book, entry: jax.Array, left: jax.Array, moves: jax.Array | None = None) -> jax.Array:
    """Thresholds `[S, 2]` after so many moves of walks, all moves if None."""
    row = at(book.entries, entry)
    first, visits = row[:, FIRST], row[:, COUNT]
    if moves is not None:
        none = jnp.zeros_like(visits)
        visits = first_that(lambda visit: at(book.at, first + visit) > moves, none, visits, book.halvings)
    return less(left, at(book.sums, first - 1 + visits))


def stride_of(book: Book, lanes: Lanes) -> int:
    """Keys of a step: the robots' turns, and with return to base, the events at the end of the step."""
    return lanes.key.shape[1] * (1 if book.homes is None else 2)


def look_up(book: Book, row: jax.Array, salt: jax.Array) -> jax.Array:
    """The entries of sets `[S, W]` and salts, uint32 `[S]`; -1: missing."""
    bucket, tag = hold(mixed(row, salt))
    there = at(book.buckets, (bucket & jnp.uint32(book.buckets.shape[0] - 1)).astype(jnp.int32))
    entry = jnp.where(there[:, :BUCKET] == tag[:, None], there[:, BUCKET:], 0).max(axis=1).astype(jnp.int32)
    # Hashes may collide, so the sets are compared too.
    same = (at(book.sets, entry) == row).all(axis=1) & (at(book.salts, entry) == salt)
    return jnp.where(same & (entry > 0), entry, -1)


def one_cell(book: Book, cell: jax.Array) -> jax.Array:
    """The sets of one cell, uint32 `[S, W]`."""
    word = jnp.arange(book.every.shape[0], dtype=jnp.int32)
    bit = jnp.uint32(1) << (cell & 31).astype(jnp.uint32)
    return jnp.where(word == (cell >> 5)[:, None], bit[:, None], jnp.uint32(0))


def log_row(number: jax.Array, robot: jax.Array, me: jax.Array, moves: jax.Array, flags: jax.Array) -> jax.Array:
    """Rows of the log, uint32 `[.., 4]`."""
    whole = (number, robot, me[..., WALK], me[..., SINCE], moves)
    number, robot, entry, since, last = (part.astype(jnp.uint32) for part in whole)
    # 22 bits hold the number of a rollout in its batch, 10 that of a robot.
    return jnp.stack([number << 10 | robot, entry, since, last | flags], axis=-1)


def write(log: Log, chosen: jax.Array, rows: jax.Array) -> Log:
    """Append the chosen rows, `[S]` of `[S, 4]`."""
    place = log.used + jnp.cumsum(chosen, dtype=jnp.int32) - 1
    place = jnp.where(chosen, place, log.rows.shape[0])
    return Log(log.rows.at[place].set(rows, mode="drop"), log.used + chosen.sum(dtype=jnp.int32))


def if_any(wanted, make, other=None):  # type: ignore[no-untyped-def]
    """`make()` if some lane needs it, else `other`, or zeros. On a GPU a branch would make the host wait."""
    if jax.default_backend() != "cpu":
        return make()
    if other is None:
        other = jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), jax.eval_shape(make))
    return jax.lax.cond(wanted.any(), make, lambda: other)
