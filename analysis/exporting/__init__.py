"""Exports of plans to ground stations, robots and GIS, by a table of formats; all files are written, or none."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.exporting.flight import cot, fence_note, nav2_poses, nav2_route, qgc_plan, wpml, xml_text
from analysis.exporting.mission import KML, Feature, Mission, Position, colour_of, features, paths
from analysis.utils.tables import make_folder
from planner.arguments import argument, did_you_mean
from planner.errors import UsageError
from planner.files import Json, atomic_write, check_new, printable
from planner.plan.plan import waypoints_csv
from planner.world.frame import Frame, Georeference
from planner.world.raster_bands import affine
from planner.world.world import World

# Paths and areas with their probabilities as GeoJSON (RFC 7946: longitude and latitude, WGS 84).


def geojson(mission: Mission) -> str:
    """A FeatureCollection of `features`: Polygons and LineStrings, of several parts where longitude 180 cuts them."""
    collection = [
        {"type": "Feature", "properties": {"name": feature.name} | feature.facts, "geometry": _geometry(feature)}
        for feature in features(mission)
    ]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in collection)
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'


def _geometry(feature: Feature) -> Json:
    kind = "Polygon" if feature.is_area else "LineString"
    parts = feature.parts if feature.is_area else [line for (line,) in feature.parts]
    if len(parts) == 1:
        return {"type": kind, "coordinates": parts[0]}
    return {"type": f"Multi{kind}", "coordinates": parts}


# The map and figures of its cells as a GeoTIFF, in the CRS of the map's file.

BANDS = {
    "threat": "probability that one visit destroys a robot",
    "covered": "probability that the cell is visited (open loop, exact)",
    "losses": "expected robots lost in the cell (open loop, exact)",
    "residual": "residual risk: threat * (1 - covered)",
}


def geotiff(mission: Mission) -> bytes:
    """The bands BANDS without those that have no value in any cell.

    If the team does not know the true map: `believed_threat` and `believed_residual`, of the prior map.
    """
    world, shape = mission.world, mission.world.shape
    threat, covered = world.threat.astype(np.float64), mission.exact.visited_by_cell.reshape(shape)
    losses = mission.exact.stops_by_cell.reshape(shape)
    bands = dict(zip(BANDS, (threat, covered, losses, threat * (1 - covered)), strict=True))
    known = {name: band for name, band in bands.items() if np.isfinite(band).any()}
    names = {name: BANDS[name] for name in known}
    if mission.believed:
        names = {f"believed_{n}" if n in ("threat", "residual") else n: words for n, words in names.items()}
    return raster(world, names, np.stack(list(known.values())))


def raster(world: World, names: Mapping[str, str], bands: NDArray[np.float64]) -> bytes:
    """Bands `[B, H, W]` as float32, NaN on obstacles; `names`: name and description of each.

    A map without georeference has no CRS.
    """
    import rasterio

    shape, bands = world.shape, np.where(world.free, bands, np.nan)
    frame, place = Frame(shape, world.cell_size, world.origin), world.georeference or Georeference("")
    height, width = shape
    with (
        rasterio.io.MemoryFile() as memory,
        memory.open(
            driver="GTiff", width=width, height=height, count=len(names), dtype="float32", nodata=math.nan,
            crs=place.crs or None, transform=rasterio.Affine(*affine(frame, place)), compress="deflate",
        ) as data,
    ):  # fmt: skip
        data.write(bands.astype(np.float32))
        for band, (name, words) in enumerate(names.items(), start=1):
            data.set_band_description(band, name)
            data.update_tags(band, meaning=words)
        data.close()
        return bytes(memory.read())


# KML 2.2 (Google Earth, QGIS) and GPX 1.1 (GPS receivers): both in longitude and latitude, WGS 84.

GPX = "http://www.topografix.com/GPX/1/1"


def kml(mission: Mission) -> str:
    """Folders of areas and paths on the ground, with properties, in the colours of the robots."""
    found = [*features(mission)]
    folders = [
        {"name": name, "Placemark": [_placemark(one) for one in found if one.is_area == is_area]}
        for name, is_area in (("areas", True), ("paths", False))
    ]
    document = {"name": printable(mission.world.source), "Folder": [one for one in folders if one["Placemark"]]}
    return xml_text("kml", {"@xmlns": KML, "Document": document})


def _placemark(feature: Feature) -> Json:
    # KML colours are aabbggrr.
    colour = colour_of(feature)
    bgr = colour[5:7] + colour[3:5] + colour[1:3]
    data = [{"@name": name, "value": "" if value is None else value} for name, value in feature.facts.items()]
    if feature.is_area:
        borders = [[{"LinearRing": _coordinates(ring)} for ring in part] for part in feature.parts]
        shapes: Json = {"Polygon": [{"outerBoundaryIs": one[0], "innerBoundaryIs": one[1:]} for one in borders]}
    else:
        shapes = {"LineString": [{"tessellate": 1} | _coordinates(line) for (line,) in feature.parts]}
    style = {"LineStyle": {"color": f"ff{bgr}", "width": 1 if feature.is_area else 2}}
    style |= {"PolyStyle": {"color": f"40{bgr}"}} if feature.is_area else {}
    whole = shapes if len(feature.parts) == 1 else {"MultiGeometry": shapes}
    return {"name": feature.name, "Style": style, "ExtendedData": {"Data": data}} | whole


def _coordinates(points: list[Position]) -> Json:
    return {"coordinates": " ".join(f"{east:.9f},{north:.9f}" for east, north in points)}


def gpx(mission: Mission) -> str:
    """A route for every robot, with a point at the end of each straight run."""
    routes = []
    for feature in paths(mission):
        chance = feature.facts["chance_of_loss"]
        # GPX longitudes must be below 180.
        points = [
            {"@lat": f"{north:.9f}", "@lon": f"{east if east < 180 else -180:.9f}"} for east, north in feature.points
        ]
        note = {} if chance is None else {"desc": f"chance of loss {chance:.6f}"}
        routes.append({"name": feature.name} | note | {"rtept": points})
    return xml_text("gpx", {"@xmlns": GPX, "@version": "1.1", "@creator": "mrac-jax", "rte": routes})


# The table of formats: a new one is a function of a Mission and a line.


def waypoints(mission: Mission) -> str:
    """Every step of every robot as CSV; with a terrain, z: metres above the zero of its heights."""
    lines = waypoints_csv(mission.plan, mission.world).splitlines()
    if mission.terrain is not None:
        path = np.concatenate([robot.path for robot in mission.plan.robots])
        heights = mission.terrain.ravel()[path] + mission.altitude
        lines = [f"{lines[0]},z", *(f"{line},{z:.2f}" for line, z in zip(lines[1:], heights.tolist(), strict=True))]
    return "\n".join([*lines, ""])


Content = str | bytes
Make = Callable[[Mission], Mapping[str, Content]]
"""Contents of files by label: "" for one file of the team, else the robot's number, or more."""


