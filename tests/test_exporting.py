"""Ways out: every format read back, by other means than ours, gives the plan's cells; hostile and wrong input."""

import csv
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import rasterio
import yaml
from helpers import ROOT, error_of
from jsonschema import Draft202012Validator
from lxml import etree
from matplotlib.path import Path as Outline
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mission_raw.mission_raw import MissionImportData, MissionRaw
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rasterio.features import rasterize

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.cli.options import COMMANDS
from analysis.exporting import FORMATS
from analysis.exporting.mission import cut_area, cut_line, make_mission, outlines, straight_runs
from planner.errors import InputError, MapError, PlanError, UsageError
from planner.plan.plan import Plan, RobotPlan
from planner.world.frame import Georeference
from planner.world.world import World

KML, GPX = "{http://www.opengis.net/kml/2.2}", "{http://www.topografix.com/GPX/1/1}"
PLACES = {
    "utm": (Georeference("EPSG:32633"), (500_000.0, 5_761_038.0, 0.3)),
    "degrees": (Georeference("EPSG:4326", (-84.4, 36.6), (1.1e-5, 9e-6)), (0.0, 0.0, 0.0)),
    "feet": (Georeference("EPSG:2263", (3.28, 0.0), (3937 / 1200, 3937 / 1200)), (300_000.0, 61_000.0, 0.0)),
}


def a_world(place: str = "utm") -> World:
    """7 x 9 cells of 4 m with a wall and a danger, somewhere on the Earth."""
    threat = np.zeros((7, 9))
    threat[2, 1:6], threat[4:6, 3:8] = np.nan, 0.2
    georeference, origin = PLACES[place]
    return World.create(threat, cell_size=4.0, origin=origin, georeference=georeference)


@pytest.fixture(scope="module", params=PLACES)
def mission(request: pytest.FixtureRequest) -> tuple[World, Plan]:
    world = a_world(request.param)
    return world, mrac.plan(world, robots=2)


def cells_of(world: World, places: list[list[float]]) -> list[int]:
    """The cells of the straight lines between longitudes and latitudes."""
    place = world.georeference
    return cells_along(world, (metres(place.crs, places) - place.origin) / place.scale)


def metres(crs: Any, places: Any) -> np.ndarray:
    """Longitudes and latitudes in a CRS (PROJ)."""
    return np.transpose(rasterio.warp.transform("EPSG:4326", crs, *zip(*places, strict=True)))


def cells_along(world: World, points: np.ndarray) -> list[int]:
    """The cells of the straight lines from point to point, metres in the map frame."""
    fine = [points[:1]]
    for one, other in pairwise(points):
        count = round(float(np.abs(other - one).max()) / world.cell_size * 8) + 1
        fine.append(one + (other - one) * (np.arange(1, count + 1) / count)[:, None])
    x, y = (np.concatenate(fine) - world.origin[:2]).T
    cos, sin = math.cos(world.origin[2]), math.sin(world.origin[2])
    rows = world.shape[0] - 1 - np.floor((cos * y - sin * x) / world.cell_size)
    cells = (rows * world.shape[1] + np.floor((cos * x + sin * y) / world.cell_size)).astype(int).tolist()
    return without_waits(cells)


def without_waits(cells: list[int]) -> list[int]:
    return [cells[0], *(other for one, other in pairwise(cells) if one != other)]


def routes(name: str, files: list[Path]) -> list[list[list[float]]]:
    """(longitude, latitude) of every robot, as a program of the format's users would find them."""
    if name == "qgc":
        return [[[item.y / 1e7, item.x / 1e7] for item in uploaded(file).mission_items[1:]] for file in files]
    if name == "geojson":
        features = json.loads(files[0].read_text())["features"]
        return [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "LineString"]
    if name == "wpml":
        return [[place_of(mark) for mark in waylines(file).iter(f"{KML}Placemark")] for file in files]
    if name == "cot":
        found = [event for event in events(files[0]) if event.attrib["type"] == "b-m-r"]
        return [[linked(link) for link in event.iter("link")] for event in found]
    top = etree.parse(files[0]).getroot()
    if name == "gpx":
        found = [route.findall(f"{GPX}rtept") for route in top.findall(f"{GPX}rte")]
        return [[[float(point.attrib["lon"]), float(point.attrib["lat"])] for point in route] for route in found]
    lines = [line.findtext(f"{KML}coordinates") or "" for line in top.iter(f"{KML}LineString")]
    return [[[float(part) for part in place.split(",")] for place in line.split()] for line in lines]


def uploaded(file: Path) -> MissionImportData:
    """What MAVSDK reads in a `.plan` for a vehicle: messages of a mission, a geofence, and rally points."""
    station = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    station.add_any_connection("raw://")
    # It reads for a vehicle that it has heard of.
    vehicle = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, mavlink.MAV_STATE_STANDBY, 3
    station.pass_received_raw_bytes(mavlink.MAVLink_heartbeat_message(*vehicle).pack(mavlink.MAVLink(None, 1, 1)))
    found = MissionRaw(station.first_autopilot()).import_qgroundcontrol_mission(str(file))
    station.destroy()
    return found


def named(enum: str, values: list[int]) -> list[str]:
    """Names of MAVLink without the prefix."""
    return [mavlink.enums[enum][value].name.removeprefix(f"{enum}_") for value in values]


