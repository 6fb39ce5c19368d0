"""A map as a picture: cells by value, obstacles and what is out of reach, with its heading, scale and legend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
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
    Look,
    MapLayout,
    ThreatScale,
    cell_points,
    heading,
    in_metres,
    inches,
    map_axes,
    map_layout,
    metre_axes,
    new_figure,
    robot_style,
    root_figure,
    threat_scale,
)
from planner.formatting import chance, counted
from planner.ids import NO_AREA
from planner.plan.plan import Plan
from planner.world.levels import ThreatLevels, find_levels
from planner.world.world import World

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


# Robots on a map: lanes of their paths, labels of those that start together.

MOST_LEVELS = 16
"""Levels shown of another planner's plan, which names none (the planner's own default)."""


MOST_LABELS = 10
"""Robots with an entry of their own in the legend."""


LABEL_HEIGHT = 13.0
"""Of the markers at the starts, in points."""


def lane(robot: int, robots: int) -> float:
    """How far right and down of the cells' centres a robot's path is drawn, so that shared corridors can be read."""
    return 0.62 * ((robot + 0.5) / robots - 0.5)


@dataclass(frozen=True)
class Label:
    """A marker for several cells: their numbers, its text ("3", "0-15", "9 robots") and its place (row, col)."""

    members: list[int]
    name: str
    place: tuple[float, float]


def robots_name(group: list[int]) -> str:
    """What several robots are called."""
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
    cells: NDArray[np.int64],
    shape: tuple[int, int],
    points: float,
    name_of: Callable[[list[int]], str] = robots_name,
) -> list[Label]:
    """Labels for `cells` `[M, 2]` that neither overlap nor leave a map of `shape`; `points`: the side of a cell.

    `name_of`: the text for a group of them. A cell joins the first group whose first cell is near; near grows until no
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
    """The world by threat level, and a plan's areas and nominal paths; `more`: words that end the second line."""
    entries = 1 if plan is None else min(len(plan.robots), LISTED_ROBOTS)
    figure, layout = map_figure(world, entries + 4)
    return with_key(figure, layout, _draw(figure.axes[0], world, plan, more))


def _draw(axes: Axes, world: World, plan: Plan | None, more: str) -> Key:
    starts = world.starts if plan is None else plan.starts
    accessible = world.free if starts is None else world.accessible(starts)
    settings = world.team.settings.get("levels") if plan is None else plan.settings and plan.settings.levels
    levels = find_levels(world, accessible, settings or MOST_LEVELS)
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
            "chance that one visit stops the robot"
            if plan is None or plan.bearing.is_even
            else "p, the dose of a visit"
        )
        + (" (level's mean)" if levels.quantised else ""),
        handles=(*_handles(plan, starts), *terrain_handles(world, accessible)),
        **level_scale(levels.values, known),
    )


def level_scale(levels: NDArray[np.float64], known: ThreatScale) -> Look:
    """The scale of a `Key` for a map's levels `[L]`, in steps, with its ticks and their words."""
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
    """The borders of its areas and its paths; `points`: side of a cell."""
    if plan.areas and points >= SMALLEST:
        draw_borders(axes, _area_numbers(plan), "#6b5b52", min(0.8, 0.06 * points), alpha=0.75)
    for robot in range(len(plan.robots)):
        _draw_path(axes, plan, robot, points)


def _how_long(world: World, plan: Plan | None) -> str:
    if plan is None:
        return ""
    return f"; {plan.origin + ', ' if plan.is_foreign else ''}makespan {world.pace.steps(plan.makespan)}"


def _area_numbers(plan: Plan) -> NDArray[np.int64]:
    """The area of every cell, int64 `[H, W]`; NO_AREA where there is none."""
    numbers = np.full(plan.shape[0] * plan.shape[1], NO_AREA, dtype=np.int64)
    for number, area in enumerate(plan.areas):
        numbers[area.cells] = number
    return numbers.reshape(plan.shape)


def _draw_path(axes: Axes, plan: Plan, robot: int, points: float) -> None:
    colour, dashes = robot_style(robot)
    robots = len(plan.robots)
    shift = lane(robot, robots)
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    width = float(np.clip(0.62 * points / max(robots, 3), 0.45, 1.9))
    x, y = cols + shift, rows + shift
    axes.plot(x, y, color=colour, linestyle=dashes, linewidth=width, alpha=0.95, gid=f"robot {robot}", zorder=2)
    size = float(np.clip(0.28 * points, 2.6, 6.0))
    axes.plot(x[-1:], y[-1:], "s", color=colour, markersize=size, markeredgecolor="white", mew=0.5, zorder=2.5)


def mark_starts(axes: Axes, starts: NDArray[np.int64], shape: tuple[int, int], points: float) -> None:
    """Numbered markers at the starts `[K, 2]`; robots that start too close together to be told apart share one."""
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
    """What `mark_starts` drew, in the legend."""
    label = "start" if len(starts) == 1 else "start, by robot"
    return Line2D([], [], color=INK, marker="o", linestyle="", markersize=7, markeredgecolor="white", label=label)
