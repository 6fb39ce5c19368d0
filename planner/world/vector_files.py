"""Polygons in GeoJSON, KML, GPX, shapefiles and GeoPackages, and fields of polygons as maps."""

from __future__ import annotations

import contextlib
import math
import re
import reprlib
import sqlite3
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import check_size, is_number, library_errors, printable, read_json
from planner.world.frame import (
    HOW_TO_GIVE_ONE,
    PLAIN_DEGREES,
    TURN,
    WGS84,
    Frame,
    Georeference,
    degree_sides,
    is_degrees,
    principal,
    reproject,
    turn_of,
)
from planner.world.grid import OCCUPIED, WHOLE, Grid, occupied
from planner.world.image_files import read_ros_map
from planner.world.keys import COORDINATE, FARTHEST, THREAT, Key, Quantity
from planner.world.points import (
    IN_METRES,
    LATITUDE,
    LONGITUDE,
    MAX_BYTES,
    MAX_CORNERS,
    Patch,
    Rings,
    X,
    Y,
    boxes_of,
    check_range,
    closed,
    edges,
    extent,
    fine,
    in_range,
    inside,
    read_table,
    unrolled,
    values_over,
)
from planner.world.raster_files import describe, true_metres
from planner.world.robot_types import short_name
from planner.world.world import MAX_CELLS


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


# Shapefiles, GeoPackages, KML and GPX by GDAL (pyogrio). GDAL chooses its driver by content, and some drivers follow
# links: the begin of a file is checked first. What GDAL would read as zero or leave out is an error.


class Kind(NamedTuple):
    """A kind of file that GDAL reads.

    Attributes:
        name: for messages.
        most_bytes: largest file.
        head: pattern of its begin.
        misread: pattern of content that GDAL reads as zero, or leaves out, without an error.
    """

    name: str
    most_bytes: int
    head: bytes
    misread: bytes | None = None


MARKUP = rb"(?s)(?:\xef\xbb\xbf)?(?:\s|<\?.*?\?>|<!--.*?-->)*<(?:\w+:)?%s\b"
"""Begin of XML with this top element, without a document type, whose entities may expand without end."""
DEGREES = rb"""\s*=\s*["']\s*[-+]?[\d.][-+\d.eE]*\s*["']"""
"""The number of an attribute."""
KINDS = {
    ".shp": Kind("a shapefile", 2**26, rb"\x00\x00\x27\x0a"),
    ".gpkg": Kind("a GeoPackage", 2**26, rb"SQLite format 3\x00"),
    ".kml": Kind("KML", MAX_BYTES, MARKUP % b"kml", rb"<(?:\w+:)?coordinates[^<>]*>[^<]*[^-+\d.,eE\s<]"),
    ".gpx": Kind(
        "GPX", MAX_BYTES, MARKUP % b"gpx",
        rb"<(?:\w+:)?(?:trk|rte)pt\b(?!(?=[^>]*\blon" + DEGREES + rb")[^>]*\blat" + DEGREES + rb")[^>]*>",
    ),
}  # fmt: skip
"""Kinds of files by suffix."""
COMPUTED = """
    SELECT name FROM sqlite_master AS one
    WHERE (name LIKE 'gpkg%' OR name IN (SELECT table_name FROM gpkg_contents LIMIT 1000))
    AND (type = 'view' OR EXISTS (SELECT 1 FROM pragma_table_xinfo(one.name) WHERE hidden > 1))
"""
"""Tables of a GeoPackage with computed content, which may be endless."""


SET_CRS = "set it in QGIS, or with ogr2ogr -a_srs; a shapefile's is in its .prj file"
SOUND = f"rings of three finite points [x, y] or more, none beyond {FARTHEST:g}"


