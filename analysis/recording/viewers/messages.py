"""Messages of one rollout, in order of time: the exact data topics, and topics that viewers draw.

They depend only on world, plan, trace and clock, so that a replay compares them byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from analysis.recording import frames as framing
from analysis.recording.viewers import topics
from analysis.recording.viewers.topics import FRAME, Clock, Message, Place, Stage, occupancy_grid
from planner.plan.plan import headings
from planner.rollout_sampling import threat_paths
from planner.simulator.codes import NO_AREA, NO_ROBOT, NO_STEP, Doing
from planner.tally import Trace
from planner.world.grid import OCCUPIED, UNKNOWN
from planner.world.world import World

# Map topics: threats, obstacles, visits, areas with their owners, and the map as robots learn it.
#
# Two forms: foxglove.Grid for Foxglove and Lichtblick; nav_msgs/OccupancyGrid and foxglove.VoxelGrid, with a coloured
# plate for each voxel, for Rerun. In all of them row 0 of the message is the lowest y. Axis letters: `N = H * W` cells.

RGBA = np.dtype([(colour, "u1") for colour in ("red", "green", "blue", "alpha")])
TRUTH, FOG = (np.dtype([(value, "<f4"), *RGBA.descr]) for value in ("threat", "seen_at"))
_KINDS = {"u1": PackedElementField.UINT8, "u2": PackedElementField.UINT16, "f4": PackedElementField.FLOAT32}
LAYERS = {
    "threat": (0.0, np.dtype([("threat", "<f4")])), "truth": (0.0, TRUTH), "areas": (0.02, RGBA),
    "voxels": (0.02, RGBA), "visited": (0.04, np.dtype([("visited", "u1")])), "obstacles": (0.06, RGBA),
    "fog": (0.08, FOG),
}  # fmt: skip
"""Height above the ground of each layer, in cells, so that layers do not hide each other; and its fields."""
DARK = (15, 70)
MAP_VOXEL_HEIGHT = 0.1
OPAQUE = 255
MOST_COUNTED = 255
FAINT, PALE, SOLID = 20, 70, 200
"""Alpha of cells: not visited in an unassigned area, not visited in an assigned area, visited."""


class MapDrawer:
    """Draws one world in one rollout. Changing arrays are kept in message order, lowest row first."""

    def __init__(self, world: World, accessible: NDArray[np.bool_]) -> None:
        """`accessible`: bool `[H, W]`."""
        self.world, self._threat = world, world.threat if world.phases is None else world.met
        self._unknown = world.free & ~accessible
        self._grids = {name: _grid(self.place(name), world, fields) for name, (_, fields) in LAYERS.items()}
        cells = np.arange(world.threat.size).reshape(world.shape)
        self._at = np.flipud(cells).reshape(-1)  # position of each cell in a message; it is its own inverse
        self._counts = np.zeros(world.threat.size, dtype=np.uint8)
        self._rgba = np.zeros((world.threat.size, 4), dtype=np.uint8)
        self._plates = np.zeros((world.threat.size, 4), dtype=np.uint8)
        self._voxels = voxel_grid(self.place("voxels"), world.shape, MAP_VOXEL_HEIGHT)
        self.changed = False
        self._first = np.full(world.threat.size, NO_ROBOT, dtype=np.int32)  # of the first visit

    def enter(self, cells: NDArray[np.int32]) -> None:
        """Count entries of robots into these cells."""
        for place in self._at[cells].tolist():
            self._counts[place] = min(int(self._counts[place]) + 1, MOST_COUNTED)

    def first_visit(self, cells: NDArray[np.int32], robots: NDArray[np.int32]) -> None:
        """Mark these cells as visited, by these robots first."""
        if not len(cells):
            return
        places, self.changed = self._at[cells], True
        self._first[places] = robots
        self._rgba[places, :3], self._rgba[places, 3] = topics.robots_rgb(robots), SOLID
        self._plates[places, :3], self._plates[places, 3] = topics.robots_rgb(robots), OPAQUE

    def hold(self, areas: framing.AreaMap) -> None:
        """Set the areas and their robots."""
        self.changed = True
        unseen = self._first == NO_ROBOT
        at = self._at[unseen]
        owned, inside = areas.held[at] != framing.Held.UNASSIGNED, areas.area[at] != NO_AREA
        rgb = np.where(owned[:, None], topics.robots_rgb(areas.robot[at]), np.array(topics.OPEN_AREA, dtype=np.uint8))
        self._rgba[unseen, :3], self._rgba[unseen, 3] = rgb, np.where(inside, np.where(owned, PALE, FAINT), 0)
        self._plates[unseen, :3], self._plates[unseen, 3] = topics.pale(rgb), np.where(inside & owned, OPAQUE, 0)

    def believe(self, threat: NDArray[np.float32], seen: NDArray[np.bool_]) -> None:
        """Set the team's map, float32 `[H, W]`, NaN = obstacle, and its seen cells."""
        self._threat, self._unknown = threat, ~seen

    def change(self, threat: NDArray[np.float32]) -> None:
        """Set the threats, float32 `[H, W]`, NaN = obstacle."""
        self._threat = threat

    def place(self, layer: str) -> Place:
        """The pose of a layer."""
        x, y, yaw = self.world.origin
        return Place(x, y, LAYERS[layer][0] * self.world.cell_size, yaw, self.world.cell_size)

    def threat(self, time: int) -> Any:
        """foxglove.Grid, one float32 `threat`, 0 at obstacles."""
        return self._send("threat", time, np.flipud(np.nan_to_num(self._threat, nan=0.0)).astype("<f4"))

    def threat_occupancy(self, time: int) -> bytes:
        """OccupancyGrid: safe cells 0, cells with threat 15 to 70 (the map's largest), obstacles 100, cells that are
        inaccessible, or not seen yet, -1."""
        threat = np.nan_to_num(self._threat, nan=0.0).astype(np.float64)
        shade = np.where(threat > 0, np.round(DARK[0] + (DARK[1] - DARK[0]) * threat / max(threat.max(), 1e-9)), 0)
        shade[np.isnan(self._threat)] = OCCUPIED
        shade[self._unknown] = UNKNOWN
        return occupancy_grid(time, self.place("threat"), np.flipud(shade).astype(np.int8))

    def obstacles(self, time: int) -> Any:
        """foxglove.Grid, red green blue alpha; alpha 0 in free cells."""
        rgba = np.zeros((*self.world.shape, 4), dtype=np.uint8)
        rgba[np.isnan(self._threat)] = topics.OBSTACLE
        return self._send("obstacles", time, np.flipud(rgba))

    def truth(self, time: int, threat: NDArray[np.float32]) -> Any:
        """foxglove.Grid of the true map: float32 `threat` `[H, W]`, 0 at obstacles, red green blue alpha."""
        cells, known = np.zeros(threat.shape, dtype=TRUTH), np.nan_to_num(threat, nan=0.0)
        cells["threat"] = known
        share = known[..., None] / max(float(known.max()), 1e-9)
        low, high = (np.array(rgb) for rgb in topics.THREAT)
        rgb = np.where(np.isnan(threat)[..., None], topics.OBSTACLE[:3], np.round(low + (high - low) * share))
        _map_paint(cells, rgb, OPAQUE)
        return self._send("truth", time, np.flipud(cells))

    def fog(self, time: int, when: NDArray[np.int32]) -> Any:
        """foxglove.Grid, float32 `seen_at` (steps; -1: not yet), red green blue alpha; alpha 0 in seen cells.

        `when`: int32 `[H, W]`, the step at which each cell is first seen.
        """
        cells = np.zeros(when.shape, dtype=FOG)
        cells["seen_at"] = np.where(self._unknown, NO_STEP, when)
        _map_paint(cells, np.array(topics.FOG[:3]), np.where(self._unknown, topics.FOG[3], 0))
        return self._send("fog", time, np.flipud(cells))

    def visited(self, time: int) -> Any:
        """foxglove.Grid, one uint8 `visited`: entries of each cell so far, at most 255."""
        return self._send("visited", time, self._counts)

    def areas(self, time: int) -> Any:
        """foxglove.Grid, red green blue alpha: visited cells in the solid colour of their first visitor, others in the
        pale colour of the robot that holds their area, grey if there is none."""
        return self._send("areas", time, self._rgba)

    def areas_voxels(self, time: int) -> Any:
        """foxglove.VoxelGrid: `areas` as plates; none in areas without a robot."""
        self._voxels.timestamp.FromNanoseconds(time)
        self._voxels.data = self._plates.tobytes()
        return self._voxels

    def _send(self, layer: str, time: int, values: NDArray) -> Any:
        """A foxglove.Grid with values in message order."""
        grid = self._grids[layer]
        grid.timestamp.FromNanoseconds(time)
        grid.data = values.tobytes()
        return grid