def _whole(write: Callable[[Mission], Content]) -> Make:
    """One file of the team."""
    return lambda mission: {"": write(mission)}


def _each(write: Callable[[Mission, int], Content]) -> Make:
    """A file of each robot."""
    return lambda mission: {str(robot): write(mission, robot) for robot in range(len(mission.plan.robots))}


@dataclass(frozen=True)
class Format:
    """An export format.

    Attributes:
        suffixes: of its files, the usual one first. make: the contents of its files.
        on_earth: it holds longitudes and latitudes. figures: names of the exact open-loop figures in it.
        takes: which of `terrain` and `battery` it uses. remarks: notes on its files.
    """

    suffixes: tuple[str, ...]
    make: Make
    on_earth: bool = True
    figures: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    remarks: Callable[[Mission], tuple[str, ...]] = lambda mission: ()

    def notes(self, mission: Mission) -> tuple[str, ...]:
        """Notes on the export of a mission."""
        return mission.unknown(self.figures) + self.remarks(mission)

    def check(self, world: World) -> None:
        """Raise MapError for a world that the format cannot describe, before a plan is made."""
        if self.on_earth:
            world.to_lonlat((0, 0))

    def name(self, out: Path, label: str, count: int) -> Path:
        """The file for `out`: in a folder, or a file (labelled if it is one of several)."""
        if is_folder(out):
            return out / f"{f'robot-{label}' if label else 'plan'}{self.suffixes[0]}"
        return out.with_stem(f"{out.stem}-{label}") if count > 1 else out


