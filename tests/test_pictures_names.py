"""Names beside marks: on the finished picture nothing is drawn where they stand."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from analysis.pictures import names
from analysis.pictures.names import Name, write_names
from analysis.pictures.style import new_figure

CROWDED = [(0.0, 5.0), (0.1, 22), (0.12, 24), (0.3, 50), (1, 60), (1.05, 61), (4, 70), (7.6, 80.2), (8, 80)]


def crowded() -> tuple[Figure, list[Name]]:
    """Curves that are steep at the axis, marks side by side, a ring, intervals."""
    figure = new_figure((4.0, 3.0))
    axes = figure.add_axes((0.15, 0.15, 0.8, 0.8))
    x, y = map(np.array, zip(*CROWDED, strict=True))
    axes.errorbar(x, y, xerr=0.1, yerr=4.0, color="#1f4e86")
    axes.scatter(x, y, s=18, color="#1f4e86")
    axes.plot(x, 0.9 * y, "o:", color="#20242b", markersize=3.5)
    axes.plot([4], [70], "o", markersize=12, markerfacecolor="none", markeredgecolor="red")
    axes.set_xlim(left=0)
    return figure, [Name(f"{100 * up:g}", (across, up), "black") for across, up in CROWDED]


def pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()
    assert isinstance(figure.canvas, FigureCanvasAgg)
    return np.asarray(figure.canvas.buffer_rgba())[::-1, :, :3].astype(int)


def boxes_and_ink() -> tuple[list[tuple[int, int, int, int]], list[int]]:
    """Where the names stand, in pixels from the lower left, and how many dark pixels lie below each without it."""
    figure, asked = crowded()
    FigureCanvasAgg(figure)
    axes = figure.axes[0]
    write_names(axes, asked)
    pixels(figure)
    boxes = [tuple(int(v) for v in text.get_window_extent().extents.round()) for text in axes.texts]
    for text in axes.texts:
        text.set_visible(False)
    bare = pixels(figure)
    ink = [int((bare[low:high, left:right] < 200).any(axis=2).sum()) for left, low, right, high in boxes]
    return [(left, low, right, high) for left, low, right, high in boxes], ink


def test_names_stand_where_nothing_is_drawn_and_none_on_another() -> None:
    boxes, ink = boxes_and_ink()
    assert len(boxes) >= 6 and not any(ink)
    for number, (left, low, right, high) in enumerate(boxes):
        for other in boxes[:number]:
            assert right <= other[0] or left >= other[2] or high <= other[1] or low >= other[3]


def test_what_is_drawn_has_to_be_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(names, "_drawn", lambda axes, dots: iter(()))
    assert any(boxes_and_ink()[1])