def _map_paint(cells: NDArray, rgb: NDArray, alpha: NDArray | int) -> None:
    """Set the colours of cells `[H, W]`; `rgb` `[..., 3]`."""
    for name, value in zip(("red", "green", "blue"), np.moveaxis(rgb, -1, 0), strict=True):
        cells[name] = value
    cells["alpha"] = alpha


def _grid(place: Place, world: World, fields: np.dtype) -> Any:
    """A foxglove.Grid without data: pose, and packed fields."""
    grid = Grid(frame_id=FRAME, column_count=world.shape[1])
    _lay(grid, place, fields, world.shape[1])
    return grid


def voxel_grid(place: Place, shape: tuple[int, int], height: float) -> Any:
    """A foxglove.VoxelGrid of one slice, red green blue alpha, without data; `height` of the voxels in cells."""
    grid = VoxelGrid(frame_id=FRAME, row_count=shape[0], column_count=shape[1])
    _lay(grid, place, RGBA, shape[1])
    grid.cell_size.z, grid.slice_stride = height * place.cell, grid.row_stride * shape[0]
    return grid


def _lay(grid: Any, place: Place, fields: np.dtype, columns: int) -> None:
    """Set the pose of a grid, and its packed fields."""
    grid.pose.position.x, grid.pose.position.y, grid.pose.position.z = place.x, place.y, place.z
    grid.pose.orientation.z, grid.pose.orientation.w = place.turned
    grid.cell_size.x = grid.cell_size.y = place.cell
    add_fields(grid, fields)
    grid.cell_stride, grid.row_stride = fields.itemsize, fields.itemsize * columns


