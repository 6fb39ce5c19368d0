"""In which order are the cells of an area covered (Algorithm 3)? Stated once, here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class CellOffer(NamedTuple):
    """A cell still to do in a robot's area, where the robot's last leg has ended.

    Attributes:
        here: the cell where the robot stands. cell: the one to do; indices `row * W + col`.
        cost: of the safest path between them.
    """

    here: int
    cell: int
    cost: int


InAreaOrder = Callable[[CellOffer], Any]
"""The cell of the least value is next. Orders besides `cheapest_first` are followed by the readable simulator alone."""


def cheapest_first(offer: CellOffer) -> tuple[int, int]:
    """The cheapest cell, then the lowest index (SPEC section 5): the order of every engine."""
    return offer.cost, offer.cell
