"""CSV files of places, their columns by name: points with a number each, the corners of an area one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import KDTree

from planner.arguments import Numbers, did_you_mean, whole
from planner.csv_tables import DECIMAL_COMMAS, SEPARATORS, STRONG, Sign, is_header, layout_note, read_rows, signs_of
from planner.errors import MapError
from planner.files import check_size
from planner.world.grid import Frame, Georeference
from planner.world.image_files import RosMap
from planner.world.keys import FARTHEST, THREAT, Key, Quantity
from planner.world.longitudes import Patch, check_range, fine, in_range, on_map
from planner.world.robot_types import short_name

# Shapes on the pixels of a map: points with a falloff, the inside of polygons, a map laid over another.

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


MAX_POINTS = 2**17
"""Most lines of a file."""
X, Y, STRENGTH = ("x", "x_m"), ("y", "y_m"), "strength"
"""Column names of a points file; the third may also be the name of what it says."""
NAMES = ("name", "id")
LONGITUDE, LATITUDE = ("lon", "lng", "long", "longitude"), ("lat", "latitude")
"""Those of one in degrees, for maps that know where they lie."""
COLUMNS = ("x", "y", STRENGTH)
"""Keys by which a scenario may say which columns those are."""
AS_SAID: Mapping[str, str] = {}
"""Nobody says which column is which."""


class Table(NamedTuple):
    """A file's lines: the names of its columns in small letters ([]: it has no header), and (line, fields) of each.

    `signs`: the decimal sign of each column. `separator`: between them.
    """

    path: Path
    names: list[str]
    rows: list[tuple[int, list[str]]]
    signs: list[Sign]
    separator: str

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of how it was read."""
        return layout_note(self.separator, "," if any(sign.decimal == "," for sign in self.signs) else ".")

    def column(self, *options: str) -> int | None:
        """Where the first of these names stands."""
        return next((self.names.index(name) for name in options if name in self.names), None)

    def number(self, row: tuple[int, list[str]], column: int, name: str, far: float = math.inf) -> float:
        """A finite number in a field, called `name`, of metres up to `far`. Raises MapError naming line and value."""
        text, sign = row[1][column], self.signs[column]
        if sign.problem:
            fix = "write all numbers with decimal points, and none with marks between thousands"
            raise MapError(f"{name}: {sign.problem}", source=self.path, expected="one decimal sign", fix=fix)
        try:
            value = float(text.replace(",", ".") if sign.decimal == "," else text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise MapError(f"line {row[0]}: {name} is {text[:40]!r}", source=self.path, expected="a finite number")
        if abs(value) > far:
            problem = f"line {row[0]}: {name} is {text[:40]!r}"
            raise MapError(problem, source=self.path, expected=f"metres, none beyond {far:g}")
        return value

    def places(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Two coordinates a line, float64 `[lines, 2]`."""
        both = list(zip(columns, ("x", "y"), strict=True))
        return np.array([[self.number(row, at, name, FARTHEST) for at, name in both] for row in self.rows])

    def lonlat(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Longitude and latitude of every line, float64 `[lines, 2]`."""
        found = self.places(columns)
        wrong = ~in_range(found)
        check_range(found, f"line {self.rows[int(np.argmax(wrong))][0]}: ", self.path)
        return found


def read_table(path: Path, holds: str) -> Table:
    """The lines of a CSV file that are not empty, all as long as the first; a first one without numbers is a header.

    Columns are separated by commas, semicolons, tabs, bars or spaces; numbers have decimal points or commas. `holds`:
    in words, for errors. Raises MapError.
    """
    check_size(path, MAX_BYTES, MapError, holds)
    separator, rows = read_rows(path, holds)
    if len(rows) > MAX_POINTS:
        raise MapError(f"{len(rows)} lines", source=path, expected=f"at most {MAX_POINTS} points", fix="use a raster")
    if not rows:
        raise MapError("is empty", source=path, expected=holds)
    names = [name.strip().lower() for name in rows[0][1]] if is_header(rows[0][1]) else []
    body = rows[1:] if names else rows
    if not body:
        raise MapError("has a header and no points", source=path, expected=holds)
    for number, row in body:
        if len(row) != len(rows[0][1]):
            other = next((words for mark, words in SEPARATORS.items() if mark in STRONG and mark in "".join(row)), "")
            problem = f"line {number} has {len(row)} values" + f", and {other}" * bool(other)
            expected = f"{len(rows[0][1])} as above, separated by {SEPARATORS[separator]}"
            fix = DECIMAL_COMMAS if separator == "," and len(row) > len(rows[0][1]) else ""
            raise MapError(problem, source=path, expected=expected, fix=fix)
    return Table(path, names, body, signs_of(body), separator)


class Points(NamedTuple):
    """What a file of points says.

    Attributes:
        places: (x, y, strength) of every point, float64 `[points, 3]`: metres, metres, and p (or another quantity).
        names: of each its name, in a column `name` or `id` if there is one, and where it stands.
        notes: what reading did that a user should know.
    """

    places: NDArray[np.float64]
    names: list[tuple[str, str]]
    notes: tuple[str, ...] = ()


def read_points(
    path: Path,
    frame: Frame,
    georeference: Georeference | None = None,
    of: Quantity = THREAT,
    said: Mapping[str, str] = AS_SAID,
) -> Points:
    """The points of a CSV file on a map.

    A header may name the columns x (or x_m), y (or y_m) and strength (or p), in any order and among others; on a
    georeferenced map also longitude and latitude (lon, lat). `said`: which columns they are, by x, y and strength.
    Without those names, or without a header, the file has exactly the three columns x, y, strength. MapError names line
    and value.
    """
    table = read_table(path, "lines x, y, strength")
    columns, degrees = _columns(table, georeference is not None, of, said)
    places = table.lonlat(columns[:2]) if degrees else table.places(columns[:2])
    if georeference is not None and degrees:
        places = on_map(places, frame, georeference, path)
    strengths = [table.number(row, columns[2], STRENGTH) for row in table.rows]
    for (line, _), strength in zip(table.rows, strengths, strict=True):
        if not of.numbers.accepts(strength):
            raise MapError(f"line {line}: strength is {strength:g}", source=path, expected=of.numbers.expected)
    called = table.column(*NAMES)
    names = [("" if called is None else short_name(row[called]), f"line {n} of {path.name}") for n, row in table.rows]
    return Points(np.column_stack([places, strengths]), names, table.notes)


class Corners(NamedTuple):
    """(x, y) of every line of a file, float64 `[lines, 2]`, whether they are longitude and latitude, and notes."""

    places: NDArray[np.float64]
    degrees: bool
    notes: tuple[str, ...]


def read_corners(path: Path) -> Corners:
    """The corners of an area, one after the other. Raises MapError."""
    table = read_table(path, "lines x, y")
    for options, degrees in (((X, Y), False), ((LONGITUDE, LATITUDE), True)):
        columns = [table.column(*names) for names in options]
        if columns[0] is not None and columns[1] is not None:
            return Corners((table.lonlat if degrees else table.places)((columns[0], columns[1])), degrees, table.notes)
    if len(table.rows[0][1]) != 2:
        problem = f"has the columns {', '.join(table.names)[:80]}" if table.names else "has no header"
        raise MapError(problem, source=path, expected="columns x and y, or lon and lat: a corner a line")
    return Corners(table.places((0, 1)), False, table.notes)


def _columns(table: Table, georeferenced: bool, of: Quantity, said: Mapping[str, str]) -> tuple[list[int], bool]:
    """Where x, y and strength stand, and whether the first two are longitude and latitude."""
    names, has = table.names, f"has the columns {', '.join(table.names)[:80]}"
    if not names:
        width = len(table.rows[0][1])
        if said or width != 3:
            problem = "has no header" if said else f"line {table.rows[0][0]} has {width} values"
            fix = DECIMAL_COMMAS if table.separator == "," and width > 3 and not said else ""
            raise MapError(problem, source=table.path, expected="x, y, strength", fix=fix)
        return [0, 1, 2], False
    for what, name in said.items():
        if name.lower() not in names:
            expected, fix = f"{name[:40]!r} among them ({what})", did_you_mean(name.lower(), names)
            raise MapError(has, source=table.path, expected=expected, fix=fix)
    on_earth = said["x"].lower() in LONGITUDE if "x" in said else bool({*LONGITUDE, *LATITUDE} & set(names))
    if on_earth and not georeferenced:
        raise MapError(has, source=table.path, expected="x, y in metres", fix=IN_METRES)
    options = dict(zip(("x", "y"), (LONGITUDE, LATITUDE) if on_earth else (X, Y), strict=True))
    options |= {"strength": (STRENGTH, of.name)} | {what: (name.lower(),) for what, name in said.items()}
    found = {what: table.column(*known) for what, known in options.items()}
    if not said and len(names) == 3 and set(found.values()) == {None}:
        return [0, 1, 2], False
    missing = [what for what, at in found.items() if at is None]
    if missing:
        spare = [name for at, name in enumerate(names) if at not in found.values() and name not in NAMES]
        fix = f"say which it is, beside the file: `{missing[0]}: {' | '.join(spare)[:80]}`" if spare else ""
        expected = "longitude, latitude and strength" if on_earth else "x, y and strength"
        raise MapError(has, source=table.path, expected=expected, fix=fix)
    return [at for at in found.values() if at is not None], on_earth


# Samples of a survey, spread over the cells of a map: by inverse distances, or by ordinary kriging.

KINDS = ("idw", "kriging")
MOST_KRIGED = 2**11
"""Samples that are kriged together: the cost grows with their cube."""
POWER, NEIGHBOURS = 2.0, 12
"""Of inverse distances, where nobody says otherwise."""


def interpolated(key: Key, samples: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values at `places` (x, y) `[m, 2]`, float64 `[m]`, from samples (x, y, value) `[n, 3]`, as `key` says.

    idw: the mean of the nearest `neighbours`, weighted by distance ** -power; a place with a sample has its value.
    kriging: ordinary, with a linear variogram, in which a sample's own error is worth `nugget` metres of distance. No
    value leaves the range of the samples, of which those at one place count as one, their mean. Raises ScenarioError.
    """
    kind = key.mapping(("kind",), optional=("power", "neighbours", "nugget"))["kind"].choice(KINDS)
    at, which = np.unique(samples[:, :2], axis=0, return_inverse=True)
    values = np.bincount(which.reshape(-1), samples[:, 2]) / np.bincount(which.reshape(-1))
    if kind == "idw":
        keys = key.mapping(("kind",), defaults={"power": POWER, "neighbours": NEIGHBOURS})
        power = keys["power"].number(Numbers(0, 16, above=True))
        return _by_distance(at, values, places, power, keys["neighbours"].number(whole(1, 256)))
    nugget = key.mapping(("kind",), defaults={"nugget": 0.0})["nugget"].number(Numbers(0, FARTHEST, "metres"))
    if len(at) > MOST_KRIGED:
        raise key.wrong(f"idw: {len(at)} samples, and kriging is for up to {MOST_KRIGED}", "or thin the samples out")
    try:
        found = RBFInterpolator(at, values, smoothing=nugget, kernel="linear", degree=0)(places)
    except np.linalg.LinAlgError:
        raise key.wrong("a nugget, or idw: samples lie too near each other") from None
    return np.clip(found, values.min(), values.max())


def _by_distance(
    at: NDArray[np.float64], values: NDArray[np.float64], places: NDArray[np.float64], power: float, near: int
) -> NDArray[np.float64]:
    near = min(near, len(at))
    distance, index = (found.reshape(-1, near) for found in KDTree(at).query(places, k=near))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = (distance[:, :1] / distance) ** power  # of the nearest: 1, so that nothing overflows
    weight = np.where(distance[:, :1] == 0, distance == 0, weight)
    return (weight * values[index]).sum(axis=1) / weight.sum(axis=1)


def farthest(samples: NDArray[np.float64], places: NDArray[np.float64]) -> float:
    """Metres from the place that is farthest from all samples to the nearest of them."""
    return float(KDTree(samples[:, :2]).query(places)[0].max())
