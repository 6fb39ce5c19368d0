"""What viewers draw of the robots: markers with numbers, points, poses, frames, and lines of their paths.

Axis letters: `T` = time + 1 steps, `K` robots, `P` points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from analysis.recording.viewers import colours
from analysis.recording.viewers.map import RGBA, add_fields, voxel_grid
from analysis.recording.viewers.ros import FRAME, Place
from planner.plans.waypoints import headings
from planner.worlds.world import World

_POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), *RGBA.descr, ("robot", "<u2"), ("", "V2")])
HEIGHT, POINT_HEIGHT, PLANNED_HEIGHT, DRIVEN_HEIGHT = 0.35, 1.0, 0.1, 0.2
"""Of robots' balls and points, and of the lines of their paths, above the ground, in cells."""
BALL = 0.04
"""Diameter of a robot's ball, in sides of the map: at least 0.9 cells."""
LABEL_PIXELS = 14.0
VOXEL_AT, VOXEL_HEIGHT = 0.15, 0.8
"""Where a robot's block begins, and how high it is, in cells."""


class RobotDrawer:
    """Draws one team in one rollout.

    Attributes:
        xy: float64 `[T, K, 2]`, metres in the map's frame. yaw: float64 `[T, K]`, heading.
    """

    def __init__(self, world: World, cells: NDArray[np.int32], alive: NDArray[np.bool_]) -> None:
        """`cells`, `alive` `[T, K]`: where each robot is at the end of each step, and whether it lives."""
        self._world, self._cells = world, cells
        self.xy = world.to_xy(cells)
        self.yaw = np.stack([headings(own.astype(np.int64), world) for own in cells.T], axis=1)
        self._alive, self._size = alive, world.cell_size
        self._ball = max(0.9, BALL * max(world.shape)) * world.cell_size
        self._turn = np.stack([np.sin(self.yaw / 2), np.cos(self.yaw / 2)], axis=-1)
        self._frames, self._poses, self._scene = FrameTransforms(), PosesInFrame(frame_id=FRAME), SceneUpdate()
        self._cloud = PointCloud(frame_id=FRAME, point_stride=_POINT.itemsize)
        self._cloud.pose.orientation.w = 1.0
        self._cloud.pose.position.SetInParent()  # the origin, said: Rerun takes a pose without a place for damaged
        add_fields(self._cloud, _POINT)
        self._points = np.zeros(cells.shape[1], dtype=_POINT)
        self._points["robot"], self._points["alpha"] = np.arange(cells.shape[1]), 255
        self._points["z"] = POINT_HEIGHT * self._size
        for robot in range(cells.shape[1]):
            self._frames.transforms.add(parent_frame_id=FRAME, child_frame_id=f"robot_{robot}")
            self._poses.poses.add()
            self._marker(robot)

    def _marker(self, robot: int) -> None:
        entity = self._scene.entities.add(frame_id=FRAME, id=f"robot {robot}")
        ball, text = entity.spheres.add(), entity.texts.add(text=str(robot), billboard=True)
        ball.pose.orientation.w = text.pose.orientation.w = 1.0
        ball.size.x = ball.size.y = ball.size.z = self._ball
        text.font_size, text.scale_invariant = LABEL_PIXELS, True
        for drawn in (ball, text):
            _paint(drawn.color, colours.robot_rgb(robot))
        ball.pose.position.z, text.pose.position.z = HEIGHT * self._size, HEIGHT * self._size + self._ball

    def messages(self, time: int, step: int) -> Iterator[tuple[str, Any]]:
        """(topic, message) of the whole team; steps come one after the other.

        Frames map -> robot_k; poses, number k robot k's; one coloured point a robot, red once it is lost; a ball with
        the robot's number, red and crossed out once it is lost.
        """
        alive = self._alive[step]
        where = zip(self.xy[step].tolist(), self._turn[step].tolist(), strict=True)
        drawn = zip(self._frames.transforms, self._poses.poses, self._scene.entities, where, strict=True)
        for robot, (transform, pose, entity, ((x, y), (z, w))) in enumerate(drawn):
            marks = entity.spheres[0].pose.position, entity.texts[0].pose.position
            for place in (transform.translation, pose.position, *marks):
                place.x, place.y = x, y
            for turn in (transform.rotation, pose.orientation):
                turn.z, turn.w = z, w
            transform.timestamp.FromNanoseconds(time)
            entity.timestamp.FromNanoseconds(time)
            if not alive[robot] and (step == 0 or self._alive[step - 1, robot]):
                self._cross_out(entity)
        points = self._points
        points["x"], points["y"] = self.xy[step].T
        rgb = np.where(
            alive[:, None], colours.robots_rgb(points["robot"].astype(np.int32)), np.array(colours.LOST, dtype=np.uint8)
        )
        points["red"], points["green"], points["blue"] = rgb.T
        self._cloud.data = points.tobytes()
        for message in (self._poses, self._cloud):
            message.timestamp.FromNanoseconds(time)
        yield "/tf", self._frames
        yield "/robots/poses", self._poses
        yield "/robots/points", self._cloud
        yield "/robots/markers", self._scene

    def _cross_out(self, entity: Any) -> None:
        ball, text = entity.spheres[0], entity.texts[0]
        _paint(ball.color, colours.LOST)
        _paint(text.color, colours.LOST)
        text.text = f"× {text.text}"  # noqa: RUF001
        line = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=0.25 * self._ball)
        line.pose.orientation.w = 1.0
        _paint(line.color, (255, 255, 255))
        at, arm = ball.pose.position, 0.4 * self._ball
        for x, y in ((-arm, -arm), (arm, arm), (-arm, arm), (arm, -arm)):
            line.points.add(x=at.x + x, y=at.y + y, z=at.z + 0.6 * self._ball)

    def voxel(self, time: int, step: int, robot: int) -> Any:
        """foxglove.VoxelGrid of one cell: a white block where the robot stands, red once it is lost.

        A grid of its own: Rerun draws one that is opaque all over as solid, above the plates of the areas.
        """
        size, yaw = self._size, self._world.origin[2]
        x, y = self.xy[step, robot].tolist()
        cos, sin = np.cos(yaw) * size / 2, np.sin(yaw) * size / 2
        grid = voxel_grid(Place(x - cos + sin, y - sin - cos, VOXEL_AT * size, yaw, size), (1, 1), VOXEL_HEIGHT)
        grid.timestamp.FromNanoseconds(time)
        grid.data = bytes((*(colours.ALIVE if self._alive[step, robot] else colours.LOST), 255))
        return grid


