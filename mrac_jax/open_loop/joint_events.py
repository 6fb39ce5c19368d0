"""Joint events of a batch of rollouts in JAX: OR the event bits of the groups' rows, add weights, count every event.

Batched by hand, because how the loops nest decides the speed: XLA looks up one word at a time in a fused reduction over
many groups (40 us a rollout at 64 robots on 256x256), and whole rows in a loop over groups (under 1 us).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from mrac_jax.open_loop.padding import PaddedTables
from planner.rollouts.open_loop.events import WORD_BITS

MOST_FUSED_WORDS = 16
"""Rows of at most so many words are united in one fused reduction."""
MOST_UNROLLED_WORDS = 8
"""Words whose weights are added in one expression: faster than a reduction, as long as they are few."""
ROWS_A_STEP = 8
"""Rows that one step of the loop over groups adds to the union: it is read and written once for all of them."""


def unite(tables: PaddedTables, rows: jax.Array) -> tuple[jax.Array, ...]:
    """All joint events of each rollout, uint32 `[B, words]` a part of the words, from its rows, int32 `[G, B]`."""
    if not tables.bits:
        return ()
    head, *tail = tables.bits
    if head.shape[1] <= MOST_FUSED_WORDS:
        return (jax.vmap(partial(_unite_one, head), in_axes=1)(rows),)
    return (_unite_groups(head, rows), *(_unite_late_rows(tables, part, rows) for part in tail))


def _unite_one(bits: jax.Array, rows: jax.Array) -> jax.Array:
    """One rollout's events, uint32 `[W]`, from its rows, int32 `[G]`."""
    return jax.lax.reduce(_rows_at(bits, rows), jnp.uint32(0), jax.lax.bitwise_or, (0,))


def _unite_groups(bits: jax.Array, rows: jax.Array) -> jax.Array:
    """The same, uint32 `[B, W]`, group by group."""
    groups, batch = rows.shape
    a_step = rows_a_step(groups)

    def add(union: jax.Array, several: jax.Array) -> tuple[jax.Array, None]:
        for row in several:
            union = union | _rows_at(bits, row)
        return union, None

    nothing = jnp.zeros((batch, bits.shape[1]), dtype=jnp.uint32)
    return jax.lax.scan(add, nothing, rows.reshape(groups // a_step, a_step, batch))[0]


def _unite_late_rows(tables: PaddedTables, tail: jax.Array, rows: jax.Array) -> jax.Array:
    """The tail's words, uint32 `[B, tail words]`: only rows from `tail_row` on have bits there, a few a rollout.

    Rows grow from group to group, so each step takes every rollout's next such row, until no rollout has another.
    """
    late = rows >= tables.tail_row[:, None]
    nothing = jnp.zeros((rows.shape[1], tail.shape[1]), dtype=jnp.uint32)

    def next_rows(done: jax.Array) -> jax.Array:
        return jnp.where(late & (rows > done), rows, tables.drop_row).min(axis=0)

    def more(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        return (state[0] < tables.drop_row).any()

    def add(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        now, union = state
        return next_rows(now), union | _rows_at(tail, now)

    return jax.lax.while_loop(more, add, (next_rows(jnp.full(rows.shape[1], -1, dtype=jnp.int32)), nothing))[1]


def rows_a_step(groups: int) -> int:
    """Groups that one step of a loop over them takes: the most that divide their number."""
    return next(size for size in range(min(ROWS_A_STEP, groups), 0, -1) if groups % size == 0)


def weigh(planes: jax.Array, union: jax.Array) -> jax.Array:
    """Sum of the weights of one rollout's joint events, uint32 scalar; planes `[planes, words]`, union `[words]`."""
    weights = sum(
        (jax.lax.population_count(union & plane) << jnp.uint32(place) for place, plane in enumerate(planes)),
        start=jnp.uint32(0),
    )
    if planes.shape[1] > MOST_UNROLLED_WORDS:
        return weights.sum(dtype=jnp.uint32)
    return sum((weights[word] for word in range(planes.shape[1])), start=jnp.uint32(0))


def count_events(union: jax.Array) -> jax.Array:
    """Rollouts in which each event happened, int32 `[W * 32]`, from uint32 `[B, W]`, B a multiple of 128.

    Sums in growing fields: four bits an event over 8 rollouts, eight bits over 128, then 32 bits.
    """
    batch, words = union.shape
    eight = union.reshape(8, batch // 8, words)
    nibbles = [
        ((eight >> jnp.uint32(place)) & jnp.uint32(0x11111111)).sum(axis=0, dtype=jnp.uint32) for place in range(4)
    ]
    pairs = jnp.stack(nibbles).reshape(4, 16, batch // 128, words)
    low = (pairs & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    high = ((pairs >> jnp.uint32(4)) & jnp.uint32(0x0F0F0F0F)).sum(axis=1, dtype=jnp.uint32)
    octets = jnp.stack([low, high])  # [2, 4, B / 128, W]: bit 8 * octet + 4 * half + place
    counts = jnp.stack(
        [((octets >> jnp.uint32(8 * octet)) & jnp.uint32(0xFF)).sum(axis=2, dtype=jnp.uint32) for octet in range(4)]
    )
    return counts.transpose(3, 0, 1, 2).reshape(words * WORD_BITS).astype(jnp.int32)


def _rows_at(table: jax.Array, rows: jax.Array) -> jax.Array:
    return table.at[rows].get(mode="promise_in_bounds")
