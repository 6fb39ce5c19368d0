"""Hazards and failure thresholds (`planner.failure_model`) as pairs of 32-bit words, high word first, on the last axis.

JAX has no 64-bit integers unless they are enabled for the whole process.
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


def uint64_pairs(units: NDArray[np.int64]) -> NDArray[np.uint32]:
    """uint32 `[.., 2]` of non-negative integers `[..]`."""
    return np.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(np.uint32)


@jax.jit
def is_reached(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """Whether the hazard reaches the remaining threshold, bool `[..]` of `[.., 2]`."""
    more, as_much = exposure[..., 0] > left[..., 0], exposure[..., 0] == left[..., 0]
    return more | (as_much & (exposure[..., 1] >= left[..., 1]))


@jax.jit
def less(left: jax.Array, exposure: jax.Array) -> jax.Array:
    """The remaining threshold after a hazard that does not reach it, `[.., 2]`."""
    borrow = (left[..., 1] < exposure[..., 1]).astype(jnp.uint32)
    return jnp.stack([left[..., 0] - exposure[..., 0] - borrow, left[..., 1] - exposure[..., 1]], axis=-1)


@jax.jit
def threshold_pairs(word: jax.Array) -> jax.Array:
    """Failure thresholds of robots, uint32 `[.., 2]`, from random words, uint32 `[..]`:
    `planner.simulator.thresholds.threshold_of`."""
    with jax.enable_x64(True):  # only for this trace
        odd = 2 * word.astype(jnp.int64) + 1
        units = log_units(odd, 63 - jax.lax.clz(odd), jnp.asarray(LOGARITHMS))
        return jnp.stack([units >> WORD, units & (2**WORD - 1)], axis=-1).astype(jnp.uint32)


# Threefry-2x32 with 20 rounds in jnp: the words of `planner.failure_model`, unrolled so that XLA can fuse them.
#
# `jax.random` is not used: flags change its streams, and its Threefry never fuses on a CPU (a tenth of the speed).


@jax.jit
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


# Arrays of the JAX engines: NumPy arrays on the host, JAX arrays inside traced functions.

Array: TypeAlias = jax.Array
STATIC = {"static": True}
"""Metadata of static fields, for which programs are compiled; all others are data."""
AnyTables = TypeVar("AnyTables")


def on_host(kind: Callable[..., AnyTables], **fields: Any) -> AnyTables:
    """Tables of NumPy arrays in place of JAX arrays, until all are put on a device at once."""
    return kind(**fields)


# Uncertain maps (`planner.world.uncertain_maps`) for both loops in JAX, with 32-bit integers.
#
# Robots have one failure threshold each. The true map is sampled by rollout and cell, when a robot enters the cell:
# this needs no memory, and few cells are entered.

LEAST_TABLE = 2**11
DIGIT, DIGITS = 8, 3
"""Splits the 24 bits of a word into digits; products with up to MOST_MAPS then fit into 32 bits."""
MOST_MAPS = UNIT


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Uncertainty:
    """`planner.world.uncertain_maps.Draws`, padded: one program for hazards and maps of all kinds. Axis `N`, places.

    Attributes:
        key: uint32 `[2]`, of the random words. counter, there: uint32 `[N]`; column: int32 `[N]`.
        doses: uint32 `[2**n, 2]`, hazard of a visit by row and column, row-major; 0 for latent hazards.
        rows, columns: uint32 and int32 scalars.
        spends: bool scalar, the first loss removes the hazard of a place.
    """

    key: Array
    counter: Array
    there: Array
    column: Array
    doses: Array
    rows: Array
    columns: Array
    spends: Array


def make_map_uncertainty(drawn: Tables | JointDraws, key: tuple[int, int], spends: bool, size: int) -> Uncertainty:
    """The uncertain map of either loop (NumPy), padded to `size` places.

    Raises WorldError for more maps than a 24-bit word distinguishes.
    """
    rows, columns = drawn.doses.shape
    if rows > MOST_MAPS:
        raise WorldError(
            f"{rows} maps", expected=f"at most {MOST_MAPS} in JAX", fix=f"use {argument('engine', 'numba')}"
        )
    doses = np.zeros((max(LEAST_TABLE, 1 << max(rows * columns - 1, 0).bit_length()), WORDS), dtype=np.uint32)
    doses[: rows * columns] = uint64_pairs(drawn.doses.ravel())
    counter, there, column = (
        np.pad(each, (0, size - len(each))) for each in (drawn.own_counter, drawn.there, drawn.column)
    )
    return on_host(
        Uncertainty, key=np.array(key, dtype=np.uint32), counter=counter, there=there, column=column, doses=doses,
        rows=np.uint32(rows), columns=np.int32(columns), spends=np.bool_(spends),
    )  # fmt: skip


def uncertain_hazard(uncertainty: Uncertainty, rollout: jax.Array, place: jax.Array, most: Array) -> jax.Array:
    """Hazard of visits, uint32 `[.., 2]`, at these places in these rollouts; `most`: of an existing latent hazard."""
    word = threefry2x32(uncertainty.key, rollout, _at(uncertainty.counter, place))[0] >> jnp.uint32(8)
    row = jnp.zeros_like(word)
    for digit in range(DIGITS):  # word * rows >> 24, digit by digit: the product has up to 48 bits
        value = (word >> jnp.uint32(DIGIT * digit)) & jnp.uint32(2**DIGIT - 1)
        row = (value * uncertainty.rows + row) >> jnp.uint32(DIGIT)
    listed = _at(uncertainty.doses, row.astype(jnp.int32) * uncertainty.columns + _at(uncertainty.column, place))
    return jnp.where((word < _at(uncertainty.there, place))[..., None], most, listed)


def _at(table: Array, places: jax.Array) -> jax.Array:
    return jnp.asarray(table).at[places].get(mode="promise_in_bounds")
