"""How pictures look: colours, the layout of a figure for a map's shape, headings, and numbers as words.

Matplotlib's object interface only: nothing here or in the modules that use it touches pyplot or its global state.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import FuncNorm, LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, Locator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from planner.errors import visible

LineStyle: TypeAlias = str | tuple[int, tuple[float, ...]]
"""A name, or (offset, lengths of dashes and gaps)."""
Look: TypeAlias = dict[str, Any]
"""Keywords that a drawing of matplotlib takes."""
WIDTH = 8.0
"""Width of every figure in inches."""
DPI = 150
"""Pixels an inch: 1,200 pixels a figure."""
FINE_DPI = 225
"""Pixels an inch for maps with a side above FINE_FROM cells, so that a cell keeps a few pixels."""
FINE_FROM = 100

INK, FAINT, GRID = "#20242b", "#5b6470", "#d9dce1"
OBSTACLE, UNREACHABLE, SAFE, FOG = "#3d434c", "#dfe5ee", "#fcfbf8", "#4a4560"
ROBOT_COLOURS = ("#0072b2", "#00916a", "#7a2fa0", "#111111", "#2fa8e6", "#8a7f00", "#d6409f", "#7a4a24")
"""Eight colours that stay apart for colour-blind readers and on the reds of the threat scale."""
LINE_STYLES: tuple[LineStyle, ...] = ("-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
HALO = [withStroke(linewidth=1.8, foreground="white")]
"""Keeps small text readable on any cell."""
SHADES = 250
"""Steps of a colour scale, the same in pictures and on pages."""
THREAT = LinearSegmentedColormap.from_list("threat", ["#fde6d3", "#fac79f", "#f19c74", "#e0705a", "#c5464a"])
COVERED = LinearSegmentedColormap.from_list("covered", ["#fff8dc", "#d3ecb9", "#85cdb9", "#3f9fbe", "#2f62a6"])
LOSSES = LinearSegmentedColormap.from_list("losses", ["#fcfbf8", "#fbd3a5", "#f08a55", "#c93a3c", "#7a1237"])

RC = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.parse_math": False,  # a `$` in somebody's words is no formula
    "axes.edgecolor": FAINT,
    "axes.labelcolor": FAINT,
    "axes.linewidth": 0.7,
    "axes.unicode_minus": False,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "hatch.linewidth": 0.5,
    "figure.facecolor": "white",
}


@dataclass(frozen=True)
class Key:
    """What a drawn map needs around it.

    Attributes:
        title, subtitle: the two lines above it.
        scale: what the colour bar shows; label: its meaning; ticks: where it is labelled (None: its own choice).
        tick_labels: the words at `ticks`.
        handles: the legend's entries. lines: short texts to list below the legend.
    """

    title: str
    subtitle: str
    scale: ScalarMappable
    label: str
    ticks: NDArray[np.float64] | None = None
    tick_labels: tuple[str, ...] = ()
    handles: tuple[Artist, ...] = ()
    lines: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class ThreatScale:
    """The colour of every chance to be stopped, on one map: the same p, the same colour, in pictures and on the page.

    The map's levels are evenly apart on the scale, p = 0 at its start; between two levels it is linear in p.

    Attributes:
        norm: p to 0..1. colours: 0..1 to a colour, in SHADES steps. at_levels: the levels' own colours, RGBA.
    """

    norm: FuncNorm
    colours: LinearSegmentedColormap
    at_levels: tuple[tuple[float, float, float, float], ...]


def threat_scale(levels: NDArray[np.float64], top: float) -> ThreatScale:
    """The scale of a map with the levels `levels` `[L]` (increasing, `levels[0] = 0`) whose largest p is `top`."""
    number = len(levels) - 1
    shown = [SAFE, *(THREAT(x) for x in np.linspace(0, 1, max(2, number))[:number])]
    if number == 1:
        shown[1] = THREAT(0.5)
    places = np.linspace(0, 1, max(2, number + 1))
    knots = np.append(levels[:-1], max(top, float(levels[-1]))) if number else np.array([0.0, 1.0])
    colours = list(zip(places, shown if number else [SAFE, SAFE], strict=True))
    scale = LinearSegmentedColormap.from_list("threat", colours, N=SHADES)
    norm = FuncNorm((lambda p: np.interp(p, knots, places), lambda x: np.interp(x, places, knots)), 0.0, knots[-1])
    at = levels if number else levels[:1]
    return ThreatScale(norm, scale, tuple(to_rgba(scale(float(norm(p)))) for p in at))


@dataclass(frozen=True)
class MapLayout:
    """A figure for a map, in inches from its lower-left corner: rectangles are (left, bottom, width, height).

    Attributes:
        size: of the figure. map_box, bar_box: the map's axes and the colour bar's.
        legend, lines: upper-left corners of the legend and of the listed lines (None: below the legend).
        columns: of the legend; more than one if the key lies below the map, one if it stands beside it.
    """

    size: tuple[float, float]
    map_box: tuple[float, float, float, float]
    bar_box: tuple[float, float, float, float]
    legend: tuple[float, float]
    lines: tuple[float, float] | None = None
    columns: int = 1


def map_layout(shape: tuple[int, int], entries: int, metres: bool = False) -> MapLayout:
    """The layout for a map of `shape`: a wide one takes the whole width, any other leaves room for its key beside it.

    `entries`: of the legend. metres: with room for axes in metres below the map and at its right.
    """
    height, width = shape
    left, right, top, bottom = 0.62, 0.25, 0.78, 0.55
    beside = 0.55 if metres else 0.0
    right, bottom = right + beside, bottom + (0.42 if metres else 0.0)
    if width > 1.5 * height:
        cell, columns = min((WIDTH - left - right) / width, 1.1), 6
        rows = -(-entries // columns)
        below = 1.0 + max(0.2 * rows, 0.45)
        size = (WIDTH, top + cell * height + bottom + below)
        map_box = (left, bottom + below, cell * width, cell * height)
        bar_box = (left, below - 0.2, 4.3, 0.14)
        return MapLayout(size, map_box, bar_box, (left, below - 0.85), (left + 4.8, below - 0.06), columns)
    cell = min((WIDTH - left - right - 2.25) / width, 7.6 / height, 1.1)
    inner = max(cell * height, 3.3)
    bar = min(inner, 5.2)
    map_box = (left, bottom + inner - cell * height, cell * width, cell * height)
    bar_box = (left + cell * width + 0.25 + beside, bottom + inner - bar, 0.14, bar)
    return MapLayout((WIDTH, top + inner + bottom), map_box, bar_box, (bar_box[0] + 0.95, bottom + inner))


def inches(figure: Figure, box: Sequence[float]) -> tuple[float, float, float, float]:
    """A rectangle in inches as fractions of the figure."""
    width, height = figure.get_size_inches()
    return (box[0] / width, box[1] / height, box[2] / width, box[3] / height)


def heading(axes: Axes, title: str, subtitle: str, left: float = 0.0) -> None:
    """Two lines above `axes`, flush with its left side or `left` inches to the right of it; long ones are smaller."""
    large, small = 13.0 * min(1.0, 62 / len(title)), 9.5 * min(1.0, 98 / len(subtitle))
    across = left * 72 / size_points(axes)[0]
    axes.set_title(title, loc="left", x=across, fontsize=large, fontweight="bold", color=INK, pad=25)
    axes.annotate(subtitle, (across, 1), (0, 9), "axes fraction", "offset points", fontsize=small, color=FAINT)


def map_axes(axes: Axes, shape: tuple[int, int], cell_size: float) -> None:
    """Row 0 at the top, equal aspect, whole numbers as ticks; metres are named where a cell is not one metre."""
    height, width = shape
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    unit = "" if cell_size == 1.0 else f"  (cells of {cell_size:g} m)"
    axes.set_xlabel(f"column{unit}")
    axes.set_ylabel("row")
    axes.xaxis.set_major_locator(cell_ticks(width))
    axes.yaxis.set_major_locator(cell_ticks(height))
    axes.tick_params(length=2.5, width=0.7)


def in_metres(cell_size: float, origin: Sequence[float]) -> bool:
    """Whether a map has a scale of its own: cells that are not 1 m, or a place in a frame."""
    return cell_size != 1.0 or any(value != 0 for value in origin)


def metre_axes(axes: Axes, shape: tuple[int, int], cell_size: float, origin: Sequence[float]) -> None:
    """A second pair of axes, below and at the right, in the metres of the map's frame (kilometres of a large map).

    Where the grid is turned in its frame, they count from its lower-left corner.
    """
    height, width = shape
    east, north = (origin[0], origin[1]) if origin[2] == 0 else (0.0, 0.0)
    ends = (east, east + width * cell_size, north, north + height * cell_size)
    unit, metres = ("km", 1000.0) if max(map(abs, ends)) >= 10_000 else ("m", 1.0)
    of = " from the corner" if origin[2] != 0 else ""

    def to_x(col: ArrayLike) -> ArrayLike:
        return (east + (np.asarray(col) + 0.5) * cell_size) / metres

    def to_col(x: ArrayLike) -> ArrayLike:
        return (np.asarray(x) * metres - east) / cell_size - 0.5

    def to_y(row: ArrayLike) -> ArrayLike:
        return (north + (height - np.asarray(row) - 0.5) * cell_size) / metres

    def to_row(y: ArrayLike) -> ArrayLike:
        return height - 0.5 - (np.asarray(y) * metres - north) / cell_size

    wide, high = size_points(axes)
    below = axes.secondary_xaxis(-36 / high, functions=(to_x, to_col))
    beside = axes.secondary_yaxis("right", functions=(to_y, to_row))
    for axis, points in ((below.xaxis, wide), (beside.yaxis, high)):
        axis.set_major_locator(MaxNLocator(nbins=int(np.clip(points / 45, 1, 6)), steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value + 0.0:,.6g}"))
    below.set_xlabel(f"x, {unit}{of}", labelpad=1)
    beside.set_ylabel(f"y, {unit}{of}", labelpad=2)
    for second in (below, beside):
        second.tick_params(length=2.5, width=0.7)


def plain(axes: Axes) -> None:
    """No frame on the right and on top, small ticks, the grid behind."""
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(length=2.5, width=0.7, labelcolor=INK, color=FAINT)


def root_figure(axes: Axes) -> Figure:
    """The figure that `axes` is drawn on."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("these axes are on no figure")
    return figure


