"""Shapefiles and GeoPackages as GeoJSON's objects, through pyogrio (GDAL): whole ones only, and none that computes."""

from __future__ import annotations

import contextlib
import re
import reprlib
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import Json, check_size, foreign_errors, printable, read_json
from planner.world.grid import HOW_TO_GIVE_ONE, PLAIN_DEGREES, WGS84, Frame, Georeference, is_degrees, turn_of
from planner.world.keys import COORDINATE, FARTHEST, THREAT, Quantity
from planner.world.longitudes import Patch, Rings, boxes_of, check_range, fine, in_range, unrolled
from planner.world.points import IN_METRES, MAX_BYTES, MAX_CORNERS, inside, read_corners
from planner.world.robot_types import short_name

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


# Polygons in KML and GPX. No entity is ever followed: a document type is refused as soon as it is met.

Places = NDArray[np.float64]
Placemark = tuple[float | str | None, list[list[Places]], str]
"""(its number, its rings, where it stands)."""


def read_kml(path: Path, most_bytes: int, name: str = "p") -> list[Placemark]:
    """(number or None, polygons, name) of every Placemark with polygons; rings `[points, 2]`, longitude and latitude.

    The number is that of a Data or SimpleData element of this name, its text if it is none. Raises MapError.
    """
    found: list[Placemark] = []
    for index, place in enumerate(_named(read_xml(path, most_bytes, "kml"), "Placemark")):
        polygons = []
        for polygon in _named(place, "Polygon"):
            borders = [*_named(polygon, "outerBoundaryIs"), *_named(polygon, "innerBoundaryIs")]
            rings = [ring for border in borders for ring in _named(border, "coordinates")]
            polygons.append([_markup_ring(_tuples(ring.text or ""), f"Placemark {index}", path) for ring in rings])
            if not polygons[-1]:
                raise MapError(f"Placemark {index}: a polygon without a boundary", source=path, expected="coordinates")
        if polygons:
            found.append((_kml_number(place, name), polygons, _own_name(place)))
    return found


def read_gpx(path: Path, most_bytes: int) -> list[Placemark]:
    """(None, polygons, name) of every track and route, the line around an area, closed; raises MapError.

    Those of fewer than three points, of which receivers' logs are full, enclose nothing and are left out.
    """
    found: list[Placemark] = []
    for index, line in enumerate(_named(read_xml(path, most_bytes, "gpx"), "trk", "rte")):
        points = [(point.get("lon"), point.get("lat")) for point in _named(line, "trkpt", "rtept")]
        if len(points) > 2:
            found.append((None, [[_markup_ring(points, f"line {index}", path)]], _own_name(line)))
    return found


def read_xml(path: Path, most_bytes: int, root: str) -> Element:
    """The top element of an XML file of this kind; names without their namespaces. Raises MapError."""
    check_size(path, most_bytes, MapError, f"{root.upper()} (XML)")

    def refuse(*given: object) -> None:
        raise MapError("has a document type (DOCTYPE)", source=path, expected="plain XML", fix="delete that line")

    builder, parser = TreeBuilder(), expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = lambda name, attributes: builder.start(name.rpartition(":")[2], attributes)
    parser.EndElementHandler = lambda name: builder.end(name.rpartition(":")[2])
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        raise MapError(f"no XML ({error})", source=path, expected=f"{root.upper()}, whole") from error
    except MapError:  # refused
        raise
    except (OSError, ValueError, LookupError) as error:  # not readable; an encoding that nobody knows
        raise MapError(f"cannot be read as XML ({error})", source=path, expected=root.upper()) from error
    top = builder.close()
    if top.tag.lower() != root:
        raise MapError(f"its top element is {top.tag[:40]!r}", source=path, expected=root)
    return top


def _named(element: Element, *names: str) -> list[Element]:
    return [one for one in element.iter() if one.tag in names]


def _own_name(element: Element) -> str:
    return short_name(next((child.text for child in element if child.tag == "name"), None))


def _kml_number(place: Element, name: str) -> float | str | None:
    for data in _named(place, "Data", "SimpleData"):
        if data.get("name") == name:
            text = "".join(data.itertext()).strip()
            try:
                return float(text)
            except ValueError:
                return text
    return None


def _tuples(text: str) -> list[tuple[str | None, str | None]]:
    """KML's `lon,lat[,altitude] lon,lat[,altitude] ...`."""
    parts = [part.split(",") for part in text.split()]
    return [(part[0], part[1] if len(part) > 1 else None) for part in parts]


def _markup_ring(points: list[tuple[str | None, str | None]], where: str, path: Path) -> Places:
    try:
        ring = np.array([(float(lon or "nan"), float(lat or "nan")) for lon, lat in points]).reshape(-1, 2)
    except ValueError as error:
        raise MapError(f"{where}: {error}", source=path, expected="longitude and latitude in degrees") from error
    check_range(ring, f"{where}: ", path)
    if len(ring) < 3:
        raise MapError(f"{where} has {len(ring)} points", source=path, expected="three around an area, or more")
    return ring


