"""A map as a picture: cells by value, obstacles and what is out of reach, with its heading, scale and legend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from analysis.pictures.style import (
    DPI,
    FAINT,
    FINE_DPI,
    FINE_FROM,
    INK,
    OBSTACLE,
    UNREACHABLE,
    Key,
    MapLayout,
    cell_points,
    heading,
    in_metres,
    inches,
    map_axes,
    map_layout,
    metre_axes,
    new_figure,
    root_figure,
)
from planner.worlds.world import World

SMALLEST = 0.5
"""Cells smaller than this, in points, get no outlines and no hatching: they would hide what they mark."""
HATCH = "/" * 5


def map_figure(world: World, entries: int = 4) -> tuple[Figure, MapLayout]:
    """An empty figure for the map and a legend of `entries`: its first Axes is the map's."""
    layout = map_layout(world.shape, entries, in_metres(world.cell_size, world.origin))
    figure = new_figure(layout.size, FINE_DPI if max(world.shape) > FINE_FROM else DPI)
    figure.add_axes(inches(figure, layout.map_box))
    return figure, layout


def with_key(figure: Figure, layout: MapLayout, key: Key) -> Figure:
    """Heading, colour bar, legend and listed lines round the map."""
    heading(figure.axes[0], key.title, key.subtitle)
    legend = draw_key(figure, layout.bar_box, layout.legend, layout.columns, key)
    if key.lines:
        under = layout.legend[1] - legend.get_window_extent().height / figure.dpi - 0.2
        across, up = layout.lines or (layout.legend[0], under)
        width, height = layout.size
        figure.text(across / width, up / height, "\n".join(key.lines), va="top", fontsize=8.5, linespacing=1.5)
    return figure


def draw_key(figure: Figure, box: Sequence[float], place: Sequence[float], columns: int, key: Key) -> Legend:
    """The colour bar in a rectangle, flat if the legend has several columns; the legend right of and below `place`.

    Both in inches from the figure's lower-left corner.
    """
    bar_axes = figure.add_axes(inches(figure, box))
    bar = figure.colorbar(key.scale, cax=bar_axes, orientation="horizontal" if columns > 1 else "vertical")
    if key.ticks is not None:
        bar.set_ticks(key.ticks.tolist(), labels=key.tick_labels)
    bar.ax.minorticks_off()
    bar.ax.tick_params(length=0, labelsize=8, labelcolor=INK)
    bar.outline.set_linewidth(0.5)
    bar.set_label(key.label, color=FAINT, fontsize=8.5)
    if columns == 1:
        bar.ax.yaxis.set_label_position("left")  # right of long numbers it would stand in the legend
    return figure.legend(
        handles=[handle for column in range(columns) for handle in key.handles[column::columns]],
        loc="upper left",
        bbox_to_anchor=tuple(np.array(place) / figure.get_size_inches()),
        ncols=columns,
        borderaxespad=0,
        borderpad=0,
        handlelength=1.6,
    )


def paint(axes: Axes, world: World, accessible: NDArray[np.bool_], values: NDArray, scale: ScalarMappable) -> None:
    """The cells as one picture, with their axes."""
    pixels = cell_points(axes, world.shape) / 72 * root_figure(axes).dpi
    image = cell_colours(world, accessible, scale.to_rgba(np.where(accessible, values, 0)))
    axes.imshow(image, interpolation="nearest" if pixels >= 1 else "auto", zorder=0)
    map_axes(axes, world.shape, world.cell_size)
    if in_metres(world.cell_size, world.origin):
        metre_axes(axes, world.shape, world.cell_size, world.origin)
    hatch(axes, world.free & ~accessible)


def cell_colours(world: World, accessible: NDArray[np.bool_], colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """RGBA `[H, W, 4]` of every cell; obstacles and cells out of reach have colours of their own."""
    reached = np.where(accessible[..., None], colours, to_rgba(UNREACHABLE))
    return np.where(world.free[..., None], reached, to_rgba(OBSTACLE))


def hatch(axes: Axes, mask: NDArray[np.bool_]) -> None:
    """Hatch the cells of `mask` `[H, W]`: runs along the rows, all in one patch."""
    if not mask.any() or cell_points(axes, mask.shape) < SMALLEST:
        return
    steps = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(steps == 1)
    ends = np.nonzero(steps == -1)[1]
    left, right, top, bottom = begins - 0.5, ends - 0.5, rows - 0.5, rows + 0.5
    corners = np.stack([left, top, right, top, right, bottom, left, bottom, left, top], axis=1).reshape(-1, 2)
    codes = np.tile([Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY], len(rows))
    patch = PathPatch(Outline(corners, codes), facecolor="none", edgecolor="#9aa7ba", linewidth=0, hatch=HATCH)
    axes.add_patch(patch)


def draw_borders(axes: Axes, labels: NDArray[np.int64], colour: str, width: float, alpha: float) -> None:
    """Thin lines along the cell sides between different `labels` `[H, W]`; -1 is no label, and draws no line."""
    down = (labels[1:] != labels[:-1]) & (labels[1:] >= 0) & (labels[:-1] >= 0)
    across = (labels[:, 1:] != labels[:, :-1]) & (labels[:, 1:] >= 0) & (labels[:, :-1] >= 0)
    rows, cols = np.nonzero(down)
    flat = np.stack([cols - 0.5, rows + 0.5, cols + 0.5, rows + 0.5], axis=1)
    rows, cols = np.nonzero(across)
    upright = np.stack([cols + 0.5, rows - 0.5, cols + 0.5, rows + 0.5], axis=1)
    segments = np.concatenate([flat, upright]).reshape(-1, 2, 2)
    lines = LineCollection(
        list(segments), colors=colour, linewidths=width, alpha=alpha, capstyle="projecting", zorder=1.5
    )
    axes.add_collection(lines, autolim=False)


def terrain_handles(world: World, accessible: NDArray[np.bool_]) -> list[Patch]:
    handles = []
    if not world.free.all():
        handles.append(Patch(facecolor=OBSTACLE, label="obstacle"))
    if (world.free & ~accessible).any():
        handles.append(Patch(facecolor=UNREACHABLE, edgecolor="#9aa7ba", hatch=HATCH, label="out of reach"))
    return handles
