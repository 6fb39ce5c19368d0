"""Splitting an area into connected, balanced parts: METIS before the start, wavefront bisection at run time.

The only file that imports METIS. Parts are always ordered by lowest cell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pymetis
from numpy.typing import NDArray

from planner.mrac.areas import connected_alike, connected_parts, split_by_label
from planner.none import NO_CELL

Partition = Callable[[tuple[int, int], NDArray[np.int64], int], list[NDArray[np.int64]]]
"""`(shape, cells of a connected area, parts) -> parts`, as `metis_parts` and `wavefront_parts` are."""


def metis_parts(shape: tuple[int, int], cells: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """`count` connected parts of a connected area by multilevel k-way partitioning (paper, section 4.1).

    METIS leaves parts empty on tiny areas and may disconnect one; then the wavefront split takes its place.
    `1 <= count <= len(cells)`.
    """
    ordered = np.sort(cells)
    if count == 1:
        return [ordered]
    starts, targets = _adjacency(shape, ordered)
    options = pymetis.Options(contig=1, seed=0)
    adjacency = pymetis.CSRAdjacency(starts, targets)
    _, label = pymetis.part_graph(count, adjacency=adjacency, recursive=False, options=options)
    parts, part_of = split_by_label(ordered, np.asarray(label)), np.full(shape[0] * shape[1], -1)
    part_of[ordered] = label
    if len(parts) == count == connected_alike(shape, part_of)[1]:
        return parts
    return wavefront_parts(shape, ordered, count)


def wavefront_parts(shape: tuple[int, int], cells: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """`count` connected parts of a connected area by repeated wavefront bisection, sizes as equal as possible."""
    if count == 1:
        return [np.sort(cells)]
    first = (count + 1) // 2
    grown, rest = bisect(shape, cells, -(-len(cells) * first // count))
    share = round(count * len(rest) / len(cells))
    of_rest = min(max(share, 1, count - len(grown)), len(rest), count - 1)
    parts = wavefront_parts(shape, grown, count - of_rest) + wavefront_parts(shape, rest, of_rest)
    return sorted(parts, key=lambda part: int(part[0]))


def bisect(
    shape: tuple[int, int], cells: NDArray[np.int64], target: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(grown, rest): two connected parts of a connected area of at least 2 cells (SPEC section 5).

    A breadth-first wavefront grows from a far end until `target` cells (default half, rounded up) are in: whole
    layers, the last one in index order. Of the rest the largest component stays, the others join the grown half.
    """
    goal = min(target if target is not None else (len(cells) + 1) // 2, len(cells) - 1)
    members = {int(cell) for cell in cells}
    far_end = min(_layers(shape, members, min(members))[-1])
    grown: set[int] = set()
    for layer in _layers(shape, members, far_end):
        grown.update(sorted(layer)[: goal - len(grown)])
        if len(grown) == goal:
            break
    rest = connected_parts(shape, np.array(sorted(members - grown), dtype=np.int64))
    stays = max(rest, key=lambda part: (len(part), -int(part[0])))
    grown_cells = np.array(sorted(members - {int(cell) for cell in stays}), dtype=np.int64)
    return grown_cells, stays


def _layers(shape: tuple[int, int], members: set[int], source: int) -> list[list[int]]:
    """Breadth-first layers of the cells of `members` from `source`."""
    width = shape[1]
    left, layers = members - {source}, [[source]]
    while left:
        reached: set[int] = set()
        for cell in layers[-1]:
            col = cell % width
            sides = (cell - width, cell - 1 if col else NO_CELL, cell + 1 if col + 1 < width else NO_CELL, cell + width)
            reached.update(side for side in sides if side in left)
        if not reached:
            break
        left -= reached
        layers.append(list(reached))
    return layers


def _adjacency(shape: tuple[int, int], ordered: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Compressed rows (starts, targets) of the 4-neighbour graph of the cells, nodes in rising cell order."""
    height, width = shape
    node = np.full((height + 2) * (width + 2), -1, dtype=np.int64)
    padded = (ordered // width + 1) * (width + 2) + ordered % width + 1
    node[padded] = np.arange(len(ordered))
    sides = node[padded[:, None] + np.array([-(width + 2), -1, 1, width + 2])]
    present = sides >= 0
    return np.concatenate([[0], np.cumsum(present.sum(axis=1))]), sides[present]
