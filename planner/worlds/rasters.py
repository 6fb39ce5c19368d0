"""Rasters of numbers: NumPy and text arrays, GeoTIFF; whatever is in degrees or not square becomes square metres."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from planner.errors import MapError
from planner.files import check_file, read_csv_grid, read_npy
from planner.worlds.georeference import Georeference, rasterio_for
from planner.worlds.grid import Bounds, Frame
from planner.worlds.images import plausible
from planner.worlds.world import CELL_SIZE, FARTHEST, MAX_CELLS, is_cell_size, is_coordinate

GEO_SUFFIXES = (".tif", ".tiff", ".asc")
"""Rasters that are read with rasterio."""
SUFFIXES = (".npy", ".csv", *GEO_SUFFIXES)
"""Rasters that can be read."""
SQUARE = 1e-6
"""Relative difference of a pixel's sides up to which it counts as square."""
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


def read_raster(path: Path, cell_size: float | None = None, smooth: bool = False) -> Raster:
    """The raster in a `.npy`, `.csv`, `.tif` or `.asc` file.

    Pixels in degrees or not square are resampled to square metres: the nearest value, or linear if `smooth` (for
    elevations). The new pixel is the largest part of `cell_size` that does not exceed the shorter side of the old one
    (or that side). Raises MapError for what cannot be read, and when rasterio is needed and not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MapError(f"unknown raster format {path.suffix!r}", source=path, expected=" ".join(SUFFIXES))
    check_file(path, "a raster")
    if suffix in GEO_SUFFIXES:
        return _read_geo(path, cell_size, smooth)
    values = read_npy(path, MAX_CELLS) if suffix == ".npy" else read_csv_grid(path, MAX_CELLS)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiub":
        raise MapError(f"holds {values.dtype} {values.shape}", source=path, expected="numbers [H, W]")
    with np.errstate(over="ignore"):  # long doubles
        return Raster(values.astype(np.float64), None, None, str(path))


def degree_sides(latitude: float) -> tuple[float, float]:
    """Metres that a degree of latitude and one of longitude span at `latitude` degrees (WGS 84, within 1 m)."""
    angle = math.radians(latitude)
    north = 111132.954 - 559.822 * math.cos(2 * angle) + 1.175 * math.cos(4 * angle)
    east = 111412.84 * math.cos(angle) - 93.5 * math.cos(3 * angle) + 0.118 * math.cos(5 * angle)
    return north, east


def square_metres(
    values: NDArray[np.float64], sides: tuple[float, float], cell_size: float | None, smooth: bool, source: str = ""
) -> tuple[NDArray[np.float64], float]:
    """Pixels of `sides` (height, width) metres as square ones: values float64 `[H', W']` and the new side in metres.

    The upper-left corner stays; what does not fill a pixel at the far edges is dropped. Linear interpolation gives
    NaN wherever a neighbour is NaN. A MapError if the result would be too large.
    """
    shortest = min(sides)
    side = shortest
    if cell_size is not None and cell_size > shortest:
        side = cell_size / math.ceil(cell_size / shortest - SQUARE)
    height, width = (math.floor(n * length / side + SQUARE) for n, length in zip(values.shape, sides, strict=True))
    if height < 1 or width < 1 or height * width > MAX_CELLS:
        problem = f"{height} x {width} pixels after resampling to squares of {side:g} m"
        raise MapError(problem, source=source, expected=f"1 to {MAX_CELLS} pixels")
    rows = (np.arange(height) + 0.5) * side / sides[0] - 0.5
    cols = (np.arange(width) + 0.5) * side / sides[1] - 0.5
    if smooth:
        grid = np.meshgrid(rows, cols, indexing="ij")
        return ndimage.map_coordinates(values, grid, order=1, mode="nearest"), side
    near = [np.clip(np.rint(at).astype(int), 0, n - 1) for at, n in zip((rows, cols), values.shape, strict=True)]
    return values[np.ix_(*near)], side


def _read_geo(path: Path, cell_size: float | None, smooth: bool) -> Raster:
    rasterio = rasterio_for(f"reading {path.suffix}", path, fix=", or convert to .npy")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with rasterio.open(path, driver="AAIGrid" if path.suffix.lower() == ".asc" else "GTiff") as data:
                plausible(data.width * data.height, path)
                values = _first_band(data, path)
                transform, crs = data.transform, data.crs
    except MapError:
        raise
    except Exception as error:  # GDAL's errors share no base class with rasterio's own
        raise MapError(f"cannot be read as a raster ({error})", source=path, expected="GeoTIFF") from error
    return _on_the_ground(values, transform, crs, path, cell_size, smooth)


def _first_band(data: Any, path: Path) -> NDArray[np.float64]:
    if data.count != 1 or np.dtype(data.dtypes[0]).kind not in "fiu":
        raise MapError(f"{data.count} bands of {data.dtypes[0]}", source=path, expected="one band of real numbers")
    band = data.read(1, masked=True)
    return np.where(np.ma.getmaskarray(band), np.nan, np.ma.getdata(band).astype(np.float64))


def _on_the_ground(
    values: NDArray[np.float64], transform: Any, crs: Any, path: Path, cell_size: float | None, smooth: bool
) -> Raster:
    if transform.is_identity:
        return Raster(values, None, None, str(path))
    if transform.b or transform.d or not transform.a > 0 or not np.isfinite(transform).all():
        raise MapError("is rotated or mirrored", source=path, fix="warp it north-up first (gdalwarp)")
    if transform.e > 0:  # stored south-up
        values = values[::-1]
    high, wide = abs(transform.e), transform.a
    bottom = min(transform.f, transform.f + values.shape[0] * transform.e)
    bounds = (transform.c, bottom, transform.c + values.shape[1] * wide, bottom + values.shape[0] * high)
    sides, corner = (high, wide), bounds[:2]
    if crs is not None and crs.is_geographic:
        return degree_raster(values, bounds, crs.to_string(), str(path), cell_size, smooth)
    if crs is None or not crs.is_projected:
        return ground_raster(values, sides, corner, bounds, str(path), cell_size, smooth)
    unit = float(crs.linear_units_factor[1])
    place = Georeference(crs.to_string(), scale=(1 / unit, 1 / unit))
    sides, corner = (high * unit, wide * unit), (corner[0] * unit, corner[1] * unit)
    raster = ground_raster(values, sides, corner, bounds, str(path), cell_size, smooth, place)
    return replace(raster, notes=(*raster.notes, *_true_metres(raster, place)))


def _true_metres(raster: Raster, place: Georeference) -> tuple[str, ...]:
    """A note where a metre of the CRS is more than 1 % off on the ground in the middle of the map, as in EPSG:3857."""
    assert raster.frame is not None
    rows, cols = np.array(raster.frame.shape) / 2
    (west, south), (east, north) = place.to_lonlat(raster.frame.at([rows, rows], [cols - 0.5, cols + 0.5]))
    up, across = degree_sides((south + north) / 2)
    ratio = math.hypot((east - west) * across, (north - south) * up) / raster.frame.size
    if abs(ratio - 1) <= TRUE:
        return ()
    return (f"a metre of {place.crs[:40]} is {ratio:.3g} m on the ground here: warp it to UTM (gdalwarp -t_srs)",)


def degree_raster(
    values: NDArray[np.float64], bounds: Bounds, crs: str, source: str, cell_size: float | None, smooth: bool
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
    raster = ground_raster(values, sides, (0.0, 0.0), bounds, source, cell_size, smooth, place)
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
    smooth: bool,
    georeference: Georeference | None = None,
) -> Raster:
    """A raster with pixels of `sides` (height, width) metres and its lower-left `corner`, made square if need be."""
    if not all(map(is_cell_size, sides)):
        raise MapError(f"pixels of {sides[0]:g} x {sides[1]:g} m", source=source, expected=CELL_SIZE)
    if not all(map(is_coordinate, corner)):
        problem = f"its lower-left corner is {corner[0]:g}, {corner[1]:g}"
        raise MapError(problem, source=source, expected=f"metres, none beyond {FARTHEST:g}")
    notes: tuple[str, ...] = ()
    side = sides[0]
    if abs(sides[1] / sides[0] - 1) > SQUARE:
        old, top = values.shape, corner[1] + values.shape[0] * sides[0]
        values, side = square_metres(values, sides, cell_size, smooth, source)
        corner = (corner[0], top - values.shape[0] * side)
        notes = (
            f"{old[0]} x {old[1]} pixels of {sides[0]:.4g} x {sides[1]:.4g} m resampled to "
            f"{values.shape[0]} x {values.shape[1]} of {side:.4g} m",
        )
    height, width = values.shape
    return Raster(values, Frame((height, width), side, (*corner, 0.0)), bounds, source, notes, georeference)
