"""CSV files of places, their columns by name: points with a number each, the corners of an area one after the other."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.arguments import did_you_mean
from planner.errors import MapError
from planner.files import check_size
from planner.worlds.georeference import WGS84, Georeference
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
    """A file's lines: the names of its columns in small letters ([]: it has no header), and (line, fields) of each."""

    path: Path
    names: list[str]
    rows: list[tuple[int, list[str]]]

    def column(self, *options: str) -> int | None:
        """Where the first of these names stands."""
        return next((self.names.index(name) for name in options if name in self.names), None)

    def number(self, row: tuple[int, list[str]], column: int, name: str, far: float = math.inf) -> float:
        """A finite number in a field, called `name`, of metres up to `far`. Raises MapError naming line and value."""
        text = row[1][column]
        try:
            value = float(text)
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
        wrong = (np.abs(found) > (180, 90)).any(axis=1)
        if wrong.any():
            line, row = self.rows[int(np.argmax(wrong))]
            problem = f"line {line}: {', '.join(row)[:60]!r} is no longitude and latitude"
            raise MapError(problem, source=self.path, expected="degrees, -180..180 and -90..90")
        return found


def read_table(path: Path, holds: str) -> Table:
    """The lines of a CSV file that are not empty, all as long as the first; a first one without numbers is a header.

    `holds`: in words, for errors. Raises MapError.
    """
    check_size(path, MAX_BYTES, MapError, holds)
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            reader = csv.reader(lines)
            rows = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f"cannot be read as text ({error})", source=path, expected=holds) from error
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
            problem, expected = f"line {number} has {len(row)} values", f"{len(rows[0][1])} as above"
            raise MapError(problem, source=path, expected=expected)
    return Table(path, names, body)


def is_header(row: list[str]) -> bool:
    """Whether none of these fields is a number."""

    def numeric(text: str) -> bool:
        try:
            float(text)
        except ValueError:
            return False
        return True

    return not any(numeric(field) for field in row)


def read_points(
    path: Path, georeference: Georeference | None = None, of: Quantity = THREAT, said: Mapping[str, str] = AS_SAID
) -> tuple[NDArray[np.float64], list[tuple[str, str]]]:
    """(x, y, strength) of every point, float64 `[points, 3]`: metres, metres, and p (or what it is `of`).

    And of each its name, in a column `name` or `id` if there is one, and where it stands.

    A header may name the columns x (or x_m), y (or y_m) and strength (or p), in any order and among others; on a
    georeferenced map also longitude and latitude (lon, lat). `said`: which columns they are, by x, y and strength.
    Without those names, or without a header, the file has exactly the three columns x, y, strength. MapError names line
    and value.
    """
    table = read_table(path, "lines x, y, strength")
    columns, degrees = _columns(table, georeference is not None, of, said)
    places = table.lonlat(columns[:2]) if degrees else table.places(columns[:2])
    if georeference is not None and degrees:
        places = georeference.from_crs(places, WGS84)
    strengths = [table.number(row, columns[2], STRENGTH) for row in table.rows]
    for (line, _), strength in zip(table.rows, strengths, strict=True):
        if not of.numbers.accepts(strength):
            raise MapError(f"line {line}: strength is {strength:g}", source=path, expected=of.numbers.expected)
    called = table.column(*NAMES)
    names = [("" if called is None else short_name(row[called]), f"line {n} of {path.name}") for n, row in table.rows]
    return np.column_stack([places, strengths]), names


def read_corners(path: Path) -> tuple[NDArray[np.float64], bool]:
    """(x, y) of every line, float64 `[lines, 2]`, and whether they are longitude and latitude. Raises MapError."""
    table = read_table(path, "lines x, y")
    for options, degrees in (((X, Y), False), ((LONGITUDE, LATITUDE), True)):
        columns = [table.column(*names) for names in options]
        if columns[0] is not None and columns[1] is not None:
            return (table.lonlat if degrees else table.places)((columns[0], columns[1])), degrees
    if len(table.rows[0][1]) != 2:
        problem = f"has the columns {', '.join(table.names)[:80]}" if table.names else "has no header"
        raise MapError(problem, source=path, expected="columns x and y, or lon and lat: a corner a line")
    return table.places((0, 1)), False


def _columns(table: Table, georeferenced: bool, of: Quantity, said: Mapping[str, str]) -> tuple[list[int], bool]:
    """Where x, y and strength stand, and whether the first two are longitude and latitude."""
    names, has = table.names, f"has the columns {', '.join(table.names)[:80]}"
    if not names:
        width = len(table.rows[0][1])
        if said or width != 3:
            problem = "has no header" if said else f"line {table.rows[0][0]} has {width} values"
            raise MapError(problem, source=table.path, expected="x, y, strength")
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
