"""Maps as pixels, before they become a world: free pixels, position, and cells of several pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.world.frame import Bounds, Frame, Georeference
from planner.world.world import World

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Occupancy of a pixel, as in ROS: values in between are free in a map, and threats in a layer."""
WHOLE = 1e-6
"""Largest distance of `cell_size / resolution` from a whole number (SPEC section 9)."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A map as read, `[H, W]` pixels.

    Attributes:
        occupancy: int16 `[H, W]`, row 0 at the top (largest y): FREE .. OCCUPIED, or UNKNOWN.
        frame: position of the pixels.
        source: the file.
        elevation: float64 `[H, W]` in metres (NaN = no data), or None.
        bounds: (left, bottom, right, top) in the units of the file's own georeference, or None.
        notes: effects of reading that a user should know.
        georeference: position of the frame on the Earth, or None.
        measured: whether the file gives the size of a pixel; else it is assumed.
        swath: metres, the side of the cells that a visit covers, if larger than a pixel; else None.
        world: the file's threats, starts, values and uncertainty, if it is a world file or one of another planner.
    """

    occupancy: NDArray[np.int16]
    frame: Frame
    source: str
    elevation: NDArray[np.float64] | None = None
    bounds: Bounds | None = None
    notes: tuple[str, ...] = field(default=())
    georeference: Georeference | None = None
    measured: bool = True
    swath: float | None = None
    world: World | None = None

    @classmethod
    def of(cls, world: World) -> Grid:
        """A world as a map."""
        return cls(
            occupied(~world.free), world.frame, world.source, None, None, world.notes, world.georeference,
            world.measured, world=world,
        )  # fmt: skip


