"""Algorithm 3, the modified GAC: cover what is left of an area, nearest cell first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.jit import compiled
from planner.mrac.paths import SafestPaths
from planner.mrac.search import NOT_WANTED
from planner.none import NO_CELL
from planner.policies.in_area import CellOffer, InAreaOrder


def coverage_path(
    paths: SafestPaths,
    here: int,
    to_do: NDArray[np.int64],
    inside: NDArray[np.bool_] | None,
    order: InAreaOrder,
    sides: NDArray[np.int64],
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
        order: which cell is next. sides: `Problem.sides`. legs: stop after so many; None = all.
    """
    rank = np.full(len(paths.neighbours), NOT_WANTED, dtype=np.int32)
    rank[to_do] = 0
    rank[here] = NOT_WANTED
    left = int(np.count_nonzero(rank != NOT_WANTED))
    path = [np.empty(0, dtype=np.int64)]
    while left and legs != 0:
        if isinstance(order, str):
            leg = _cheapest_legs(paths, here, rank, inside, to_do, sides, len(to_do) if legs is None else 1)
        else:
            leg = _leg_by(order, paths, here, to_do[rank[to_do] != NOT_WANTED], inside)
        left -= int(np.count_nonzero(rank[leg] != NOT_WANTED))
        rank[leg] = NOT_WANTED
        path.append(leg)
        here = int(leg[-1])
        legs = None if legs is None else legs - 1
    return np.concatenate(path)


def _cheapest_legs(
    paths: SafestPaths,
    here: int,
    rank: NDArray[np.int32],
    inside: NDArray[np.bool_] | None,
    to_do: NDArray[np.int64],
    sides: NDArray[np.int64],
    most: int,
) -> NDArray[np.int64]:
    """The cheapest cell first: legs to adjacent cells, at most so many; if there is none, one leg by a search.

    The cells are of one level, so an adjacent one is always cheapest.
    """
    adjacent = _adjacent_run(here, rank, paths.neighbours, sides, most)
    if len(adjacent):
        return adjacent
    target = paths.nearest(here, rank, inside, to_do)
    if target is None:
        raise ValueError(f"cells to cover cannot be reached from cell {here}")
    return paths.path(here, target.cell, inside)


def _leg_by(
    order: Callable[[CellOffer], Any],
    paths: SafestPaths,
    here: int,
    to_do: NDArray[np.int64],
    inside: NDArray[np.bool_] | None,
) -> NDArray[np.int64]:
    """The way to the first of the cells in any order."""
    cost = paths.to_all(here, inside)[to_do].tolist()
    offers = [CellOffer(here, *item) for item in zip(to_do.tolist(), cost, strict=True)]
    return paths.path(here, min(offers, key=order).cell, inside)


@compiled
def _adjacent_run(here, rank, neighbours, sides, most):  # type: ignore[no-untyped-def]
    """From cell to adjacent cell of rank 0, by `sides`, until there is none or it is `most`; int64 `[legs]`."""
    run, length = np.empty(most, dtype=np.int64), 0
    while length < most:
        after = NO_CELL
        for place in range(4):
            cell = neighbours[here, sides[here, place]]
            if cell != NO_CELL and rank[cell] == 0:
                after = cell
                break
        if after == NO_CELL:
            break
        here = after
        rank[here] = NOT_WANTED
        run[length] = here
        length += 1
    run = run[:length].copy()
    rank[run] = 0
    return run
