"""Plans for robots: nav2 poses and graphs, QGroundControl, DJI drones, and TAK (Cursor on Target)."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, timedelta
from uuid import NAMESPACE_URL, uuid5
from xml.etree.ElementTree import Element, SubElement, indent, tostring
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np
import yaml
from scipy import ndimage

from analysis.exporting.mission import KML, Feature, Mission, Position, Stop, colour_of, features, polygons
from analysis.utils.tables import json_text
from planner.arguments import Numbers, argument
from planner.errors import PlanError, UsageError
from planner.files import Json
from planner.plan.plan import DECIMALS, headings

# Poses for nav2, one file for each robot: the goal of FollowWaypoints or NavigateThroughPoses, as YAML.

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
    places, turns = np.round(points, DECIMALS) + 0.0, np.round([np.sin(yaws / 2), np.cos(yaws / 2)], 12).T + 0.0
    poses = [  # geometry_msgs/PoseStamped; without a stamp it is 0, the latest transform
        {"header": {"frame_id": "map"}, "pose": {"position": {"x": x, "y": y, "z": 0.0},
                                                 "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w}}}
        for (x, y), (z, w) in zip(places.tolist(), turns.tolist(), strict=True)
    ]  # fmt: skip
    cell = mission.world.cell_size
    presumed = PRESUMED.format(cell=cell, half=cell / 2)
    return f"# robot {robot}\n{presumed}" + yaml.safe_dump({"poses": poses}, sort_keys=False)


# The graph of the areas for nav2's route server: GeoJSON in metres, as its GeoJsonGraphFileLoader reads.


def nav2_route(mission: Mission) -> str:
    """A node in each area, at its cell nearest to the middle, and edges both ways between areas that touch.

    An edge follows the way of least hazard through its two areas. Its metadata hold `survival`, `length` (metres) and
    `penalty`, the hazard -ln(survival), which nav2's PenaltyScorer reads. Raises PlanError for less than two areas.
    """
    import networkx as nx

    world, areas = mission.world, mission.plan.areas
    if len(areas) < 2:
        problem, fix = f"the plan has {len(areas)} areas", "export a plan of the closed loop on a larger map"
        raise PlanError(problem, expected="two areas or more, the nodes of a graph", fix=fix)
    graph = world.to_networkx()
    cells = [np.stack(np.divmod(area.cells, world.shape[1]), axis=1) for area in areas]
    nearest = (own[np.square(own - own.mean(axis=0)).sum(axis=1).argmin()] for own in cells)
    middles = [(int(row), int(col)) for row, col in nearest]
    area_of = {(row, col): number for number, own in enumerate(cells) for row, col in own.tolist()}
    found: list[Json] = []
    for number, (area, middle) in enumerate(zip(areas, middles, strict=True)):
        node: Json = {"id": number, "frame": "map", "metadata": {"level": area.level, "cells": len(area.cells)}}
        found.append(_feature("Point", _metres(mission, [middle])[0], node))
    touching = {(area_of.get(one, -1), area_of.get(other, -1)) for one, other in graph.edges}
    for first, last in sorted((one, other) for one, other in touching if min(one, other) >= 0 and one != other):
        part = graph.subgraph([*map(tuple, np.concatenate([cells[first], cells[last]]).tolist())])
        way = nx.shortest_path(part, middles[first], middles[last], lambda _, __, edge: edge["hazard"] + SHORTER)
        hazard = sum(part.edges[edge]["hazard"] for edge in nx.utils.pairwise(way))
        facts = {"survival": math.exp(-hazard), "penalty": hazard, "length": (len(way) - 1) * world.cell_size}
        ends: Json = {"id": len(found), "startid": first, "endid": last, "cost": 0.0, "overridable": True}
        found.append(_feature("MultiLineString", [_metres(mission, way)], ends | {"metadata": facts}))
    return json_text({"type": "FeatureCollection", "name": "areas", "features": found})


SHORTER = 1e-9
"""Hazard added to each move, so that the shortest of equally safe ways is taken."""


def _feature(kind: str, coordinates: object, properties: Json) -> Json:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _metres(mission: Mission, cells: Sequence[tuple[int, int]]) -> list[list[float]]:
    rows, cols = np.transpose(cells)
    places: list[list[float]] = np.round(mission.world.at(rows + 0.5, cols + 0.5), DECIMALS).tolist()
    return places


# Plan file of QGroundControl, one for each robot (QGroundControl developer guide, "Plan File Format").

TAKE_OFF, WAYPOINT, CHANGE_SPEED = 22, 16, 178
"""Values of MAV_CMD."""
ABOVE_HOME, ABOVE_TERRAIN, NO_PLACE = 3, 10, 2
"""Values of MAV_FRAME: altitudes above the take-off position, above the ground; an item without a position."""
MODES = {ABOVE_HOME: 1, ABOVE_TERRAIN: 4}
"""QGroundControl's altitude mode of each frame."""
COPTER, ROVER = 2, 10
"""Values of MAV_TYPE."""
MOST_ITEMS, MOST_CORNERS = 2**16 - 1, 64
"""Items of a mission in MAVLink, whose numbers have 16 bits; corners of a geofence in PX4 (DM_KEY_FENCE_POINTS_MAX)."""
ARDUPILOT, PX4 = 3, 12
"""MAV_AUTOPILOT that QGroundControl assumes without a connected vehicle. Only ArduPilot takes ABOVE_TERRAIN."""


