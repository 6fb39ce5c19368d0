"""`debrief`: tracks of every kind against the rollouts that they are of; noise, gaps, clocks; what is refused."""

import json
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from helpers import error_of
from jsonschema import Draft202012Validator
from mcap.writer import Writer
from numpy.typing import NDArray
from rasterio.features import rasterize
from rasterio.warp import transform
from rosbags.typesys import Stores, get_typestore

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.debrief import Debrief, Multiplier
from analysis.report.schema import schema
from planner.errors import MapError
from planner.plan.plan import Plan
from planner.world.grid import Georeference
from planner.world.world import World

UTM, ORIGIN, CELL = "EPSG:32633", (500_000.0, 5_761_038.0), 4.0
BEGIN = datetime(2026, 5, 1, 12, tzinfo=UTC)
ROS = get_typestore(Stores.ROS2_HUMBLE)


def a_world() -> World:
    """7 x 9 cells with a wall and a danger, somewhere on the Earth."""
    threat = np.zeros((7, 9))
    threat[2, 1:6], threat[4:6, 3:8] = np.nan, 0.2
    return World.create(threat, cell_size=CELL, origin=(*ORIGIN, 0.0), georeference=Georeference(UTM))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[World, Plan, NDArray, list[int], Path]:
    """A recorded rollout in which a robot is lost: its cells by step and robot, and the robots that survive."""
    path = tmp_path_factory.mktemp("flown") / "r.mcap"
    world = a_world()
    plan = mrac.plan(world, robots=2)
    mrac.record(world, plan, path, ids=range(20), loop="open")
    cells = world.accessible(plan.starts).sum()
    one = next(one for one in mrac.read_rollouts(path) if one.alive[-1] == 1 and one.visited[-1] < cells)
    mrac.record(world, plan, path, ids=[one.trace.rollout], loop="open", force=True)
    dead = [robot for robot in range(2) if one.trace.doing[-1, robot] == one.trace.doing.max()]
    assert len(dead) == 1
    return world, plan, one.trace.cells, dead, path


def metres(cells: NDArray) -> NDArray[np.float64]:
    """Centres of cells, by hand."""
    rows, cols = np.divmod(cells, 9)
    return np.stack([ORIGIN[0] + (cols + 0.5) * CELL, ORIGIN[1] + (6.5 - rows) * CELL], axis=-1)


def degrees(points: NDArray) -> NDArray[np.float64]:
    return np.stack(transform(UTM, "EPSG:4326", *points.reshape(-1, 2).T), axis=-1).reshape(points.shape)


def time_of(seconds: float) -> str:
    return (BEGIN + timedelta(seconds=float(seconds))).isoformat().replace("+00:00", "Z")


def tracks(folder: Path, kind: str, places: NDArray, times: NDArray | None = None) -> Path:
    """A file of tracks: places `[T, K, 2]` in metres at `times` `[T, K]`, or a second each."""
    steps, robots = places.shape[:2]
    times = np.tile(np.arange(steps, dtype=float)[:, None], (1, robots)) if times is None else times
    lonlat, path = degrees(places), folder / f"t.{kind}"
    each = [(robot, step) for robot in range(robots) for step in range(steps)]
    if kind == "csv":
        rows = [
            f"{robot},{times[step, robot]},{places[step, robot, 0]},{places[step, robot, 1]}" for robot, step in each
        ]
        path.write_text("\n".join(["robot,time,x,y", *rows]))
    elif kind == "gpx":
        text = ""
        for robot in range(robots):
            fixes = "".join(
                f'<trkpt lon="{east}" lat="{north}"><time>{time_of(when)}</time></trkpt>'
                for (east, north), when in zip(lonlat[:, robot], times[:, robot], strict=True)
            )
            text += f"<trk><name>robot {robot}</name><trkseg>{fixes}</trkseg></trk>"
        path.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">{text}</gpx>')
    elif kind == "geojson":
        features = [
            {"type": "Feature", "properties": {"robot": robot, "coordTimes": [time_of(t) for t in times[:, robot]]},
             "geometry": {"type": "LineString", "coordinates": lonlat[:, robot].tolist()}}
            for robot in range(robots)
        ]  # fmt: skip
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    else:
        kinds = ["nav_msgs/msg/Odometry", "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/PoseStamped"]
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            for robot, kind in zip(range(robots), kinds, strict=False):
                schema = writer.register_schema(kind, "ros2msg", b"")
                channel = writer.register_channel(f"/robot_{robot}/where", "cdr", schema)
                for step in range(steps):
                    place = lonlat[step, robot] if kind.endswith("Fix") else places[step, robot]
                    writer.add_message(channel, int(times[step, robot] * 1e9), message(kind, *place.tolist()), 0)
            writer.finish()
    return path


