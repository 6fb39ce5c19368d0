"""Parts of an event: the return to base, and `Find Area To Share`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import HALVE, LENGTH, NEVER, PARTS, PIECE
from mrac_jax.closed_loop.lanes import Book, Lanes, at, hold, look_up, one_cell, pick, walk
from planner.simulator.codes import Outcome

# Robots that return to base (SPEC section 19): the turning point, reachable pieces, and the end of a mission.


def moves_home(book: Book, robot: jax.Array, cell: jax.Array) -> jax.Array:
    """Moves of the robots' paths to a base from cells, of the same shape; below 0: no path."""
    assert book.homes is not None
    place = at(book.homes.of, robot) * book.homes.steps.shape[1] + cell
    return at(book.homes.steps.reshape(-1), place)


def of_bases(table: jax.Array, book: Book, row: jax.Array, robot: jax.Array) -> jax.Array:
    """Values of a table `[R, S]` at rows, for the robots' bases."""
    assert book.homes is not None
    return at(table.reshape(-1), row * table.shape[1] + at(book.homes.of, robot))


def depart(
    book: Book, robot: jax.Array, doing: jax.Array, entry: jax.Array, left: jax.Array, since: jax.Array,
    until: jax.Array, waits: bool = False,
) -> tuple[jax.Array, ...]:  # fmt: skip
    """(first row, moves, fate, last cell) of walks `[S]` that begin with thresholds `[S, 2]`.

    Args:
        doing: with an area of its own, a robot returns to base before it gets out of range.
        since: the step before the first move. until: that of the last move of the robot's range.
        waits: a walk of no moves takes a turn.
    """
    budget = until - since + ((doing == ln.RETURN) | (doing == ln.RECALL))
    base, moves, fate, end = walk(book, entry, left, budget)
    if waits:  # that turn may be the last of its range
        fate = jnp.where((moves == 0) & (budget <= 1), ln.ENDS, fate)
    if book.homes is None:
        return base, moves, fate, end
    within, length = jnp.minimum(until, book.homes.last) - since, at(book.entries, entry)[:, LENGTH]

    def is_late(move: jax.Array) -> jax.Array:
        return of_bases(book.need, book, base + move, robot) > within

    first = ln.first_that(is_late, jnp.ones_like(length), length + 1, book.turnings)
    owns = (doing == ln.TRAVEL) | (doing == ln.COVER)
    turns = owns & (first <= length) & (first <= moves)
    moves = jnp.where(turns, first - 1, moves)
    if waits:
        turns = turns | ((length == 0) & is_late(jnp.zeros_like(length)))
    return hold((base, moves, jnp.where(turns, ln.TURNS, fate), end))


def is_within_range(book: Book, place: jax.Array, robot: jax.Array, left: jax.Array) -> jax.Array:
    """True for robots `[B]` that could return to base from the pieces `[B, n]` with the moves left."""
    steps, goal = at(book.steps.reshape(-1), place), at(book.target.reshape(-1), place)
    way = moves_home(book, jnp.broadcast_to(robot[:, None], place.shape), goal)
    return (way < 0) | (steps + way <= left[:, None])