def qgc_plan(mission: Mission, robot: int) -> str:
    """The `.plan` of a robot: speed, take-off unless it drives (altitude 0), and a waypoint for each straight run.

    Waiting is the hold time of its waypoint. After the last waypoint the autopilot's default applies. The geofence
    holds the cells that the robot can reach, without obstacles and keep-out cells; rally points are the bases. Raises
    MapError for a map without georeference, PlanError for more items than a controller takes.
    """
    stops = mission.stops(robot)
    places = mission.lonlat(np.array([stop.cell for stop in stops])).tolist()
    drives, ground = mission.altitude == 0, mission.terrain
    frame = ABOVE_HOME if ground is None else ABOVE_TERRAIN
    items: list[Json] = [_item(CHANGE_SPEED, NO_PLACE, [1, mission.speed, -1, 0, 0, 0, 0])]
    for number, (stop, (east, north)) in enumerate(zip(stops, places, strict=True)):
        above_sea = None if ground is None else round(float(ground.flat[stop.cell]) + mission.altitude, 2)
        heights = {"AMSLAltAboveTerrain": above_sea, "Altitude": mission.altitude, "AltitudeMode": MODES[frame]}
        takes_off = number == 0 and not drives
        for command in [TAKE_OFF] * takes_off + [WAYPOINT] * (not takes_off or stop.waits > 0):
            hold = stop.waits * mission.step_seconds * (command == WAYPOINT)
            items.append(_item(command, frame, [hold, 0, 0, None, north, east, mission.altitude]) | heights)
    if len(items) > MOST_ITEMS:
        problem, fix = f"robot {robot} has a mission of {len(items):,} items", "export a plan for more robots"
        raise PlanError(problem, expected=f"at most {MOST_ITEMS:,}, which MAVLink can number", fix=fix)
    for number, item in enumerate(items, start=1):
        item["doJumpId"] = number
    (east, north), *_ = places
    rally = [[latitude, longitude, mission.altitude] for longitude, latitude in mission.lonlat(mission.bases).tolist()]
    flown: Json = {"cruiseSpeed": mission.speed, "hoverSpeed": mission.speed, "globalPlanAltitudeMode": MODES[frame]}
    flown |= {"firmwareType": PX4 if ground is None else ARDUPILOT, "vehicleType": ROVER if drives else COPTER}
    flown |= {"items": items, "plannedHomePosition": [north, east, 0], "version": 2}
    content: Json = {"fileType": "Plan", "groundStation": "QGroundControl", "mission": flown, "version": 1}
    content["geoFence"] = {"circles": [], "polygons": _fence(mission, stops[0].cell), "version": 2}
    content["rallyPoints"] = {"points": rally, "version": 2}
    return json_text(content)


def _item(command: int, frame: int, params: list[float | None]) -> Json:
    return {"autoContinue": True, "command": command, "frame": frame, "params": params, "type": "SimpleItem"}


def fence_note(mission: Mission) -> tuple[str, ...]:
    """A note where the geofence has more corners than PX4 takes."""
    starts = {int(robot.path[0]) for robot in mission.plan.robots}
    corners = max(sum(len(one["polygon"]) for one in _fence(mission, start)) for start in starts)
    fix = "fly ArduPilot, or delete it in QGroundControl"
    return (f"the geofence has {corners} corners, and PX4 takes {MOST_CORNERS}: {fix}",) * (corners > MOST_CORNERS)


