"""Rasters of numbers: NumPy and text arrays, GeoTIFF. Degrees become UTM, and pixels become square."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.errors import MapError
from planner.files import check_file, read_csv_grid, read_npy
from planner.world.frame import WGS84, Bounds, Frame, Georeference, degree_sides, same_crs, utm_zone
from planner.world.grid import Grid, Ground, occupied
from planner.world.keys import CELL_SIZE, COORDINATE
from planner.world.raster_bands import (
    HEIGHTS,
    PROBABILITIES,
    SQUARE,
    WORDS,
    Band,
    How,
    Meaning,
    Metadata,
    edges_in,
    lay_over,
    physical,
    read_band,
    side_of_pixels,
    span,
)
from planner.world.world import MAX_CELLS

GEO_SUFFIXES = (".tif", ".tiff", ".asc")
"""Rasters that are read with rasterio."""
SUFFIXES = (".npy", ".csv", *GEO_SUFFIXES)
"""Rasters that can be read."""
TRUE = 0.01
"""Relative difference between a CRS's metre and a metre on the ground from which on a note is made."""

NO_PLACE = "has no position: a pixel is 1 m, unless `resolution:` in `map:` gives another size"
CELL_ON_CELL = "{} has no position: it is laid on the map cell on cell, its row 0 on the map's"


@dataclass(frozen=True, eq=False)
class Raster:
    """Numbers on the ground, row 0 north.

    Attributes:
        values: float64 `[H, W]`; NaN = no data.
        frame: position of its square pixels in metres, or None if the file has none.
        bounds: (left, bottom, right, top) in the units of its own georeference, or None.
        source: the file. notes: effects of reading that a user should know.
        voids: description of undeclared no-data numbers ("": none).
        georeference: position of the frame on the Earth, or None if the file has none.
    """

    values: NDArray[np.float64]
    frame: Frame | None
    bounds: Bounds | None
    source: str
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None
    voids: str = ""


def read_raster(
    path: Path,
    cell_size: float | None = None,
    how: How = "average",
    over: Ground | None = None,
    of: Meaning = PROBABILITIES,
) -> Raster:
    """Read the raster in a `.npy`, `.csv`, `.tif` or `.asc` file.

    Scale, offset and unit of a file are applied first; undeclared voids become no data. A raster in degrees is warped
    to the UTM zone of its middle; if it reaches out of a zone it keeps its rows and columns (`degree_raster`). Pixels
    become square by the nearest or the linear value. With `over`, a raster with other pixels than the map's is warped
    to the map's, if both have positions.

    Args:
        path: the file.
        cell_size: metres; new pixels are its largest whole part up to the shorter side of the old ones. None: that
            side.
        how: resampling.
        over: the map that it is laid over.
        of: kind of quantity.

    Raises:
        MapError: the file cannot be read, a unit is unknown.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MapError(f"unknown raster format {path.suffix!r}", source=path, expected=" ".join(SUFFIXES))
    check_file(path, "a raster")
    if suffix in GEO_SUFFIXES:
        band = read_band(path, of)
        raster = _placed(band, str(path), cell_size, how, over)
        placeless = "" if raster.frame is not None else NO_PLACE if over is None else CELL_ON_CELL.format(path.name)
        notes = (*band.notes, *raster.notes, *filter(None, [placeless, band.voids]))
        return replace(raster, notes=notes, voids=band.voids)
    values, said = (read_npy(path, MAX_CELLS), ()) if suffix == ".npy" else read_csv_grid(path, MAX_CELLS)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiub":
        raise MapError(f"holds {values.dtype} {values.shape}", source=path, expected="numbers [H, W]")
    found = physical(values, np.ones(values.shape, dtype=bool), Metadata(), of, str(path))
    return Raster(found.values, None, None, str(path), (*said, *filter(None, [found.voids])), voids=found.voids)


def _placed(band: Band, source: str, cell_size: float | None, how: How, over: Ground | None) -> Raster:
    """The band on pixels of its own, or on the map's if its position or pixels differ."""
    grid, crs = (None if over is None else over.grid), band.crs
    placed = band.bounds is not None and crs is not None and (crs.is_geographic or crs.is_projected)
    if over is None or grid is None or grid.georeference is None or not placed or _same(band, over):
        return _on_the_ground(band, source, cell_size, how)
    values = lay_over(band, grid.frame, grid.georeference, how, source)
    note = f"{band.crs.to_string()[:40]}, {size_of(band.values.shape)} pixels, laid over the map's: {WORDS[how]}"
    return Raster(values, grid.frame, grid.bounds, source, (note,), grid.georeference)


