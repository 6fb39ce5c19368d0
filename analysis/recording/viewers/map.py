"""What viewers draw of the map: threats, obstacles, visits, areas with their owners, and what robots learn of it.

In two forms: foxglove.Grid for Foxglove and Lichtblick; nav_msgs/OccupancyGrid and foxglove.VoxelGrid, of which each
voxel is a coloured plate, for Rerun. In all of them row 0 of the message is the lowest y. Axis letters: `N = H * W`
cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from numpy.typing import NDArray

from analysis.recording.frames import AreaMap, Held
from analysis.recording.viewers import colours
from analysis.recording.viewers.ros import FRAME, Place, occupancy_grid
from planner.none import NO_AREA, NO_ROBOT, NO_STEP
from planner.worlds.ros_map import FULL, NO_VALUE
from planner.worlds.world import World

RGBA = np.dtype([(colour, "u1") for colour in ("red", "green", "blue", "alpha")])
TRUTH, FOG = (np.dtype([(value, "<f4"), *RGBA.descr]) for value in ("threat", "seen_at"))
_KINDS = {"u1": PackedElementField.UINT8, "u2": PackedElementField.UINT16, "f4": PackedElementField.FLOAT32}
HEIGHTS = {
    "threat": 0.0, "truth": 0.0, "areas": 0.02, "voxels": 0.02, "visited": 0.04, "obstacles": 0.06, "fog": 0.08,
}  # fmt: skip
"""Height above the ground of each layer, in cells, so that they do not fight for the same pixels."""
DARK = (15, 70)
VOXEL_HEIGHT = 0.1
OPAQUE = 255
MOST_COUNTED = 255
FAINT, PALE, SOLID = 20, 70, 200
"""Alpha of cells not visited yet, in nobody's area and in somebody's, and visited."""


class MapDrawer:
    """Draws one world in one rollout. What changes is kept as the messages want it, lowest row first."""

    def __init__(self, world: World, accessible: NDArray[np.bool_]) -> None:
        """`accessible`: bool `[H, W]`."""
        self.world, self._threat = world, world.threat if world.phases is None else world.met
        self._unknown = world.free & ~accessible
        self._grids = {
            "threat": _grid(self.place("threat"), world, np.dtype([("threat", "<f4")])),
            "obstacles": _grid(self.place("obstacles"), world, RGBA),
            "truth": _grid(self.place("truth"), world, TRUTH),
            "fog": _grid(self.place("fog"), world, FOG),
            "visited": _grid(self.place("visited"), world, np.dtype([("visited", "u1")])),
            "areas": _grid(self.place("areas"), world, RGBA),
        }
        cells = np.arange(world.threat.size).reshape(world.shape)
        self._at = np.flipud(cells).reshape(-1)  # its own inverse: the place of each cell in a message
        self._counts = np.zeros(world.threat.size, dtype=np.uint8)
        self._rgba = np.zeros((world.threat.size, 4), dtype=np.uint8)
        self._plates = np.zeros((world.threat.size, 4), dtype=np.uint8)
        self._voxels = voxel_grid(self.place("voxels"), world.shape, VOXEL_HEIGHT)
        self.changed = False
        self._first = np.full(world.threat.size, NO_ROBOT, dtype=np.int32)  # of the first visit

    def enter(self, cells: NDArray[np.int32]) -> None:
        """Robots enter these cells, one after the other."""
        for place in self._at[cells].tolist():
            self._counts[place] = min(int(self._counts[place]) + 1, MOST_COUNTED)

    def first_visit(self, cells: NDArray[np.int32], robots: NDArray[np.int32]) -> None:
        """These cells are visited for the first time."""
        if not len(cells):
            return
        places, self.changed = self._at[cells], True
        self._first[places] = robots
        self._rgba[places, :3], self._rgba[places, 3] = colours.robots_rgb(robots), SOLID
        self._plates[places, :3], self._plates[places, 3] = colours.robots_rgb(robots), OPAQUE

    def hold(self, areas: AreaMap) -> None:
        """Who holds what from now on."""
        self.changed = True
        unseen = self._first == NO_ROBOT
        at = self._at[unseen]
        owned, inside = areas.held[at] != Held.UNASSIGNED, areas.area[at] != NO_AREA
        rgb = np.where(owned[:, None], colours.robots_rgb(areas.robot[at]), np.array(colours.OPEN_AREA, dtype=np.uint8))
        self._rgba[unseen, :3], self._rgba[unseen, 3] = rgb, np.where(inside, np.where(owned, PALE, FAINT), 0)
        self._plates[unseen, :3], self._plates[unseen, 3] = colours.pale(rgb), np.where(inside & owned, OPAQUE, 0)

    def believe(self, threat: NDArray[np.float32], seen: NDArray[np.bool_]) -> None:
        """From now on this is the map, float32 `[H, W]`, NaN = obstacle, and these cells of it are known."""
        self._threat, self._unknown = threat, ~seen

    def change(self, threat: NDArray[np.float32]) -> None:
        """From now on these are the threats, float32 `[H, W]`, NaN = obstacle."""
        self._threat = threat

    def place(self, layer: str) -> Place:
        """Where a layer lies."""
        x, y, yaw = self.world.origin
        return Place(x, y, HEIGHTS[layer] * self.world.cell_size, yaw, self.world.cell_size)

    def threat(self, time: int) -> Any:
        """foxglove.Grid, one float32 `threat`, 0 at obstacles."""
        return self._send("threat", time, np.flipud(np.nan_to_num(self._threat, nan=0.0)).astype("<f4"))

    def threat_occupancy(self, time: int) -> bytes:
        """OccupancyGrid: safe cells 0, dangerous ones 15 to 70 for the map's largest threat, obstacles 100, cells that
        nobody reaches, or that robots have not seen, -1."""
        threat = np.nan_to_num(self._threat, nan=0.0).astype(np.float64)
        shade = np.where(threat > 0, np.round(DARK[0] + (DARK[1] - DARK[0]) * threat / max(threat.max(), 1e-9)), 0)
        shade[np.isnan(self._threat)] = FULL
        shade[self._unknown] = NO_VALUE
        return occupancy_grid(time, self.place("threat"), np.flipud(shade).astype(np.int8))

    def obstacles(self, time: int) -> Any:
        """foxglove.Grid, red green blue alpha; alpha 0 where free."""
        rgba = np.zeros((*self.world.shape, 4), dtype=np.uint8)
        rgba[np.isnan(self._threat)] = colours.OBSTACLE
        return self._send("obstacles", time, np.flipud(rgba))

    def truth(self, time: int, threat: NDArray[np.float32]) -> Any:
        """foxglove.Grid, float32 `threat` `[H, W]`, 0 at obstacles, red green blue alpha: what robots meet."""
        cells, known = np.zeros(threat.shape, dtype=TRUTH), np.nan_to_num(threat, nan=0.0)
        cells["threat"] = known
        share = known[..., None] / max(float(known.max()), 1e-9)
        low, high = (np.array(rgb) for rgb in colours.THREAT)
        rgb = np.where(np.isnan(threat)[..., None], colours.OBSTACLE[:3], np.round(low + (high - low) * share))
        _paint(cells, rgb, OPAQUE)
        return self._send("truth", time, np.flipud(cells))

    def fog(self, time: int, when: NDArray[np.int32]) -> Any:
        """foxglove.Grid, float32 `seen_at` (steps; -1: not yet), red green blue alpha; alpha 0 where it was seen.

        `when`: int32 `[H, W]`, the step at which each cell is first seen.
        """
        cells = np.zeros(when.shape, dtype=FOG)
        cells["seen_at"] = np.where(self._unknown, NO_STEP, when)
        _paint(cells, np.array(colours.FOG[:3]), np.where(self._unknown, colours.FOG[3], 0))
        return self._send("fog", time, np.flipud(cells))

    def visited(self, time: int) -> Any:
        """foxglove.Grid, one uint8 `visited`: entries of each cell so far, at most 255."""
        return self._send("visited", time, self._counts)

    def areas(self, time: int) -> Any:
        """foxglove.Grid, red green blue alpha: visited cells in the solid colour of their first visitor, others in the
        pale colour of their area's owner, grey where it has none."""
        return self._send("areas", time, self._rgba)

    def areas_voxels(self, time: int) -> Any:
        """foxglove.VoxelGrid: the same as plates; none where an area has no owner."""
        self._voxels.timestamp.FromNanoseconds(time)
        self._voxels.data = self._plates.tobytes()
        return self._voxels

    def _send(self, layer: str, time: int, values: NDArray) -> Any:
        """A foxglove.Grid of values in the message's order."""
        grid = self._grids[layer]
        grid.timestamp.FromNanoseconds(time)
        grid.data = values.tobytes()
        return grid


def _paint(cells: NDArray, rgb: NDArray, alpha: NDArray | int) -> None:
    """Colours of cells `[H, W]`; `rgb` `[..., 3]`."""
    for name, value in zip(("red", "green", "blue"), np.moveaxis(rgb, -1, 0), strict=True):
        cells[name] = value
    cells["alpha"] = alpha


def _grid(place: Place, world: World, fields: np.dtype) -> Any:
    """A foxglove.Grid without data: where it lies, and its fields one after the other."""
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
    """Where a grid lies, and its fields one after the other."""
    grid.pose.position.x, grid.pose.position.y, grid.pose.position.z = place.x, place.y, place.z
    grid.pose.orientation.z, grid.pose.orientation.w = place.turned
    grid.cell_size.x = grid.cell_size.y = place.cell
    add_fields(grid, fields)
    grid.cell_stride, grid.row_stride = fields.itemsize, fields.itemsize * columns


def add_fields(message: Any, fields: np.dtype) -> None:
    """Tell a message what its packed data hold: the named fields, which viewers know."""
    for name, (kind, offset, *_) in (fields.fields or {}).items():
        if kind.str[1:] in _KINDS:
            message.fields.add(name=name, offset=offset, type=_KINDS[kind.str[1:]])
