"""Utilities for matplotlib: colours, headings and layout, and a map as a picture."""

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
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, Colormap, FuncNorm, LinearSegmentedColormap, ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, Locator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from planner.errors import visible
from planner.formatting import chance, counted
from planner.plan.plan import Plan
from planner.simulator.codes import NO_AREA
from planner.world.levels import ThreatLevels, find_levels
from planner.world.world import World

# Style of pictures: colours, the layout of a figure for a map's shape, headings, and formats of numbers.
#
# Only matplotlib's object interface: neither this module nor its users touch pyplot or its global state.

LineStyle: TypeAlias = str | tuple[int, tuple[float, ...]]
"""A name, or (offset, lengths of dashes and gaps)."""
Look: TypeAlias = dict[str, Any]
"""Keyword arguments of a matplotlib drawing function."""
WIDTH = 8.0
"""Width of every figure in inches."""
DPI = 150
"""Pixels an inch: 1,200 pixels a figure."""
FINE_DPI = 225
"""Pixels an inch for maps with a side above FINE_FROM cells, so that a cell keeps a few pixels."""
FINE_FROM = 100

INK, FAINT, GRID = "#20242b", "#5b6470", "#d9dce1"
PICK = "#b3263a"
"""What stands out: a selected point, an outlined cell."""
OBSTACLE, UNREACHABLE, SAFE, FOG = "#3d434c", "#dfe5ee", "#fcfbf8", "#4a4560"
ROBOT_COLOURS = ("#0072b2", "#00916a", "#7a2fa0", "#111111", "#2fa8e6", "#8a7f00", "#d6409f", "#7a4a24")
"""Eight colours that colour-blind readers can distinguish, also on the reds of the threat scale."""
LINE_STYLES: tuple[LineStyle, ...] = ("-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
HALO = [withStroke(linewidth=1.8, foreground="white")]
"""Keeps small text readable on any cell."""
SHADES = 250
"""Steps of a colour scale, the same in pictures and on pages."""
THREAT = LinearSegmentedColormap.from_list("threat", ["#fde6d3", "#fac79f", "#f19c74", "#e0705a", "#c5464a"])
COVERED = LinearSegmentedColormap.from_list("covered", ["#fff8dc", "#d3ecb9", "#85cdb9", "#3f9fbe", "#2f62a6"])
LOSSES = LinearSegmentedColormap.from_list("losses", ["#fcfbf8", "#fbd3a5", "#f08a55", "#c93a3c", "#7a1237"])
SCALES: dict[str, Colormap] = {"threat": THREAT, "covered": COVERED, "losses": LOSSES}
"""Colour scales by the names that layers of cells give."""

RC = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.parse_math": False,  # a `$` in a user's text is not a formula
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
    """Elements around a drawn map.

    Attributes:
        title, subtitle: the two lines above it.
        scale: of the colour bar; label: its meaning; ticks: its labelled positions (None: automatic).
        tick_labels: the labels at `ticks`.
        handles: the legend's entries. lines: short texts below the legend.
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
    """The colour of every p on one map: equal p have equal colours, in pictures and on the page.

    The map's levels are evenly spaced on the scale, p = 0 at its start; between two levels it is linear in p.

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
        columns: of the legend; more than one if the key lies below the map, one if it is next to it.
    """

    size: tuple[float, float]
    map_box: tuple[float, float, float, float]
    bar_box: tuple[float, float, float, float]
    legend: tuple[float, float]
    lines: tuple[float, float] | None = None
    columns: int = 1


def map_layout(shape: tuple[int, int], entries: int, metres: bool = False) -> MapLayout:
    """The layout for a map of `shape`: a wide map takes the whole width, any other leaves room for its key at the side.

    `entries`: of the legend. metres: leave room for axes in metres below the map and at its right.
    """
    height, width = shape
    left, right, top, bottom = 0.62, 0.25, 0.78, 0.55
    beside = 0.55 if metres else 0.0
    right, bottom = right + beside, bottom + (0.42 if metres else 0.0)
    # A wide map takes the whole width, with its key below.
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


def heading(axes: Axes, title: str, subtitle: str) -> None:
    """Two lines above `axes`, at its left side; long ones are smaller."""
    large, small = 13.0 * min(1.0, 62 / len(title)), 9.5 * min(1.0, 98 / len(subtitle))
    axes.set_title(title, loc="left", fontsize=large, fontweight="bold", color=INK, pad=25)
    axes.annotate(subtitle, (0, 1), (0, 9), "axes fraction", "offset points", fontsize=small, color=FAINT)


def map_axes(axes: Axes, shape: tuple[int, int], cell_size: float) -> None:
    """Row 0 at the top, equal aspect, integer ticks; the cell size is named unless it is one metre."""
    height, width = shape
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    unit = "" if cell_size == 1.0 else f"  (cells of {cell_size:g} m)"
    axes.set_xlabel(f"column{unit}")
    axes.set_ylabel("row")
    axes.xaxis.set_major_locator(cell_ticks(width))
    axes.yaxis.set_major_locator(cell_ticks(height))
    axes.tick_params(length=2.5, width=0.7)


def in_metres(cell_size: float, origin: Sequence[float]) -> bool:
    """Whether a map has a metric scale: cells that are not 1 m, or an origin in a frame."""
    return cell_size != 1.0 or any(value != 0 for value in origin)


def metre_axes(axes: Axes, shape: tuple[int, int], cell_size: float, origin: Sequence[float]) -> None:
    """A second pair of axes, below and at the right, in the metres of the map's frame (kilometres for a large map).

    If the grid is rotated in its frame, they count from its lower-left corner.
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
    """The figure that contains `axes`."""
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
    """Ticks at rows or columns: all of a few, some of many."""
    return FixedLocator(range(cells)) if cells <= 8 else whole_ticks(8)


def whole_ticks(most: int) -> Locator:
    """Ticks at whole numbers in steps of 1, 2 or 5 times a power of ten."""
    return MaxNLocator(nbins=most, steps=[1, 2, 5, 10], integer=True)


@contextmanager
def picture_style() -> Iterator[None]:
    """Matplotlib's defaults with the settings of this package, restored at the end; the user's are ignored."""
    with style.context(["default", RC]):
        yield


class Picture(Figure):
    """A figure that displays in a notebook; IPython finds other figures through pyplot, which is not used here."""

    def _repr_png_(self) -> bytes:
        with picture_style():
            return png_bytes(self)


def new_figure(size: tuple[float, float], dpi: int = DPI) -> Picture:
    """A figure of `size` inches on an Agg canvas."""
    figure = Picture(figsize=size, dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def png_of(draw: Callable[..., Figure], *given: object) -> bytes:
    """The figure `draw(*given)` as PNG, in the style of this package; equal arguments give equal bytes."""
    with picture_style():
        return png_bytes(draw(*given))


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG, with its titles as its description; equal figures give equal bytes (no date)."""
    out, titles = io.BytesIO(), [axes.get_title("left").replace("\n", " ") for axes in figure.axes]
    described = visible("; ".join(filter(None, titles)))
    figure.savefig(out, format="png", dpi=figure.dpi, metadata={"Software": None, "Description": described})
    return out.getvalue()


def robot_style(robot: int) -> tuple[str, LineStyle]:
    """(colour, line style) of a robot; after eight colours the next line style."""
    turn, colour = divmod(robot, len(ROBOT_COLOURS))
    return ROBOT_COLOURS[colour], LINE_STYLES[turn % len(LINE_STYLES)]


# A map as a picture: cells by value, obstacles and unreachable cells, with heading, scale and legend.

SMALLEST = 0.5
"""Smallest cells, in points, with outlines and hatching, which would hide smaller ones."""
HATCH = "/" * 5


def map_figure(world: World, entries: int = 4) -> tuple[Figure, MapLayout]:
    """An empty figure for the map and a legend of `entries`; its first Axes is the map's."""
    layout = map_layout(world.shape, entries, in_metres(world.cell_size, world.origin))
    figure = new_figure(layout.size, FINE_DPI if max(world.shape) > FINE_FROM else DPI)
    figure.add_axes(inches(figure, layout.map_box))
    return figure, layout


def with_key(figure: Figure, layout: MapLayout, key: Key) -> Figure:
    """Add heading, colour bar, legend and lines around the map."""
    heading(figure.axes[0], key.title, key.subtitle)
    legend = draw_key(figure, layout.bar_box, layout.legend, layout.columns, key)
    if key.lines:
        under = layout.legend[1] - legend.get_window_extent().height / figure.dpi - 0.2
        across, up = layout.lines or (layout.legend[0], under)
        width, height = layout.size
        figure.text(across / width, up / height, "\n".join(key.lines), va="top", fontsize=8.5, linespacing=1.5)
    return figure


def draw_key(figure: Figure, box: Sequence[float], place: Sequence[float], columns: int, key: Key) -> Legend:
    """The colour bar in a rectangle, horizontal if the legend has several columns; the legend's corner is at `place`.

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
        bar.ax.yaxis.set_label_position("left")  # at the right it would overlap the legend
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
    """Draw the cells as one image, with their axes."""
    pixels = cell_points(axes, world.shape) / 72 * root_figure(axes).dpi
    image = cell_colours(world, accessible, scale.to_rgba(np.where(accessible, values, 0)))
    axes.imshow(image, interpolation="nearest" if pixels >= 1 else "auto", zorder=0)
    map_axes(axes, world.shape, world.cell_size)
    if in_metres(world.cell_size, world.origin):
        metre_axes(axes, world.shape, world.cell_size, world.origin)
    hatch(axes, world.free & ~accessible)


def cell_colours(world: World, accessible: NDArray[np.bool_], colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """RGBA `[H, W, 4]` of every cell; obstacles and unreachable cells have separate colours."""
    reached = np.where(accessible[..., None], colours, to_rgba(UNREACHABLE))
    return np.where(world.free[..., None], reached, to_rgba(OBSTACLE))


def hatch(axes: Axes, mask: NDArray[np.bool_]) -> None:
    """Hatch the cells of `mask` `[H, W]`: runs along the rows, all in one patch."""
    if not mask.any() or cell_points(axes, mask.shape) < SMALLEST:
        return
    steps = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    # One patch of all runs is much faster than a patch for each cell.
    rows, begins = np.nonzero(steps == 1)
    ends = np.nonzero(steps == -1)[1]
    left, right, top, bottom = begins - 0.5, ends - 0.5, rows - 0.5, rows + 0.5
    corners = np.stack([left, top, right, top, right, bottom, left, bottom, left, top], axis=1).reshape(-1, 2)
    codes = np.tile([Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY], len(rows))
    patch = PathPatch(Outline(corners, codes), facecolor="none", edgecolor="#9aa7ba", linewidth=0, hatch=HATCH)
    axes.add_patch(patch)


def draw_borders(axes: Axes, labels: NDArray[np.int64], colour: str, width: float, alpha: float) -> None:
    """Thin lines along the cell sides between different `labels` `[H, W]`; -1 has no border."""
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


# Robots on a map: shifts of their paths, labels of robots that start together.

MOST_LEVELS = 16
"""Levels shown for an external plan, which names none (the planner's own default)."""


MOST_LABELS = 10
"""Most labels on a scale of levels."""


LABEL_HEIGHT = 13.0
"""Height of the markers at the starts, in points."""


def lane(robot: int, robots: int) -> float:
    """Shift of a robot's path to the right and down, in cells, so that paths in shared corridors stay distinct."""
    return 0.62 * ((robot + 0.5) / robots - 0.5)


@dataclass(frozen=True)
class Label:
    """A marker for several cells: their numbers, its text ("3", "0-15", "9 robots") and its place (row, col)."""

    members: list[int]
    name: str
    place: tuple[float, float]


def robots_name(group: list[int]) -> str:
    """The label of several robots."""
    text = ranges(group)
    return text if len(text) <= 9 else f"{len(group)} robots"


def ranges(numbers: list[int]) -> str:
    """Increasing numbers as "0-3,7"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], number]
        else:
            runs.append([number])
    return ",".join("-".join(map(str, run)) for run in runs)


def group_labels(
    cells: NDArray[np.int64], shape: tuple[int, int], points: float, name_of: Callable[[list[int]], str] = robots_name
) -> list[Label]:
    """Labels for `cells` `[M, 2]` that neither overlap nor leave a map of `shape`; `points`: the side of a cell.

    `name_of`: the text for a group. A cell joins the first group whose first cell is near; the distance grows until no
    two labels overlap.
    """
    reach = LABEL_HEIGHT / points
    while True:
        groups = _near_groups(cells, reach)
        names = [name_of(group) for group in groups]
        size = np.array([(LABEL_HEIGHT, label_width(name)) for name in names]) / points
        room = np.maximum(size / 2, 0.5) - 0.5
        places = np.minimum(np.maximum(cells[[group[0] for group in groups]], room), np.subtract(shape, 1) - room)
        gap = np.abs(places[:, None] - places[None, :])
        if (gap < (size[:, None] + size[None, :]) / 2).all(axis=-1).sum() == len(groups):
            where = ((float(row), float(col)) for row, col in places)
            return [Label(*label) for label in zip(groups, names, where, strict=True)]
        # Larger groups, until no two labels overlap.
        reach *= 1.4


def _near_groups(cells: NDArray[np.int64], reach: float) -> list[list[int]]:
    groups: list[list[int]] = []
    for number, cell in enumerate(cells):
        near = (g for g in groups if np.abs(cells[g[0]] - cell).max() < reach)
        group = next(near, None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return groups


def label_width(text: str) -> float:
    """Width of a marker with `text` in points, its frame included."""
    return max(LABEL_HEIGHT, 4.8 * len(text) + 6.0)


# A world and a plan on it: cells by threat level, the areas' borders, every robot's nominal path and start.

LISTED_ROBOTS = 16


def plan_figure(world: World, plan: Plan | None = None, more: str = "") -> Figure:
    """The world by threat level, with a plan's areas and nominal paths; `more`: text at the end of the second line."""
    entries = 1 if plan is None else min(len(plan.robots), LISTED_ROBOTS)
    figure, layout = map_figure(world, entries + 4)
    return with_key(figure, layout, _draw(figure.axes[0], world, plan, more))


def _draw(axes: Axes, world: World, plan: Plan | None, more: str) -> Key:
    starts = world.starts if plan is None else plan.starts
    accessible = world.free if starts is None else world.accessible(starts)
    settings = world.team.settings.get("levels") if plan is None else plan.settings and plan.settings.levels
    levels = find_levels(world.threat, accessible, settings or MOST_LEVELS)
    threat = np.nan_to_num(world.threat.astype(np.float64))
    known = threat_scale(levels.values, float(threat[accessible].max(initial=0.0)))
    paint(axes, world, accessible, threat, ScalarMappable(known.norm, known.colours))
    points = cell_points(axes, world.shape)
    if plan is not None:
        _draw_plan(axes, plan, points)
    if starts is not None:
        mark_starts(axes, starts, world.shape, points)
    unreachable = int(world.free.sum() - accessible.sum())
    return Key(
        title=_title(plan, int(accessible.sum()), "free" if starts is None else "accessible", levels),
        subtitle=f"{world.shape[0]} x {world.shape[1]} map{_how_long(world, plan)}"
        + (f"; {counted(unreachable, 'free cell')} out of reach" if unreachable else "")
        + more,
        label=(
            "chance that one visit destroys the robot"
            if plan is None or plan.failure_model.is_even
            else "p, the dose of a visit"
        )
        + (" (level's mean)" if levels.quantised else ""),
        handles=(*_handles(plan, starts), *terrain_handles(world, accessible)),
        **level_scale(levels.values, known),
    )


def level_scale(levels: NDArray[np.float64], known: ThreatScale) -> Look:
    """The scale of a `Key` for a map's levels `[L]`, in steps, with its ticks and labels."""
    number = len(levels)
    every = -(-number // MOST_LABELS)
    labels = ["safe", *map(chance, levels[1:])]
    return {
        "scale": ScalarMappable(BoundaryNorm(np.arange(number + 1) - 0.5, number), ListedColormap(known.at_levels)),
        "ticks": np.arange(number, dtype=np.float64),
        "tick_labels": tuple(label if index % every == 0 else "" for index, label in enumerate(labels)),
    }


def _title(plan: Plan | None, cells: int, kind: str, levels: ThreatLevels) -> str:
    parts = [counted(cells, f"{kind} cell"), counted(len(levels.values), "threat level")]
    if plan is not None:
        parts.insert(0, counted(len(plan.robots), "robot"))
        parts += [counted(len(plan.areas), "area")] * bool(plan.areas)
    return ", ".join(parts)


def _draw_plan(axes: Axes, plan: Plan, points: float) -> None:
    """Draw the borders of its areas and its paths; `points`: side of a cell."""
    if plan.areas and points >= SMALLEST:
        draw_borders(axes, _area_numbers(plan), "#6b5b52", min(0.8, 0.06 * points), alpha=0.75)
    for robot in range(len(plan.robots)):
        _draw_path(axes, plan, robot, points)


def _how_long(world: World, plan: Plan | None) -> str:
    if plan is None:
        return ""
    return f"; {plan.origin + ', ' if plan.is_external else ''}makespan {world.pace.steps(plan.makespan)}"


def _area_numbers(plan: Plan) -> NDArray[np.int64]:
    """The area of every cell, int64 `[H, W]`; NO_AREA if there is none."""
    numbers = np.full(plan.shape[0] * plan.shape[1], NO_AREA, dtype=np.int64)
    for number, area in enumerate(plan.areas):
        numbers[area.cells] = number
    return numbers.reshape(plan.shape)


def _draw_path(axes: Axes, plan: Plan, robot: int, points: float) -> None:
    colour, dashes = robot_style(robot)
    robots = len(plan.robots)
    shift = lane(robot, robots)
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    # The more robots, the closer their lanes and the thinner their lines.
    width = float(np.clip(0.62 * points / max(robots, 3), 0.45, 1.9))
    x, y = cols + shift, rows + shift
    axes.plot(x, y, color=colour, linestyle=dashes, linewidth=width, alpha=0.95, gid=f"robot {robot}", zorder=2)
    size = float(np.clip(0.28 * points, 2.6, 6.0))
    axes.plot(x[-1:], y[-1:], "s", color=colour, markersize=size, markeredgecolor="white", mew=0.5, zorder=2.5)


def mark_starts(axes: Axes, starts: NDArray[np.int64], shape: tuple[int, int], points: float) -> None:
    """Numbered markers at the starts `[K, 2]`; robots that start too close together share one."""
    for label in group_labels(starts, shape, points):
        group, name, (row, col) = label.members, label.name, label.place
        box = {
            "boxstyle": "circle,pad=0.25" if len(name) == 1 else "round,pad=0.25",
            "facecolor": robot_style(group[0])[0] if len(group) == 1 else INK,
            "edgecolor": "white",
            "linewidth": 0.9,
        }
        font: Look = {"fontsize": 6.5, "fontweight": "bold", "color": "white"}
        axes.text(col, row, name, ha="center", va="center", bbox=box, zorder=4, **font)


def _handles(plan: Plan | None, starts: NDArray[np.int64] | None) -> Iterator[Artist]:
    """The legend's entries of paths, starts and ends."""
    robots = 0 if plan is None else len(plan.robots)
    for robot in range(robots if robots <= LISTED_ROBOTS else 0):
        colour, dashes = robot_style(robot)
        yield Line2D([], [], color=colour, linestyle=dashes, linewidth=1.8, label=f"robot {robot}")
    if robots > LISTED_ROBOTS:
        yield Line2D([], [], color=robot_style(0)[0], linewidth=1.8, label=f"{robots} paths")
    if starts is not None:
        yield start_handle(starts)
    if plan is not None:
        yield Line2D([], [], color=FAINT, marker="s", linestyle="", markersize=5, label="end of path")


def start_handle(starts: NDArray[np.int64]) -> Line2D:
    """The legend's entry of the start markers."""
    label = "start" if len(starts) == 1 else "start, by robot"
    return Line2D([], [], color=INK, marker="o", linestyle="", markersize=7, markeredgecolor="white", label=label)
