"""Export of plans to other formats, chosen by name or by the file's suffix; all files are written, or none."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from analysis.pictures import ROBOT_COLOURS
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.utils.tables import json_text
from planner.arguments import Numbers, argument, did_you_mean
from planner.errors import MapError, UsageError
from planner.files import Json, atomic_write, check_new, printable
from planner.formatting import SPEEDS
from planner.plan.plan import DECIMALS, Plan, headings, last_move, waypoints_csv
from planner.world.frame import TURN, Frame, Georeference, near, principal
from planner.world.raster_bands import affine
from planner.world.world import World

# Common to all formats: a plan on its world, exact probabilities of the open loop, and paths as straight runs.

DEGREES = 9
"""Decimals of longitude and latitude: a tenth of a millimetre."""
ALTITUDE, SPEED = 20.0, 3.0
"""Defaults: metres above the take-off position, and metres a second."""
HIGHEST = 10_000.0


class Stop(NamedTuple):
    """End of a straight run: the step at which a robot arrives, the cell, and the steps that it waits there."""

    step: int
    cell: int
    waits: int


@dataclass(frozen=True, eq=False)
class Mission:
    """A plan for export.

    Attributes:
        world, plan: the map and the paths on it.
        altitude: metres above the take-off position; 0: on the ground. speed: metres a second.
    """

    world: World
    plan: Plan
    altitude: float
    speed: float

    def check(self) -> None:
        """Raise UsageError for an altitude or speed out of range, PlanError for a plan of another map."""
        Numbers(0, HIGHEST, "metres above the ground").check("altitude", self.altitude)
        SPEEDS.check("speed", self.speed)
        self.plan.require(self.world)

    @cached_property
    def exact(self) -> OpenLoopExact:
        """Exact expectations of the open loop."""
        return open_loop_exact(self.plan, self.world)

    @property
    def believed(self) -> str:
        """Prefix of the names of figures that belong to the prior map, where it differs from the true map."""
        return "" if self.world.knowledge is None else "believed_"

    def unknown(self, figures: tuple[str, ...]) -> tuple[str, ...]:
        """A note with the names of those figures that lack an exact value for some cell or robot, and the reason."""
        uncertainty = self.world.uncertainty or self.world.knowledge
        if not figures or uncertainty is None:
            return ()
        covered, lost, survival = self.exact.visited_by_cell, self.exact.stops_by_cell, self.exact.survival
        of = {"covered": covered, "losses": lost, "residual": covered, "chance_of_loss": survival}
        left = [name for name in figures if np.isnan(of[name]).any()]
        if not left:
            return ()
        names = " and ".join(filter(None, (", ".join(left[:-1]), left[-1])))
        return (
            f"{names} omitted where the open loop has no exact value (`evaluate` estimates them): "
            f"{uncertainty.description}",
        )

    @property
    def step_seconds(self) -> float:
        """Seconds for each step."""
        return self.world.cell_size / self.speed

    def stops(self, robot: int) -> list[Stop]:
        """The ends of the straight runs of a robot's path."""
        return straight_runs(self.plan.robots[robot].path)

    def lonlat(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """(longitude, latitude) of the centres of cells, degrees. Raises MapError for a map without georeference."""
        return rounded(principal(on_earth(self.world, self.world.to_xy(cells))))


def on_earth(world: World, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) of points (x, y) in the map frame; longitudes continue beyond 180. Raises MapError."""
    height, width = world.shape
    middle = world.to_lonlat(world.at(height / 2, width / 2))
    assert world.georeference is not None
    return world.georeference.to_lonlat(points, about=middle[0])


def rounded(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(longitude, latitude) with the decimals of files, without -0."""
    return np.round(places, DEGREES) + 0.0


def make_mission(world: World, plan: Plan, altitude: float | None = None, speed: float | None = None) -> Mission:
    """A checked mission. None: ALTITUDE; the speed that the world implies, else SPEED. Raises InputError."""
    if speed is None:
        speed = SPEED if world.pace.seconds is None else world.cell_size / world.pace.seconds
    mission = Mission(world, plan, ALTITUDE if altitude is None else altitude, speed)
    # Check before any file is opened.
    mission.check()
    return mission


def straight_runs(path: NDArray[np.int64]) -> list[Stop]:
    """The ends of a path's straight runs, with the start and the last cell; waiting at the end is omitted."""
    # Plans pad shorter paths by waiting at the end.
    path = path[: last_move(path) + 1]
    moves = np.diff(path)
    stops = [Stop(0, int(path[0]), 0)]
    for step, end in pairwise(np.unique([0, *np.flatnonzero(np.diff(moves)) + 1, len(moves)]).tolist()):
        if moves[step] == 0:
            stops[-1] = stops[-1]._replace(waits=end - step)
        else:
            stops.append(Stop(end, int(path[end]), 0))
    return stops


# Lines and polygons cut at longitude 180 (RFC 7946, section 3.1.9), so that no part spans the whole flat map.

Ring = NDArray[np.float64]
"""Corners (longitude, latitude) `[points, 2]`, closed; longitudes continue beyond 180."""
HALF = TURN / 2
POLE = 90 - 1e-9
"""Latitude from which a corner counts as the pole (0.1 mm)."""


def over_a_pole(ring: Ring) -> bool:
    """True for a closed ring around a pole, or through one: the short steps in longitude do not sum to 0."""
    # Each step is taken the short way around the Earth.
    steps = near(np.diff(ring[:, 0]), 0.0, TURN)
    through = np.abs(np.abs(steps) - HALF) < 1e-6
    return bool(abs(steps.sum()) > HALF or through.any() or (np.abs(ring[:, 1]) >= POLE).any())


def cut_line(line: Ring) -> list[Ring]:
    """The parts of a line with longitudes in -180..180; a line that only touches 180 is not cut."""
    points = [line[0]]
    for (x0, y0), (x1, y1) in pairwise(line):
        low, high = min(x0, x1), max(x0, x1)
        seams = [TURN * n + HALF for n in range(math.floor((low - HALF) / TURN), math.ceil((high - HALF) / TURN) + 1)]
        crossed = sorted((seam for seam in seams if low < seam < high), reverse=bool(x0 > x1))
        points += [np.array([seam, y0 + (seam - x0) * (y1 - y0) / (x1 - x0)]) for seam in crossed]
        points.append(np.array([x1, y1]))
    places = np.array(points)
    # The middle of a segment decides its turn, so that an end on the seam is unambiguous.
    turns = np.floor(((places[:-1, 0] + places[1:, 0]) / 2 + HALF) / TURN)
    ends = [0, *(np.flatnonzero(np.diff(turns)) + 1).tolist(), len(turns)]
    return [places[first : last + 1] - (turns[first] * TURN, 0) for first, last in pairwise(ends)]


def cut_area(rings: list[Ring]) -> list[list[Ring]]:
    """The parts of a polygon (outer ring first, then holes), each as rings with longitudes in -180..180.

    Outer rings are counterclockwise and holes clockwise, before and after.
    """
    import shapely

    low, high = min(ring[:, 0].min() for ring in rings), max(ring[:, 0].max() for ring in rings)
    first, last = math.floor((low + HALF) / TURN), math.ceil((high + HALF) / TURN) - 1
    if last <= first:
        return [[ring - (first * TURN, 0) for ring in rings]]
    area, parts = shapely.make_valid(shapely.Polygon(rings[0], rings[1:])), []
    for turn in range(first, last + 1):
        west, east = turn * TURN - HALF, turn * TURN + HALF
        held = shapely.get_parts(shapely.orient_polygons(area & shapely.box(west, -90, east, 90)))
        for part in (part for part in held if part.geom_type == "Polygon"):
            corners = [
                np.clip(shapely.get_coordinates(ring), (west, -90), (east, 90)) for ring in shapely.get_rings(part)
            ]
            parts.append([ring - (turn * TURN, 0) for ring in corners])
    return parts


def outlines(areas: list[NDArray[np.int64]], shape: tuple[int, int]) -> list[list[NDArray[np.int64]]]:
    """Closed rings (row, col) `[points, 2]` of cell corners around 4-connected areas, each outer ring first.

    Seen with row 0 at the top, outer rings are counterclockwise and holes are clockwise (RFC 7946, section 3.1.6).
    Rings are simple: where two cells meet only in a corner, the outline turns to the other cell.
    """
    from rasterio.features import shapes

    labels = np.zeros(shape, dtype=np.int32)
    for number, cells in enumerate(areas, start=1):
        labels.reshape(-1)[cells] = number
    rings = {int(label): outline["coordinates"] for outline, label in shapes(labels, labels > 0, connectivity=4)}
    return [[np.array(ring, dtype=np.int64)[:, ::-1] for ring in rings[n]] for n in range(1, len(areas) + 1)]


# Paths and areas with their probabilities as GeoJSON (RFC 7946: longitude and latitude, WGS 84).

Position = list[float]


def polygons(world: World, areas: list[NDArray[np.int64]], called: str = "area") -> list[list[list[list[Position]]]]:
    """The parts of each area (cells) in longitude and latitude: closed rings, outer ring first.

    Raises MapError for a map without georeference, and for an area over a pole, which has no such ring; `called`: its
    name in the message.
    """
    found = []
    for number, borders in enumerate(outlines(areas, world.shape)):
        rings = [on_earth(world, world.at(*ring.T)) for ring in borders]
        if any(over_a_pole(ring) for ring in rings):
            problem = f"{called} {number} lies over a pole, and cannot be written in longitude and latitude"
            fix = "export .tif or .csv, in the map's metres, or .gpx, which holds no areas"
            raise MapError(problem, source=world.source, expected="no area over a pole", fix=fix)
        found.append([[rounded(ring).tolist() for ring in part] for part in cut_area(rings)])
    return found


@dataclass(frozen=True)
class Feature:
    """A path or an area in longitude and latitude, with its properties.

    Attributes:
        name: for display. facts: properties.
        is_area: area or path.
        parts: after the cut at longitude 180, usually one: a line of a path, or the closed rings of an area, outer ring
            first.
        points: of a path, uncut.
    """

    name: str
    is_area: bool
    parts: list[list[list[Position]]]
    facts: Json
    points: list[Position] = field(default_factory=list)


def features(mission: Mission) -> Iterator[Feature]:
    """Every area at t = 0, then every robot's path. Raises MapError for a map without georeference."""
    yield from _areas(mission)
    yield from paths(mission)


def _areas(mission: Mission) -> Iterator[Feature]:
    """Every area at t = 0. Raises MapError also for an area over a pole, which has no ring of longitudes and latitudes.

    Properties: `level`, `robot` (to which it is assigned at t = 0), `threat` (its largest), and exact for the open
    loop `covered` (mean probability that its cells are visited) and `losses` (expected robots lost in it). None: no
    exact value. `believed_threat`: of the prior map, if the team does not know the true map.
    """
    world, areas = mission.world, mission.plan.areas
    threat, parts = world.threat.ravel(), polygons(world, [area.cells for area in areas])
    for number, area in enumerate(areas):
        facts = {
            "area": number,
            "level": area.level,
            "robot": None if area.robot < 0 else area.robot,
            "cells": len(area.cells),
            f"{mission.believed}threat": _rounded(threat[area.cells].max()),
            "covered": _rounded(mission.exact.visited_by_cell[area.cells].mean()),
            "losses": _rounded(mission.exact.stops_by_cell[area.cells].sum()),
        }
        yield Feature(f"area {number}", True, parts[number], facts)


def paths(mission: Mission) -> Iterator[Feature]:
    """Every robot's path: `robot`, `steps`, `chance_of_loss` before its end (None: no exact value)."""
    world = mission.world
    for number, robot in enumerate(mission.plan.robots):
        facts = {
            "robot": number,
            "steps": mission.stops(number)[-1].step,
            "cells": len(np.unique(robot.path[robot.entered])),
            "chance_of_loss": _rounded(1 - mission.exact.survival[number]),
        }
        cells = [stop.cell for stop in mission.stops(number)]
        # A LineString needs two points, even if the robot never moves.
        line = np.array(cells if len(cells) > 1 else cells * 2)
        lines = [[rounded(part).tolist()] for part in cut_line(on_earth(world, world.to_xy(line)))]
        yield Feature(f"robot {number}", False, lines, facts, mission.lonlat(line).tolist())


def _rounded(value: float) -> float | None:
    return round(float(value), 9) if isfinite(value) else None


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

KML, GPX = "http://www.opengis.net/kml/2.2", "http://www.topografix.com/GPX/1/1"
UNASSIGNED = "#777777"


def kml(mission: Mission) -> str:
    """Folders of areas and paths on the ground, with properties, in the colours of the robots."""
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
    colour = UNASSIGNED if robot is None else ROBOT_COLOURS[robot % len(ROBOT_COLOURS)]
    # KML colours are aabbggrr.
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
    """A route for every robot, with a point at the end of each straight run."""
    top = Element("gpx", xmlns=GPX, version="1.1", creator="mrac-jax")
    for feature in paths(mission):
        route = SubElement(top, "rte")
        _text(route, "name", feature.name)
        if (chance := feature.facts["chance_of_loss"]) is not None:
            _text(route, "desc", f"chance of loss {chance:.6f}")
        for east, north in feature.points:
            east = -180.0 if east == 180 else east  # GPX longitudes must be below 180
            SubElement(route, "rtept", lat=f"{north:.9f}", lon=f"{east:.9f}")
    return _document(top)


def _text(parent: Element, name: str, text: str) -> None:
    SubElement(parent, name).text = text


def _document(top: Element) -> str:
    indent(top, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(top, encoding="unicode") + "\n"


# Poses for nav2, one file for each robot: the goal of FollowWaypoints or NavigateThroughPoses, as YAML.

POSE = (
    "- header: {{frame_id: map}}\n"
    "  pose:\n"
    "    position: {{x: {x}, y: {y}, z: 0.0}}\n"
    "    orientation: {{x: 0.0, y: 0.0, z: {z}, w: {w}}}\n"
)
"""A geometry_msgs/PoseStamped; stamp 0 means the latest transform."""
PRESUMED = (
    "# A pose ends a straight run along cells of {cell:g} m. Presumed: footprint and inflation fit into a cell, so\n"
    "# that the costmap leaves the straight way free; xy_goal_tolerance of the goal checker is below {half:g} m, so\n"
    "# that the robot turns in that cell. Threats are not in the costmap: a way around something may enter others.\n"
)


def nav2_poses(mission: Mission, robot: int) -> str:
    """`poses:`, the start and the end of every straight run, metres in the map frame.

    A pose faces along the run that it ends. Waiting is omitted: nav2 continues on arrival.
    """
    path = mission.plan.robots[robot].path
    steps = np.array([stop.step for stop in mission.stops(robot)])
    points, yaws = mission.world.to_xy(path[steps]), headings(path, mission.world)[steps]
    poses = [
        POSE.format(x=_number(x), y=_number(y), z=_number(math.sin(yaw / 2), 12), w=_number(math.cos(yaw / 2), 12))
        for (x, y), yaw in zip(points.tolist(), yaws.tolist(), strict=True)
    ]
    cell = mission.world.cell_size
    presumed = PRESUMED.format(cell=cell, half=cell / 2)
    return f"# robot {robot}\n{presumed}poses:\n{''.join(poses)}"


def _number(value: float, decimals: int = DECIMALS) -> str:
    """A float in YAML 1.1 syntax, which needs a decimal point."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


# Plan file of QGroundControl, one for each robot (QGroundControl developer guide, "Plan File Format").

TAKE_OFF, WAYPOINT, CHANGE_SPEED = 22, 16, 178
"""Values of MAV_CMD."""
ABOVE_HOME, NO_PLACE = 3, 2
"""Values of MAV_FRAME: altitudes above the take-off position; an item without a position."""
COPTER, ROVER = 2, 10
"""Values of MAV_TYPE."""
PX4 = 12
"""MAV_AUTOPILOT that QGroundControl assumes without a connected vehicle; all autopilots support the items."""


def qgc_plan(mission: Mission, robot: int) -> str:
    """The `.plan` of a robot: speed, take-off unless it drives (altitude 0), and a waypoint for each straight run.

    Waiting is the hold time of its waypoint. After the last waypoint the autopilot's default applies. Raises MapError
    for a map without georeference.
    """
    stops = mission.stops(robot)
    places = mission.lonlat(np.array([stop.cell for stop in stops])).tolist()
    drives = mission.altitude == 0
    items: list[Json] = [_item(CHANGE_SPEED, NO_PLACE, [1, mission.speed, -1, 0, 0, 0, 0])]
    for number, (stop, (east, north)) in enumerate(zip(stops, places, strict=True)):
        takes_off = number == 0 and not drives
        if takes_off:
            items.append(_placed(TAKE_OFF, 0.0, north, east, mission.altitude))
        if not takes_off or stop.waits:
            hold = stop.waits * mission.step_seconds
            items.append(_placed(WAYPOINT, hold, north, east, mission.altitude))
    for number, item in enumerate(items, start=1):
        item["doJumpId"] = number
    (east, north), *_ = places
    content = {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": mission.speed,
            "firmwareType": PX4,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": mission.speed,
            "items": items,
            "plannedHomePosition": [north, east, 0],
            "vehicleType": ROVER if drives else COPTER,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    return json_text(content)


def _placed(command: int, hold: float, north: float, east: float, altitude: float) -> Json:
    item = _item(command, ABOVE_HOME, [hold, 0, 0, None, north, east, altitude])
    return item | {"AMSLAltAboveTerrain": None, "Altitude": altitude, "AltitudeMode": 1}


def _item(command: int, frame: int, params: list[float | None]) -> Json:
    return {"autoContinue": True, "command": command, "frame": frame, "params": params, "type": "SimpleItem"}


Content = str | bytes


@dataclass(frozen=True)
class Format:
    """An export format.

    Attributes:
        suffixes: of its files, the usual one first.
        whole: content of the file of the team; or `each`: content of the file of a robot.
        on_earth: it holds longitudes and latitudes. figures: names of the exact open-loop figures in it.
    """

    suffixes: tuple[str, ...]
    whole: Callable[[Mission], Content] | None = None
    each: Callable[[Mission, int], Content] | None = None
    on_earth: bool = True
    figures: tuple[str, ...] = ()

    def check(self, world: World) -> None:
        """Raise MapError for a world that the format cannot describe, before a plan is made."""
        if self.on_earth:
            world.to_lonlat((0, 0))

    def names(self, out: Path, robots: int) -> list[Path]:
        """The files for `out`: a folder, or a file (numbered if each of several robots has one)."""
        folder, suffix = is_folder(out), self.suffixes[0]
        if self.each is None:
            return [out / f"plan{suffix}"] if folder else [out]
        if folder:
            return [out / f"robot-{robot}{suffix}" for robot in range(robots)]
        return [out.with_stem(f"{out.stem}-{robot}") for robot in range(robots)] if robots > 1 else [out]

    def contents(self, mission: Mission) -> list[Content]:
        """Contents of these files."""
        if self.each is not None:
            return [self.each(mission, robot) for robot in range(len(mission.plan.robots))]
        assert self.whole is not None
        return [self.whole(mission)]


FORMATS = {
    "qgc": Format((".plan",), each=qgc_plan),
    "nav2": Format((".yaml", ".yml"), each=nav2_poses, on_earth=False),
    "geojson": Format((".geojson", ".json"), geojson, figures=("covered", "losses", "chance_of_loss")),
    "kml": Format((".kml",), kml, figures=("covered", "losses", "chance_of_loss")),
    "gpx": Format((".gpx",), gpx, figures=("chance_of_loss",)),
    "csv": Format((".csv",), lambda mission: waypoints_csv(mission.plan, mission.world), on_earth=False),
    "geotiff": Format((".tif", ".tiff"), geotiff, on_earth=False, figures=("covered", "losses", "residual")),
}
"""Export formats by name."""


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
        known = " ".join(one.suffixes[0] for one in FORMATS.values())
        problem = f"{argument(name, printable(out))}: no format has the suffix {suffix!r}"
        raise UsageError(problem, expected=known, fix=f"or add {argument('to')} {'|'.join(FORMATS)}" * (name == "out"))
    return found[0]


def export(mission: Mission, out: Path, form: Format, spare: Iterable[Path] = (), *, force: bool = True) -> list[Path]:
    """Write the mission and return the files. Nothing is written unless all contents can be made.

    Raises InputError: a map without georeference, an altitude out of range, a file that cannot be written, that is the
    map or one of `spare`, files that were read, or that exists, without `force`.
    """
    names = form.names(out, len(mission.plan.robots))
    check_new(*names, force=force)
    read = {file.resolve() for file in (Path(mission.world.source), *spare)}
    for name in names:
        if name.resolve() in read:
            raise UsageError(f"{printable(name)} is an input and would be overwritten", expected="another file")
    # All contents exist before the first file is written.
    contents = form.contents(mission)
    if is_folder(out):
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            problem = f"{argument('out', printable(out))} cannot be made ({error.strerror})"
            raise UsageError(problem, expected="a folder to write to") from error
    for name, content in zip(names, contents, strict=True):
        with atomic_write(name, "wb" if isinstance(content, bytes) else "w") as file:
            file.write(content)
    return names
