"""Shapes on the pixels of a map: points with a falloff, the inside of polygons, a map laid over another."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from planner.worlds.degrees import Patch, fine
from planner.worlds.georeference import Georeference
from planner.worlds.grid import Frame
from planner.worlds.ros_map import RosMap

CUT_OFF = 3.0
"""Radii after which a Gaussian falloff ends: far cells stay safe (p = 0) instead of nearly so."""
MAX_BYTES = 2**24
"""Largest CSV or GeoJSON file that is read (16 MiB)."""
MAX_CORNERS = 2**18
"""Most corners of all polygons in a file: each edge is drawn on its own."""
IN_METRES = "reproject it into metres of the map's frame (ogr2ogr -t_srs, or QGIS: export in the map's CRS)"
Merge = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


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


def misplaced(
    points: NDArray[np.float64], frame: Frame, georeference: Georeference | None = None
) -> tuple[str, str] | None:
    """Why shapes at `points` (x, y) `[points, 2]` that threaten no pixel are no mistake (None), or which, and the fix.

    It is one if they lie off the map, and if they look like degrees: within their range, to tenths of a millimetre.
    """
    height, width = frame.shape
    local = frame.local(points) / frame.size
    off = bool((local.max(axis=0) < 0).any() or (local.min(axis=0) > (width, height)).any())
    orders = [bool((np.abs(places) <= (180, 90)).all()) and fine(points) for places in (points, points[:, ::-1])]
    if not off and not any(orders):
        return None
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    x, y, _ = frame.origin
    problem = f"x {west:.10g} .. {east:.10g}, y {south:.10g} .. {north:.10g} "
    if not any(orders):
        problem += f"lie off the map, {width * frame.size:g} x {height * frame.size:g} m from ({x:.10g}, {y:.10g})"
        return problem, "give metres in the map's frame (its origin says where it lies)"
    problem += f"look like {'longitude and latitude' if orders[0] else 'latitude and longitude, latitude first'}"
    if georeference is None:
        problem += f", {width * frame.size:g} x {height * frame.size:g} m from ({x:.10g}, {y:.10g})"
        return problem, IN_METRES if orders[0] else f"swap the two, and {IN_METRES}"
    patch = Patch.of(frame, georeference)
    problem += f", and the map lies at {patch.words}"
    near = [patch.is_near(points), patch.is_near(points[:, ::-1])]
    if not any(near):
        return problem, "check the coordinates: do they belong to this map?"
    return problem, f"name the columns {' and '.join(('lon', 'lat') if near[0] else ('lat', 'lon'))}"


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