def waylines(file: Path) -> etree._Element:
    """What a DJI drone executes."""
    with ZipFile(file) as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        return etree.fromstring(archive.read("wpmz/waylines.wpml"))


def place_of(mark: etree._Element) -> list[float]:
    return [float(part) for part in (mark.findtext(f"{KML}Point/{KML}coordinates") or "").split(",")]


def events(file: Path) -> list[etree._Element]:
    """The Cursor on Target events that the manifest of a data package lists."""
    with ZipFile(file) as archive:
        manifest = etree.fromstring(archive.read("MANIFEST/manifest.xml"))
        assert (manifest.tag, manifest.attrib) == ("MissionPackageManifest", {"version": "2"})
        listed = [one.attrib["zipEntry"] for one in manifest.iter("Content")]
        assert ["MANIFEST/manifest.xml", *listed] == archive.namelist()
        return [etree.fromstring(archive.read(name)) for name in listed]


def linked(link: etree._Element) -> list[float]:
    north, east = link.attrib["point"].split(",")[:2]
    return [float(east), float(north)]


@pytest.mark.parametrize("name", ["qgc", "geojson", "kml", "gpx", "wpml", "cot"])
def test_places_on_the_earth_are_the_plans_cells(tmp_path: Path, mission: tuple[World, Plan], name: str) -> None:
    world, plan = mission
    files = mrac.export(world, plan, tmp_path / "out", to=name)  # type: ignore[arg-type]
    assert len(files) == (2 if name in ("qgc", "wpml") else 1)
    found = [cells_of(world, route) for route in routes(name, files)]
    assert found == [without_waits(robot.path.tolist()) for robot in plan.robots]


def test_poses_and_rows_are_the_plans_cells(tmp_path: Path, mission: tuple[World, Plan]) -> None:
    world, plan = mission
    for robot, file in enumerate(mrac.export(world, plan, tmp_path / "go.yaml")):
        assert file.name == f"go-{robot}.yaml"
        poses = [pose["pose"] for pose in yaml.safe_load(file.read_text())["poses"]]
        points = np.array([[pose["position"]["x"], pose["position"]["y"]] for pose in poses])
        assert cells_along(world, points) == without_waits(plan.robots[robot].path.tolist())
        turn = [pose["orientation"] for pose in poses]
        yaws = np.array([2 * math.atan2(one["z"], one["w"]) for one in turn])[1:]
        runs = np.diff(points, axis=0)
        ways = runs / np.linalg.norm(runs, axis=1, keepdims=True)
        np.testing.assert_allclose(np.stack([np.cos(yaws), np.sin(yaws)], axis=-1), ways, atol=1e-6)
        moves = np.diff(plan.robots[robot].path)
        waits = np.count_nonzero((moves[:-1] == 0) & (moves[1:] != 0))  # at most so many runs go on straight
        assert np.count_nonzero(np.isclose((ways[1:] * ways[:-1]).sum(axis=1), 1)) <= waits
        assert f"is below {world.cell_size / 2:g} m" in file.read_text()
    (file,) = mrac.export(world, plan, tmp_path / "go.csv")
    rows = list(csv.DictReader(file.read_text().splitlines()))
    cells = world.to_cells([[float(row["x"]), float(row["y"])] for row in rows]) @ [world.shape[1], 1]
    assert cells.tolist() == [cell for robot in plan.robots for cell in robot.path.tolist()]


def test_poses_are_messages_of_ros(tmp_path: Path) -> None:
    """rosbags, which knows the message types of ROS 2, takes them as they are."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    kinds = {name: store.types[f"geometry_msgs/msg/{name}"] for name in ("PoseStamped", "Pose", "Point", "Quaternion")}
    world = a_world()
    (file,) = mrac.export(world, 1, tmp_path / "go.yaml")
    poses = []
    for given in yaml.safe_load(file.read_text())["poses"]:
        assert set(given) == {"header", "pose"} and set(given["pose"]) == {"position", "orientation"}
        pose = kinds["Pose"](
            kinds["Point"](**given["pose"]["position"]), kinds["Quaternion"](**given["pose"]["orientation"])
        )
        assert math.hypot(*given["pose"]["orientation"].values()) == pytest.approx(1, abs=1e-11)
        poses.append(kinds["PoseStamped"](header(stamp(0, 0), **given["header"]), pose))
    path = store.types["nav_msgs/msg/Path"](header(stamp(0, 0), "map"), poses)
    again = store.deserialize_cdr(store.serialize_cdr(path, "nav_msgs/msg/Path"), "nav_msgs/msg/Path")
    assert [pose.pose.position.x for pose in again.poses] == [pose.pose.position.x for pose in poses]


def test_areas_and_chances(tmp_path: Path, mission: tuple[World, Plan]) -> None:
    """Areas burnt by GDAL into the grid are the plan's areas; a robot's chance of loss is 1 - prod(1 - p)."""
    world, plan = mission
    (tif,) = mrac.export(world, plan, tmp_path / "out.tif")
    (file,) = mrac.export(world, plan, tmp_path / "out.geojson")
    features = json.loads(file.read_text())["features"]
    with rasterio.open(tif) as data:
        threat, covered, losses, residual = data.read().astype(float)
        assert data.descriptions == ("threat", "covered", "losses", "residual")
        crs, transform = data.crs, data.transform
    assert crs == rasterio.crs.CRS.from_user_input(world.georeference.crs)  # type: ignore[union-attr]
    np.testing.assert_array_equal(np.isnan(threat), ~world.free)
    np.testing.assert_array_equal(threat, world.threat)
    np.testing.assert_allclose(residual, threat * (1 - covered), atol=1e-6)
    areas = [feature for feature in features if feature["geometry"]["type"] == "Polygon"]
    for area, feature in zip(plan.areas, areas, strict=True):
        moved = [metres(crs, ring).tolist() for ring in feature["geometry"]["coordinates"]]
        shape = {"type": "Polygon", "coordinates": moved}
        burnt = rasterize([shape], out_shape=world.shape, transform=transform, fill=0)
        assert np.flatnonzero(burnt).tolist() == area.cells.tolist()
        assert feature["properties"]["losses"] == pytest.approx(losses.ravel()[area.cells].sum(), abs=1e-6)
    for robot, feature in zip(plan.robots, features[len(areas) :], strict=True):
        entered = without_waits(robot.path.tolist())
        chance = 1 - np.prod(1 - world.threat.ravel()[entered].astype(float))
        assert feature["properties"]["chance_of_loss"] == pytest.approx(chance, abs=1e-8)


FIJI = {
    "zone 60": (Georeference("EPSG:32760"), (819_438.0, 8_117_981.0, 0.3)),
    "degrees": (Georeference("EPSG:4326", (179.99985, -17.0), (9.4e-6, 9.04e-6)), (0.0, 0.0, 0.0)),
    "mercator": (Georeference("EPSG:3857"), (20_037_495.0, -1_920_800.0, 0.0)),
}
"""Places about longitude 180, where the world's middle is."""


