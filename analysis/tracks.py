"""Tracks of robots: CSV, GPX, GeoJSON lines, MCAP poses and recordings; and the cells that a track enters."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.files import check_size, damage_reported, library_errors, read_json
from planner.plan.state_file import TRACK_STATUS, Track, metres, moment, tracks_of
from planner.simulator.codes import Doing
from planner.world.frame import WGS84
from planner.world.map_files import is_bag, log_files, log_messages
from planner.world.points import read_table
from planner.world.world import World

MOST_BYTES = 2**26
"""Largest file of tracks, logs apart."""
IN_TIME = "a time for each place, in seconds, ISO 8601 or steps"


def read_tracks(path: Path, world: World) -> tuple[tuple[Track, ...], bool]:
    """The tracks in a file, in order of the robots' numbers, or of the file; and whether times are steps.

    Robots are numbered if each name is a number, or holds one after "robot". Several parts of a robot are joined.

    Raises MapError: no tracks, no times, another coordinate reference system.
    """
    suffix = ".mcap" if is_bag(path) else path.suffix.lower()
    if suffix not in READERS:
        raise MapError(f"no tracks are read from {path.suffix!r}", source=path, expected=" ".join(READERS))
    in_steps, parts = READERS[suffix](path, world)
    held: dict[str, list[Track]] = {}
    for part in (part for part in parts if len(part.points)):
        numbered = re.search(r"^\d{1,9}$|(?<=robot)[ _-]?\d{1,9}(?!\d)", part.name, re.IGNORECASE)
        held.setdefault(str(int(numbered[0].lstrip(" _-"))) if numbered else part.name, []).append(part)
    if not held:
        raise MapError("holds no track", source=path, expected="places of robots, with times")
    names = sorted(held, key=int) if all(name.isdecimal() for name in held) else list(held)
    return tuple(_track(name, held[name], world, path) for name in names), in_steps


def _track(name: str, parts: list[Track], world: World, path: Path) -> Track:
    times, places = [], []
    for part in parts:
        if part.times is None:
            fix = "debrief needs their order and gaps; without times, plan the rest with `plan --state`"
            raise MapError(f"robot {name[:40]} has no times", source=path, expected=IN_TIME, fix=fix)
        times += [_seconds(one, name, path) for one in part.times]
        places.append(metres(part.points, part.crs, world, path))
    if not np.isfinite(np.concatenate(places)).all():
        raise MapError(f"robot {name[:40]}: a place is no number", source=path, expected="two finite coordinates")
    order = np.argsort(times, kind="stable")
    status = "dead" if any(part.status == "dead" for part in parts) else "idle"
    return Track(name, np.array(times)[order], np.concatenate(places)[order], "", status)


def _seconds(given: object, name: str, path: Path) -> float:
    """A time as a number: ISO 8601 in seconds, of UTC without a time zone."""
    try:
        if not isinstance(given, str) or re.fullmatch(r"\s*[-+\d.eE]+\s*", given):
            value = float(given)  # type: ignore[arg-type]
        else:
            value = moment(given)
    except (TypeError, ValueError, OverflowError):
        value = np.nan
    if not isfinite(value):
        raise MapError(f"robot {name[:40]}: a time is {str(given)[:40]!r}", source=path, expected=IN_TIME)
    return value


# Readers: whether times are steps, and the parts of tracks.

Found = tuple[bool, list[Track]]


def _csv(path: Path, world: World) -> Found:
    table = read_table(path, "lines robot, time, x, y")
    return table.column("step") is not None, tracks_of(table, world)


def _gpx(path: Path, world: World) -> Found:
    """Every track of a GPX file."""
    check_size(path, MOST_BYTES, MapError, "GPX")
    parts = []
    with library_errors("cannot be read", path, "GPX"):
        data = path.read_bytes()
        # Entities of a document type may expand without end.
        if b"<!DOCTYPE" in data:
            raise MapError("has a document type", source=path, expected="GPX", fix="delete its DOCTYPE")
        for number, track in enumerate(ElementTree.fromstring(data).findall(".//{*}trk")):
            fixes = track.findall(".//{*}trkpt")
            points = np.array([[float(fix.attrib["lon"]), float(fix.attrib["lat"])] for fix in fixes]).reshape(-1, 2)
            times = [fix.findtext("{*}time") for fix in fixes]
            parts.append(
                Track(track.findtext("{*}name") or str(number), None if None in times else times, points, WGS84)
            )
    return False, parts


def _geojson(path: Path, world: World) -> Found:
    """Lines with `coordTimes` or `times`; `robot` or `name` is that of the robot."""
    data, parts = read_json(path, MOST_BYTES, MapError, "GeoJSON"), []
    with library_errors("is no GeoJSON of tracks", path, "a FeatureCollection of lines"):
        named = (data.get("crs") or {}).get("properties", {}).get("name", "")
        crs = named if named and not re.search(r"CRS:?84$|\b4326$", named) else WGS84 if world.georeference else named
        for number, feature in enumerate(data["features"]):
            facts, geometry = feature.get("properties") or {}, feature["geometry"]
            times = facts.get("coordTimes", facts.get("times", (facts.get("coordinateProperties") or {}).get("times")))
            if geometry["type"] != "LineString":
                continue
            points = geometry["coordinates"]
            if times is not None and len(times) != len(points):
                problem = f"features[{number}]: {len(times)} times for {len(points)} places"
                raise MapError(problem, source=path, expected="a time for each place")
            name = str(facts.get("robot", facts.get("name", number)))
            status = TRACK_STATUS.get(str(facts.get("status", "")).lower(), "idle")
            places = np.array([point[:2] for point in points], dtype=np.float64).reshape(-1, 2)
            parts.append(Track(name, times, places, crs, status))
    return False, parts


def _log(path: Path, world: World) -> Found:
    """The rollout of a recording; else each topic with poses or positions of other logs, times by the log."""
    from analysis.recording.contents import read_rollouts

    files, _ = log_files(path)
    held: dict[str, list[tuple[float, float, float]]] = {}
    crs: dict[str, str] = {}
    for file in files:
        # What is read of a message may be damaged too.
        with damage_reported(file, MapError):
            for kind, channel, message in log_messages(file, "cut the poses' topics out"):
                if channel.topic == "/rollout/start":
                    break
                if kind in POSES:
                    crs[channel.topic], decode = POSES[kind]
                    held.setdefault(channel.topic, []).append((message.log_time / 1e9, *decode(message.data)))
            else:
                continue
        recorded = [*zip(read_rollouts(file), range(2), strict=False)]
        if len(recorded) != 1 or recorded[0][0].shape != world.shape:
            problem = f"its {len(recorded) or 'no'} rollouts" if len(recorded) != 1 else "its map has another shape"
            raise MapError(problem, source=path, expected="one rollout on this map, as `record --ids 5` writes it")
        trace = recorded[0][0].trace
        times, places = np.arange(len(trace.cells)).tolist(), world.to_xy(trace.cells)
        status = np.where(trace.doing[-1] == Doing.DEAD, "dead", "idle").tolist()
        return True, [Track(str(one), times, places[:, one], "", word) for one, word in enumerate(status)]
    rows = {topic: np.array(found, dtype=np.float64) for topic, found in held.items()}
    return False, [Track(topic, of[:, 0].tolist(), of[:, 1:], crs[topic]) for topic, of in rows.items()]


def _two_numbers(strings: int, more: int = 0) -> Callable[[bytes], tuple[float, float]]:
    """The decoder of the first two float64 of a CDR message, after a stamp, so many strings, and `more` bytes."""

    def decode(data: bytes) -> tuple[float, float]:
        # Each value is aligned to its size, counted from the end of the 4-byte header.
        order, data, at = "<" if data[1:2] == b"\x01" else ">", data[4:], 8
        for _ in range(strings):
            at += -at % 4
            at += 4 + int(struct.unpack_from(f"{order}I", data, at)[0])
        at += more
        first, second = struct.unpack_from(f"{order}2d", data, at + -at % 8)
        return first, second

    return decode


POSES: dict[str, tuple[str, Callable[[bytes], tuple[float, float]]]] = {
    "geometry_msgs/msg/PoseStamped": ("", _two_numbers(1)),
    "nav_msgs/msg/Odometry": ("", _two_numbers(2)),
    "sensor_msgs/msg/NavSatFix": (WGS84, lambda data: _two_numbers(1, 4)(data)[::-1]),
}
"""ROS 2 messages that hold a place: its CRS, and the decoder of (x, y) or (longitude, latitude)."""
READERS: dict[str, Callable[[Path, World], Found]] = {
    ".csv": _csv, ".gpx": _gpx, ".geojson": _geojson, ".json": _geojson, ".mcap": _log,
}  # fmt: skip


# The cells that a track enters.

FINE = 8
"""Points in which a way of one cell is looked up."""
FAR = 2.0**31
"""Cells from the map's corner beyond which a place is moved there."""
GAP = 5.0
"""Times the usual interval between places after which their way is not known."""


