"""Position of a map: its frame in metres, and its coordinate reference system on the Earth."""

from __future__ import annotations

import math
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import MapError
from planner.files import library_errors

WGS84 = "EPSG:4326"
"""Longitude and latitude, always in this order: GeoJSON, KML, GPS."""
PLAIN_DEGREES = re.compile(r"CRS:?84$|EPSG:.*\b4326$", re.IGNORECASE)
"""Names of WGS 84."""
TURN = 360.0
"""Degrees of longitude around the Earth: places that differ by a multiple are the same."""
RANGE = np.array([TURN, 90.0])
"""Largest longitude and latitude accepted: 181 and -181 are valid, and some files count from 0 to 360."""
UTM_LATITUDES, UTM_REACH = (-80.0, 84.0), 6.0
"""Latitudes of UTM, and the largest distance in degrees from a zone's central meridian: metres are 0.5 % off there."""
LONGEST = 2**14
"""Most characters of a CRS: WKT takes about two thousand."""
HOW_TO_GIVE_ONE = (
    "give a GeoTIFF with a CRS, or `datum: {latitude: ..., longitude: ...}`, the place of the map's (0, 0), "
    "in the ROS map or the scenario"
)


@dataclass(frozen=True)
class Georeference:
    """Map from metres of the map's frame to coordinates: crs = origin + metres * scale, x (or longitude) first.

    Attributes:
        crs: the coordinate reference system as text: "EPSG:32633", a PROJ string or WKT.
        origin: the frame's (0, 0) in the CRS, in its units.
        scale: units of the CRS per metre of the frame, along x and y: (1, 1) if the CRS is in metres.
    """

    crs: str
    origin: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)

    def to_crs(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (x, y) `[..., 2]` of the map's frame, in metres, as coordinates of the CRS."""
        return np.asarray(points, dtype=np.float64) * self.scale + self.origin

    def to_lonlat(self, points: ArrayLike, file: str = "", about: float | None = None) -> NDArray[np.float64]:
        """Points of the map's frame as (longitude, latitude) in degrees, WGS 84.

        Longitudes are within half a turn of `about`, so that neighbours stay neighbours: across longitude 180 they
        continue with 180.1. `principal` maps them back.

        Args:
            points: (x, y) `[..., 2]`, metres.
            file: for messages.
            about: longitude; None: that of the first point.

        Raises:
            MapError: the CRS or a point cannot be transformed.
        """
        found = reproject(self.to_crs(points), self.crs, WGS84, file)
        if found.size:
            # PROJ returns -180..180: without this a map across longitude 180 would be torn apart.
            found[..., 0] = near(found[..., 0], found.flat[0] if about is None else about, TURN)
        return found

    def from_crs(self, points: ArrayLike, crs: str, file: str = "") -> NDArray[np.float64]:
        """Coordinates `[..., 2]` of the CRS `crs` as metres of the map's frame; `file`: for messages.

        Where x wraps around the Earth, longitudes that continue across 180 give x that continues.

        Raises:
            MapError: the CRS or a point cannot be transformed.
        """
        found, (turn, start) = reproject(points, crs, self.crs, file), turn_of(self.crs)
        if turn and is_degrees(crs) and crs != self.crs:
            expected = start + np.asarray(points, dtype=np.float64)[..., 0] * turn / TURN
            found[..., 0] = near(found[..., 0], expected, turn)
        return (found - self.origin) / self.scale


def near(values: ArrayLike, middle: float | NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """The values shifted by whole turns to within half a turn of `middle`; values exactly half a turn away stay."""
    given = np.asarray(values, dtype=np.float64)
    return given - turn * np.round((given - middle) / turn)


def principal(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) `[..., 2]` with longitudes in -180..180."""
    return np.stack([near(places[..., 0], 0.0, TURN), places[..., 1]], axis=-1)


def is_degrees(crs: str) -> bool:
    """True for the name or text of a CRS of longitudes and latitudes."""
    if PLAIN_DEGREES.search(crs):
        return True
    import rasterio.crs

    try:
        with rasterio.Env():  # keeps GDAL's errors off the screen
            return bool(rasterio.crs.CRS.from_user_input(crs).is_geographic)
    except rasterio.errors.CRSError:  # users of the CRS report that
        return False


@cache
def turn_of(crs: str) -> tuple[float, float]:
    """(units of x around the Earth, x at longitude 0) of a CRS whose x wraps as longitudes do; else (0, 0).

    It wraps for degrees, and for cylindrical projections such as Mercator's.
    """
    if is_degrees(crs):
        return TURN, 0.0
    try:
        # x is periodic if a degree of longitude is as long at 60 degrees north as at the equator.
        (start, _), (one, _), (north, _) = reproject([(0, 0), (1, 0), (1, 60)], WGS84, crs).tolist()
    except MapError:  # the CRS does not cover these points
        return 0.0, 0.0
    return (TURN * (one - start), start) if abs(north - one) <= 1e-9 * abs(one - start) else (0.0, 0.0)


def around(latitude: float, longitude: float) -> Georeference:
    """Metres east and north of a place, by a transverse Mercator projection around it (error 1e-6 within 9 km).

    Args:
        latitude, longitude: degrees, WGS 84.
    """
    longitude = float(near(longitude, 0.0, TURN))
    words = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    return Georeference(words)


def reproject(points: ArrayLike, source: str, target: str, file: str = "") -> NDArray[np.float64]:
    """Transform coordinates between CRSs, x or longitude first.

    Args:
        points: `[..., 2]`, in the CRS `source`.
        source, target: CRSs as text.
        file: for messages.

    Returns:
        float64 `[..., 2]`, in the CRS `target`.

    Raises:
        MapError: PROJ does not know a CRS, a point lies outside of it.
    """
    given = np.asarray(points, dtype=np.float64)
    if source == target or not given.size:
        return given
    import rasterio.warp

    with no_way(source, target, file), rasterio.Env():
        found = rasterio.warp.transform(source, target, *given.reshape(-1, 2).T.tolist())
    moved = np.stack(found, axis=-1).reshape(given.shape)
    if not np.isfinite(moved).all():
        wrong = given.reshape(-1, 2)[~np.isfinite(moved.reshape(-1, 2)).all(axis=1)][0].tolist()
        raise MapError(
            f"{wrong} of the CRS {source[:60]!r} is no place in {target[:60]!r}", source=file, expected="points of both"
        )
    return moved


def no_way(source: object, target: str, file: str = "") -> AbstractContextManager[None]:
    """Context in which PROJ's errors about a transformation become MapErrors; `file`: for messages."""
    problem = f"no way from the CRS {str(source)[:60]!r} to {target[:60]!r}"
    return library_errors(problem, file, "a CRS that PROJ knows, and places where it holds")


def degree_sides(latitude: float) -> tuple[float, float]:
    """Metres per degree of latitude and of longitude at `latitude` degrees (WGS 84, within 1 m)."""
    angle = math.radians(latitude)
    north = 111132.954 - 559.822 * math.cos(2 * angle) + 1.175 * math.cos(4 * angle)
    east = 111412.84 * math.cos(angle) - 93.5 * math.cos(3 * angle) + 0.118 * math.cos(5 * angle)
    return north, east


def utm_zone(west: float, south: float, east: float, north: float) -> tuple[str, str] | None:
    """The UTM zone (WGS 84) of the middle of a box in degrees: (name, CRS); None if the box reaches out of it."""
    longitude = ((west + east) / 2 + 180) % 360
    zone = int(longitude // 6)
    # By the far edge: metres get wrong with the distance from the central meridian.
    off_centre = abs(longitude - 6 * zone - 3) + (east - west) / 2
    if south < UTM_LATITUDES[0] or north > UTM_LATITUDES[1] or off_centre > UTM_REACH:
        return None
    is_north = south + north >= 0
    words = f"UTM zone {zone + 1} {'north' if is_north else 'south'}"
    return words, f"EPSG:{(32601 if is_north else 32701) + zone}"


def same_crs(one: str, other: str) -> bool:
    """True if both texts name the same CRS."""
    if one == other:
        return True
    from rasterio.crs import CRS

    return bool(CRS.from_user_input(one) == CRS.from_user_input(other))


Pose = tuple[float, float, float]
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Frame:
    """Position of a grid on the ground.

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
        """(x, y) in metres, map frame, of positions in pixels from the upper-left corner; centres are at .5.

        Args:
            rows, cols: `[...]`, down and to the right.

        Returns:
            float64 `[..., 2]`.
        """
        across, up = np.asarray(cols) * self.size, (self.shape[0] - np.asarray(rows)) * self.size
        east, north, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack([east + cos * across - sin * up, north + sin * across + cos * up], axis=-1)

    def local(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (x, y) `[..., 2]` of the map's frame as metres (to the right, up) from the lower-left corner."""
        east, north, yaw = self.origin
        moved = np.asarray(points, dtype=np.float64) - (east, north)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.stack(
            [cos * moved[..., 0] + sin * moved[..., 1], -sin * moved[..., 0] + cos * moved[..., 1]], axis=-1
        )

    def pixels(self, points: ArrayLike) -> NDArray[np.int64]:
        """(row, col) int64 `[..., 2]` of the pixels that hold points (x, y) in metres; possibly off the grid."""
        # Clipped: points far off would overflow the conversion to integers.
        local = np.clip(np.floor(self.local(points) / self.size), -(2.0**53), 2.0**53)
        return np.stack([self.shape[0] - 1 - local[..., 1], local[..., 0]], axis=-1).astype(np.int64)

    def holds(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """bool `[...]`: whether (row, col) `[..., 2]` are on the grid."""
        return np.all((pixels >= 0) & (pixels < self.shape), axis=-1)