def message(kind: str, x: float, y: float) -> bytes:
    """A message of ROS 2 by rosbags, with frames whose names have odd lengths."""
    types = ROS.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "map")
    if kind.endswith("Fix"):
        status = types["sensor_msgs/msg/NavSatStatus"](0, 1)
        return bytes(ROS.serialize_cdr(types[kind](header, status, y, x, 0.0, np.zeros(9), 0), kind))
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, 0.0), turn)
    if kind.endswith("PoseStamped"):
        return bytes(ROS.serialize_cdr(types[kind](header, pose), kind))
    vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        types["geometry_msgs/msg/Twist"](vector, vector), np.zeros(36)
    )
    placed = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
    return bytes(ROS.serialize_cdr(types[kind](header, "base", placed, twist), kind))


def check_is_flown(done: Debrief, world: World, cells: NDArray, dead: list[int]) -> None:
    """Coverage and hazard, counted from the cells of each step."""
    paths = [[cells[0, robot]] + [b for a, b in zip(cells[:-1, robot], cells[1:, robot], strict=True) if a != b]
             for robot in range(cells.shape[1])]  # fmt: skip
    assert np.flatnonzero(done.visited).tolist() == sorted({int(cell) for path in paths for cell in path})
    kept = {int(c) for robot, path in enumerate(paths) for c in (path[:-1] if robot in dead else path)}
    assert np.flatnonzero(done.survived).tolist() == sorted(kept)
    assert [robot for robot, flight in enumerate(done.flights) if flight.lost] == dead
    for flight, path in zip(done.flights, paths, strict=True):
        assert flight.cells.tolist() == path
        hazard = -sum(math.log(1 - float(world.threat.flat[cell])) for cell in path)
        assert flight.hazard == pytest.approx(hazard, rel=1e-6)


@pytest.mark.parametrize("kind", ["recording", "csv", "gpx", "geojson", "mcap"])
def test_a_rollout_debriefed_gives_its_own_coverage(tmp_path: Path, flown: tuple, kind: str) -> None:
    world, plan, cells, dead, recording = flown
    if kind == "recording":
        done = mrac.debrief(world, recording, plan)
    else:
        done = mrac.debrief(world, tracks(tmp_path, kind, metres(cells)), plan, lost=dead)
    check_is_flown(done, world, cells, dead)
    found = done.to_json()
    assert found["coverage"]["visited"] == done.visited.sum() / world.accessible(plan.starts).sum()
    assert found["coverage"]["planned"] == 1 and found["lost"] == 1
    assert sum(gap["cells"] for gap in found["gaps"]) == (done.accessible & ~done.visited).sum() > 0
    rules = {"$defs": schema()["$defs"], "$ref": "#/$defs/debrief.Debrief"}
    Draft202012Validator(rules).validate(json.loads(json.dumps(found)))
    # The plan of the rest covers what is left, with the robots that are left.
    rest = {int(cell) for robot, path in enumerate(done.rest.robots) if robot not in dead for cell in path.path}
    assert rest >= {int(cell) for gap in done.gaps for cell in gap}


def test_noise_of_half_a_cell(tmp_path: Path, flown: tuple) -> None:
    """Of one place a step nothing changes; of ten a step few cells do, if the length of a step is known."""
    world, plan, cells, dead, _ = flown
    rng, exact = np.random.default_rng(3), metres(cells)
    noisy = exact + rng.uniform(-0.499, 0.499, exact.shape) * CELL
    check_is_flown(mrac.debrief(world, tracks(tmp_path, "csv", noisy), plan, lost=dead), world, cells, dead)
    steps = np.arange(0, len(exact) - 1, 0.1)
    fine = np.stack([[np.interp(steps, np.arange(len(exact)), exact[:, robot, axis]) for axis in (0, 1)]
                     for robot in range(2)], axis=0).transpose(2, 0, 1)  # fmt: skip
    fine = fine + rng.uniform(-0.5, 0.5, fine.shape) * CELL
    path = tracks(tmp_path, "csv", fine, np.tile(steps[:, None], (1, 2)))
    known = mrac.debrief(world.with_pace(step_seconds=1.0), path, plan, lost=dead)
    raw = mrac.debrief(world, path, plan, lost=dead)
    true = {int(cell) for cell in cells.ravel()}
    assert len(true ^ set(np.flatnonzero(known.visited).tolist())) <= 0.1 * len(true)
    moves = sum(int(np.count_nonzero(np.diff(cells[:, robot]))) + 1 for robot in range(2))
    assert abs(sum(len(one.cells) for one in known.flights) / moves - 1) < 0.15
    assert sum(len(one.cells) for one in raw.flights) > 2 * moves and "places are not averaged" in raw.notes[-1]


