"""Elevation models as maps: obstacles where it is too steep, and what a threat sees from where it stands."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.errors import MapError
from planner.worlds.georeference import WGS84
from planner.worlds.grid import FREE, OCCUPIED, Frame, Grid
from planner.worlds.physical import HEIGHTS
from planner.worlds.rasters import Raster, degree_raster, read_raster

BUILTIN = "builtin:"
JACKSBORO = "jacksboro"
"""The one elevation model that comes along, inside matplotlib: Jacksboro fault, Tennessee, about 32 x 30 km."""
TALLEST = 1e6
"""Metres above the ground that a threat may look from, at most."""
SIGHT_SLACK = 1e-9
"""Slope by which a ridge must rise above the line of sight to block it: rounding on level ground must not."""


def elevation_grid(raster: Raster, resolution: float, max_slope_deg: float | None = None) -> Grid:
    """An elevation raster as a map: pixels without data, or steeper than `max_slope_deg`, are obstacles.

    `resolution`: metres a pixel of a file that does not say.
    """
    height, width = raster.values.shape
    frame = Frame((height, width), resolution) if raster.frame is None else raster.frame
    blocked = np.isnan(raster.values)
    if blocked.all():
        raise MapError("holds no elevation at all" + f": {raster.voids}" * bool(raster.voids), source=raster.source)
    if max_slope_deg is not None:
        blocked = blocked | (slope_degrees(raster.values, frame.size) > max_slope_deg)
        if blocked.all():
            problem = f"every pixel of {frame.size:g} m is steeper than {max_slope_deg:g} degrees, or without data"
            raise MapError(problem, source=raster.source, fix="; ".join(raster.notes))
    state = np.where(blocked, OCCUPIED, FREE).astype(np.uint8)
    return Grid(
        state, frame, raster.source, elevation=raster.values, bounds=raster.bounds, notes=raster.notes,
        georeference=raster.georeference,
    )  # fmt: skip


def read_elevation(path: Path, cell_size: float | None = None) -> Raster:
    """The elevation in a raster file, in metres; degrees and oblong pixels resampled linearly to square metres."""
    return read_raster(path, cell_size, "bilinear", of=HEIGHTS)


def jacksboro(cell_size: float | None = None) -> Raster:
    """Matplotlib's sample elevation model `jacksboro_fault_dem.npz`, resampled from degrees to square metres."""
    from matplotlib import cbook

    archive: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    with archive as data:
        values = data["elevation"].astype(np.float64)
        west, step_east, step_north = (float(data[name]) for name in ("xmin", "dx", "dy"))
        south = min(float(data["ymin"]), float(data["ymax"]))  # stored the wrong way round; row 0 is north
    bounds = (west, south, west + values.shape[1] * step_east, south + values.shape[0] * step_north)
    return degree_raster(values, bounds, WGS84, BUILTIN + JACKSBORO, cell_size, "bilinear")


def slope_degrees(elevation: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Slope float64 `[H, W]` in degrees, from central differences over pixels of `size` metres (one-sided at edges).

    A pixel without data takes the elevation of the nearest one that has some, for its neighbours' sake.
    """
    unknown = np.isnan(elevation)
    if unknown.any():
        nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
        elevation = elevation[tuple(nearest)]
    rise = [np.gradient(elevation, size, axis=axis) for axis in (0, 1) if elevation.shape[axis] > 1]
    return np.degrees(np.arctan(np.hypot(*rise) if len(rise) == 2 else np.abs(sum(rise) + np.zeros(elevation.shape))))


def visible(
    elevation: NDArray[np.float64], site: tuple[int, int], height: float, reach: float, size: float
) -> NDArray[np.float64]:
    """Metres from `site` (row, col) to every cell that it sees, float64 `[H, W]`; inf: hidden or beyond `reach` metres.

    The eye is `height` metres above the site's cell of `size` metres; a cell is seen if the straight line to the
    ground at its centre passes no higher ground, taken from the elevation `[H, W]` (linear between centres) at every
    row or column it crosses, whichever are more. Ground without data (NaN) hides nothing. Cost O(cells in reach *
    reach / size).
    """
    ground = np.where(np.isnan(elevation), -1e6, elevation)
    eye = float(ground[site]) + height
    rows, cols = np.indices(ground.shape).reshape(2, -1) - np.array(site)[:, None]
    distance = np.hypot(rows, cols) * size
    aims = np.flatnonzero(distance <= reach)
    rows, cols, away = rows[aims], cols[aims], distance[aims]
    steps = np.maximum(np.abs(rows), np.abs(cols))
    slope = (ground.reshape(-1)[aims] - eye) / np.maximum(away, size / 2)
    seen = np.ones(len(aims), dtype=bool)
    for step in range(1, int(steps.max())):
        on = np.flatnonzero(seen & (steps > step))
        part = step / steps[on]
        at = np.stack([site[0] + rows[on] * part, site[1] + cols[on] * part])
        between = ndimage.map_coordinates(ground, at, order=1, mode="nearest")
        seen[on] = (between - eye) / (away[on] * part) <= slope[on] + SIGHT_SLACK
    result = np.full(ground.size, np.inf)
    result[aims[seen]] = away[seen]
    return result.reshape(ground.shape)


def band_threat(distance: NDArray[np.float64], bands: Iterable[tuple[float, float]]) -> NDArray[np.float64]:
    """p of every cell by its distance in metres: of `bands` (range, p), ranges rising, the first that reaches it."""
    threat = np.zeros(distance.shape)
    for reach, p in reversed(list(bands)):
        threat[distance <= reach] = p
    return threat
