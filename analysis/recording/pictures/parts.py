"""The parts of a rollout's picture that stand still, where they lie, and its words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from analysis.pictures.maps import cell_colours, draw_key
from analysis.pictures.plans import level_scale
from analysis.pictures.robots import MOST_LEVELS
from analysis.pictures.style import (
    FAINT,
    FOG,
    GRID,
    INK,
    OBSTACLE,
    SAFE,
    WIDTH,
    Key,
    Look,
    map_axes,
    plain,
    root_figure,
    threat_scale,
    whole_ticks,
)
from analysis.recording.frames import Frames
from planner.plans.plan import Plan
from planner.worlds.levels import levels_of_maps
from planner.worlds.world import World

NOBODY = SAFE
BEFORE = "#c3c7cc"
LOST = "#b3263a"
FOG_ALPHA = 0.8
MOVER = "#e2264d"
VISITED, SURVIVED = "#2f62a6", "#7fb2d9"
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Boxes:
    """Where things lie, in inches from the figure's lower-left corner.

    Attributes:
        size: of the figure. axes: (left, bottom, width, height) of the threat map, the areas' map and the curve.
        bar: of the threat's colour bar. legend: upper-left corner of the areas' legend. events: of the events' list.
    """

    size: tuple[float, float]
    axes: tuple[Box, Box, Box]
    bar: Box
    legend: tuple[float, float]
    events: tuple[float, float]


def boxes_for(shape: tuple[int, int]) -> Boxes:
    """Two maps of `shape` side by side, wide ones one above the other; the curve and the events below them."""
    height, width = shape
    left, right, top, gap = 0.62, 0.2, 0.9, 0.6
    curve = (left, 0.5, 4.3, 1.3)
    events = (left + curve[2] + 0.3, curve[1] + curve[3])
    bar = (left, 2.35, 2.6, 0.11)
    base = 3.1
    if width > 2.2 * height:
        cell = (WIDTH - left - right) / width
        tall = cell * height
        areas = (left, base, cell * width, tall)
        threat = (left, base + tall + gap, cell * width, tall)
    else:
        room = (WIDTH - left - right - gap) / 2
        cell = min(room / width, 5.0 / height)
        tall = cell * height
        threat = (left, base, cell * width, tall)
        areas = (left + room + gap, base, cell * width, tall)
    size = (WIDTH, threat[1] + tall + top)
    return Boxes(size, (threat, areas, curve), bar, (left + 3.0, bar[1] + 0.16), events)


def draw_threat(
    axes: Axes, boxes: Boxes, world: World, plan: Plan, has_areas: bool, *, fog: bool = False
) -> tuple[AxesImage, list[NDArray[np.float64]]]:
    """The world by threat, its colour bar, and the legend of both maps; `fog`: not all of it is seen at once.

    The image, and the colours that it has in each phase.
    """
    accessible = world.accessible(plan.starts)
    maps = world.threat[None] if world.phases is None else world.phases.threats
    most = plan.settings.levels if plan.settings else MOST_LEVELS
    levels, _, _ = levels_of_maps(maps.reshape(len(maps), -1), accessible.ravel(), most)
    threats = np.nan_to_num(maps.astype(np.float64))
    known = threat_scale(levels, float(threats[:, accessible].max(initial=0.0)))
    paint = ScalarMappable(known.norm, known.colours)
    painted = [cell_colours(world, accessible, paint.to_rgba(threat)) for threat in threats]
    image = axes.imshow(painted[0], interpolation="nearest", zorder=0)
    map_frame(axes, world, "threat, and the paths driven")
    label, handles = (
        "chance that one visit stops the robot",
        _area_handles(has_areas, plan.state is not None, fog, world.movers is not None),
    )
    key = Key("", "", label=label, handles=handles, **level_scale(levels, known))
    draw_key(root_figure(axes), boxes.bar, boxes.legend, 2, key)
    return image, painted


def _area_handles(has_areas: bool, before: bool, fog: bool, movers: bool) -> tuple[Patch | Line2D, ...]:
    """The legend of the areas' map, whose cells are painted step by step. `before`: some were covered."""
    hue = np.array([to_rgba("#0072b2")[:3]])
    entries = [(tint(hue, 0.62)[0], "covered, in the robot's colour")]
    if has_areas:
        entries += [(tint(hue, 0.3)[0], "still to do, that robot's")]
    if before:
        entries += [(to_rgba(BEFORE)[:3], "covered before")]
    entries += [(NOBODY, "still to do, nobody's" if has_areas else "still to do"), (OBSTACLE, "obstacle")]
    entries += [(to_rgb(FOG), "seen by nobody yet")] if fog else []
    patches = [Patch(facecolor=colour, edgecolor=FAINT, linewidth=0.4, label=label) for colour, label in entries]
    look: Look = {"linestyle": "", "marker": "D", "markersize": 5, "markeredgecolor": "white"}
    return (*patches, *([Line2D([], [], color=MOVER, label="threat that moves", **look)] if movers else []))


def draw_fog(axes: Axes, shape: tuple[int, int]) -> AxesImage:
    """A dark sheet over a map, whose alpha is set cell by cell."""
    sheet = np.full((*shape, 3), to_rgb(FOG))
    return axes.imshow(sheet, interpolation="nearest", zorder=1, alpha=np.full(shape, FOG_ALPHA))


def draw_movers(axes: Axes, points: float) -> PathCollection:
    """Threats that move, nowhere yet; `points`: of a cell."""
    size = float(np.clip(0.7 * points, 3.0, 9.0))
    return axes.scatter([], [], s=size**2, marker="D", color=MOVER, edgecolors="white", linewidths=0.5, zorder=3.5)


def draw_coverage(axes: Axes, frames: Frames, total: int) -> list[Line2D]:
    """The axes of coverage over time, and its lines, visited and survived, still empty."""
    last = max(1, frames.trace.time)
    axes.set(xlim=(0, last * 1.02), ylim=(0, 1.1))
    axes.set_xlabel("step", fontsize=8)
    axes.set_ylabel("cells covered", fontsize=8)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    axes.xaxis.set_major_locator(whole_ticks(8))
    axes.grid(color=GRID, linewidth=0.6)
    plain(axes)
    axes.tick_params(labelsize=7.5)
    lines = []
    for colour, label, dashes in ((VISITED, "visited", "-"), (SURVIVED, "survived", (0, (4, 1.5)))):
        (line,) = axes.plot([], [], color=colour, linestyle=dashes, linewidth=1.7, label=label, zorder=3)
        lines.append(line)
    axes.legend(loc="lower right", fontsize=7.5, ncols=2, handlelength=1.8, columnspacing=1.2)
    return lines


def map_frame(axes: Axes, world: World, title: str) -> None:
    """The axes of a map, and what it shows."""
    map_axes(axes, world.shape, world.cell_size)
    axes.set_title(title, loc="left", fontsize=9, color=INK, pad=4)


def tint(colours: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """`colours` `[..., 3]` mixed with white; `share` of the colour."""
    return 1.0 - share * (1.0 - colours)
