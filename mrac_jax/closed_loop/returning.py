"""Robots that return to base (SPEC section 19): when they turn back, what they can afford, and the end of a mission."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from mrac_jax.arrays import less
from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import COUNT, FIRST, NEVER
from mrac_jax.closed_loop.lanes import Book, Lanes, Log, at, entered, hold
from planner.simulator.codes import Outcome


def moves_home(book: Book, robot: jax.Array, cell: jax.Array) -> jax.Array:
    """Moves of robots' ways to a base from cells, of the same shape; below 0: there is none."""
    assert book.homes is not None
    place = at(book.homes.of, robot) * book.homes.steps.shape[1] + cell
    return at(book.homes.steps.reshape(-1), place)


def turning(
    book: Book, robot: jax.Array, entry: jax.Array, since: jax.Array, until: jax.Array, moves: jax.Array,
    fate: jax.Array, waits: bool = False,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """(moves, fate) of walks `[S]` of robots with an area, which return to base as soon as they could not later on.

    `waits`: one of no moves takes a turn.
    """
    if book.homes is None:
        return moves, fate
    homes, sets = book.homes, book.need.shape[1]
    within = jnp.minimum(until, homes.last) - since
    row, length = at(book.entries, entry)[:, :2].T
    table, column = book.need.reshape(-1), at(homes.of, robot)

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        goes = (low < high) & (at(table, (row + middle) * sets + column) <= within)
        return hold((jnp.where(goes, middle + 1, low), jnp.where(goes, high, middle)))

    first = jax.lax.fori_loop(0, homes.turnings, halve, (jnp.ones_like(length), length + 1))[0]
    turns = (first <= length) & (first <= moves)
    moves = jnp.where(turns, first - 1, moves)
    if waits:
        turns = turns | ((length == 0) & (at(table, row * sets + column) > within))
    return hold((moves, jnp.where(turns, ln.TURNS, fate)))


def affords(book: Book, place: jax.Array, robot: jax.Array, left: jax.Array) -> jax.Array:
    """Whether robots `[B]` with so many moves left could return to base from pieces at these places `[B, n]`."""
    steps, goal = at(book.steps.reshape(-1), place), at(book.target.reshape(-1), place)
    way = moves_home(book, jnp.broadcast_to(robot[:, None], place.shape), goal)
    return (way < 0) | (steps + way <= left[:, None])


def all_return(book, lanes, log, runs, key):  # type: ignore[no-untyped-def]
    """Lanes whose mission is over before the next event: at the end of that step all robots return to base.

    Each leaves its walk where it is; at the end of the step it sets out. Returns lanes, log, and which lanes these are.
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
    # What has been visited by the last event was not complete before it.
    complete = (step > lanes.last) & covered(step - 1)
    over = may & (complete | asleep)

    def halve(_: int, span: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = span
        middle = (low + high) >> 1
        full = covered(middle)
        return hold((jnp.where(full, low, middle + 1), jnp.where(full, middle, high)))

    def turn() -> tuple[Lanes, Log | None]:
        first = jax.lax.fori_loop(0, ln.HALVINGS, halve, (jnp.minimum(lanes.last, step - 1), step - 1))[1]
        time = jnp.where(complete, first, stuck)
        offset = jnp.clip(time[:, None] - robots[:, :, ln.SINCE], 0, robots[:, :, ln.LAST])
        doing = robots[:, :, ln.DOING]
        cut = over[:, None] & ((doing < ln.RETURN) | (doing == ln.IDLE))
        flat = robots.reshape(-1, ln.FIELDS)
        entry = at(book.entries, flat[:, ln.WALK])
        visits = ln.visits_before(book, entry[:, FIRST], entry[:, COUNT], offset.reshape(-1), None, book.halvings)
        left = less(lanes.left.reshape(-1, 2), ln.hazard_of(book, flat[:, ln.WALK], visits)).reshape(lanes.left.shape)
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

    lanes, log = ln.if_any_else(over, turn, (lanes, log))
    return lanes, log, over
