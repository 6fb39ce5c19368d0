"""Sets of cells as bits: flood fill by shifts, for many lanes at once.

A board is uint32 `[P / 32, S]`, place p of lane s being bit p % 32 of word p // 32: the lanes come last, so that every
operation runs along them. Places are numbered row by row with a wall after each row (`mrac_jax.closed_loop.tables`), so
the neighbours of a place are one, or one `stride`, away. Axis letters: `P` places, `A` cells, `S` lanes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

WORD, SHIFT = 32, 5
GROWTH = 2
"""Moves that a flood makes before it looks whether it is over."""


def word_and_bit(place: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The word of each place, int32, and its bit there, uint32. Shifts: `//` and `%` of signed numbers are 20 steps."""
    return place >> SHIFT, jnp.uint32(1) << (place & jnp.int32(WORD - 1)).astype(jnp.uint32)


def pack(cells: jax.Array, cell_at: jax.Array) -> jax.Array:
    """The board of bool `[S, A]`, with the cell at each place, int32 `[P]`."""
    at_place = cells[:, cell_at].reshape(cells.shape[0], -1, WORD)
    bits = jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32)
    return jnp.where(at_place, bits, jnp.uint32(0)).sum(axis=2, dtype=jnp.uint32).T


def unpack(board: jax.Array, spot: jax.Array) -> jax.Array:
    """bool `[S, A]` of a board, with each cell's place, int32 `[A]`."""
    word, bit = word_and_bit(spot)
    return ((board[word] & bit[:, None]) != 0).T


def size(board: jax.Array) -> jax.Array:
    """Cells in it, int32 `[S]`."""
    return jax.lax.population_count(board).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)


def some(board: jax.Array) -> jax.Array:
    """Whether there is any cell in it, bool `[S]`."""
    return (board != 0).any(axis=0)


def lowest(board: jax.Array) -> jax.Array:
    """The lowest place, int32 `[S]`; P where there is none."""
    places = jnp.arange(board.shape[0], dtype=jnp.int32)[:, None] * WORD
    lone = board & (~board + jnp.uint32(1))
    bit = jnp.int32(WORD - 1) - jax.lax.clz(lone).astype(jnp.int32)
    return jnp.where(board != 0, places + bit, board.shape[0] * WORD).min(axis=0)


def lowest_cell(board: jax.Array, cell_at: jax.Array) -> jax.Array:
    """The lowest cell, int32 `[S]`, with the cell at each place, int32 `[P]`; the one at the last place if none."""
    return cell_at[jnp.minimum(lowest(board), cell_at.shape[0] - 1)]


def single(cell: jax.Array, words: int) -> jax.Array:
    """The board of one cell each, int32 `[S]`; empty for cells past the end."""
    word, bit = word_and_bit(cell)
    return jnp.where(jnp.arange(words, dtype=jnp.int32)[:, None] == word, bit, jnp.uint32(0))


def up(board: jax.Array, cells: jax.Array) -> jax.Array:
    """Every cell moved to a higher index by so many cells, int32 scalar in [0, A)."""
    words, bits = cells >> SHIFT, (cells & (WORD - 1)).astype(jnp.uint32)
    count = board.shape[0]
    # Whole words by a slice, the rest by shifts; shifts by 32 are undefined, hence in two parts.
    padded = jnp.concatenate([jnp.zeros_like(board), board])
    near = jax.lax.dynamic_slice_in_dim(padded, count - words, count)
    far = jax.lax.dynamic_slice_in_dim(padded, count - words - 1, count)
    return (near << bits) | ((far >> (jnp.uint32(WORD - 1) - bits)) >> jnp.uint32(1))


def down(board: jax.Array, cells: jax.Array) -> jax.Array:
    """Every cell moved to a lower index by so many cells, int32 scalar in [0, A)."""
    words, bits = cells >> SHIFT, (cells & (WORD - 1)).astype(jnp.uint32)
    count = board.shape[0]
    padded = jnp.concatenate([board, jnp.zeros_like(board)])
    near = jax.lax.dynamic_slice_in_dim(padded, words, count)
    far = jax.lax.dynamic_slice_in_dim(padded, words + 1, count)
    return (near >> bits) | ((far << (jnp.uint32(WORD - 1) - bits)) << jnp.uint32(1))