def longitudes(coordinates: Any) -> list[float]:
    if isinstance(coordinates[0], float):
        return [coordinates[0]]
    return [longitude for part in coordinates for longitude in longitudes(part)]


@pytest.mark.parametrize("place", FIJI)
def test_exports_are_cut_at_longitude_180(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    """RFC 7946, 3.1.9: no part spans the world, parts together are the plan's cells; waypoints are in -180..180."""
    monkeypatch.setitem(PLACES, "utm", FIJI[place])
    world = a_world()
    plan = mrac.plan(world, robots=2)
    (file,) = mrac.export(world, plan, tmp_path / "out.geojson")
    shapes = [feature["geometry"] for feature in json.loads(file.read_text())["features"]]
    areas, paths = [one for one in shapes if "Polygon" in one["type"]], [one for one in shapes if "Line" in one["type"]]
    assert {one["type"] for one in shapes} >= {"MultiPolygon", "MultiLineString"} and len(paths) == 2
    for one in shapes:
        parts = one["coordinates"] if one["type"].startswith("Multi") else [one["coordinates"]]
        for part in parts:
            east = longitudes(part)
            assert max(east) - min(east) < 0.01 and max(map(abs, east)) <= 180
    crs = rasterio.crs.CRS.from_user_input(world.georeference.crs)  # type: ignore[union-attr]
    (tif,) = mrac.export(world, plan, tmp_path / "out.tif")
    with rasterio.open(tif) as data:
        transform = data.transform
    turn = {"degrees": 360.0, "mercator": 2 * math.pi * 6_378_137}.get(place, 0.0)
    for area, shape in zip(plan.areas, areas, strict=True):
        polygons = shape["coordinates"] if shape["type"].startswith("Multi") else [shape["coordinates"]]
        burnt = np.zeros(world.shape, dtype=bool)
        for rings in polygons:
            moved = [metres(crs, ring) for ring in rings]
            if moved[0][:, 0].min() < 0 and turn:
                moved = [ring + np.array([turn, 0]) for ring in moved]
            held = rasterize([{"type": "Polygon", "coordinates": [ring.tolist() for ring in moved]}],
                             out_shape=world.shape, transform=transform, fill=0)  # fmt: skip
            assert not (burnt & (held > 0)).any()
            burnt |= held > 0
        assert np.flatnonzero(burnt).tolist() == area.cells.tolist()
    (kml,) = mrac.export(world, plan, tmp_path / "out.kml")
    top = etree.parse(kml).getroot()
    assert len(list(top.iter(f"{KML}MultiGeometry"))) == sum(one["type"].startswith("Multi") for one in shapes)
    for places in top.iter(f"{KML}coordinates"):
        east = [float(one.split(",")[0]) for one in places.text.split()]
        assert max(east) - min(east) < 0.01 and max(map(abs, east)) <= 180
    for name in ("qgc", "gpx"):
        found = routes(name, mrac.export(world, plan, tmp_path / name, to=name))  # type: ignore[arg-type]
        for robot, route in zip(plan.robots, found, strict=True):
            assert max(abs(east) for east, _ in route) <= 180
            points = metres(crs, route)
            points[points[:, 0] < 0, 0] += turn
            along = cells_along(world, (points - world.georeference.origin) / world.georeference.scale)  # type: ignore[union-attr]
            assert along == without_waits(robot.path.tolist())


@pytest.mark.parametrize("seed", range(4))
def test_areas_with_holes_cut_at_random(seed: int) -> None:
    """Cells of any shape, also with corners and sides on the cut: each place is inside as before."""
    rng = np.random.default_rng(seed)
    for offset, yaw in ((4.0, 0.0), (3.5, 0.0), (5.0, 0.4)):
        world = World.create(np.where(rng.random((9, 11)) < 0.35, np.nan, 0.0))
        labels = world.components
        cells = np.flatnonzero(labels.ravel() == np.bincount(labels[labels > 0]).argmax())
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        rings = [ring[:, ::-1] * (1.0, -1.0) @ turn + (180 - offset, 0) for ring in outlines([cells], (9, 11))[0]]
        parts = cut_area(rings)
        places = rng.uniform((180 - offset - 6, -12), (180 - offset + 14, 8), (400, 2))
        moved = places - np.where(places[:, :1] > 180, (360.0, 0.0), 0.0)
        inside = np.sum([[Outline(ring).contains_point(one) for one in places] for ring in rings], axis=0) % 2
        found = sum(
            np.sum([[Outline(ring).contains_point(one) for one in moved] for ring in part], axis=0) % 2
            for part in parts
        )
        np.testing.assert_array_equal(found, inside)
        assert len(parts) > 1 and all(np.abs(ring[:, 0]).max() <= 180 for part in parts for ring in part)


def test_lines_cut_by_hand() -> None:
    """There and back; along 180; what only touches it is whole."""
    line = np.array([[179.0, 0.0], [181, 2], [181, 3], [180, 4], [179, 4]])
    east = [[-180, 1], [-179, 2], [-179, 3], [-180, 4]]
    assert [part.tolist() for part in cut_line(line)] == [[[179, 0], [180, 1]], east, [[180, 4], [179, 4]]]
    for whole in ([[179.0, 0.0], [180, 1], [179, 2]], [[10.0, 0.0], [10, 0]]):
        assert [part.tolist() for part in cut_line(np.array(whole))] == [whole]
    assert [part.tolist() for part in cut_line(np.array([[180.0, 0.0], [180, 1]]))] == [[[-180, 0], [-180, 1]]]


@pytest.mark.parametrize("seed", range(8))
def test_outlines_enclose_the_cells_and_touch_themselves_nowhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = World.create(np.where(rng.random((9, 11)) < 0.35, np.nan, 0.0))
    labels = world.components
    cells = np.flatnonzero(labels.ravel() == np.bincount(labels[labels > 0]).argmax())
    (rings,) = outlines([cells], (9, 11))
    corners = [[(col, row) for row, col in ring.tolist()] for ring in rings]
    burnt = rasterize([{"type": "Polygon", "coordinates": corners}], out_shape=(9, 11), fill=0)
    assert np.flatnonzero(burnt).tolist() == cells.tolist()
    for number, ring in enumerate(corners):
        assert ring[0] == ring[-1] and len(set(ring)) == len(ring) - 1 >= 4
        twice = sum(x0 * -y1 - x1 * -y0 for (x0, y0), (x1, y1) in pairwise(ring))
        assert (twice > 0) == (number == 0)  # counterclockwise with north up, holes the other way


def test_straight_runs_by_hand() -> None:
    path = np.array([0, 0, 1, 2, 2, 2, 11, 20, 19, 20, 20])
    assert [tuple(stop) for stop in straight_runs(path)] == [
        (0, 0, 1), (3, 2, 2), (7, 20, 0), (8, 19, 0), (9, 20, 0),
    ]  # fmt: skip
    assert [tuple(stop) for stop in straight_runs(np.array([5, 5]))] == [(0, 5, 0)]


MOVERS = "map: {file: w.npz}\nmovers:\n- {walk: 0.5, h: 0.2, count: 3}\nrobots: {count: 2}\n"
TOLD = "map: {file: w.npz}\ntrue_map: t.npy\nsensor_range: {range: 2}\nrobots: {count: 2}\n"


def test_what_is_not_known_exactly_is_left_out_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two robots among moving_threats: no NaN in any text, and one line that says what is left out."""
    monkeypatch.chdir(tmp_path)
    a_world().save("w.npz")
    Path("m.yaml").write_text(MOVERS)
    for name, left in (
        ("o.geojson", "covered, losses and chance_of_loss"),
        ("o.kml", "covered, losses and chance_of_loss"),
        ("o.gpx", "chance_of_loss"),
        ("o.tif", "covered, losses and residual"),
        ("o.csv", ""),
    ):
        assert run(["export", "m.yaml", "--out", name]) == 0
        said = [line for line in capsys.readouterr().err.splitlines() if "omitted where" in line]
        assert [line.split(" omitted")[0] for line in said] == [left] * bool(left)
        assert name == "o.tif" or "nan" not in Path(name).read_text().lower()
    facts = [feature["properties"] for feature in json.loads(Path("o.geojson").read_text())["features"]]
    assert {of.get("covered", of.get("chance_of_loss")) for of in facts} == {None} and facts[0]["threat"] >= 0
    with rasterio.open("o.tif") as data:
        assert data.descriptions == ("threat",)


def test_what_robots_believe_is_called_so(tmp_path: Path) -> None:
    """A plan made on another map than the true one: chances are of the true one, threats of what is believed."""
    a_world().save(tmp_path / "w.npz")
    np.save(tmp_path / "t.npy", np.where(a_world().free, 0.1, np.nan))
    (tmp_path / "u.yaml").write_text(TOLD)
    world = mrac.load(tmp_path / "u.yaml")
    (tif,) = mrac.export(world, 2, tmp_path / "o.tif")
    with rasterio.open(tif) as data:
        assert data.descriptions == ("believed_threat", "covered", "losses", "believed_residual")
        np.testing.assert_array_equal(data.read(1), a_world().threat)
    (file,) = mrac.export(world, 2, tmp_path / "o.geojson")
    facts = json.loads(file.read_text())["features"][0]["properties"]
    assert "believed_threat" in facts and "threat" not in facts


def check_format(name: str, content: object) -> None:
    """What a format's own reader asks for (`fixtures/formats`): of JSON, or of XML."""
    file = ROOT / "tests/fixtures/formats" / name
    if isinstance(content, etree._Element):
        etree.RelaxNG(file=f"{file}.rng").assertValid(content)
    else:
        Draft202012Validator(json.loads(file.with_suffix(".json").read_text())).validate(content)


def test_missions_take_off_hold_and_drive(tmp_path: Path) -> None:
    """What QGroundControl asks for; hold times are waits."""
    world = a_world()
    path = np.array([0, 1, 1, 1, 2])
    plan = Plan(world.shape, world.sha256, None, (RobotPlan(path),), outcome="end_of_paths")
    for altitude, first, vehicle in ((30.0, "TAKEOFF", "QUADROTOR"), (0.0, "WAYPOINT", "GROUND_ROVER")):
        (file,) = mrac.export(world, plan, tmp_path / "a.plan", altitude=altitude, speed=2.0, force=True)
        content = json.loads(file.read_text())
        check_format("qgc", content)
        assert named("MAV_TYPE", [content["mission"]["vehicleType"]]) == [vehicle]
        assert [item["doJumpId"] for item in content["mission"]["items"]] == [1, 2, 3, 4]
        items = uploaded(file).mission_items
        commands = ["DO_CHANGE_SPEED", f"NAV_{first}", "NAV_WAYPOINT", "NAV_WAYPOINT"]
        assert named("MAV_CMD", [item.command for item in items]) == commands
        frames = ["MISSION", *["GLOBAL_RELATIVE_ALT"] * 3]
        assert named("MAV_FRAME", [item.frame for item in items]) == frames
        assert (items[0].param1, items[0].param2) == (1, 2.0)
        assert [(item.param1, item.z) for item in items[1:]] == [
            (0, altitude),
            (2 * 4.0 / 2.0, altitude),
            (0, altitude),
        ]
        home = content["mission"]["plannedHomePosition"]
        assert home[:2] == pytest.approx([items[1].x / 1e7, items[1].y / 1e7], abs=1e-7)
        assert abs(home[0] - 52) < 0.1 and abs(home[1] - 15) < 0.1


def test_more_waypoints_than_a_controller_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.exporting.flight.MOST_ITEMS", 4)
    with pytest.raises(PlanError, match=r"robot \d has a mission of \d+ items; expected at most 4, which MAVLink"):
        mrac.export(a_world(), 1, tmp_path / "a.plan")
    assert not list(tmp_path.iterdir())


def test_the_fence_holds_what_can_be_reached_and_rally_points_are_bases(tmp_path: Path) -> None:
    """A yard that a wall cuts off, and an island of keep-out cells."""
    threat = np.zeros((8, 10))
    threat[:, 7], threat[3:5, 2:5] = np.nan, np.nan
    world = World.create(threat, [[0, 0]], 4.0, (*PLACES["utm"][1][:2], 0.2), georeference=PLACES["utm"][0])
    plan = mrac.plan(world, return_to=[[7, 0], [0, 0]])
    (file,) = mrac.export(world, plan, tmp_path / "a.plan")
    content = json.loads(file.read_text())
    check_format("qgc", content)
    read = uploaded(file)
    kinds = [f"NAV_FENCE_POLYGON_VERTEX_{kind}" for kind in ("INCLUSION", "EXCLUSION")]
    corners = zip(named("MAV_CMD", [one.command for one in read.geofence_items]), read.geofence_items, strict=True)
    fence = [(kind, corner.y / 1e7, corner.x / 1e7) for kind, corner in corners]
    rings = [Outline([place for own, *place in fence if own == kind]) for kind in kinds]
    assert {kind for kind, *_ in fence} == {*kinds}
    centres = np.transpose(rasterio.warp.transform("EPSG:32633", "EPSG:4326", *world.to_xy(np.arange(80)).T))
    held = rings[0].contains_points(centres) & ~rings[1].contains_points(centres)
    assert held.tolist() == world.accessible([[0, 0]]).ravel().tolist()
    assert FORMATS["qgc"].notes(make_mission(world, plan)) == ()
    rough = np.zeros((9, 30))
    rough[1::2, 1::2] = np.nan
    many = World.create(rough, None, 4.0, world.origin, georeference=world.georeference)
    assert "corners, and PX4 takes 64" in FORMATS["qgc"].notes(make_mission(many, mrac.plan(many)))[0]
    found = np.array([(one.y, one.x) for one in read.rally_items]) / 1e7
    np.testing.assert_allclose(found, centres[[0, 70]], atol=1e-7)


def dem(path: Path, world: World, shift: float = 0.0) -> Path:
    """Heights: a plane, 300 m + (x - x0) / 2, and a ridge of 12 m along a column of cells; pixels of 1 m."""
    x, y, _ = world.origin
    cols = np.tile(np.arange(60) + 0.5, (60, 1))
    heights = 300 + (cols - 10) / 2 + 12 * (np.abs(cols - 10 - 18) < 2)
    place = rasterio.Affine(1, 0, x - 10 + shift, 0, -1, y + 50)
    with rasterio.open(path, "w", driver="GTiff", width=60, height=60, count=1, dtype="float64", crs="EPSG:32633",
                       transform=place) as data:  # fmt: skip
        data.write(heights, 1)
    return path


def test_heights_above_the_ground(tmp_path: Path) -> None:
    """Linear between the pixels' centres, so exact on the plane; a flight over the ridge climbs before it."""
    world = World.create(np.zeros((1, 9)), None, 4.0, (*PLACES["utm"][1][:2], 0.0), georeference=PLACES["utm"][0])
    plan, ground = mrac.plan(world, 1), dem(tmp_path / "dem.tif", world)
    flat = [300 + (4 * col + 2) / 2 + 12 * (col == 4) for col in range(9)]
    (file,) = mrac.export(world, plan, tmp_path / "a.plan", terrain=ground, altitude=30.0)
    content = json.loads(file.read_text())
    check_format("qgc", content)
    assert content["mission"]["firmwareType"] == 3 and content["mission"]["globalPlanAltitudeMode"] == 4
    items = [item for item in content["mission"]["items"] if item["frame"] == 10]
    sent = uploaded(file).mission_items[1:]
    assert named("MAV_FRAME", [item.frame for item in sent]) == ["GLOBAL_TERRAIN_ALT"] * 2
    assert [(item["Altitude"], one.z) for item, one in zip(items, sent, strict=True)] == [(30.0, 30.0)] * 2
    assert [item["AMSLAltAboveTerrain"] for item in items] == pytest.approx([flat[0] + 30, flat[8] + 30], abs=0.02)
    (file,) = mrac.export(world, plan, tmp_path / "a.csv", terrain=ground, altitude=30.0)
    found = [float(row["z"]) for row in csv.DictReader(file.read_text().splitlines())]
    assert found == pytest.approx([one + 30 for one in flat], abs=0.02)
    (file,) = mrac.export(world, plan, tmp_path / "a.kmz", terrain=ground, altitude=30.0)
    marks = list(waylines(file).iter(f"{KML}Placemark"))
    cells = [cells_of(world, [place_of(mark)])[0] for mark in marks]
    heights = [float(mark.findtext(f"{WPML}executeHeight") or "") for mark in marks]
    assert heights == pytest.approx([30 + flat[cell] - flat[0] for cell in cells], abs=0.03)
    between = np.interp(range(9), cells, heights) - (np.array(flat) - flat[0])
    assert np.abs(between - 30).max() <= 1 and {3, 4, 5} <= set(cells)
    assert float(waylines(file).findtext(f".//{WPML}globalRTHHeight") or "") >= 29.97 + max(flat) - flat[0]
    with pytest.raises(MapError, match=r"has no height at the cell \[0, 8\] of a path \(1 such cells\)"):
        mrac.export(world, plan, tmp_path / "b.plan", terrain=dem(tmp_path / "off.tif", world, -17.0))
    with pytest.raises(UsageError, match="terrain with a format that ignores it; expected qgc or csv or wpml"):
        mrac.export(world, plan, tmp_path / "b.kml", terrain=ground)
    with rasterio.open(tmp_path / "dem.tif", "r+") as data:
        data.crs = rasterio.CRS()
    with pytest.raises(MapError, match="has no position; expected a raster of heights with a CRS"):
        mrac.export(world, plan, tmp_path / "b.plan", terrain=ground)
    assert not list(tmp_path.glob("b.*"))


WPML = "{http://www.dji.com/wpmz/1.0.2}"


def test_flights_of_dji_drones(tmp_path: Path) -> None:
    """2 to 99 waypoints; each flight there, along and back lasts no longer than the battery."""
    rng = np.random.default_rng(5)
    threat = np.where(rng.random((24, 24)) < 0.15, np.nan, 0.0)
    threat[0, 0] = 0.0
    world = World.create(threat, [[0, 0]], 4.0, (*PLACES["utm"][1][:2], 0.3), georeference=PLACES["utm"][0])
    plan = mrac.plan(world)
    whole = mrac.export(world, plan, tmp_path / "whole.kmz", speed=5.0)
    parts = mrac.export(world, plan, tmp_path / "part", to="wpml", speed=5.0, battery=2.0)
    assert len(parts) > len(whole) > 1 and whole[1].name == "whole-0-1.kmz" and parts[1].name == "robot-0-1.kmz"
    for files, limit in ((whole, math.inf), (parts, 120.0)):
        joined: list[int] = []
        for file in files:
            top = waylines(file)
            check_format("wpml", top)
            marks = list(top.iter(f"{KML}Placemark"))
            assert 2 <= len(marks) <= 99
            assert [mark.findtext(f"{WPML}index") for mark in marks] == [str(n) for n in range(len(marks))]
            points = metres("EPSG:32633", map(place_of, marks))
            base = world.to_xy(np.array([0]))
            lengths = np.linalg.norm(np.diff(np.concatenate([base, points, base]), axis=0), axis=1)
            assert (lengths.sum() + 2 * 20.0) / 5.0 <= limit
            cells = cells_of(world, [place_of(mark) for mark in marks])
            assert not joined or joined[-1] == cells[0]
            joined += cells
        assert without_waits(joined) == without_waits(plan.robots[0].path.tolist())
    for given, words in (
        ({"battery": 0.2}, r"battery=0.2 minutes do not last for a straight run of robot 0; expected 0\.\d or more"),
        ({"altitude": 0.0}, "altitude=0.0; expected .* above the ground for wpml"), ({"speed": 20.0}, "speed=20.0"),
        ({"battery": -1.0}, "battery=-1.0"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            mrac.export(world, plan, tmp_path / "none.kmz", **given)  # type: ignore[arg-type]
    assert not (tmp_path / "none.kmz").exists()


def test_a_waypoint_waits(tmp_path: Path) -> None:
    world = a_world()
    plan = Plan(world.shape, world.sha256, None, (RobotPlan(np.array([0, 1, 1, 1, 2])),), outcome="end_of_paths")
    (file,) = mrac.export(world, plan, tmp_path / "a.kmz", speed=2.0)
    groups = list(waylines(file).iter(f"{WPML}actionGroup"))
    assert [group.findtext(f".//{WPML}hoverTime") for group in groups] == ["4.0"]
    assert [group.findtext(f"{WPML}actionGroupStartIndex") for group in groups] == ["1"]


def test_events_for_tak(tmp_path: Path) -> None:
    """A point for each start, and areas as closed shapes around their cells; names are the same in a later package."""
    world = a_world()
    plan = mrac.plan(world, 2, return_to="home")
    (file,) = mrac.export(world, plan, tmp_path / "a.zip")
    found = events(file)
    kinds = [event.attrib["type"] for event in found]
    assert [kinds.count(kind) for kind in ("b-m-p-s-m", "u-d-f", "b-m-r")] == [
        len({tuple(start) for start in plan.starts.tolist()}), len(plan.areas), 2,
    ]  # fmt: skip
    assert len({event.attrib["uid"] for event in found}) == len(found)
    for event in found:
        check_format("cot", event)
        assert event.attrib["stale"] > event.attrib["start"]
    for area, event in zip(plan.areas, [one for one in found if one.attrib["type"] == "u-d-f"], strict=True):
        ring = [linked(link) for link in event.iter("link")]
        assert ring[0] == ring[-1]
        centres = np.transpose(rasterio.warp.transform("EPSG:32633", "EPSG:4326", *world.to_xy(area.cells).T))
        assert Outline(ring).contains_points(centres).all()
    again = {event.attrib["uid"] for event in events(mrac.export(world, plan, tmp_path / "b.zip")[0])}
    assert again == {event.attrib["uid"] for event in found}


def test_the_graph_of_the_areas_for_nav2(tmp_path: Path) -> None:
    """Nodes in their areas, edges between all areas that touch; survival along the line of each edge."""
    world = a_world()
    plan = mrac.plan(world, 2)
    (file,) = mrac.export(world, plan, tmp_path / "g.geojson", to="nav2_route")
    check_format("nav2_route", json.loads(file.read_text()))
    features = json.loads(file.read_text())["features"]
    nodes = [one for one in features if one["geometry"]["type"] == "Point"]
    edges = [one for one in features if one["geometry"]["type"] == "MultiLineString"]
    ids = [one["properties"]["id"] for one in features]
    assert len(nodes) == len(plan.areas) and len(nodes) + len(edges) == len(features) and ids == [*range(len(ids))]
    areas = [set(area.cells.tolist()) for area in plan.areas]
    for node, area in zip(nodes, areas, strict=True):
        assert cells_along(world, np.array([node["geometry"]["coordinates"]]))[0] in area
    for edge in edges:
        facts = edge["properties"]
        assert (facts["overridable"], facts["cost"]) == (True, 0.0)
        cells = cells_along(world, np.array(edge["geometry"]["coordinates"][0]))
        assert cells[0] in areas[facts["startid"]] and cells[-1] in areas[facts["endid"]]
        survival = math.prod(1 - float(world.threat.flat[cell]) for cell in cells[1:])
        assert facts["metadata"]["survival"] == pytest.approx(survival)
        assert facts["metadata"]["penalty"] == pytest.approx(-math.log(survival), abs=1e-12)
    width = world.shape[1]
    beside = {(m, n) for m, one in enumerate(areas) for n, other in enumerate(areas) if m != n and any(
        cell + step in other for cell in one for step in (1, -1, width, -width)
        if not (abs(step) == 1 and cell // width != (cell + step) // width))}  # fmt: skip
    assert {(edge["properties"]["startid"], edge["properties"]["endid"]) for edge in edges} == beside
    with pytest.raises(PlanError, match="the plan has 1 areas"):
        mrac.export(World.create(np.zeros((3, 3))), 1, tmp_path / "h.geojson", to="nav2_route")


def test_a_map_that_nobody_put_on_the_earth(tmp_path: Path) -> None:
    world = mrac.load(np.zeros((3, 4)))
    for name, form in FORMATS.items():
        if name in ("nav2", "csv", "geotiff"):
            assert mrac.export(world, 1, tmp_path / f"a{form.suffixes[0]}")
        elif form.on_earth:
            with pytest.raises(MapError, match=r"the map has no georeference.* give a GeoTIFF with a CRS, or `datum"):
                mrac.export(world, 1, tmp_path / "none", to=name)  # type: ignore[arg-type]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.csv", "a.tif", "a.yaml"]
    with rasterio.open(tmp_path / "a.tif") as data:
        assert data.crs is None and data.transform[:6] == (1, 0, 0, 0, -1, 3)


@pytest.mark.parametrize(("crs", "pole"), [("EPSG:3413", 1), ("EPSG:3031", -1)])
def test_areas_over_a_pole_have_no_longitudes(tmp_path: Path, crs: str, pole: int) -> None:
    """Around it, with a corner at it, with a side through it; 20 m beside it they are written, as routes are always."""
    threat = np.zeros((6, 8))
    threat[1:5, 2:6] = 0.1
    for x, y in ((-40, -30), (-20, -20), (-20, -30), (-80, -80)):
        world = World.create(threat, cell_size=10.0, origin=(x, y, 0.0), georeference=Georeference(crs))
        plan = mrac.plan(world, 2)
        for name in ("a.geojson", "a.kml"):
            if x > -80:
                with pytest.raises(MapError, match=r"area \d lies over a pole, .* export \.tif or \.csv"):
                    mrac.export(world, plan, tmp_path / name)
            else:
                mrac.export(world, plan, tmp_path / name)
            assert (tmp_path / name).exists() == (x == -80)
        for name in ("a.gpx", "a.csv", "a.tif"):
            mrac.export(world, plan, tmp_path / name, force=True)
        latitudes = [float(text) for text in re.findall(r'lat="(\S+)"', (tmp_path / "a.gpx").read_text())]
        assert latitudes and all(pole * latitude > 89.99 for latitude in latitudes)


REFUSED = [
    ({"out": "a.txt"}, UsageError, r"no format has the suffix '\.txt'; expected \.plan \.yaml"),
    ({"out": "folder"}, UsageError, "no format has the suffix ''"),
    ({"out": "a.csv", "to": "qcg"}, UsageError, "did you mean 'qgc'"),
    ({"out": "a.csv", "to": "kml"}, UsageError, r"ends in '\.csv'; expected \.kml for kml"),
    ({"out": "a.plan", "altitude": -1.0}, UsageError, "altitude=-1.0"),
    ({"out": "a.plan", "speed": 0.0}, UsageError, "speed=0.0"),
    ({"out": "a.plan", "speed": math.nan}, UsageError, "speed=nan"),
    ({"out": "none/a.csv"}, MapError, "its folder does not exist"),
]


@pytest.mark.parametrize(("given", "error", "words"), REFUSED)
def test_what_is_refused(tmp_path: Path, given: dict, error: type[InputError], words: str) -> None:
    with pytest.raises(error, match=words):
        mrac.export(a_world(), 1, tmp_path / given.pop("out"), **given)
    assert not list(tmp_path.iterdir())


def test_the_plan_of_another_map_is_refused(tmp_path: Path) -> None:
    plan = mrac.plan(World.create(np.zeros((7, 9))), 1)
    with pytest.raises(PlanError, match="another map"):
        mrac.export(a_world(), plan, tmp_path / "a.csv")
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    a_world().save("w.npz")
    assert run(["plan", "w.npz", "--robots", "2", "--out", "p.json", "--waypoints", "p.plan", "--altitude", "9"]) == 0
    assert run(["export", "w.npz", "--plan", "p.json", "--to", "qgc", "--out", "there", "--altitude", "9"]) == 0
    assert Path("p-1.plan").read_text() == Path("there/robot-1.plan").read_text()
    assert "wrote there/robot-1.plan" in capsys.readouterr().err
    Path("t.csv").write_text("robot,row,col\n0,0,0\n0,0,1\n")
    assert run(["plan", "w.npz", "--state", "t.csv", "--out", "rest.json"]) == 0
    assert run(["export", "w.npz", "--plan", "rest.json", "--out", "a.csv"]) == 0
    assert run(["export", "w.npz", "--state", "t.csv", "--out", "b.csv"]) == 0
    assert Path("a.csv").read_text() == Path("b.csv").read_text()
    capsys.readouterr()
    assert "--seconds 5 where nothing is searched for" in error_of(capsys, *["plan", "p.json", "--seconds", "5"])
    assert "--altitude 1e+09" in error_of(capsys, *["plan", "w.npz", "--waypoints", "a.plan", "--altitude", "1e9"])
    assert "no format has the suffix '.npz'" in error_of(capsys, *["export", "w.npz", "--out", "w.npz"])
    Path("m.csv").write_text("0,0\n0,0\n")
    assert run(["export", "m.csv", "--out", "m.csv"]) == 2
    assert "m.csv is an input" in capsys.readouterr().err and Path("m.csv").read_text() == "0,0\n0,0\n"
    assert not list(tmp_path.glob("*.partial")) and not Path("a.plan").exists()


def test_the_command_line_knows_every_format() -> None:
    assert tuple(FORMATS) == next(one for one in COMMANDS if one.name == "export").options["to"].words
