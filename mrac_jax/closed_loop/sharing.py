"""`Find Area To Share` for lanes: a robot without an area, the helper, takes a part of that of another, its owner."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.arrays import less
from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import COUNT, FIRST, HALVE, NEVER, PARTS, PIECE
from mrac_jax.closed_loop.lanes import Book, Lanes, at, look_up, one_cell, pick, walk
from mrac_jax.closed_loop.returning import affords, turning


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Sharing:
    """What comes of looking for an area to share, `[B]` each: whether there is one, and its owner; the split of its
    unvisited cells and the walks of owner and helper to their parts; each -1: missing, then asked for; parts `[B, 2]`,
    counted from the split's first."""

    found: jax.Array
    owner: jax.Array
    split: jax.Array
    parts: jax.Array
    walks: jax.Array
    asked: jax.Array


def find_to_share(
    book: Book, lanes: Lanes, helper: jax.Array, here: jax.Array, offset: jax.Array, afford: jax.Array
) -> Sharing:
    """`Find Area To Share` for helpers in the cells `here`: of those near enough the least (level, cost, id)."""
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
        fits = fits & affords(book, place, helper, afford)
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
    """The owner of a shared area leaves its walk where it is, and sets out to its part.

    One that has yet to enter its start only has another area.
    """
    K, owner = lanes.key.shape[1], share.owner
    me, by = pick(lanes.robots, owner), pick(offset, owner)
    waits = me[:, ln.DOING] == ln.START
    entry = at(book.entries, me[:, ln.WALK])
    visits = ln.visits_before(book, entry[:, FIRST], entry[:, COUNT], by, None, book.halvings)
    left = less(pick(lanes.left, owner), ln.hazard_of(book, me[:, ln.WALK], visits))
    since = step - (owner > helper)
    way, budget = jnp.maximum(share.walks[:, 0], 0), me[:, ln.UNTIL] - since
    base, moves, fate, end = walk(book, way, left, budget)
    # One that is at its target already begins to cover at its next turn, which may be the last of its range.
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