def _gdal(path: Path, number: str) -> Shapes:
    """The features of a shapefile, GeoPackage or KML file; open rings are closed, and curves become straight lines."""
    suffix = path.suffix.lower()
    kind = KINDS[suffix]
    data = _checked(path, kind)
    found: list[tuple[Any, Any, Any]] = []
    with library_errors("cannot be read", path, kind.name), warnings.catch_warnings(record=True) as said:
        import pyogrio
        import shapely

        warnings.simplefilter("always")
        for layer in _layers(pyogrio.list_layers(path), path):
            fields = pyogrio.read_info(path, layer=layer)["fields"].tolist()
            named = {field.lower(): field for field in fields if field.lower() in (number, "name")}
            if suffix == ".gpkg" and number in named:
                # A database holds text in columns of numbers too, which GDAL reads as 0.
                text = f"typeof({named[number]}) IN ('text', 'blob')"
                _, wrong, *_ = pyogrio.raw.read(path, layer, where=text, read_geometry=False, return_fids=True)
                if len(wrong):
                    problem = f"feature {wrong[0]}: property {number} is text"
                    raise MapError(problem, source=path, expected="a number, or nothing")
            meta, _, shapes, columns = pyogrio.raw.read(path, layer, columns=[*named.values()], force_2d=True)
            # Only NaN, GDAL's empty field of numbers, differs from itself.
            given = ([None if value != value else value for value in column.tolist()] for column in columns)
            values = dict(zip(named, given, strict=True))
            parts = [values.get(name, [None] * len(shapes)) for name in (number, "name")]
            found += zip(*parts, shapely.from_wkb(shapes, on_invalid="fix"), strict=True)
    # GDAL reads text in a field of numbers as far as it understands it: "0,3" would be 0.
    for problem in (str(warning.message) for warning in said if "parsed incompletely" in str(warning.message)):
        raise MapError(problem, source=path, expected="a number, or nothing", fix="write it with a decimal point")
    if suffix == ".shp" and not fields and any(path.with_suffix(end).exists() for end in (".dbf", ".DBF")):
        raise MapError("its .dbf file cannot be read", source=path, expected=kind.name)
    if suffix == ".kml":
        # Polygons also within collections; placemarks without one are points and lines.
        areas = [
            [one for one in shapely.get_parts(shapely.get_parts(of)) if one.geom_type == "Polygon"] for *_, of in found
        ]
        found = [(*of[:2], shapely.MultiPolygon(held)) for of, held in zip(found, areas, strict=True) if held]
        count = len(re.findall(rb"<(?:\w+:)?Polygon\b", re.sub(rb"(?s)<!--.*?-->", b"", data)))
        if sum(len(shape.geoms) for _, _, shape in found) != count:
            fix = "give every Placemark one geometry (MultiGeometry: several), and every polygon a boundary"
            raise MapError(f"GDAL does not read all of its {count} polygons", source=path, fix=fix)
    return Shapes([_feature(*given, index, path) for index, given in enumerate(found)], meta["crs"])


def _gpx(path: Path, number: str) -> Shapes:
    """Every route and track of a GPX file as the closed line around an area; its segments are joined.

    Those of one or two points, which are frequent in receivers' logs, enclose nothing and are left out.
    """
    _checked(path, KINDS[".gpx"])
    features: list[Feature] = []
    with library_errors("cannot be read", path, "GPX"):
        import pyogrio
        import shapely

        for line in ("route", "track"):
            names = pyogrio.raw.read(path, f"{line}s", columns=["name"], read_geometry=False)[3][0]
            keys = {"columns": [f"{line}_fid"], "force_2d": True}
            _, _, points, (owner,) = pyogrio.raw.read(path, f"{line}_points", **keys)
            corners = shapely.get_coordinates(shapely.from_wkb(points))
            lines = ((corners[owner == number], name) for number, name in enumerate(names))
            features += [Feature(None, [[ring]], short_name(name)) for ring, name in lines if len(ring) > 2]
    return Shapes(features, WGS84)


