"""What a cell, a point or a polygon may say a number of: its threat, its value, the chance that a visit detects."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import WorldError

LARGEST_VALUE = 1e9
"""Of a cell."""


class Quantity(NamedTuple):
    """A number that files may state.

    Attributes:
        name: of the property of a feature, and of the column of a points file (besides `strength`).
        expected: what is accepted, in words. ok: whether a number is. most: the largest of them.
    """

    name: str
    expected: str
    ok: Callable[[float], bool]
    most: float


def is_probability(value: float) -> bool:
    """True for 0 <= p < 1, in float64 and as float32."""
    return 0 <= value < 1 and bool(np.float32(value) < 1)


THREAT = Quantity("p", "a probability 0 <= p < 1", is_probability, 1.0)
VALUE = Quantity("value", f"a number 0 .. {LARGEST_VALUE:g}", lambda value: 0 <= value <= LARGEST_VALUE, LARGEST_VALUE)
DETECT = Quantity("detect", "a chance 0 <= d <= 1", lambda value: 0 <= value <= 1, 1.0)
SAMPLE = Quantity("value", "a number", lambda value: True, np.inf)
"""What was measured at a place, before a rule makes p of it."""


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
    layer = np.where(free, array.astype(np.float64), 0.0)
    wrong = np.argwhere(~((layer >= 0) & (layer <= of.most))).tolist()
    if wrong:
        row, col = wrong[0]
        problem = f"{of.name} at [{row}, {col}] is {layer[row, col]:g} ({len(wrong)} such cell{'s' * (len(wrong) > 1)})"
        raise WorldError(problem, source=source, expected=of.expected)
    if of is VALUE and not layer.any():
        raise WorldError("value is 0 in every free cell", source=source, expected="a cell that is worth something")
    layer.setflags(write=False)
    return layer
