"""Where a map lies on the Earth: its coordinate reference system, and how the map's own metres sit in it."""

from __future__ import annotations

import math
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.errors import MapError
from planner.files import foreign_errors

WGS84 = "EPSG:4326"
"""Longitude and latitude, in this order everywhere in this program: GeoJSON, KML, GPS."""
PLAIN_DEGREES = re.compile(r"CRS:?84$|EPSG:.*\b4326$", re.IGNORECASE)
"""Names of WGS 84."""
TURN = 360.0
"""Degrees of longitude in a turn of the Earth: places a whole turn apart are one."""
RANGE = np.array([TURN, 90.0])
"""Largest longitude and latitude that are read: 181 and -181 are places too, and some files count from 0 to 360."""
UTM_LATITUDES, UTM_REACH = (-80.0, 84.0), 6.0
"""Where UTM holds, and how many degrees from its central meridian a zone is used here: metres are 0.5 % off there."""
LONGEST = 2**14
"""Most characters of a CRS: WKT takes some two thousand."""
HOW_TO_GIVE_ONE = (
    "give a GeoTIFF with a CRS, or `datum: {latitude: ..., longitude: ...}`, the place of the map's (0, 0), "
    "in the ROS map or the scenario"
)


@dataclass(frozen=True)
class Georeference:
    """How metres of the map's frame become coordinates: crs = origin + metres * scale, x (or longitude) first.

    Attributes:
        crs: the coordinate reference system as text: "EPSG:32633", PROJ's words or WKT.
        origin: the frame's (0, 0) in the CRS, in its units.
        scale: units of the CRS a metre of the frame, along x and y: (1, 1) where the CRS is in metres.
    """

    crs: str
    origin: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)

    def to_crs(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (x, y) `[..., 2]` of the map's frame, in metres, as coordinates of the CRS."""
        return np.asarray(points, dtype=np.float64) * self.scale + self.origin

    def to_lonlat(self, points: ArrayLike, file: str = "", about: float | None = None) -> NDArray[np.float64]:
        """Points (x, y) `[..., 2]` of the map's frame as (longitude, latitude) in degrees, WGS 84. Raises MapError.

        Longitudes are within half a turn of the longitude `about`, by default the first point's, so that neighbours
        stay neighbours: across longitude 180 they go on with 180.1. `principal` brings them back.
        """
        found = reproject(self.to_crs(points), self.crs, WGS84, file)
        if found.size:
            found[..., 0] = near(found[..., 0], found.flat[0] if about is None else about, TURN)
        return found

    def from_crs(self, points: ArrayLike, crs: str) -> NDArray[np.float64]:
        """Coordinates `[..., 2]` of any CRS as metres of the map's frame. Raises MapError.

        Where x comes round, longitudes that go on across 180 lead to x that goes on.
        """
        found, (turn, start) = reproject(points, crs, self.crs), turn_of(self.crs)
        if turn and is_degrees(crs) and crs != self.crs:
            expected = start + np.asarray(points, dtype=np.float64)[..., 0] * turn / TURN
            found[..., 0] = near(found[..., 0], expected, turn)
        return (found - self.origin) / self.scale


def near(values: ArrayLike, middle: float | NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """The values moved by whole turns to within half a turn of `middle`; those half a turn away stay."""
    given = np.asarray(values, dtype=np.float64)
    return given - turn * np.round((given - middle) / turn)


def principal(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) `[..., 2]` with longitudes in -180..180."""
    return np.stack([near(places[..., 0], 0.0, TURN), places[..., 1]], axis=-1)


def is_degrees(crs: str) -> bool:
    """True for the name or the text of a CRS of longitudes and latitudes."""
    if PLAIN_DEGREES.search(crs):
        return True
    try:
        rasterio = rasterio_for("a CRS", crs)
        with rasterio.Env():  # which keeps GDAL's errors off the screen
            return bool(rasterio.crs.CRS.from_user_input(crs).is_geographic)
    except Exception:  # rasterio is missing, or PROJ does not know the CRS: what needs it says so
        names = r"EPSG:.*\b(4258|4269|4979|4230)$|GEOG(CS|CRS)"
        return bool(re.search(names, crs, re.IGNORECASE))


@cache
def turn_of(crs: str) -> tuple[float, float]:
    """(units of x in a turn of the Earth, x at longitude 0) of a CRS whose x comes round as longitudes do; else (0, 0).

    So do degrees, and the cylindrical projections, as Mercator's.
    """
    if is_degrees(crs):
        return TURN, 0.0
    try:
        (start, _), (one, _), (north, _) = reproject([(0, 0), (1, 0), (1, 60)], WGS84, crs).tolist()
    except MapError:  # it does not reach there
        return 0.0, 0.0
    return (TURN * (one - start), start) if abs(north - one) <= 1e-9 * abs(one - start) else (0.0, 0.0)


def around(latitude: float, longitude: float) -> Georeference:
    """Metres east and north of a place, by a transverse Mercator projection about it (true to 1e-6 within 9 km)."""
    longitude = float(near(longitude, 0.0, TURN))
    words = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    return Georeference(words)


def reproject(points: ArrayLike, source: str, target: str, file: str = "") -> NDArray[np.float64]:
    """Coordinates float64 `[..., 2]` of the CRS `source` in the CRS `target`, x or longitude first.

    Raises MapError for a CRS that PROJ does not know, for points outside of it, and without rasterio.
    """
    given = np.asarray(points, dtype=np.float64)
    if source == target or not given.size:
        return given
    rasterio = rasterio_for("another coordinate reference system", source)
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
    """PROJ's errors on the way from a CRS to another as MapErrors; `file`: what they are about."""
    problem = f"no way from the CRS {str(source)[:60]!r} to {target[:60]!r}"
    return foreign_errors(problem, file, "a CRS that PROJ knows, and places where it holds")


def degree_sides(latitude: float) -> tuple[float, float]:
    """Metres that a degree of latitude and one of longitude span at `latitude` degrees (WGS 84, within 1 m)."""
    angle = math.radians(latitude)
    north = 111132.954 - 559.822 * math.cos(2 * angle) + 1.175 * math.cos(4 * angle)
    east = 111412.84 * math.cos(angle) - 93.5 * math.cos(3 * angle) + 0.118 * math.cos(5 * angle)
    return north, east


def utm_zone(west: float, south: float, east: float, north: float) -> tuple[str, str] | None:
    """The UTM zone (WGS 84) of the middle of these degrees, in words and as its CRS; None if they reach out of it."""
    longitude = ((west + east) / 2 + 180) % 360
    zone = int(longitude // 6)
    off_centre = abs(longitude - 6 * zone - 3) + (east - west) / 2
    if south < UTM_LATITUDES[0] or north > UTM_LATITUDES[1] or off_centre > UTM_REACH:
        return None
    is_north = south + north >= 0
    words = f"UTM zone {zone + 1} {'north' if is_north else 'south'}"
    return words, f"EPSG:{(32601 if is_north else 32701) + zone}"


def same_crs(one: str, other: str) -> bool:
    """True if both texts name one CRS."""
    if one == other:
        return True
    crs = rasterio_for("a CRS", one).crs.CRS
    return bool(crs.from_user_input(one) == crs.from_user_input(other))


def rasterio_for(what: str, source: object, fix: str = "") -> Any:
    """The module rasterio with its parts; a MapError that says what to install where it is missing."""
    try:
        import rasterio
        import rasterio.crs
        import rasterio.warp
    except ImportError as missing:
        fix = f"pip install 'mrac-jax[geo]'{fix}"
        raise MapError(f"{what} needs rasterio", source=source, fix=fix) from missing
    return rasterio
