"""What is in doubt about a map (`planner.worlds.doubt`), as both loops draw it in JAX, in numbers of 32 bits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import Array, on_host
from mrac_jax.threefry import threefry2x32
from planner.arguments import argument
from planner.errors import WorldError
from planner.luck_names import LuckName
from planner.threefry import own_key
from planner.tolerance import key_of_luck
from planner.worlds.doubt import UNIT

LEAST_TABLE = 2**11
DIGIT, DIGITS = 8, 3
"""Of the 24 bits of a number; times up to MOST_MAPS each of them fits into 32 bits."""
MOST_MAPS = UNIT


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Doubt:
    """`planner.worlds.doubt.Draws`, padded: one program for hazards and maps of all kinds. Axis `N`, places.

    Attributes:
        counter, there: uint32 `[N]`; column: int32 `[N]`.
        table: uint32 `[2**n]`, row after row; for hazards nothing but 0. rows, columns: uint32 and int32 scalars.
        spends: bool scalar, the first hit makes a place harmless.
    """

    counter: Array
    there: Array
    column: Array
    table: Array
    rows: Array
    columns: Array
    spends: Array


class Drawn(Protocol):
    """What either loop says of its places; the fields are those of `planner.worlds.doubt.Draws`."""

    @property
    def own_counter(self) -> NDArray[np.uint32]: ...
    @property
    def there(self) -> NDArray[np.uint32]: ...
    @property
    def column(self) -> NDArray[np.int32]: ...
    @property
    def table(self) -> NDArray[np.uint32]: ...


def make_doubt(drawn: Drawn, spends: bool, size: int, at: NDArray[np.int64] | slice = slice(None)) -> Doubt:
    """What is drawn (NumPy) at all places, or at these, with room for `size` of them.

    Raises WorldError for more maps than a number tells apart.
    """
    rows, columns = drawn.table.shape
    if rows > MOST_MAPS:
        raise WorldError(
            f"{rows} maps", expected=f"at most {MOST_MAPS} in JAX", fix=f"use {argument('engine', 'numba')}"
        )
    table = np.zeros(max(LEAST_TABLE, 1 << max(rows * columns - 1, 0).bit_length()), dtype=np.uint32)
    table[: rows * columns] = drawn.table.ravel()
    counter, there, column = (
        np.pad(each[at], (0, size - len(each[at]))) for each in (drawn.own_counter, drawn.there, drawn.column)
    )
    return on_host(
        Doubt, counter=counter, there=there, column=column, table=table,
        rows=np.uint32(rows), columns=np.int32(columns), spends=np.bool_(spends),
    )  # fmt: skip


def keys_of(seed: int, purpose: int | None, luck: LuckName = "step") -> NDArray[np.uint32]:
    """Luck's key, uint32 `[2]`; with a purpose `[4]`: and the key of the numbers that say what is true."""
    return np.array((*key_of_luck(seed, luck), *(() if purpose is None else own_key(seed, purpose))), dtype=np.uint32)


def bound_in_doubt(doubt: Doubt, keys: jax.Array, rollout: jax.Array, place: jax.Array, bound: Array) -> jax.Array:
    """Below which a visit's 24 bits stop the robot, uint32, as the places are in these rollouts; keys `[4]`.

    bound: uint32, the largest that it may be there; 0: nothing is drawn.
    """
    word = threefry2x32(keys[2:], rollout, _at(doubt.counter, place))[0] >> jnp.uint32(8)
    row = jnp.zeros_like(word)
    for digit in range(DIGITS):  # word * rows >> 24
        value = (word >> jnp.uint32(DIGIT * digit)) & jnp.uint32(2**DIGIT - 1)
        row = (value * doubt.rows + row) >> jnp.uint32(DIGIT)
    listed = _at(doubt.table, row.astype(jnp.int32) * doubt.columns + _at(doubt.column, place))
    there = jnp.where(word < _at(doubt.there, place), jnp.uint32(UNIT), jnp.uint32(0))
    return jnp.minimum(bound, there | listed)


def _at(flat: Array, places: jax.Array) -> jax.Array:
    return jnp.asarray(flat).at[places].get(mode="promise_in_bounds")
