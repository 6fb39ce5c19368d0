"""What is seen from where: cells within a range, and with `sight` only past no obstacle; in integers, exact."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isqrt

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers
from planner.errors import WorldError
from planner.jit import compiled

RANGE = Numbers(0, inf, said="0, or a number of cells from 1 on")
FARTHEST = 2**20
"""Cells; nothing is farther on the largest map."""
MOST_SEEN = 2**26
"""Most cells that may be within range of all cells of a map, one after the other: 0.3 GB."""


@dataclass(frozen=True)
class Sense:
    """What a robot that is alive sees: every cell whose centre lies within `range` cells of its own, Euclidean.

    `sight`: only where the segment of the two centres crosses the inside of no other cell that is an obstacle.
    """

    range: float = 0.0
    sight: bool = False

    @property
    def square(self) -> int:
        """The largest squared distance, in cells, that is seen."""
        return int(min(self.range, FARTHEST) ** 2)

    @property
    def said(self) -> str:
        """It in words."""
        if self.range == 0:
            return "robots see nothing"
        far = "everything" if self.range == inf else f"{self.range:g} cells far"
        return f"robots see {far}{', not past obstacles' if self.sight else ''}"

    def views(self, free: NDArray[np.bool_], cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """(begin `[C + 1]`, seen): `seen[begin[i]:begin[i + 1]]`, rising, is seen from `cells[i]`; indices of cells.

        `free`: bool `[H, W]`, truly. `cells`: int64 `[C]`. Raises WorldError for too many.
        """
        if len(cells) * min(4 * self.square + 1, free.size) > MOST_SEEN:
            problem = f"{len(cells)} cells from which {self.said.removeprefix('robots see ')} is seen"
            raise WorldError(problem, expected=f"at most {MOST_SEEN} cells in range in all", fix="sense less far")
        blocked, reach = ~free, min(isqrt(self.square), sum(free.shape))
        begin, room = np.zeros(len(cells) + 1, dtype=np.int64), 16
        while True:
            seen = np.empty(room, dtype=np.int32)
            if _look(blocked, cells, reach, self.square, self.sight, begin, seen):
                return begin, seen[: begin[-1]]
            room = int(begin[-1])


@compiled
def _look(blocked, cells, reach, square, sight, begin, seen):  # type: ignore[no-untyped-def]
    """Fill `begin` and, as far as there is room, `seen`; whether there was."""
    height, width = blocked.shape
    count = 0
    for number in range(len(cells)):
        row, col = cells[number] // width, cells[number] % width
        for other_row in range(max(row - reach, 0), min(row + reach, height - 1) + 1):
            for other_col in range(max(col - reach, 0), min(col + reach, width - 1) + 1):
                down, right = other_row - row, other_col - col
                if down * down + right * right > square or (sight and _is_hidden(blocked, row, col, down, right)):
                    continue
                if count < len(seen):
                    seen[count] = other_row * width + other_col
                count += 1
        begin[number + 1] = count
    return count <= len(seen)


@compiled
def _is_hidden(blocked, row, col, down, right):  # type: ignore[no-untyped-def]
    """Whether an obstacle other than the two cells lies between a cell and the one so far `down` and `right` of it.

    The inside of the cell (i, j) is crossed iff 2 |down j - right i| < |down| + |right|: no side of it, and not the
    segment's line, keeps the two apart. A corner that is touched does not count.
    """
    wide = abs(down) + abs(right)
    tall, low, high = abs(down), min(right, 0), max(right, 0)
    for i in range(min(down, 0), max(down, 0) + 1):
        if down != 0:  # of this row only what is near the line
            middle = right * i // down
            low, high = max(min(right, 0), middle - wide // tall - 1), min(max(right, 0), middle + wide // tall + 1)
        for j in range(low, high + 1):
            is_end = (i == 0 and j == 0) or (i == down and j == right)
            if not is_end and blocked[row + i, col + j] and 2 * abs(down * j - right * i) < wide:
                return True
    return False
