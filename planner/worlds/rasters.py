"""Rasters of numbers: NumPy and text arrays, GeoTIFF; degrees become UTM, pixels that are not square are made so."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.errors import MapError
from planner.files import check_file, foreign_errors, read_npy
from planner.tables import read_csv_grid
from planner.worlds.georeference import Georeference, degree_sides, rasterio_for, same_crs, utm_zone
from planner.worlds.grid import Bounds, Frame, Ground
from planner.worlds.images import plausible
from planner.worlds.quantities import CELL_SIZE, COORDINATE
from planner.worlds.warp import SQUARE, WORDS, Band, How, edges_in, lay_over, side_of_pixels
from planner.worlds.world import MAX_CELLS

GEO_SUFFIXES = (".tif", ".tiff", ".asc")
"""Rasters that are read with rasterio."""
SUFFIXES = (".npy", ".csv", *GEO_SUFFIXES)
"""Rasters that can be read."""
TRUE = 0.01
"""Relative difference of a CRS's metre from one on the ground up to which nobody is told."""


@dataclass(frozen=True, eq=False)
class Raster:
    """Numbers on the ground, row 0 north.

    Attributes:
        values: float64 `[H, W]`; NaN = no data.
        frame: where its square pixels lie in metres, or None when the file does not say.
        bounds: (left, bottom, right, top) in the units of its own georeference, or None.
        source: the file. notes: what reading did that a user should know.
        georeference: where the frame lies on the Earth, or None when the file does not say.
    """

    values: NDArray[np.float64]
    frame: Frame | None
    bounds: Bounds | None
    source: str
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None


def read_raster(path: Path, cell_size: float | None = None, how: How = "average", over: Ground | None = None) -> Raster:
    """The raster in a `.npy`, `.csv`, `.tif` or `.asc` file.

    One in degrees is warped to the UTM zone of its middle, as `how` says; where it reaches out of a zone it stays in
    rows and columns of its degrees (`degree_raster`). Pixels that are not square become so: the nearest value, or
    linear. The new pixel is the largest part of `cell_size` that does not exceed the shorter side of the old one (or
    that side). A raster on other ground than the map `over` which it is laid, or on other pixels, is warped to the
    map's pixels, where both say where they lie. Raises MapError for what cannot be read, and when rasterio is needed
    and not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MapError(f"unknown raster format {path.suffix!r}", source=path, expected=" ".join(SUFFIXES))
    check_file(path, "a raster")
    if suffix in GEO_SUFFIXES:
        band, grid = _read_band(path), None if over is None else over.grid
        if over is None or grid is None or not _says_where(band) or grid.georeference is None or _same(band, over):
            return _on_the_ground(band, str(path), cell_size, how)
        values = lay_over(band, grid.frame, grid.georeference, how, str(path))
        note = f"{band.crs.to_string()[:40]}, {_size(band.values)} pixels, laid over the map's: {WORDS[how]}"
        return Raster(values, grid.frame, grid.bounds, str(path), (note,), grid.georeference)
    values, notes = (read_npy(path, MAX_CELLS), ()) if suffix == ".npy" else read_csv_grid(path, MAX_CELLS)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiub":
        raise MapError(f"holds {values.dtype} {values.shape}", source=path, expected="numbers [H, W]")
    with np.errstate(over="ignore"):  # long doubles
        return Raster(values.astype(np.float64), None, None, str(path), notes)


def _says_where(band: Band) -> bool:
    return band.bounds is not None and band.crs is not None and (band.crs.is_geographic or band.crs.is_projected)


def _same(band: Band, over: Ground) -> bool:
    """True for a raster of the map's own pixels or cells: its CRS, in metres, its edges within half a pixel."""
    ours, place = over.grid.bounds, over.grid.georeference
    if ours is None or place is None or not band.crs.is_projected or not same_crs(band.crs.to_string(), place.crs):
        return False
    assert band.bounds is not None
    pixel = (band.bounds[2] - band.bounds[0]) / band.values.shape[1]
    near = np.abs(np.subtract(ours, band.bounds)).max() <= pixel / 2
    return bool(near) and band.values.shape in (over.grid.frame.shape, over.frame.shape)


