"""What viewers draw of threats that move: a red cube each, and a point for those that draw no markers.

Axis letters: `T` = time + 1 steps, `M` movers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from analysis.recording.viewers import colours
from analysis.recording.viewers.map import RGBA, add_fields
from analysis.recording.viewers.ros import FRAME
from planner.worlds.world import World

_POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), *RGBA.descr])
HEIGHT, SIDE = 0.5, 0.7
"""Above the ground, and of a cube, in cells."""


class MoverDrawer:
    """Draws the movers of one rollout."""

    def __init__(self, world: World, ways: NDArray[np.int64]) -> None:
        """`ways` `[T, M]`: the cell of each at the end of each step; none: nothing is drawn."""
        self._xy, self._scene = world.to_xy(ways), SceneUpdate()
        self._cloud = PointCloud(frame_id=FRAME, point_stride=_POINT.itemsize)
        self._cloud.pose.orientation.w = 1.0
        self._cloud.pose.position.SetInParent()
        add_fields(self._cloud, _POINT)
        self._points = np.zeros(ways.shape[1], dtype=_POINT)
        self._points["z"], self._points["alpha"] = HEIGHT * world.cell_size, 255
        self._points["red"], self._points["green"], self._points["blue"] = colours.MOVER
        for number in range(ways.shape[1]):
            cube = self._scene.entities.add(frame_id=FRAME, id=f"mover {number}").cubes.add()
            cube.pose.orientation.w, cube.pose.position.z = 1.0, HEIGHT * world.cell_size
            cube.size.x = cube.size.y = cube.size.z = SIDE * world.cell_size
            cube.color.r, cube.color.g, cube.color.b = (part / 255 for part in colours.MOVER)
            cube.color.a = 1.0

    def messages(self, time: int, step: int) -> Iterator[tuple[str, Any]]:
        """(topic, message) of all of them."""
        if not len(self._points):
            return
        for entity, (x, y) in zip(self._scene.entities, self._xy[step].tolist(), strict=True):
            place = entity.cubes[0].pose.position
            place.x, place.y = x, y
            entity.timestamp.FromNanoseconds(time)
        self._points["x"], self._points["y"] = self._xy[step].T
        self._cloud.data = self._points.tobytes()
        self._cloud.timestamp.FromNanoseconds(time)
        yield "/movers/markers", self._scene
        yield "/movers/points", self._cloud