def _same(band: Band, over: Ground) -> bool:
    """True for a raster with the map's pixels or cells: same CRS, in metres, edges within half a pixel."""
    ours, place = over.grid.bounds, over.grid.georeference
    if (
        ours is None
        or place is None
        or band.points
        or not band.crs.is_projected
        or not same_crs(band.crs.to_string(), place.crs)
    ):
        return False
    assert band.bounds is not None
    pixel = (band.bounds[2] - band.bounds[0]) / band.values.shape[1]
    near = np.abs(np.subtract(ours, band.bounds)).max() <= pixel / 2
    return bool(near) and band.values.shape in (over.grid.frame.shape, over.frame.shape)


def square_metres(
    values: NDArray[np.float64], sides: tuple[float, float], cell_size: float | None, smooth: bool, source: str = ""
) -> tuple[NDArray[np.float64], float]:
    """Resample pixels to squares. The upper-left corner stays; incomplete pixels at the far edges are dropped.

    Args:
        values: float64 `[H, W]`.
        sides: (height, width) of a pixel, metres.
        cell_size: as in `read_raster`.
        smooth: linear interpolation, with NaN next to NaN; else the nearest value.
        source: for messages.

    Returns:
        (values float64 `[H', W']`, side in metres).

    Raises:
        MapError: the result would be too large.
    """
    side = side_of_pixels(min(sides), cell_size)
    height, width = (math.floor(n * length / side + SQUARE) for n, length in zip(values.shape, sides, strict=True))
    _check_count(height, width, side, source)
    rows = (np.arange(height) + 0.5) * side / sides[0] - 0.5
    cols = (np.arange(width) + 0.5) * side / sides[1] - 0.5
    if smooth:
        grid = np.meshgrid(rows, cols, indexing="ij")
        return ndimage.map_coordinates(values, grid, order=1, mode="nearest"), side
    near = [np.clip(np.rint(at).astype(int), 0, n - 1) for at, n in zip((rows, cols), values.shape, strict=True)]
    return values[np.ix_(*near)], side


def _check_count(height: int, width: int, side: float, source: str) -> None:
    if height < 1 or width < 1 or height * width > MAX_CELLS:
        problem = f"{height} x {width} pixels after resampling to squares of {side:g} m"
        raise MapError(problem, source=source, expected=f"1 to {MAX_CELLS} pixels")


def _on_the_ground(band: Band, source: str, cell_size: float | None, how: How) -> Raster:
    bounds, crs = band.bounds, band.crs
    if bounds is None:
        return Raster(band.values, None, None, source)
    geographic = crs is not None and crs.is_geographic
    if geographic and abs(math.degrees(crs.units_factor[1]) - 1) > SQUARE:
        problem = f"its CRS counts in {crs.units_factor[0]}"
        raise MapError(problem, source=source, expected="degrees or metres", fix="warp it first (gdalwarp -t_srs)")
    zone = utm_zone(*bounds) if geographic else None
    if zone is not None:
        place, where = Georeference(zone[1]), f"{zone[0]} ({zone[1]})"
        if band.points:
            return _warped(band, place, where, source, cell_size, how)
        (west, south, east, north), (rows, cols) = bounds, band.values.shape
        up, across = degree_sides((south + north) / 2)
        sides = ((north - south) / rows * up, (east - west) / cols * across)
        _check_sides(sides, source)
        edges = edges_in(bounds, crs, place.crs, source)
        return _warped(band, place, where, source, cell_size, how, (edges, sides))
    if geographic and not band.points:
        return degree_raster(band.values, bounds, crs.to_string(), source, cell_size, how)
    unit = 1.0 if crs is None or geographic else float(crs.units_factor[1])
    own = Georeference(crs.to_string(), scale=(1 / unit, 1 / unit)) if crs is not None and crs.is_projected else None
    if band.points:
        if own is None:
            problem = "its control points are on no map projection" + ", and reach out of a UTM zone" * geographic
            raise MapError(problem, source=source, fix="warp it first (gdalwarp -t_srs)")
        raster = _warped(band, own, own.crs[:40], source, cell_size, how)
    else:
        (height, width), (left, bottom, right, top) = band.values.shape, np.multiply(bounds, unit).tolist()
        sides = ((top - bottom) / height, (right - left) / width)
        raster = ground_raster(band.values, sides, (left, bottom), bounds, source, cell_size, how, own)
    if own is None:
        return raster
    assert raster.frame is not None
    return replace(raster, notes=(*raster.notes, *true_metres(raster.frame, own, source, "gdalwarp -t_srs")))


