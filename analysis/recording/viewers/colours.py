"""Colours of recordings: apart from each other, and bright enough for the dark backgrounds of viewers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_HEX = ("4ea1ff", "ff9f1c", "2ecc96", "d678ff", "ffdd3c", "ff6ea0", "78e6f0", "bed25a")
ROBOTS = np.array([tuple(bytes.fromhex(colour)) for colour in _HEX], dtype=np.uint8)
"""RGB of robot k is row k modulo their number."""
LOST = (255, 64, 64)
MOVER = (226, 38, 77)
"""A threat that moves."""
ALIVE = (255, 255, 255)
"""A live robot's block: its own colour would vanish on the plates of its area."""
OBSTACLE = (128, 134, 144, 255)
FOG = (74, 69, 96, 190)
"""What nobody has seen yet; what is believed of it shines through."""
THREAT = ((42, 47, 55), (255, 59, 48))
"""From no threat to the largest: the colours of the layout's threat map."""
OPEN_AREA = (235, 235, 235)
"""An area that nobody has."""


PALE = 0.35
"""Share of the colour in a pale one on plates, which know no transparency; the rest is white."""


def pale(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """uint8 `[..., 3]`: the same colours mixed with white."""
    return np.round(255 - PALE * (255.0 - rgb)).astype(np.uint8)


def robot_rgb(robot: int) -> tuple[int, int, int]:
    """The colour of a robot, 0..255."""
    red, green, blue = ROBOTS[robot % len(ROBOTS)].tolist()
    return red, green, blue


def robots_rgb(robots: NDArray[np.int32]) -> NDArray[np.uint8]:
    """uint8 `[..., 3]`, the colour of each robot; that of robot 0 where there is none."""
    return ROBOTS[np.maximum(robots, 0) % len(ROBOTS)]
