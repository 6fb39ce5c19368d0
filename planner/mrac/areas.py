"""Connected areas (Def. 2): the 4-connected components of sets of cells."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.worlds.levels import NO_LEVEL, ThreatLevels
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
    ends = np.cumsum(np.bincount(label)).tolist()
    parts = (grouped[begin:end] for begin, end in itertools.pairwise([0, *ends]) if end > begin)
    return sorted(parts, key=lambda part: int(part[0]))


@lru_cache(maxsize=1)
def find_areas(shape: tuple[int, int], levels: ThreatLevels) -> list[tuple[int, NDArray[np.int64]]]:
    """Every area as (level, cells), level by level and by lowest cell within a level: the order of area ids.

    The last ones are kept, for other teams with the same levels.
    """
    cells = np.flatnonzero(levels.of_cell != NO_LEVEL)
    parts = split_by_label(cells, connected_alike(shape, levels.of_cell)[0][cells])
    return sorted(((int(levels.of_cell[part[0]]), part) for part in parts), key=lambda area: area[0])


def connected_alike(shape: tuple[int, int], kind: NDArray[np.integer]) -> tuple[NDArray[np.int32], int]:
    """The 4-connected components of cells of one `kind` `[N]`, all kinds at once: numbers `[N]` from 1, how many.

    A kind below 0 is none, and has number 0. Between two neighbours lies a place that is free if they are alike.
    """
    of = kind.reshape(shape)
    free = np.zeros((2 * shape[0] - 1, 2 * shape[1] - 1), dtype=np.bool_)
    free[::2, ::2] = of >= 0
    free[1::2, ::2] = (of[1:] == of[:-1]) & (of[1:] >= 0)
    free[::2, 1::2] = (of[:, 1:] == of[:, :-1]) & (of[:, 1:] >= 0)
    labels, count = ndimage.label(free, structure=FOUR_NEIGHBOURS)
    return labels[::2, ::2].ravel(), count