def size_points(axes: Axes) -> tuple[float, float]:
    """Width and height of `axes` in points (1/72 inch)."""
    box = axes.get_position()
    width, height = root_figure(axes).get_size_inches()
    return float(box.width * width * 72), float(box.height * height * 72)


def cell_points(axes: Axes, shape: tuple[int, int]) -> float:
    """Side of a cell on `axes` in points."""
    width, height = size_points(axes)
    return min(width / shape[1], height / shape[0])


def cell_ticks(cells: int) -> Locator:
    """Ticks at rows or columns: every one of a few, some of many."""
    return FixedLocator(range(cells)) if cells <= 8 else whole_ticks(8)


def whole_ticks(most: int) -> Locator:
    """Ticks at whole numbers in steps of 1, 2 or 5 times a power of ten."""
    return MaxNLocator(nbins=most, steps=[1, 2, 5, 10], integer=True)


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib's defaults with the house's settings, whatever the user's own are; restored at the end."""
    with style.context(["default", RC]):
        yield


class Picture(Figure):
    """A figure that shows itself in a notebook: IPython learns of others through pyplot, which is not used here."""

    def _repr_png_(self) -> bytes:
        with house_style():
            return png_bytes(self)


def new_figure(size: tuple[float, float], dpi: int = DPI) -> Picture:
    """A figure of `size` inches on an Agg canvas."""
    figure = Picture(figsize=size, dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def png_of(draw: Callable[..., Figure], *what: object) -> bytes:
    """What `draw(*what)` makes, in the house's style, as PNG; the same arguments give the same bytes."""
    with house_style():
        return png_bytes(draw(*what))


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG, with its titles as its description; the same figure gives the same bytes (no date)."""
    out, titles = io.BytesIO(), [axes.get_title("left").replace("\n", " ") for axes in figure.axes]
    described = visible("; ".join(filter(None, titles)))
    figure.savefig(out, format="png", dpi=figure.dpi, metadata={"Software": None, "Description": described})
    return out.getvalue()


def robot_style(robot: int) -> tuple[str, LineStyle]:
    """(colour, line style) of a robot; after eight colours the next line style."""
    turn, colour = divmod(robot, len(ROBOT_COLOURS))
    return ROBOT_COLOURS[colour], LINE_STYLES[turn % len(LINE_STYLES)]
