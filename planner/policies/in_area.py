"""In which order are the cells of an area covered (Algorithm 3)? Stated once, here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

NEAREST, BOUSTROPHEDON, ROWS, COLUMNS = "nearest", "boustrophedon", "rows", "columns"
ORDERS = (NEAREST, BOUSTROPHEDON, ROWS, COLUMNS)
"""The orders of every engine: the cheapest cell is next. Of cells beside the robot, which cost alike, `nearest` takes
the lowest index; in safe areas `rows` goes on along the row and `columns` along the column as far as it leads, and
`boustrophedon` along those of the two of which there are fewer (`planner.mrac.sides`)."""


class CellOffer(NamedTuple):
    """A cell still to do in a robot's area, where the robot's last leg has ended.

    Attributes:
        here: the cell where the robot stands. cell: the one to do; indices `row * W + col`.
        cost: of the safest path between them.
    """

    here: int
    cell: int
    cost: int


InAreaOrder = str | Callable[[CellOffer], Any]
"""One of ORDERS, or a user's own: the cell of the least value is next, which the readable simulator alone follows."""