class Walk(NamedTuple):
    """The visits of a track: cells int64 `[n]`, the time of each, gaps in time, and the share of places off the map."""

    cells: NDArray[np.int64]
    times: NDArray[np.float64]
    gaps: int
    off: float


def walk(track: Track, world: World, step: float | None) -> Walk:
    """The cells that a track enters, in order; a cell that it leaves and enters again is there twice.

    Places within half a step are averaged, so that noise makes no visits while a robot stays in its cell. Places are
    joined by straight lines, but not across a gap in time. A line that only cuts a cell's corner does not visit it.

    Args:
        track: the track.
        world: the map.
        step: duration of a step in the unit of its times; None: not known, places are not averaged.

    Raises:
        MapError: no place lies on a free cell.
    """
    times, places = track.times, np.clip(world.places(track.points), -FAR, FAR)
    if step is not None:
        group = np.unique(np.floor((times - times[0]) / (step / 2) + 1e-9), return_inverse=True)[1].reshape(-1)
        count = np.bincount(group)
        places = np.stack([np.bincount(group, places[:, axis]) / count for axis in (0, 1)], axis=1)
        times = np.bincount(group, times) / count
    apart, away = np.diff(times), np.abs(np.diff(places, axis=0)).max(axis=1, initial=0.0)
    # A way longer than the map is none that a robot flew.
    cut = away > max(world.shape)
    if (apart > 0).any():
        cut |= apart > GAP * np.median(apart[apart > 0])
    pieces = np.where(cut, 1, np.maximum(np.ceil(away * FINE), 1)).astype(np.int64)
    # Point i of way j lies at share i / pieces[j] of it, and the last place is a point of its own.
    way = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(way)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[way]
    points = np.concatenate([places[way] + share[:, None] * np.diff(places, axis=0)[way], places[-1:]])
    is_place = np.append(share == 0, True)
    at = np.append(times[way] + share * apart[way], times[-1])
    pixels = np.floor(points).astype(np.int64)
    on = world.frame.holds(pixels)
    cells = np.where(on, pixels[:, 0] * world.shape[1] + pixels[:, 1], -1)
    cells[on & ~world.enterable.ravel()[np.maximum(cells, 0)]] = -1
    begins = np.flatnonzero(np.append(True, np.diff(cells) != 0))
    lengths, real = np.diff(np.append(begins, len(cells))), np.add.reduceat(is_place, begins) > 0
    begins = begins[(cells[begins] >= 0) & (real | (lengths > 1))]
    if not len(begins):
        fix = "check its coordinate reference system: do they belong to this map?"
        raise MapError(f"no place of robot {track.name[:40]} is on a free cell", expected="places on the map", fix=fix)
    begins = begins[np.append(True, np.diff(cells[begins]) != 0)]
    return Walk(cells[begins], at[begins], int((cut & (away > 1)).sum()), float((cells[is_place] < 0).mean()))
