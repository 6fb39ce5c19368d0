"""Shapefiles and GeoPackages as GeoJSON's objects, through pyogrio (GDAL): whole ones only, and none that computes."""

from __future__ import annotations

import contextlib
import re
import reprlib
import sqlite3
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from planner.errors import MapError
from planner.files import Json, check_size, foreign_errors, printable
from planner.worlds.shapes import MAX_CORNERS

MOST_BYTES = 2**26
"""Largest file of the two kinds, and of those beside a shapefile (64 MiB)."""
KINDS = {".shp": "a shapefile", ".gpkg": "a GeoPackage"}
"""Files that are read here, by the end of their names."""
POLYGON, MULTIPOLYGON, POINT_BYTES = 3, 6, 16
"""Of WKB: types of geometries, and what two float64 take."""
OTHERS = {1: "Point", 2: "LineString", 4: "MultiPoint", 5: "MultiLineString", 7: "GeometryCollection", 16: "TIN"}
WHOLE = "a file that was copied as a whole"


def read_vectors(path: Path, number: str) -> tuple[list[Json], str | None]:
    """(features as GeoJSON has them, with the field of that name and "name"; the CRS, None where the file names none).

    Of a GeoPackage its one layer that may hold polygons; curves come as short straight lines. Raises MapError for
    what is not whole, not of its kind, or too large, and without pyogrio.
    """
    pyogrio = _pyogrio(path)
    check_size(path, MOST_BYTES, MapError, KINDS[path.suffix.lower()])
    (_check_shapefile if path.suffix.lower() == ".shp" else _check_geopackage)(path)
    with foreign_errors("cannot be read", path, KINDS[path.suffix.lower()]):
        layer = _layer(pyogrio.list_layers(path), path)
        _check_numbers(_stored(path, layer, number), number, path)
        fields = pyogrio.read_info(path, layer=layer)["fields"].tolist()
        named = [field for field in fields if field.lower() in (number, "name")]
        meta, _, shapes, columns = pyogrio.raw.read(
            path, layer=layer, columns=named, force_2d=True, max_features=MAX_CORNERS
        )
    corners = sum(len(shape or b"") for shape in shapes) // POINT_BYTES
    if corners > MAX_CORNERS:
        raise MapError(f"some {corners} corners", source=path, expected=f"at most {MAX_CORNERS}", fix="simplify it")
    said = {str(field).lower(): column.tolist() for field, column in zip(meta["fields"], columns, strict=True)}
    features = [
        {
            "properties": {key: None if values[n] != values[n] else values[n] for key, values in said.items()},
            "geometry": _geometry(shape),
        }
        for n, shape in enumerate(shapes)
    ]
    return features, meta["crs"]


def _pyogrio(path: Path) -> Any:
    try:
        import pyogrio
    except ImportError as missing:
        fix = "pip install 'mrac-jax[geo]', or convert to GeoJSON"
        raise MapError(f"reading {path.suffix} needs pyogrio", source=path, fix=fix) from missing
    return pyogrio


def _layer(layers: Any, path: Path) -> str:
    """The one layer of polygons; layers of points and lines are passed over where there is one."""
    names = [(str(name), str(kind)) for name, kind in layers if kind is not None and kind != "None"]
    held = [name for name, kind in names if "Polygon" in kind or kind in ("Unknown", "GeometryCollection")]
    if len(held) == 1 or (not held and len(names) == 1):
        return held[0] if held else names[0][0]
    if not names:
        raise MapError("has no layer with places", source=path, expected="one layer of polygons")
    said = ", ".join(printable(f"{name} ({kind})")[:40] for name, kind in names[:5])
    fix = "copy the one that is meant into a file of its own (ogr2ogr one.gpkg all.gpkg LAYER)"
    raise MapError(f"its layers are {said}", source=path, expected="one layer of polygons", fix=fix)


def _check_shapefile(path: Path) -> None:
    """An error unless the file, its index and its table are there and as long as their heads say."""
    for suffix in (".shp", ".shx", ".dbf"):
        part = path if suffix == ".shp" else _beside(path, suffix)
        if part is None:
            if suffix == ".dbf":
                continue  # only its numbers are missing
            raise MapError(f"there is no {path.stem}{suffix} beside it", source=path, expected="all of a shapefile")
        check_size(part, MOST_BYTES, MapError, "a part of a shapefile")
        with part.open("rb") as file:
            head = file.read(100)
        if suffix != ".dbf" and (len(head) < 100 or head[:4] != b"\x00\x00\x27\x0a"):
            raise MapError(f"{part.name} is no part of a shapefile", source=path, expected=KINDS[".shp"])
        if len(head) < 32:
            raise MapError(f"{part.name} is cut off", source=path, expected=WHOLE)
        records, skip, each = struct.unpack_from("<IHH", head, 4)
        claimed = records * each + skip if suffix == ".dbf" else 2 * struct.unpack_from(">i", head, 24)[0]
        if claimed > part.stat().st_size:
            problem = f"{part.name} claims {claimed} bytes and has {part.stat().st_size}"
            raise MapError(problem, source=path, expected=WHOLE)


