"""CSV files of points and corners, shapes on pixels, interpolation, and coordinates that wrap around the Earth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from planner.arguments import Numbers, did_you_mean, whole
from planner.errors import MapError
from planner.files import (
    DECIMAL_COMMAS,
    SEPARATORS,
    STRONG,
    Sign,
    check_size,
    is_header,
    layout_note,
    read_rows,
    signs_of,
)
from planner.world.frame import RANGE, TURN, WGS84, Frame, Georeference, near, principal
from planner.world.grid import UNKNOWN, Grid
from planner.world.keys import FARTHEST, THREAT, Key, Quantity
from planner.world.raster_files import describe
from planner.world.robot_types import short_name

# Coordinates that wrap: the order of longitude and latitude, and shapes across longitude 180.
#
# RFC 7946, 3.1.9, cuts shapes there: the two parts of a polygon lie a whole turn apart, and are joined again here.

Rings = list[NDArray[np.float64]]
"""A polygon: rings `[points, 2]`, x or longitude first, holes included."""
Boxes = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Least and largest coordinates `[boxes, 2]`; for a point both are the point."""
NEAR = 0.01
"""Degrees around a map, or the map's own size, within which shapes are assumed to belong to it."""
WIDE = 10
"""Largest gap, in cells, between the sides of a cut at longitude 180 that is reported."""
SAMPLES = 9
"""Places along each side of a map at which longitude and latitude are evaluated."""


