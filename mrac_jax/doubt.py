"""What is in doubt about a map (`planner.worlds.doubt`), as both loops draw it in JAX, in numbers of 32 bits.

Who is stopped is a matter of what robots bear; what is true of the map is drawn for each rollout and cell, where a
robot enters it: it takes no room, and few cells are entered.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from mrac_jax.arrays import Array, on_host
from mrac_jax.threefry import threefry2x32
from mrac_jax.two_words import WORDS, two_words
from planner.arguments import argument
from planner.errors import WorldError
from planner.kernels.state import Tables
from planner.rollouts.open_loop.joint_draws import JointDraws
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
