"""Topics of a recording with their schemas, its clock, and the data that all rollouts of a file share."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from google.protobuf import descriptor_pool, message_factory, text_format
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from analysis.recording.container import LogSchema
from analysis.recording.frames import AreaMap, Discovery, area_maps, discovery_of, learned_maps
from planner.files import Json, atomic_write
from planner.mrac.problem import ready_loop
from planner.plan.plan import Area, Plan
from planner.rollouts.single_run import PythonLoop
from planner.tally import Trace
from planner.world.world import World

# ROS 2 messages (CDR, little-endian) that viewers draw without settings: OccupancyGrid, Path, Float64MultiArray.
#
# They are written directly from NumPy: fields are aligned to their size, counted from the end of the 4-byte
# encapsulation.

FRAME = "map"
"""The frame of all drawings: the map's, in metres, y up."""
_ENCAPSULATION = b"\x00\x01\x00\x00"


def _schema(name: str) -> LogSchema:
    """The schema of a message, from its definition in this folder."""
    definition = files("analysis.recording.viewers").joinpath(f"{name.rpartition('/')[2]}.msg")
    return LogSchema(name, "ros2msg", definition.read_bytes(), "cdr")


OCCUPANCY_GRID, PATH = _schema("nav_msgs/msg/OccupancyGrid"), _schema("nav_msgs/msg/Path")
ARRAY = _schema("std_msgs/msg/Float64MultiArray")
_HEADER = struct.Struct("<iII4s")
"""Header: seconds, nanoseconds, length of "map" with its NUL, and the text: 16 bytes."""
_META = struct.Struct("<iIfII4x7dI")
_STAMPED = np.dtype([("sec", "<i4"), ("nanosec", "<u4"), ("size", "<u4"), ("frame", "S4"), ("pose", "<f8", 7)])


@dataclass(frozen=True)
class Place:
    """Pose of a grid: the lower-left corner of its lower-left cell, in the map's frame.

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
    """nav_msgs/OccupancyGrid of `values` int8 `[H, W]`, lowest row first: 0..100, -1 unknown."""
    height, width = values.shape
    z, w = place.turned
    meta = _META.pack(0, 0, place.cell, width, height, place.x, place.y, place.z, 0.0, 0.0, z, w, values.size)
    return _ENCAPSULATION + _header(nanoseconds) + meta + values.tobytes()


def path(nanoseconds: int, stamps: NDArray[np.int64], xy: NDArray[np.float64], yaw: NDArray[np.float64]) -> bytes:
    """nav_msgs/Path of poses at `stamps` `[P]` in nanoseconds, positions `[P, 2]` in metres, yaws `[P]` in radians."""
    poses = np.zeros(len(stamps), dtype=_STAMPED)
    poses["sec"], poses["nanosec"] = np.divmod(stamps, 10**9)
    poses["size"], poses["frame"] = len(FRAME) + 1, FRAME.encode()
    poses["pose"][:, :2] = xy
    poses["pose"][:, 5], poses["pose"][:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    body = poses.tobytes()
    # after the count, the first header ends at 4 mod 8: its doubles need 4 bytes of padding; later ones are aligned
    first = body[:16] + b"\x00" * 4 + body[16:] if len(poses) else b""
    return _ENCAPSULATION + _header(nanoseconds) + struct.pack("<I", len(poses)) + first


def array(*values: float) -> bytes:
    """std_msgs/Float64MultiArray without dimensions: Rerun plots it."""
    return _ENCAPSULATION + struct.pack(f"<III4x{len(values)}d", 0, 0, len(values), *values)


def _header(nanoseconds: int) -> bytes:
    seconds, rest = divmod(nanoseconds, 10**9)
    return _HEADER.pack(seconds, rest, 4, FRAME.encode())


# The project's own messages: classes of a descriptor in this folder, without a compiler.

_POOL = descriptor_pool.DescriptorPool()
_FILE = files("analysis.recording.viewers").joinpath("mrac.textproto").read_text(encoding="utf-8")
_POOL.Add(text_format.Parse(_FILE, FileDescriptorProto()))
Start, Step, Event, End, Stats, Outcomes = (
    message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"mrac.{name}"))
    for name in ("Start", "Step", "Event", "End", "Stats", "Outcomes")
)


GAP_SECONDS = 3.0
"""Gap between consecutive rollouts in one file."""
_DATA = {"/rollout/start": Start, "/rollout/step": Step, "/rollout/event": Event, "/rollout/end": End}
DATA_TOPICS = tuple(_DATA)
OWN = _DATA | {"/outcomes": Outcomes, "/stats": Stats}
"""The project's own messages by topic."""