def add_fields(message: Any, fields: np.dtype) -> None:
    """Describe the packed data of a message by fields that viewers know."""
    for name, (kind, offset, *_) in (fields.fields or {}).items():
        if kind.str[1:] in _KINDS:
            message.fields.add(name=name, offset=offset, type=_KINDS[kind.str[1:]])


def stamp(time: int) -> Timestamp:
    """A time in nanoseconds."""
    made = Timestamp()
    made.FromNanoseconds(time)
    return made


def pose(x: float, y: float, height: float, z: float = 0.0, w: float = 1.0) -> Pose:
    """The pose at a place, in metres; `z, w`: of the quaternion."""
    return Pose(position=Vector3(x=x, y=y, z=height), orientation=Quaternion(z=z, w=w))


def colour(rgb: tuple[int, int, int], alpha: float = 1.0) -> Color:
    """The colour of 0..255 each."""
    return Color(r=rgb[0] / 255, g=rgb[1] / 255, b=rgb[2] / 255, a=alpha)


def _cloud(fields: np.dtype, count: int) -> tuple[Any, NDArray]:
    """A foxglove.PointCloud without data, and the array of its points."""
    cloud = PointCloud(frame_id=FRAME, point_stride=fields.itemsize)
    cloud.pose.orientation.w = 1.0
    cloud.pose.position.SetInParent()  # set the origin explicitly: Rerun rejects a pose without a position
    add_fields(cloud, fields)
    return cloud, np.zeros(count, dtype=fields)


# Topics of moving threats: a red cube each, and a point for viewers without markers.
#
# Axis letters: `T` = time + 1 steps, `M` moving threats.

_THREAT_POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), *RGBA.descr])
THREAT_HEIGHT, SIDE = 0.5, 0.7
"""Height above the ground, and side of a cube, in cells."""


class MovingThreatDrawer:
    """Draws the moving threats of one rollout."""

    def __init__(self, world: World, ways: NDArray[np.int64]) -> None:
        """`ways` `[T, M]`: the cell of each threat at the end of each step; nothing is drawn if M is 0."""
        self._xy, self._z, self._side = world.to_xy(ways), THREAT_HEIGHT * world.cell_size, SIDE * world.cell_size
        self._cloud, self._points = _cloud(_THREAT_POINT, ways.shape[1])
        self._points["z"], self._points["alpha"] = self._z, 255
        self._points["red"], self._points["green"], self._points["blue"] = topics.MOVING_THREAT

    def messages(self, time: int, step: int) -> Iterator[tuple[str, Any]]:
        """(topic, message) of all moving threats."""
        if not len(self._points):
            return
        scene, side = SceneUpdate(), self._side
        for number, (x, y) in enumerate(self._xy[step].tolist()):
            entity = scene.entities.add(timestamp=stamp(time), frame_id=FRAME, id=f"moving threat {number}")
            size = Vector3(x=side, y=side, z=side)
            entity.cubes.add(pose=pose(x, y, self._z), size=size, color=colour(topics.MOVING_THREAT))
        self._points["x"], self._points["y"] = self._xy[step].T
        self._cloud.data = self._points.tobytes()
        self._cloud.timestamp.FromNanoseconds(time)
        yield "/movers/markers", scene
        yield "/movers/points", self._cloud


