"""Polygons in GeoJSON, KML, GPX, shapefiles and GeoPackages, and fields of polygons as maps."""

from __future__ import annotations

import contextlib
import math
import re
import reprlib
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import Json, check_size, library_errors, printable, read_json
from planner.world.grid import (
    FREE,
    HOW_TO_GIVE_ONE,
    OCCUPIED,
    PLAIN_DEGREES,
    TURN,
    WGS84,
    WHOLE,
    Frame,
    Georeference,
    Grid,
    degree_sides,
    is_degrees,
    principal,
    rasterio_for,
    reproject,
    turn_of,
)
from planner.world.image_files import FULL, read_ros_map
from planner.world.keys import COORDINATE, FARTHEST, THREAT, Key, Quantity
from planner.world.points import (
    IN_METRES,
    MAX_BYTES,
    MAX_CORNERS,
    Patch,
    Rings,
    Unrolled,
    boxes_of,
    check_range,
    closed,
    extent,
    fine,
    in_range,
    inside,
    read_corners,
    unrolled,
    values_over,
)
from planner.world.raster_files import describe, true_metres
from planner.world.robot_types import short_name
from planner.world.world import MAX_CELLS

# Shapefiles and GeoPackages as GeoJSON objects, by pyogrio (GDAL): only complete files without computed content.

MOST_BYTES = 2**26
"""Largest file of the two kinds, and of the parts of a shapefile (64 MiB)."""
KINDS = {".shp": "a shapefile", ".gpkg": "a GeoPackage"}
"""Suffixes of these files."""
POLYGON, MULTIPOLYGON, POINT_BYTES = 3, 6, 16
"""WKB: types of geometries, and the bytes of two float64."""
OTHERS = {1: "Point", 2: "LineString", 4: "MultiPoint", 5: "MultiLineString", 7: "GeometryCollection", 16: "TIN"}
WHOLE_FILE = "a file that was copied as a whole"


