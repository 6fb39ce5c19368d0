"""Map images, read safely: how dark each pixel is, and nothing that a header merely claims."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from planner.errors import MapError
from planner.files import check_file
from planner.worlds.world import MAX_CELLS

FORMATS = ("PNG", "PPM", "BMP", "GIF", "JPEG", "TIFF")
"""Pillow's names of the formats that are opened."""
SUFFIXES = (".png", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".gif", ".jpg", ".jpeg")
"""File names that are taken for map images."""
SPARE_PIXELS, PIXELS_PER_BYTE = 2**20, 20_000
"""A compressed file of n bytes may claim this many pixels at most: SPARE_PIXELS + n * PIXELS_PER_BYTE."""


def plausible(pixels: int, path: Path) -> None:
    """MapError unless a file of this length can hold so many pixels; called before memory is taken."""
    size = path.stat().st_size
    most = min(MAX_CELLS, SPARE_PIXELS + size * PIXELS_PER_BYTE)
    if pixels > most:
        raise MapError(f"{size} bytes claim {pixels} pixels", source=path, expected=f"at most {most}")


def read_image(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Brightness float64 `[H, W]` (0 black .. 1 white, mean of red, green, blue) and bool `[H, W]`: opaque pixels.

    Row 0 is the top of the picture. Raises MapError for a file that is missing, no image, truncated or too large.
    """
    check_file(path, "a map image")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as whole:
                plausible(whole.width * whole.height, path)
                whole.verify()  # to the end of a PNG, which decoding never reaches; it spoils the handle
            with Image.open(path, formats=FORMATS) as image:
                plausible(image.width * image.height, path)
                _check_raw(image, path)
                return _brightness(image)
    except MapError:
        raise
    except Exception as error:  # decoders of broken files raise nearly anything
        problem = f"cannot be read as an image ({error or type(error).__name__})"
        raise MapError(problem, source=path, expected="a complete PNG, PGM, BMP, GIF or JPEG") from error


def _check_raw(image: Image.Image, path: Path) -> None:
    """An uncompressed file must be about as long as its header claims: a byte a pixel, or a bit if it is bilevel."""
    with path.open("rb") as stream:
        text = stream.read(2) in (b"P1", b"P2", b"P3")
    raw = image.format == "PPM" or (image.format == "BMP" and not image.info.get("compression"))
    pixels_per_byte = 1 if text or (image.format == "PPM" and image.mode != "1") else 8
    if raw and image.width * image.height > pixels_per_byte * path.stat().st_size:
        raise MapError(f"is truncated: it claims {image.width} x {image.height} pixels", source=path)


def _brightness(image: Image.Image) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    if image.mode.startswith("I"):  # 16 bits a pixel
        wide = np.asarray(image, dtype=np.float64) / 65535
        return np.clip(wide, 0, 1), np.ones(wide.shape, dtype=bool)
    if image.mode in ("1", "L"):
        grey = np.asarray(image.convert("L"), dtype=np.float64) / 255
        return grey, np.ones(grey.shape, dtype=bool)
    pixels = np.asarray(image.convert("RGBA"))
    return pixels[..., :3].sum(axis=2, dtype=np.float64) / (3 * 255), pixels[..., 3] == 255
