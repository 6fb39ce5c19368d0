"""Makes the example files that are not text: the paper's world and the plan of an office floor, always the same.

python tests/make_examples.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.files import atomic_write
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

PIXELS_PER_METRE = 20
FLOOR = (16.0, 24.0)
"""Height and width of the drawing in metres."""
OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Grey values as map_saver writes them."""
WALL = 0.2
"""Thickness of a wall in metres."""
ROOMS: tuple[tuple[float, float, float, float], ...] = (
    (1, 1, 6, 6), (1, 6, 6, 11), (1, 11, 6, 17), (1, 17, 6, 23), (9, 1, 15, 8), (9, 8, 15, 14), (9, 14, 15, 23),
)  # fmt: skip
"""(top, left, bottom, right) of every room in metres from the upper-left corner; the corridor lies between them."""
DOORS: tuple[tuple[float, float], ...] = ((6, 2.5), (6, 8), (6, 13.5), (6, 19.5), (9, 4), (9, 10.5), (9, 18))
"""(wall's distance from the top, left edge) of the doors on the corridor, each 1.5 m wide, in metres."""
DOOR = 1.5
PASSAGES: tuple[tuple[float, float], ...] = ((3, 17), (12, 8))
"""(top edge, wall's distance from the left) of the doors between two rooms, 1.5 m high, in metres."""
FURNITURE: tuple[tuple[float, float, float, float], ...] = (
    (2.5, 2.5, 3.5, 4.5), (2, 7.5, 2.5, 9.5), (2.5, 13, 4.5, 15), (2, 19, 2.5, 22), (4, 19, 4.5, 22),
    (11, 2.5, 13, 5), (11, 10, 11.5, 12), (13, 10, 13.5, 12), (10.5, 16, 11, 21), (12, 16, 12.5, 21),
    (13.5, 16, 14, 21),
)  # fmt: skip
"""(top, left, bottom, right) of tables and shelves in metres."""


def paper_world() -> World:
    """The paper's setting: 20 x 20, a quarter obstacles, a quarter dangerous in 10 contiguous areas."""
    return random_world(20, 20, ThreatPattern(kind="contiguous", seed=1))


def office_floor() -> NDArray[np.uint8]:
    """Grey values of the floor, uint8 `[320, 480]`, row 0 at the top: rooms on both sides of a corridor."""
    image = np.full([round(side * PIXELS_PER_METRE) for side in FLOOR], UNKNOWN, dtype=np.uint8)

    def fill(top: float, left: float, bottom: float, right: float, grey: int) -> None:
        rows, cols = (slice(*(round(n * PIXELS_PER_METRE) for n in pair)) for pair in ((top, bottom), (left, right)))
        image[rows, cols] = grey

    fill(1, 1, 15 + WALL, 23 + WALL, OCCUPIED)
    fill(6 + WALL, 1 + WALL, 9, 23, FREE)
    for top, left, bottom, right in ROOMS:
        fill(top + WALL, left + WALL, bottom, right, FREE)
    for top, left in DOORS:
        fill(top, left, top + WALL, left + DOOR, FREE)
    for top, left in PASSAGES:
        fill(top, left, top + DOOR, left + WALL, FREE)
    for box in FURNITURE:
        fill(*box, OCCUPIED)
    return image


def main(folder: Path) -> None:
    """Write `paper.npz` and `building_map.pgm` into `folder`."""
    paper_world().save(folder / "paper.npz")
    image = office_floor()
    with atomic_write(folder / "building_map.pgm", "wb") as out:
        out.write(f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode() + image.tobytes())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "analysis" / "examples")
