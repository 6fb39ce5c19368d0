"""Recording: the file, every channel, the viewer layout, which rollout is picked."""

import json
import re
import struct
from collections import Counter, defaultdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from helpers import rollout_results
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from recordings import SEED, foreign_plan, positions, small_recording, small_task

from analysis.recording import contents
from analysis.recording import record as rolling
from analysis.recording.container import open_log
from analysis.recording.contents import read_outcomes, read_rollouts
from analysis.recording.frames import Held, make_frames
from analysis.recording.viewers import topics as colours
from analysis.recording.viewers.messages import rollout_messages
from analysis.recording.viewers.topics import (
    MOST_STATES,
    Clock,
    Stage,
    Stats,
    layout_json,
    topic_types,
    type_of,
    write_layout,
)
from analysis.recording.viewers.topics import path as ros_path
from analysis.theory.bounds import all_bounds
from planner.errors import InputError, MapError, UsageError
from planner.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan, headings
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import closed_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.open_loop_events import open_loop_trace
from planner.settings import Settings
from planner.simulator.codes import Doing, EventKind, Outcome
from planner.tally import RolloutResults, Trace
from planner.world.world import World

# Recording: what is in the file, that it can be read back, and that the same input gives the same bytes.


@pytest.mark.parametrize("first_only", [False, True])
def test_rollouts_come_back_as_they_were(tmp_path: Path, first_only: bool) -> None:
    path = tmp_path / "r.mcap"
    world, plan = small_recording(path, ids=(9, 2, 4), first_only=first_only)
    loop, found = compile_closed_loop(plan, world, first_only=first_only), list(read_rollouts(path))
    assert [one.trace for one in found] == list(closed_loop_engine(loop, SEED, "numba").traces([9, 2, 4]))
    for one in found:
        results = run_range(loop, SEED, one.trace.rollout, 1, singles=True)[1]
        last = (one.visited[-1], one.survived[-1], one.alive[-1], one.trace.time)
        assert last == (results.visited[0], results.survived[0], results.alive[0], results.time[0])
        assert (one.loop, one.seed, one.shape) == ("closed", SEED, world.shape)
        assert one.accessible == world.accessible(plan.starts).sum()
        assert one.trace.cells.dtype == one.trace.events.dtype == np.int32
    assert len(read_outcomes(path).ids) == 0, "none unless asked"


@pytest.mark.usefixtures("few_lanes")
def test_same_input_same_bytes_whatever_the_engine(tmp_path: Path) -> None:
    choices = {"ids": (), "picks": rolling.parse_picks("worst,best,random"), "evaluated": 300, "outcomes": True}
    small_recording(tmp_path / "a.mcap", **choices)
    small_recording(tmp_path / "b.mcap", **choices)
    small_recording(tmp_path / "jax.mcap", **choices, engine="jax")
    first = (tmp_path / "a.mcap").read_bytes()
    assert first == (tmp_path / "b.mcap").read_bytes() == (tmp_path / "jax.mcap").read_bytes()
    assert b"numba" not in first
    assert str(tmp_path).encode() not in first


def test_what_lies_beside_the_messages(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    world, plan = small_recording(
        path, ids=(), picks=rolling.parse_picks("median"), evaluated=100, scenario=b"map: x\n"
    )
    log = open_log(path)
    settings = contents.read_settings(log.attachment("settings.json"), "r")
    assert (settings.seed, settings.evaluated, settings.plan, settings.loop) == (SEED, 100, "made", "closed")
    assert settings.ids == tuple(settings.picks.values())
    stored = contents.read_world(log.attachment("world.npz"), "r")
    assert stored.sha256 == world.sha256
    assert (stored.cell_size, stored.origin) == (world.cell_size, world.origin)
    assert contents.read_plan(log.attachment("plan.json"), stored, "r").to_json() == plan.to_json()
    tally = contents.read_tally(log.attachment("tally.json"), log.attachment("tally-cells.npz"), "r")
    assert tally == run_range(compile_closed_loop(plan, world), SEED, 0, 100)[0]
    bounds = json.loads(log.attachment("bounds.json"))
    assert bounds["ideal_team"] == all_bounds(plan, world).ideal_team
    assert json.loads(log.attachment("layout.json"))
    assert bytes(log.attachment("scenario.yaml")) == b"map: x\n"
    (items,) = (items for name, items in log.metadata if name == "mrac-jax")
    assert (items["format"], items["seed"], items["rows"], items["columns"]) == ("mrac-recording", "5", "6", "9")


def test_every_outcome_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rolling, "BLOCK", 64)
    path = tmp_path / "r.mcap"
    world, plan = small_recording(path, ids=(), picks=rolling.parse_picks("best"), evaluated=1000, outcomes=True)
    found = read_outcomes(path)
    truth = run_range(compile_closed_loop(plan, world), SEED, 0, 1000, singles=True)[1]
    assert np.array_equal(found.ids, np.arange(1000))
    for name in ("visited", "survived", "time", "alive", "outcome"):
        assert np.array_equal(getattr(found, name), getattr(truth, name)), name
        assert getattr(found, name).dtype == getattr(truth, name).dtype
    blocks = [rolling.topics.Outcomes.FromString(one.data) for one in open_log(path).messages(["/outcomes"])]
    assert [(one.first, len(one.visited)) for one in blocks] == [(at, min(64, 1000 - at)) for at in range(0, 1000, 64)]
    (best,) = read_rollouts(path)
    order = np.lexsort((found.ids, found.time, -found.survived, -found.visited))
    assert best.trace.rollout == order[0]


