"""What robots that come home can afford (SPEC section 19) in the lanes: how far they can go, and how far home is.

The readable statement is `planner.mrac.homecoming`. Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.boards import word_and_bit
from mrac_jax.closed_loop.state import (
    Lanes,
    low_half,
    read,
)
from mrac_jax.closed_loop.tables import UNREACHABLE, LaneTables


def moves_left(tables: LaneTables, lanes: Lanes, lane: jax.Array, robot: jax.Array) -> jax.Array:
    """Moves that the robots of these lanes can still make, from the step on in which they would move first, int32."""
    assert tables.homes is not None and lanes.moves_left is not None
    batch = lanes.mode.shape[0]
    at = jnp.minimum(lane, batch - 1)
    now = 0 if lanes.looked is None else lanes.looked[at]
    own = read(lanes.moves_left, at * (lanes.moves_left.shape[0] // batch) + robot)
    return jnp.minimum(own, tables.homes.last - lanes.step[at] + now)


def affords(tables: LaneTables, here: jax.Array, robot: jax.Array, target: jax.Array, left: jax.Array) -> jax.Array:
    """Whether robots with so many moves left could come home from their targets, once they have gone there."""
    homes = tables.homes
    assert homes is not None
    way = read(homes.steps, homes.of[robot] * homes.size + target)
    return (way < 0) | (read(homes.moves, here * homes.size + target).astype(jnp.int32) + way <= left)


def further(tables: LaneTables, here: jax.Array, robot: jax.Array, target: jax.Array) -> jax.Array:
    """How much dearer the way home is from the targets than from here."""
    homes = tables.homes
    assert homes is not None
    row = homes.of[robot] * homes.size
    return jnp.maximum(read(homes.cost, row + target) - read(homes.cost, row + here), 0)


def targets(cost: jax.Array, label: jax.Array) -> jax.Array:
    """At each label the cell of its area that costs least, the lowest of several; int32 `[S, A]` of the cells'."""
    rows = jnp.broadcast_to(jnp.arange(len(label), dtype=jnp.int32)[:, None], label.shape)
    least = jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")
    first = (cost == jnp.take_along_axis(least, label, axis=1)) & (cost < UNREACHABLE)
    cell = jnp.where(first, jnp.arange(label.shape[1], dtype=jnp.int32), label.shape[1] - 1)
    return jnp.full_like(cost, label.shape[1] - 1).at[rows, label].min(cell, mode="promise_in_bounds")


def in_reach(
    tables: LaneTables, here: jax.Array, robot: jax.Array, words: jax.Array, fits: jax.Array, left: jax.Array
) -> jax.Array:
    """Of the cells that fit those of areas that robots with so many moves left can afford, bool `[S, A]`."""
    label = low_half(words)
    target = targets(jnp.where(fits, tables.cost[here], UNREACHABLE), label)
    can = affords(tables, here[:, None], robot[:, None], target, left[:, None])
    return fits & jnp.take_along_axis(can, label, axis=1)


def flags_of(words: jax.Array, team: int) -> jax.Array:
    """bool `[K, B]` of uint32 `[W, B]`."""
    word, bit = word_and_bit(jnp.arange(team, dtype=jnp.int32))
    return (words[word] & bit[:, None]) != 0


def robots_home(tables: LaneTables, lanes: Lanes, at: jax.Array) -> jax.Array:
    """Robots of the lanes `at` that were not stopped and are at a base, int32 `[S]`."""
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None
    place = low_half(lanes.place.reshape(batch, -1)[at])
    there = read(homes.steps, homes.of * homes.size + place) == 0
    return (there & flags_of(lanes.unharmed[:, at], place.shape[1]).T).sum(axis=1, dtype=jnp.int32)