def grow(board: jax.Array, inside: jax.Array, stride: jax.Array) -> jax.Array:
    """The board with the neighbours, inside the other one, of all its cells."""
    one = jnp.int32(1)
    return (board | up(board, one) | down(board, one) | up(board, stride) | down(board, stride)) & inside


def flood(inside: jax.Array, seed: jax.Array, stride: jax.Array) -> jax.Array:
    """The cells inside that can be reached from the seed's without leaving it."""

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        board = state[0]
        # Growing twice before asking halves the reductions; growing too often changes nothing.
        after = board
        for _ in range(GROWTH):
            after = grow(after, inside, stride)
        return after, (after != board).any()

    start = seed & inside
    return jax.lax.while_loop(lambda state: state[1], step, (start, (start != 0).any()))[0]


def first_component(inside: jax.Array, stride: jax.Array) -> jax.Array:
    """The 4-connected component that holds the lowest cell."""
    return flood(inside, single(lowest(inside), inside.shape[0]), stride)


def keep_lowest(board: jax.Array, count: jax.Array) -> jax.Array:
    """The board's lowest cells, so many of them, int32 `[S]`; all if there are fewer."""
    sizes = jax.lax.population_count(board).astype(jnp.int32)
    wanted = jnp.clip(count - (jnp.cumsum(sizes, axis=0) - sizes), 0, sizes)
    taken = jnp.zeros_like(sizes)  # bits looked at: the most whose cells are not more than wanted
    for half in (16, 8, 4, 2, 1):
        below = board & ((jnp.uint32(1) << (taken + half).astype(jnp.uint32)) - jnp.uint32(1))
        fits = jax.lax.population_count(below).astype(jnp.int32) <= wanted
        taken = jnp.where(fits, taken + half, taken)
    below = board & ((jnp.uint32(1) << taken.astype(jnp.uint32)) - jnp.uint32(1))
    return jnp.where(sizes <= wanted, board, below)


def bisect(inside: jax.Array, stride: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two connected halves of a component, the one with its lowest cell first (SPEC section 5, `Bisection`).

    A wavefront grows from a far end, whole layers and the last one in index order, until half of the cells (rounded
    up) are in; of the rest the largest component stays (of equal ones, that with the lowest cell), the others join.
    """
    words = inside.shape[0]
    source = single(lowest(inside), words)

    def spread(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        reached, last, _ = state
        wider = grow(reached, inside, stride)
        layer = wider & ~reached
        return wider, jnp.where(some(layer), layer, last), (layer != 0).any()

    last = jax.lax.while_loop(lambda state: state[2], spread, (source, source, (source != 0).any()))[1]
    half = (size(inside) + 1) // 2

    def fill(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        board = state[0]
        layer = grow(board, inside, stride) & ~board
        after = board | keep_lowest(layer, half - size(board))
        return after, (after != board).any()

    start = single(lowest(last), words) & inside
    grown = jax.lax.while_loop(lambda state: state[1], fill, (start, (start != 0).any()))[0]

    def weigh(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        rest, stays, most = state
        part = first_component(rest, stride)
        # Components come in order of their lowest cell, so `>` leaves ties with the lowest.
        larger = size(part) > most
        return rest & ~part, jnp.where(larger, part, stays), jnp.where(larger, size(part), most)

    rest = inside & ~grown
    nothing = (rest, jnp.zeros_like(rest), jnp.zeros_like(half))
    stays = jax.lax.while_loop(lambda state: (state[0] != 0).any(), weigh, nothing)[1]
    others = inside & ~stays
    swap = lowest(others) < lowest(stays)
    return jnp.where(swap, others, stays), jnp.where(swap, stays, others)
