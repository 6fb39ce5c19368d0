"""The latest `nav_msgs/OccupancyGrid` of a ROS 2 log (MCAP, or a rosbag2 folder of it) as a map."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from planner.arguments import did_you_mean
from planner.errors import MapError
from planner.files import check_size, foreign_errors, why_no_file
from planner.mcap import MAGIC, Damaged, Descriptions, all_records, mapped, refusal
from planner.shown import counted
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
RECOVERED = ".recovered.mcap"
"""End of the name that `recover` gives what it saved of a log."""
MOST_LISTED, MOST_TOPICS = 12, 1000
"""Topics that an error lists, and that are kept for it."""
OTHER_STORAGE = {
    ".db3": "convert it: `ros2 bag convert -i {bag} -o out.yaml`, where out.yaml holds "
    "`output_bags: [{{uri: out, storage_id: mcap, all: true}}]`",
    ".zstd": "unpack it: `unzstd {log}`",
}
"""Ends of the names of logs that are not read, and what makes an MCAP log of one."""


def is_bag(path: Path) -> bool:
    """Whether this is a rosbag2 folder: one that holds logs."""
    return why_no_file(path) == "is a folder" and bool(_logs_in(path))


def _logs_in(folder: Path) -> list[Path]:
    """Files of a rosbag2 folder that hold messages, in the order of their names, whatever their storage."""
    return sorted(one for one in folder.glob("*") if one.name.endswith((".mcap", *OTHER_STORAGE)))


def log_files(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The MCAP file itself, or those of a rosbag2 folder, and notes on those that others stand for.

    Where what `recover` saved of a log lies beside it, that is read in its place; so is the log that a packed one was
    unpacked to. Raises MapError for a log of another storage: the latest map may be in it.
    """
    if not is_bag(path):
        return [path], ()
    logs = {one.name: one for one in _logs_in(path)}
    packed = {f"{name}.zstd" for name in logs}
    other = [one for name, one in logs.items() if one.suffix != ".mcap" and name not in packed]
    if other:
        raise other_storage(path, other[0])
    saved = {name: name.removesuffix(".mcap") + RECOVERED for name in logs}
    notes = tuple(f"{saved[name]} is read in place of {name}" for name in logs if saved[name] in logs)
    return [one for name, one in logs.items() if one.suffix == ".mcap" and saved[name] not in logs], notes


def other_storage(path: Path, log: Path) -> MapError:
    """The error for a log that is no MCAP file; `path`: the same, or its rosbag2 folder."""
    fix = next(fix for end, fix in OTHER_STORAGE.items() if log.name.endswith(end))
    problem = f"is a log that is not MCAP: {log.name}"
    return MapError(problem, source=path, expected="an MCAP log (.mcap)", fix=fix.format(bag=path, log=log))


def read_logged_map(path: Path, topic: str | None = None, choose: str = "") -> RosMap:
    """The latest grid, by log time, of a log or a rosbag2 folder; raises MapError.

    Values are cut as nav2's map_saver does: occupied from 65, free up to 25, else unknown.

    Args:
        path: an MCAP file, or a rosbag2 folder of them.
        topic: of the map; None: `/map`, or the one topic that has grids.
        choose: what the error of a log with several maps says of how to choose one.
    """
    grids: dict[str, tuple[int, bytes]] = {}
    others: dict[str, str] = {}
    files, notes = log_files(path)
    for file in files:
        _add_grids(file, grids, others)
    if not grids:
        problem = f"holds no map, but {_listed(others)}" if others else "holds no map"
        raise MapError(problem, source=path, expected=f"messages {SCHEMA} (ROS 2, {ENCODING})")
    maps = _listed(dict.fromkeys(grids, SCHEMA))
    if topic is None and len(grids) > 1 and TOPIC not in grids:
        raise MapError(f"holds several maps: {maps}", source=path, expected=f"one, or {TOPIC} among them", fix=choose)
    taken = topic or (TOPIC if TOPIC in grids else next(iter(grids)))
    if taken not in grids:
        problem = f"holds no map on {taken}" + (f" ({others[taken]})" if taken in others else "")
        raise MapError(problem, source=path, expected=f"one of {maps}", fix=did_you_mean(taken, grids))
    with foreign_errors(f"the map on {taken} is cut short", path, SCHEMA):
        found = _decode(grids[taken][1], path)
    if topic is None and len(grids) > 1:
        notes += (f"{taken} is taken of the maps {maps}; {choose}".rstrip("; "),)
    return replace(found, notes=(*found.notes, *notes))


def _listed(topics: dict[str, str]) -> str:
    """Topics with their types: "/map (nav_msgs/msg/OccupancyGrid), ..."."""
    said = [f"{topic} ({kind})" for topic, kind in sorted(topics.items())[:MOST_LISTED]]
    more = len(topics) - MOST_LISTED
    return ", ".join(said) + (f" and {more} more" if more > 0 else "")


def _add_grids(path: Path, grids: dict[str, tuple[int, bytes]], others: dict[str, str]) -> None:
    """Add log time and data of the latest grid of each topic of a file, and the types of topics that have none."""
    check_size(path, MAX_BYTES, MapError, "a log", "cut the map's topic out")
    data = mapped(path, MapError)
    if data[: len(MAGIC)] != MAGIC:
        raise MapError("cannot be read as MCAP: its first bytes are not those of one", source=path, expected="a log")
    try:
        if data[-len(MAGIC) :] != MAGIC or len(data) < 2 * len(MAGIC):
            raise Damaged("the end is missing")
        for message in Descriptions().messages(all_records(data[len(MAGIC) : -len(MAGIC)])):
            kind, encoding = message.schema.name if message.schema else "no type", message.channel.message_encoding
            if kind == SCHEMA and encoding == ENCODING:
                if message.log_time >= grids.get(message.topic, (0, b""))[0]:
                    grids[message.topic] = message.log_time, message.data
            elif len(others) < MOST_TOPICS:
                others[message.topic] = kind if encoding == ENCODING else f"{kind}, {encoding}"
    except Damaged as error:
        raise refusal(path, str(error), data, MapError) from error


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
    between = int(((grid > FREE) & (grid < OCCUPIED)).sum())
    notes = (
        (f"unknown, since its value is between {FREE} and {OCCUPIED}: {counted(between, 'pixel')}",) if between else ()
    )
    return RosMap(state, Frame((height, width), size, (x, y, yaw)), str(path), notes=notes)
