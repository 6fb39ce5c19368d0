"""Names beside the marks of a chart, where no line, no mark and no other name is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from numpy.typing import NDArray

Box = tuple[float, float, float, float]
"""Left, lower, right and upper end, in pixels."""
SIZE = 7.0
"""Of the letters; this and what follows in points."""
LETTER, HEIGHT = 0.64 * SIZE, 0.8 * SIZE
"""Width of a letter, and height of a line."""
CLEAR = 1.2
"""Kept free around a name."""
NEARER = 1.3
"""How many times as far as from its own mark a name is from every other mark that has one."""
GAPS = (3.5, 6.5, 9.5)
"""From a mark's middle to its name, the nearest first."""
SIDES = ((-1, 1), (1, -1), (-1, 0), (1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))
"""Where a name may be, seen from its mark: to the left or right, below or above; what is preferred comes first."""


class Name(NamedTuple):
    """Words beside the mark at (x, y) of the chart."""

    words: str
    at: tuple[float, float]
    colour: str


def write_names(axes: Axes, names: Sequence[Name]) -> None:
    """Write each name beside its mark, if there is a free place for it; the first ones choose first.

    To be called when all else is drawn, and the limits of the axes stay as they are.
    """
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())
    dots = axes.figure.dpi / 72  # pixels a point
    drawn = np.concatenate([np.empty((0, 2)), *_drawn(axes, dots)])
    marks = axes.transData.transform([name.at for name in names] or np.empty((0, 2)))
    taken: list[Box] = []
    for mark, name in zip(marks, names, strict=True):
        places = (box for box in _places(mark, name.words, dots) if _is_told(box, mark, marks))
        box = next((box for box in places if _is_free(box, axes, drawn, taken, dots)), None)
        if box is None:
            continue
        taken.append(box)
        middle = axes.transData.inverted().transform(((box[0] + box[2]) / 2, (box[1] + box[3]) / 2))
        axes.text(
            float(middle[0]),
            float(middle[1]),
            name.words,
            fontsize=SIZE,
            color=name.colour,
            ha="center",
            va="center_baseline",
        )


def _places(mark: NDArray[np.float64], words: str, dots: float) -> Iterator[Box]:
    """Where the name may be, the best place first."""
    x, y = mark.tolist()
    width, height = LETTER * len(words) * dots, HEIGHT * dots
    for gap in GAPS:
        for across, up in SIDES:
            left = x + across * gap * dots - width * (1 - across) / 2
            low = y + up * gap * dots - height * (1 - up) / 2
            yield left, low, left + width, low + height


def _is_told(box: Box, mark: NDArray[np.float64], marks: NDArray[np.float64]) -> bool:
    """Whether it is clear whose name it is."""
    nearest = np.clip(marks, box[:2], box[2:])
    away = np.hypot(*(marks - nearest).T)
    own = (marks == mark).all(axis=1)
    return bool(NEARER * away[own].min() < away[~own].min(initial=np.inf))


def _is_free(box: Box, axes: Axes, drawn: NDArray[np.float64], taken: list[Box], dots: float) -> bool:
    clear = CLEAR * dots
    left, low, right, high = box[0] - clear, box[1] - clear, box[2] + clear, box[3] + clear
    of = axes.bbox
    if left < of.x0 or right > of.x1 or low < of.y0 or high > of.y1:
        return False
    x, y = drawn.T
    if ((x > left) & (x < right) & (y > low) & (y < high)).any():
        return False
    return all(right < other[0] or left > other[2] or high < other[1] or low > other[3] for other in taken)


def _drawn(axes: Axes, dots: float) -> Iterator[NDArray[np.float64]]:
    """Points `[.., 2]` in pixels, close together, on every line and round every mark."""
    for line in axes.lines:
        ends = line.get_transform().transform(line.get_xydata())
        yield from map(_between, ends[:-1], ends[1:])
        if line.get_marker() not in ("None", "none", "", None):
            yield _round(ends, line.get_markersize() / 2 * dots)
    for group in axes.collections:
        if isinstance(group, LineCollection):
            for segment in group.get_segments():
                ends = group.get_transform().transform(segment)
                yield from map(_between, ends[:-1], ends[1:])
        elif isinstance(group, PathCollection):
            middles = group.get_offset_transform().transform(group.get_offsets())
            yield _round(middles, float(np.sqrt(group.get_sizes().max())) / 2 * dots)


def _between(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    steps = 2 + int(np.hypot(*(other - one)))
    return np.linspace(one, other, steps)


def _round(middles: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return (middles[:, None] + circle).reshape(-1, 2)
