"""Map images: brightness of each pixel, read safely whatever a header claims; and ROS map_server maps."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from planner.arguments import Numbers
from planner.errors import MapError
from planner.files import Json, check_file, library_errors
from planner.formatting import counted
from planner.world.frame import TURN, Frame, Georeference, around
from planner.world.grid import OCCUPIED, UNKNOWN, Grid
from planner.world.keys import CELL_SIZE, COORDINATE, POSE, SHARE, Key, read_yaml
from planner.world.world import MAX_CELLS

FORMATS = ("PNG", "PPM", "BMP", "GIF", "JPEG", "TIFF")
"""Pillow's names of the accepted formats."""
SUFFIXES = (".png", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".gif", ".jpg", ".jpeg")
"""Suffixes of map images."""
COLOURED = 48
"""Difference of the largest and the least of red, green and blue (0..255) above which a pixel counts as coloured: more
than JPEG adds to greys."""
SPARE_PIXELS, PIXELS_PER_BYTE = 2**20, 20_000
"""A compressed file of n bytes may claim at most SPARE_PIXELS + n * PIXELS_PER_BYTE pixels."""


def plausible(pixels: int, path: Path) -> None:
    """Check, before memory is allocated, that a file of this length can hold this many pixels.

    Raises:
        MapError: it cannot.
    """
    size = path.stat().st_size
    most = min(MAX_CELLS, SPARE_PIXELS + size * PIXELS_PER_BYTE)
    if pixels > most:
        raise MapError(f"{size} bytes claim {pixels} pixels", source=path, expected=f"at most {most}")


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels of a picture, row 0 at the top.

    Attributes:
        bright: float64 `[H, W]`, 0 black .. 1 white, mean of red, green, blue.
        alpha: float64 `[H, W]`, 0 transparent .. 1 opaque; None: the picture has no transparency.
        coloured: bool `[H, W]`, neither black, grey, white nor fully transparent.
    """

    bright: NDArray[np.float64]
    alpha: NDArray[np.float64] | None
    coloured: NDArray[np.bool_]

    def colours(self, readings: dict[str, NDArray[np.bool_]]) -> tuple[str, ...]:
        """A note on how coloured pixels are read, if there are any.

        Args:
            readings: bool `[H, W]` by meaning, for example "obstacle"; each pixel has one.
        """
        counts = {name: int((self.coloured & taken).sum()) for name, taken in readings.items()}
        said = ", ".join(f"{count} as {name}" for name, count in counts.items() if count)
        notes = f"coloured pixels are read by their brightness only: {said}; threats belong in a scenario"
        return (notes,) if said else ()


def read_image(path: Path) -> Picture:
    """Read a picture.

    Raises:
        MapError: the file is missing, no image, truncated or too large.
    """
    check_file(path, "a map image")
    with library_errors("cannot be read as an image", path, "a complete PNG, PGM, BMP, GIF or JPEG"):
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(path, formats=FORMATS) as whole:
            plausible(whole.width * whole.height, path)
            whole.verify()  # to the end of a PNG, which decoding never reaches; it invalidates the handle
        with Image.open(path, formats=FORMATS) as image:
            plausible(image.width * image.height, path)
            _check_raw(image, path)
            return _picture(image)


def _check_raw(image: Image.Image, path: Path) -> None:
    """Check that an uncompressed file is as long as its header claims: a byte per pixel, or a bit if bilevel."""
    with path.open("rb") as stream:
        text = stream.read(2) in (b"P1", b"P2", b"P3")
    raw = image.format == "PPM" or (image.format == "BMP" and not image.info.get("compression"))
    pixels_per_byte = 1 if text or (image.format == "PPM" and image.mode != "1") else 8
    if raw and image.width * image.height > pixels_per_byte * path.stat().st_size:
        raise MapError(f"is truncated: it claims {image.width} x {image.height} pixels", source=path)


def _picture(image: Image.Image) -> Picture:
    if image.mode.startswith("I"):  # 16 bits per pixel
        wide = np.asarray(image, dtype=np.float64) / 65535
        return Picture(np.clip(wide, 0, 1), None, np.zeros(wide.shape, dtype=bool))
    pixels = np.asarray(image.convert("RGBA"))
    bright = pixels[..., :3].sum(axis=2, dtype=np.float64) / (3 * 255)
    coloured = (pixels[..., 3] > 0) & (np.ptp(pixels[..., :3], axis=2) > COLOURED)
    return Picture(bright, pixels[..., 3] / 255 if image.has_transparency_data else None, coloured)


# ROS map_server maps (a YAML file and an image), by nav2's rules.

REQUIRED = ("image", "resolution", "origin", "occupied_thresh")
USUAL_FREE = 0.196
"""The `free_thresh` that map_saver writes: the default, with a note."""
DEFAULTS: Json = {"mode": "trinary", "negate": 0, "free_thresh": USUAL_FREE}
OPTIONAL = ("datum",)
"""Required and optional keys of a map's YAML file; `datum`, the position of the frame's (0, 0), is ours."""
UNKNOWN_GREYS = {205: "map_saver", 128: "cartographer"}
"""Greys that programs write for unknown ground, with black = occupied."""


def read_ros_map(path: Path, top: Key | None = None) -> Grid:
    """Read the map of a map_server YAML file; unknown keys are ignored, as map_server does.

    With brightness b in 0..1 (16 bits as well), p = 1 - b, or b if `negate`. Modes: `trinary` (the default): occupied
    if p >= occupied_thresh, free if p <= free_thresh, else unknown; `scale`: the same, and between the thresholds
    round(100 * (p - free) / (occupied - free)); `raw`: the bytes 0..100, larger ones unknown, without effect of
    `negate`. Transparency is read as map_server reads it: `trinary` averages alpha into the brightness as a fourth
    channel; in `scale` a pixel that is not fully opaque is unknown; in `raw` alpha has no effect.

    Args:
        path: the YAML file.
        top: its content, if already read.

    Raises:
        MapError: names key, value and expectation.
    """
    top = read_yaml(path, MapError) if top is None else Key(top.value, "", path, MapError)
    keys = top.mapping(REQUIRED, OPTIONAL, DEFAULTS, strict=False)
    mode = keys["mode"].choice(("trinary", "scale", "raw"))
    resolution = keys["resolution"].number(CELL_SIZE, f"{CELL_SIZE.expected}, a pixel")
    x, y, yaw = keys["origin"].numbers(COORDINATE, POSE, count=3)
    occupied = keys["occupied_thresh"].number(SHARE)
    below = f"a number from 0 to below occupied_thresh ({occupied:g})"
    free = keys["free_thresh"].number(Numbers(0, occupied, below=True, text=below))
    negate = _flag(keys["negate"])
    picture = read_image(keys["image"].file("the map's image"))
    values, notes = _values(mode, picture, negate, occupied, free)
    if mode != "raw" and "free_thresh" not in top.value:
        notes += (f"names no free_thresh: {USUAL_FREE} is used, as map_saver writes it",)
    height, width = values.shape
    frame = Frame((height, width), resolution, (x, y, math.remainder(yaw, 2 * math.pi)))
    place = read_datum(keys["datum"]) if "datum" in keys else None
    return Grid(values, frame, str(path), notes=notes, georeference=place)


def read_datum(key: Key) -> Georeference:
    """`{latitude, longitude}` of the frame's (0, 0), in degrees of WGS 84; x points east there, y north.

    Raises:
        ScenarioError, MapError: of the key, for an invalid value.
    """
    keys = key.mapping(("latitude", "longitude"))
    latitudes, longitudes = Numbers(-89, 89, "degrees"), Numbers(-TURN, TURN, text="degrees, -180 to 180")
    given = [keys[name].value for name in ("latitude", "longitude")]
    if not latitudes.accepts(given[0]) and longitudes.accepts(given[0]) and latitudes.accepts(given[1]):
        raise keys["latitude"].wrong(
            latitudes.expected, "if latitude and longitude stand in the wrong order, swap them"
        )
    return around(keys["latitude"].number(latitudes), keys["longitude"].number(longitudes))


def _values(
    mode: str, picture: Picture, negate: bool, occupied: float, free: float
) -> tuple[NDArray[np.int16], tuple[str, ...]]:
    """`Grid.occupancy`, and notes on colours, transparency, and unknown ground that is read as free or occupied."""
    notes: list[str] = []
    if mode == "raw":
        raw = np.rint(picture.bright * 255)
        values = np.where(raw <= OCCUPIED, raw, UNKNOWN).astype(np.int16)
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
                values = np.where(alpha < 1, UNKNOWN, plain).astype(np.int16)
                how = "mode: scale reads pixels that are not fully opaque as unknown, as map_server does"
            notes += _changed(plain, values, how)
        notes += _unknown_greys(mode, picture, values, p, negate)
    readings = {"obstacle": values >= OCCUPIED, "free": values == 0, "unknown": values == UNKNOWN}
    readings |= {"in between": (values > 0) & (values < OCCUPIED)}
    return values, (*picture.colours(readings), *notes)


def _by_thresholds(mode: str, p: NDArray[np.float64], occupied: float, free: float) -> NDArray[np.int16]:
    """Values from p `[H, W]`, the occupancy in 0..1."""
    between = np.rint((p - free) / (occupied - free) * OCCUPIED) if mode == "scale" else np.full(p.shape, UNKNOWN)
    return np.where(p >= occupied, OCCUPIED, np.where(p <= free, 0, between)).astype(np.int16)


def _changed(plain: NDArray[np.int16], values: NDArray[np.int16], how: str) -> list[str]:
    """A note on pixels that transparency changes; `plain`: values by brightness only."""
    names = {UNKNOWN: "unknown", 0: "free", OCCUPIED: "obstacles"}
    counts = {name: int(((values == value) & (plain != value)).sum()) for value, name in names.items()}
    said = ", ".join(f"{counted(count, 'pixel')} {name} by it" for name, count in counts.items() if count)
    return [f"{how}: {said}"] if said else []


def _unknown_greys(
    mode: str, picture: Picture, values: NDArray[np.int16], p: NDArray[np.float64], negate: bool
) -> list[str]:
    """A note for every grey of unknown ground that the thresholds make free or an obstacle."""
    notes, greys = [], np.where(picture.coloured, -1, np.rint(picture.bright * 255))
    for unknown, writer in UNKNOWN_GREYS.items():
        grey = 255 - unknown if negate else unknown
        for taken, value in (("free", 0), ("an obstacle", OCCUPIED)):
            held = (greys == grey) & (values == value)
            if held.any():
                below = math.floor(1000 * p[held].min()) / 1000
                fix = f"free_thresh: {below:g}" if value == 0 else "occupied_thresh: 0.65"
                fix = fix if mode == "trinary" else f"mode: trinary` and `{fix}"  # scale grades what is in between
                notes.append(
                    f"grey {grey}, which {writer} writes for unknown ground, is {taken} in "
                    f"{counted(int(held.sum()), 'pixel')}; with `{fix}` in a map_server YAML file it is unknown"
                )
    return notes


def _flag(key: Key) -> bool:
    if key.value not in (0, 1):
        raise key.wrong("0 or 1")
    return bool(key.value)


def image_grid(path: Path) -> Grid:
    """Read a plain picture as a map, one metre per pixel: dark pixels are obstacles.

    It is read as a trinary map with map_server's usual thresholds: p = 1 - brightness >= 0.65 is an obstacle, p <= 0.25
    free, between them unknown. Fully transparent pixels are unknown.

    Raises:
        MapError: the file is no picture.
    """
    picture = read_image(path)
    values, notes = _values("trinary", picture, False, 0.65, 0.25)
    if picture.alpha is not None and (hidden := picture.alpha == 0).any():
        values[hidden] = UNKNOWN
        notes += (f"{counted(int(hidden.sum()), 'pixel')} fully transparent: unknown",)
    height, width = values.shape
    return Grid(values, Frame((height, width), 1.0), str(path), notes=notes, measured=False)