CHANCES = ("covered", "losses", "chance_of_loss")
FORMATS = {
    "qgc": Format((".plan",), _each(qgc_plan), takes=("terrain",), remarks=fence_note),
    "nav2": Format((".yaml", ".yml"), _each(nav2_poses), on_earth=False),
    "geojson": Format((".geojson", ".json"), _whole(geojson), figures=CHANCES),
    "kml": Format((".kml",), _whole(kml), figures=CHANCES),
    "gpx": Format((".gpx",), _whole(gpx), figures=("chance_of_loss",)),
    "csv": Format((".csv",), _whole(waypoints), on_earth=False, takes=("terrain",)),
    "geotiff": Format((".tif", ".tiff"), _whole(geotiff), on_earth=False, figures=("covered", "losses", "residual")),
    "wpml": Format((".kmz",), wpml, takes=("terrain", "battery")),
    "cot": Format((".zip",), _whole(cot), figures=CHANCES),
    "nav2_route": Format((".geojson", ".json"), _whole(nav2_route), on_earth=False),
}
"""Export formats by name; a suffix stands for the first one that has it."""


def is_folder(out: Path) -> bool:
    """True for an existing folder, and for a name without a suffix."""
    return out.is_dir() or not out.suffix


def choose_format(out: Path, to: str | None, name: str = "out") -> Format:
    """The format `to`, else that of the suffix of `out`. Raises UsageError that names the argument `name`."""
    if to is not None and to not in FORMATS:
        raise UsageError(argument("to", to), expected=" or ".join(FORMATS), fix=did_you_mean(to, FORMATS))
    suffix = "" if is_folder(out) else out.suffix.lower()
    if to is not None:
        if suffix and suffix not in FORMATS[to].suffixes:
            expected = f"{' or '.join(FORMATS[to].suffixes)} for {to}, or a folder"
            raise UsageError(f"{argument(name, str(out))} ends in {suffix!r}", expected=expected)
        return FORMATS[to]
    found = [one for one in FORMATS.values() if suffix in one.suffixes]
    if not found:
        known = " ".join(dict.fromkeys(one.suffixes[0] for one in FORMATS.values()))
        problem = f"{argument(name, printable(out))}: no format has the suffix {suffix!r}"
        raise UsageError(problem, expected=known, fix=f"or add {argument('to')} {'|'.join(FORMATS)}" * (name == "out"))
    return found[0]


def _check_not_read(file: Path, read: set[Path]) -> None:
    if file.resolve() in read:
        raise UsageError(f"{printable(file)} is an input and would be overwritten", expected="another file")


def export(
    mission: Mission, out: Path, form: Format, *, spare: Iterable[Path] = (), force: bool = True
) -> tuple[list[Path], tuple[str, ...]]:
    """Write a mission in a format. Nothing is written unless all contents can be made.

    Args:
        mission: as `make_mission` returns it.
        out, form: a file or a folder, and the format.
        spare: files that were read, apart from the map.
        force: whether existing files are replaced.

    Returns:
        (files, notes).

    Raises:
        InputError: a map without georeference, a file that cannot be written, that was read, or that exists, without
            `force`; an option that the format ignores.
    """
    for option in ("terrain", "battery"):
        if getattr(mission, option) is not None and option not in form.takes:
            able = " or ".join(name for name, one in FORMATS.items() if option in one.takes)
            raise UsageError(f"{argument(option)} with a format that ignores it", expected=able, fix="leave it out")
    read = {file.resolve() for file in (Path(mission.world.source), *spare)}
    _check_not_read(out, read)
    # All contents exist before the first file is written.
    contents = form.make(mission)
    files = {form.name(out, label, len(contents)): content for label, content in contents.items()}
    check_new(*files, force=force)
    for name in files:
        _check_not_read(name, read)
    if is_folder(out):
        make_folder(out, "out")
    for name, content in files.items():
        with atomic_write(name, "wb" if isinstance(content, bytes) else "w") as file:
            file.write(content)
    return list(files), form.notes(mission)
