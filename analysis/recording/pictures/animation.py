"""A rollout for people without a viewer: a PNG of one of its steps, and an animated GIF of all of it."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import KDTree

from analysis.pictures.style import DPI, FINE_DPI, FINE_FROM, house_style, png_bytes
from analysis.recording.pictures.picture import RolloutPicture
from analysis.recording.viewers.topics import Stage
from planner.errors import UsageError
from planner.trace import EventKind, Trace

MOST_FRAMES = 300
ANIMATION_DPI = 100
"""Pixels an inch of an animation: 800 across."""
PLAYING_SECONDS = 24.0
FASTEST, SLOWEST = 40, 250
"""Milliseconds that a frame is shown; browsers slow down what is faster."""
ON_LOSS, AT_END = 500, 3000
"""Milliseconds that a frame with a loss is shown, and the last one."""
COLOURS = 255
"""Of a GIF: of 256, one stands for "as in the frame before"."""


def picture_png(trace: Trace, stage: Stage, step: int | None = None) -> bytes:
    """The rollout at the end of `step` (None: its last) as a PNG 8 inches wide. The same input, the same bytes.

    `stage`: what the trace is a rollout of. Raises UsageError for a step that it does not have.
    """
    at = trace.time if step is None else step
    if not 0 <= at <= trace.time:
        raise UsageError(f"step {step} of rollout {trace.rollout}", expected=f"0 to {trace.time}, where it ended")
    with house_style():
        dpi = FINE_DPI if max(stage.world.shape) > FINE_FROM else DPI
        picture = RolloutPicture(trace, stage, dpi)
        picture.show(at)
        return png_bytes(picture.figure)


def animation_gif(trace: Trace, stage: Stage, most_frames: int = MOST_FRAMES) -> bytes:
    """The whole rollout as an animated GIF, 800 pixels wide, that plays for about half a minute, over and over.

    Of a long rollout at most `most_frames` steps are shown, the first, the last and those with losses first of all.
    The same input gives the same bytes. Holds one byte a pixel and frame. Raises UsageError for less than two frames.
    """
    if most_frames < 2:
        raise UsageError(f"{most_frames} frames", expected="2 or more")
    steps = shown_steps(trace, most_frames)

    def pixels(steps: list[int]) -> Iterator[NDArray[np.uint8]]:
        picture = RolloutPicture(trace, stage, ANIMATION_DPI)
        for step in steps:
            picture.show(step)
            yield picture.pixels()

    with house_style():
        colours = _commonest(pixels(sorted({0, trace.time // 2, trace.time})))
        return _gif(pixels(steps), colours, durations(trace, steps))


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


def _commonest(pictures: Iterator[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """The commonest colours of some pictures `[down, across, 3]`, uint8 `[COLOURS, 3]`."""
    found, counts = np.unique(np.concatenate([_packed(one).ravel() for one in pictures]), return_counts=True)
    chosen = found[np.argsort(-counts, kind="stable")][:COLOURS]
    return _rgb(np.pad(chosen, (0, COLOURS - len(chosen)), mode="edge"))


def _packed(pixels: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours `[..., 3]` as numbers below 2**24, `[...]`."""
    packed: NDArray[np.uint32] = pixels.astype(np.uint32) @ np.array([2**16, 2**8, 1], dtype=np.uint32)
    return packed


def _rgb(packed: NDArray[np.uint32]) -> NDArray[np.uint8]:
    return (packed[..., None] >> np.array([16, 8, 0], dtype=np.uint32)).astype(np.uint8)


def _in_colours(picture: NDArray[np.uint8], colours: NDArray[np.uint8], tree: KDTree) -> Image.Image:
    """The picture `[down, across, 3]` in the colours of the tree, each pixel in the nearest."""
    found, which = np.unique(_packed(picture), return_inverse=True)
    nearest = tree.query(_rgb(found))[1].astype(np.uint8)
    image = Image.fromarray(nearest[which].reshape(picture.shape[:2]))
    image.putpalette(colours.tobytes())
    return image


def _gif(pictures: Iterator[NDArray[np.uint8]], colours: NDArray[np.uint8], milliseconds: list[int]) -> bytes:
    """The pictures as a GIF whose frames say only what has changed."""
    tree = KDTree(colours)
    frames = (_in_colours(one, colours, tree) for one in pictures)
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