def square_metres(
    values: NDArray[np.float64], sides: tuple[float, float], cell_size: float | None, smooth: bool, source: str = ""
) -> tuple[NDArray[np.float64], float]:
    """Pixels of `sides` (height, width) metres as square ones: values float64 `[H', W']` and the new side in metres.

    The upper-left corner stays; what does not fill a pixel at the far edges is dropped. Linear interpolation gives
    NaN wherever a neighbour is NaN. A MapError if the result would be too large.
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


def _read_band(path: Path) -> Band:
    rasterio = rasterio_for(f"reading {path.suffix}", path, fix=", or convert to .npy")
    driver = "AAIGrid" if path.suffix.lower() == ".asc" else "GTiff"
    with foreign_errors("cannot be read as a raster", path, "GeoTIFF"), rasterio.open(path, driver=driver) as data:
        plausible(data.width * data.height, path)
        values, transform, crs = _first_band(data, path), data.transform, data.crs
    if transform.is_identity:
        return Band(values, None, None)
    if transform.b or transform.d or not transform.a > 0 or not np.isfinite(transform).all():
        raise MapError("is rotated or mirrored", source=path, fix="warp it north-up first (gdalwarp)")
    if transform.e > 0:  # stored south-up
        values = values[::-1].copy()
    bottom = min(transform.f, transform.f + values.shape[0] * transform.e)
    right, top = transform.c + values.shape[1] * transform.a, bottom + values.shape[0] * abs(transform.e)
    return Band(values, (transform.c, bottom, right, top), crs)


def _first_band(data: Any, path: Path) -> NDArray[np.float64]:
    if data.count != 1 or np.dtype(data.dtypes[0]).kind not in "fiu":
        raise MapError(f"{data.count} bands of {data.dtypes[0]}", source=path, expected="one band of real numbers")
    band = data.read(1, masked=True)
    return np.where(np.ma.getmaskarray(band), np.nan, np.ma.getdata(band).astype(np.float64))


def _on_the_ground(band: Band, source: str, cell_size: float | None, how: How) -> Raster:
    values, bounds, crs = band
    if bounds is None:
        return Raster(values, None, None, source)
    if crs is not None and crs.is_geographic:
        zone = utm_zone(*bounds)
        if zone is not None:
            return _utm_raster(band, zone, source, cell_size, how)
        return degree_raster(values, bounds, crs.to_string(), source, cell_size, how)
    (left, bottom, right, top), (height, width) = bounds, values.shape
    sides = ((top - bottom) / height, (right - left) / width)
    if crs is None or not crs.is_projected:
        return ground_raster(values, sides, (left, bottom), bounds, source, cell_size, how)
    unit = float(crs.linear_units_factor[1])
    place = Georeference(crs.to_string(), scale=(1 / unit, 1 / unit))
    sides, corner = (sides[0] * unit, sides[1] * unit), (left * unit, bottom * unit)
    raster = ground_raster(values, sides, corner, bounds, source, cell_size, how, place)
    return replace(raster, notes=(*raster.notes, *_true_metres(raster, place)))


def _utm_raster(band: Band, zone: tuple[str, str], source: str, cell_size: float | None, how: How) -> Raster:
    """A raster of degrees on square pixels of its UTM zone, their edges whole multiples of their side."""
    assert band.bounds is not None
    (west, south, east, north), (rows, cols), (words, crs) = band.bounds, band.values.shape, zone
    up, across = degree_sides((south + north) / 2)
    sides = ((north - south) / rows * up, (east - west) / cols * across)
    _check_sides(sides, source)
    side = side_of_pixels(min(sides), cell_size)
    edges = np.array(edges_in(band.bounds, band.crs, crs, source)) / side
    left, bottom, right, top = *np.floor(edges[:2] + SQUARE), *np.ceil(edges[2:] - SQUARE)
    height, width = int(top - bottom), int(right - left)
    _check_count(height, width, side, source)
    frame = Frame((height, width), side, (float(left * side), float(bottom * side), 0.0))
    values = lay_over(band, frame, Georeference(crs), how, source)
    note = (
        f"degrees: {_size(band.values)} pixels of {sides[0]:.4g} x {sides[1]:.4g} m warped to {_size(values)} of "
        f"{side:.4g} m in {words} ({crs}), {WORDS[how]}; {int(np.isnan(values).sum())} hold no data"
    )
    corners = (float(left * side), float(bottom * side), float(right * side), float(top * side))
    return Raster(values, frame, corners, source, (note,), Georeference(crs))


def _size(values: NDArray) -> str:
    return " x ".join(map(str, values.shape))


def _true_metres(raster: Raster, place: Georeference) -> tuple[str, ...]:
    """A note where a metre of the CRS is more than 1 % off on the ground in the middle of the map, as in EPSG:3857."""
    assert raster.frame is not None
    rows, cols = np.array(raster.frame.shape) / 2
    (west, south), (east, north) = place.to_lonlat(
        raster.frame.at([rows, rows], [cols - 0.5, cols + 0.5]), raster.source
    )
    up, across = degree_sides((south + north) / 2)
    ratio = math.hypot((east - west) * across, (north - south) * up) / raster.frame.size
    if abs(ratio - 1) <= TRUE:
        return ()
    return (f"a metre of {place.crs[:40]} is {ratio:.3g} m on the ground here: warp it to UTM (gdalwarp -t_srs)",)


def degree_raster(
    values: NDArray[np.float64], bounds: Bounds, crs: str, source: str, cell_size: float | None, how: How
) -> Raster:
    """A raster of degrees, within `bounds`, in metres east and north of its lower-left corner.

    East is to scale on the middle latitude; a note says how far off it is at the edges. Every metre has its exact
    longitude and latitude, so what goes back to degrees lies where it came from.
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
    """A place on the Earth in words: `36.6 N 84.4 W`."""
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
    """A raster with pixels of `sides` (height, width) metres and its lower-left `corner`, made square if need be."""
    _check_sides(sides, source)
    if not all(map(COORDINATE.accepts, corner)):
        problem = f"its lower-left corner is {corner[0]:g}, {corner[1]:g}"
        raise MapError(problem, source=source, expected=COORDINATE.expected)
    notes: tuple[str, ...] = ()
    side = sides[0]
    if abs(sides[1] / sides[0] - 1) > SQUARE:
        old, top = values.shape, corner[1] + values.shape[0] * sides[0]
        values, side = square_metres(values, sides, cell_size, how == "bilinear", source)
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