def all_return(book: Book, lanes: Lanes, runs: jax.Array, key: jax.Array) -> Lanes:
    """Where the mission is over before the next event, all robots return to base at the end of that step.

    Their walks end at their present cells, and each departs by an event of its own.
    """
    robots, stride = lanes.robots, ln.stride_of(book, lanes)
    step, K = jnp.minimum(key // stride, book.max_steps + 1), lanes.key.shape[1]
    doing, covered = robots[:, :, ln.DOING], partial(ln.is_covered, book, lanes)
    stuck = lanes.last + book.quiet
    asleep = (doing > ln.CHARGE).all(axis=1) & (step + (key % stride >= K) > stuck) & (stuck <= book.max_steps)
    # The cells visited by the last event were not complete before it.
    complete = (step > lanes.last) & covered(step - 1)
    over = runs & (lanes.over == 0) & (complete | asleep)

    def turn() -> Lanes:
        first = ln.first_that(covered, jnp.minimum(lanes.last, step - 1), step - 1, ln.HALVINGS)
        time = jnp.where(complete, first, stuck)
        cut = over[:, None] & ((doing < ln.RETURN) | (doing == ln.IDLE))
        charging = over[:, None] & (doing == ln.CHARGE)
        due = time[:, None] * stride + K + jnp.arange(K, dtype=jnp.int32)
        outcome = jnp.where(complete, int(Outcome.COMPLETE), int(Outcome.NO_PROGRESS))
        after = {
            ln.DOING: jnp.where(charging, ln.OUT, doing),
            ln.FATE: jnp.where(cut, ln.TURNS, robots[:, :, ln.FATE]),
            ln.LAST: jnp.where(cut, ln.moves_by(lanes, time[:, None]), robots[:, :, ln.LAST]),
        }
        return replace(
            lanes,
            robots=jnp.stack([after.get(name, robots[:, :, name]) for name in range(ln.FIELDS)], axis=2),
            key=jnp.where(cut, due, jnp.where(charging, NEVER, lanes.key)),
            over=jnp.where(over, outcome + 1, lanes.over),
            last=jnp.where(over, time, lanes.last),
        )

    return ln.if_any(over, turn, lanes)


def end_walks(
    book: Book, lanes: Lanes, robot: jax.Array, me: jax.Array, moves: jax.Array, survived: jax.Array
) -> Lanes:
    """Lanes in which robots `[B]` have made so many moves of their walks, and survived so many; below 0: none."""

    def come(moves: jax.Array) -> jax.Array:
        cells = at(book.prefix, me[:, ln.ROW] + jnp.maximum(moves, 0))
        return jnp.where((moves >= 0)[:, None], cells, jnp.uint32(0))

    undelivered = lanes.undelivered
    if undelivered is not None:
        last = of_bases(book.brought, book, me[:, ln.ROW] + jnp.maximum(survived, 0), robot)
        own = pick(undelivered, robot)
        home = jnp.where((last > 0)[:, None], own | come(last), jnp.uint32(0))
        mine = jnp.arange(undelivered.shape[1], dtype=jnp.int32) == robot[:, None]
        undelivered = jnp.where(mine[:, :, None], (own | come(survived))[:, None], undelivered)
        undelivered = undelivered.at[:, -1].set(undelivered[:, -1] | home)
    return replace(
        lanes, visited=lanes.visited | come(moves), survived=lanes.survived | come(survived), undelivered=undelivered
    )


# `Find Area To Share` for lanes: a robot without an area, the helper, takes a part of that of another, its owner.


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Sharing:
    """Result of `Find Area To Share`, `[B]` each: whether there is an area, and its owner; the split of its unvisited
    cells and the walks of owner and helper to their parts (-1: missing, then requested); parts `[B, 2]`, counted from
    the split's first."""

    found: jax.Array
    owner: jax.Array
    split: jax.Array
    parts: jax.Array
    walks: jax.Array
    asked: jax.Array


def find_to_share(
    book: Book, lanes: Lanes, helper: jax.Array, here: jax.Array, offset: jax.Array, afford: jax.Array
) -> Sharing:
    """`Find Area To Share` for helpers in the cells `here`: the least (level, cost, id) of those close enough."""
    robots, flat = jnp.arange(lanes.key.shape[1], dtype=jnp.int32), book.cost.shape[1]
    doing, area = lanes.robots[:, :, ln.DOING], lanes.robots[:, :, ln.AREA]
    owns = (doing == ln.START) | (doing == ln.TRAVEL) | (doing == ln.COVER)
    piece = jnp.maximum(area, 0)
    place = piece * flat + here[:, None]
    rest = at(book.bits, piece) & ~lanes.now[:, None]
    left = jax.lax.population_count(rest).sum(axis=2, dtype=jnp.uint32).astype(jnp.int32)
    cost = at(book.cost.reshape(-1), place)
    fits = owns & (robots != helper[:, None]) & (left >= 2) & (at(book.steps.reshape(-1), place) <= left)
    fits = fits & (cost < NEVER)
    if book.homes is not None:
        fits = fits & is_within_range(book, place, helper, afford)
    found = fits.any(axis=1)
    for value in (cost, lanes.robots[:, :, ln.IDENT]):
        fits = fits & (value == jnp.where(fits, value, NEVER).min(axis=1, keepdims=True))
    owner = jnp.argmax(fits, axis=1).astype(jnp.int32)
    todo = pick(rest, owner)
    halve = jnp.full(owner.shape, HALVE, jnp.uint32)
    split = look_up(book, todo, halve)
    entry = at(book.entries, jnp.maximum(split, 0))
    there = at(book.cell_at, pick(lanes.robots[:, :, ln.ROW] + offset, owner))
    parts = jnp.arange(book.parts, dtype=jnp.int32)
    piece = jnp.minimum(entry[:, PIECE, None] + parts, book.bits.shape[0] - 1) * flat
    one, two = (at(book.cost.reshape(-1), piece + cell[:, None]) & book.mask for cell in (there, here))
    differ = (parts[:, None] != parts) & (jnp.maximum(parts[:, None], parts) < entry[:, PARTS, None, None])
    total = jnp.where(differ, one[:, :, None] + two[:, None, :], 2 * NEVER - 1)
    best = jnp.argmin(total.reshape(total.shape[0], -1), axis=1).astype(jnp.int32)
    chosen = jnp.stack([best // book.parts, best % book.parts], axis=1)
    cells = jnp.stack([there, here], axis=1).reshape(-1)
    goal = at(book.target.reshape(-1), (entry[:, PIECE, None] + chosen).reshape(-1) * flat + cells)
    ways = one_cell(book, goal)
    walks = look_up(book, ways, cells.astype(jnp.uint32)).reshape(-1, 2)
    ways = jnp.concatenate([ways, cells[:, None].astype(jnp.uint32)], axis=1).reshape(*walks.shape, -1)
    way = jnp.where(walks[:, :1] < 0, ways[:, 0], ways[:, 1])
    asked = jnp.where((split < 0)[:, None], jnp.concatenate([todo, halve[:, None]], axis=1), way)
    return Sharing(found, owner, split, chosen, walks, asked)


def owner_sets_out(book, lanes, log, share, made, first, step, helper, offset):  # type: ignore[no-untyped-def]
    """The owner of a shared area leaves its walk at its present cell, and departs to its part.

    If it has not entered its start yet, only its area changes.
    """
    K, owner = lanes.key.shape[1], share.owner
    me, by = pick(lanes.robots, owner), pick(offset, owner)
    waits = me[:, ln.DOING] == ln.START
    left = ln.left_after(book, me[:, ln.WALK], pick(lanes.left, owner), by)
    since = step - (owner > helper)
    way, travel = jnp.maximum(share.walks[:, 0], 0), jnp.full_like(step, ln.TRAVEL)
    base, moves, fate, end = depart(book, owner, travel, way, left, since, me[:, ln.UNTIL], True)
    part, ident = first + share.parts[:, 0], made + share.parts[:, 0]
    after = ln.robot_fields(
        step, doing=ln.TRAVEL, here=end, area=part, ident=ident, since=since, until=me[:, ln.UNTIL], fate=fate,
        walk=way, row=base, last=moves,
    )  # fmt: skip
    given = jnp.array([name in (ln.AREA, ln.IDENT) for name in range(ln.FIELDS)])
    after = jnp.where(waits[:, None] & ~given, me, after)
    here = share.found[:, None] & (jnp.arange(K, dtype=jnp.int32) == owner[:, None])
    goes = here & ~waits[:, None]
    walked = jnp.where(share.found & ~waits, by, -1)
    lanes = replace(
        end_walks(book, lanes, owner, me, walked, walked),
        key=jnp.where(
            goes,
            ((since + jnp.maximum(moves + (fate == ln.TURNS), 1)) * ln.stride_of(book, lanes) + owner)[:, None],
            lanes.key,
        ),
        robots=jnp.where(here[:, :, None], after[:, None], lanes.robots),
        left=jnp.where(goes[:, :, None], left[:, None], lanes.left),
    )
    if log is not None:
        rows = ln.log_row(lanes.number, owner, me, by, jnp.zeros(by.shape, jnp.uint32))
        log = ln.write(log, walked > 0, rows)
    return lanes, log