# Robot topics: numbered markers, points, poses, frames, and lines of their paths.
#
# Axis letters: `T` = time + 1 steps, `K` robots, `P` points.

_ROBOTS_POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), *RGBA.descr, ("robot", "<u2"), ("", "V2")])
ROBOTS_HEIGHT, POINT_HEIGHT, PLANNED_HEIGHT, DRIVEN_HEIGHT = 0.35, 1.0, 0.1, 0.2
"""Height above the ground of robots' balls and points, and of the lines of their paths, in cells."""
BALL = 0.04
"""Diameter of a robot's ball, as a share of the map's longer side; at least 0.9 cells."""
LABEL_PIXELS = 14.0
VOXEL_AT, ROBOTS_VOXEL_HEIGHT = 0.15, 0.8
"""Height at which a robot's block begins, and its height, in cells."""


class RobotDrawer:
    """Draws one team in one rollout.

    Attributes:
        xy: float64 `[T, K, 2]`, metres in the map's frame. yaw: float64 `[T, K]`, heading.
    """

    def __init__(self, world: World, cells: NDArray[np.int32], alive: NDArray[np.bool_]) -> None:
        """`cells`, `alive` `[T, K]`: each robot's cell at the end of each step, and whether it is alive."""
        self._world, self._cells = world, cells
        self.xy = world.to_xy(cells)
        self.yaw = np.stack([headings(own.astype(np.int64), world) for own in cells.T], axis=1)
        self._alive, self._size = alive, world.cell_size
        self._ball = max(0.9, BALL * max(world.shape)) * world.cell_size
        self._turn = np.stack([np.sin(self.yaw / 2), np.cos(self.yaw / 2)], axis=-1)
        self._cloud, self._points = _cloud(_ROBOTS_POINT, cells.shape[1])
        self._points["robot"], self._points["alpha"] = np.arange(cells.shape[1]), 255
        self._points["z"] = POINT_HEIGHT * self._size

    def messages(self, time: int, step: int) -> Iterator[tuple[str, Any]]:
        """(topic, message) of the whole team.

        Frames map -> robot_k; poses by robot; one coloured point for each robot, red if it is lost; a ball with the
        robot's number, red and crossed out if it is lost.
        """
        alive, now = self._alive[step], stamp(time)
        frames, poses, scene = FrameTransforms(), PosesInFrame(frame_id=FRAME, timestamp=now), SceneUpdate()
        where = zip(self.xy[step].tolist(), self._turn[step].tolist(), strict=True)
        for robot, ((x, y), (z, w)) in enumerate(where):
            at = pose(x, y, 0.0, z, w)
            child = f"robot_{robot}"
            place: dict[str, Any] = {"translation": at.position, "rotation": at.orientation}
            frames.transforms.add(timestamp=now, parent_frame_id=FRAME, child_frame_id=child, **place)
            poses.poses.append(at)
            self._mark(
                scene.entities.add(timestamp=now, frame_id=FRAME, id=f"robot {robot}"), robot, x, y, alive[robot]
            )
        points = self._points
        points["x"], points["y"] = self.xy[step].T
        own = topics.robots_rgb(points["robot"].astype(np.int32))
        points["red"], points["green"], points["blue"] = np.where(alive[:, None], own, topics.LOST).T
        self._cloud.data = points.tobytes()
        self._cloud.timestamp.FromNanoseconds(time)
        yield "/tf", frames
        yield "/robots/poses", poses
        yield "/robots/points", self._cloud
        yield "/robots/markers", scene

    def _mark(self, entity: Any, robot: int, x: float, y: float, alive: bool) -> None:
        """A ball with the robot's number; a lost robot is red and crossed out."""
        side, z = self._ball, ROBOTS_HEIGHT * self._size
        text = str(robot) if alive else f"× {robot}"  # noqa: RUF001
        paint = colour(topics.robot_rgb(robot) if alive else topics.LOST)
        entity.spheres.add(pose=pose(x, y, z), size=Vector3(x=side, y=side, z=side), color=paint)
        label: dict[str, Any] = {"font_size": LABEL_PIXELS, "scale_invariant": True, "billboard": True}
        entity.texts.add(pose=pose(x, y, z + side), color=paint, text=text, **label)
        if not alive:
            line = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=0.25 * side, color=colour((255, 255, 255)))
            line.pose.orientation.w, arm = 1.0, 0.4 * side
            for across, up in ((-arm, -arm), (arm, arm), (-arm, arm), (arm, -arm)):
                line.points.add(x=x + across, y=y + up, z=z + 0.6 * side)

    def voxel(self, time: int, step: int, robot: int) -> Any:
        """foxglove.VoxelGrid of one cell: a white block at the robot, red if it is lost.

        A separate grid: Rerun draws a fully opaque grid as solid, above the plates of the areas.
        """
        size, yaw = self._size, self._world.origin[2]
        x, y = self.xy[step, robot].tolist()
        cos, sin = np.cos(yaw) * size / 2, np.sin(yaw) * size / 2
        grid = voxel_grid(Place(x - cos + sin, y - sin - cos, VOXEL_AT * size, yaw, size), (1, 1), ROBOTS_VOXEL_HEIGHT)
        grid.timestamp.FromNanoseconds(time)
        grid.data = bytes((*(topics.ALIVE if self._alive[step, robot] else topics.LOST), 255))
        return grid


