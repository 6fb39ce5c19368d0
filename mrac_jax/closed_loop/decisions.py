"""Parts of an event: the return to base, and `Find Area To Share`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import HALVE, NEVER, PARTS, PIECE
from mrac_jax.closed_loop.lanes import Book, Lanes, Log, at, entered, hold, look_up, one_cell, pick, walk
from planner.simulator.codes import Outcome

# Robots that return to base (SPEC section 19): the turning point, reachable pieces, and the end of a mission.


def moves_home(book: Book, robot: jax.Array, cell: jax.Array) -> jax.Array:
    """Moves of the robots' paths to a base from cells, of the same shape; below 0: no path."""
    assert book.homes is not None
    place = at(book.homes.of, robot) * book.homes.steps.shape[1] + cell
    return at(book.homes.steps.reshape(-1), place)


def turning(
    book: Book, robot: jax.Array, entry: jax.Array, since: jax.Array, until: jax.Array, moves: jax.Array,
    fate: jax.Array, waits: bool = False,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """(moves, fate) of walks `[S]` of robots with an area, which return to base before it gets out of range.

    `waits`: one of no moves takes a turn.
    """
    if book.homes is None:
        return moves, fate
    homes, sets = book.homes, book.need.shape[1]
    within = jnp.minimum(until, homes.last) - since
    row, length = at(book.entries, entry)[:, :2].T
    table, column = book.need.reshape(-1), at(homes.of, robot)

    def is_late(move: jax.Array) -> jax.Array:
        return at(table, (row + move) * sets + column) > within

    first = ln.first_that(is_late, jnp.ones_like(length), length + 1, homes.turnings)
    turns = (first <= length) & (first <= moves)
    moves = jnp.where(turns, first - 1, moves)
    if waits:
        turns = turns | ((length == 0) & is_late(jnp.zeros_like(length)))
    return hold((moves, jnp.where(turns, ln.TURNS, fate)))


def is_within_range(book: Book, place: jax.Array, robot: jax.Array, left: jax.Array) -> jax.Array:
    """True for robots `[B]` that could return to base from the pieces `[B, n]` with the moves left."""
    steps, goal = at(book.steps.reshape(-1), place), at(book.target.reshape(-1), place)
    way = moves_home(book, jnp.broadcast_to(robot[:, None], place.shape), goal)
    return (way < 0) | (steps + way <= left[:, None])


def all_return(book, lanes, log, runs, key):  # type: ignore[no-untyped-def]
    """Lanes whose mission is over before the next event: at the end of that step all robots return to base.

    Each leaves its walk at its present cell, and departs at the end of the step. Returns lanes, log, and a mask of
    these lanes.
    """
    robots, stride = lanes.robots, ln.stride_of(book, lanes)
    step, K = jnp.minimum(key // stride, book.max_steps + 1), lanes.key.shape[1]
    moving = (robots[:, :, ln.DOING] <= ln.CHARGE).any(axis=1)

    def covered(time: jax.Array) -> jax.Array:
        offset = jnp.clip(time[:, None] - robots[:, :, ln.SINCE], 0, robots[:, :, ln.LAST])
        return (lanes.visited | entered(book, robots[:, :, ln.ROW] + offset) == book.every).all(axis=1)

    stuck = lanes.last + book.quiet
    asleep = ~moving & (step + (key % stride >= K) > stuck) & (stuck <= book.max_steps)
    may = runs & (lanes.over == 0)
    # The cells visited by the last event were not complete before it.
    complete = (step > lanes.last) & covered(step - 1)
    over = may & (complete | asleep)

    def turn() -> tuple[Lanes, Log | None]:
        first = ln.first_that(covered, jnp.minimum(lanes.last, step - 1), step - 1, ln.HALVINGS)
        time = jnp.where(complete, first, stuck)
        offset = jnp.clip(time[:, None] - robots[:, :, ln.SINCE], 0, robots[:, :, ln.LAST])
        doing = robots[:, :, ln.DOING]
        cut = over[:, None] & ((doing < ln.RETURN) | (doing == ln.IDLE))
        walks, left = robots[:, :, ln.WALK].reshape(-1), lanes.left.reshape(-1, 2)
        left = ln.left_after(book, walks, left, offset.reshape(-1)).reshape(lanes.left.shape)
        rows = jnp.where(cut, robots[:, :, ln.ROW] + offset, 0)
        come = jnp.bitwise_or.reduce(at(book.prefix, rows), axis=1)
        cell = jnp.where(
            robots[:, :, ln.WALK] > 0, at(book.cell_at, robots[:, :, ln.ROW] + offset), robots[:, :, ln.HERE]
        )
        who = jnp.broadcast_to(jnp.arange(K, dtype=jnp.int32), doing.shape)
        until = robots[:, :, ln.UNTIL] - jnp.where(doing == ln.IDLE, 0, time[:, None])
        after = ln.robot_fields(doing, doing=ln.IDLE, here=cell, area=-1, ident=0, since=time[:, None], until=until)
        charging = over[:, None] & (doing == ln.CHARGE)
        kept = robots.at[:, :, ln.DOING].set(jnp.where(charging, ln.OUT, doing))
        keys = jnp.where(cut, time[:, None] * stride + K + who, jnp.where(charging, NEVER, lanes.key))
        changed = replace(
            lanes,
            visited=lanes.visited | come,
            survived=lanes.survived | come,
            robots=jnp.where(cut[:, :, None], after, kept),
            left=jnp.where(cut[:, :, None], left, lanes.left),
            key=keys,
            over=jnp.where(over, jnp.where(complete, int(Outcome.COMPLETE), int(Outcome.NO_PROGRESS)) + 1, lanes.over),
            last=jnp.where(over, time, lanes.last),
            fuel=lanes.fuel - over.astype(jnp.int32),
        )
        if log is None:
            return changed, None
        flags = jnp.zeros(doing.shape, jnp.uint32)
        written = ln.log_row(lanes.number[:, None], who, robots, offset, flags).reshape(-1, 4)
        return changed, ln.write(log, (cut & (offset > 0)).reshape(-1), written)

    lanes, log = ln.if_any(over, turn, (lanes, log))
    return lanes, log, over


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
    way, budget = jnp.maximum(share.walks[:, 0], 0), me[:, ln.UNTIL] - since
    base, moves, fate, end = walk(book, way, left, budget)
    # An owner already at its target begins to cover at its next turn, which may be the last of its range.
    fate = jnp.where((moves == 0) & (budget <= 1), ln.ENDS, fate)
    moves, fate = turning(book, owner, way, since, me[:, ln.UNTIL], moves, fate, True)
    part, ident = first + share.parts[:, 0], made + share.parts[:, 0]
    after = ln.robot_fields(
        step, doing=ln.TRAVEL, here=end, area=part, ident=ident, since=since, until=me[:, ln.UNTIL], fate=fate,
        walk=way, row=base, last=moves,
    )  # fmt: skip
    given = jnp.array([name in (ln.AREA, ln.IDENT) for name in range(ln.FIELDS)])
    after = jnp.where(waits[:, None] & ~given, me, after)
    here = share.found[:, None] & (jnp.arange(K, dtype=jnp.int32) == owner[:, None])
    goes = here & ~waits[:, None]
    come = jnp.where((share.found & ~waits)[:, None], at(book.prefix, me[:, ln.ROW] + by), jnp.uint32(0))
    lanes = replace(
        lanes,
        visited=lanes.visited | come,
        survived=lanes.survived | come,
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
        log = ln.write(log, share.found & ~waits & (by > 0), rows)
    return lanes, log
