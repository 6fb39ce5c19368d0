"""Which of the cells next to a robot goes first where all of them are to do: what makes coverage paths go straight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.policies.in_area import BOUSTROPHEDON, COLUMNS, ROWS
from planner.worlds.world import FOUR_NEIGHBOURS

BY_INDEX, BY_ROW, BY_COLUMN = (0, 1, 2, 3), (1, 2, 0, 3), (0, 3, 1, 2)
"""Sides in their order: 0 north, 1 west, 2 east, 3 south."""


def sides_first(order: object, safe: NDArray[np.bool_]) -> NDArray[np.int64]:
    """int64 `[H * W, 4]`: of each cell its sides, the one that goes first, first (SPEC section 20).

    `safe` `[H, W]`: the cells of level 0; all others have theirs by index. Of a connected set of safe cells it knows
    nothing but its shape, so that a mission that is gone on with has the order with which it began.
    """
    sides = np.tile(BY_INDEX, (safe.size, 1))
    along_row = np.zeros(safe.shape, dtype=np.bool_)
    if order == ROWS:
        along_row = safe
    elif order == BOUSTROPHEDON:
        along_row = _fewer_in_rows(safe)
    if order in (ROWS, COLUMNS, BOUSTROPHEDON):
        sides[safe.ravel()] = BY_COLUMN
        sides[along_row.ravel()] = BY_ROW
    return sides


def _fewer_in_rows(safe: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells of those connected sets that have no more straight runs in rows than in columns."""
    part, count = ndimage.label(safe, FOUR_NEIGHBOURS)
    begins_row, begins_column = safe.copy(), safe.copy()
    begins_row[:, 1:] &= ~safe[:, :-1]
    begins_column[1:] &= ~safe[:-1]
    runs = (np.bincount(part[begins], minlength=count + 1) for begins in (begins_row, begins_column))
    return safe & np.less_equal(*runs)[part]
