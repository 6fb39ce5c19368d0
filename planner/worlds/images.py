"""Map images, read safely: how dark each pixel is, and nothing that a header merely claims."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from planner.errors import MapError
from planner.files import check_file, foreign_errors
from planner.worlds.world import MAX_CELLS

FORMATS = ("PNG", "PPM", "BMP", "GIF", "JPEG", "TIFF")
"""Pillow's names of the formats that are opened."""
SUFFIXES = (".png", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".gif", ".jpg", ".jpeg")
"""File names that are taken for map images."""
COLOURED = 48
"""Difference of the strongest and the weakest of red, green and blue (0..255) above which a pixel counts as coloured:
more than JPEG makes of greys."""
SPARE_PIXELS, PIXELS_PER_BYTE = 2**20, 20_000
"""A compressed file of n bytes may claim this many pixels at most: SPARE_PIXELS + n * PIXELS_PER_BYTE."""


def plausible(pixels: int, path: Path) -> None:
    """MapError unless a file of this length can hold so many pixels; called before memory is taken."""
    size = path.stat().st_size
    most = min(MAX_CELLS, SPARE_PIXELS + size * PIXELS_PER_BYTE)
    if pixels > most:
        raise MapError(f"{size} bytes claim {pixels} pixels", source=path, expected=f"at most {most}")


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture's pixels, row 0 at the top.

    Attributes:
        bright: float64 `[H, W]`, 0 black .. 1 white, mean of red, green, blue.
        alpha: float64 `[H, W]`, 0 transparent .. 1 opaque; None: the picture has no transparency.
        coloured: bool `[H, W]`, neither black, grey, white nor wholly transparent.
        lossy: its values are not exactly those that were written.
    """

    bright: NDArray[np.float64]
    alpha: NDArray[np.float64] | None
    coloured: NDArray[np.bool_]
    lossy: bool = False

    @property
    def grey(self) -> NDArray[np.int64]:
        """The grey value 0..255 of every pixel, int64 `[H, W]`; -1 where it is coloured."""
        return np.where(self.coloured, -1, np.rint(self.bright * 255).astype(np.int64))

    def colours(self, readings: dict[str, NDArray[np.bool_]]) -> tuple[str, ...]:
        """A note on the coloured pixels, if there are any: what they are taken for.

        `readings`: bool `[H, W]` by name, for example "obstacle"; each pixel is of one.
        """
        counts = {name: int((self.coloured & taken).sum()) for name, taken in readings.items()}
        said = ", ".join(f"{count} as {name}" for name, count in counts.items() if count)
        notes = f"coloured pixels are read by their brightness alone: {said}; threats are given in a scenario"
        return (notes,) if said else ()


def read_image(path: Path) -> Picture:
    """The picture in a file. Raises MapError for a file that is missing, no image, truncated or too large."""
    check_file(path, "a map image")
    with foreign_errors("cannot be read as an image", path, "a complete PNG, PGM, BMP, GIF or JPEG"):
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(path, formats=FORMATS) as whole:
            plausible(whole.width * whole.height, path)
            whole.verify()  # to the end of a PNG, which decoding never reaches; it spoils the handle
        with Image.open(path, formats=FORMATS) as image:
            plausible(image.width * image.height, path)
            _check_raw(image, path)
            return _picture(image)


def _check_raw(image: Image.Image, path: Path) -> None:
    """An uncompressed file must be about as long as its header claims: a byte a pixel, or a bit if it is bilevel."""
    with path.open("rb") as stream:
        text = stream.read(2) in (b"P1", b"P2", b"P3")
    raw = image.format == "PPM" or (image.format == "BMP" and not image.info.get("compression"))
    pixels_per_byte = 1 if text or (image.format == "PPM" and image.mode != "1") else 8
    if raw and image.width * image.height > pixels_per_byte * path.stat().st_size:
        raise MapError(f"is truncated: it claims {image.width} x {image.height} pixels", source=path)


def _picture(image: Image.Image) -> Picture:
    if image.mode.startswith("I"):  # 16 bits a pixel
        wide = np.asarray(image, dtype=np.float64) / 65535
        return Picture(np.clip(wide, 0, 1), None, np.zeros(wide.shape, dtype=bool))
    pixels = np.asarray(image.convert("RGBA"))
    bright = pixels[..., :3].sum(axis=2, dtype=np.float64) / (3 * 255)
    coloured = (pixels[..., 3] > 0) & (np.ptp(pixels[..., :3], axis=2) > COLOURED)
    lossy = image.format == "JPEG" or image.info.get("compression") == "jpeg"  # of TIFF
    return Picture(bright, pixels[..., 3] / 255 if image.has_transparency_data else None, coloured, lossy)
