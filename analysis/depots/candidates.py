"""Places where robots may start: the border of the map, a mask, or a list; which of them are worth a plan.

A *site* is a set of candidates from which every strategy can do the same: those of one safe area, in which moves are
free of risk; a dangerous candidate is a site of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import argument
from planner.errors import MapError, UsageError
from planner.files import check_file, read_npy
from planner.tables import read_csv_grid, starts_with_header
from planner.worlds.points import read_table
from planner.worlds.world import FOUR_NEIGHBOURS, MAX_CELLS, World

BORDER = "border"
Cells = NDArray[np.int64]
"""(row, col) of cells, int64 `[C, 2]`."""


def border(world: World) -> NDArray[np.bool_]:
    """bool `[H, W]`: safe cells on the edge of the map, or beside obstacles that reach to it, as a sea does."""
    around, _ = ndimage.label(np.pad(~world.free, 1, constant_values=True), structure=FOUR_NEIGHBOURS)
    near = ndimage.binary_dilation(around == around[0, 0], FOUR_NEIGHBOURS)[1:-1, 1:-1]
    return near & (world.threat == 0)


def read_candidates(path: Path) -> tuple[NDArray, tuple[str, ...]]:
    """What a file of candidates holds, a mask or a list: .npy, or .csv of numbers; and notes. Raises InputError."""
    if path.suffix.lower() not in (".npy", ".csv"):
        problem = f"{argument('candidates')} {path} is neither {BORDER!r} nor such a file"
        raise UsageError(problem, expected="a mask of the map or rows of row,col as .npy or .csv")
    check_file(path, "a mask of the map, or rows of row,col")
    if path.suffix.lower() == ".npy":
        return read_npy(path, MAX_CELLS), ()
    if not starts_with_header(path):
        return read_csv_grid(path, MAX_CELLS)
    table = read_table(path, "lines row, col")
    row, col = table.column("row"), table.column("col", "column")
    if row is None or col is None:
        raise MapError(f"has the columns {', '.join(table.names)[:80]}", source=path, expected="row and col")
    cells = [[table.number(one, row, "row"), table.number(one, col, "col")] for one in table.rows]
    return np.array(cells), table.notes


def candidate_cells(world: World, given: ArrayLike, source: object = "") -> tuple[Cells, tuple[str, ...]]:
    """Candidates in one connected part of the map, in order of index, and notes.

    Args:
        given: "border"; a mask `[H, W]`, non-zero where robots may start; or a list of (row, col) `[C, 2]`.
            Two columns of numbers are a list, unless they are booleans.
        source: the file that it comes from, for errors.

    Robots start in one part of the map: of several, the largest that has a candidate. Raises UsageError.
    """
    cells = _cells(world, given, str(source))
    labels = world.components
    part = labels[tuple(cells.T)]
    size = np.bincount(labels.ravel())
    best = min(set(part.tolist()), key=lambda name: (-size[name], name))
    kept = cells[part == best]
    left_out = len(cells) - len(kept)
    note = f"{left_out} of {len(cells)} candidates lie in smaller parts of the map that cannot be reached from the rest"
    return kept, (f"{note}: left out",) if left_out else ()


def _cells(world: World, given: ArrayLike, source: str) -> Cells:
    name = source or argument("candidates")
    if isinstance(given, str):
        if given != BORDER:
            raise UsageError(argument("candidates", given), expected=f"{BORDER!r}, a mask of the map, or cells")
        found = np.argwhere(border(world))
        if not len(found):
            raise UsageError("no cell on the border of the map is safe", fix="name candidates in a file")
        return found
    array = np.asarray(given)
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] == 2:
        return _listed(world, array, name)
    if array.shape != world.shape or array.dtype.kind not in "bfiu":
        raise UsageError(
            f"{name}: has shape {array.shape}",
            expected=f"a mask of the map, {world.shape}, or rows of row,col",
        )
    chosen = np.nan_to_num(array.astype(np.float64)) != 0
    if not chosen.any():
        raise UsageError(f"{name}: names no cell", expected="a candidate or more")
    return _checked(world, np.argwhere(chosen), name)


def _listed(world: World, array: NDArray, name: str) -> Cells:
    if not np.isfinite(array).all() or (array != np.round(array)).any() or np.abs(array).max(initial=0) >= 2**31:
        raise UsageError(f"{name}: holds numbers that are no cells", expected="row,col in whole numbers")
    cells = np.unique(array.astype(np.int64), axis=0)
    if not len(cells):
        raise UsageError(f"{name}: names no cell", expected="a candidate or more")
    off = ((cells < 0) | (cells >= world.shape)).any(axis=1)
    if off.any():
        row, col = cells[off][0].tolist()
        height, width = world.shape
        expected = f"row 0..{height - 1} and col 0..{width - 1}"
        raise UsageError(f"{name}: [{row}, {col}] lies off the map", expected=expected)
    return _checked(world, cells, name)


def _checked(world: World, cells: Cells, name: str) -> Cells:
    blocked = ~world.free[tuple(cells.T)]
    if blocked.any():
        row, col = cells[blocked][0].tolist()
        problem = f"{name}: [{row}, {col}] is an obstacle ({int(blocked.sum())} such of {len(cells)})"
        raise UsageError(problem, expected="free cells", fix="leave it out")
    return cells


def sites_of(world: World, cells: Cells) -> list[Cells]:
    """The candidates by site, each spread out: its first ones lie far from each other."""
    areas, count = ndimage.label(world.threat == 0, structure=FOUR_NEIGHBOURS)
    site = areas[tuple(cells.T)].astype(np.int64)
    dangerous = site == 0
    site[dangerous] = count + 1 + np.arange(int(dangerous.sum()))
    return [spread_out(cells[site == name]) for name in np.unique(site)]


def spread_out(cells: Cells, most: int = 256) -> Cells:
    """The cells in an order in which each is the farthest from all before it; those after the first `most` as given."""
    left = np.sum((cells - cells.mean(axis=0)) ** 2, axis=1)
    order: list[int] = []
    while len(order) < min(most, len(cells)):
        order.append(int(np.argmax(left)))
        apart = np.sum((cells - cells[order[-1]]) ** 2, axis=1)
        left = np.minimum(left, apart) if len(order) > 1 else apart.astype(np.float64)
        left[order] = -1.0
    rest = np.setdiff1d(np.arange(len(cells)), order)
    return cells[np.concatenate([np.array(order, dtype=np.int64), rest])]


def in_turn(sites: Sequence[NDArray[np.int64]]) -> Iterator[NDArray[np.int64]]:
    """The first item of every site, then the second of every one, ..."""
    for row in zip_longest(*map(list, sites)):
        yield from (item for item in row if item is not None)