def test_gaps_clocks_and_places_off_the_map(tmp_path: Path, flown: tuple) -> None:
    world, plan, cells, _, _ = flown
    exact = metres(cells)
    times = np.tile(np.arange(len(exact), dtype=float)[:, None], (1, 2))
    whole = mrac.debrief(world, tracks(tmp_path, "csv", exact, times), plan)
    later = mrac.debrief(world, tracks(tmp_path, "csv", exact, times + np.array([0.0, 3600.0])), plan)
    assert [one.cells.tolist() for one in later.flights] == [one.cells.tolist() for one in whole.flights]
    assert any("3600 apart" in note for note in later.notes) and later.multiplier == whole.multiplier
    # A straight run without its inner places is joined, but not across a gap in time.
    line = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8])[:, None]
    kept = np.array([0, 1, 2, 7, 8])
    for when, count, gaps in (([0, 1, 2, 3, 4], 9, 0), ([0, 1, 2, 60, 61], 5, 1)):
        path = tracks(tmp_path, "csv", metres(line[kept]), np.array(when, dtype=float)[:, None])
        done = mrac.debrief(world, path)
        assert (int(done.visited.sum()), done.flights[0].gaps) == (count, gaps)
    away = exact.copy()
    away[len(away) // 2 :, 1] += 1000.0
    done = mrac.debrief(world, tracks(tmp_path, "csv", away, times), plan)
    assert 0.4 < done.flights[1].off < 0.6 and any("off the map" in note for note in done.notes)
    assert set(done.flights[1].cells.tolist()) == set(cells[: len(away) // 2, 1].tolist())


def test_the_loss_rate_met() -> None:
    """By numerical integration of the posterior, and against missions drawn visit by visit."""
    m = np.linspace(1e-6, 60, 2_000_001)
    for lost, hazard in ((0, 0.4), (3, 1.5), (8, 20.0)):
        density = m ** (lost - 0.5) * np.exp(-m * hazard)
        mass = np.cumsum(density) / density.sum()
        found = Multiplier(lost, hazard)
        assert found.mean == pytest.approx(float((m * density).sum() / density.sum()), rel=0.01)
        assert found.above == pytest.approx(1 - float(np.interp(1.0, m, mass)), abs=0.01)
        if lost:
            assert found.interval == pytest.approx(np.interp([0.025, 0.975], mass, m), rel=0.02)
    rng, p, held = np.random.default_rng(1), 0.03, 0
    for _ in range(1000):
        ends = rng.geometric(p, size=8)
        visits, lost = np.minimum(ends, 40).sum(), int((ends <= 40).sum())
        low, high = Multiplier(lost, -float(visits) * math.log(1 - p)).interval
        held += low <= 1 <= high
    assert abs(held / 1000 - 0.95) <= 5 * math.sqrt(0.95 * 0.05 / 1000)


def test_threats_that_change_and_that_move(tmp_path: Path) -> None:
    """Phases count by the step of a visit, by the robot's own clock; of threats that move no hazard is known."""
    world = World.create(np.full((1, 6), 0.1)).with_phases([(0, np.full((1, 6), 0.1)), (3, np.full((1, 6), 0.3))])
    path = tmp_path / "t.csv"
    path.write_text("robot,step,row,col,status\n" + "".join(f"a,{7 + step},0,{step},dead\n" for step in range(6)))
    done = mrac.debrief(world, path)
    assert done.flights[0].hazard == pytest.approx(-3 * math.log(0.9) - 3 * math.log(0.7), rel=1e-6)
    assert (done.lost, done.state, done.flights[0].name) == (1, None, "a")
    moving = World.create(np.zeros((1, 6))).with_moving_threats([{"walk": 0.5, "h": 0.2}])
    done = mrac.debrief(moving, path)
    assert done.multiplier is None and any("loss rate is not compared" in note for note in done.notes)


def test_the_command(
    tmp_path: Path, flown: tuple, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    world, plan, cells, dead, _ = flown
    monkeypatch.chdir(tmp_path)
    world.save("w.npz")
    plan.save("p.json")
    tracks(tmp_path, "csv", metres(cells))
    words = ["debrief", "w.npz", "--tracks", "t.csv", "--plan", "p.json", "--lost", str(dead[0])]
    assert run([*words, "--out", "out"]) == 0
    said = capsys.readouterr().out
    assert "planned: 100 %" in said and "1 of 2 robots lost" in said and "times that of the map" in said
    names = {"index.html", "debrief.txt", "debrief.json", "debrief.png", "state.json", "rest.json", "flown.geojson"}
    assert {file.name for file in Path("out").iterdir()} == names
    done = mrac.debrief(world, "t.csv", plan, lost=dead)
    features = json.loads(Path("out/flown.geojson").read_text())["features"]
    for kind, marked in (("flown", done.visited), ("left", done.accessible & ~done.visited)):
        held = [one["geometry"] for one in features if one["properties"]["kind"] == kind]
        shapes = [
            {"type": "Polygon", "coordinates": [
                [((x - ORIGIN[0]) / CELL, 7 - (y - ORIGIN[1]) / CELL)
                 for x, y in np.transpose(transform("EPSG:4326", UTM, *zip(*ring, strict=True)))] for ring in part]}
            for one in held for part in one["coordinates"]
        ]  # fmt: skip
        assert np.flatnonzero(rasterize(shapes, out_shape=(7, 9), fill=0)).tolist() == np.flatnonzero(marked).tolist()
    again = mrac.plan(world, state="out/state.json")
    assert [one.path.tolist() for one in again.robots] == [one.path.tolist() for one in done.rest.robots]  # type: ignore[union-attr]
    every = ["debrief", "w.npz", "--tracks", "t.csv", "--lost", "0,1", "--out", "none"]
    assert run(every) == 0 and not (tmp_path / "none" / "rest.json").exists()


HEAD = "robot,time,x,y\n"
HERE = f"{ORIGIN[0] + 1},{ORIGIN[1] + 1}"
LINE = '{"type":"FeatureCollection","features":[{"properties":%s,"geometry":{"type":"LineString","coordinates":%s}}]}'


REFUSED = [
    ("t.csv", f"robot,x,y\n0,{HERE}\n", "", "robot 0 has no times; expected a time for each place"),
    ("t.csv", f"time,x,y\n0,{HERE}\n", "", "has the columns time, x, y; expected robot, a time or step"),
    ("t.csv", f"{HEAD}0,noon,{HERE}\n", "", "line 2: time is 'noon'"),
    ("t.csv", f"{HEAD}0,0,1,1\n", "", "no place of robot 0 is on a free cell"),
    ("t.csv", f"{HEAD}5,0,{HERE}\n", "--plan p.json", "robot 5 is none of the plan's 2; expected robots 0 to 1"),
    ("t.csv", f"{HEAD}0,0,{HERE}\n", "--lost 3", "--lost 3; expected robots of t.csv: 0"),
    ("t.csv", f"robot,time,x,y,status\n0,0,{HERE},gone\n", "", "status 'gone'; expected idle, done, dead or lost"),
    ("t.gpx", "<gpx><trk><trkpt lon='15' lat='52'/></trk></gpx>", "", "has no times"),
    ("t.gpx", "<!DOCTYPE a><gpx/>", "", "has a document type"),
    ("t.geojson", LINE % ('{"times":[0,1]}', "[[500000,0],[500001,0]]"), "", "a point at longitude 500000"),
    ("t.geojson", LINE % ('{"times":[0]}', "[[15,52],[15,52.1]]"), "", "1 times for 2 places"),
    ("t.geojson", LINE % ("{}", "[[15,52],[15,52.1]]"), "", "has no times"),
    ("t.geojson", LINE % ('{"times":[]}', "[]"), "", "holds no track"),
    ("t.geojson", '{"features":7}', "", "is no GeoJSON of tracks"),
    ("t.kml", "<kml/>", "", "no tracks are read from '.kml'"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "more", "words"), REFUSED)
def test_what_is_refused(
    tmp_path: Path, flown: tuple, name: str, text: str, more: str, words: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    flown[0].save("w.npz")
    flown[1].save("p.json")
    Path(name).write_text(text)
    assert words in error_of(capsys, "debrief", "w.npz", "--tracks", name, "--out", "out", *more.split())
    assert not Path("out").exists()


def test_degrees_on_a_map_without_a_place(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("robot,step,lon,lat\n0,0,15,52\n")
    with pytest.raises(MapError, match="in EPSG:4326, and the map has no georeference; give columns x and y"):
        mrac.debrief(World.create(np.zeros((3, 4))), tmp_path / "t.csv")
