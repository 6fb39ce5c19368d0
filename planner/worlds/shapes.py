"""Shapes on the pixels of a map: points with a falloff (CSV), the inside of polygons, a map laid over another."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import check_size
from planner.worlds.georeference import WGS84, Georeference
from planner.worlds.grid import Frame
from planner.worlds.quantities import THREAT, Quantity
from planner.worlds.ros_map import RosMap
from planner.worlds.sources import short_name
from planner.worlds.world import FARTHEST, is_coordinate

CUT_OFF = 3.0
"""Radii after which a Gaussian falloff ends: far cells stay safe (p = 0) instead of nearly so."""
MAX_BYTES = 2**24
"""Largest CSV or GeoJSON file that is read (16 MiB)."""
MAX_POINTS, MAX_CORNERS = 2**17, 2**18
"""Most points in a CSV file, and most corners of all polygons in a GeoJSON file: each is drawn on its own."""
IN_METRES = "reproject it into metres of the map's frame (ogr2ogr -t_srs, or QGIS: export in the map's CRS)"
X, Y, STRENGTH = ("x", "x_m"), ("y", "y_m"), "strength"
"""Column names of a points file; the third may also be the name of what it says."""
NAMES = ("name", "id")
LONGITUDE, LATITUDE = ("lon", "lng", "long", "longitude"), ("lat", "latitude")
"""Those of one in degrees, for maps that know where they lie."""

Merge = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def read_points(
    path: Path, georeference: Georeference | None = None, of: Quantity = THREAT
) -> tuple[NDArray[np.float64], list[tuple[str, str]]]:
    """(x, y, strength) of every point, float64 `[points, 3]`: metres, metres, and p (or what it is `of`).

    And of each its name, in a column `name` or `id` if there is one, and where it stands.

    A header may name the columns x (or x_m), y (or y_m) and strength (or p), in any order and among others; on a
    georeferenced map also longitude and latitude (lon, lat). Without those names, or without a header, the file has
    exactly the three columns x, y, strength. MapError names line and value.
    """
    rows = [(number, row) for number, row in _csv_rows(path) if any(field.strip() for field in row)]
    if len(rows) > MAX_POINTS:
        raise MapError(f"{len(rows)} lines", source=path, expected=f"at most {MAX_POINTS} points", fix="use a raster")
    if not rows:
        raise MapError("is empty", source=path, expected="lines x, y, strength")
    columns, body, place, called = (0, 1, 2), rows, None, None
    if _is_header(rows[0][1]):
        names = [name.strip().lower() for name in rows[0][1]]
        place = georeference if set(names) & {*LONGITUDE, *LATITUDE} else None
        columns, body = _columns(names, path, of, degrees=place is not None), rows[1:]
        called = next((names.index(name) for name in NAMES if name in names), None)
    elif len(rows[0][1]) != 3:
        raise MapError(f"line {rows[0][0]} has {len(rows[0][1])} values", source=path, expected="x, y, strength")
    if not body:
        raise MapError("has a header and no points", source=path, expected="lines x, y, strength")
    width = len(rows[0][1])
    points = np.array([_point(number, row, columns, width, path, of) for number, row in body], dtype=np.float64)
    if place is not None:
        if not (np.abs(points[:, :2]) <= (180, 90)).all():
            line = body[int(np.argmax((np.abs(points[:, :2]) > (180, 90)).any(axis=1)))]
            problem = f"line {line[0]}: {', '.join(line[1])[:60]!r} is no longitude and latitude"
            raise MapError(problem, source=path, expected="degrees, -180..180 and -90..90")
        points[:, :2] = place.from_crs(points[:, :2], WGS84)
    return points, [("" if called is None else short_name(row[called]), f"line {n} of {path.name}") for n, row in body]


def _csv_rows(path: Path) -> list[tuple[int, list[str]]]:
    check_size(path, MAX_BYTES, MapError, "lines x, y, strength")
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            reader = csv.reader(lines)
            return [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected="lines x, y, strength") from error


def _is_header(row: list[str]) -> bool:
    def numeric(text: str) -> bool:
        try:
            float(text)
        except ValueError:
            return False
        return True

    return not any(numeric(field) for field in row)


def _columns(names: list[str], path: Path, of: Quantity, degrees: bool) -> tuple[int, int, int]:
    if not degrees and {*LONGITUDE, *LATITUDE} & set(names):
        raise MapError(
            f"has the columns {', '.join(names)[:80]}", source=path, expected="x, y in metres", fix=IN_METRES
        )
    strength = (STRENGTH, of.name)
    wanted = (LONGITUDE, LATITUDE, strength) if degrees else (X, Y, strength)
    found = [next((names.index(name) for name in options if name in names), None) for options in wanted]
    if None not in found:
        return tuple(found)  # type: ignore[return-value]
    if len(names) == 3 and found == [None, None, None]:
        return (0, 1, 2)
    expected = "longitude, latitude and strength" if degrees else "x, y and strength"
    raise MapError(f"has the columns {', '.join(names)[:80]}", source=path, expected=expected)


def _point(
    number: int, row: list[str], columns: tuple[int, int, int], width: int, path: Path, of: Quantity
) -> list[float]:
    if len(row) != width:
        raise MapError(f"line {number} has {len(row)} values", source=path, expected=f"{width} as above")
    values = []
    for name, column in zip(("x", "y", "strength"), columns, strict=True):
        try:
            values.append(float(row[column]))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise MapError(f"line {number}: {name} is {row[column][:40]!r}", source=path, expected="a finite number")
        if not is_coordinate(values[-1]):
            problem = f"line {number}: {name} is {row[column][:40]!r}"
            raise MapError(problem, source=path, expected=f"metres, none beyond {FARTHEST:g}")
    if not of.ok(values[2]):
        raise MapError(f"line {number}: strength is {values[2]:g}", source=path, expected=of.expected)
    return values


def point_threat(points: NDArray[np.float64], kind: str, radius: float, frame: Frame, merge: Merge) -> NDArray:
    """Threat float64 `[H, W]` of points (x, y, strength) `[points, 3]`, as of `point_spreads`."""
    threat = np.zeros(frame.shape[0] * frame.shape[1])
    for at, own in point_spreads(points, kind, radius, frame):
        threat[at] = merge(threat[at], own)
    return threat.reshape(frame.shape)


def point_spreads(
    points: NDArray[np.float64], kind: str, radius: float, frame: Frame
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Of every point (x, y, strength) `[points, 3]`: pixels that it reaches, int64 `[n]`, and p at their centres.

    disc: strength within `radius` metres; gaussian: strength * exp(-d**2 / (2 * radius**2)), 0 beyond CUT_OFF radii.
    """
    height, width = frame.shape
    reach = radius if kind == "disc" else CUT_OFF * radius
    for (across, up), strength in zip(frame.local(points[:, :2]) / frame.size, points[:, 2], strict=True):
        row, col, span = height - up - 0.5, across - 0.5, reach / frame.size
        top, bottom = (int(np.clip(edge, 0, height)) for edge in (math.ceil(row - span), math.floor(row + span) + 1))
        left, right = (int(np.clip(edge, 0, width)) for edge in (math.ceil(col - span), math.floor(col + span) + 1))
        squared = (np.arange(top, bottom)[:, None] - row) ** 2 + (np.arange(left, right)[None, :] - col) ** 2
        shape = np.ones(squared.shape) if kind == "disc" else np.exp(-squared * (frame.size / radius) ** 2 / 2)
        rows, cols = np.nonzero(squared <= span**2)
        yield (rows + top) * width + cols + left, strength * shape[rows, cols]