class PathLines:
    """Every robot's path as a growing line: foxglove.SceneUpdate."""

    def __init__(self, world: World, robots: int, name: str, height: float, alpha: float, pixels: float) -> None:
        """`name`: of the entities; `height` above the ground in cells; `pixels`: thickness on the screen."""
        self._world, self._z = world, height * world.cell_size
        self._scene, self._length = SceneUpdate(), [0] * robots
        for robot in range(robots):
            entity = self._scene.entities.add(frame_id=FRAME, id=f"{name} {robot}")
            paint = colour(topics.robot_rgb(robot), alpha)
            line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=pixels, scale_invariant=True, color=paint)
            line.pose.orientation.w = 1.0

    def message(self, time: int, paths: Sequence[NDArray[np.int64]]) -> Any:
        """The lines of paths `[P]` (cells), through their corners; each path extends the one of the last call."""
        for robot, (entity, path) in enumerate(zip(self._scene.entities, paths, strict=True)):
            entity.timestamp.FromNanoseconds(time)
            points, begin = entity.lines[0].points, max(self._length[robot] - 1, 0)
            places = self._world.to_xy(path[begin:][corners(path[begin:])]).tolist()
            for x, y in places[1 if self._length[robot] else 0 :]:
                points.add(x=x, y=y, z=self._z)
            self._length[robot] = len(path)
        return self._scene


