"""A rollout for people without a viewer: a PNG of one of its steps, and an animated GIF of all of it."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from analysis.pictures.style import DPI, FINE_DPI, FINE_FROM, house_style, png_bytes
from analysis.recording.pictures.picture import RolloutPicture
from planner.errors import UsageError
from planner.plans.plan import Area, Plan
from planner.trace import EventKind, Trace
from planner.worlds.world import World

MOST_FRAMES = 300
ANIMATION_DPI = 100
"""Pixels an inch of an animation: 800 across."""
PLAYING_SECONDS = 24.0
FASTEST, SLOWEST = 40, 250
"""Milliseconds that a frame is shown; browsers slow down what is faster."""
ON_LOSS, AT_END = 500, 3000
"""Milliseconds that a frame with a loss is shown, and the last one."""
COLOURS, FILLS = 255, 48
"""Colours of a GIF (of 256, one stands for "as in the frame before"), and how many are the commonest as they are."""


def picture_png(
    trace: Trace, plan: Plan, world: World, step: int | None = None, areas: Sequence[Area] | None = None
) -> bytes:
    """The rollout at the end of `step` (None: its last) as a PNG 8 inches wide. The same input, the same bytes.

    `plan`, `world`: those that the trace is a rollout of. `areas`: the areas at t = 0 in id order, if they are not
    `plan.areas` (the open loop has those that the nominal run adds as well). Raises UsageError for a step that it does
    not have.
    """
    at = trace.time if step is None else step
    if not 0 <= at <= trace.time:
        raise UsageError(f"step {step} of rollout {trace.rollout}", expected=f"0 to {trace.time}, where it ended")
    with house_style():
        dpi = FINE_DPI if max(world.shape) > FINE_FROM else DPI
        picture = RolloutPicture(trace, plan, world, plan.areas if areas is None else areas, dpi)
        picture.show(at)
        return png_bytes(picture.figure)


def animation_gif(
    trace: Trace,
    plan: Plan,
    world: World,
    most_frames: int = MOST_FRAMES,
    areas: Sequence[Area] | None = None,
) -> bytes:
    """The whole rollout as an animated GIF, 800 pixels wide, that plays for about half a minute, over and over.

    Of a long rollout at most `most_frames` steps are shown, the first, the last and those with losses first of all.
    The same input gives the same bytes. Holds one byte a pixel and frame. `areas`: see `picture_png`. Raises
    UsageError for less than two frames.
    """
    if most_frames < 2:
        raise UsageError(f"{most_frames} frames", expected="2 or more")
    steps = shown_steps(trace, most_frames)

    def pixels(steps: list[int]) -> Iterator[NDArray[np.uint8]]:
        picture = RolloutPicture(trace, plan, world, plan.areas if areas is None else areas, ANIMATION_DPI)
        for step in steps:
            picture.show(step)
            yield picture.pixels()

    with house_style():
        palette = _Palette(pixels(sorted({0, trace.time // 2, trace.time})))
        return _gif(pixels(steps), palette, durations(trace, steps))


def shown_steps(trace: Trace, most: int) -> list[int]:
    """Increasing steps, at most `most` (2 or more): first, last, those with losses, the others evenly spread."""
    losses = np.unique(trace.events[trace.events[:, 2] == EventKind.HIT, 0])
    steps = np.unique([0, trace.time, *losses[: most - 2]])
    others = np.setdiff1d(np.arange(trace.time + 1), steps)
    room = most - len(steps)
    if len(others) > room:
        others = others[np.linspace(0, len(others) - 1, room).round().astype(np.int64)]
    return [int(step) for step in np.union1d(steps, others)]


def durations(trace: Trace, steps: list[int]) -> list[int]:
    """Milliseconds for each of `steps`, in whole hundredths of a second: longer at losses and at the end."""
    usual = int(np.clip(PLAYING_SECONDS * 1000 / len(steps), FASTEST, SLOWEST)) // 10 * 10
    losses = set(trace.events[trace.events[:, 2] == EventKind.HIT, 0].tolist())
    return [AT_END if step == trace.time else ON_LOSS if step in losses else usual for step in steps]


class _Palette:
    """The colours of a GIF: the commonest of some pictures as they are, and shades by median cut.

    Pillow's own way to a palette takes colours that are close for the same, white and the map's safe cells too.
    """

    def __init__(self, pictures: Iterator[NDArray[np.uint8]]) -> None:
        pixels = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
        packed, counts = np.unique(_packed(pixels), return_counts=True)
        common = packed[np.argsort(-counts, kind="stable")][:FILLS]
        cut = Image.fromarray(pixels[None]).quantize(COLOURS - FILLS, Image.Quantize.MEDIANCUT).getpalette() or []
        colours = np.concatenate([common, _packed(np.array(cut, dtype=np.uint8).reshape(-1, 3))])
        colours = np.pad(colours, (0, COLOURS - len(colours)), mode="edge")
        self._colours = np.stack([colours >> 16, colours >> 8 & 255, colours & 255], axis=1).astype(np.int64)
        self._index = np.full(2**24, COLOURS, dtype=np.uint8)

    def image(self, picture: NDArray[np.uint8]) -> Image.Image:
        """The picture `[down, across, 3]` in these colours, each pixel in the nearest."""
        packed = _packed(picture)
        new = np.unique(packed[self._index[packed] == COLOURS])
        for part in np.array_split(new, 1 + len(new) // 4096):
            rgb = np.stack([part >> 16, part >> 8 & 255, part & 255], axis=1).astype(np.int64)
            self._index[part] = ((rgb[:, None] - self._colours) ** 2).sum(axis=2).argmin(axis=1)
        image = Image.fromarray(self._index[packed])
        image.putpalette(self._colours.astype(np.uint8).tobytes())
        return image


def _packed(pixels: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours `[..., 3]` as numbers below 2**24, `[...]`."""
    packed: NDArray[np.uint32] = pixels.astype(np.uint32) @ np.array([2**16, 2**8, 1], dtype=np.uint32)
    return packed


def _gif(pictures: Iterator[NDArray[np.uint8]], palette: _Palette, milliseconds: list[int]) -> bytes:
    """The pictures as a GIF whose frames say only what has changed."""
    frames = map(palette.image, pictures)
    out = io.BytesIO()
    next(frames).save(
        out,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=milliseconds,
        loop=0,
        disposal=1,
        optimize=True,
        transparency=COLOURS,
    )
    return out.getvalue()