def occupied(blocked: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Occupancy int16 of pixels that are obstacles or free."""
    return np.where(blocked, np.int16(OCCUPIED), np.int16(FREE))


@dataclass(frozen=True, eq=False)
class Ground:
    """A map coarsened to cells of `ratio` x `ratio` pixels.

    Attributes:
        grid: the map as read.
        free_pixels: bool `[H0, W0]`: free pixels, unknown ones decided.
        ratio: pixels per side of a cell.
        frame: position of the cells; its `shape` is (H, W).
        notes: effects of coarsening that a user should know.
    """

    grid: Grid
    free_pixels: NDArray[np.bool_]
    ratio: int
    frame: Frame
    notes: tuple[str, ...] = field(default=())

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells with only free pixels; with a swath, with at least half of them free."""
        share = self.blocks(self.free_pixels).mean(axis=2)
        return share == 1 if self.grid.swath is None else share >= 0.5

    def blocks(self, pixels: NDArray) -> NDArray:
        """The pixels `[H0, W0]` of every cell: `[H, W, ratio * ratio]`."""
        (height, width), ratio = self.frame.shape, self.ratio
        kept = pixels[: height * ratio, : width * ratio].reshape(height, ratio, width, ratio)
        return kept.swapaxes(1, 2).reshape(height, width, ratio * ratio)

    def largest(self, values: NDArray) -> NDArray[np.float64]:
        """The largest value of every cell's free pixels, float64 `[H, W]`; 0 if none is free."""
        # Pixels that are not free must not decide: a cell's threat is that of where robots can be.
        filled = np.where(self.free_pixels, values, -np.inf)
        most = self.blocks(filled).max(axis=2).astype(np.float64)
        return np.where(np.isneginf(most), 0.0, most)

    def total(self, values: NDArray) -> NDArray[np.float64]:
        """The sum over every cell's free pixels, float64 `[H, W]`."""
        return self.blocks(np.where(self.free_pixels, values, 0.0)).sum(axis=2)

    def mean(self, values: NDArray) -> NDArray[np.float64]:
        """The mean over every cell's free pixels, float64 `[H, W]`; 0 if none is free."""
        return self.total(values) / np.maximum(self.blocks(self.free_pixels).sum(axis=2), 1)

    def elevation(self) -> NDArray[np.float64] | None:
        """Mean elevation of every cell's pixels in metres, float64 `[H, W]` (NaN = no data), or None."""
        if self.grid.elevation is None:
            return None
        blocks = self.blocks(self.grid.elevation)
        known = ~np.isnan(blocks)
        count = known.sum(axis=2)
        return np.where(count > 0, np.where(known, blocks, 0.0).sum(axis=2) / np.maximum(count, 1), np.nan)


def coarsen(grid: Grid, cell_size: float | None = None, unknown_free: bool = False) -> Ground:
    """Coarsen a map to cells.

    Blocks start at row 0, col 0. Partial blocks at the far edges are dropped and counted in the notes. A cell is an
    obstacle if one of its pixels is. The origin moves up by the rows dropped at the bottom, along the grid's own axes.

    Args:
        grid: the map.
        cell_size: metres; None: one pixel.
        unknown_free: whether unknown pixels count as free.

    Raises:
        MapError: a cell is not a whole number of pixels, or no whole cell fits.

    Source: SPEC section 9.
    """
    (height, width), size = grid.frame.shape, grid.frame.size
    cell_size = cell_size if grid.swath is None else grid.swath
    grid = replace(grid, measured=grid.measured or cell_size is not None)
    ratio = _ratio(cell_size, grid)
    rows, cols = height // ratio, width // ratio
    if rows == 0 or cols == 0:
        raise MapError(
            f"{height} x {width} pixels of {size:g} m hold no cell of {cell_size:g} m",
            source=grid.source,
            fix="choose a smaller cell_size",
        )
    # Rows are counted from the top, the origin is at the bottom: dropped rows move it up.
    left_over = (height - rows * ratio) * size
    x, y, yaw = grid.frame.origin
    origin = (x - math.sin(yaw) * left_over, y + math.cos(yaw) * left_over, yaw)
    frame = Frame((rows, cols), size if cell_size is None else cell_size, origin)
    free_pixels = (grid.occupancy < OCCUPIED) & (unknown_free | (grid.occupancy != UNKNOWN))
    ground = Ground(grid, free_pixels, ratio, frame, _notes(grid, ratio, unknown_free))
    return ground if grid.swath is None else replace(ground, notes=(*ground.notes, _edge(ground)))


def _edge(ground: Ground) -> str:
    """A note on the part of a field that no swath covers."""
    kept = np.where(ground.free, ground.blocks(ground.free_pixels).sum(axis=2), 0).sum() / ground.free_pixels.sum()
    return (
        f"swaths of {ground.frame.size:g} m hold {100 * kept:.2f} % of the field's cells of {ground.grid.frame.size:g} "
        "m, the rest lies along the edge and is not counted; `value` counts the covered ones of those held"
    )


def _ratio(cell_size: float | None, grid: Grid) -> int:
    if cell_size is None:
        return 1
    exact = cell_size / grid.frame.size
    if 1 - WHOLE <= exact <= 1e9 and abs(exact - round(exact)) <= WHOLE:
        return round(exact)
    fewest = max(math.floor(min(exact, 1e9)), 1)
    near = " or ".join(f"{times * grid.frame.size:.9g}" for times in (fewest, fewest + 1))
    problem = f"cell_size {cell_size:g} m is {exact:.6g} pixels of {grid.frame.size:g} m"
    expected = "a whole number of pixels: maps are only coarsened"
    raise MapError(problem, source=grid.source, expected=expected, fix=f"for example cell_size: {near}")


def _notes(grid: Grid, ratio: int, unknown_free: bool) -> tuple[str, ...]:
    height, width = grid.frame.shape
    rows, cols = height % ratio, width % ratio
    notes = list(grid.notes)
    between = int(((grid.occupancy > FREE) & (grid.occupancy < OCCUPIED)).sum())
    if between:
        notes.append(
            f"its `mode:` is meant for threats (`layer:` in a scenario): as a map, its {between} pixels between free "
            "and occupied are free and without threat"
        )
    if rows or cols:
        notes.append(
            f"cells of {ratio} x {ratio} pixels: the last {rows} of {height} pixel rows and {cols} of {width} "
            "pixel columns do not fill a cell and are dropped"
        )
    unknown = int((grid.occupancy == UNKNOWN).sum())
    if unknown:
        notes.append(f"{unknown} unknown pixels count as {'free' if unknown_free else 'obstacles'}")
    return tuple(notes)