def read_vectors(path: Path, number: str) -> tuple[list[Json], str | None]:
    """Read the features of a shapefile or GeoPackage.

    From a GeoPackage the only layer that may hold polygons; curves become short straight lines.

    Args:
        path: the file.
        number: name of the field with numbers.

    Returns:
        (features as in GeoJSON, with that field and "name"; the CRS, None if the file names none).

    Raises:
        MapError: the file is incomplete, of another kind or too large, or pyogrio is missing.
    """
    pyogrio = _pyogrio(path)
    check_size(path, MOST_BYTES, MapError, KINDS[path.suffix.lower()])
    # GDAL would read an incomplete file as far as it goes, and polygons would be missing without an error.
    (_check_shapefile if path.suffix.lower() == ".shp" else _check_geopackage)(path)
    with library_errors("cannot be read", path, KINDS[path.suffix.lower()]):
        layer = _layer(pyogrio.list_layers(path), path)
        # Before GDAL reads the numbers, since it turns text into 0.
        _check_numbers(_stored(path, layer, number), number, path)
        fields = pyogrio.read_info(path, layer=layer)["fields"].tolist()
        named = [field for field in fields if field.lower() in (number, "name")]
        # Heights of the corners are not used, and a limit of features bounds the memory.
        meta, _, shapes, columns = pyogrio.raw.read(
            path, layer=layer, columns=named, force_2d=True, max_features=MAX_CORNERS
        )
    corners = sum(len(shape or b"") for shape in shapes) // POINT_BYTES
    if corners > MAX_CORNERS:
        raise MapError(f"some {corners} corners", source=path, expected=f"at most {MAX_CORNERS}", fix="simplify it")
    said = {str(field).lower(): column.tolist() for field, column in zip(meta["fields"], columns, strict=True)}
    features = [
        {
            # Only NaN differs from itself: that is how pyogrio returns an empty field.
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
    """The only layer of polygons; layers of points and lines are ignored if there is one."""
    names = [(str(name), str(kind)) for name, kind in layers if kind is not None and kind != "None"]
    held = [name for name, kind in names if "Polygon" in kind or kind in ("Unknown", "GeometryCollection")]
    if len(held) == 1 or (not held and len(names) == 1):
        return held[0] if held else names[0][0]
    if not names:
        raise MapError("has no layer with places", source=path, expected="one layer of polygons")
    said = ", ".join(printable(f"{name} ({kind})")[:40] for name, kind in names[:5])
    fix = "copy the intended one into a separate file (ogr2ogr one.gpkg all.gpkg LAYER)"
    raise MapError(f"its layers are {said}", source=path, expected="one layer of polygons", fix=fix)


def _check_shapefile(path: Path) -> None:
    """Raise an error unless the file, its index and its table exist and are as long as their headers say."""
    for suffix in (".shp", ".shx", ".dbf"):
        part = path if suffix == ".shp" else _beside(path, suffix)
        if part is None:
            if suffix == ".dbf":
                continue  # without it only the numbers are missing
            raise MapError(f"there is no {path.stem}{suffix} in its folder", source=path, expected="all of a shapefile")
        check_size(part, MOST_BYTES, MapError, "a part of a shapefile")
        with part.open("rb") as file:
            head = file.read(100)
        # 9994, big-endian, begins both the file and its index.
        if suffix != ".dbf" and (len(head) < 100 or head[:4] != b"\x00\x00\x27\x0a"):
            raise MapError(f"{part.name} is no part of a shapefile", source=path, expected=KINDS[".shp"])
        if len(head) < 32:
            raise MapError(f"{part.name} is cut off", source=path, expected=WHOLE_FILE)
        records, skip, each = struct.unpack_from("<IHH", head, 4)
        # A table counts bytes, the other two 16-bit words.
        claimed = records * each + skip if suffix == ".dbf" else 2 * struct.unpack_from(">i", head, 24)[0]
        if claimed > part.stat().st_size:
            problem = f"{part.name} claims {claimed} bytes and has {part.stat().st_size}"
            raise MapError(problem, source=path, expected=WHOLE_FILE)


def _beside(path: Path, suffix: str) -> Path | None:
    """The part of a shapefile with this suffix, in lower or upper case."""
    return next((part for end in (suffix, suffix.upper()) if (part := path.with_suffix(end)).exists()), None)


def _check_geopackage(path: Path) -> None:
    """Raise an error unless it is a complete database with stored tables: a view may run forever."""
    try:
        with path.open("rb") as file:
            if file.read(16) != b"SQLite format 3\0":
                raise MapError("is no database of SQLite", source=path, expected=KINDS[".gpkg"])
        # Read-only and immutable: SQLite then creates no journal in the user's folder.
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
            # Opening a database does not check its pages.
            (state,) = database.execute("PRAGMA quick_check(1)").fetchone()
            if state != "ok":
                raise MapError(f"is damaged ({printable(state)[:80]})", source=path, expected=WHOLE_FILE)
            _check_tables(database, path)
    except (sqlite3.Error, UnicodeDecodeError, OSError) as error:  # SQLite quotes damaged names in its errors
        raise MapError(f"is damaged ({error})", source=path, expected=WHOLE_FILE) from error


def _check_tables(database: sqlite3.Connection, path: Path) -> None:
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master"))
    if kinds.get("gpkg_contents") != "table":
        raise MapError("has no table gpkg_contents", source=path, expected=KINDS[".gpkg"])
    # The limit bounds the work on a hostile file.
    shown = {str(name) for (name,) in database.execute("SELECT table_name FROM gpkg_contents LIMIT 1000")}
    for name in sorted((shown | {name for name in kinds if name.startswith("gpkg_")}) & kinds.keys()):
        computed = database.execute("SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden > 1", (name,))
        if kinds[name] == "view" or computed.fetchone()[0]:
            problem = f"{printable(name)[:60]!r} is a view, or has computed columns"
            fix = "copy it into a separate file (ogr2ogr)"
            raise MapError(problem, source=path, expected="plain tables", fix=fix)


def _check_numbers(stored: Iterable[object], number: str, path: Path) -> None:
    """Raise an error for text instead of a number: GDAL reads it as 0, so that a threat would be lost."""
    for index, value in enumerate(stored):
        if isinstance(value, str | bytes):
            text = value.decode("latin-1") if isinstance(value, bytes) else value
            problem = f"features[{index}]: property {number} is {reprlib.repr(text)}, which is no number"
            fix = "write it with a decimal point" if "," in text else ""
            raise MapError(problem, source=path, expected="a number, or nothing", fix=fix)


def _stored(path: Path, layer: str, number: str) -> Iterable[object]:
    """Content of a field, feature by feature, before GDAL converts it to numbers."""
    if path.suffix.lower() == ".shp":
        table = _beside(path, ".dbf")
        # Shapefiles keep their numbers in the table, as text of fixed width.
        return () if table is None else _dbf_numbers(table.read_bytes(), number)
    # The layer's name comes from the file: quotes in it are doubled.
    uri, quoted = f"{path.resolve().as_uri()}?mode=ro&immutable=1", layer.replace('"', '""')
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as database:
        names = [str(name) for (name,) in database.execute("SELECT name FROM pragma_table_info(?)", (layer,))]
        if number not in map(str.lower, names):
            return ()
        rows = database.execute(f'SELECT "{number}" FROM "{quoted}" LIMIT {MAX_CORNERS}')
        return [value for (value,) in rows]


def _dbf_numbers(table: bytes, number: str) -> Iterator[object]:
    """A numeric field in every record that is not deleted: None, a float, or bytes that are no number."""
    records, skip, each = struct.unpack_from("<IHH", table, 4)
    start = 1
    # Descriptions of fields: 32 bytes each, after a header of 32 bytes.
    for at in range(32, skip - 31, 32):
        name, kind, width = table[at : at + 11].split(b"\0")[0], table[at + 11 : at + 12], table[at + 16]
        if name.decode("latin-1").lower() == number and kind in (b"N", b"F"):
            for record in range(skip, skip + records * each, each):
                # An asterisk marks a deleted record; GDAL skips it too, so features and numbers stay aligned.
                if table[record : record + 1] != b"*":
                    yield _dbf_number(table[record + start : record + start + width].strip(b" \0"))
            return
        start += width


def _dbf_number(text: bytes) -> float | bytes | None:
    if not text or text.startswith(b"*"):
        return None  # a number that did not fit into the field's width
    return float(text) if re.fullmatch(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text) else text


def _geometry(shape: bytes | None) -> Json:
    """A WKB geometry (little-endian, as GDAL's) as in GeoJSON; of other kinds than polygons the type only."""
    if not shape:
        return {"type": "none"}
    # The first byte is the byte order, and then comes the type.
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
    """Rings of the polygon at that position, and its end."""
    (count,), at, rings = struct.unpack_from("<I", shape, at + 5), at + 9, []
    for _ in range(count):
        (points,) = struct.unpack_from("<I", shape, at)
        rings.append(np.frombuffer(shape, "<f8", 2 * points, at + 4).reshape(-1, 2).tolist())
        at += 4 + POINT_BYTES * points
    return rings, at


# Polygons in KML and GPX. Entities are never expanded: a document type is rejected at once.

Places = NDArray[np.float64]
Placemark = tuple[float | str | None, list[list[Places]], str]
"""(number, rings, place in the file)."""


def read_kml(path: Path, most_bytes: int, name: str = "p") -> list[Placemark]:
    """Read the Placemarks with polygons.

    Args:
        path: the file.
        most_bytes: largest file.
        name: of the Data or SimpleData element with the number.

    Returns:
        (number, its text if invalid, or None; polygons with rings `[points, 2]` of longitude and latitude; name).

    Raises:
        MapError: the file is invalid.
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
    """Read every track and route as the closed line around an area: (None, polygons, name).

    Those of fewer than three points, which are frequent in receivers' logs, enclose nothing and are left out.

    Args:
        path: the file.
        most_bytes: largest file.

    Raises:
        MapError: the file is invalid.
    """
    found: list[Placemark] = []
    for index, line in enumerate(_named(read_xml(path, most_bytes, "gpx"), "trk", "rte")):
        points = [(point.get("lon"), point.get("lat")) for point in _named(line, "trkpt", "rtept")]
        # Fewer than three points enclose no area.
        if len(points) > 2:
            found.append((None, [[_markup_ring(points, f"line {index}", path)]], _own_name(line)))
    return found


def read_xml(path: Path, most_bytes: int, root: str) -> Element:
    """Read an XML file of a kind.

    Args:
        path: the file.
        most_bytes: largest file.
        root: name of the top element.

    Returns:
        The top element; names without namespaces.

    Raises:
        MapError: the file is invalid, or has a document type.
    """
    check_size(path, most_bytes, MapError, f"{root.upper()} (XML)")

    # Entities are declared in a document type: without one, no entity can expand to gigabytes.
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
    except MapError:  # from `refuse`
        raise
    except (OSError, ValueError, LookupError) as error:  # not readable; an unknown encoding
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


# Polygons in metres of the map's frame: GeoJSON, KML, GPX, shapefiles, GeoPackages.


class Feature(NamedTuple):
    """A feature of a file: its number (p), its polygons as lists of rings `[points, 2]`, and its name."""

    number: Any
    polygons: list[Rings]
    name: str = ""

    def mask(self, frame: Frame) -> NDArray[np.bool_]:
        """bool `[H, W]`: pixels whose centre is in the feature."""
        return np.logical_or.reduce([inside(rings, frame) for rings in self.polygons] or [np.zeros(frame.shape, bool)])


def rings_of(features: Iterable[Feature]) -> Rings:
    """All rings of the features."""
    return [ring for feature in features for rings in feature.polygons for ring in rings]


class Shapes(NamedTuple):
    """Features of a file in its own coordinates, the name of their CRS, and notes.

    crs "": not given, and not required (GeoJSON); None: not given, but required.
    """

    features: list[Feature]
    crs: str | None = ""
    notes: tuple[str, ...] = ()


def read_polygons(
    path: Path, default: float | None, frame: Frame, georeference: Georeference | None, of: Quantity = THREAT
) -> Shapes:
    """Read every feature of a file on a map.

    Polygons may have holes. On a map without georeference coordinates are metres of its frame. On a georeferenced map
    they are in the file's `crs`; without one they are longitude and latitude if they lie on the map as such (RFC 7946,
    section 4), else metres.

    Args:
        path: the file.
        default: number of features without one; None: required.
        frame: of the map.
        georeference: of the map, or None.
        of: quantity of the number, and name of its property.

    Returns:
        The features, with rings float64 `[points, 2]` in metres.

    Raises:
        MapError: names the feature.
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
    """Features in metres of the map's frame, joined where they were cut at longitude 180."""
    if is_degrees(crs):
        rings = rings_of(features)
        check_range(np.concatenate(rings), "", path)
        Patch.of(frame, georeference).check_order(boxes_of(rings), path)
    corners = frame.at([0, 0, *frame.shape[:1] * 2], [0, frame.shape[1]] * 2)[:, 0]
    # A turn in metres of the frame: the interval of x in which polygons are looked for.
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
    """Read the features of a file with polygons, in its own coordinates.

    Args:
        path: the file.
        of: quantity of their number.

    Raises:
        MapError: the file is invalid, or of another kind.
    """
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
    """The CRS of the coordinates, "" for metres of the frame; MapError if a file mixes both."""
    if shapes.crs is None:
        fix = "set it in QGIS, or with ogr2ogr -a_srs; a shapefile's is in its .prj file"
        raise MapError(
            "names no coordinate reference system", source=path, expected="one, on a map that has one", fix=fix
        )
    if shapes.crs:
        return shapes.crs
    rings, patch = rings_of(shapes.features), Patch.of(frame, georeference)
    # Without a CRS, coordinates are degrees only if they lie on the map as such.
    if not patch.meets(boxes_of(rings)).any():
        metres = frame.local(np.concatenate(rings)) / frame.size
        off = (metres.max(axis=0) < 0).any() or (metres.min(axis=0) > frame.shape[::-1]).any()
        if off or fine(np.concatenate(rings)):
            patch.check_order(boxes_of(rings), path)
        return ""
    degrees = [bool(in_range(ring).all()) for ring in rings]
    if not all(degrees):
        wrong = rings[degrees.index(False)][0].tolist()
        problem = f"mixes longitude and latitude with other coordinates, as {wrong}"
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
    """One polygon from the lines of a CSV file, one corner per line."""
    corners, degrees, notes = read_corners(path)
    if len(corners) < 3:
        raise MapError(f"{len(corners)} corners", source=path, expected="three around an area, or more")
    return Shapes([Feature(None, [[corners]])], WGS84 if degrees else "", notes)


def _corner(point: Any) -> list[float]:
    """x and y of a GeoJSON position; ValueError unless they are plausible numbers."""
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
"""Readers of polygons by file suffix; the second argument is the name of their number."""


# A field as a map: cells inside polygons are free, all others obstacles.

SUFFIXES = (".geojson", ".kml", ".gpx", ".shp", ".gpkg")
"""Suffixes of files that are read as a field if given as a map; `map: {polygons: ...}` accepts all polygon files."""
BOUNDARIES = ("whole", "centre")
"""Which cells are free: those that are completely inside the field, or those whose centre is."""
WIDEST = 3.0
"""Largest extent of a field in degrees: larger coordinates are metres of a local frame."""


def read_field(
    path: Path, cell_size: float, boundary: str = BOUNDARIES[0], direction: float = 0.0, swath: float | None = None
) -> Grid:
    """Read the polygons of a file as a map, in cells counted from their upper-left corner.

    In degrees the frame is metres east and north of the lower-left corner, to scale at the middle latitude; in another
    CRS its own metres.

    Args:
        path: the file.
        cell_size: metres.
        boundary: "whole": a cell is free if it is inside a polygon and no edge runs through it; "centre": if its centre
            is inside one.
        direction: of the rows, radians counter-clockwise from x (east).
        swath: side of the squares of cells that a visit covers, a whole number of cells; each cell then has value 1,
            so that coverage is counted in cells.

    Raises:
        MapError: the file is invalid, or no cell is free.
    """
    shapes = read_shapes(path)
    (polygons, borders), place, notes = _in_metres(shapes, path, cell_size)
    notes = (*shapes.notes, *notes)
    blocks = 1 if swath is None else round(swath / cell_size)
    frame = _frame(polygons, cell_size, path, direction, blocks)
    if place is not None:
        notes += true_metres(frame, place, str(path), "ogr2ogr -t_srs")
    held, crossed = np.zeros(frame.shape, dtype=bool), np.zeros(frame.shape, dtype=bool)
    for rings in polygons:
        held |= inside(rings, frame)
    # Borders, not areas: the edge at which a shape was cut at longitude 180 is inside the field.
    for rings in borders if boundary == "whole" else ():
        crossed |= touched(rings, frame)
    free = held & ~crossed
    if not free.any():
        raise _no_cell(polygons, place, cell_size, boundary, path)
    lost = int((held & crossed).sum())
    if lost:
        notes += (
            f"{lost} cells lie on the field's boundary with their centre inside: they are obstacles "
            "(in a scenario, `map: {polygons: ..., boundary: centre}` makes them free)",
        )
    if any(feature.number is not None for feature in shapes.features):
        notes += ("its property p is not read, as this is the map: name the file under `threats` of a scenario too",)
    state = np.where(free, FREE, OCCUPIED).astype(np.uint8)
    worth = None if swath is None else np.ones(frame.shape)
    return Grid(state, frame, str(path), notes=notes, georeference=place, value=worth, swath=swath)


def touched(rings: Rings, frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells with an edge of the rings through their inside.

    Edges within 1e-6 of a cell's side run along it. Cost: O(edges * H + H * W).

    Args:
        rings: `[points, 2]`, metres.
        frame: of the cells.
    """
    height, width = frame.shape
    counts = np.zeros((height, width + 1), dtype=np.int64)
    for ring in rings:
        corners = frame.local(ring) / frame.size
        corners[:, 1] = height - corners[:, 1]
        # Snapped to the sides of cells: an edge along a side touches no cell.
        corners = np.where(np.abs(corners - np.rint(corners)) < WHOLE, np.rint(corners), corners)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            low, high = sorted((y0, y1))
            rows = np.arange(max(math.floor(low), 0), min(math.ceil(high), height))
            if not len(rows):
                continue  # along a side, or off the grid
            slope = (x1 - x0) / (y1 - y0) if y1 != y0 else 0.0
            at = [x0 + (np.clip(edge, low, high) - y0) * slope for edge in (rows, rows + 1)]
            # A horizontal edge covers all columns between its ends.
            at = at if slope or x0 == x1 else [np.array([x0]), np.array([x1])]
            first = np.clip(np.floor(np.minimum(*at) + WHOLE), 0, width).astype(int)
            after = np.clip(np.ceil(np.maximum(*at) - WHOLE), 0, width).astype(int)
            counts[rows, first] += 1
            counts[rows, np.maximum(first, after)] -= 1
    return np.cumsum(counts, axis=1)[:, :width] > 0


def _no_cell(
    polygons: list[Rings], place: Georeference | None, cell_size: float, boundary: str, path: Path
) -> MapError:
    """The error for a field without free cells: it gives the size of the field, and its position if in degrees."""
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    across, up = np.ptp(corners, axis=0).tolist()
    problem = f"no cell of {cell_size:g} m lies {'whole' if boundary == 'whole' else 'with its centre'} in the field"
    problem, fix = f"{problem} of {across:.4g} x {up:.4g} m", "give smaller cells"
    if place is not None:
        (east, north), *_ = principal(place.to_lonlat(corners[:1], str(path))).tolist()
        problem += f" at {describe(east, north)}"
    if place is not None and place.crs == WGS84:
        fix += ", or swap latitude and longitude if it does not lie there"
    return MapError(problem, source=path, fix=fix)


def _frame(polygons: list[Rings], cell_size: float, path: Path, yaw: float, blocks: int) -> Frame:
    """Cells from the upper-left corner of all polygons, where blocks of pixels begin too, to beyond the lower-right.

    Corners, rows and columns are those of a frame turned by `yaw`; blocks of `blocks` x `blocks` cells are complete.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    # Rotated by -yaw, so that rows and columns are parallel to the axes.
    turned = np.concatenate([ring for rings in polygons for ring in rings]) @ [[cos, -sin], [sin, cos]]
    low, high = turned.min(axis=0), turned.max(axis=0)
    side = blocks * cell_size
    width, height = (blocks * max(math.ceil(span / side - WHOLE), 1) for span in high - low)
    if height * width > MAX_CELLS:
        problem = f"a field of {high[0] - low[0]:g} x {high[1] - low[1]:g} m makes {width} x {height} cells"
        raise MapError(problem, source=path, expected=f"at most {MAX_CELLS}", fix="give larger cells")
    left, bottom = float(low[0]), float(high[1]) - height * cell_size
    return Frame((height, width), cell_size, (cos * left - sin * bottom, sin * left + cos * bottom, yaw))


def _in_metres(shapes: Shapes, path: Path, cell_size: float) -> tuple[Unrolled, Georeference | None, tuple[str, ...]]:
    """The polygons in metres of the map's frame, its position on the Earth, and notes."""
    polygons = [rings for feature in shapes.features for rings in feature.polygons]
    if not polygons:
        raise MapError("holds no polygon", source=path, expected="the boundary of a field")
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    # A field is small: only then can coordinates without a CRS be degrees.
    small, swapped = _spans_a_field(corners), _spans_a_field(corners[:, ::-1])
    tiny = bool((np.ptp(corners, axis=0) < cell_size).all())
    if not shapes.crs and swapped and not small and (tiny or fine(corners)):
        check_range(corners, "", path)
    if shapes.crs is None and small:
        fix = "set it in QGIS, or with ogr2ogr -a_srs; a shapefile's is in its .prj file"
        raise MapError("names no CRS, and looks like degrees", source=path, expected="a CRS", fix=fix)
    crs = shapes.crs or (WGS84 if shapes.crs == "" and small else "")
    if not crs:
        return (
            Unrolled(polygons, polygons),
            None,
            ("its coordinates are read as metres of a local frame: it names no CRS",),
        )
    if crs == WGS84:
        return _degrees(polygons, path, cell_size)
    with library_errors(f"its CRS is {crs[:60]!r}", path, "a CRS that PROJ knows, in degrees or metres"):
        known = rasterio_for("another coordinate reference system", path).crs.CRS.from_user_input(crs)
        if known.is_geographic:
            check_range(corners, "", path)
            moved = [[reproject(ring, crs, WGS84) for ring in rings] for rings in polygons]
            return _degrees(moved, path, cell_size)
        unit = float(known.linear_units_factor[1])
    place, turn = Georeference(crs, scale=(1 / unit, 1 / unit)), turn_of(crs)[0]
    polygons, width = closed(polygons, turn, cell_size / unit)
    shape = unrolled(polygons, *extent(corners[:, 0], turn), turn)
    if not all(COORDINATE.accepts(float(np.abs(ring).max() * unit)) for rings in shape.areas for ring in rings):
        raise MapError("a corner too far away", source=path, expected=COORDINATE.expected)
    return _moved(shape, lambda ring: ring * unit), place, _of_the_cut(width * unit, cell_size)


def _spans_a_field(corners: NDArray[np.float64]) -> bool:
    """True if (longitude, latitude) `[n, 2]` can be a field's; with a whole turn between them, only one around 180."""
    longitudes = corners[:, 0]
    about = np.ptp(longitudes) <= WIDEST or (np.abs(longitudes) >= TURN / 2 - WIDEST).all()
    west, east = extent(longitudes, TURN)
    return bool(about and east - west <= WIDEST and np.ptp(corners[:, 1]) <= WIDEST and in_range(corners).all())


def _moved(shape: Unrolled, to: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Unrolled:
    """The shape with transformed rings."""
    areas, borders = ([[to(ring) for ring in rings] for rings in part] for part in shape)
    return Unrolled(areas, borders)


def _of_the_cut(width: float, cell_size: float) -> tuple[str, ...]:
    """A note on parts with a gap of at least 1 cm where longitudes wrap."""
    if width < 0.01:
        return ()
    what = "are joined there" if width <= cell_size else "stay apart: what lies between, more than a cell, is obstacle"
    return (f"its parts, {width:.2g} m apart where longitudes come round, {what}",)


def _degrees(polygons: list[Rings], path: Path, cell_size: float) -> tuple[Unrolled, Georeference, tuple[str, ...]]:
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    check_range(corners, "", path)
    (west, east), (south, north) = extent(corners[:, 0], TURN), (corners[:, 1].min(), corners[:, 1].max())
    if max(east - west, north - south) > WIDEST or max(-south, north) > 89:
        problem = f"lies at longitude {west:.6g} .. {east:.6g}, latitude {south:.6g} .. {north:.6g}"
        expected = f"degrees, -89 .. 89 north, a field of at most {WIDEST:g} degrees"
        raise MapError(problem, source=path, expected=expected, fix="name the file's CRS, if it is another")
    up, across = degree_sides((south + north) / 2)
    place = Georeference(WGS84, (float(west), float(south)), (1 / across, 1 / up))
    off = max(abs(degree_sides(edge)[1] / across - 1) for edge in (south, north))
    note = f"degrees: worked on in metres east and north of {describe(west, float(south))}"
    note += f", {100 * off:.2g} % off at the edges" if off > 1e-3 else ""
    polygons, width = closed(polygons, TURN, cell_size / across)
    shape = unrolled(polygons, west, east, TURN)
    return (
        _moved(shape, lambda ring: place.from_crs(ring, WGS84)),
        place,
        (note, *_of_the_cut(width * across, cell_size)),
    )


# Keep-out areas of a scenario as obstacles of the map: polygons, and occupied pixels of another map.

FIELD_KEYS = ("polygons", "layer")


def keep_out(key: Key, grid: Grid) -> Grid:
    """A map with the keep-out areas as obstacles: pixels whose centre a polygon holds, or that a ROS map occupies.

    Args:
        key: `keepout` of a scenario.
        grid: the map.

    Raises:
        ScenarioError: an invalid key, or an area without pixels.
        MapError: a file is invalid.
    """
    state, notes = grid.state.copy(), list(grid.notes)
    for item in key.items("a list of {polygons: ...} and {layer: ...}"):
        keys = item.mapping(optional=FIELD_KEYS)
        if len(keys) != 1:
            raise item.wrong("one of polygons and layer")
        (kind,) = keys
        if kind == "layer":
            layer = read_ros_map(keys[kind].file("a map_server YAML file"))
            held = values_over(layer, grid.frame) >= FULL
            notes.extend(f"{item.path}: {note}" for note in layer.notes)
        else:
            path = keys[kind].file("a file of polygons")
            shapes = read_polygons(path, 0.0, grid.frame, grid.georeference)
            held = np.logical_or.reduce([feature.mask(grid.frame) for feature in shapes.features])
            notes += [f"{item.path}: {note}" for note in shapes.notes]
        if not held.any():
            raise keys[kind].wrong("something on the map", "it keeps robots out of no pixel: check its coordinates")
        state[held] = OCCUPIED
        notes.append(f"{item.path}: {int(held.sum())} pixels are kept out of")
    return replace(grid, state=state, notes=tuple(notes))
