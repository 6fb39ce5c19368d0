"""Maps in ROS 2 logs, written by rosbags and by the mcap library; damaged and hostile ones."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from analysis.recording.log_reader import recover
from analysis.recording.replay import inspect
from planner.errors import InputError, MapError, ScenarioError
from planner.plan.state_file import read_state
from planner.world.scenario import load_input
from planner.world.world import World

STORE = get_typestore(Stores.ROS2_HUMBLE)
KIND = "nav_msgs/msg/OccupancyGrid"


def grid(
    values: np.ndarray,
    frame: str = "map",
    turn: tuple[float, ...] = (0, 0, 0.5**0.5, 0.5**0.5),
    corner: tuple[float, float] = (-1.5, 2.0),
    size: float = 0.05,
) -> bytes:
    """A serialised OccupancyGrid, its first row at the bottom."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*corner, 0.0), types["geometry_msgs/msg/Quaternion"](*map(float, turn))
    )
    height, width = values.shape
    info = types["nav_msgs/msg/MapMetaData"](stamp, np.float32(size), width, height, pose)
    header = types["std_msgs/msg/Header"](stamp, frame)
    return bytes(STORE.serialize_cdr(types[KIND](header, info, values.astype(np.int8).ravel()), KIND))


def log(path: Path, *messages: tuple[str, bytes], kind: str = KIND, encoding: str = "cdr", **options: Any) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", b"")
        channels = {topic: writer.register_channel(topic, encoding, schema) for topic, _ in messages}
        for time, (topic, data) in enumerate(messages):
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_unpacks_to_more_than_it_claims(tmp_path: Path, compression: CompressionType) -> None:
    values = np.zeros((30, 40))
    data = log(tmp_path / "a.mcap", ("/map", grid(values)), compression=compression).read_bytes()
    assert load_input(tmp_path / "a.mcap").free.all()
    chunk = data.index(b"\x06", 8)  # its opcode; then its length, two times, and how long it is unpacked
    (claimed,) = struct.unpack_from("<Q", data, chunk + 25)
    assert 1200 < claimed < 2000
    for lie in (claimed - 1, 100, 2**40):
        hostile = data[: chunk + 25] + struct.pack("<Q", lie) + data[chunk + 33 :]
        (tmp_path / "a.mcap").write_bytes(hostile)
        with pytest.raises(MapError, match=r"a chunk with a wrong checksum or size|a chunk of 1099511627776 bytes"):
            load_input(tmp_path / "a.mcap")


@pytest.mark.parametrize("frame", ["", "m", "map", "odom", "a_map"])
def test_the_last_map_of_a_log(tmp_path: Path, frame: str) -> None:
    """Strings of all lengths: what follows them is aligned. Row 0 of a message is at the bottom."""
    values = np.array([[0, 25, 26], [-1, 64, 65], [100, 0, 0], [0, 0, 0]])
    path = log(
        tmp_path / "a.mcap", ("/map", grid(np.full((2, 2), 100))), ("/map", grid(values, frame)), ("/local", b"")
    )
    world = load_input(path)
    assert world.free[::-1].tolist() == [[True, True, False], [False] * 3, [False, True, True], [True] * 3]
    assert world.cell_size == 0.05 and world.origin == pytest.approx((-1.5, 2.0, np.pi / 2))


