"""Exposure and tolerance (`planner.failure_model`) in two words of 32 bits, the leading one first, along the last axis.

JAX has no larger whole numbers unless a whole process switches them on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import WorldError
from planner.rollouts.open_loop_events import JointDraws
from planner.simulator.state import Tables
from planner.simulator.thresholds import KEY_PARITY, LOGARITHMS, ROTATIONS, log_units
from planner.world.uncertain_maps import UNIT

WORDS, WORD = 2, 32


def two_words(units: NDArray[np.int64]) -> NDArray[np.uint32]:
    """uint32 `[.., 2]` of numbers that are not negative, `[..]`."""
    return np.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(np.uint32)


def is_reached(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """Whether the exposure is as much as is left or more, bool `[..]` of `[.., 2]`."""
    more, as_much = exposure[..., 0] > left[..., 0], exposure[..., 0] == left[..., 0]
    return more | (as_much & (exposure[..., 1] >= left[..., 1]))


def less(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """What is left after an exposure that does not reach it, `[.., 2]`."""
    borrowed = (left[..., 1] < exposure[..., 1]).astype(jnp.uint32)
    return jnp.stack([left[..., 0] - exposure[..., 0] - borrowed, left[..., 1] - exposure[..., 1]], axis=-1)


def tolerance_words(word: jax.Array) -> jax.Array:
    """What robots bear, uint32 `[.., 2]`, by their random words, uint32 `[..]`:
    `planner.simulator.thresholds.tolerance_of`."""
    with jax.enable_x64(True):  # of what is traced here alone
        odd = 2 * word.astype(jnp.int64) + 1
        units = log_units(odd, 63 - jax.lax.clz(odd), jnp.asarray(LOGARITHMS))
        return jnp.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(jnp.uint32)


# Threefry-2x32 with 20 rounds in jnp: the words of `planner.failure_model`, written out so that XLA fuses them away.
#
# `jax.random` is not used: its streams are flags away from changing, and its Threefry never fuses on a CPU (a tenth of
# the words a second).


def threefry2x32(key: jax.Array, counter0: jax.Array, counter1: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Words (x0, x1) of one counter. All uint32: key `[2]` (low half of the seed first), counters and words scalars."""
    schedule = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(KEY_PARITY))
    x0, x1 = counter0 + schedule[0], counter1 + schedule[1]
    for group in range(5):
        for rotation in ROTATIONS[4 * (group % 2) : 4 * (group % 2) + 4]:
            x0 = x0 + x1
            x1 = (x1 << jnp.uint32(rotation)) | (x1 >> jnp.uint32(32 - rotation))
            x1 = x1 ^ x0
        x0 = x0 + schedule[(group + 1) % 3]
        x1 = x1 + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return x0, x1


def robot_words(key: jax.Array, ids: jax.Array, robots: int) -> jax.Array:
    """The random word of each robot in each rollout, uint32 `[.., K]`: the first of Threefry at (id, robot)."""
    shape = (*ids.shape, robots)
    robot = jnp.broadcast_to(jnp.arange(robots, dtype=jnp.uint32), shape)
    return threefry2x32(key, jnp.broadcast_to(ids[..., None], shape), robot)[0]


# Arrays of the JAX engines: made of NumPy on the host, read as JAX arrays by what is traced.

Array: TypeAlias = jax.Array
STATIC = {"static": True}
"""Of fields of tables that programs are compiled for; all others are data."""
AnyTables = TypeVar("AnyTables")


def on_host(kind: Callable[..., AnyTables], **fields: Any) -> AnyTables:
    """Tables of NumPy arrays, in the place of JAX arrays until all of them are put on a device at once."""
    return kind(**fields)


# What is in doubt about a map (`planner.world.uncertain_maps`), as both loops draw it in JAX, in numbers of 32 bits.
#
# Who is stopped is a matter of what robots bear; what is true of the map is drawn for each rollout and cell, where a
# robot enters it: it takes no room, and few cells are entered.

LEAST_TABLE = 2**11
DIGIT, DIGITS = 8, 3
"""Of the 24 bits of a number; times up to MOST_MAPS each of them fits into 32 bits."""
MOST_MAPS = UNIT


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Doubt:
    """`planner.world.uncertain_maps.Draws`, padded: one program for hazards and maps of all kinds. Axis `N`, places.

    Attributes:
        key: uint32 `[2]`, under which it is drawn. counter, there: uint32 `[N]`; column: int32 `[N]`.
        doses: uint32 `[2**n, 2]`, what a visit adds by row and column, row after row; for hazards nothing but 0.
        rows, columns: uint32 and int32 scalars.
        spends: bool scalar, the first hit makes a place harmless.
    """

    key: Array
    counter: Array
    there: Array
    column: Array
    doses: Array
    rows: Array
    columns: Array
    spends: Array


def make_doubt(drawn: Tables | JointDraws, key: tuple[int, int], spends: bool, size: int) -> Doubt:
    """What is drawn (NumPy) at all places of either loop, with room for `size` of them.

    Raises WorldError for more maps than a number tells apart.
    """
    rows, columns = drawn.doses.shape
    if rows > MOST_MAPS:
        raise WorldError(
            f"{rows} maps", expected=f"at most {MOST_MAPS} in JAX", fix=f"use {argument('engine', 'numba')}"
        )
    doses = np.zeros((max(LEAST_TABLE, 1 << max(rows * columns - 1, 0).bit_length()), WORDS), dtype=np.uint32)
    doses[: rows * columns] = two_words(drawn.doses.ravel())
    counter, there, column = (
        np.pad(each, (0, size - len(each))) for each in (drawn.own_counter, drawn.there, drawn.column)
    )
    return on_host(
        Doubt, key=np.array(key, dtype=np.uint32), counter=counter, there=there, column=column, doses=doses,
        rows=np.uint32(rows), columns=np.int32(columns), spends=np.bool_(spends),
    )  # fmt: skip


def exposure_in_doubt(doubt: Doubt, rollout: jax.Array, place: jax.Array, most: Array) -> jax.Array:
    """What visits add, uint32 `[.., 2]`, as the places are in these rollouts; `most`: where a hazard is there."""
    word = threefry2x32(doubt.key, rollout, _at(doubt.counter, place))[0] >> jnp.uint32(8)
    row = jnp.zeros_like(word)
    for digit in range(DIGITS):  # word * rows >> 24: the product has up to 48 bits
        value = (word >> jnp.uint32(DIGIT * digit)) & jnp.uint32(2**DIGIT - 1)
        row = (value * doubt.rows + row) >> jnp.uint32(DIGIT)
    listed = _at(doubt.doses, row.astype(jnp.int32) * doubt.columns + _at(doubt.column, place))
    return jnp.where((word < _at(doubt.there, place))[..., None], most, listed)


def _at(table: Array, places: jax.Array) -> jax.Array:
    return jnp.asarray(table).at[places].get(mode="promise_in_bounds")