def _warped(
    band: Band,
    place: Georeference,
    where: str,
    source: str,
    cell_size: float | None,
    how: How,
    spans: tuple[Bounds, tuple[float, float]] | None = None,
) -> Raster:
    """A raster on square pixels of a CRS, in metres, with edges at whole multiples of their side.

    `where`: name of the CRS. `spans`: the raster's edges there and the sides of its pixels (height, width), both in
    units of the CRS; None: from its control points.
    """
    unit = 1 / place.scale[0]
    found = span(band.points, band.values.shape, band.crs, place.crs, source) if spans is None else spans
    edges, sides = unit * np.array(found[0]), (unit * found[1][0], unit * found[1][1])
    _check_sides(sides, source)
    side = side_of_pixels(min(sides), cell_size)
    # Edges at whole multiples of the side: rasters of one zone and side then share their pixels.
    near = edges / side
    left, bottom, right, top = *np.floor(near[:2] + SQUARE), *np.ceil(near[2:] - SQUARE)
    height, width = int(top - bottom), int(right - left)
    _check_count(height, width, side, source)
    frame = Frame((height, width), side, (float(left * side), float(bottom * side), 0.0))
    values = lay_over(band, frame, place, how, source)
    note = (
        f"{size_of(band.values.shape)} pixels of {sides[0]:.4g} x {sides[1]:.4g} m warped to "
        f"{size_of(values.shape)} of {side:.4g} m in {where}, {WORDS[how]}; {int(np.isnan(values).sum())} hold no data"
    )
    west, south, east, north = (float(edge * side / unit) for edge in (left, bottom, right, top))
    return Raster(values, frame, (west, south, east, north), source, (note,), place)


def size_of(shape: tuple[int, ...]) -> str:
    """A shape as text: `20 x 30`."""
    return " x ".join(map(str, shape))


def true_metres(frame: Frame, place: Georeference, source: str, command: str) -> tuple[str, ...]:
    """A note if a metre of the CRS is more than 1 % off on the ground in the middle of the map, as in EPSG:3857.

    Args:
        frame: of the map.
        place: its position on the Earth.
        source: for messages.
        command: that brings such a file into another CRS.
    """
    rows, cols = np.array(frame.shape) / 2
    (west, south), (east, north) = place.to_lonlat(frame.at([rows, rows], [cols - 0.5, cols + 0.5]), source)
    up, across = degree_sides((south + north) / 2)
    ratio = math.hypot((east - west) * across, (north - south) * up) / frame.size
    if abs(ratio - 1) <= TRUE:
        return ()
    return (f"a metre of {place.crs[:40]} is {ratio:.3g} m on the ground here: warp it to UTM ({command})",)


