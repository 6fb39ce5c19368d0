"""Connected areas (Def. 2): the 4-connected components of sets of cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.worlds.levels import ThreatLevels
from planner.worlds.world import FOUR_NEIGHBOURS


def connected_parts(shape: tuple[int, int], cells: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The 4-connected components of `cells` (indices), each in rising order, ordered by lowest cell."""
    if len(cells) == 0:
        return []
    rows, cols = np.divmod(cells, shape[1])
    top, left = rows.min(), cols.min()
    window = np.zeros((rows.max() - top + 1, cols.max() - left + 1), dtype=np.bool_)
    window[rows - top, cols - left] = True
    labels, count = ndimage.label(window, structure=FOUR_NEIGHBOURS)
    if count == 1:
        return [np.sort(cells)]
    ordered = np.sort(cells)
    label = labels[ordered // shape[1] - top, ordered % shape[1] - left]
    return split_by_label(ordered, label)


def split_by_label(ordered: NDArray[np.int64], label: NDArray) -> list[NDArray[np.int64]]:
    """`ordered` (rising indices) cut by `label`, the parts ordered by lowest cell."""
    grouped = ordered[np.argsort(label, kind="stable")]
    counts = np.unique(label, return_counts=True)[1]
    parts = np.split(grouped, np.cumsum(counts)[:-1])
    return sorted(parts, key=lambda part: int(part[0]))


def find_areas(shape: tuple[int, int], levels: ThreatLevels) -> list[tuple[int, NDArray[np.int64]]]:
    """Every area as (level, cells), level by level and by lowest cell within a level: the order of area ids."""
    areas = []
    for level in range(len(levels.values)):
        members = np.flatnonzero(levels.of_cell == level)
        areas += [(level, part) for part in connected_parts(shape, members)]
    return areas
