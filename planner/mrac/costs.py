"""Eq. (3) made exact: integer entry costs, and the grid's neighbours that safest paths run over (SPEC section 3)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from planner.arguments import check_word
from planner.errors import WorldError
from planner.none import NO_CELL
from planner.worlds.levels import ThreatLevels

BLOCKED = 0
"""Entry cost of a cell that cannot be entered."""


def entry_costs(levels: ThreatLevels, risk: Literal["paper", "log"], source: str = "") -> NDArray[np.int64]:
    """Cost of entering each cell, int64 `[N]`, BLOCKED where not accessible (eq. (3) times n, rounded).

    Raises WorldError, of `source`, if the sum over all cells, which no path can exceed, might not fit in 62 bits.
    """
    of_level = level_costs(levels.values, levels.of_cell.size, risk)
    counts = np.bincount(levels.of_cell[levels.accessible], minlength=len(of_level))
    if float(of_level @ counts) >= 2.0**62:
        raise WorldError(
            f"threat levels from {levels.values[1]:g} to {levels.values[-1]:g} make path costs too large for 64 bits",
            source=source,
            expected="a ratio of the largest to the smallest threat below about 2**62 / cells**2",
            fix="raise the smallest threats or set them to 0",
        )
    costs = of_level.astype(np.int64)[np.maximum(levels.of_cell, 0)]
    return np.where(levels.accessible, costs, BLOCKED)


def level_costs(values: NDArray[np.float64], n: int, risk: Literal["paper", "log"]) -> NDArray[np.float64]:
    """Cost of entering a cell of each level `[L]`, whole numbers.

    Safe 1; dangerous `floor(n * p / p_min + 0.5)`, or with logarithms of survival for `risk="log"`.
    """
    check_word("risk", risk, ("paper", "log"))
    of_level = np.ones(len(values), dtype=np.float64)
    if len(values) > 1:
        hazard = values[1:] if risk == "paper" else np.log1p(-values[1:])
        of_level[1:] = np.floor(n * hazard / hazard[0] + 0.5)
    return of_level


def neighbour_table(shape: tuple[int, int], passable: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The neighbours of each cell that are `passable` `[N]`, int32 `[N, 4]` in the order N, W, E, S; NO_CELL: none."""
    height, width = shape
    padded = np.full((height + 2, width + 2), NO_CELL, dtype=np.int32)
    padded[1:-1, 1:-1] = np.where(passable, np.arange(height * width), NO_CELL).reshape(shape)
    sides = [padded[:-2, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:], padded[2:, 1:-1]]
    return np.stack(sides, axis=2).reshape(-1, 4)
