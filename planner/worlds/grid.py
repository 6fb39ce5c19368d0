"""Maps as pixels, before they become a world: what is free, where it lies, and how pixels become cells."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import MapError
from planner.worlds.doubt import Hazard, Uncertain
from planner.worlds.georeference import Georeference
from planner.worlds.knowledge import Knowledge
from planner.worlds.movers import Movers
from planner.worlds.phases import Phases
from planner.worlds.robot_types import RobotTypes

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
"""States of a pixel."""
WHOLE = 1e-6
"""How far `cell_size / resolution` may be from a whole number (SPEC section 9)."""

Pose = tuple[float, float, float]
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Frame:
    """Where a grid lies on the ground.

    Attributes:
        shape: (H, W); row 0 is at the top, the far end of the y axis.
        size: side of a pixel in metres.
        origin: (x, y, yaw), the pose of the lower-left corner in the map's frame; metres and radians.
    """

    shape: tuple[int, int]
    size: float
    origin: Pose = (0.0, 0.0, 0.0)

    def centres(self) -> NDArray[np.float64]:
        """(x, y) of every pixel's centre in metres, map frame, float64 `[H, W, 2]`."""
        height, width = self.shape
        return self.at(*np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij"))

    def at(self, rows: ArrayLike, cols: ArrayLike) -> NDArray[np.float64]:
        """(x, y) `[..., 2]` in metres, map frame, of places in pixels from the upper-left corner; centres are at .5."""
        across, up = np.asarray(cols) * self.size, (self.shape[0] - np.asarray(rows)) * self.size
        east, north, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack([east + cos * across - sin * up, north + sin * across + cos * up], axis=-1)

    def local(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (x, y) `[..., 2]` of the map's frame as metres (to the right of, up from) the lower-left corner."""
        east, north, yaw = self.origin
        moved = np.asarray(points, dtype=np.float64) - (east, north)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack(
            [cos * moved[..., 0] + sin * moved[..., 1], -sin * moved[..., 0] + cos * moved[..., 1]], axis=-1
        )

    def pixels(self, points: ArrayLike) -> NDArray[np.int64]:
        """(row, col) int64 `[..., 2]` of the pixels that hold points (x, y) in metres; they may lie off the grid."""
        local = np.clip(np.floor(self.local(points) / self.size), -(2.0**53), 2.0**53)
        return np.stack([self.shape[0] - 1 - local[..., 1], local[..., 0]], axis=-1).astype(np.int64)

    def holds(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool `[...]`: which (row, col) `[..., 2]` lie on the grid."""
        return np.all((pixels >= 0) & (pixels < self.shape), axis=-1)


@dataclass(frozen=True, eq=False)
class Grid:
    """A map as it was read, `[H, W]` pixels.

    Attributes:
        state: uint8 `[H, W]`: FREE, OCCUPIED or UNKNOWN.
        frame: where the pixels lie.
        source: the file.
        threat: float32 `[H, W]`, the probabilities that a world file brings along (NaN = obstacle), or None.
        elevation: float64 `[H, W]` in metres (NaN = no data), or None.
        starts: int64 `[K, 2]`, pixels that a world file names as starts, or None.
        bounds: (left, bottom, right, top) in the units of the file's own georeference, or None.
        notes: what reading did that a user should know.
        georeference: where the frame lies on the Earth, or None.
        value, detect: float64 `[H, W]`, what pixels are worth, and how well a visit detects, or None.
        doubt: what a world file says is in doubt about its threats, or moves, or None.
        knowledge: what it says is true beside them, or None.
        measured: the file says how large a pixel is; else it is presumed.
        types: of robots, that a world file brings along, or None.
        swath: metres, the side of the cells that a visit covers, where that is more than a pixel; else None.
    """

    state: NDArray[np.uint8]
    frame: Frame
    source: str
    threat: NDArray[np.float32] | None = None
    elevation: NDArray[np.float64] | None = None
    starts: NDArray[np.int64] | None = None
    bounds: Bounds | None = None
    notes: tuple[str, ...] = field(default=())
    georeference: Georeference | None = None
    value: NDArray[np.float64] | None = None
    detect: NDArray[np.float64] | None = None
    doubt: Hazard | Uncertain | Movers | Phases | None = None
    knowledge: Knowledge | None = None
    measured: bool = True
    swath: float | None = None
    types: RobotTypes | None = None


@dataclass(frozen=True, eq=False)
class Ground:
    """A map coarsened to cells of `ratio` x `ratio` pixels.

    Attributes:
        grid: the map as read.
        free_pixels: bool `[H0, W0]`: free pixels, unknown ones decided.
        ratio: pixels a cell has a side.
        frame: where the cells lie; their `shape` is (H, W).
        notes: what coarsening did that a user should know.
    """

    grid: Grid
    free_pixels: NDArray[np.bool_]
    ratio: int
    frame: Frame
    notes: tuple[str, ...] = field(default=())

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells all of whose pixels are free; by swaths, at least half of them."""
        share = self.blocks(self.free_pixels).mean(axis=2)
        return share == 1 if self.grid.swath is None else share >= 0.5

    def blocks(self, pixels: NDArray) -> NDArray:
        """The pixels `[H0, W0]` of every cell: `[H, W, ratio * ratio]`."""
        (height, width), ratio = self.frame.shape, self.ratio
        kept = pixels[: height * ratio, : width * ratio].reshape(height, ratio, width, ratio)
        return kept.swapaxes(1, 2).reshape(height, width, ratio * ratio)

    def largest(self, values: NDArray) -> NDArray[np.float64]:
        """The largest value of every cell's free pixels, float64 `[H, W]`; 0 where none is free."""
        filled = np.where(self.free_pixels, values, -np.inf)
        most = self.blocks(filled).max(axis=2).astype(np.float64)
        return np.where(np.isneginf(most), 0.0, most)

    def total(self, values: NDArray) -> NDArray[np.float64]:
        """The sum over every cell's free pixels, float64 `[H, W]`."""
        return self.blocks(np.where(self.free_pixels, values, 0.0)).sum(axis=2)

    def mean(self, values: NDArray) -> NDArray[np.float64]:
        """The mean over every cell's free pixels, float64 `[H, W]`; 0 where none is free."""
        return self.total(values) / np.maximum(self.blocks(self.free_pixels).sum(axis=2), 1)

    def elevation(self) -> NDArray[np.float64] | None:
        """Mean elevation of every cell's pixels in metres, float64 `[H, W]` (NaN = no data at all), or None."""
        if self.grid.elevation is None:
            return None
        blocks = self.blocks(self.grid.elevation)
        known = ~np.isnan(blocks)
        count = known.sum(axis=2)
        return np.where(count > 0, np.where(known, blocks, 0.0).sum(axis=2) / np.maximum(count, 1), np.nan)


def coarsen(grid: Grid, cell_size: float | None = None, unknown_free: bool = False) -> Ground:
    """The map in cells of `cell_size` metres (None: its pixels), as SPEC section 9 decides.

    Blocks start at row 0, col 0; partial blocks at the far edges are dropped and counted in the notes; a cell is an
    obstacle as soon as one of its pixels is; the origin moves up by the rows dropped at the bottom, along the grid's
    own axes. Raises MapError when a cell is no whole number of pixels, or no whole cell fits.
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
    left_over = (height - rows * ratio) * size
    x, y, yaw = grid.frame.origin
    origin = (x - math.sin(yaw) * left_over, y + math.cos(yaw) * left_over, yaw)
    frame = Frame((rows, cols), size if cell_size is None else cell_size, origin)
    free_pixels = (grid.state == FREE) | (unknown_free & (grid.state == UNKNOWN))
    ground = Ground(grid, free_pixels, ratio, frame, _notes(grid, ratio, unknown_free))
    return ground if grid.swath is None else replace(ground, notes=(*ground.notes, _edge(ground)))


def _edge(ground: Ground) -> str:
    """What of a field no swath covers."""
    kept = np.where(ground.free, ground.blocks(ground.free_pixels).sum(axis=2), 0).sum() / ground.free_pixels.sum()
    return (
        f"swaths of {ground.frame.size:g} m hold {100 * kept:.2f} % of the field's cells of {ground.grid.frame.size:g} "
        "m, the rest lies along the edge and is not counted; `value` is what is covered of those held"
    )


def _ratio(cell_size: float | None, grid: Grid) -> int:
    if cell_size is None:
        return 1
    exact = cell_size / grid.frame.size
    if exact < 1 - WHOLE:
        problem = f"cell_size {cell_size:g} m is smaller than a pixel of {grid.frame.size:g} m"
        raise MapError(problem, source=grid.source, fix=f"give at least {grid.frame.size:g}: maps are only coarsened")
    if exact > 1e9:
        problem = f"cell_size {cell_size:g} m is larger than every map"
        raise MapError(problem, source=grid.source, expected="a whole number of pixels")
    if abs(exact - round(exact)) > WHOLE:
        near = [f"{times * grid.frame.size:.9g}" for times in (math.floor(exact), math.floor(exact) + 1)]
        raise MapError(
            f"cell_size {cell_size:g} m is {exact:.6g} pixels of {grid.frame.size:g} m",
            source=grid.source,
            expected="a whole number of pixels",
            fix=f"for example cell_size: {near[0]} or {near[1]}",
        )
    return round(exact)


def _notes(grid: Grid, ratio: int, unknown_free: bool) -> tuple[str, ...]:
    height, width = grid.frame.shape
    rows, cols = height % ratio, width % ratio
    notes = list(grid.notes)
    if rows or cols:
        notes.append(
            f"cells of {ratio} x {ratio} pixels: the last {rows} of {height} pixel rows and {cols} of {width} "
            "pixel columns do not fill a cell and are dropped"
        )
    unknown = int((grid.state == UNKNOWN).sum())
    if unknown:
        notes.append(f"{unknown} unknown pixels count as {'free' if unknown_free else 'obstacles'}")
    return tuple(notes)
