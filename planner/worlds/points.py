"""CSV files of places, their columns by name: points with a number each, the corners of an area one after the other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.arguments import did_you_mean
from planner.errors import MapError
from planner.files import check_size
from planner.tables import DECIMAL_COMMAS, SEPARATORS, STRONG, Sign, is_header, layout_note, read_rows, signs_of
from planner.worlds.degrees import check_range, in_range, on_map
from planner.worlds.georeference import Georeference
from planner.worlds.grid import Frame
from planner.worlds.quantities import FARTHEST, THREAT, Quantity
from planner.worlds.shapes import IN_METRES, MAX_BYTES
from planner.worlds.sources import short_name

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
