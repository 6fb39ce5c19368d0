"""What is seen from where: cells within a range, and with `sight` only past no obstacle; in integers, exact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isqrt

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers
from planner.errors import WorldError

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
        far = "everything" if self.range == inf else f"{self.range:g} cell{'s' * (self.range != 1)} far"
        return f"robots see {far}{', not past obstacles' if self.sight else ''}"

    def views(self, free: NDArray[np.bool_], cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """(begin `[C + 1]`, seen): `seen[begin[i]:begin[i + 1]]`, rising, is seen from `cells[i]`; indices of cells.

        `free`: bool `[H, W]`, truly. `cells`: int64 `[C]`. Raises WorldError for too many.
        """
        if len(cells) * min(4 * self.square + 1, free.size) > MOST_SEEN:
            problem = f"{len(cells)} cells from which {self.said.removeprefix('robots see ')} is seen"
            raise WorldError(problem, expected=f"at most {MOST_SEEN} cells in range in all", fix="sense less far")
        height, width = free.shape
        rows, cols = np.divmod(cells, width)
        who, what = [], []
        # Offsets rise as the cells do that they lead to, so what is seen from a cell rises too.
        for down, right in self._offsets(height, width):
            inside = (rows + down >= 0) & (rows + down < height) & (cols + right >= 0) & (cols + right < width)
            seers = np.flatnonzero(inside)
            for i, j in _between(down, right) if self.sight else ():
                seers = seers[free[rows[seers] + i, cols[seers] + j]]
            who.append(seers)
            what.append((cells[seers] + down * width + right).astype(np.int32))
        seer = np.concatenate(who)
        begin = np.append(0, np.cumsum(np.bincount(seer, minlength=len(cells))))
        return begin, np.concatenate(what)[np.argsort(seer, kind="stable")]

    def _offsets(self, height: int, width: int) -> Iterator[tuple[int, int]]:
        reach = isqrt(self.square)
        tall, wide = min(reach, height - 1), min(reach, width - 1)
        for down in range(-tall, tall + 1):
            for right in range(-wide, wide + 1):
                if down * down + right * right <= self.square:
                    yield down, right


def _between(down: int, right: int) -> Iterator[tuple[int, int]]:
    """The cells other than the two whose inside the segment crosses to the cell so far `down` and `right`.

    That of the cell (i, j) is crossed iff 2 |down j - right i| < |down| + |right|: no side of it, and not the segment's
    line, keeps the two apart. A corner that is touched does not count.
    """
    wide = abs(down) + abs(right)
    for i in range(min(down, 0), max(down, 0) + 1):
        for j in range(min(right, 0), max(right, 0) + 1):
            if (i, j) not in ((0, 0), (down, right)) and 2 * abs(down * j - right * i) < wide:
                yield i, j