def protobuf(message: Any) -> LogSchema:
    """The schema of a protobuf message type."""
    described = build_file_descriptor_set(message).SerializeToString(deterministic=True)
    return LogSchema(message.DESCRIPTOR.full_name, "protobuf", described, "protobuf")


@cache
def topic_types() -> dict[str, LogSchema]:
    """The schema of every topic; topics of single robots are under `/robots/*/`."""
    drawn = {
        Grid: ("/map/threat", "/map/obstacles", "/map/visited", "/map/truth", "/map/fog", "/areas"),
        VoxelGrid: ("/areas_voxels", "/robots/*/voxel"),
        SceneUpdate: ("/movers/markers", "/plans", "/driven", "/robots/markers"),
        PointCloud: ("/movers/points", "/robots/points"),
        PosesInFrame: ("/robots/poses",), FrameTransforms: ("/tf",), Log: ("/events",),
    }  # fmt: skip
    messages = OWN | {topic: message for message, topics in drawn.items() for topic in topics}
    ros = {"/map/threat_occ": OCCUPANCY_GRID, "/coverage": ARRAY, "/robots/*/plan": PATH, "/robots/*/driven": PATH}
    return {topic: protobuf(message) for topic, message in messages.items()} | ros


def type_of(topic: str) -> LogSchema:
    """The schema of a topic. Raises KeyError for an unknown topic."""
    parts = topic.split("/")
    if len(parts) == 4 and parts[1] == "robots":
        parts[2] = "*"
    return topic_types()["/".join(parts)]


class Message(NamedTuple):
    """A message: topic, log time in nanoseconds, encoded data."""

    topic: str
    time: int
    data: bytes


@dataclass(frozen=True)
class Clock:
    """Times of steps: step t of a rollout is at `start + t * step_seconds`. start: nanoseconds."""

    start: int
    step_seconds: float

    def at(self, step: int) -> int:
        """The time of a step in nanoseconds."""
        return self.start + round(step * self.step_seconds * 1e9)

    def after(self, last_step: int) -> Clock:
        """The clock of the rollout after one of this length."""
        return Clock(self.at(last_step) + round(GAP_SECONDS * 1e9), self.step_seconds)


@dataclass(frozen=True, eq=False)
class Stage:
    """Data that all rollouts of a file share.

    Attributes:
        loop: "closed" or "open". seed: of the rollouts. first_only: see `Request`.
        areas: those at t = 0.
    """

    world: World
    plan: Plan
    loop: Literal["closed", "open"]
    seed: int
    first_only: bool = False

    @cached_property
    def areas(self) -> tuple[Area, ...]:
        """Areas at t = 0; in the open loop also those that the nominal run creates later."""
        if self.loop == "closed":
            return ready_loop(self.plan, self.world)[1]
        return self.plan.areas + self.plan.areas_added

    def area_maps(self, trace: Trace) -> Iterator[AreaMap]:
        """The areas at the end of step 0 and of every later step that changes them; empty without areas."""
        if self.loop == "closed" and ready_loop(self.plan, self.world)[0].learns:  # map updates may make new areas
            loop = PythonLoop(self.plan, self.world, first_only=self.first_only)
            return learned_maps(loop.runs(self.seed, trace.rollout))
        return area_maps(trace, self.areas, self.plan.state) if self.areas else iter(())

    def discovery(self, trace: Trace) -> Discovery | None:
        """The team's map knowledge in a rollout; None if it learns nothing."""
        return discovery_of(self.world, self.seed, trace) if self.learns else None

    @property
    def learns(self) -> bool:
        """Whether robots update the map by a sensor; on fixed paths they do not."""
        known = self.world.knowledge
        return self.loop == "closed" and known is not None and known.sensor.range > 0


# Colours of recordings: distinct, and bright enough for the dark backgrounds of viewers.