def _fence(mission: Mission, start: int) -> list[Json]:
    """Polygons of the geofence: the outline of the cells that are connected with `start`, and the holes in it."""
    labels = ndimage.label(mission.world.enterable)[0].ravel()
    (parts,) = polygons(mission.world, [np.flatnonzero(labels == labels[start])])
    return [
        {"inclusion": number == 0, "polygon": [[lat, lon] for lon, lat in ring[:-1]], "version": 1}
        for part in parts
        for number, ring in enumerate(part)
    ]


# DJI: WPML in KMZ files (Cloud API, "DJI WPML"), a file for each flight of each robot.

WPML = "http://www.dji.com/wpmz/1.0.2"
MOST_WAYPOINTS = 99
"""Waypoints of a file: the format allows 65,536, but DJI Fly on consumer drones fails beyond 99."""
BENT = 1.0
"""Metres by which the ground may leave the straight line between two waypoints."""
HEIGHTS, SPEEDS = Numbers(2, 1500, "metres above the ground for wpml"), Numbers(0, 15, "m/s for wpml", above=True)
"""Altitudes and speeds that DJI drones accept."""
CONFIG: Json = {
    "flyToWaylineMode": "safely", "finishAction": "goHome", "exitOnRCLost": "executeLostAction",
    "executeRCLostAction": "goBack",
}  # fmt: skip
DRONE: Json = {"droneEnumValue": 68, "droneSubEnumValue": 0}
"""As DJI Fly writes it. Pilot 2 asks for the drone's own number, for example 77 for the Mavic 3 Enterprise."""
HEADING: Json = {"waypointHeadingMode": "followWayline", "waypointHeadingPathMode": "followBadArc"}
TURN: Json = {"waypointTurnMode": "toPointAndStopWithDiscontinuityCurvature", "waypointTurnDampingDist": 0}


def wpml(mission: Mission) -> dict[str, bytes]:
    """Flights by robot, "0", or by robot and number, "0-1": at most MOST_WAYPOINTS, and no more than a battery lasts.

    Heights are metres above the take-off position; with a terrain, waypoints are added where the ground bends. Robots
    that do not move have no file. Raises UsageError: altitude, speed, or a battery too short for one straight run.
    """
    HEIGHTS.check("altitude", mission.altitude)
    SPEEDS.check("speed", mission.speed)
    files = {}
    for robot in range(len(mission.plan.robots)):
        flights = list(_flights(mission, robot))
        for number, stops in enumerate(flights):
            files[f"{robot}-{number}" if len(flights) > 1 else str(robot)] = _kmz(mission, robot, stops)
    if not files:
        raise PlanError("no robot moves", expected="a path with two waypoints or more")
    return files


def _flights(mission: Mission, robot: int) -> Iterator[list[Stop]]:
    """The stops of each flight, which begins and ends at the robot's start; the next continues from the last stop."""
    stops, cell = _profile(mission, robot), mission.world.cell_size
    points = mission.world.to_xy(np.array([stop.cell for stop in stops]))
    away, legs = np.linalg.norm(points - points[0], axis=1), np.linalg.norm(np.diff(points, axis=0), axis=1)
    # A battery lasts for so many metres: waiting counts as moving, and the climb and the descent as flight.
    limit = math.inf if mission.battery is None else mission.battery * 60 * mission.speed - 2 * mission.altitude
    first = 0
    while first < len(stops) - 1:
        last, flown = first, away[first] + stops[first].waits * cell
        while last - first + 1 < MOST_WAYPOINTS and last + 1 < len(stops):
            more = legs[last] + stops[last + 1].waits * cell
            if flown + more + away[last + 1] > limit:
                break
            last, flown = last + 1, flown + more
        if last == first:
            need = (flown + more + away[first + 1] + 2 * mission.altitude) / mission.speed / 60
            problem = f"{argument('battery', mission.battery)} minutes do not last for a straight run of robot {robot}"
            raise UsageError(problem, expected=f"{need:.1f} or more: there, along it and back")
        yield stops[first : last + 1]
        stops[last], first = stops[last]._replace(waits=0), last


