"""Maps in ROS 2 logs, written by rosbags and by the mcap library; damaged and hostile ones."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from planner.errors import MapError
from planner.worlds.scenario import load_input

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
        ([("/a", whole), ("/b", whole)], "holds maps on /a, /b; expected one topic, or /map among them"),
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
        with pytest.raises(MapError, match="holds no map"):
            load_input(log(tmp_path / "a.mcap", ("/map", whole), kind=kind, encoding=encoding))
    data = log(tmp_path / "a.mcap", ("/map", whole)).read_bytes()
    rng = np.random.default_rng(3)
    for size in (0, 7, 40, len(data) // 2, len(data) - 9):
        (tmp_path / "a.mcap").write_bytes(data[:size])
        with pytest.raises(MapError, match=r"cannot be read as MCAP|holds no map"):
            load_input(tmp_path / "a.mcap")
    for _ in range(60):  # damage anywhere: an error in one line, or a map
        damaged = bytearray(data)
        damaged[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        (tmp_path / "a.mcap").write_bytes(bytes(damaged))
        try:
            assert load_input(tmp_path / "a.mcap").shape == (3, 4)
        except MapError as error:
            assert "a.mcap" in str(error)