def _checked(path: Path, kind: Kind) -> bytes:
    """Content of a file of that kind. Raises MapError for another, and for one that GDAL misreads or never ends."""
    check_size(path, kind.most_bytes, MapError, kind.name)
    with library_errors("cannot be read", path, kind.name):
        data = path.read_bytes()
    if re.match(kind.head, data) is None:
        fix = "delete its document type (DOCTYPE)" if b"<!DOCTYPE" in data else ""
        raise MapError(f"does not begin as {kind.name} does", source=path, expected=kind.name, fix=fix)
    if kind.misread and (wrong := re.search(kind.misread, data)):
        problem = f"has {printable(wrong[0].decode(errors='replace'))[-60:]!r}"
        raise MapError(problem, source=path, expected="longitude and latitude in degrees")
    if kind.name == "a GeoPackage":
        # Read-only and immutable: SQLite then creates no journal in the user's folder.
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with library_errors("is damaged", path, kind.name), contextlib.closing(sqlite3.connect(uri, uri=True)) as file:
            computed = file.execute(COMPUTED).fetchone()
        if computed:
            problem = f"{printable(computed[0])[:60]!r} is a view, or has computed columns"
            fix = "copy it into a separate file (ogr2ogr)"
            raise MapError(problem, source=path, expected="plain tables", fix=fix)
    return data


def _layers(layers: Any, path: Path) -> list[int]:
    """Numbers of the layers to read: all of KML, else the only one of polygons."""
    if path.suffix.lower() == ".kml":
        return list(range(len(layers)))
    kinds = {number: str(kind) for number, (_, kind) in enumerate(layers) if kind is not None}
    held = [number for number, kind in kinds.items() if re.search("Polygon|Surface|Unknown|GeometryCollection", kind)]
    held = held or list(kinds)
    if len(held) != 1:
        said = ", ".join(printable(f"{name} ({kind})")[:40] for name, kind in layers[:5])
        fix = "copy the intended one into a separate file (ogr2ogr one.gpkg all.gpkg LAYER)"
        raise MapError(f"its layers are {said}", source=path, expected="one layer of polygons", fix=fix)
    return held


def _feature(number: Any, name: Any, shape: Any, index: int, path: Path) -> Feature:
    """A feature with the values that GDAL or JSON has for it, and its shape."""
    import shapely

    kind = "none" if shape is None else shape.geom_type
    if kind not in ("Polygon", "MultiPolygon"):
        problem = f"features[{index}]: geometry is {kind!r}"
        raise MapError(problem, source=path, expected="Polygon or MultiPolygon")
    rings = [shapely.get_rings(part) for part in shapely.get_parts(shape)]
    polygons = [[shapely.get_coordinates(ring) for ring in part] for part in rings]
    # A ring of three points has four, as the last is the first.
    sound = [len(ring) > 3 and (np.abs(ring) <= FARTHEST).all() for part in polygons for ring in part]
    if not all(sound) or not all(polygons):
        raise MapError(f"features[{index}]: wrong coordinates", source=path, expected=SOUND)
    if isinstance(number, str) and path.suffix.lower() == ".kml" and is_number(number):
        number = float(number)
    return Feature(number, polygons, short_name(name))


# Polygons of any file in metres of the map's frame.


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
    return shapes._replace(features=_on_map(found, crs, frame, georeference, path))