def degree_raster(
    values: NDArray[np.float64], bounds: Bounds, crs: str, source: str, cell_size: float | None, how: How
) -> Raster:
    """A raster of degrees in metres east and north of its lower-left corner.

    East is to scale at the middle latitude; a note gives the error at the edges. Every metre has exact longitude and
    latitude, so coordinates transformed back to degrees are exact.

    Args:
        values: float64 `[H, W]`.
        bounds: (west, south, east, north), degrees.
        crs: of the degrees.
        source: for messages.
        cell_size, how: as in `read_raster`.

    Raises:
        MapError: a latitude beyond 89 degrees, or too many pixels.
    """
    west, south, east, north = bounds
    if south < -89 or north > 89:
        raise MapError(f"lies at latitudes {south:g}..{north:g}", source=source, expected="-89..89 degrees")
    up, across = degree_sides((south + north) / 2)
    place = Georeference(crs, (west, south), (1 / across, 1 / up))
    sides = ((north - south) / values.shape[0] * up, (east - west) / values.shape[1] * across)
    raster = ground_raster(values, sides, (0.0, 0.0), bounds, source, cell_size, how, place)
    off = max(abs(degree_sides(edge)[1] / across - 1) for edge in (south, north))
    note = f"degrees: worked on in metres east and north of {describe(west, south)}, {100 * off:.2g} % off at the edges"
    return replace(raster, notes=(*raster.notes, note))


def describe(longitude: float, latitude: float) -> str:
    """A place on the Earth as text: `36.6 N 84.4 W`."""
    return f"{abs(latitude):.6g} {'NS'[latitude < 0]} {abs(longitude):.6g} {'EW'[longitude < 0]}"


def ground_raster(
    values: NDArray[np.float64],
    sides: tuple[float, float],
    corner: tuple[float, float],
    bounds: Bounds | None,
    source: str,
    cell_size: float | None,
    how: How,
    georeference: Georeference | None = None,
) -> Raster:
    """A raster in metres, made square if necessary.

    Args:
        values: float64 `[H, W]`.
        sides: (height, width) of a pixel, metres.
        corner: (x, y) of its lower-left corner, metres.
        bounds, source, georeference: of the result.
        cell_size, how: as in `read_raster`.

    Raises:
        MapError: sides, corner or the number of pixels are out of range.
    """
    _check_sides(sides, source)
    if not all(map(COORDINATE.accepts, corner)):
        problem = f"its lower-left corner is {corner[0]:g}, {corner[1]:g}"
        raise MapError(problem, source=source, expected=COORDINATE.expected)
    notes: tuple[str, ...] = ()
    side = sides[0]
    if abs(sides[1] / sides[0] - 1) > SQUARE:
        old, top = values.shape, corner[1] + values.shape[0] * sides[0]
        values, side = square_metres(values, sides, cell_size, how == "bilinear", source)
        # Amounts are per pixel: the sum is kept when pixels change their area.
        values = values * (side * side / (sides[0] * sides[1])) if how == "sum" else values
        corner = (corner[0], top - values.shape[0] * side)
        notes = (
            f"{old[0]} x {old[1]} pixels of {sides[0]:.4g} x {sides[1]:.4g} m resampled to "
            f"{values.shape[0]} x {values.shape[1]} of {side:.4g} m",
        )
    height, width = values.shape
    return Raster(values, Frame((height, width), side, (*corner, 0.0)), bounds, source, notes, georeference)


def _check_sides(sides: tuple[float, float], source: str) -> None:
    if not all(map(CELL_SIZE.accepts, sides)):
        raise MapError(f"pixels of {sides[0]:g} x {sides[1]:g} m", source=source, expected=CELL_SIZE.expected)


# Elevation models as maps: obstacles on steep ground, and the view from a site.

BUILTIN = "builtin:"
JACKSBORO = "jacksboro"
"""The elevation model shipped with matplotlib: Jacksboro fault, Tennessee, about 32 x 30 km."""
TALLEST = 1e6
"""Largest height of a site above the ground, metres."""
SIGHT_SLACK = 1e-9
"""Slope by which a ridge must rise above the line of sight to block it: larger than rounding on level ground."""