def test_ids_alone_are_the_tally(tmp_path: Path) -> None:
    world, plan = small_task()
    done = rolling.record(world, plan, rolling.Request(ids=(3, 4, 9), seed=SEED), tmp_path / "r.mcap")
    assert done.tally.ids == ((3, 5), (9, 10))
    assert [row.rollout for row in done.rows] == [3, 4, 9]


@pytest.mark.parametrize("foreign", [False, True])
def test_the_open_loop(tmp_path: Path, foreign: bool) -> None:
    world, plan = small_task()
    chosen = foreign_plan(world, plan) if foreign else plan
    request = rolling.Request(picks=rolling.parse_picks("worst"), evaluated=500, outcomes=True, loop="open", seed=SEED)
    done = rolling.record(world, chosen, request, tmp_path / "r.mcap")
    truth = rollout_results(compile_plan(chosen, world), seed=SEED, count=500)
    found = read_outcomes(tmp_path / "r.mcap")
    assert np.array_equal(found.visited, truth.visited)
    (one,) = read_rollouts(tmp_path / "r.mcap")
    assert one.visited[-1] == truth.visited.min()
    assert one.trace.rollout == done.rows[0].rollout
    assert one.loop == "open"


def test_it_says_that_it_writes(tmp_path: Path) -> None:
    world, plan = small_task()
    told: list[str] = []
    rolling.record(world, plan, rolling.Request(ids=(3, 4), seed=SEED), tmp_path / "r.mcap", doing=told.append)
    assert told == ["writing rollout 1 of 2", "writing rollout 2 of 2", "closing the file"]


WRONG_REQUESTS = [
    ({"step_seconds": 0.0}, "step_seconds=0.0"),
    ({"step_seconds": 501.0}, "step_seconds=501.0"),
    ({"first_only": True, "loop": "open"}, "first_only=True"),
]


@pytest.mark.parametrize(("request_", "said"), WRONG_REQUESTS)
def test_requests_that_make_no_sense(tmp_path: Path, request_: dict[str, Any], said: str) -> None:
    world, plan = small_task()
    with pytest.raises(UsageError, match=said):
        rolling.record(world, plan, rolling.Request(ids=(1,), **request_), tmp_path / "r.mcap")
    assert list(tmp_path.iterdir()) == []


def test_times_that_ros_cannot_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.record.MOST_SECONDS", 100.0)
    with pytest.raises(UsageError, match="reduce step_seconds"):
        small_recording(tmp_path / "r.mcap", step_seconds=400.0)


def test_a_rollout_that_is_not_all_there(tmp_path: Path) -> None:
    from recordings import nth, rewrite

    small_recording(tmp_path / "r.mcap")
    for topic in ("/rollout/step", "/rollout/end", "/rollout/start"):
        rewrite(tmp_path / "r.mcap", tmp_path / "cut.mcap", change=nth(topic, 0, lambda data: None))
        with pytest.raises(InputError, match=r"cut\.mcap"):
            list(read_rollouts(tmp_path / "cut.mcap"))


def test_the_scenario_goes_along_and_no_other_input(tmp_path: Path) -> None:
    assert b"map:" in (rolling.scenario_text("example:terrain") or b"")
    assert rolling.scenario_text("example:paper") is None
    from importlib.resources import files

    assert rolling.scenario_text(str(files("analysis.examples") / "building_map.yaml")) is None


def test_settings_are_checked_value_by_value() -> None:
    good = contents.Settings("closed", "every_visit", 1, (2,), {"best": 2}, 10, False, 1.0, "made", "0.1").to_json()
    assert contents.read_settings(contents.json_bytes(good), "f").ids == (2,)
    wrong: dict[str, tuple[Any, ...]] = {"seed": (-1, True, 2**64), "ids": ([1.5], "1"), "version": (3, 0, "2")}
    wrong |= {"loop": ("both",), "step_seconds": (1e9,), "picks": ({"best": "2"},), "format": ("other",)}
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(InputError, match=r"f \(settings.json\)"):
                contents.read_settings(contents.json_bytes(good | {name: value}), "f")
    with pytest.raises(InputError, match="invalid JSON"):
        contents.read_settings(b"[" * 100_000, "f")


# Every channel of a recording, decoded by other people's readers, and held against the world and the trace.

WHERE_THERE_ARE = {"/movers/markers", "/movers/points", "/map/truth", "/map/fog"}
"""Threats that move, and robots that learn."""
Decoded = dict[str, list[tuple[int, Any]]]


def decoded(path: Path) -> Decoded:
    """(log time, message) by topic, as the `mcap` packages read them."""
    by_topic: Decoded = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[ProtobufDecoders(), Ros2Decoders()])
        for _, channel, message, value in reader.iter_decoded_messages():
            by_topic[channel.topic].append((message.log_time, value))
    return by_topic


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[World, Plan, list[Trace], Decoded, Path]:
    path = tmp_path_factory.mktemp("recording") / "two.mcap"
    world, plan = small_recording(path)
    traces = trace_rollouts(compile_closed_loop(plan, world), SEED, [3, 4])
    return world, plan, traces, decoded(path), path