class PathLines:
    """Every robot's path as a line that grows: foxglove.SceneUpdate."""

    def __init__(self, world: World, robots: int, name: str, height: float, alpha: float, pixels: float) -> None:
        """`name`: of the entities; `height` above the ground in cells; `pixels`: thickness on the screen."""
        self._world, self._z = world, height * world.cell_size
        self._scene, self._length = SceneUpdate(), [0] * robots
        for robot in range(robots):
            entity = self._scene.entities.add(frame_id=FRAME, id=f"{name} {robot}")
            line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=pixels, scale_invariant=True)
            line.pose.orientation.w = 1.0
            _paint(line.color, colours.robot_rgb(robot), alpha)

    def message(self, time: int, paths: Sequence[NDArray[np.int64]]) -> Any:
        """The lines of paths `[P]` (cells), through their corners; each begins with what it was the last time."""
        for robot, (entity, path) in enumerate(zip(self._scene.entities, paths, strict=True)):
            entity.timestamp.FromNanoseconds(time)
            points, begin = entity.lines[0].points, max(self._length[robot] - 1, 0)
            places = self._world.to_xy(path[begin:][corners(path[begin:])]).tolist()
            for x, y in places[1 if self._length[robot] else 0 :]:
                points.add(x=x, y=y, z=self._z)
            self._length[robot] = len(path)
        return self._scene


def corners(path: NDArray[np.int64]) -> NDArray[np.int64]:
    """The entries of a path `[P]` where it begins, turns or ends; waiting left out."""
    entered = np.concatenate([[0], np.flatnonzero(path[1:] != path[:-1]) + 1])
    moves = np.diff(path[entered])
    turned = np.flatnonzero(moves[1:] != moves[:-1]) + 1
    return np.unique(np.concatenate([entered[:1], entered[turned], entered[-1:]]))


def _paint(colour: Any, rgb: tuple[int, int, int], alpha: float = 1.0) -> None:
    colour.r, colour.g, colour.b, colour.a = rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, alpha
