"""Ways out: every format read back, by other means than ours, gives the plan's cells; hostile and wrong input."""

import csv
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
import yaml
from helpers import error_of
from matplotlib.path import Path as Outline
from rasterio.features import rasterize

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.cli.options import COMMANDS
from analysis.exporting import FORMATS, cut_area, cut_line, outlines, straight_runs
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
    """The cells of the straight lines between longitudes and latitudes (PROJ)."""
    east, north = zip(*places, strict=True)
    place = world.georeference
    if place.crs != "EPSG:4326":
        east, north = rasterio.warp.transform("EPSG:4326", place.crs, east, north)
    return cells_along(world, (np.stack([east, north], axis=-1) - place.origin) / place.scale)


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
        items = [json.loads(file.read_text())["mission"]["items"] for file in files]
        return [[[i["params"][5], i["params"][4]] for i in item if i["command"] in (16, 22)] for item in items]
    if name == "geojson":
        features = json.loads(files[0].read_text())["features"]
        return [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "LineString"]
    top = ElementTree.parse(files[0]).getroot()
    if name == "gpx":
        found = [route.findall(f"{GPX}rtept") for route in top.findall(f"{GPX}rte")]
        return [[[float(point.attrib["lon"]), float(point.attrib["lat"])] for point in route] for route in found]
    lines = [line.findtext(f"{KML}coordinates") or "" for line in top.iter(f"{KML}LineString")]
    return [[[float(part) for part in place.split(",")] for place in line.split()] for line in lines]


@pytest.mark.parametrize("name", ["qgc", "geojson", "kml", "gpx"])
def test_places_on_the_earth_are_the_plans_cells(tmp_path: Path, mission: tuple[World, Plan], name: str) -> None:
    world, plan = mission
    files = mrac.export(world, plan, tmp_path / "out", to=name)  # type: ignore[arg-type]
    assert len(files) == (2 if name == "qgc" else 1)
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
        rings = feature["geometry"]["coordinates"]
        moved = [
            list(zip(*rasterio.warp.transform("EPSG:4326", crs, *zip(*ring, strict=True)), strict=True))
            for ring in rings
        ]
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
            moved = [
                np.transpose(rasterio.warp.transform("EPSG:4326", crs, *zip(*ring, strict=True))) for ring in rings
            ]
            if moved[0][:, 0].min() < 0 and turn:
                moved = [ring + np.array([turn, 0]) for ring in moved]
            held = rasterize([{"type": "Polygon", "coordinates": [ring.tolist() for ring in moved]}],
                             out_shape=world.shape, transform=transform, fill=0)  # fmt: skip
            assert not (burnt & (held > 0)).any()
            burnt |= held > 0
        assert np.flatnonzero(burnt).tolist() == area.cells.tolist()
    (kml,) = mrac.export(world, plan, tmp_path / "out.kml")
    top = ElementTree.parse(kml).getroot()
    assert len(list(top.iter(f"{KML}MultiGeometry"))) == sum(one["type"].startswith("Multi") for one in shapes)
    for places in top.iter(f"{KML}coordinates"):
        east = [float(one.split(",")[0]) for one in (places.text or "").split()]
        assert max(east) - min(east) < 0.01 and max(map(abs, east)) <= 180
    for name in ("qgc", "gpx"):
        found = routes(name, mrac.export(world, plan, tmp_path / name, to=name))  # type: ignore[arg-type]
        for robot, route in zip(plan.robots, found, strict=True):
            assert max(abs(east) for east, _ in route) <= 180
            points = np.transpose(rasterio.warp.transform("EPSG:4326", crs, *zip(*route, strict=True)))
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


NUMBER = (int, float)
HEAD = {
    "fileType": str, "version": NUMBER, "groundStation": str, "mission": dict, "geoFence": dict, "rallyPoints": dict,
}  # fmt: skip
MISSION = {
    "plannedHomePosition": list, "items": list, "firmwareType": NUMBER, "vehicleType": NUMBER, "cruiseSpeed": NUMBER,
    "hoverSpeed": NUMBER, "globalPlanAltitudeMode": NUMBER, "version": NUMBER,
}  # fmt: skip
ITEM = {"type": str, "frame": NUMBER, "command": NUMBER, "params": list, "autoContinue": bool, "doJumpId": NUMBER}
PLACED = {"AltitudeMode": NUMBER, "Altitude": NUMBER, "AMSLAltAboveTerrain": type(None)}
"""Keys and types that QGroundControl validates: PlanMasterController::loadFromFile, _loadJsonMissionFileV2 of
MissionController, MissionItem::load, SimpleMissionItem::load (of commands that have a place; null is its NaN)."""


