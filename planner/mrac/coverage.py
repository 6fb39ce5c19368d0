"""Algorithm 3, the modified GAC: cover what is left of an area, nearest cell first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.costs import NOT_WANTED, NOWHERE, SafestPaths
from planner.policies.in_area import CellOffer, InAreaOrder, cheapest_first


def coverage_path(
    paths: SafestPaths,
    here: int,
    to_do: NDArray[np.int64],
    inside: NDArray[np.bool_] | None,
    order: InAreaOrder = cheapest_first,
    legs: int | None = None,
) -> NDArray[np.int64]:
    """The cells entered, in order, to visit every cell of `to_do` from `here` (left out).

    Repeatedly the first cell to do, in this order, from where the last leg ended, by the safest path (paper,
    Algorithm 3, with SPEC's ties).

    Args:
        paths: the safest paths of the world.
        here: where the robot stands.
        to_do: the unvisited cells of the area at this moment, reachable from `here`.
        inside: bool `[N]`, the cells that legs may enter (`transit="area"`), or None for all.
        order: which cell is next. legs: stop after so many; None = all.
    """
    rank = np.full(len(paths.neighbours), NOT_WANTED, dtype=np.int32)
    rank[to_do] = 0
    rank[here] = NOT_WANTED
    left = int(np.count_nonzero(rank != NOT_WANTED))
    path: list[int] = []
    while left and legs != 0:
        if order is cheapest_first:
            leg = _cheapest_leg(paths, here, rank, inside)
        else:
            leg = _leg_by(order, paths, here, to_do[rank[to_do] != NOT_WANTED], inside)
        left -= int(np.count_nonzero(rank[leg] != NOT_WANTED))
        rank[leg] = NOT_WANTED
        path.extend(leg)
        here = path[-1]
        legs = None if legs is None else legs - 1
    return np.array(path, dtype=np.int64)


def _cheapest_leg(
    paths: SafestPaths, here: int, rank: NDArray[np.int32], inside: NDArray[np.bool_] | None
) -> list[int]:
    """`cheapest_first` by a search. The cells are of one level, so an adjacent one is always cheapest: no search."""
    adjacent = _adjacent_target(paths, here, rank)
    if adjacent != NOWHERE:
        return [adjacent]
    target = paths.nearest(here, rank, inside)
    if target is None:
        raise ValueError(f"cells to cover cannot be reached from cell {here}")
    return paths.path(here, target.cell, inside).tolist()


def _leg_by(
    order: InAreaOrder, paths: SafestPaths, here: int, to_do: NDArray[np.int64], inside: NDArray[np.bool_] | None
) -> list[int]:
    """The way to the first of the cells in any order."""
    cost = paths.to_all(here, inside)[to_do].tolist()
    offers = [CellOffer(here, *item) for item in zip(to_do.tolist(), cost, strict=True)]
    return paths.path(here, min(offers, key=order).cell, inside).tolist()


def _adjacent_target(paths: SafestPaths, here: int, rank: NDArray[np.int32]) -> int:
    for cell in paths.neighbours[here].tolist():
        if cell != NOWHERE and rank[cell] != NOT_WANTED:
            return int(cell)
    return NOWHERE