def test_logs_that_are_refused(tmp_path: Path) -> None:
    whole = grid(np.zeros((3, 4)))
    for messages, words in (
        (
            [("/a", whole), ("/b", whole)],
            r"holds several maps: /a \(nav_msgs/msg/OccupancyGrid\), /b \(nav_.*\); expected one, or /map among them; "
            r"choose one in a scenario: `map: {file: ..., topic: ...}`",
        ),
        ([("/map", whole[:-1])], "cut short"),
        ([("/map", whole[:40])], "cut short"),
        ([("/map", b"")], "cut short"),
        ([("/map", whole[:28] + struct.pack("<II", 2**31, 2**31) + whole[36:])], "its map"),
        ([("/map", grid(np.zeros((3, 4)), turn=(0.5, 0.5, 0.5, 0.5)))], "tilted"),
    ):
        with pytest.raises(MapError, match=words) as caught:
            load_input(log(tmp_path / "a.mcap", *messages))
        assert "a.mcap" in str(caught.value)
    for kind, encoding in (("nav_msgs/msg/Path", "cdr"), (KIND, "json")):
        with pytest.raises(MapError, match=f"holds no map, but /map .{kind}"):
            load_input(log(tmp_path / "a.mcap", ("/map", whole), kind=kind, encoding=encoding))
    data = log(tmp_path / "a.mcap", ("/map", whole)).read_bytes()
    rng = np.random.default_rng(3)
    for size in (0, 7, 8, 40, len(data) // 2, len(data) - 9):
        (tmp_path / "a.mcap").write_bytes(data[:size])
        words = r"is empty|cannot be read as MCAP" if size < 8 else r"truncated.*try `mrac-jax recover .*/a\.mcap`"
        with pytest.raises(MapError, match=words):
            load_input(tmp_path / "a.mcap")
    for _ in range(60):  # damage anywhere: an error in one line, or a map
        damaged = bytearray(data)
        damaged[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        (tmp_path / "a.mcap").write_bytes(bytes(damaged))
        try:
            assert load_input(tmp_path / "a.mcap").shape == (3, 4)
        except MapError as error:
            assert "a.mcap" in str(error)


FIRST, LAST = np.zeros((3, 4)), np.zeros((3, 4))
FIRST[0, 0] = LAST[2, 3] = 100  # the bottom left, the top right


def timed(path: Path, *messages: tuple[int, str, np.ndarray], **options: Any) -> Path:
    """A log of grids: (log time, topic, values), in the order of the file."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema(KIND, "ros2msg", b"")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for _, topic, _ in messages}
        for time, topic, values in messages:
            writer.add_message(channels[topic], time, grid(values, turn=(0, 0, 0, 1)), time)
        writer.finish()
    return path


def obstacle(world: World) -> list[list[int]]:
    return np.argwhere(~world.free).tolist()


@pytest.mark.parametrize("chunk", [1, 2**20])
def test_the_latest_map_is_the_latest_by_log_time(tmp_path: Path, chunk: int) -> None:
    """In one chunk or in one each; of equal times the one that comes later in the file."""
    path = tmp_path / "a.mcap"
    assert obstacle(load_input(timed(path, (200, "/map", LAST), (100, "/map", FIRST), chunk_size=chunk))) == [[0, 3]]
    assert obstacle(load_input(timed(path, (100, "/map", LAST), (200, "/map", FIRST), chunk_size=chunk))) == [[2, 0]]
    assert obstacle(load_input(timed(path, (0, "/map", FIRST), (0, "/map", LAST), chunk_size=chunk))) == [[0, 3]]
    assert obstacle(load_input(timed(path, (0, "/map", LAST), (0, "/map", FIRST), use_chunking=False))) == [[2, 0]]


def test_a_topic_of_several_is_chosen_in_a_scenario(tmp_path: Path) -> None:
    timed(tmp_path / "a.mcap", (1, "/map", FIRST), (2, "/costmap", LAST))
    world = load_input(tmp_path / "a.mcap")
    assert obstacle(world) == [[2, 0]]
    assert world.notes[0] == (
        "/map is taken of the maps /costmap (nav_msgs/msg/OccupancyGrid), /map (nav_msgs/msg/OccupancyGrid); choose "
        "one in a scenario: `map: {file: ..., topic: ...}`"
    )
    scenario = tmp_path / "s.yaml"
    for topic, cell in (("/map", [2, 0]), ("/costmap", [0, 3])):
        scenario.write_text(f"map: {{file: a.mcap, topic: {topic}}}\n")
        world = load_input(scenario)
        assert obstacle(world) == [cell] and not any("is taken" in note for note in world.notes)
    scenario.write_text("map: {file: a.mcap, topic: /costmaps}\n")
    with pytest.raises(
        MapError, match=r"a\.mcap: holds no map on /costmaps; expected one of /costmap \(.*mean '/costmap'"
    ):
        load_input(scenario)
    np.save(tmp_path / "w.npy", np.zeros((3, 4)))
    scenario.write_text("map: {file: w.npy, topic: /map}\n")
    with pytest.raises(ScenarioError, match=r"`map.topic` is '/map'; expected none: the map is not in a log"):
        load_input(scenario)


def test_a_topic_that_has_something_else(tmp_path: Path) -> None:
    path = log(tmp_path / "a.mcap", ("/scan", b"x"), kind="sensor_msgs/msg/LaserScan")
    with pytest.raises(
        MapError, match=r"holds no map, but /scan \(sensor_msgs/msg/LaserScan\); expected messages nav_"
    ):
        load_input(path)


def test_a_rosbag2_folder_is_the_logs_in_it(tmp_path: Path) -> None:
    """Split into two files, the latest map in the first by name; as INPUT, in a scenario, and as a state."""
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}\n")
    timed(bag / "bag_0.mcap", (300, "/map", LAST))
    timed(bag / "bag_1.mcap", (200, "/map", FIRST))
    assert obstacle(load_input(bag)) == [[0, 3]]
    (tmp_path / "s.yaml").write_text("map: {file: bag, topic: /map}\n")
    assert obstacle(load_input(tmp_path / "s.yaml")) == [[0, 3]]
    state, _ = read_state(bag, load_input(bag), [[1, 1]])
    assert state.visited.tolist() == [5]  # the start alone: what is occupied is no free cell
    with pytest.raises(InputError, match="it describes a rosbag2: name its folder"):
        load_input(bag / "metadata.yaml")


def test_other_storage_is_named_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "old_0.db3").write_bytes(b"SQLite format 3")
    for path in (tmp_path / "old", tmp_path / "old" / "old_0.db3"):
        with pytest.raises(
            MapError, match=r"not MCAP: old_0\.db3; expected .*; convert it: `ros2 bag convert -i .*old"
        ):
            load_input(path)
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "p_0.mcap.zstd").write_bytes(b"x")
    with pytest.raises(MapError, match=r"unpack it: `unzstd .*/p_0\.mcap\.zstd`"):
        load_input(tmp_path / "packed")
    (tmp_path / "none").mkdir()
    with pytest.raises(MapError, match="is a folder"):
        load_input(tmp_path / "none")


def test_other_storage_beside_mcap_is_not_left_out(tmp_path: Path) -> None:
    """A newer map may be in it; a packed log that lies unpacked beside itself holds nothing more."""
    timed(tmp_path / "x_0.mcap", (100, "/map", LAST))
    for name, fix in (("x_1.mcap.zstd", "unzstd"), ("x_1.db3", "ros2 bag convert"), ("x_0.db3", "ros2 bag convert")):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(MapError, match=rf"not MCAP: {name}; expected .*; .*`{fix}"):
            load_input(tmp_path)
        (tmp_path / name).unlink()
    (tmp_path / "x_0.mcap.zstd").write_bytes(b"x")
    assert obstacle(load_input(tmp_path)) == [[0, 3]]


def test_what_was_recovered_is_read_in_place_of_the_damaged_log(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    timed(bag / "x_0.mcap", (1, "/map", FIRST))
    path = timed(bag / "x_1.mcap", *[(2 + time, "/map", LAST) for time in range(200)], chunk_size=2000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MapError, match="truncated or damaged"):
        load_input(bag)
    recover(path, bag / "x_1.recovered.mcap")
    world, note = load_input(bag), "x_1.recovered.mcap is read in place of x_1.mcap"
    assert obstacle(world) == [[0, 3]] and note in world.notes
    assert f"bag: {note}" in read_state(bag, world, [[1, 1]])[1]
    (bag / "x_1.mcap").unlink()
    world = load_input(bag)
    assert obstacle(world) == [[0, 3]] and note not in world.notes


def test_a_cut_log_names_what_saves_its_maps(tmp_path: Path) -> None:
    """`recover`, which then gives back the map; for messages under no checksums the tool that does without them."""
    messages = [(time, "/map", FIRST) for time in range(200)]
    data = timed(tmp_path / "whole.mcap", *messages, chunk_size=2000).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    for read in (load_input, lambda path: read_state(path, World.create(np.zeros((3, 4))), [[1, 1]]), inspect):
        with pytest.raises(InputError, match=r"truncated or damaged: .*; try `mrac-jax recover .*/cut\.mcap`"):
            read(cut)
    recover(cut, tmp_path / "new.mcap")
    assert obstacle(load_input(tmp_path / "new.mcap")) == [[2, 0]]
    for options in ({"use_chunking": False}, {"enable_crcs": False, "chunk_size": 2000}):
        data = timed(tmp_path / "whole.mcap", *messages, **options).read_bytes()
        cut.write_bytes(data[: len(data) // 2])
        with pytest.raises(MapError, match="are under no checksums: try `mcap recover` of the MCAP command line tools"):
            load_input(cut)
        with pytest.raises(InputError, match=r"holds nothing that can be saved.*try `mcap recover`"):
            recover(cut, tmp_path / "none.mcap")


def test_values_between_the_thresholds_of_a_logged_map_are_counted(tmp_path: Path) -> None:
    values = np.array([[0, 25, 26], [-1, 64, 65]])
    world = load_input(timed(tmp_path / "a.mcap", (0, "/map", values)))
    assert world.notes[:2] == (
        "unknown, since its value is between 25 and 65: 2 pixels", "3 unknown pixels count as obstacles",
    )  # fmt: skip
