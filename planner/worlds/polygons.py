"""Polygons in files, as metres of the map's frame: GeoJSON, KML, GPX, shapefiles, GeoPackages."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import Json, read_json
from planner.worlds.degrees import Patch, Rings, boxes_of, check_range, fine, in_range, unrolled
from planner.worlds.georeference import HOW_TO_GIVE_ONE, PLAIN_DEGREES, WGS84, Georeference, is_degrees, turn_of
from planner.worlds.grid import Frame
from planner.worlds.markup import read_gpx, read_kml
from planner.worlds.points import read_corners
from planner.worlds.quantities import COORDINATE, FARTHEST, THREAT, Quantity
from planner.worlds.shapes import IN_METRES, MAX_BYTES, MAX_CORNERS, inside
from planner.worlds.sources import short_name
from planner.worlds.vectors import KINDS, read_vectors


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


def _ring(path: Path) -> Shapes:
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
    ".csv": lambda path, number: _ring(path),
    **dict.fromkeys(KINDS, _vectors),
}
"""What reads polygons with their numbers of that name, by the end of the file's name."""