def _profile(mission: Mission, robot: int) -> list[Stop]:
    """The stops of a robot, and between them the cells at which the ground bends by more than BENT."""
    stops = mission.stops(robot)
    if mission.terrain is None:
        return stops
    path = mission.plan.robots[robot].path
    ground, found = mission.terrain.ravel()[path], [stops[0]]

    def between(begin: int, end: int) -> Iterator[Stop]:
        off = np.abs(ground[begin : end + 1] - np.linspace(ground[begin], ground[end], end - begin + 1))
        if off.max() > BENT:
            middle = begin + int(off.argmax())
            yield from (*between(begin, middle), Stop(middle, int(path[middle]), 0), *between(middle, end))

    for stop in stops[1:]:
        found += [*between(found[-1].step + found[-1].waits, stop.step), stop]
    return found


def _kmz(mission: Mission, robot: int, stops: Sequence[Stop]) -> bytes:
    """A flight: `waylines.wpml`, which the drone executes, and `template.kml` without waypoints, as DJI Fly does."""
    cells = np.array([stop.cell for stop in stops])
    heights, highest = np.full(len(cells), mission.altitude), mission.altitude
    if mission.terrain is not None:
        rise = mission.terrain - mission.terrain.flat[mission.plan.robots[robot].path[0]]
        heights, highest = heights + rise.flat[cells], highest + max(float(np.nanmax(rise)), 0.0)
    config = CONFIG | {"takeOffSecurityHeight": round(highest, 2), "globalTransitionalSpeed": mission.speed}
    config |= {"globalRTHHeight": round(highest, 2), "droneInfo": DRONE}
    flown = [
        {"Point": {"coordinates": f"{east:.9f},{north:.9f}"}, "index": number, "executeHeight": height}
        | {"waypointSpeed": mission.speed, "waypointHeadingParam": HEADING, "waypointTurnParam": TURN}
        | {"useStraightLine": 1} | (_hover(number, stop.waits * mission.step_seconds) if stop.waits else {})
        for number, (stop, (east, north), height) in enumerate(
            zip(stops, mission.lonlat(cells).tolist(), np.round(heights, 2).tolist(), strict=True)
        )
    ]  # fmt: skip
    folder: Json = {"templateId": 0, "waylineId": 0, "executeHeightMode": "relativeToStartPoint"}
    folder |= {"autoFlightSpeed": mission.speed, "Placemark": flown}
    contents = {"template.kml": {"missionConfig": config}, "waylines.wpml": {"missionConfig": config, "Folder": folder}}
    spaces = {"@xmlns": KML, "@xmlns:wpml": WPML}
    return zipped({
        f"wpmz/{name}": xml_text("kml", spaces | {"Document": content}, "wpml:") for name, content in contents.items()
    })  # fmt: skip


def _hover(number: int, seconds: float) -> Json:
    """The action of a waypoint at which the robot waits."""
    act = {"actionId": 0, "actionActuatorFunc": "hover", "actionActuatorFuncParam": {"hoverTime": round(seconds, 1)}}
    group = {"actionGroupId": number, "actionGroupStartIndex": number, "actionGroupEndIndex": number}
    when = {"actionGroupMode": "sequence", "actionTrigger": {"actionTriggerType": "reachPoint"}}
    return {"actionGroup": group | when | {"action": act}}


# XML files from mappings, and ZIP archives of texts.

OF_KML = ("Document", "Folder", "Placemark", "Point", "coordinates")
"""Elements that keep their names where all others have a prefix."""


