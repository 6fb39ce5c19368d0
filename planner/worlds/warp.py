"""Rasters laid over other grids by their places on the Earth, as GDAL warps them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.worlds.georeference import (
    TURN,
    WGS84,
    Georeference,
    near,
    no_way,
    rasterio_for,
    reproject,
    same_crs,
    turn_of,
)
from planner.worlds.grid import Bounds, Frame

How = Literal["average", "sum", "bilinear", "nearest"]
"""What a new pixel takes: the mean of all that it covers (probabilities), their sum, of each the part that it covers
(amounts), the linear value at its centre (elevations), or the pixel under its centre (classes). What has no data is
always the nearest's to say."""
WORDS: dict[How, str] = {"average": "averaged", "sum": "summed up", "bilinear": "linear", "nearest": "nearest"}
STRIP = 32
"""Columns that are warped at a time: GDAL takes a stretch of a row for straight, up to an eighth of a pixel off."""
LATTICE = 21
"""Places a side of a raster that control points place, by which its edges are found."""
SQUARE = 1e-6
"""Relative difference of a pixel's sides up to which it counts as square."""


class Band(NamedTuple):
    """A raster as it is in its file, north up.

    Attributes:
        values: float64 `[H, W]`, physical values; NaN = no data.
        bounds: its edges in its CRS; None where the file does not say. crs: None where it names none.
        points: ground control points that its pixels are placed by; (): they fill the bounds evenly.
        notes: what reading did that a user should know. voids: undeclared ones, in words.
    """

    values: NDArray[np.float64]
    bounds: Bounds | None
    crs: Any
    points: tuple[Any, ...] = ()
    notes: tuple[str, ...] = ()
    voids: str = ""


def side_of_pixels(shortest: float, cell_size: float | None) -> float:
    """The largest part of `cell_size` that does not exceed the `shortest` side of a pixel; metres."""
    if cell_size is None or cell_size <= shortest:
        return shortest
    return cell_size / math.ceil(cell_size / shortest - SQUARE)


def affine(frame: Frame, place: Georeference) -> tuple[float, ...]:
    """(a, b, c, d, e, f): a pixel's (col, row) becomes x = a col + b row + c, y = d col + e row + f, in the CRS."""
    corner, right, down = place.to_crs(frame.at([0, 0, 1], [0, 1, 0]))
    (a, d), (b, e) = right - corner, down - corner
    return tuple(map(float, (a, b, corner[0], d, e, corner[1])))


def edges_in(bounds: Bounds, crs: Any, target: str, source: str) -> Bounds:
    """The rectangle (left, bottom, right, top) of the CRS `target` around `bounds`. Raises MapError."""
    rasterio = rasterio_for("another coordinate reference system", source)
    with no_way(crs, target, source):
        edges: Bounds = rasterio.warp.transform_bounds(crs, target, *bounds)
        if not np.isfinite(edges).all():
            raise ValueError("its edges are nowhere in it")
    return edges


def span(
    points: Sequence[Any], shape: tuple[int, int], crs: Any, target: str, source: str
) -> tuple[Bounds, tuple[float, float]]:
    """Where a raster `shape` that ground control points place lies in the CRS `target`, in its units.

    Returns its edges (left, bottom, right, top), and the mean sides of a pixel (height, width). Raises MapError.
    """
    rasterio = rasterio_for("another coordinate reference system", source)
    rows, cols = (ends.ravel() for ends in np.meshgrid(*(np.linspace(0, n, LATTICE) for n in shape), indexing="ij"))
    with no_way(crs, target, source), rasterio.transform.GCPTransformer(points) as places:
        found = np.stack(places.xy(rows.tolist(), cols.tolist(), offset="ul"), axis=-1)
    found = reproject(found, crs.to_string(), target, source)
    down, right, _ = np.linalg.lstsq(np.stack([rows, cols, np.ones(rows.shape)], axis=-1), found, rcond=None)[0]
    (left, bottom), (east, top) = found.min(axis=0).tolist(), found.max(axis=0).tolist()
    return (left, bottom, east, top), (float(np.hypot(*down)), float(np.hypot(*right)))


