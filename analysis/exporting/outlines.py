"""The outline of an area of cells: one outer ring and its holes, as GIS programs want polygons."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.none import NO_CELL

Corner = tuple[int, int]


def outline(cells: NDArray[np.int64], width: int) -> list[list[Corner]]:
    """Rings (row, col) of cells' corners around a 4-connected area, closed; the outer one first, then the holes.

    Seen with row 0 at the top, the outer ring is counterclockwise, holes are clockwise (RFC 7946, 3.1.6). Rings touch
    themselves nowhere: where two cells meet in a corner alone the outline goes over to the other cell.
    """
    ahead = _edges(cells, width)
    rings: list[list[Corner]] = []
    while ahead:
        at = min(ahead)
        ring, step = [at], (0, 0)
        while True:
            row, col = at
            left = [(-step[1], step[0]), step, (step[1], -step[0])]
            turns = left[::-1] if len(ahead[at]) > 1 else ahead[at]
            new = next(turn for turn in turns if turn in ahead[at])
            ahead[at].remove(new)
            if not ahead[at]:
                del ahead[at]
            if new == step:
                ring.pop()
            at, step = (row + new[0], col + new[1]), new
            ring.append(at)
            if at == ring[0]:
                break
        rings.append(ring)
    return sorted(rings, key=min)


def _edges(cells: NDArray[np.int64], width: int) -> dict[Corner, list[Corner]]:
    """Where the outline leaves every corner for, (row, col) steps: the area lies on the left."""
    held = set(cells.tolist())
    ahead: dict[Corner, list[Corner]] = {}
    for cell in held:
        row, col = divmod(cell, width)
        sides = (
            (cell - width, (row, col + 1), (0, -1)),
            (cell - 1 if col else NO_CELL, (row, col), (1, 0)),
            (cell + width, (row + 1, col), (0, 1)),
            (cell + 1 if col + 1 < width else NO_CELL, (row + 1, col + 1), (-1, 0)),
        )
        for neighbour, corner, step in sides:
            if neighbour not in held:
                ahead.setdefault(corner, []).append(step)
    return ahead