def in_range(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """bool `[...]`: whether (x, y) `[..., 2]` can be longitude and latitude."""
    return np.asarray((np.abs(places) <= RANGE).all(axis=-1))


def fine(places: NDArray[np.float64]) -> bool:
    """True if coordinates have more digits than millimetres, as degrees do."""
    return bool((np.abs(places - np.round(places, 3)) > 1e-9).any())


def latitude_first(place: Sequence[float], where: str, source: object, why: str) -> MapError:
    """The error for coordinates in the wrong order.

    Args:
        place: an example, (latitude, longitude).
        where: place in the file, for the message.
        source: the file.
        why: reason, for the message.
    """
    problem = f"{where}latitude stands first, as in {place[0]:.10g}, {place[1]:.10g}: {why}"
    return MapError(problem, source=source, expected="longitude, then latitude", fix="swap the two everywhere in it")


def check_range(places: NDArray[np.float64], where: str, source: object) -> None:
    """Check that (longitude, latitude) `[n, 2]` are in range; the error says so if latitude stands first.

    Raises:
        MapError: one of them is out of range.
    """
    wrong = ~in_range(places)
    if not wrong.any():
        return
    x, y = places[wrong][0].tolist()
    # Swapped, all of them would be in range: then the order is the likely mistake.
    if in_range(places[:, ::-1]).all():
        raise latitude_first((x, y), where, source, f"{y:.6g} is no latitude")
    problem = f"{where}a point at longitude {x:g}, latitude {y:g}"
    raise MapError(problem, source=source, expected="degrees, -180..180 and -90..90")


def boxes_of(rings: Rings) -> Boxes:
    """Least and largest longitude and latitude of each ring; rings that may cross 180 count in both readings."""
    short = [_unwrapped(ring, TURN) for ring in rings if _is_wide(ring, TURN)]
    # Both readings count: a ring across 180 and one around the Earth have the same coordinates.
    both = [*rings, *(np.subtract(ring, (TURN * np.round(ring[0, 0] / TURN), 0)) for ring in short)]
    return np.array([ring.min(axis=0) for ring in both]), np.array([ring.max(axis=0) for ring in both])


def _is_wide(ring: NDArray[np.float64], turn: float) -> bool:
    """True if a step of the ring is longer than half a turn, and shorter than a whole one."""
    step = np.abs(np.diff(ring[:, 0], append=ring[:1, 0]))
    return bool(((step > turn / 2) & (step < turn)).any())


def _unwrapped(ring: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """The ring with every step taken the short way around."""
    return np.column_stack([np.unwrap(ring[:, 0], period=turn), ring[:, 1]])


@dataclass(frozen=True)
class Patch:
    """Area of a map on the Earth.

    Attributes:
        low, high: float64 `[2]`, its least and largest longitude and latitude; longitudes continue across 180.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, frame: Frame, georeference: Georeference) -> Patch:
        """The area of a map's frame.

        Raises:
            MapError: its CRS is not known.
        """
        height, width = frame.shape
        # Longitudes are taken near that of the middle, so that a map across 180 is one interval.
        middle = georeference.to_lonlat(frame.at(height / 2, width / 2))
        # A lattice, not only the corners: sides of the map are curved in degrees.
        rows, cols = np.meshgrid(np.linspace(0, height, SAMPLES), np.linspace(0, width, SAMPLES))
        places = georeference.to_lonlat(frame.at(rows, cols), about=middle[0]).reshape(-1, 2)
        return cls(places.min(axis=0), places.max(axis=0))

    @property
    def middle(self) -> NDArray[np.float64]:
        """(longitude, latitude) `[2]`."""
        return (self.low + self.high) / 2

    @property
    def words(self) -> str:
        """Its middle as text: `46.95 N 9.001 E`."""
        return describe(*principal(self.middle).tolist())

    def meets(self, boxes: Boxes, margin: float = 0.0) -> NDArray[np.bool_]:
        """bool `[boxes]`: whether boxes in degrees come within `margin` degrees of the map."""
        low, high = boxes
        middle, half = (low + high) / 2, (high - low) / 2
        middle = np.stack([near(middle[:, 0], float(self.middle[0]), TURN), middle[:, 1]], axis=1)
        apart = np.abs(middle - self.middle) - half - (self.high - self.low) / 2
        return (apart <= margin).all(axis=1) & in_range(low) & in_range(high)

    @property
    def margin(self) -> float:
        """Degrees from the map within which places are assumed to belong to it."""
        return max(NEAR, float((self.high - self.low).max()))

    def check_order(self, boxes: Boxes, source: object) -> None:
        """Check the order of longitude and latitude.

        Raises:
            MapError: no box is near the map, but one is with both swapped.
        """
        low, high = boxes
        swapped = self.meets((low[:, ::-1], high[:, ::-1]), self.margin)
        if swapped.any() and not self.meets(boxes, self.margin).any():
            why = f"swapped, it lies on the map, at {self.words}"
            raise latitude_first(low[swapped][0].tolist(), "", source, why)


def on_map(
    places: NDArray[np.float64], frame: Frame, georeference: Georeference, source: object
) -> NDArray[np.float64]:
    """(longitude, latitude) `[n, 2]` as metres of the map's frame.

    Raises:
        MapError: they cannot be transformed, or latitude stands first.
    """
    patch = Patch.of(frame, georeference)
    patch.check_order((places, places), source)
    longitudes = near(places[:, 0], float(patch.middle[0]), TURN)
    return georeference.from_crs(np.stack([longitudes, places[:, 1]], axis=1), WGS84)


def extent(values: NDArray[np.float64], turn: float) -> tuple[float, float]:
    """Least and largest x of the shortest interval with all `values`.

    The least lies within half a turn of 0, the largest may lie beyond.

    Args:
        values: float64 `[n]`.
        turn: period of x, 0: none.
    """
    x = np.unique(values)
    if not turn or (x[-1] - x[0] <= turn / 2 and np.abs(x).max() <= turn / 2):
        return float(x[0]), float(x[-1])
    x = np.unique(x % turn)
    # The shortest interval is the complement of the largest gap.
    gaps = np.append(x[1:], x[0] + turn) - x
    last = int(np.argmax(gaps))
    high = float(x[last])
    low = high - (turn - float(gaps[last]))
    # The same interval, moved by whole turns to where its begin is in -turn / 2 .. turn / 2.
    back = turn * np.floor(low / turn + 0.5)
    return float(low - back), float(high - back)


def closed(polygons: list[Rings], turn: float, cell: float) -> tuple[list[Rings], float]:
    """Close a cut: move its sides to where x wraps, if they are at most a cell apart.

    x wraps at half a turn, or at 0 if it counts to a whole turn.

    Args:
        polygons: of one shape.
        turn: period of x, 0: none.
        cell: size of a cell.

    Returns:
        (polygons, distance between the sides; 0 beyond WIDE cells).
    """
    x = np.concatenate([ring[:, 0] for rings in polygons for ring in rings])
    for west, east in ((-turn / 2, turn / 2), (0.0, turn)):
        short = float(np.abs(x - west).min()), float(np.abs(x - east).min())
        width = sum(short)
        if not turn or width > WIDE * cell:
            continue
        # Both sides are moved, by at most a cell in all.
        for side, other in ((west, short[1]), (east, short[0])) if width <= cell else ():
            polygons = [[_moved_to(side, ring, cell - other) for ring in rings] for rings in polygons]
        return polygons, width
    return polygons, 0.0


def _moved_to(side: float, ring: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
    x = np.where(np.abs(ring[:, 0] - side) <= tolerance, side, ring[:, 0])
    return np.column_stack([x, ring[:, 1]])


def unrolled(polygons: list[Rings], low: float, high: float, turn: float) -> tuple[list[Rings], bool]:
    """Polygons of one shape, moved near x = low .. high.

    A ring with a step of more than half a turn goes the short way if only then it holds their middle. A polygon is
    repeated as often as it lies there, at least once.

    Args:
        polygons: of the shape.
        low, high: interval of x.
        turn: period of x, 0: none.

    Returns:
        (polygons, whether they were moved by different numbers of turns, as those cut at longitude 180).
    """
    if not turn:
        return polygons, False
    moved: list[Rings] = []
    turns: set[int] = set()
    for rings in polygons:
        rings = _short_way(rings, low, high, turn)
        x = np.concatenate([ring[:, 0] for ring in rings])
        nearest = round(((low + high) - (x.min() + x.max())) / 2 / turn)
        # The polygon may lie on the interval in more than one turn if it goes around the Earth.
        there = [n for n in range(nearest - 1, nearest + 2) if x.min() + n * turn < high and x.max() + n * turn > low]
        for number in there or [nearest]:
            moved.append([np.add(ring, (number * turn, 0.0)) for ring in rings] if number else rings)
            turns.add(number)
    return moved, len(turns) > 1


def _short_way(rings: Rings, low: float, high: float, turn: float) -> Rings:
    """The polygon with every step taken the short way, if it has longer ones and only then covers x = low .. high."""
    if not any(_is_wide(ring, turn) for ring in rings):
        return rings

    def away(ring: NDArray[np.float64]) -> float:
        """Distance from the middle of low .. high to the nearest x of the ring; negative inside it."""
        middle, half = (low + high) / 2, float(np.ptp(ring[:, 0])) / 2
        return abs(float(near(ring[:, 0].min() + half, middle, turn)) - middle) - half

    short = [_unwrapped(ring, turn) for ring in rings]
    if away(rings[0]) <= 0 or away(short[0]) > (high - low) / 2 or np.ptp(short[0][:, 0]) == 0:
        return rings
    middle = float(short[0][:, 0].min() + short[0][:, 0].max()) / 2
    for ring in short[1:]:
        own = float(ring[:, 0].min() + ring[:, 0].max()) / 2
        ring[:, 0] += near(own, middle, turn) - own
    return short


# Shapes on the pixels of a map: points with a falloff, the inside of polygons, a map laid over another.

CUT_OFF = 3.0
"""Radii after which a Gaussian falloff ends: far cells are safe (p = 0), not nearly safe."""
MAX_BYTES = 2**24
"""Largest CSV or GeoJSON file that is read (16 MiB)."""
MAX_CORNERS = 2**18
"""Most corners of all polygons in a file: each edge is rasterised separately."""
NAME_DEGREES = "longitude and latitude, in this order, are in a file with a CRS, or in columns named lon and lat"
IN_METRES = "reproject it into metres of the map's frame (ogr2ogr -t_srs, or QGIS: export in the map's CRS)"


def point_spreads(
    points: NDArray[np.float64], kind: str, radius: float, frame: Frame
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Pixels that points affect.

    disc: strength within `radius` metres; gaussian: strength * exp(-d**2 / (2 * radius**2)), 0 beyond CUT_OFF radii.

    Args:
        points: float64 `[points, 3]`, (x, y, strength).
        kind: "disc" or "gaussian".
        radius: metres.
        frame: of the pixels.

    Yields:
        For each point (pixel indices int64 `[n]`, p at their centres float64 `[n]`).
    """
    height, width = frame.shape
    # Only pixels of the square around a point are computed: a map may have thousands of points.
    reach = radius if kind == "disc" else CUT_OFF * radius
    for (across, up), strength in zip(frame.local(points[:, :2]) / frame.size, points[:, 2], strict=True):
        row, col, span = height - up - 0.5, across - 0.5, reach / frame.size
        top, bottom = (int(np.clip(edge, 0, height)) for edge in (math.ceil(row - span), math.floor(row + span) + 1))
        left, right = (int(np.clip(edge, 0, width)) for edge in (math.ceil(col - span), math.floor(col + span) + 1))
        squared = (np.arange(top, bottom)[:, None] - row) ** 2 + (np.arange(left, right)[None, :] - col) ** 2
        shape = np.ones(squared.shape) if kind == "disc" else np.exp(-squared * (frame.size / radius) ** 2 / 2)
        rows, cols = np.nonzero(squared <= span**2)
        yield (rows + top) * width + cols + left, strength * shape[rows, cols]


def check_place(key: Key, points: NDArray[np.float64], frame: Frame, place: Georeference | None, what: str) -> None:
    """Check that shapes that affect no pixel are no mistake: off the map, or degrees instead of metres.

    Coordinates look like degrees within their range and with more digits than millimetres.

    Args:
        key: named in the error.
        points: float64 `[points, 2]`, (x, y) in metres.
        frame: of the map.
        place: georeference of the map.
        what: text of the error.

    Raises:
        ScenarioError: they are.
    """
    height, width = frame.shape
    local = frame.local(points) / frame.size
    off = bool((local.max(axis=0) < 0).any() or (local.min(axis=0) > (width, height)).any())
    if not off and not (fine(points) and (in_range(points).all() or in_range(points[:, ::-1]).all())):
        return
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    x, y, _ = frame.origin
    at = "" if place is None else f", at {Patch.of(frame, place).words}"
    problem = (
        f"names {key.value}, which {what}: x {west:.10g} .. {east:.10g}, y {south:.10g} .. {north:.10g}, and the map "
        f"is {width * frame.size:g} x {height * frame.size:g} m from ({x:.10g}, {y:.10g}){at}"
    )
    raise key.fault(problem, "metres on the map", IN_METRES if place is None else NAME_DEGREES)


def values_over(layer: Grid, frame: Frame) -> NDArray[np.int16]:
    """Values of a ROS map laid over the pixels of a frame by both origins and resolutions.

    A pixel takes the layer's value at its centre, or the largest of those whose centre it holds.

    Args:
        layer: the ROS map.
        frame: of the pixels.

    Returns:
        int16 `[H, W]`; -1 (unknown) outside of the layer.
    """
    at = layer.frame.pixels(frame.centres())
    held = layer.frame.holds(at)
    value = np.full(frame.shape, UNKNOWN, dtype=np.int16)
    value[held] = layer.occupancy[tuple(at[held].T)]
    if layer.frame.size < frame.size:
        under = frame.pixels(layer.frame.centres())
        held = frame.holds(under)
        np.maximum.at(value, tuple(under[held].T), layer.occupancy[held])
    return value


def edges(rings: Rings, frame: Frame, snap: float = 0.0) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """The ends (x, y) of every edge in pixels, x to the right and y down: a row's centre is at row + 0.5.

    Args:
        rings: `[points, 2]` each, metres.
        frame: of the pixels.
        snap: distance within which corners are moved to the sides of pixels.
    """
    for ring in rings:
        corners = frame.local(ring) / frame.size
        corners[:, 1] = frame.shape[0] - corners[:, 1]
        corners = np.where(np.abs(corners - np.rint(corners)) < snap, np.rint(corners), corners)
        yield from zip(corners, np.roll(corners, -1, axis=0), strict=True)


def inside(rings: list[NDArray[np.float64]], frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: pixels whose centre is in a polygon (even-odd rule, so holes are outside).

    Row by row, every edge flips all pixels to the right of its crossing. Cost: O(edges * H + H * W).

    Args:
        rings: `[points, 2]` each, metres.
        frame: of the pixels.
    """
    height, width = frame.shape
    flips = np.zeros((height, width + 1), dtype=np.uint8)
    for (x0, y0), (x1, y1) in edges(rings, frame):
        first, last = (int(np.clip(math.ceil(y - 0.5), 0, height)) for y in sorted((y0, y1)))
        rows = np.arange(first, last)
        crossing = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0) if len(rows) else rows
        # Parity of crossings to the left of a pixel's centre, computed by a cumulative XOR below.
        flips[rows, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)] ^= 1
    return (np.bitwise_xor.accumulate(flips, axis=1)[:, :width]).astype(bool)


MAX_POINTS = 2**17
"""Most lines of a file."""
X, Y, STRENGTH = ("x", "x_m"), ("y", "y_m"), "strength"
"""Column names of a points file; the third may also be the name of the quantity."""
NAMES = ("name", "id")
LONGITUDE, LATITUDE = ("lon", "lng", "long", "longitude"), ("lat", "latitude")
"""Column names of points in degrees, for georeferenced maps."""
COLUMNS = ("x", "y", STRENGTH)
"""Keys of a scenario that name these columns."""
AS_SAID: Mapping[str, str] = {}
"""No columns are named in the scenario."""


class Table(NamedTuple):
    """Lines of a CSV file.

    Attributes:
        path: the file.
        names: names of its columns in lower case; [] without a header.
        rows: (line number, fields) of each line.
        signs: decimal sign of each column.
        separator: between fields.
    """

    path: Path
    names: list[str]
    rows: list[tuple[int, list[str]]]
    signs: list[Sign]
    separator: str

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on how it was read."""
        return layout_note(self.separator, "," if any(sign.decimal == "," for sign in self.signs) else ".")

    @property
    def described(self) -> str:
        """Its columns, for the error about those that it lacks."""
        return f"has the columns {', '.join(self.names)[:80]}" if self.names else "has no header"

    def column(self, *options: str) -> int | None:
        """Index of the column with the first of these names that exists, or None."""
        return next((self.names.index(name) for name in options if name in self.names), None)

    def columns(self, *options: Sequence[str]) -> list[int]:
        """Indices of the columns of several coordinates; [] if one of them is missing."""
        found = [self.column(*names) for names in options]
        return [] if None in found else [at for at in found if at is not None]

    def number(self, row: tuple[int, list[str]], column: int, name: str, far: float = math.inf) -> float:
        """A finite number in a field.

        Args:
            row: line.
            column: index.
            name: for messages.
            far: largest magnitude.

        Raises:
            MapError: names line and value.
        """
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

    def places(self, columns: Sequence[int], names: tuple[str, str] = ("x", "y")) -> NDArray[np.float64]:
        """Two coordinates per line, float64 `[lines, 2]`; their names are for messages."""
        both = list(zip(columns, names, strict=True))
        return np.array([[self.number(row, at, name, FARTHEST) for at, name in both] for row in self.rows])

    def lonlat(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Longitude and latitude of every line, float64 `[lines, 2]`, checked."""
        found = self.places(columns)
        wrong = ~in_range(found)
        check_range(found, f"line {self.rows[int(np.argmax(wrong))][0]}: ", self.path)
        return found


def read_table(path: Path, holds: str) -> Table:
    """Read the non-empty lines of a CSV file; all have as many fields as the first. A first line of text is a header.

    Columns are separated by commas, semicolons, tabs, bars or spaces; numbers have decimal points or commas.

    Args:
        path: the file.
        holds: expected content, for messages.

    Raises:
        MapError: names the first invalid line.
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
        # A decimal comma in a file separated by commas makes rows of different lengths: the fix says so.
        if len(row) != len(rows[0][1]):
            other = next((words for mark, words in SEPARATORS.items() if mark in STRONG and mark in "".join(row)), "")
            problem = f"line {number} has {len(row)} values" + f", and {other}" * bool(other)
            expected = f"{len(rows[0][1])} as above, separated by {SEPARATORS[separator]}"
            fix = DECIMAL_COMMAS if separator == "," and len(row) > len(rows[0][1]) else ""
            raise MapError(problem, source=path, expected=expected, fix=fix)
    return Table(path, names, body, signs_of(body), separator)


class Points(NamedTuple):
    """Points of a file.

    Attributes:
        places: float64 `[points, 3]`, (x, y, strength) of every point: metres, metres, and p (or another quantity).
        names: (name, or "" without a column `name` or `id`; place in the file) of every point.
        notes: effects of reading that a user should know.
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
    """Read the points of a CSV file on a map.

    A header may name the columns x (or x_m), y (or y_m) and strength (or p), in any order and among others; on a
    georeferenced map also longitude and latitude (lon, lat). Without these names, or without a header, the file has
    exactly the three columns x, y, strength.

    Args:
        path: the file.
        frame: of the map.
        georeference: of the map.
        of: quantity of the strength.
        said: names of the columns x, y and strength, where the scenario gives them.

    Raises:
        MapError: names line and value.
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


def _columns(table: Table, georeferenced: bool, of: Quantity, said: Mapping[str, str]) -> tuple[list[int], bool]:
    """Indices of the columns x, y and strength, and whether the first two are longitude and latitude."""
    names, has = table.names, table.described
    if not names:
        width = len(table.rows[0][1])
        if said or width != 3:
            problem = has if said else f"line {table.rows[0][0]} has {width} values"
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
    # Three columns with other names are read in order, as without a header.
    if not said and len(names) == 3 and set(found.values()) == {None}:
        return [0, 1, 2], False
    missing = [what for what, at in found.items() if at is None]
    if missing:
        # Columns that are not used yet are suggested.
        spare = [name for at, name in enumerate(names) if at not in found.values() and name not in NAMES]
        fix = f"name it in the scenario: `{missing[0]}: {' | '.join(spare)[:80]}`" if spare else ""
        expected = "longitude, latitude and strength" if on_earth else "x, y and strength"
        raise MapError(has, source=table.path, expected=expected, fix=fix)
    return [at for at in found.values() if at is not None], on_earth


# Interpolation of samples at the cells of a map: by inverse distance, or by ordinary kriging.

KINDS = ("idw", "kriging")
MOST_KRIGED = 2**11
"""Most samples for kriging: the cost grows with their cube."""
POWER, NEIGHBOURS = 2.0, 12
"""Defaults of inverse-distance weighting."""


def interpolated(key: Key, samples: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate samples.

    idw: the mean of the nearest `neighbours`, weighted by distance ** -power; a place with a sample gets its value.
    kriging: ordinary, with a linear variogram; `nugget` is a sample's own error in metres of distance. No value leaves
    the range of the samples. Samples at one place count as one, their mean.

    Args:
        key: `interpolate` of a scenario.
        samples: float64 `[n, 3]`, (x, y, value).
        places: float64 `[m, 2]`, (x, y).

    Returns:
        float64 `[m]`.

    Raises:
        ScenarioError: the key is invalid, or there are too many samples.
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
    from scipy.interpolate import RBFInterpolator  # takes .2 s, which no other command waits for

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
    """Largest distance of the places from their nearest sample, metres.

    Args:
        samples: float64 `[n, 3]`, (x, y, value).
        places: float64 `[m, 2]`, (x, y).
    """
    return float(KDTree(samples[:, :2]).query(places)[0].max())
