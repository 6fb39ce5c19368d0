"""The last `nav_msgs/OccupancyGrid` of a ROS 2 log (MCAP) as a map."""

from __future__ import annotations

import math
import mmap
import struct
from pathlib import Path

import numpy as np

from planner.errors import MapError
from planner.files import check_size, foreign_errors
from planner.mcap import MAGIC, Damaged, Descriptions, all_records
from planner.worlds.grid import Frame
from planner.worlds.quantities import CELL_SIZE, COORDINATE, FARTHEST
from planner.worlds.ros_map import FULL, NO_VALUE, RosMap
from planner.worlds.world import MAX_CELLS

SCHEMA, ENCODING, TOPIC = "nav_msgs/msg/OccupancyGrid", "cdr", "/map"
MAX_BYTES = 2**30
"""Largest log that is read."""
OCCUPIED, FREE = 65, 25
"""Values from and up to which a pixel is occupied and free: nav2's map_saver cuts there when it saves such a map."""
LEVEL = 1e-3
"""Largest x and y of a quaternion that still only turns a map about the vertical."""


def read_logged_map(path: Path) -> RosMap:
    """The last grid on `/map`, or on the one topic that has grids; raises MapError.

    Values are cut as nav2's map_saver does: occupied from 65, free up to 25, else unknown.
    """
    check_size(path, MAX_BYTES, MapError, "a log", "cut the map's topic out")
    with foreign_errors("cannot be read as MCAP", path, "a whole log"), path.open("rb") as stream:
        found = _grids(memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)))
    if not found:
        raise MapError("holds no map", source=path, expected=f"messages {SCHEMA} (ROS 2, {ENCODING})")
    if len(found) > 1 and TOPIC not in found:
        topics = ", ".join(sorted(found))[:200]
        raise MapError(f"holds maps on {topics}", source=path, expected=f"one topic, or {TOPIC} among them")
    topic = TOPIC if TOPIC in found else next(iter(found))
    with foreign_errors(f"the map on {topic} is cut short", path, SCHEMA):
        return _decode(found[topic], path)


def _grids(data: memoryview) -> dict[str, bytes]:
    """The last message of every topic with grids."""
    if data[: len(MAGIC)] != MAGIC or data[-len(MAGIC) :] != MAGIC:
        raise Damaged("its first or last bytes are not those of a whole log")
    found: dict[str, bytes] = {}
    for message in Descriptions().messages(all_records(data[len(MAGIC) : -len(MAGIC)])):
        if message.schema and message.schema.name == SCHEMA and message.channel.message_encoding == ENCODING:
            found[message.topic] = message.data
    return found


def _decode(data: bytes, path: Path) -> RosMap:
    """The map in a message (CDR): each value is aligned to its size, from the end of the 4 bytes of the head."""
    order, data = "<" if data[1:2] == b"\x01" else ">", data[4:]
    at = 12 + struct.unpack_from(f"{order}iII", data)[2]  # after the stamp and the name of the frame
    at += -at % 4
    *_, resolution, width, height = struct.unpack_from(f"{order}iIfII", data, at)
    at += 20 + -(at + 20) % 8
    x, y, _, *turn, count = struct.unpack_from(f"{order}7dI", data, at)
    values = np.frombuffer(data, np.int8, count, at + 60)
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