_HEX = ("4ea1ff", "ff9f1c", "2ecc96", "d678ff", "ffdd3c", "ff6ea0", "78e6f0", "bed25a")
ROBOTS = np.array([tuple(bytes.fromhex(colour)) for colour in _HEX], dtype=np.uint8)
"""RGB of robot k is row k modulo the number of rows."""
LOST = (255, 64, 64)
MOVING_THREAT = (226, 38, 77)
"""A moving threat."""
ALIVE = (255, 255, 255)
"""A live robot's block: its own colour would not stand out on the plates of its area."""
OBSTACLE = (128, 134, 144, 255)
FOG = (74, 69, 96, 190)
"""Unseen cells; the prior map shines through."""
THREAT = ((42, 47, 55), (255, 59, 48))
"""From no threat to the largest: the colours of the layout's threat map."""
OPEN_AREA = (235, 235, 235)
"""An unassigned area."""


PALE = 0.35
"""Share of the colour in a pale one on plates, which have no transparency; the rest is white."""


def pale(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """uint8 `[..., 3]`: the colours mixed with white."""
    return np.round(255 - PALE * (255.0 - rgb)).astype(np.uint8)


def robot_rgb(robot: int) -> tuple[int, int, int]:
    """The colour of a robot, 0..255."""
    red, green, blue = ROBOTS[robot % len(ROBOTS)].tolist()
    return red, green, blue


def robots_rgb(robots: NDArray[np.int32]) -> NDArray[np.uint8]:
    """uint8 `[..., 3]`, the colour of each robot; that of robot 0 where there is none."""
    return ROBOTS[np.maximum(robots, 0) % len(ROBOTS)]


# Layout for Lichtblick and Foxglove, which need one to draw a recording usefully.

MOST_STATES = 16
"""Robots with a line in the panel of activities."""
_MARGIN = 1.12


def layout_json(world: World, robots: int) -> str:
    """The layout for recordings of `robots` robots in `world`, as JSON. Equal input gives equal text.

    Top view: the threat map with the driven paths (for robots that learn the map, the true one), and next to it the
    areas with their owners. Below: activities of up to MOST_STATES robots, coverage, live robots, and events. The parts
    that depend on neither argument are in `layout.json` in this folder, with null for the others.
    """
    layout: Json = json.loads(files("analysis.recording.viewers").joinpath("layout.json").read_text(encoding="utf-8"))
    panels, camera = layout["configById"], _camera(world)
    for name in ("3D!threat", "3D!areas"):
        panels[name]["cameraState"].update(camera)
    largest = max(float(np.nanmax(layer, initial=0.0)) for layer in (world.threat, world.by_phase))
    panels["3D!threat"]["topics"]["/map/threat"]["maxValue"] = max(largest, 1e-6)
    if world.knowledge is not None and world.knowledge.sensor.range > 0:
        _show_truth(layout)
    panels["Plot!alive"]["maxYValue"] = robots
    panels["StateTransitions!doing"]["paths"] = [
        {"value": f"/stats.doing[{robot}]", "label": f"robot {robot}", "timestampMethod": "receiveTime"}
        for robot in range(min(robots, MOST_STATES))
    ]
    return json.dumps(layout, indent=1) + "\n"


def _show_truth(layout: Json) -> None:
    """Add a panel with the true map next to the team's map and its unseen cells, with a common camera."""
    panels, panel = layout["configById"], layout["configById"]["3D!threat"]
    panel["lichtblickPanelTitle"] = "The team's map; dark: not seen yet"
    topics = {name: shown for name, shown in panel["topics"].items() if name not in ("/map/threat", "/map/obstacles")}
    as_painted = {"visible": True, "colorMode": "rgba-fields"}
    panels["3D!truth"] = panel | {
        "lichtblickPanelTitle": "True map, and paths driven",
        "topics": {"/map/truth": as_painted} | topics,
    }
    panel["topics"]["/map/fog"] = as_painted
    maps = layout["layout"]["first"]
    layout["layout"]["first"] = {"direction": "row", "first": "3D!truth", "second": maps, "splitPercentage": 33.3}


def write_layout(path: Path, world: World, robots: int) -> None:
    """Write the layout to `path`, completely or not at all. Raises MapError if the folder does not exist."""
    with atomic_write(path, "w") as out:
        out.write(layout_json(world, robots))


def _camera(world: World) -> Json:
    """Top view at a distance from which the whole map is visible, whatever its yaw."""
    height, width = world.shape
    corners = world.to_xy([0, width - 1, (height - 1) * width, height * width - 1])
    across, up = (np.ptp(corners, axis=0) + world.cell_size).tolist()
    distance = _MARGIN * max(up, across)
    offset = [*corners.mean(axis=0).tolist(), 0]
    return {"distance": distance, "targetOffset": offset, "near": distance / 1000, "far": distance * 10}