def misplaced(points: NDArray[np.float64], frame: Frame) -> tuple[str, str] | None:
    """Why shapes at `points` (x, y) `[points, 2]` that threaten no pixel are no mistake (None), or which, and the fix.

    It is one if they lie off the map, and if they look like degrees: within their range, to tenths of a millimetre.
    """
    height, width = frame.shape
    local = frame.local(points) / frame.size
    off = bool((local.max(axis=0) < 0).any() or (local.min(axis=0) > (width, height)).any())
    finer = bool((np.abs(points - np.round(points, 3)) > 1e-9).any())
    degrees = bool((np.abs(points) <= (180, 90)).all()) and finer
    if not off and not degrees:
        return None
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    x, y, _ = frame.origin
    problem = f"x {west:.10g} .. {east:.10g}, y {south:.10g} .. {north:.10g} "
    problem += "look like longitude and latitude" if degrees else "lie off the map"
    problem += f", {width * frame.size:g} x {height * frame.size:g} m from ({x:.10g}, {y:.10g})"
    return problem, IN_METRES if degrees else "give metres in the map's frame (its origin says where it lies)"


def values_over(layer: RosMap, frame: Frame) -> NDArray[np.int16]:
    """Values of a ROS map laid over the pixels of `frame` by both origins and resolutions, int16 `[H, W]`.

    A pixel takes the layer's pixel under its centre, or the largest of those whose centre it holds; -1 (unknown) where
    the layer does not reach.
    """
    at = layer.frame.pixels(frame.centres())
    held = layer.frame.holds(at)
    value = np.full(frame.shape, -1, dtype=np.int16)
    value[held] = layer.values[tuple(at[held].T)]
    if layer.frame.size < frame.size:
        under = frame.pixels(layer.frame.centres())
        held = frame.holds(under)
        np.maximum.at(value, tuple(under[held].T), layer.values[held])
    return value


def inside(rings: list[NDArray[np.float64]], frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: pixels whose centre lies in the polygon of `rings` (even-odd rule, so holes are out).

    Row by row, every edge flips all pixels to the right of where it crosses the row. Cost O(edges * H + H * W).
    """
    height, width = frame.shape
    flips = np.zeros((height, width + 1), dtype=np.uint8)
    for ring in rings:
        corners = frame.local(ring) / frame.size
        corners[:, 1] = height - corners[:, 1]  # downwards, in pixels: a row's centre is at row + 0.5
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            first, last = (int(np.clip(math.ceil(y - 0.5), 0, height)) for y in sorted((y0, y1)))
            rows = np.arange(first, last)
            crossing = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0) if len(rows) else rows
            flips[rows, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)] ^= 1
    return (np.bitwise_xor.accumulate(flips, axis=1)[:, :width]).astype(bool)
