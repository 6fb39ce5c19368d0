"""Joint events of a batch of rollouts in JAX: OR the event bits of the groups' rows, add weights, count every event.

How the loops nest decides the speed. Of rows of few words XLA makes one fused reduction over the groups, several times
as fast as a loop; of long ones it would look up one word at a time (40 us a rollout at 64 robots on 256x256), and it
looks up whole rows in a loop over groups (under 1 us).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from planner.rollouts.open_loop.events import WORD_BITS

MOST_FUSED_WORDS = 16
"""Rows of at most so many words are united in one fused reduction."""
ROWS_A_STEP = 8
"""Rows that one step of the loop over groups adds to the union: it is read and written once for all of them."""


def unite(bits: jax.Array, rows: jax.Array) -> jax.Array:
    """All joint events of each rollout, uint32 `[B, W]`, from its rows, int32 `[G, B]`; bits: uint32 `[R, W]`."""
    groups, batch = rows.shape
    if bits.shape[1] <= MOST_FUSED_WORDS:
        return jax.vmap(lambda mine: jax.lax.reduce_or(_rows_at(bits, mine), axes=(0,)), in_axes=1)(rows)
    a_step = next(size for size in range(min(ROWS_A_STEP, groups), 0, -1) if groups % size == 0)

    def add(union: jax.Array, several: jax.Array) -> tuple[jax.Array, None]:
        for row in several:
            union = union | _rows_at(bits, row)
        return union, None

    nothing = jnp.zeros((batch, bits.shape[1]), dtype=jnp.uint32)
    return jax.lax.scan(add, nothing, rows.reshape(groups // a_step, a_step, batch))[0]


def _rows_at(bits: jax.Array, rows: jax.Array) -> jax.Array:
    return bits.at[rows].get(mode="promise_in_bounds")


def weigh(planes: jax.Array, union: jax.Array) -> jax.Array:
    """Sum of the weights of each rollout's joint events, uint32 `[B]`; planes `[planes, W']`, union `[B, W]`."""
    lead, total = union[:, : planes.shape[1]], jnp.zeros(len(union), dtype=jnp.uint32)
    for place, plane in enumerate(planes):
        total += jax.lax.population_count(lead & plane).sum(axis=1, dtype=jnp.uint32) << jnp.uint32(place)
    return total


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