def _on_map(features: list[Feature], crs: str, frame: Frame, georeference: Georeference, path: Path) -> list[Feature]:
    """Features in metres of the map's frame, joined where they were cut at longitude 180."""
    if is_degrees(crs):
        rings = rings_of(features)
        check_range(np.concatenate(rings), "", path)
        Patch.of(frame, georeference).check_order(boxes_of(rings), path)
    corners = frame.at([0, 0, *frame.shape[:1] * 2], [0, frame.shape[1]] * 2)[:, 0]
    # A turn in metres of the frame: the interval of x in which polygons are looked for.
    place = float(corners.min()), float(corners.max()), turn_of(georeference.crs)[0] / georeference.scale[0]
    moved = [
        [[georeference.from_crs(ring, crs, str(path)) for ring in rings] for rings in of.polygons] for of in features
    ]
    return [of._replace(polygons=unrolled(areas, *place)[0]) for of, areas in zip(features, moved, strict=True)]


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
        raise MapError(
            "names no coordinate reference system", source=path, expected="one, on a map that has one", fix=SET_CRS
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
    """The features of a GeoJSON file. GDAL does not tell a file without a CRS from one in degrees, or 1 from true."""
    from shapely.geometry import shape

    data = read_json(path, MAX_BYTES, MapError, "GeoJSON")
    crs, found = "", []
    with contextlib.suppress(KeyError, TypeError):  # none, or none that is named
        crs = str(data["crs"]["properties"]["name"])
    with library_errors("is no GeoJSON", path, "a FeatureCollection, Feature or Polygon, features with properties"):
        kind = data["type"]
        features = (
            data["features"] if kind == "FeatureCollection" else [data if kind == "Feature" else {"geometry": data}]
        )
        given = [(of.get("properties") or {}, of.get("geometry")) for of in features]
        values = [(said.get(number), said.get("name"), geometry) for said, geometry in given]
    for index, (value, name, geometry) in enumerate(values):
        with library_errors(f"features[{index}]: wrong coordinates", path, SOUND):
            flat = geometry and shape({**geometry, "coordinates": _flat(geometry.get("coordinates", []))})
            found.append(_feature(value, name, flat, index, path))
    return Shapes(found, crs)


def _flat(places: Any) -> Any:
    """Nested coordinates without heights. Raises ValueError for a point without two numbers."""
    if isinstance(places, list) and all(isinstance(place, list) for place in places):
        return [_flat(place) for place in places]
    if not isinstance(places, list) or len(places) < 2 or not all(map(COORDINATE.accepts, places[:2])):
        raise ValueError(f"a point is {reprlib.repr(places)}")
    return places[:2]


def _csv(path: Path, number: str) -> Shapes:
    """One polygon from the lines of a CSV file, one corner per line."""
    table = read_table(path, "lines x, y")
    metres, degrees = table.columns(X, Y), table.columns(LONGITUDE, LATITUDE)
    columns = metres or degrees or [0, 1]
    on_earth = columns is degrees
    if not metres and not degrees and len(table.rows[0][1]) != 2:
        raise MapError(table.described, source=path, expected="columns x and y, or lon and lat: a corner a line")
    corners = (table.lonlat if on_earth else table.places)(columns)
    if len(corners) < 3:
        raise MapError(f"{len(corners)} corners", source=path, expected="three around an area, or more")
    return Shapes([Feature(None, [[corners]])], WGS84 if on_earth else "", table.notes)


READERS: dict[str, Callable[[Path, str], Shapes]] = {
    **dict.fromkeys((".geojson", ".json"), _geojson),
    ".csv": _csv,
    **dict.fromkeys(KINDS, _gdal),
    ".gpx": _gpx,
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
    polygons, is_cut, place, notes = _in_metres(shapes, path, cell_size)
    notes = (*shapes.notes, *notes)
    blocks = 1 if swath is None else round(swath / cell_size)
    frame = _frame(polygons, cell_size, path, direction, blocks)
    if place is not None:
        notes += true_metres(frame, place, str(path), "ogr2ogr -t_srs")
    held, crossed = np.zeros(frame.shape, dtype=bool), np.zeros(frame.shape, dtype=bool)
    for rings in polygons:
        held |= inside(rings, frame)
    if boundary == "whole":
        # The edge at which a shape was cut at longitude 180 is inside the field, and no border of the union.
        for rings in _union(polygons) if is_cut else polygons:
            crossed |= touched(rings, frame)
    free = held & ~crossed
    if not free.any():
        raise _no_cell(polygons, place, cell_size, path)
    lost = int((held & crossed).sum())
    if lost:
        notes += (
            f"{lost} cells lie on the field's boundary with their centre inside: they are obstacles "
            "(in a scenario, `map: {polygons: ..., boundary: centre}` makes them free)",
        )
    if any(feature.number is not None for feature in shapes.features):
        notes += ("its property p is not read, as this is the map: name the file under `threats` of a scenario too",)
    return Grid(occupied(~free), frame, str(path), notes=notes, georeference=place, swath=swath)


def _union(polygons: list[Rings]) -> list[Rings]:
    """The union of polygons."""
    import shapely

    with library_errors("its parts across longitude 180 cannot be joined"):
        areas = shapely.make_valid([shapely.Polygon(rings[0], rings[1:]) for rings in polygons])
        rings = [shapely.get_rings(part) for part in shapely.get_parts(shapely.union_all(areas))]
    return [[shapely.get_coordinates(ring) for ring in part] for part in rings]


def touched(rings: Rings, frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells with an edge of the rings through their inside.

    Edges within 1e-6 of a cell's side run along it. Cost: O(edges * H + H * W).

    Args:
        rings: `[points, 2]`, metres.
        frame: of the cells.
    """
    height, width = frame.shape
    counts = np.zeros((height, width + 1), dtype=np.int64)
    # Snapped to the sides of cells: an edge along a side touches no cell.
    for (x0, y0), (x1, y1) in edges(rings, frame, WHOLE):
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


def _no_cell(polygons: list[Rings], place: Georeference | None, cell_size: float, path: Path) -> MapError:
    """The error for a field without free cells: it gives the size of the field, and its position on the Earth."""
    corners = np.concatenate([ring for rings in polygons for ring in rings])
    across, up = np.ptp(corners, axis=0).tolist()
    problem = f"no cell of {cell_size:g} m lies in the field of {across:.4g} x {up:.4g} m"
    fix = "give smaller cells"
    if place is not None:
        problem += f" at {describe(*principal(place.to_lonlat(corners[:1], str(path)))[0].tolist())}"
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


Placed = tuple[list[Rings], bool, Georeference | None, tuple[str, ...]]
"""Polygons in metres of the map's frame, whether they were cut at longitude 180, position on the Earth, notes."""


def _in_metres(shapes: Shapes, path: Path, cell_size: float) -> Placed:
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
        raise MapError("names no CRS, and looks like degrees", source=path, expected="a CRS", fix=SET_CRS)
    crs = shapes.crs or (WGS84 if shapes.crs == "" and small else "")
    if not crs:
        return polygons, False, None, ("its coordinates are read as metres of a local frame: it names no CRS",)
    with library_errors(f"its CRS is {crs[:60]!r}", path, "a CRS that PROJ knows, in degrees or metres"):
        from rasterio.crs import CRS

        known = CRS.from_user_input(crs)
        side = 1.0 if known.is_geographic else float(known.linear_units_factor[1])
    notes: tuple[str, ...] = ()
    if known.is_geographic:
        check_range(corners, "", path)
        polygons = [[reproject(ring, crs, WGS84) for ring in rings] for rings in polygons]
        corners = np.concatenate([ring for rings in polygons for ring in rings])
        place, side, notes = _degrees(corners, path)
    else:
        place = Georeference(crs, scale=(1 / side, 1 / side))
    turn = turn_of(place.crs)[0]
    polygons, width = closed(polygons, turn, cell_size / side)
    areas, is_cut = unrolled(polygons, *extent(corners[:, 0], turn), turn)
    moved = [[place.from_crs(ring, place.crs) for ring in rings] for rings in areas]
    if not all(COORDINATE.accepts(float(np.abs(ring).max())) for rings in moved for ring in rings):
        raise MapError("a corner too far away", source=path, expected=COORDINATE.expected)
    return moved, is_cut, place, (*notes, *_of_the_cut(width * side, cell_size))


def _spans_a_field(corners: NDArray[np.float64]) -> bool:
    """True if (longitude, latitude) `[n, 2]` can be a field's; with a whole turn between them, only one around 180."""
    longitudes = corners[:, 0]
    about = np.ptp(longitudes) <= WIDEST or (np.abs(longitudes) >= TURN / 2 - WIDEST).all()
    west, east = extent(longitudes, TURN)
    return bool(about and east - west <= WIDEST and np.ptp(corners[:, 1]) <= WIDEST and in_range(corners).all())


def _of_the_cut(width: float, cell_size: float) -> tuple[str, ...]:
    """A note on parts with a gap of at least 1 cm where longitudes wrap."""
    if width < 0.01:
        return ()
    what = "are joined there" if width <= cell_size else "stay apart: what lies between, more than a cell, is obstacle"
    return (f"its parts, {width:.2g} m apart where longitudes come round, {what}",)


def _degrees(corners: NDArray[np.float64], path: Path) -> tuple[Georeference, float, tuple[str, ...]]:
    """(metres about the lower-left of (longitude, latitude) `[n, 2]`, metres of a degree of longitude, notes)."""
    check_range(corners, "", path)
    (west, east), (south, north) = extent(corners[:, 0], TURN), (corners[:, 1].min(), corners[:, 1].max())
    if max(east - west, north - south) > WIDEST or max(-south, north) > 89:
        problem = f"lies at longitude {west:.6g} .. {east:.6g}, latitude {south:.6g} .. {north:.6g}"
        expected = f"degrees, -89 .. 89 north, a field of at most {WIDEST:g} degrees"
        raise MapError(problem, source=path, expected=expected, fix="name the file's CRS, if it is another")
    up, across = degree_sides((south + north) / 2)
    off = max(abs(degree_sides(edge)[1] / across - 1) for edge in (south, north))
    note = f"degrees: worked on in metres east and north of {describe(west, float(south))}"
    note += f", {100 * off:.2g} % off at the edges" if off > 1e-3 else ""
    return Georeference(WGS84, (float(west), float(south)), (1 / across, 1 / up)), across, (note,)


# Keep-out areas of a scenario as obstacles of the map: polygons, and occupied pixels of another map.


def keep_out(key: Key, grid: Grid) -> Grid:
    """A map with the keep-out areas as obstacles: pixels whose centre a polygon holds, or that a ROS map occupies.

    Args:
        key: `keepout` of a scenario.
        grid: the map.

    Raises:
        ScenarioError: an invalid key, or an area without pixels.
        MapError: a file is invalid.
    """
    occupancy, notes = grid.occupancy.copy(), list(grid.notes)
    for item in key.items("a list of {polygons: ...} and {layer: ...}"):
        keys = item.mapping(optional=("polygons", "layer"))
        if len(keys) != 1:
            raise item.wrong("one of polygons and layer")
        (kind,) = keys
        if kind == "layer":
            layer = read_ros_map(keys[kind].file("a map_server YAML file"))
            held = values_over(layer, grid.frame) >= OCCUPIED
            notes.extend(f"{item.path}: {note}" for note in layer.notes)
        else:
            path = keys[kind].file("a file of polygons")
            shapes = read_polygons(path, 0.0, grid.frame, grid.georeference)
            held = np.logical_or.reduce([feature.mask(grid.frame) for feature in shapes.features])
            notes += [f"{item.path}: {note}" for note in shapes.notes]
        if not held.any():
            raise keys[kind].wrong("something on the map", "it keeps robots out of no pixel: check its coordinates")
        occupancy[held] = OCCUPIED
        notes.append(f"{item.path}: {int(held.sum())} pixels are kept out of")
    return replace(grid, occupancy=occupancy, notes=tuple(notes))
