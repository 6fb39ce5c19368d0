"""What a cell, a point or a polygon may say a number of: its threat, its value, the chance that a visit detects."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import ANY, Numbers
from planner.errors import WorldError
from planner.shown import counted

LARGEST_VALUE = 1e9
"""Of a cell."""


class Quantity(NamedTuple):
    """A number that files may state.

    Attributes:
        name: of the property of a feature, and of the column of a points file (besides `strength`).
        numbers: that it may be.
    """

    name: str
    numbers: Numbers


PROBABILITY = Numbers(0, 1 - 2**-25, below=True, said="a probability 0 <= p < 1")
"""Of float64, which as float32 is below 1 too."""
CHANCE = Numbers(0, 1, "a chance")
CELL_SIZE = Numbers(1e-5, 1e6, "a number of metres")
"""Side of a cell: centres differ in the micrometres that waypoints are written in."""
FARTHEST = 1e9
"""Largest coordinate accepted, in metres: beyond it float64 no longer tells the smallest cells apart."""
DISTANCE = Numbers(CELL_SIZE.least, FARTHEST, "a number of metres")
COORDINATE = Numbers(-FARTHEST, FARTHEST, said=f"metres, none beyond {FARTHEST:g}")
POSE = f"three numbers [x, y, yaw], none beyond {FARTHEST:g}"
SCALE = Numbers(1e-7, 1e4)
"""Units of a CRS a metre: a degree has 1e5 metres, a foot 0.3."""
SHARE = Numbers(0, 1, above=True)
THREAT = Quantity("p", PROBABILITY)
VALUE = Quantity("value", Numbers(0, LARGEST_VALUE))
DETECT = Quantity("detect", CHANCE)
SAMPLE = Quantity("value", ANY)
"""What was measured at a place, before a rule makes p of it."""


def first_of(wrong: NDArray[np.bool_]) -> tuple[tuple[int, int], str]:
    """The first of some wrong cells `[H, W]`, for messages: (row, col), and "at [0, 3] (2 such cells)"."""
    row, col = np.argwhere(wrong)[0].tolist()
    return (row, col), f"at [{row}, {col}] ({counted(int(wrong.sum()), 'such cell')})"


def checked_layer(
    given: ArrayLike | None, of: Quantity, free: NDArray[np.bool_], source: str
) -> NDArray[np.float64] | None:
    """A number a free cell, float64 `[H, W]`, 0 on obstacles; None where nobody said. Raises WorldError.

    `given`: `[H, W]`, or one number for all; `free`: bool `[H, W]`.
    """
    if given is None:
        return None
    try:
        array = np.asarray(given)
    except ValueError:
        raise WorldError(f"{of.name} has rows of different lengths", source=source, expected="a grid [H, W]") from None
    if array.dtype.kind not in "fiu":
        raise WorldError(f"{of.name} holds {array.dtype}", source=source, expected="numbers")
    if array.ndim and array.shape != free.shape:
        expected = f"the map's, {list(free.shape)}"
        raise WorldError(f"{of.name} has shape {list(array.shape)}", source=source, expected=expected)
    unsaid = free & np.ma.getmaskarray(given) if isinstance(given, np.ma.MaskedArray) else np.zeros_like(free)
    if unsaid.any():
        where = first_of(unsaid)[1]
        problem = f"{of.name} is masked {where}"
        raise WorldError(
            problem, source=source, expected="a number in every free cell", fix="fill it, as by .filled(1)"
        )
    layer = np.where(free, array.astype(np.float64), 0.0)
    wrong = ~((layer >= 0) & (layer <= of.numbers.most))
    if wrong.any():
        at, where = first_of(wrong)
        raise WorldError(f"{of.name} is {layer[at]:g} {where}", source=source, expected=of.numbers.expected)
    if of is VALUE and not layer.any():
        raise WorldError("value is 0 in every free cell", source=source, expected="a cell that is worth something")
    layer.setflags(write=False)
    return layer