def of_first(topic: str, recorded: tuple) -> list[tuple[int, Any]]:
    """The messages of the first rollout."""
    _, _, traces, by_topic, _ = recorded
    return [(time, message) for time, message in by_topic[topic] if time <= traces[0].time * 10**9]


def test_messages_are_in_order_and_the_statistics_count_them(recorded: tuple) -> None:
    path = recorded[-1]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        in_file = [
            (message.log_time, channel.topic) for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
    assert [time for time, _ in in_file] == sorted(time for time, _ in in_file)
    counts = Counter(topic for _, topic in in_file)
    statistics = summary.statistics
    assert statistics.message_count == len(in_file)
    told = {summary.channels[one].topic: count for one, count in statistics.channel_message_counts.items()}
    assert told == dict(counts)
    assert (statistics.message_start_time, statistics.message_end_time) == (0, in_file[-1][0])


def test_every_topic_has_its_published_schema(recorded: tuple) -> None:
    with recorded[-1].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    topics = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    types = topic_types()
    expected = {topic for topic in types if "*" not in topic} - {"/outcomes", *WHERE_THERE_ARE}
    expected |= {f"/robots/{robot}/{kind}" for robot in range(3) for kind in ("plan", "driven", "voxel")}
    assert set(topics) == expected
    assert topics["/map/threat"].name == "foxglove.Grid"
    assert topics["/map/threat_occ"].name == "nav_msgs/msg/OccupancyGrid"
    assert topics["/areas_voxels"].name == "foxglove.VoxelGrid"
    for topic, schema in topics.items():
        own = type_of(topic)
        assert (schema.name, schema.encoding, schema.data) == (own.name, own.encoding, own.data)


def test_data_topics_hold_the_trace(recorded: tuple) -> None:
    world, _, traces, by_topic, _ = recorded
    assert [start.rollout for _, start in by_topic["/rollout/start"]] == [3, 4]
    first = by_topic["/rollout/start"][0][1]
    assert (first.height, first.width, first.seed, first.loop) == (*world.shape, SEED, "closed")
    steps = [message for _, message in by_topic["/rollout/step"]]
    assert [list(step.cells) for step in steps] == [row.tolist() for trace in traces for row in trace.cells]
    assert [list(step.areas) for step in steps] == [row.tolist() for trace in traces for row in trace.areas]
    events = [(e.step, e.robot, e.kind, e.area, e.other) for _, e in by_topic["/rollout/event"]]
    assert events == [tuple(row) for trace in traces for row in trace.events.tolist()]
    ends = [message for _, message in by_topic["/rollout/end"]]
    assert [(end.rollout, end.outcome, end.time) for end in ends] == [(t.rollout, t.outcome, t.time) for t in traces]
    names = {"Doing": Doing, "EventKind": EventKind, "Outcome": Outcome}
    file = type(steps[0]).DESCRIPTOR.file
    for name, members in names.items():
        assert {v.name: v.number for v in file.enum_types_by_name[name].values} == {
            m.name: m.value
            for m in members
            if m is not Outcome.DEADLINE  # recordings hold the step limit in its place
        }


def test_rollouts_follow_each_other_with_a_gap(recorded: tuple) -> None:
    _, _, traces, by_topic, _ = recorded
    times = [time for time, _ in by_topic["/rollout/step"]]
    first = np.arange(len(traces[0].cells)) * 10**9
    second = first[-1] + 3 * 10**9 + np.arange(len(traces[1].cells)) * 10**9
    assert times == [*first.tolist(), *second.tolist()]


def test_grids_lie_where_the_world_says_and_show_it(recorded: tuple) -> None:
    world, _, _, by_topic, _ = recorded
    for topic in ("/map/threat", "/map/obstacles", "/map/visited", "/areas"):
        grid = by_topic[topic][0][1]
        assert (grid.pose.position.x, grid.pose.position.y) == (10.0, -20.0)
        assert (grid.pose.orientation.z, grid.pose.orientation.w) == pytest.approx((np.sin(0.35), np.cos(0.35)))
        assert (grid.cell_size.x, grid.cell_size.y, grid.frame_id) == (0.5, 0.5, "map")
        assert grid.column_count == world.shape[1]
        assert len(grid.data) == grid.row_stride * world.shape[0]
    threat = cells_of(by_topic["/map/threat"][0][1], "<f4", world)
    assert np.array_equal(threat, np.nan_to_num(world.threat))
    obstacle = cells_of(by_topic["/map/obstacles"][0][1], "u1", world)
    assert np.array_equal(obstacle[..., 3] > 0, ~world.free)
    occupied = np.array(by_topic["/map/threat_occ"][0][1].data).reshape(world.shape)[::-1]
    assert (occupied[~world.free] == 100).all()
    accessible = world.accessible(world.starts)
    threats = world.threat[accessible].astype(float)
    assert np.array_equal(occupied[accessible] == 0, threats == 0)
    assert occupied[accessible].max() == 70
    assert (np.diff(occupied[accessible][np.argsort(threats)]) >= 0).all()
    assert (occupied[world.free & ~accessible] == -1).all()


def cells_of(grid: Grid, kind: str, world: World) -> np.ndarray:
    """A foxglove.Grid's values by row and column of the world, its layout taken from the message alone."""
    rows = [grid.data[at * grid.row_stride : (at + 1) * grid.row_stride] for at in range(world.shape[0])]
    values = np.stack([np.frombuffer(row, dtype=kind).reshape(grid.column_count, -1) for row in rows])
    return np.squeeze(values[::-1], axis=-1) if values.shape[-1] == 1 else values[::-1]


def test_a_small_turned_world_by_hand() -> None:
    """2 x 3 cells of 2 m, the lower-left corner at (10, 20), turned by 90 degrees: up is -x, right is +y."""
    threat = np.array([[0.0, 0.1, np.nan], [0.2, 0.0, 0.3]])
    world = World.create(threat, starts=[[0, 0]], cell_size=2.0, origin=(10.0, 20.0, np.pi / 2))
    plan = Plan(world.shape, world.sha256, None, (RobotPlan(np.array([0, 1, 4, 5])),), outcome="end_of_paths", time=3)
    trace = next(
        t for t in (open_loop_trace(plan, world, 0, r) for r in range(50)) if t.outcome == Outcome.END_OF_PATHS
    )
    sent = defaultdict(list)
    for message in rollout_messages(Stage(world, plan, "open", 0), trace, Clock(0, 0.25)):
        sent[message.topic].append(message)
    grid = Grid.FromString(sent["/map/threat"][0].data)
    assert np.frombuffer(grid.data, "<f4").tolist() == pytest.approx([0.2, 0.0, 0.3, 0.0, 0.1, 0.0])
    assert (grid.pose.position.x, grid.pose.position.y, grid.column_count) == (10.0, 20.0, 3)
    assert (grid.pose.orientation.z, grid.pose.orientation.w) == pytest.approx((np.sqrt(0.5), np.sqrt(0.5)))
    centres = {0: (7.0, 21.0), 1: (7.0, 23.0), 4: (9.0, 23.0), 5: (9.0, 25.0)}
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

    poses = [PosesInFrame.FromString(message.data).poses[0] for message in sent["/robots/poses"]]
    assert [(p.position.x, p.position.y) for p in poses] == [pytest.approx(centres[c]) for c in (0, 1, 4, 5)]
    facing = [2 * np.arctan2(p.orientation.z, p.orientation.w) for p in poses]
    assert facing == pytest.approx([np.pi / 2, np.pi / 2, 0.0, np.pi / 2])
    assert [message.time for message in sent["/robots/poses"]] == [0, 250_000_000, 500_000_000, 750_000_000]
    assert "/areas" not in sent


def test_robots_stand_where_the_trace_says(recorded: tuple) -> None:
    world, _, traces, _, _ = recorded
    trace = traces[0]
    xy = positions(world, trace.cells)
    yaw = np.stack([headings(own.astype(np.int64), world) for own in trace.cells.T], axis=1)
    alive = trace.doing != Doing.DEAD
    for step, (time, poses) in enumerate(of_first("/robots/poses", recorded)):
        assert time == step * 10**9 == poses.timestamp.ToNanoseconds()
        assert [(p.position.x, p.position.y) for p in poses.poses] == [pytest.approx(at) for at in xy[step]]
    for step, (_, frames) in enumerate(of_first("/tf", recorded)):
        assert [t.child_frame_id for t in frames.transforms] == ["robot_0", "robot_1", "robot_2"]
        assert [(t.translation.x, t.translation.y) for t in frames.transforms] == [pytest.approx(at) for at in xy[step]]
        turned = [(t.rotation.z, t.rotation.w) for t in frames.transforms]
        assert turned == [pytest.approx((np.sin(a / 2), np.cos(a / 2))) for a in yaw[step]]
    for step, (_, scene) in enumerate(of_first("/robots/markers", recorded)):
        for robot, entity in enumerate(scene.entities):
            at = entity.spheres[0].pose.position
            assert (at.x, at.y) == pytest.approx(tuple(xy[step, robot]))
            assert len(entity.lines) == (0 if alive[step, robot] else 1)
            assert entity.texts[0].text == (str(robot) if alive[step, robot] else f"× {robot}")  # noqa: RUF001
    for step, (_, cloud) in enumerate(of_first("/robots/points", recorded)):
        offsets = {field.name: field.offset for field in cloud.fields}
        for robot in range(3):
            point = cloud.data[robot * cloud.point_stride : (robot + 1) * cloud.point_stride]
            assert struct.unpack_from("<2f", point, offsets["x"]) == pytest.approx(tuple(xy[step, robot]), rel=1e-6)
            colour = tuple(point[offsets["red"] : offsets["red"] + 3])
            assert colour == (colours.robot_rgb(robot) if alive[step, robot] else colours.LOST)
            assert struct.unpack_from("<H", point, offsets["robot"]) == (robot,)


def test_visits_and_areas_as_they_change(recorded: tuple) -> None:
    world, _, traces, _, _ = recorded
    trace = traces[0]
    frames = make_frames(trace)
    counts = np.zeros(world.threat.size, dtype=int)
    visits = of_first("/map/visited", recorded)
    areas, plates = (dict(of_first(topic, recorded)) for topic in ("/areas", "/areas_voxels"))
    assert len(visits) == len(trace.cells)
    assert areas.keys() == plates.keys()
    assert 0 in areas
    for step in range(len(trace.cells)):
        for robot in np.flatnonzero(frames.moved[step]):
            counts[trace.cells[step, robot]] += 1
        assert np.array_equal(cells_of(visits[step][1], "u1", world).reshape(-1), counts)
        assert (frames.visited_at == step).any() <= (step * 10**9 in areas)
        rgba = cells_of(areas.get(step * 10**9, areas[0]), "u1", world).reshape(-1, 4)
        if step * 10**9 in areas:
            for cell in np.flatnonzero(counts):
                assert tuple(rgba[cell, :3]) == colours.robot_rgb(int(frames.visited_by[cell]))
            assert np.array_equal(rgba[:, 3] > 0, trace.area_of >= 0)
            assert len(set(rgba[counts > 0, 3].tolist())) == 1
            assert (rgba[counts == 0, 3] < rgba[counts > 0, 3][0]).all()
            plate = cells_of(plates[step * 10**9], "u1", world).reshape(-1, 4)
            assert np.array_equal(plate[counts > 0, :3], rgba[counts > 0, :3])
            assert set(plate[:, 3].tolist()) <= {0, 255}
    check_owners(areas[0], plates[0], recorded)


def check_owners(grid: Any, voxels: Any, recorded: tuple) -> None:
    """Cells not visited at step 0 have their owner's colour, pale as a plate; nobody's are grey, and no plate."""
    world, plan, traces, _, _ = recorded
    owned, plate = (cells_of(one, "u1", world).reshape(-1, 4) for one in (grid, voxels))
    assert (voxels.row_count, voxels.column_count, voxels.slice_stride) == (*world.shape, 4 * world.threat.size)
    assert (voxels.cell_size.x, voxels.cell_size.y) == (0.5, 0.5)
    for area in plan.areas:
        unseen = area.cells[~np.isin(area.cells, traces[0].cells[0])]
        colour = colours.OPEN_AREA if area.robot < 0 else colours.robot_rgb(area.robot)
        assert {tuple(rgb) for rgb in owned[unseen, :3].tolist()} <= {colour}
        assert set(plate[unseen, 3].tolist()) <= {0 if area.robot < 0 else 255}
        if area.robot >= 0 and len(unseen):
            assert (plate[unseen, :3].astype(int) >= owned[unseen, :3]).all()


def test_robots_are_blocks_where_they_stand(recorded: tuple) -> None:
    """A block is sent when the robot moves or is lost; the last one sent is where it is, and as it is."""
    world, _, traces, _, _ = recorded
    trace = traces[0]
    alive = trace.doing != Doing.DEAD
    for robot in range(trace.cells.shape[1]):
        sent = dict(of_first(f"/robots/{robot}/voxel", recorded))
        times = [time for time, _ in of_first("/rollout/step", recorded)]
        last, changes = None, 0
        for step, time in enumerate(times):
            if time in sent:
                last, changes = sent[time], changes + 1
            assert (last.row_count, last.column_count) == (1, 1)
            yaw = 2 * np.arctan2(last.pose.orientation.z, last.pose.orientation.w)
            side = last.cell_size.x / 2
            x = last.pose.position.x + np.cos(yaw) * side - np.sin(yaw) * side
            y = last.pose.position.y + np.sin(yaw) * side + np.cos(yaw) * side
            at = divmod(int(trace.cells[step, robot]), world.shape[1])
            assert tuple(world.to_cells([x, y]).tolist()) == at
            assert tuple(last.data) == (*(colours.ALIVE if alive[step, robot] else colours.LOST), 255)
        moves = np.count_nonzero(np.diff(trace.cells[:, robot]) | np.diff(alive[:, robot].astype(int)))
        assert changes == 1 + moves


def test_scalars_and_the_log(recorded: tuple) -> None:
    world, plan, traces, by_topic, _ = recorded
    accessible = int(world.accessible(plan.starts).sum())
    stats = [message for _, message in by_topic["/stats"]]
    frames = [make_frames(trace) for trace in traces]
    visited = np.concatenate([one.visited for one in frames]) / accessible
    assert [one.coverage_visited for one in stats] == visited.tolist()
    assert [one.alive for one in stats] == [float(n) for one in frames for n in one.alive_count]
    words = [[Doing(doing).name.lower() for doing in row] for trace in traces for row in trace.doing]
    assert [list(one.doing) for one in stats] == words
    plotted = [list(message.data) for _, message in by_topic["/coverage"]]
    assert plotted == [[one.coverage_visited, one.coverage_survived] for one in stats]
    logs = of_first("/events", recorded)
    assert len(logs) == len(traces[0].events) + 1
    levels = {EventKind.HIT: 4, EventKind.REALLOCATED: 3, EventKind.SHARED: 3}
    assert [log.level for _, log in logs[:-1]] == [levels.get(kind, 2) for kind in traces[0].events[:, 2].tolist()]
    hit = next(log for _, log in logs if log.level == 4)
    assert "is lost at [" in hit.message
    assert logs[-1][1].message.startswith("rollout 3 ends: ")


def test_lines_and_paths(recorded: tuple) -> None:
    world, plan, traces, by_topic, _ = recorded
    trace = traces[0]
    for robot, entity in enumerate(by_topic["/plans"][0][1].entities):
        line = positions(world, plan.robots[robot].path)
        check_line(entity.lines[0], line)
    last_time, last = of_first("/driven", recorded)[-1]
    assert last_time == trace.time * 10**9
    for robot, entity in enumerate(last.entities):
        check_line(entity.lines[0], positions(world, trace.cells[:, robot]))
    frames = make_frames(trace)
    for robot in range(3):
        _, path = of_first(f"/robots/{robot}/driven", recorded)[-1]
        entered = np.flatnonzero(frames.moved[:, robot])
        assert [pose.header.stamp.sec for pose in path.poses] == entered.tolist()
        found = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
        assert found == [pytest.approx(at) for at in positions(world, trace.cells[entered, robot])]
        _, path = by_topic[f"/robots/{robot}/plan"][0]
        assert len(path.poses) == len(plan.robots[robot].path)


def check_line(line: Any, places: np.ndarray) -> None:
    """A line through the corners goes through all places."""
    points = np.array([[point.x, point.y] for point in line.points])
    assert points[0] == pytest.approx(places[0])
    assert points[-1] == pytest.approx(places[-1])
    for place in places:
        if len(points) == 1:
            assert place == pytest.approx(points[0])
            continue
        start, along = points[:-1], np.diff(points, axis=0)
        length = (along**2).sum(axis=1)
        at = np.clip(((place - start) * along).sum(axis=1) / np.maximum(length, 1e-12), 0, 1)
        assert np.hypot(*(start + at[:, None] * along - place).T).min() < 1e-9


def test_an_independent_ros_library_reads_the_cdr_messages(recorded: tuple) -> None:
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    world, _, _, by_topic, path = recorded
    with path.open("rb") as stream:
        raw = {
            channel.topic: (schema.name, message.data)
            for schema, channel, message in make_reader(stream).iter_messages()
            if channel.message_encoding == "cdr"
        }
    assert len(raw) == 2 + 2 * 3
    for topic, (kind, data) in raw.items():
        message = store.deserialize_cdr(data, kind)
        assert bytes(store.serialize_cdr(message, kind)) == bytes(data)
        if kind.endswith("Array"):
            assert message.data.tolist() == list(by_topic[topic][-1][1].data)
            continue
        assert message.header.frame_id == "map"
        if kind.endswith("OccupancyGrid"):
            assert (message.info.width, message.info.height) == (world.shape[1], world.shape[0])
            assert message.info.resolution == np.float32(0.5)
            assert (message.info.origin.position.x, message.info.origin.position.y) == (10.0, -20.0)
            assert message.info.origin.orientation.z == pytest.approx(np.sin(0.35))
            assert message.data.tolist() == list(by_topic[topic][-1][1].data)
        else:
            assert len(message.poses) == len(by_topic[topic][-1][1].poses) > 0


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_paths_of_any_length_are_aligned(count: int) -> None:
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    steps = np.arange(count)
    data = ros_path(1_500_000_000, steps * 10**9 + 7, np.stack([steps, -steps], axis=1).astype(float), steps * 0.1)
    message = store.deserialize_cdr(data, "nav_msgs/msg/Path")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert [(p.header.stamp.sec, p.header.stamp.nanosec) for p in message.poses] == [(i, 7) for i in range(count)]
    assert [p.pose.position.y for p in message.poses] == [-float(i) for i in range(count)]
    assert bytes(store.serialize_cdr(message, "nav_msgs/msg/Path")) == data


def test_another_planners_plan_and_the_open_loop(tmp_path: Path) -> None:
    world, plan = small_task()
    for name, one in (("own", plan), ("foreign", foreign_plan(world, plan))):
        path = tmp_path / f"{name}.mcap"
        rolling.record(world, one, rolling.Request(ids=(0, 7), loop="open", seed=SEED, made=False), path)
        by_topic = decoded(path)
        assert ("/areas" in by_topic) == (name == "own")
        traces = [open_loop_trace(one, world, SEED, rollout) for rollout in (0, 7)]
        steps = [list(step.cells) for _, step in by_topic["/rollout/step"]]
        assert steps == [row.tolist() for trace in traces for row in trace.cells]


def test_what_robots_learn_and_when(tmp_path: Path) -> None:
    """Truth, belief and fog at every step, by distances alone; areas against those that the engine's robots say."""
    known, seen_far, path = small_task()[0], 2, tmp_path / "dark.mcap"
    world = known.with_prior_map(0.05, sensor_range=seen_far)
    plan = make_plan(world, world.starts, Settings())
    rolling.record(world, plan, rolling.Request(ids=(3,), seed=SEED), path)
    (trace,), by_topic = trace_rollouts(compile_closed_loop(plan, world), SEED, [3]), decoded(path)
    truth = cells_of(by_topic["/map/truth"][0][1], "<f4", known)[..., 0]
    assert np.array_equal(truth, np.nan_to_num(known.threat))
    places, when = np.indices(world.shape), np.full(world.shape, -1)
    last, areas = dict[str, Any](), set[bytes]()
    for step in range(trace.time + 1):
        for row, col in zip(
            *np.divmod(trace.cells[step][trace.doing[step] != Doing.DEAD], world.shape[1]), strict=True
        ):
            near = (places[0] - row) ** 2 + (places[1] - col) ** 2 <= seen_far**2
            when[near & (when < 0)] = step
        last |= {topic: one for topic, all_of_it in by_topic.items() for time, one in all_of_it if time == step * 10**9}
        believed = np.where(when >= 0, known.threat, np.float32(0.05))
        assert np.array_equal(cells_of(last["/map/threat"], "<f4", world), np.nan_to_num(believed))
        assert np.array_equal(cells_of(last["/map/obstacles"], "u1", world)[..., 3] > 0, np.isnan(believed))
        assert np.array_equal(np.array(last["/map/threat_occ"].data).reshape(world.shape)[::-1] == -1, when < 0)
        fog = cells_of(last["/map/fog"], "u1", world)
        assert np.array_equal(fog[..., :4].copy().view("<f4")[..., 0], when)
        assert np.array_equal(fog[..., 7] > 0, when < 0)
        areas.add(last["/areas"].data)
    assert (when >= 0).any() and (when[np.isnan(known.threat)] >= 0).any() and len(areas) > 5
    told, more = (json.loads(layout_json(one, 3))["configById"].keys() for one in (known, world))
    assert more > told


def test_areas_of_robots_that_learn_are_those_of_the_engine() -> None:
    world = small_task()[0].with_prior_map(0.05, sensor_range=1)
    plan = make_plan(world, world.starts, Settings())
    stage, steps = Stage(world, plan, "closed", SEED), 0
    for trace in trace_rollouts(compile_closed_loop(plan, world), SEED, range(4)):
        maps = {areas.step: areas for areas in stage.area_maps(trace)}
        areas = maps[0]
        for step in range(trace.time + 1):
            areas = maps.get(step, areas)
            for robot, (area, doing) in enumerate(zip(trace.areas[step], trace.doing[step], strict=True)):
                if doing in (Doing.TRAVELING, Doing.COVERING):
                    assert set(areas.robot[areas.area == area].tolist()) == {robot}
                    assert set(areas.held[areas.area == area].tolist()) == {Held.ASSIGNED}
                    steps += 1
            assert (areas.open > 0) == bool((areas.held[areas.area >= 0] == Held.UNASSIGNED).any())
        assert np.array_equal(areas.area, trace.area_of)
        assert {EventKind.SURPRISED} < {*trace.events[:, 2].tolist()}
    assert steps > 100


def test_a_drawn_truth_is_that_of_the_rollout() -> None:
    world = small_task()[0].with_spread("lognormal", 0.6, by="common").with_sensor_range(2)
    plan, truths = make_plan(world, world.starts, Settings()), []
    for trace in trace_rollouts(compile_closed_loop(plan, world), SEED, range(3)):
        found = Stage(world, plan, "closed", SEED).discovery(trace)
        truths.append(float(np.nanmax(found.truth)))
        assert np.array_equal(np.isnan(found.truth), np.isnan(world.threat))
        for step, _, _, _, cell in trace.events[trace.events[:, 2] == EventKind.HIT].tolist():
            assert found.truth.ravel()[cell] > 0 and found.when.ravel()[cell] <= step
    assert len(set(truths)) > 1


def test_long_rollouts_on_large_maps_write_grids_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.viewers.messages.GRID_BYTES", 9 * 54 * 10)
    world, plan = small_task()
    (trace,) = trace_rollouts(compile_closed_loop(plan, world), SEED, [3])
    stage = Stage(world, plan, "closed", SEED)
    messages = list(rollout_messages(stage, trace, Clock(0, 1.0)))
    times = [message.time // 10**9 for message in messages if message.topic == "/map/visited"]
    assert 2 <= len(times) <= 12
    assert times[-1] == trace.time
    full = [m for m in messages if m.topic == "/robots/poses"]
    assert len(full) == len(trace.cells)


# The viewer layout: valid, deterministic, naming only topics that are recorded, and showing all of the map.

WORLD = World.create([[0.0, 0.1, np.nan], [0.0, 0.0, 0.3]], cell_size=2.0, origin=(10.0, -5.0, 0.4))


def strings(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [text for key, inner in value.items() for text in [key, *strings(inner)]]
    if isinstance(value, list):
        return [text for inner in value for text in strings(inner)]
    return [value] if isinstance(value, str) else []


def test_the_layout_names_what_is_recorded_and_places_every_panel_once() -> None:
    layout, recorded = json.loads(layout_json(WORLD, 3)), topic_types()
    named = strings(layout)
    topics = {re.split(r"[.\[]", text)[0] for text in named if re.match(r"/[a-z]", text)}
    assert topics <= set(recorded), topics - set(recorded)
    assert {"/map/threat", "/map/obstacles", "/areas", "/robots/markers", "/driven", "/stats", "/events"} <= topics
    plotted = [text for text in named if text.startswith("/stats.")]
    assert {re.split(r"[.\[]", text)[1] for text in plotted} <= set(Stats.DESCRIPTOR.fields_by_name)
    assert [text for text in plotted if "doing" in text] == [f"/stats.doing[{robot}]" for robot in range(3)]
    assert "null" not in layout_json(WORLD, 3)
    placed = [text for text in strings(layout["layout"]) if "!" in text]
    assert sorted(placed) == sorted(layout["configById"]) and len(set(placed)) == len(placed)


@pytest.mark.parametrize("shape", [(3, 40), (40, 3), (1, 1)])
def test_the_map_is_in_view_whichever_way_it_is_turned(shape: tuple[int, int]) -> None:
    world = World.create(np.zeros(shape), cell_size=0.5, origin=(100.0, 7.0, 1.2))
    camera = json.loads(layout_json(world, 1))["configById"]["3D!threat"]["cameraState"]
    corners = world.to_xy(np.arange(shape[0] * shape[1]))
    offset = np.abs(corners - camera["targetOffset"][:2]).max()
    assert offset < camera["distance"] / 2 < 3 * (offset + 0.5)
    assert camera["near"] < camera["distance"] < camera["far"]


def test_the_layout_follows_the_largest_threat_and_the_number_of_robots() -> None:
    def largest(world: World) -> float:
        panels = json.loads(layout_json(world, 1))["configById"]
        return float(panels["3D!threat"]["topics"]["/map/threat"]["maxValue"])

    assert largest(WORLD) == pytest.approx(0.3) and largest(World.create(np.zeros((2, 2)))) > 0
    panel = json.loads(layout_json(WORLD, 500))["configById"]["StateTransitions!doing"]
    assert len(panel["paths"]) == MOST_STATES


def test_same_input_same_bytes_and_written_whole(tmp_path: Path) -> None:
    write_layout(tmp_path / "a.layout.json", WORLD, 4)
    assert (tmp_path / "a.layout.json").read_text() == layout_json(WORLD, 4)
    assert [path.name for path in tmp_path.iterdir()] == ["a.layout.json"]
    with pytest.raises(MapError):
        write_layout(tmp_path / "none" / "a.json", WORLD, 4)


# Which rollout is picked: against sorting all of them.

ROWS = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(0, 4)), min_size=1, max_size=60)


def results(rows: list[tuple[int, int, int]], start: int) -> RolloutResults:
    visited, survived, time = (np.array(column, dtype=np.int32) for column in zip(*rows, strict=True))
    alive = np.zeros(len(rows), dtype=np.int32)
    return RolloutResults(start, visited, survived, time, alive, alive.astype(np.int8))


def picker_of(rows: list[tuple[int, int, int]], cut: int) -> rolling.Picker:
    """All rows, handed over in parts of `cut`."""
    picker = rolling.Picker(5)
    for start in range(0, len(rows), cut):
        picker.add(results(rows[start : start + cut], start))
    return picker


@given(rows=ROWS, cut=st.integers(1, 60), q=st.sampled_from([0.001, 0.05, 0.25, 0.5, 0.9, 0.999]))
def test_a_quantile_is_the_best_of_those_with_that_coverage(
    rows: list[tuple[int, int, int]], cut: int, q: float
) -> None:
    chosen = picker_of(rows, cut).choose(rolling.Pick("quantile", q), 0)
    at = sorted(visited for visited, _, _ in rows)[max(int(np.ceil(q * len(rows) - 1e-9)) - 1, 0)]
    same = [(-survived, time, number) for number, (visited, survived, time) in enumerate(rows) if visited == at]
    assert chosen == min(same)[2]


@given(rows=ROWS, cut=st.integers(1, 60))
def test_worst_and_best(rows: list[tuple[int, int, int]], cut: int) -> None:
    picker = picker_of(rows, cut)
    worst = min((visited, survived, -time, number) for number, (visited, survived, time) in enumerate(rows))
    best = min((-visited, -survived, time, number) for number, (visited, survived, time) in enumerate(rows))
    assert picker.choose(*rolling.parse_picks("worst"), 0) == worst[3]
    assert picker.choose(*rolling.parse_picks("best"), 0) == best[3]


def test_random_is_any_of_them_by_the_seed_alone() -> None:
    rows = [(1, 1, 1)] * 10
    chosen = [picker_of(rows, 3).choose(rolling.Pick("random", None), seed) for seed in range(300)]
    assert chosen == [picker_of(rows, 7).choose(rolling.Pick("random", None), seed) for seed in range(300)]
    assert set(chosen) == set(range(10))


def test_names() -> None:
    picks = rolling.parse_picks("worst,median,best,random,quantile:0.05,quantile:.9")
    assert [pick.q for pick in picks] == [0.0, 0.5, 1.0, None, 0.05, 0.9]
    assert len(rolling.parse_picks("best,best")) == 1


def test_ids() -> None:
    assert rolling.parse_ids("0,5,7-9,8", 10) == (0, 5, 7, 8, 9)
    assert rolling.parse_ids("4294967295", 10) == (2**32 - 1,)


NO_PICKS = "|Best|quantile|quantile:|quantile:0|quantile:1|quantile:1.5|quantile:-.5|best,|quantile:nan|quantile:1e-3"
NO_IDS = "|a|-1|5-3|1,|1.5|4294967296|0-10|0-99999999999|٣"


@pytest.mark.parametrize(
    ("name", "text"), [*product(["pick"], NO_PICKS.split("|")), *product(["ids"], NO_IDS.split("|"))]
)
def test_wrong_names_and_ids_are_refused(name: str, text: str) -> None:
    with pytest.raises(UsageError, match=rf"^{name} "):
        rolling.parse_picks(text) if name == "pick" else rolling.parse_ids(text, 10)
