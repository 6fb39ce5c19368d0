"""The last `nav_msgs/OccupancyGrid` of a ROS 2 log (MCAP) as a map."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import LOG, LONG_BYTES, foreign_errors
from planner.worlds.grid import Frame
from planner.worlds.quantities import CELL_SIZE, COORDINATE, FARTHEST
from planner.worlds.ros_map import FULL, NO_VALUE, RosMap
from planner.worlds.world import MAX_CELLS

SCHEMA, ENCODING, TOPIC = "nav_msgs/msg/OccupancyGrid", "cdr", "/map"
MAX_BYTES, MAX_CHUNK = 2**30, 2**28
"""Largest log that is read, and largest part of one once it is unpacked."""
OCCUPIED, FREE = 65, 25
"""Values from and up to which a pixel is occupied and free: nav2's map_saver cuts there when it saves such a map."""
LEVEL = 1e-3
"""Largest x and y of a quaternion that still only turns a map about the vertical."""


def read_logged_map(path: Path) -> RosMap:
    """The last grid on `/map`, or on the one topic that has grids; raises MapError.

    Values are cut as nav2's map_saver does: occupied from 65, free up to 25, else unknown.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise MapError(f"{size} bytes", source=path, expected=f"at most {MAX_BYTES}", fix="cut the map's topic out")
    if size > LONG_BYTES:
        LOG.warning("reading %s (%.0f MB), which takes a while ...", path, size / 1e6)
    with foreign_errors("cannot be read as MCAP", path, "a whole log"), path.open("rb") as stream:
        found = _grids(stream)
    if not found:
        raise MapError("holds no map", source=path, expected=f"messages {SCHEMA} (ROS 2, {ENCODING})")
    if len(found) > 1 and TOPIC not in found:
        topics = ", ".join(sorted(found))[:200]
        raise MapError(f"holds maps on {topics}", source=path, expected=f"one topic, or {TOPIC} among them")
    topic = TOPIC if TOPIC in found else next(iter(found))
    with foreign_errors(f"the map on {topic} is cut short", path, SCHEMA):
        return _decode(found[topic], path)


def _grids(stream: IO[bytes]) -> dict[str, bytes]:
    """The last message of every topic with grids."""
    from mcap.records import Channel, Message, Schema

    found: dict[str, bytes] = {}
    schemas, topics = set[int](), dict[int, str]()
    for record in _records(stream):
        if isinstance(record, Schema) and record.name == SCHEMA:
            schemas.add(record.id)
        elif isinstance(record, Channel) and record.schema_id in schemas and record.message_encoding == ENCODING:
            topics[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in topics:
            found[topics[record.channel_id]] = record.data
    return found


def _records(stream: IO[bytes]) -> Iterator[Any]:
    """The records of a log, chunks unpacked no further than they claim, and that at most MAX_CHUNK."""
    import lz4.frame
    import zstandard
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader, breakup_chunk

    for record in StreamReader(stream, emit_chunks=True, record_size_limit=MAX_BYTES).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        size = record.uncompressed_size
        data = record.data if size <= MAX_CHUNK else b""
        if record.compression == "zstd" and data:
            data = zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
        elif record.compression == "lz4" and data:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        if len(data) != size:
            raise ValueError(f"a chunk is not the {size} bytes that it claims (at most {MAX_CHUNK})")
        yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)


class _Cdr:
    """Values of a CDR message one after the other, each aligned to its size from the end of the 4 bytes of header."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data[4:], 0
        self.order = "<" if data[1:2] == b"\x01" else ">"

    def take(self, kind: str, count: int = 1) -> tuple[Any, ...]:
        """`count` values of a kind of `struct`."""
        size = struct.calcsize(kind)
        self.at += -self.at % size
        values = struct.unpack_from(f"{self.order}{count}{kind}", self.data, self.at)
        self.at += size * count
        return values

    def text(self) -> str:
        """A string."""
        (length,) = self.take("I")
        self.at += length
        return self.data[self.at - length : self.at].rstrip(b"\0").decode()

    def bytes(self) -> NDArray[np.int8]:
        """A sequence of int8."""
        (length,) = self.take("I")
        if length > len(self.data) - self.at:
            raise struct.error(f"{length} values claimed, {len(self.data) - self.at} bytes left")
        return np.frombuffer(self.data, dtype=np.int8, count=length, offset=self.at)


def _decode(data: bytes, path: Path) -> RosMap:
    message = _Cdr(data)
    message.take("i"), message.take("I"), message.text(), message.take("i"), message.take("I")
    (resolution,), (width, height) = message.take("f"), message.take("I", 2)
    x, y, _, *turn = message.take("d", 7)
    values = message.bytes()
    if not 0 < height * width <= MAX_CELLS or len(values) != height * width:
        problem = f"its map claims {height} x {width} pixels and holds {len(values)}"
        raise MapError(problem, source=path, expected=f"1 to {MAX_CELLS} pixels")
    size = float(f"{resolution:.7g}")  # what was meant by a number of 32 bits
    if not CELL_SIZE.accepts(size) or not all(map(COORDINATE.accepts, (x, y, *turn))):
        problem = f"its map has pixels of {size:g} m from ({x:g}, {y:g})"
        raise MapError(problem, source=path, expected=f"{CELL_SIZE.expected}; an origin, nothing beyond {FARTHEST:g}")
    if max(abs(turn[0]), abs(turn[1])) > LEVEL:
        raise MapError(f"its map is tilted: quaternion {turn}", source=path, expected="a map that lies flat")
    yaw = math.remainder(2 * math.atan2(turn[2], turn[3]), 2 * math.pi)
    grid = values.reshape(height, width)[::-1].astype(np.int16)
    state = np.where(grid >= OCCUPIED, FULL, np.where((grid >= 0) & (grid <= FREE), 0, NO_VALUE)).astype(np.int16)
    return RosMap(state, Frame((height, width), size, (x, y, yaw)), str(path))
