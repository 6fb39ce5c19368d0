"""ROS map_server maps (a YAML file beside an image), after nav2's rules."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.worlds.grid import FREE, OCCUPIED, UNKNOWN, Frame, Grid
from planner.worlds.images import read_image
from planner.worlds.keys import Key, read_yaml
from planner.worlds.world import CELL_SIZE, FARTHEST, is_cell_size, is_coordinate

REQUIRED = ("image", "resolution", "origin", "occupied_thresh", "free_thresh")
DEFAULTS = {"mode": "trinary", "negate": 0}
"""Keys that a map's YAML file must have, and may have."""
FULL, NO_VALUE = 100, -1
"""Value of an occupied pixel, and of an unknown one."""


@dataclass(frozen=True, eq=False)
class RosMap:
    """A map as map_server publishes it.

    Attributes:
        values: int16 `[H, W]`, row 0 at the top (largest y): 0 free .. 100 occupied, -1 unknown.
        frame: resolution in metres and the pose of the lower-left corner.
        source: the YAML file.
    """

    values: NDArray[np.int16]
    frame: Frame
    source: str

    def grid(self) -> Grid:
        """Its pixels as obstacles (value 100), unknown (-1) and free (all else, as nav2's static layer takes it)."""
        state = np.full(self.values.shape, FREE, dtype=np.uint8)
        state[self.values >= FULL] = OCCUPIED
        state[self.values == NO_VALUE] = UNKNOWN
        return Grid(state, self.frame, self.source)


def read_ros_map(path: Path, top: Key | None = None) -> RosMap:
    """The map that a map_server YAML file describes; keys that map_server does not know are ignored, as it does.

    With brightness b of 0..1 (16 bits as well), p = 1 - b, or b if `negate`. Modes: `trinary` (the default): occupied
    if p >= occupied_thresh, free if p <= free_thresh, else unknown; `scale`: the same, and between the thresholds
    round(100 * (p - free) / (occupied - free)); `raw`: the bytes 0..100 themselves, above unknown, `negate` without
    effect. A pixel that is not opaque is unknown. Raises MapError naming key, value and what was expected.
    """
    top = read_yaml(path, MapError) if top is None else Key(top.value, "", path, MapError)
    keys = top.mapping(REQUIRED, defaults=DEFAULTS, strict=False)
    mode = keys["mode"].choice(("trinary", "scale", "raw"))
    resolution = keys["resolution"].number(f"{CELL_SIZE}, a pixel", is_cell_size)
    x, y, yaw = keys["origin"].numbers(f"three numbers [x, y, yaw], none beyond {FARTHEST:g}", is_coordinate, count=3)
    occupied = keys["occupied_thresh"].number("a number above 0, at most 1", lambda value: 0 < value <= 1)
    free = keys["free_thresh"].number(
        f"a number from 0 to below occupied_thresh ({occupied:g})", lambda value: 0 <= value < occupied
    )
    negate = _flag(keys["negate"])
    bright, opaque = read_image(keys["image"].file("the map's image"))
    values = _values(mode, bright, negate, occupied, free)
    values[~opaque] = NO_VALUE
    height, width = values.shape
    return RosMap(values, Frame((height, width), resolution, (x, y, math.remainder(yaw, 2 * math.pi))), str(path))


def _values(mode: str, bright: NDArray[np.float64], negate: bool, occupied: float, free: float) -> NDArray[np.int16]:
    if mode == "raw":
        raw = np.rint(bright * 255)
        return np.where(raw <= FULL, raw, NO_VALUE).astype(np.int16)
    p = bright if negate else 1 - bright
    between = np.rint((p - free) / (occupied - free) * FULL) if mode == "scale" else np.full(p.shape, NO_VALUE)
    return np.where(p >= occupied, FULL, np.where(p <= free, 0, between)).astype(np.int16)


def _flag(key: Key) -> bool:
    if key.value not in (0, 1):
        raise key.wrong("0 or 1")
    return bool(key.value)


def image_grid(path: Path) -> Grid:
    """A plain picture as a map, one metre a pixel: dark is an obstacle.

    It is read as a trinary map with map_server's usual thresholds (0.65 and 0.25): p = 1 - brightness >= 0.65 is an
    obstacle, p <= 0.25 free, between (and where it is transparent) unknown.
    """
    bright, opaque = read_image(path)
    values = _values("trinary", bright, False, 0.65, 0.25)
    values[~opaque] = NO_VALUE
    height, width = values.shape
    return RosMap(values, Frame((height, width), 1.0), str(path)).grid()