# Polygons in files, as metres of the map's frame: GeoJSON, KML, GPX, shapefiles, GeoPackages.


class Feature(NamedTuple):
    """What a file says is the number of a feature (its p), its polygons, lists of rings `[points, 2]`, and its name."""

    number: Any
    polygons: list[Rings]
    name: str = ""

    def mask(self, frame: Frame) -> NDArray[np.bool_]:
        """bool `[H, W]`: pixels whose centre it holds."""
        return np.logical_or.reduce([inside(rings, frame) for rings in self.polygons] or [np.zeros(frame.shape, bool)])


def rings_of(features: Iterable[Feature]) -> Rings:
    """All of theirs."""
    return [ring for feature in features for rings in feature.polygons for ring in rings]


class Shapes(NamedTuple):
    """The features of a file in its own coordinates, and the name of their CRS.

    crs "": the file does not say, and need not (GeoJSON); None: it does not say, and should. `notes`: what reading did
    that a user should know.
    """

    features: list[Feature]
    crs: str | None = ""
    notes: tuple[str, ...] = ()


def read_polygons(
    path: Path, default: float | None, frame: Frame, georeference: Georeference | None, of: Quantity = THREAT
) -> Shapes:
    """Every feature of a file, its number float; a polygon is a list of rings, float64 `[points, 2]` in metres.

    Polygons with holes; the number is the feature's property of that name, or `default`. On a map without georeference
    coordinates are metres of its frame. On one that has it they are those of the file's `crs`; where it names none,
    longitude and latitude if they lie on the map as such (RFC 7946, section 4), else metres. Raises MapError naming the
    feature.
    """
    shapes = read_shapes(path, of)
    found = [
        feature._replace(number=_number(feature.number, default, index, path, of))
        for index, feature in enumerate(shapes.features)
    ]
    crs = (shapes.crs or "") if georeference is None else _crs(shapes, frame, georeference, path)
    if georeference is None and is_degrees(crs):
        fix = f"{IN_METRES}, or {HOW_TO_GIVE_ONE}"
        raise MapError(f"its crs is {crs[:60]!r}, degrees", source=path, expected="metres", fix=fix)
    if georeference is None or not crs:
        return shapes._replace(features=found)
    try:
        return shapes._replace(features=_on_map(found, crs, frame, georeference, path))
    except MapError as error:
        raise MapError(error.problem, source=path, expected=error.expected, fix=error.fix) from error


def _on_map(features: list[Feature], crs: str, frame: Frame, georeference: Georeference, path: Path) -> list[Feature]:
    """Features in metres of the map's frame, brought together where they were cut at longitude 180."""
    if is_degrees(crs):
        rings = rings_of(features)
        check_range(np.concatenate(rings), "", path)
        Patch.of(frame, georeference).check_order(boxes_of(rings), path)
    corners = frame.at([0, 0, *frame.shape[:1] * 2], [0, frame.shape[1]] * 2)[:, 0]
    place = float(corners.min()), float(corners.max()), turn_of(georeference.crs)[0] / georeference.scale[0]
    return [
        feature._replace(
            polygons=unrolled(
                [[georeference.from_crs(ring, crs) for ring in rings] for rings in feature.polygons], *place
            ).areas
        )
        for feature in features
    ]


def read_shapes(path: Path, of: Quantity = THREAT) -> Shapes:
    """The features of a file with polygons, in its own coordinates. Raises MapError."""
    if path.suffix.lower() not in READERS:
        raise MapError(f"no polygons are read from {path.suffix!r}", source=path, expected=" ".join(READERS))
    shapes = READERS[path.suffix.lower()](path, of.name)
    if not shapes.features:
        raise MapError("holds no features", source=path, expected="Polygon or MultiPolygon features")
    corners = sum(map(len, rings_of(shapes.features)))
    if corners > MAX_CORNERS:
        raise MapError(f"{corners} corners", source=path, expected=f"at most {MAX_CORNERS}", fix="simplify it")
    return shapes._replace(crs=WGS84) if PLAIN_DEGREES.search(shapes.crs or "") else shapes


def _number(value: object, default: float | None, index: int, path: Path, of: Quantity) -> float:
    value = default if value is None else value
    if not of.numbers.accepts(value):
        said = "missing" if value is None else reprlib.repr(value)
        problem = f"features[{index}]: property {of.name} is {said}"
        raise MapError(problem, source=path, expected=of.numbers.expected, fix=f"or give {of.name} in the scenario")
    return float(value)  # type: ignore[arg-type]