def xml_text(name: str, content: Json, prefix: str = "") -> str:
    """The text of an XML file with this top element.

    Args:
        name: of the element.
        content: by name of an element its content: a text or number, a mapping, or a list of these, an element each.
            "@name" is an attribute, "#" the text beside attributes.
        prefix: of the elements that are not KML's.
    """
    top = Element(name)
    _fill(top, content, prefix)
    indent(top, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(top, encoding="unicode") + "\n"


def _fill(parent: Element, content: object, prefix: str) -> None:
    for name, value in (content if isinstance(content, Mapping) else {"#": content}).items():
        if name == "#":
            parent.text = str(value)
        elif name.startswith("@"):
            parent.set(name[1:], str(value))
        else:
            for one in value if isinstance(value, list) else [value]:
                _fill(SubElement(parent, name if name in OF_KML else f"{prefix}{name}"), one, prefix)


def zipped(files: Mapping[str, str]) -> bytes:
    """A ZIP archive of texts; equal texts give equal bytes."""
    out = io.BytesIO()
    with ZipFile(out, "w") as archive:
        for name, text in files.items():
            archive.writestr(ZipInfo(name), text, ZIP_DEFLATED)
    return out.getvalue()


# TAK (ATAK, WinTAK, iTAK): a data package of Cursor on Target events, which its import takes.

UNKNOWN = "9999999.0"
"""Height and errors that are not known."""
STALE_DAYS = 7


def cot(mission: Mission) -> bytes:
    """A data package (.zip): a point for each base, a shape for each area, without its holes, a route for each path.

    Identifiers follow from the map and the name, so that a later package replaces an earlier one's events.
    """
    icon = {"usericon": {"@iconsetpath": "COT_MAPPING_SPOTMAP/b-m-p-s-m/-1"}}
    bases = mission.lonlat(mission.bases).tolist()
    shapes: list[tuple[str, Position, str, Json, Json]] = [
        (f"base {number}", place, "b-m-p-s-m", icon, {}) for number, place in enumerate(bases)
    ]
    for feature in features(mission):
        for number, part in enumerate(feature.parts):
            name = feature.name if len(feature.parts) == 1 else f"{feature.name}.{number}"
            look = _area(feature, part[0]) if feature.is_area else _route(feature, part[0], name)
            shapes.append((name, part[0][0], *look, feature.facts))
    package, files, entries, now = f"mrac-jax:{mission.world.sha256}", {}, [], mission.now.astimezone(UTC)
    moments = {"time": now, "start": now, "stale": now + timedelta(days=STALE_DAYS)}
    times = {f"@{key}": moment.strftime("%Y-%m-%dT%H:%M:%SZ") for key, moment in moments.items()}
    for name, (east, north), kind, details, facts in shapes:
        uid = uuid5(NAMESPACE_URL, f"{package}:{name}")
        entry = {"@ignore": "false", "@zipEntry": f"{uid}/{uid}.cot", "Parameter": {"@name": "uid", "@value": uid}}
        entries.append(entry)
        point = {"@lat": f"{north:.9f}", "@lon": f"{east:.9f}"} | dict.fromkeys(("@hae", "@ce", "@le"), UNKNOWN)
        remarks = ", ".join(f"{key} {value}" for key, value in facts.items() if value is not None)
        details = details | {"contact": {"@callsign": name}, "remarks": remarks, "archive": {}}
        event = {"@version": "2.0", "@uid": uid, "@type": kind, "@how": "h-e"} | times
        files[f"{uid}/{uid}.cot"] = xml_text("event", event | {"point": point, "detail": details})
    settings = {"uid": uuid5(NAMESPACE_URL, package), "name": mission.world.name, "onReceiveImport": "true"}
    listed = {"Parameter": [{"@name": key, "@value": value} for key, value in settings.items()]}
    manifest = {"@version": "2", "Configuration": listed, "Contents": {"Content": entries}}
    return zipped({"MANIFEST/manifest.xml": xml_text("MissionPackageManifest", manifest)} | files)


def _colours(feature: Feature) -> tuple[int, int]:
    """The colour of its robot, solid and pale: TAK's are 32-bit integers with a sign, alpha first."""
    red_green_blue = int(colour_of(feature)[1:], 16)
    return red_green_blue - 2**24, red_green_blue | 0x40 << 24


def _area(feature: Feature, ring: list[Position]) -> tuple[str, Json]:
    """An area as a closed free form: its type, and its details."""
    solid, pale = _colours(feature)
    links = [{"@point": f"{north:.9f},{east:.9f}"} for east, north in ring]
    look = {"strokeColor": solid, "strokeWeight": "2.0", "fillColor": pale, "labels_on": "false"}
    return "u-d-f", {"link": links} | {name: {"@value": value} for name, value in look.items()}


def _route(feature: Feature, line: list[Position], name: str) -> tuple[str, Json]:
    """A path as a route of check points: its type, and its details."""
    ends = {0: "SP", len(line) - 1: "EP"}
    links = [
        {"@uid": f"{name}-{number}", "@callsign": ends.get(number, ""), "@relation": "c"}
        | {"@type": "b-m-p-w" if number in ends else "b-m-p-c", "@point": f"{north:.9f},{east:.9f},{UNKNOWN}"}
        for number, (east, north) in enumerate(line)
    ]
    look = {"@color": _colours(feature)[0], "@method": "Flying", "@prefix": "CP", "@direction": "Infil"}
    look |= {"@routetype": "Primary", "@order": "Ascending Check Points", "@stroke": "3"}
    return "b-m-r", {"link": links, "link_attr": look, "__routeinfo": {}}
