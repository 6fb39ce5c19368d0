"""Polygons in KML and GPX. No entity is ever followed: a document type is refused as soon as it is met."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import check_size
from planner.worlds.degrees import check_range
from planner.worlds.sources import short_name

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
            polygons.append([_ring(_tuples(ring.text or ""), f"Placemark {index}", path) for ring in rings])
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
            found.append((None, [[_ring(points, f"line {index}", path)]], _own_name(line)))
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


def _ring(points: list[tuple[str | None, str | None]], where: str, path: Path) -> Places:
    try:
        ring = np.array([(float(lon or "nan"), float(lat or "nan")) for lon, lat in points]).reshape(-1, 2)
    except ValueError as error:
        raise MapError(f"{where}: {error}", source=path, expected="longitude and latitude in degrees") from error
    check_range(ring, f"{where}: ", path)
    if len(ring) < 3:
        raise MapError(f"{where} has {len(ring)} points", source=path, expected="three around an area, or more")
    return ring