def _off_the_seam(band: Band, place: Georeference, source: str) -> Band:
    """A raster whose x goes on where that of its CRS comes round, in a CRS that comes round elsewhere; else itself.

    GDAL asks such a raster for places on the other side alone, but where it is one of degrees without control points.
    """
    assert band.bounds is not None
    crs, points = band.crs, band.points
    turn = turn_of(crs.to_string())[0]
    if not turn or same_crs(crs.to_string(), place.crs) or (crs.is_geographic and not points):
        return band
    text = crs.to_dict(projjson=True)
    text = text.get("source_crs", text)
    origins = [item for item in text.get("conversion", {}).get("parameters", []) if "ongitude" in item["name"]]
    middle = 0.0 if crs.is_geographic else sum(item["value"] for item in origins)
    middle = float(reproject([middle, 0.0], WGS84, crs.to_string(), source)[0])
    if max(abs(band.bounds[0] - middle), abs(band.bounds[2] - middle)) <= turn / 2 or len(origins) > 1:
        return band
    rasterio, moved = rasterio_for("another coordinate reference system", source), -turn / 2
    if crs.is_geographic:
        about = (band.bounds[0] + band.bounds[2]) / 2
        crs = rasterio.crs.CRS.from_string(f"+proj=longlat +datum=WGS84 +lon_wrap={about:.6f} +no_defs +type=crs")
        found = reproject([[point.x, point.y] for point in points], band.crs.to_string(), WGS84, source)
        found[:, 0] = near(found[:, 0], about, TURN)
    else:
        for item in origins:
            item["value"] = float(near(item["value"] + TURN / 2, 0.0, TURN))
        text.pop("id", None)
        text["name"] = "about its own middle"  # else GDAL takes it for the CRS of the old name
        crs = rasterio.crs.CRS.from_user_input(json.dumps(text))
        found = np.array([[point.x + moved, point.y] for point in points])
    points = tuple(
        type(point)(point.row, point.col, *xy, point.z) for point, xy in zip(points, found.tolist(), strict=True)
    )
    left, bottom, right, top = band.bounds
    return band._replace(crs=crs, points=points, bounds=(left + moved, bottom, right + moved, top))


def lay_over(band: Band, frame: Frame, place: Georeference, how: How, source: str) -> NDArray[np.float64]:
    """The raster on the pixels of `frame`, float64 `[H, W]`; NaN where it does not reach, or has no data.

    Places are PROJ's own within 0.02 pixels of the file (0.06 where those have kilometres). XSCALE: GDAL would
    guess how much coarser the new pixels are, strip by strip, and blur. Raises MapError for a CRS with no way from it.
    """
    rasterio = rasterio_for("another coordinate reference system", source)
    band = _off_the_seam(band, place, source)
    assert band.bounds is not None
    left, bottom, right, top = band.bounds
    rows, cols = band.values.shape
    a, b, c, d, e, f = affine(frame, place)
    laid = np.empty(frame.shape)
    evenly = rasterio.Affine((right - left) / cols, 0, left, 0, (bottom - top) / rows, top)
    keys = {
        **({"gcps": band.points} if band.points else {"src_transform": evenly}),
        "src_crs": band.crs, "src_nodata": math.nan, "dst_crs": place.crs, "dst_nodata": math.nan,
    }  # fmt: skip
    for start in range(0, frame.shape[1], STRIP):
        keys["dst_transform"] = rasterio.Affine(a, b, c + a * start, d, e, f + d * start)
        strip = laid[:, start : start + STRIP]
        for method in dict.fromkeys((how, "nearest")):
            part = np.full(strip.shape, math.nan)
            keys["resampling"] = rasterio.warp.Resampling[method]
            with no_way(band.crs, place.crs, source):
                rasterio.warp.reproject(band.values, part, XSCALE=1, YSCALE=1, **keys)
            if method == how:
                strip[:] = part
            else:
                strip[np.isnan(part)] = math.nan
    return laid