def _beside(path: Path, suffix: str) -> Path | None:
    """The part of a shapefile that ends so, in small letters or capitals."""
    return next((part for end in (suffix, suffix.upper()) if (part := path.with_suffix(end)).exists()), None)


def _check_geopackage(path: Path) -> None:
    """An error unless it is a whole database whose tables hold what they show: a view may never end."""
    try:
        with path.open("rb") as file:
            if file.read(16) != b"SQLite format 3\0":
                raise MapError("is no database of SQLite", source=path, expected=KINDS[".gpkg"])
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
            (state,) = database.execute("PRAGMA quick_check(1)").fetchone()
            if state != "ok":
                raise MapError(f"is damaged ({printable(state)[:80]})", source=path, expected=WHOLE)
            _check_tables(database, path)
    except (sqlite3.Error, UnicodeDecodeError, OSError) as error:  # SQLite quotes damaged names in its errors
        raise MapError(f"is damaged ({error})", source=path, expected=WHOLE) from error


def _check_tables(database: sqlite3.Connection, path: Path) -> None:
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master"))
    if kinds.get("gpkg_contents") != "table":
        raise MapError("has no table gpkg_contents", source=path, expected=KINDS[".gpkg"])
    shown = {str(name) for (name,) in database.execute("SELECT table_name FROM gpkg_contents LIMIT 1000")}
    for name in sorted((shown | {name for name in kinds if name.startswith("gpkg_")}) & kinds.keys()):
        computed = database.execute("SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden > 1", (name,))
        if kinds[name] == "view" or computed.fetchone()[0]:
            problem = f"{printable(name)[:60]!r} is a view, or has computed columns"
            fix = "copy it into a file of its own (ogr2ogr)"
            raise MapError(problem, source=path, expected="plain tables", fix=fix)


def _check_numbers(stored: Iterable[object], number: str, path: Path) -> None:
    """An error for text where a number should be: GDAL reads it as 0, and a threat would be none."""
    for index, value in enumerate(stored):
        if isinstance(value, str | bytes):
            text = value.decode("latin-1") if isinstance(value, bytes) else value
            problem = f"features[{index}]: property {number} is {reprlib.repr(text)}, which is no number"
            fix = "write it with a decimal point" if "," in text else ""
            raise MapError(problem, source=path, expected="a number, or nothing", fix=fix)


def _stored(path: Path, layer: str, number: str) -> Iterable[object]:
    """What a file holds in the field of that name, feature by feature, before GDAL makes numbers of it."""
    if path.suffix.lower() == ".shp":
        table = _beside(path, ".dbf")
        return () if table is None else _dbf_numbers(table.read_bytes(), number)
    uri, quoted = f"{path.resolve().as_uri()}?mode=ro&immutable=1", layer.replace('"', '""')
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
        names = [str(name) for (name,) in database.execute("SELECT name FROM pragma_table_info(?)", (layer,))]
        if number not in map(str.lower, names):
            return ()
        rows = database.execute(f'SELECT "{number}" FROM "{quoted}" LIMIT {MAX_CORNERS}')
        return [value for (value,) in rows]


def _dbf_numbers(table: bytes, number: str) -> Iterator[object]:
    """The numeric field of that name in every record that is not deleted: None, a float, or bytes that are none."""
    records, skip, each = struct.unpack_from("<IHH", table, 4)
    start = 1
    for at in range(32, skip - 31, 32):
        name, kind, width = table[at : at + 11].split(b"\0")[0], table[at + 11 : at + 12], table[at + 16]
        if name.decode("latin-1").lower() == number and kind in (b"N", b"F"):
            for record in range(skip, skip + records * each, each):
                if table[record : record + 1] != b"*":
                    yield _dbf_number(table[record + start : record + start + width].strip(b" \0"))
            return
        start += width


def _dbf_number(text: bytes) -> float | bytes | None:
    if not text or text.startswith(b"*"):
        return None  # what could not be written within the field's width
    return float(text) if re.fullmatch(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text) else text


def _geometry(shape: bytes | None) -> Json:
    """A geometry in WKB (GDAL's: little-endian) as GeoJSON has it; of others than polygons the type alone."""
    if not shape:
        return {"type": "none"}
    (kind,) = struct.unpack_from("<I", shape, 1)
    if kind not in (POLYGON, MULTIPOLYGON):
        return {"type": OTHERS.get(kind, f"number {kind} of WKB")}
    if kind == POLYGON:
        return {"type": "Polygon", "coordinates": _rings(shape, 0)[0]}
    (parts,), at, polygons = struct.unpack_from("<I", shape, 5), 9, []
    for _ in range(parts):
        rings, at = _rings(shape, at)
        polygons.append(rings)
    return {"type": "MultiPolygon", "coordinates": polygons}


def _rings(shape: bytes, at: int) -> tuple[list[list[list[float]]], int]:
    """Rings of the polygon at that place, and where it ends."""
    (count,), at, rings = struct.unpack_from("<I", shape, at + 5), at + 9, []
    for _ in range(count):
        (points,) = struct.unpack_from("<I", shape, at)
        rings.append(np.frombuffer(shape, "<f8", 2 * points, at + 4).reshape(-1, 2).tolist())
        at += 4 + POINT_BYTES * points
    return rings, at