def _crs(shapes: Shapes, frame: Frame, georeference: Georeference, path: Path) -> str:
    """The CRS of the coordinates, "" for metres of the frame; MapError where a file mixes both."""
    if shapes.crs is None:
        fix = "say it in QGIS, or ogr2ogr -a_srs; a shapefile's is in the .prj beside it"
        raise MapError(
            "names no coordinate reference system", source=path, expected="one, on a map that has one", fix=fix
        )
    if shapes.crs:
        return shapes.crs
    rings, patch = rings_of(shapes.features), Patch.of(frame, georeference)
    if not patch.meets(boxes_of(rings)).any():
        metres = frame.local(np.concatenate(rings)) / frame.size
        off = (metres.max(axis=0) < 0).any() or (metres.min(axis=0) > frame.shape[::-1]).any()
        if off or fine(np.concatenate(rings)):
            patch.check_order(boxes_of(rings), path)
        return ""
    degrees = [bool(in_range(ring).all()) for ring in rings]
    if not all(degrees):
        wrong = rings[degrees.index(False)][0].tolist()
        problem = f"mixes longitude and latitude with coordinates that are none, as {wrong}"
        raise MapError(problem, source=path, expected="one kind of coordinates", fix="or a `crs` that names it")
    return WGS84


def _geojson(path: Path, number: str) -> Shapes:
    data = read_json(path, MAX_BYTES, MapError, "GeoJSON")
    crs = data.get("crs") if isinstance(data, dict) else None
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return Shapes(_read(_features(data, path), number, path), name if isinstance(name, str) else "")


def _vectors(path: Path, number: str) -> Shapes:
    features, crs = read_vectors(path, number)
    return Shapes(_read(features, number, path), crs)


def _read(features: list[Json], number: str, path: Path) -> list[Feature]:
    found: list[Feature] = []
    for index, feature in enumerate(features):
        said = feature.get("properties") or {}
        polygons = list(_polygons(feature.get("geometry"), f"features[{index}]", path))
        found.append(Feature(said.get(number), polygons, short_name(said.get("name"))))
    return found


def _features(data: Any, path: Path) -> list[Json]:
    kind = data.get("type") if isinstance(data, dict) else None
    features = [data] if kind == "Feature" else [{"geometry": data}] if kind in ("Polygon", "MultiPolygon") else None
    if kind == "FeatureCollection":
        features = data.get("features")
    if not isinstance(features, list) or not all(isinstance(feature, dict) for feature in features):
        raise MapError(f"its type is {str(kind)[:40]!r}", source=path, expected="FeatureCollection, Feature or Polygon")
    for index, feature in enumerate(features):
        if not isinstance(feature.get("properties") or {}, dict):
            raise MapError(
                f"features[{index}]: properties are no object", source=path, expected="properties with numbers"
            )
    return features


def _polygons(geometry: Any, where: str, path: Path) -> Iterator[Rings]:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in ("Polygon", "MultiPolygon"):
        problem = f"{where}: geometry is {str(kind)[:40]!r}"
        raise MapError(problem, source=path, expected="Polygon or MultiPolygon")
    parts = [geometry.get("coordinates")] if kind == "Polygon" else geometry.get("coordinates")
    try:
        for part in parts:
            rings = [np.array([_corner(point) for point in ring], dtype=np.float64) for ring in part]
            if not rings or any(len(ring) < 3 for ring in rings):
                raise ValueError("a ring of fewer than three points")
            yield rings
    except (TypeError, ValueError, KeyError) as error:
        problem = f"{where}: wrong coordinates ({error})"
        expected = f"rings of three finite points [x, y] or more, in metres, none beyond {FARTHEST:g}"
        raise MapError(problem, source=path, expected=expected) from error


def _polygons_ring(path: Path) -> Shapes:
    """One polygon from the lines of a CSV file, corner after corner."""
    corners, degrees, notes = read_corners(path)
    if len(corners) < 3:
        raise MapError(f"{len(corners)} corners", source=path, expected="three around an area, or more")
    return Shapes([Feature(None, [[corners]])], WGS84 if degrees else "", notes)


def _corner(point: Any) -> list[float]:
    """x and y of a GeoJSON position; ValueError for anything but plausible numbers."""
    ok = isinstance(point, list) and len(point) >= 2
    if not ok or not all(COORDINATE.accepts(value) for value in point[:2]):
        raise ValueError(f"a point is {reprlib.repr(point)}")
    return [float(value) for value in point[:2]]


READERS: dict[str, Callable[[Path, str], Shapes]] = {
    **dict.fromkeys((".geojson", ".json"), _geojson),
    ".kml": lambda path, number: Shapes([Feature(*each) for each in read_kml(path, MAX_BYTES, number)], WGS84),
    ".gpx": lambda path, number: Shapes([Feature(*each) for each in read_gpx(path, MAX_BYTES)], WGS84),
    ".csv": lambda path, number: _polygons_ring(path),
    **dict.fromkeys(KINDS, _vectors),
}
"""What reads polygons with their numbers of that name, by the end of the file's name."""