def elevation_grid(raster: Raster, resolution: float, max_slope_deg: float | None = None) -> Grid:
    """An elevation raster as a map: pixels without data, or steeper than a limit, are obstacles.

    Args:
        raster: elevation, metres.
        resolution: metres per pixel, for a file without it.
        max_slope_deg: the limit, degrees; None: no limit.

    Raises:
        MapError: no pixel is free.
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
    where = raster.bounds, raster.notes, raster.georeference
    return Grid(occupied(blocked), frame, raster.source, raster.values, *where)


def read_elevation(path: Path, cell_size: float | None = None) -> Raster:
    """Read the elevation in a raster file, in metres; degrees and oblong pixels are resampled linearly.

    Args:
        path: the file.
        cell_size: as in `read_raster`.
    """
    return read_raster(path, cell_size, "bilinear", of=HEIGHTS)


def jacksboro(cell_size: float | None = None) -> Raster:
    """Matplotlib's sample elevation model `jacksboro_fault_dem.npz`, resampled from degrees to square metres."""
    from matplotlib import cbook

    archive: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    with archive as data:
        values = data["elevation"].astype(np.float64)
        west, step_east, step_north = (float(data[name]) for name in ("xmin", "dx", "dy"))
        south = min(float(data["ymin"]), float(data["ymax"]))  # stored in reverse; row 0 is north
    bounds = (west, south, west + values.shape[1] * step_east, south + values.shape[0] * step_north)
    return degree_raster(values, bounds, WGS84, BUILTIN + JACKSBORO, cell_size, "bilinear")


def slope_degrees(elevation: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Slope in degrees, from central differences (one-sided at edges).

    A pixel without data takes the elevation of the nearest one with data, for its neighbours.

    Args:
        elevation: float64 `[H, W]`, metres.
        size: of a pixel, metres.

    Returns:
        float64 `[H, W]`.
    """
    unknown = np.isnan(elevation)
    if unknown.any():
        nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
        # Else the gradient of every neighbour of a pixel without data would be NaN too.
        elevation = elevation[tuple(nearest)]
    rise = [np.gradient(elevation, size, axis=axis) for axis in (0, 1) if elevation.shape[axis] > 1]
    return np.degrees(np.arctan(np.hypot(*rise) if len(rise) == 2 else np.abs(sum(rise) + np.zeros(elevation.shape))))


def visible(
    elevation: NDArray[np.float64], site: tuple[int, int], height: float, reach: float, size: float
) -> NDArray[np.float64]:
    """Distance from a site to every cell that it sees.

    A cell is seen if the straight line from the eye to the ground at its centre passes no higher ground. The elevation
    along the line is linear between centres, at every row or column crossed, whichever are more. Ground without data
    hides nothing. Cost: O(cells in reach * reach / size).

    Args:
        elevation: float64 `[H, W]`, metres; NaN = no data.
        site: (row, col).
        height: of the eye above the ground of its cell, metres.
        reach: largest distance, metres.
        size: of a cell, metres.

    Returns:
        float64 `[H, W]`, metres; inf: hidden or out of reach.
    """
    # Ground without data lies below every line of sight.
    ground = np.where(np.isnan(elevation), -1e6, elevation)
    eye = float(ground[site]) + height
    rows, cols = np.indices(ground.shape).reshape(2, -1) - np.array(site)[:, None]
    distance = np.hypot(rows, cols) * size
    aims = np.flatnonzero(distance <= reach)
    rows, cols, away = rows[aims], cols[aims], distance[aims]
    # One sample for each row or column that the line crosses, whichever are more.
    steps = np.maximum(np.abs(rows), np.abs(cols))
    # The site's own cell has distance 0: half a cell avoids a division by zero.
    slope = (ground.reshape(-1)[aims] - eye) / np.maximum(away, size / 2)
    seen = np.ones(len(aims), dtype=bool)
    for step in range(1, int(steps.max())):
        # Cells that are hidden already, or whose line has ended, are not computed again.
        on = np.flatnonzero(seen & (steps > step))
        part = step / steps[on]
        at = np.stack([site[0] + rows[on] * part, site[1] + cols[on] * part])
        between = ndimage.map_coordinates(ground, at, order=1, mode="nearest")
        seen[on] = (between - eye) / (away[on] * part) <= slope[on] + SIGHT_SLACK
    result = np.full(ground.size, np.inf)
    result[aims[seen]] = away[seen]
    return result.reshape(ground.shape)


def band_threat(distance: NDArray[np.float64], bands: Iterable[tuple[float, float]]) -> NDArray[np.float64]:
    """p of every cell by its distance.

    Args:
        distance: float64 `[H, W]`, metres.
        bands: (range, p), ranges increasing; the first that includes the distance counts.
    """
    threat = np.zeros(distance.shape)
    for reach, p in reversed(list(bands)):
        threat[distance <= reach] = p
    return threat
