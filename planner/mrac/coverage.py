"""Algorithm 3, the modified GAC: cover what is left of an area, nearest cell first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.mrac.costs import NOT_WANTED, NOWHERE, SafestPaths


def coverage_path(
    paths: SafestPaths, here: int, to_do: NDArray[np.int64], inside: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """The cells entered, in order, to visit every cell of `to_do` from `here` (left out).

    Repeatedly the cheapest cell to do from where the last leg ended, by the safest path (paper, Algorithm 3, with
    SPEC's ties). The cells are of one level, so an adjacent one is always cheapest and needs no search.

    Args:
        paths: the safest paths of the world.
        here: where the robot stands.
        to_do: the unvisited cells of the area at this moment, reachable from `here`.
        inside: bool `[N]`, the cells that legs may enter (`transit="area"`), or None for all.
    """
    rank = np.full(len(paths.neighbours), NOT_WANTED, dtype=np.int32)
    rank[to_do] = 0
    left = len(to_do)
    if rank[here] != NOT_WANTED:
        rank[here] = NOT_WANTED
        left -= 1
    path: list[int] = []
    while left:
        adjacent = _adjacent_target(paths, here, rank)
        if adjacent != NOWHERE:
            path.append(adjacent)
        else:
            target = paths.nearest(here, rank, inside)
            if target is None:
                raise ValueError(f"{left} cells to cover cannot be reached from cell {here}")
            path.extend(paths.path(here, target.cell, inside).tolist())
        here = path[-1]
        rank[here] = NOT_WANTED
        left -= 1
    return np.array(path, dtype=np.int64)


def _adjacent_target(paths: SafestPaths, here: int, rank: NDArray[np.int32]) -> int:
    for cell in paths.neighbours[here].tolist():
        if cell != NOWHERE and rank[cell] != NOT_WANTED:
            return int(cell)
    return NOWHERE