def corners(path: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of a path `[P]` at which it begins, turns or ends; waiting is skipped."""
    entered = np.concatenate([[0], np.flatnonzero(path[1:] != path[:-1]) + 1])
    moves = np.diff(path[entered])
    turned = np.flatnonzero(moves[1:] != moves[:-1]) + 1
    return np.unique(np.concatenate([entered[:1], entered[turned], entered[-1:]]))


DRIVEN_LOOKS, DRIVEN_PATHS = 40, 4
"""Number of times that the paths so far are written in a rollout, each time in full, so that viewers can seek: as
lines, and as nav_msgs/Path."""
MOST_PATHS = 64
"""Robots with nav_msgs/Path topics."""
MOST_WORDS = 16
"""Robots whose activity is text in `/stats`."""
GRID_BYTES = 2**26
"""Limit of the size of a rollout's grids, before compression; above it, they are written at fewer steps."""


Messages = Iterator[tuple[str, Any]]
"""Topics and messages at one time: a protobuf message, or the bytes of another."""


def rollout_messages(stage: Stage, trace: Trace, clock: Clock) -> Iterator[Message]:
    """All messages of one rollout, in order of time."""
    drawer = RolloutDrawer(stage, trace, clock)
    for step in range(trace.time + 1):
        time = clock.at(step)
        for topic, said in drawer.messages(time, step):
            yield Message(topic, time, said if isinstance(said, bytes) else said.SerializeToString())


class RolloutDrawer:
    """Creates the messages of one rollout."""

    def __init__(self, stage: Stage, trace: Trace, clock: Clock) -> None:
        self.stage, self.trace = stage, trace
        world, state = stage.world, stage.plan.state
        accessible = world.accessible(stage.plan.starts)
        self.accessible = int(accessible.sum())
        self.frames: framing.Frames = framing.make_frames(trace, state)
        self.map = MapDrawer(world, accessible)
        self.robots = RobotDrawer(world, trace.cells, self.frames.alive)
        self.moving = MovingThreatDrawer(world, threat_paths(world, stage.seed, trace.rollout, trace.time + 1))
        self.driven = PathLines(world, trace.cells.shape[1], "driven", DRIVEN_HEIGHT, 1.0, 2.0)
        self.cuts = self.frames.events_by_step()
        self.areas, self.open_areas = stage.area_maps(trace), 0
        self.next_areas = next(self.areas, None)
        self.discovery, self.shown = stage.discovery(trace), NO_STEP
        length = max(trace.time + 1, *(len(robot.path) for robot in stage.plan.robots))
        self.stamps = np.array([clock.at(step) for step in range(length)], dtype=np.int64)
        self.step_seconds = clock.step_seconds
        steps, size = trace.time + 1, (9 if self.discovery is None else 26) * world.threat.size
        self.every = -(-steps * size // GRID_BYTES)
        self.driven_every, self.paths_every = (-(-steps // looks) for looks in (DRIVEN_LOOKS, DRIVEN_PATHS))

    def messages(self, time: int, step: int) -> Messages:
        """All messages of one step; steps must be consecutive."""
        if step == 0:
            yield from self._begin(time)
        if self.next_areas is not None and self.next_areas.step == step:
            self.map.hold(self.next_areas)
            self.open_areas = self.next_areas.open
            self.next_areas = next(self.areas, None)
        phases = self.stage.world.phases
        if phases is not None and (phases.begins[1:] == step).any():
            self.map.change(phases.threats[phases.number_at(step)])
            yield from self._known(time)
        yield from self._data(time, step)
        if self.discovery is not None and self._looks(step, self.every):
            yield from self._discovered(self.discovery, time, step)
        yield from self._map(time, step)
        yield from self._drawn(time, step)
        if step == self.trace.time:
            yield from self._end(time)

    def _begin(self, time: int) -> Messages:
        stage, trace = self.stage, self.trace
        if stage.plan.state is not None:  # in the colour of an additional robot: a state does not store the visitor
            before = stage.plan.state.visited.astype(np.int32)
            self.map.first_visit(before, np.full_like(before, trace.cells.shape[1]))
        height, width = stage.world.shape
        start = topics.Start(rollout=trace.rollout, robots=trace.cells.shape[1], cells=trace.cells[0].tolist())
        start.height, start.width, start.accessible = height, width, self.accessible
        start.loop, start.seed, start.step_seconds = stage.loop, stage.seed, self.step_seconds
        yield "/rollout/start", start
        if self.discovery is None:
            yield from self._known(time)
        else:
            yield "/map/truth", self.map.truth(time, self.discovery.truth)
        paths = [robot.path for robot in stage.plan.robots]
        lines = PathLines(stage.world, len(paths), "plan", PLANNED_HEIGHT, 0.5, 1.0)
        yield "/plans", lines.message(time, paths)
        for number, path in enumerate(paths[:MOST_PATHS]):
            xy, yaw = stage.world.to_xy(path.astype(np.int32)), headings(path.astype(np.int64), stage.world)
            yield f"/robots/{number}/plan", topics.path(time, self.stamps[: len(path)], xy, yaw)

    def _known(self, time: int) -> Messages:
        """The team's map."""
        yield "/map/threat", self.map.threat(time)
        yield "/map/threat_occ", self.map.threat_occupancy(time)
        yield "/map/obstacles", self.map.obstacles(time)

    def _discovered(self, discovery: framing.Discovery, time: int, step: int) -> Messages:
        """The team's map and the unseen cells, if they changed."""
        if step == 0 or ((discovery.when > self.shown) & (discovery.when <= step)).any():
            self.map.believe(discovery.believed(step), discovery.seen(step))
            yield from self._known(time)
            yield "/map/fog", self.map.fog(time, discovery.when)
            self.shown = step

    def _data(self, time: int, step: int) -> Messages:
        """The exact topics of one step, and its events as text."""
        trace, frames = self.trace, self.frames
        state = topics.Step(rollout=trace.rollout, step=step, cells=trace.cells[step].tolist())
        state.doing.extend(trace.doing[step].tolist())
        state.areas.extend(trace.areas[step].tolist())
        state.visited, state.survived = int(frames.visited[step]), int(frames.survived[step])
        state.alive, state.unassigned = int(frames.alive_count[step]), self.open_areas
        yield "/rollout/step", state
        for row in trace.events[self.cuts[step] : self.cuts[step + 1]]:
            _, robot, kind, area, other = row.tolist()
            event = topics.Event(rollout=trace.rollout, step=step, robot=robot, kind=kind, area=area, other=other)
            yield "/rollout/event", event
            line = framing.event_line(row, self.stage.world, self.stage.plan)
            yield "/events", _log(time, line.level, f"robot {robot}", line.text)

    def _map(self, time: int, step: int) -> Messages:
        """Grids of visits and areas."""
        trace, frames = self.trace, self.frames
        entered = trace.cells[step][frames.moved[step]]
        new = np.unique(entered[frames.visited_at[entered] == step])
        self.map.enter(entered)
        self.map.first_visit(new, frames.visited_by[new])
        if self._looks(step, self.every):
            yield "/map/visited", self.map.visited(time)
            if self.stage.areas and self.map.changed:
                yield "/areas", self.map.areas(time)
                yield "/areas_voxels", self.map.areas_voxels(time)
                self.map.changed = False

    def _drawn(self, time: int, step: int) -> Messages:
        """Robots and figures."""
        trace, frames = self.trace, self.frames
        yield from self.robots.messages(time, step)
        yield from self.moving.messages(time, step)
        changed = np.ones(len(trace.cells[0]), dtype=np.bool_)
        if step > 0:
            changed = (trace.cells[step] != trace.cells[step - 1]) | (frames.alive[step] != frames.alive[step - 1])
        for robot in np.flatnonzero(changed[:MOST_PATHS]).tolist():
            yield f"/robots/{robot}/voxel", self.robots.voxel(time, step, robot)
        if self._looks(step, self.driven_every):
            yield "/driven", self.driven.message(time, list(trace.cells[: step + 1].T.astype(np.int64)))
        if self._looks(step, self.paths_every):
            yield from self._paths(time, step)
        covered = (frames.visited[step] / self.accessible, frames.survived[step] / self.accessible)
        yield "/coverage", topics.array(*covered)
        stats = topics.Stats(rollout=trace.rollout, step=step, alive=float(frames.alive_count[step]))
        stats.coverage_visited, stats.coverage_survived = covered
        stats.unassigned_areas = float(self.open_areas)
        stats.doing.extend(Doing(doing).name.lower() for doing in trace.doing[step, :MOST_WORDS].tolist())
        yield "/stats", stats

    def _looks(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.trace.time

    def _paths(self, time: int, step: int) -> Messages:
        """The path of each robot so far."""
        for robot in range(min(self.trace.cells.shape[1], MOST_PATHS)):
            entered = np.flatnonzero(self.frames.moved[: step + 1, robot])
            xy, yaw = self.robots.xy[entered, robot], self.robots.yaw[entered, robot]
            yield f"/robots/{robot}/driven", topics.path(time, self.stamps[entered], xy, yaw)

    def _end(self, time: int) -> Messages:
        trace, frames = self.trace, self.frames
        visited, survived, alive = int(frames.visited[-1]), int(frames.survived[-1]), int(frames.alive_count[-1])
        ended = self.stage.plan.ending(trace.outcome)
        text, level = framing.end_text(trace, ended, visited, survived, self.accessible, alive), Log.INFO
        yield "/events", _log(time, Log.ERROR if ended in framing.ENDS_WITH_ERROR else level, "rollout", text)
        end = topics.End(rollout=trace.rollout, outcome=int(trace.outcome), time=trace.time, visited=visited)
        end.survived, end.alive = survived, alive
        end.area_of.extend(trace.area_of.tolist())
        yield "/rollout/end", end


def _log(time: int, level: int, name: str, text: str) -> Any:
    return Log(timestamp=stamp(time), level=level, message=text, name=name)  # type: ignore[arg-type]
