"""Areas as a rule sees them, and the first of them: fractions compared exactly, in numbers of 32 bits.

Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mrac_jax.arrays import Array
from mrac_jax.closed_loop.homeward import affords, further, moves_left, targets
from mrac_jax.closed_loop.search import FAR, Chosen, entry, first_cell
from mrac_jax.closed_loop.state import Lanes, low_half
from mrac_jax.closed_loop.tables import OPEN, PENDING, UNREACHABLE, LaneTables
from planner.policies.limits import is_dangerous, is_refused
from planner.policies.offer import Offer

BITS, ONES = 16, 2**16 - 1
"""Trailing bits of a product that are a word of their own, and their largest value."""


class Candidate(NamedTuple):
    """Areas, by the fractions that the rule orders them by; arrays of one shape.

    Attributes:
        number: id, FAR for none. label: as in `mrac_jax.closed_loop.tables`. first, second: fractions.
    """

    number: Array
    label: Array
    first: tuple[Array, Array]
    second: tuple[Array, Array]


class First(NamedTuple):
    """The first area of each lane, `[S]`.

    Attributes:
        candidate: it, number FAR for none. found: there is one. cell: its target. dangerous: it is, or the way there.
    """

    candidate: Candidate
    found: jax.Array
    cell: jax.Array
    dangerous: jax.Array


def open_cells(words: jax.Array) -> jax.Array:
    """The unvisited cells of unassigned areas, bool `[S, A]` of cells' words."""
    return (words & (OPEN | PENDING)) == (OPEN | PENDING)


def first_area(
    tables: LaneTables,
    lanes: Lanes,
    chosen: Chosen,
    here: jax.Array,
    offered: jax.Array,
    refusing: jax.Array | bool = True,
    robot: jax.Array | None = None,
    limited: jax.Array | bool = True,
) -> First:
    """Of the areas of the unvisited cells offered, bool `[S, A]`, the first that a robot in `here` `[S]` can reach.

    refusing: bool `[S]`, areas that cost more than a robot is worth are not among them. robot: int32 `[S]`; None: those
    whose turn it is. limited: bool `[S]`, nor are areas that they cannot afford.
    """
    policy, batch = tables.policy, lanes.mode.shape[0]
    assert policy is not None
    label, at = low_half(chosen.words), jnp.minimum(chosen.lane, batch - 1)
    cost = jnp.where(offered, tables.cost[here], UNREACHABLE)
    # Everything about an area is gathered at its label, so areas need no table of their own.
    rows = jnp.broadcast_to(jnp.arange(len(label), dtype=jnp.int32)[:, None], label.shape)
    least = jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")  # at each label
    left = jnp.maximum(low_half(lanes.areas.reshape(batch, -1)[at]), 1)
    value = left
    if policy.value is not None:
        worth = jnp.where(offered, policy.value, 0)
        value = jnp.zeros_like(cost).at[rows, label].add(worth, mode="promise_in_bounds")
    offer = Offer(
        level=jnp.broadcast_to(tables.level, cost.shape),
        cost=least,
        unvisited=left,
        entry=jnp.broadcast_to(policy.entry, cost.shape),
        value=value,
        beyond=policy.beyond,
    )
    asked, can = offer, least < UNREACHABLE
    if tables.homes is not None:
        who, target = (chosen.robot if robot is None else robot)[:, None], targets(cost, label)
        left = moves_left(tables, lanes, chosen.lane, who[:, 0])[:, None]
        can = can & (affords(tables, here[:, None], who, target, left) | ~jnp.asarray(limited)[..., None])
        asked = offer._replace(cost=least + further(tables, here[:, None], who, target))
    refused = jax.lax.cond(
        policy.refuses,
        lambda: is_refused(asked, policy.cells, policy.theta, policy.scale),
        lambda: jnp.zeros_like(offered),
    )
    number = jnp.where(can & ~(refused & jnp.asarray(refusing)[..., None]), lanes.ids.reshape(batch, -1)[at], FAR)
    best = _first_of(tables, offer, number)
    cell = first_cell((label == best.label[:, None]) & (cost == entry(least, best.label)[:, None]))
    return First(best, best.number != FAR, cell, entry(is_dangerous(offer, policy.cells), best.label))


def _first_of(tables: LaneTables, offer: Offer, number: jax.Array) -> Candidate:
    """The first offer of each row by the rule, then by number, `[S]` of `[S, A]`; number: FAR where nothing is."""

    def wide(value: jax.Array | int) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=jnp.int32), number.shape)

    assert tables.policy is not None
    (first, second), label = tables.policy.order(offer), jnp.arange(number.shape[1], dtype=jnp.int32)
    # One reduction over all labels: an order of fractions is associative, and ids make it total.
    each = Candidate(number, wide(label), (wide(first[0]), wide(first[1])), (wide(second[0]), wide(second[1])))
    nought, one = jnp.int32(0), jnp.int32(1)
    nothing = Candidate(jnp.int32(FAR), nought, (nought, one), (nought, one))

    def earlier(mine: Candidate, theirs: Candidate) -> Candidate:
        ahead = is_before(tables, mine, theirs, mine.number < theirs.number)
        ahead = (theirs.number == FAR) | ((mine.number != FAR) & ahead)
        return jax.tree.map(lambda left, right: jnp.where(ahead, left, right), mine, theirs)

    best: Candidate = jax.lax.reduce(each, nothing, earlier, (1,))
    return best


def is_before(tables: LaneTables, one: Candidate, other: Candidate, tied: jax.Array | bool = False) -> jax.Array:
    """Whether the rule puts one area before the other; `tied`: where it sees no difference."""
    before, product = jnp.asarray(tied), _product
    if tables.policy is not None and tables.policy.value is not None:
        product = _wide_product
    for mine, theirs in ((one.second, other.second), (one.first, other.first)):
        left, right = product(mine[0], theirs[1]), product(theirs[0], mine[1])
        less = (left[0] < right[0]) | ((left[0] == right[0]) & (left[1] < right[1]))
        before = less | ((left[0] == right[0]) & (left[1] == right[1]) & before)
    return before


def _product(numerator: jax.Array, denominator: jax.Array) -> tuple[jax.Array, jax.Array]:
    """An int32 times a positive number below 2**16, exactly: the leading word, and the 16 trailing bits."""
    low = (numerator & ONES).astype(jnp.uint32) * denominator.astype(jnp.uint32)
    return (numerator >> BITS) * denominator + (low >> BITS).astype(jnp.int32), low & ONES


def _wide_product(numerator: jax.Array, denominator: jax.Array) -> tuple[jax.Array, jax.Array]:
    """An int32 times a positive number below 2**31, exactly: the leading word, and the trailing one, uint32."""
    low, high = (numerator & ONES).astype(jnp.uint32), numerator >> BITS
    under, over = denominator & ONES, denominator >> BITS
    least = low * under.astype(jnp.uint32)
    mixed = low * over.astype(jnp.uint32), high * under  # the second one signed, |high| at most 2**15
    middle = (mixed[0] & ONES) + (mixed[1] & ONES).astype(jnp.uint32) + (least >> BITS)
    leading = high * over + (mixed[0] >> BITS).astype(jnp.int32) + (mixed[1] >> BITS)
    return leading + (middle >> BITS).astype(jnp.int32), (middle << BITS) | (least & ONES)
