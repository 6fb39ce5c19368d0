"""ROS 2 messages (CDR, little-endian) that viewers draw with no settings: OccupancyGrid, Path, Float64MultiArray.

Written straight from NumPy: fields are aligned to their size, counted from the end of the 4-byte encapsulation.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from analysis.recording.mcap.container import LogSchema

FRAME = "map"
"""The frame of everything that is drawn: the map's own, in metres, y up."""
_ENCAPSULATION = b"\x00\x01\x00\x00"


def _schema(name: str) -> LogSchema:
    """The schema of a message, whose definition stands beside this file."""
    definition = files("analysis.recording.viewers").joinpath(f"{name.rpartition('/')[2]}.msg")
    return LogSchema(name, "ros2msg", definition.read_bytes(), "cdr")


OCCUPANCY_GRID, PATH = _schema("nav_msgs/msg/OccupancyGrid"), _schema("nav_msgs/msg/Path")
ARRAY = _schema("std_msgs/msg/Float64MultiArray")
_HEADER = struct.Struct("<iII4s")
"""Header: seconds, nanoseconds, length of "map" with its NUL, and itself: 16 bytes."""
_META = struct.Struct("<iIfII4x7dI")
_STAMPED = np.dtype([("header", "V16"), ("pose", "<f8", 7)])


@dataclass(frozen=True)
class Place:
    """Where a grid lies: pose of the lower-left corner of its lower-left cell, in the map's frame.

    Attributes:
        x, y, z: metres. yaw: radians. cell: side of a cell in metres.
    """

    x: float
    y: float
    z: float
    yaw: float
    cell: float

    @property
    def turned(self) -> tuple[float, float]:
        """(z, w) of the quaternion of the yaw."""
        return float(np.sin(self.yaw / 2)), float(np.cos(self.yaw / 2))


def occupancy_grid(nanoseconds: int, place: Place, values: NDArray[np.int8]) -> bytes:
    """nav_msgs/OccupancyGrid of `values` int8 `[H, W]`, the lowest row first: 0..100, -1 unknown."""
    height, width = values.shape
    z, w = place.turned
    meta = _META.pack(0, 0, place.cell, width, height, place.x, place.y, place.z, 0.0, 0.0, z, w, values.size)
    return _ENCAPSULATION + _header(nanoseconds) + meta + values.tobytes()


def path(nanoseconds: int, stamps: NDArray[np.int64], xy: NDArray[np.float64], yaw: NDArray[np.float64]) -> bytes:
    """nav_msgs/Path of poses at `stamps` `[P]` in nanoseconds, positions `[P, 2]` in metres, yaws `[P]` in radians."""
    poses = np.zeros(len(stamps), dtype=_STAMPED)
    seconds, rest = np.divmod(stamps, 10**9)
    headers = np.zeros(len(stamps), dtype=[("sec", "<i4"), ("nanosec", "<u4"), ("size", "<u4"), ("frame", "S4")])
    headers["sec"], headers["nanosec"], headers["size"], headers["frame"] = seconds, rest, 4, FRAME.encode()
    poses["header"] = headers.view("V16")
    poses["pose"][:, :2] = xy
    poses["pose"][:, 5], poses["pose"][:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    body = poses.tobytes()
    # the count leaves the first header at 4 of 8, its doubles need 4 bytes of padding; all later ones lie right
    first = body[:16] + b"\x00" * 4 + body[16:] if len(poses) else b""
    return _ENCAPSULATION + _header(nanoseconds) + struct.pack("<I", len(poses)) + first


def array(*values: float) -> bytes:
    """std_msgs/Float64MultiArray without dimensions: Rerun plots it."""
    return _ENCAPSULATION + struct.pack(f"<III4x{len(values)}d", 0, 0, len(values), *values)


def _header(nanoseconds: int) -> bytes:
    seconds, rest = divmod(nanoseconds, 10**9)
    return _HEADER.pack(seconds, rest, 4, FRAME.encode())
