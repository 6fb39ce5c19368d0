"""KML 2.2 (Google Earth, QGIS) and GPX 1.1 (GPS receivers): both in longitude and latitude, WGS 84."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from analysis.exporting.features import Feature, Position, features, paths
from analysis.exporting.mission import Mission
from analysis.pictures.style import ROBOT_COLOURS
from planner.files import printable

KML, GPX = "http://www.opengis.net/kml/2.2", "http://www.topografix.com/GPX/1/1"
NOBODYS = "#777777"


def kml(mission: Mission) -> str:
    """Folders of areas and paths on the ground, each with its facts, in the colours of the robots."""
    top = Element("kml", xmlns=KML)
    document = SubElement(top, "Document")
    _text(document, "name", printable(mission.world.source))
    folders: dict[bool, Element] = {}
    for feature in features(mission):
        if feature.is_area not in folders:
            folders[feature.is_area] = SubElement(document, "Folder")
            _text(folders[feature.is_area], "name", "areas" if feature.is_area else "paths")
        _placemark(folders[feature.is_area], feature)
    return _document(top)


def _placemark(folder: Element, feature: Feature) -> None:
    place = SubElement(folder, "Placemark")
    _text(place, "name", feature.name)
    robot = feature.facts["robot"]
    colour = NOBODYS if robot is None else ROBOT_COLOURS[robot % len(ROBOT_COLOURS)]
    bgr = colour[5:7] + colour[3:5] + colour[1:3]
    style = SubElement(place, "Style")
    line = SubElement(style, "LineStyle")
    _text(line, "color", f"ff{bgr}")
    _text(line, "width", "1" if feature.is_area else "2")
    if feature.is_area:
        _text(SubElement(style, "PolyStyle"), "color", f"40{bgr}")
    data = SubElement(place, "ExtendedData")
    for name, value in feature.facts.items():
        _text(SubElement(data, "Data", name=name), "value", "" if value is None else str(value))
    parent = place if len(feature.parts) == 1 else SubElement(place, "MultiGeometry")
    for part in feature.parts:
        if not feature.is_area:
            path = SubElement(parent, "LineString")
            _text(path, "tessellate", "1")
            _coordinates(path, part[0])
            continue
        polygon = SubElement(parent, "Polygon")
        for number, ring in enumerate(part):
            border = SubElement(polygon, "innerBoundaryIs" if number else "outerBoundaryIs")
            _coordinates(SubElement(border, "LinearRing"), ring)


def _coordinates(parent: Element, points: list[Position]) -> None:
    _text(parent, "coordinates", " ".join(f"{east:.9f},{north:.9f}" for east, north in points))


def gpx(mission: Mission) -> str:
    """A route for every robot, a point at the end of each straight run."""
    top = Element("gpx", xmlns=GPX, version="1.1", creator="mrac-jax")
    for feature in paths(mission):
        route = SubElement(top, "rte")
        _text(route, "name", feature.name)
        if (chance := feature.facts["chance_of_loss"]) is not None:
            _text(route, "desc", f"chance of loss {chance:.6f}")
        for east, north in feature.points:
            east = -180.0 if east == 180 else east  # GPX has longitudes below 180 alone
            SubElement(route, "rtept", lat=f"{north:.9f}", lon=f"{east:.9f}")
    return _document(top)


def _text(parent: Element, name: str, text: str) -> None:
    SubElement(parent, name).text = text


def _document(top: Element) -> str:
    indent(top, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(top, encoding="unicode") + "\n"