def check_keys(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    assert found.keys() == wanted.keys()
    for name, kind in wanted.items():
        assert isinstance(found[name], kind) and (kind is not NUMBER or not isinstance(found[name], bool)), name


def check_loads(content: dict[str, Any]) -> None:
    """What QGroundControl's loaders ask for; without a place are commands of MAV_FRAME_MISSION (2)."""
    check_keys(content, HEAD)
    check_keys(content["mission"], MISSION)
    check_keys(content["geoFence"], {"circles": list, "polygons": list, "version": NUMBER})
    check_keys(content["rallyPoints"], {"points": list, "version": NUMBER})
    assert (content["fileType"], content["version"], content["mission"]["version"]) == ("Plan", 1, 2)
    assert content["geoFence"]["version"] == content["rallyPoints"]["version"] == 2
    assert len(content["mission"]["plannedHomePosition"]) == 3
    for item in content["mission"]["items"]:
        check_keys(item, ITEM if item["frame"] == 2 else ITEM | PLACED)
        assert item["type"] == "SimpleItem" and item["autoContinue"] is True and len(item["params"]) == 7
        assert all(part is None or isinstance(part, NUMBER) for part in item["params"])
        assert item["frame"] == {22: 3, 16: 3, 178: 2}[item["command"]]


def test_missions_take_off_hold_and_drive(tmp_path: Path) -> None:
    """What QGroundControl asks for; hold times are waits."""
    world = a_world()
    path = np.array([0, 1, 1, 1, 2])
    plan = Plan(world.shape, world.sha256, None, (RobotPlan(path),), outcome="end_of_paths")
    for altitude, commands, vehicle in ((30.0, [178, 22, 16, 16], 2), (0.0, [178, 16, 16, 16], 10)):
        (file,) = mrac.export(world, plan, tmp_path / "a.plan", altitude=altitude, speed=2.0, force=True)
        content = json.loads(file.read_text())
        check_loads(content)
        assert content["mission"]["vehicleType"] == vehicle
        items = content["mission"]["items"]
        assert [item["command"] for item in items] == commands
        assert [item["doJumpId"] for item in items] == [1, 2, 3, 4]
        assert items[0]["params"][:2] == [1, 2.0]
        assert [item["params"][0] for item in items[1:]] == [0, 2 * 4.0 / 2.0, 0]
        assert {item["params"][6] for item in items[1:]} == {altitude}
        home = content["mission"]["plannedHomePosition"]
        assert home[:2] == items[1]["params"][4:6] and abs(home[0] - 52) < 0.1 and abs(home[1] - 15) < 0.1


def test_a_map_that_nobody_put_on_the_earth(tmp_path: Path) -> None:
    world = mrac.load(np.zeros((3, 4)))
    for name, form in FORMATS.items():
        if name in ("nav2", "csv", "geotiff"):
            assert mrac.export(world, 1, tmp_path / f"a{form.suffixes[0]}")
        else:
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
    for words, said in (
        ("export w.npz --out w.npz", "no format has the suffix '.npz'"),
        ("export w.npz --to kml --out w.csv", "--out w.csv ends in '.csv'"),
        ("export w.npz --out a.plan --speed 0", "--speed 0"),
        ("export w.npz --out a.plan --to plan", "--to 'plan'; expected qgc or nav2"),
        ("plan w.npz --waypoints a.plan --altitude 1e9", "--altitude 1e+09"),
    ):
        assert said in error_of(capsys, *words.split())
    Path("m.csv").write_text("0,0\n0,0\n")
    assert run(["export", "m.csv", "--out", "m.csv"]) == 2
    assert "m.csv is an input" in capsys.readouterr().err and Path("m.csv").read_text() == "0,0\n0,0\n"
    assert not list(tmp_path.glob("*.partial")) and not Path("a.plan").exists()


def test_the_command_line_knows_every_format() -> None:
    assert tuple(FORMATS) == next(one for one in COMMANDS if one.name == "export").options["to"].words
