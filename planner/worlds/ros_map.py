"""ROS map_server maps (a YAML file beside an image), after nav2's rules."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers
from planner.errors import MapError
from planner.files import Json
from planner.shown import counted
from planner.worlds.georeference import TURN, Georeference, around
from planner.worlds.grid import FREE, OCCUPIED, UNKNOWN, Frame, Grid
from planner.worlds.images import Picture, read_image
from planner.worlds.keys import Key, read_yaml
from planner.worlds.quantities import CELL_SIZE, COORDINATE, POSE, SHARE

REQUIRED = ("image", "resolution", "origin", "occupied_thresh")
USUAL_FREE = 0.196
"""The `free_thresh` that map_saver writes: taken, with a note, where a file names none."""
DEFAULTS: Json = {"mode": "trinary", "negate": 0, "free_thresh": USUAL_FREE}
OPTIONAL = ("datum",)
"""Keys that a map's YAML file must have, and may have; `datum` is ours: where the map frame's (0, 0) lies."""
FULL, NO_VALUE = 100, -1
"""Value of an occupied pixel, and of an unknown one."""
UNKNOWN_GREYS = {205: "map_saver", 128: "cartographer"}
"""Greys that programs write for unknown ground, of black = occupied."""
LOSSY = 2
"""How far from that grey a pixel of a picture under lossy compression may be."""


@dataclass(frozen=True, eq=False)
class RosMap:
    """A map as map_server publishes it.

    Attributes:
        values: int16 `[H, W]`, row 0 at the top (largest y): 0 free .. 100 occupied, -1 unknown.
        frame: resolution in metres and the pose of the lower-left corner.
        source: the YAML file. mode: of its values.
        notes: what reading did that a user should know.
        georeference: where the frame lies on the Earth, if its `datum` says so.
    """

    values: NDArray[np.int16]
    frame: Frame
    source: str
    mode: str = DEFAULTS["mode"]
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None

    def grid(self) -> Grid:
        """Its pixels as obstacles (value 100), unknown (-1) and free (all else, as nav2's static layer takes it)."""
        state = np.full(self.values.shape, FREE, dtype=np.uint8)
        state[self.values >= FULL] = OCCUPIED
        state[self.values == NO_VALUE] = UNKNOWN
        notes = self.notes
        between = int(((self.values > 0) & (self.values < FULL)).sum())
        if between:
            notes += (
                f"mode: {self.mode} is meant for threats (`layer:` in a scenario): as a map, its {between} pixels "
                "between free and occupied are free and without threat",
            )
        return Grid(state, self.frame, self.source, notes=notes, georeference=self.georeference)


def read_ros_map(path: Path, top: Key | None = None) -> RosMap:
    """The map that a map_server YAML file describes; keys that map_server does not know are ignored, as it does.

    With brightness b of 0..1 (16 bits as well), p = 1 - b, or b if `negate`. Modes: `trinary` (the default): occupied
    if p >= occupied_thresh, free if p <= free_thresh, else unknown; `scale`: the same, and between the thresholds
    round(100 * (p - free) / (occupied - free)); `raw`: the bytes 0..100 themselves, above unknown, `negate` without
    effect. Transparency is read as map_server reads it: `trinary` averages alpha into the brightness as a fourth
    channel, in `scale` a pixel that is not wholly opaque is unknown, in `raw` alpha has no effect. Raises MapError
    naming key, value and what was expected.
    """
    top = read_yaml(path, MapError) if top is None else Key(top.value, "", path, MapError)
    keys = top.mapping(REQUIRED, OPTIONAL, DEFAULTS, strict=False)
    mode = keys["mode"].choice(("trinary", "scale", "raw"))
    resolution = keys["resolution"].number(CELL_SIZE, f"{CELL_SIZE.expected}, a pixel")
    x, y, yaw = keys["origin"].numbers(COORDINATE, POSE, count=3)
    occupied = keys["occupied_thresh"].number(SHARE)
    below = f"a number from 0 to below occupied_thresh ({occupied:g})"
    free = keys["free_thresh"].number(Numbers(0, occupied, below=True, said=below))
    negate = _flag(keys["negate"])
    picture = read_image(keys["image"].file("the map's image"))
    values, notes = _values(mode, picture, negate, occupied, free)
    if mode != "raw" and "free_thresh" not in top.value:
        notes += (f"names no free_thresh: {USUAL_FREE} is taken, as map_saver writes it",)
    height, width = values.shape
    frame = Frame((height, width), resolution, (x, y, math.remainder(yaw, 2 * math.pi)))
    place = read_datum(keys["datum"]) if "datum" in keys else None
    return RosMap(values, frame, str(path), mode, notes, place)


def read_datum(key: Key) -> Georeference:
    """`{latitude, longitude}` of the map frame's (0, 0), in degrees of WGS 84; x points east there, y north."""
    keys = key.mapping(("latitude", "longitude"))
    latitudes, longitudes = Numbers(-89, 89, "degrees"), Numbers(-TURN, TURN, said="degrees, -180 to 180")
    given = [keys[name].value for name in ("latitude", "longitude")]
    if not latitudes.accepts(given[0]) and longitudes.accepts(given[0]) and latitudes.accepts(given[1]):
        raise keys["latitude"].wrong(
            latitudes.expected, "if latitude and longitude stand in the wrong order, swap them"
        )
    return around(keys["latitude"].number(latitudes), keys["longitude"].number(longitudes))


def _values(
    mode: str, picture: Picture, negate: bool, occupied: float, free: float
) -> tuple[NDArray[np.int16], tuple[str, ...]]:
    """`RosMap.values`, and notes on colours, transparency, and unknown ground that is read as something else."""
    notes: list[str] = []
    if mode == "raw":
        raw = np.rint(picture.bright * 255)
        values = np.where(raw <= FULL, raw, NO_VALUE).astype(np.int16)
    else:
        p = picture.bright if negate else 1 - picture.bright
        values = _by_thresholds(mode, p, occupied, free)
        if picture.alpha is not None:
            plain, alpha = values, picture.alpha
            if mode == "trinary":
                bright = (3 * picture.bright + alpha) / 4
                p = bright if negate else 1 - bright
                values = _by_thresholds(mode, p, occupied, free)
                how = "mode: trinary averages alpha into the brightness, as map_server does"
            else:
                values = np.where(alpha < 1, NO_VALUE, plain).astype(np.int16)
                how = "mode: scale takes what is not wholly opaque for unknown, as map_server does"
            notes += _changed(plain, values, how)
        notes += _unknown_greys(mode, picture, values, p, negate)
    readings = {"obstacle": values >= FULL, "free": values == 0, "unknown": values == NO_VALUE}
    readings |= {"in between": (values > 0) & (values < FULL)}
    return values, (*picture.colours(readings), *notes)


def _by_thresholds(mode: str, p: NDArray[np.float64], occupied: float, free: float) -> NDArray[np.int16]:
    """Values of how occupied pixels are, p `[H, W]` in 0..1."""
    between = np.rint((p - free) / (occupied - free) * FULL) if mode == "scale" else np.full(p.shape, NO_VALUE)
    return np.where(p >= occupied, FULL, np.where(p <= free, 0, between)).astype(np.int16)


def _changed(plain: NDArray[np.int16], values: NDArray[np.int16], how: str) -> list[str]:
    """A note on pixels that transparency makes something else; `plain`: values by brightness alone."""
    names = {NO_VALUE: "unknown", 0: "free", FULL: "obstacles"}
    counts = {name: int(((values == value) & (plain != value)).sum()) for value, name in names.items()}
    said = ", ".join(f"{counted(count, 'pixel')} {name} by it" for name, count in counts.items() if count)
    return [f"{how}: {said}"] if said else []


def _unknown_greys(
    mode: str, picture: Picture, values: NDArray[np.int16], p: NDArray[np.float64], negate: bool
) -> list[str]:
    """A note for every grey of unknown ground that the thresholds make free or an obstacle."""
    notes = []
    for unknown, writer in UNKNOWN_GREYS.items():
        grey, off = 255 - unknown if negate else unknown, LOSSY if picture.lossy else 0
        said = f"grey {grey}" + (f" ({grey - off} to {grey + off} under lossy compression)" if off else "")
        for taken, value in (("free", 0), ("an obstacle", FULL)):
            held = (np.abs(picture.grey - grey) <= off) & (values == value)
            if held.any():
                below = math.floor(1000 * p[held].min()) / 1000
                fix = f"free_thresh: {below:g}" if value == 0 else "occupied_thresh: 0.65"
                fix = fix if mode == "trinary" else f"mode: trinary` and `{fix}"  # scale grades what is in between
                notes.append(
                    f"{said}, which {writer} writes for unknown ground, is {taken} in "
                    f"{counted(int(held.sum()), 'pixel')}; with `{fix}` in a map_server YAML file it is unknown"
                )
    return notes


def _flag(key: Key) -> bool:
    if key.value not in (0, 1):
        raise key.wrong("0 or 1")
    return bool(key.value)


def image_grid(path: Path) -> Grid:
    """A plain picture as a map, one metre a pixel: dark is an obstacle.

    It is read as a trinary map with map_server's usual thresholds (0.65 and 0.25): p = 1 - brightness >= 0.65 is an
    obstacle, p <= 0.25 free, between unknown. What is wholly transparent shows nothing, and is unknown.
    """
    picture = read_image(path)
    values, notes = _values("trinary", picture, False, 0.65, 0.25)
    if picture.alpha is not None and (hidden := picture.alpha == 0).any():
        values[hidden] = NO_VALUE
        notes += (f"{counted(int(hidden.sum()), 'pixel')} wholly transparent: unknown",)
    height, width = values.shape
    return replace(RosMap(values, Frame((height, width), 1.0), str(path), notes=notes).grid(), measured=False)
