"""Picture of a rollout at a step: threat map and paths, coverage by robot, coverage over time, latest events.

Axis letters: `K` robots, `N = H * W` cells, `T` = time + 1 steps.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import KDTree

from analysis import pictures as style
from analysis.recording.frames import Frames, Held, event_line, make_frames, no_areas
from analysis.recording.viewers.topics import Stage
from planner.errors import UsageError
from planner.files import atomic_write
from planner.formatting import counted, percent
from planner.plan.plan import Plan
from planner.rollout_sampling import threat_paths
from planner.simulator.codes import NO_ROBOT, NO_STEP, EventKind
from planner.tally import Trace
from planner.world.levels import levels_of_maps
from planner.world.world import World

# The static parts of a rollout's picture: layout, legends and texts.

UNASSIGNED = style.SAFE
BEFORE = "#c3c7cc"
LOST = "#b3263a"
FOG_ALPHA = 0.8
MOVING = "#e2264d"
VISITED, SURVIVED = "#2f62a6", "#7fb2d9"
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Boxes:
    """Layout, in inches from the figure's lower-left corner.

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
    """Two maps of `shape` side by side, wide ones stacked; the curve and the events below them."""
    height, width = shape
    left, right, top, gap = 0.62, 0.2, 0.9, 0.6
    curve = (left, 0.5, 4.3, 1.3)
    events = (left + curve[2] + 0.3, curve[1] + curve[3])
    bar = (left, 2.35, 2.6, 0.11)
    base = 3.1
    # Wide maps side by side would have tiny cells.
    if width > 2.2 * height:
        cell = (style.WIDTH - left - right) / width
        tall = cell * height
        areas = (left, base, cell * width, tall)
        threat = (left, base + tall + gap, cell * width, tall)
    else:
        room = (style.WIDTH - left - right - gap) / 2
        cell = min(room / width, 5.0 / height)
        tall = cell * height
        threat = (left, base, cell * width, tall)
        areas = (left + room + gap, base, cell * width, tall)
    size = (style.WIDTH, threat[1] + tall + top)
    return Boxes(size, (threat, areas, curve), bar, (left + 3.0, bar[1] + 0.16), events)


def draw_threat(
    axes: Axes, boxes: Boxes, world: World, plan: Plan, has_areas: bool, *, fog: bool = False
) -> tuple[AxesImage, list[NDArray[np.float64]]]:
    """Draw the world by threat, its colour bar, and the legend of both maps; `fog`: parts of the map are unseen.

    Returns the image, and its colours in each phase.
    """
    accessible = world.accessible(plan.starts)
    maps = world.threat[None] if world.phases is None else world.phases.threats
    most = plan.settings.levels if plan.settings else style.MOST_LEVELS
    levels, _, _ = levels_of_maps(maps.reshape(len(maps), -1), accessible.ravel(), most)
    threats = np.nan_to_num(maps.astype(np.float64))
    known = style.threat_scale(levels, float(threats[:, accessible].max(initial=0.0)))
    paint = ScalarMappable(known.norm, known.colours)
    painted = [style.cell_colours(world, accessible, paint.to_rgba(threat)) for threat in threats]
    image = axes.imshow(painted[0], interpolation="nearest", zorder=0)
    map_frame(axes, world, "threat, and paths driven")
    label = "probability that one visit destroys the robot"
    handles = _area_handles(has_areas, plan.state is not None, fog, world.moving_threats is not None)
    key = style.Key("", "", label=label, handles=handles, **style.level_scale(levels, known))
    style.draw_key(style.root_figure(axes), boxes.bar, boxes.legend, 2, key)
    return image, painted


def _area_handles(has_areas: bool, before: bool, fog: bool, moving: bool) -> tuple[Patch | Line2D, ...]:
    """The legend of the areas' map, which is painted step by step. `before`: some cells were covered earlier."""
    hue = np.array([to_rgba("#0072b2")[:3]])
    entries = [(tint(hue, 0.62)[0], "covered, in the robot's colour")]
    if has_areas:
        entries += [(tint(hue, 0.3)[0], "assigned to that robot")]
    if before:
        entries += [(to_rgba(BEFORE)[:3], "covered before")]
    entries += [(UNASSIGNED, "unassigned" if has_areas else "not covered"), (style.OBSTACLE, "obstacle")]
    entries += [(to_rgb(style.FOG), "not seen yet")] if fog else []
    patches = [Patch(facecolor=colour, edgecolor=style.FAINT, linewidth=0.4, label=label) for colour, label in entries]
    look: style.Look = {"linestyle": "", "marker": "D", "markersize": 5, "markeredgecolor": "white"}
    return (*patches, *([Line2D([], [], color=MOVING, label="moving threat", **look)] if moving else []))


def draw_fog(axes: Axes, shape: tuple[int, int]) -> AxesImage:
    """A dark layer over a map; its alpha is set by cell."""
    sheet = np.full((*shape, 3), to_rgb(style.FOG))
    return axes.imshow(sheet, interpolation="nearest", zorder=1, alpha=np.full(shape, FOG_ALPHA))


def draw_moving_threats(axes: Axes, points: float) -> PathCollection:
    """Moving threats without positions; `points`: size of a cell."""
    size = float(np.clip(0.7 * points, 3.0, 9.0))
    return axes.scatter([], [], s=size**2, marker="D", color=MOVING, edgecolors="white", linewidths=0.5, zorder=3.5)


def draw_coverage(axes: Axes, frames: Frames, total: int) -> list[Line2D]:
    """Set up the axes of coverage over time, and return its empty lines, visited and survived."""
    last = max(1, frames.trace.time)
    axes.set(xlim=(0, last * 1.02), ylim=(0, 1.1))
    axes.set_xlabel("step", fontsize=8)
    axes.set_ylabel("cells covered", fontsize=8)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    axes.xaxis.set_major_locator(style.whole_ticks(8))
    axes.grid(color=style.GRID, linewidth=0.6)
    style.plain(axes)
    axes.tick_params(labelsize=7.5)
    lines = []
    for colour, label, dashes in ((VISITED, "visited", "-"), (SURVIVED, "survived", (0, (4, 1.5)))):
        (line,) = axes.plot([], [], color=colour, linestyle=dashes, linewidth=1.7, label=label, zorder=3)
        lines.append(line)
    axes.legend(loc="lower right", fontsize=7.5, ncols=2, handlelength=1.8, columnspacing=1.2)
    return lines


def map_frame(axes: Axes, world: World, title: str) -> None:
    """Set up the axes of a map, with its title."""
    style.map_axes(axes, world.shape, world.cell_size)
    axes.set_title(title, loc="left", fontsize=9, color=style.INK, pad=4)


def tint(colours: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """`colours` `[..., 3]` mixed with white; `share` of the colour."""
    return 1.0 - share * (1.0 - colours)


NUMBERED = 40
"""Robots up to which markers have numbers."""
LISTED_EVENTS = 8


class RolloutPicture:
    """A rollout drawn at increasing steps: `show(step)`, then `pixels()`, or `figure` for a file."""

    def __init__(self, trace: Trace, stage: Stage, dpi: int) -> None:
        """Draw the static parts, and step 0. For use within `analysis.pictures.picture_style()`.

        `dpi`: pixels per inch of the figure, which is `style.WIDTH` inches wide.
        """
        plan, self._found = stage.plan, stage.discovery(trace)
        world = stage.world
        if self._found is not None:  # draw the true map, behind the fog
            world = replace(world, threat=self._found.truth, knowledge=None, uncertainty=None)
        self._trace, self._plan, self._world, self._shape = trace, plan, world, world.shape
        self._frames = make_frames(trace, plan.state)
        self._accessible = world.accessible(plan.starts).ravel()
        self._free = world.free.ravel()
        self._maps, self._map = stage.area_maps(trace), no_areas(world.threat.size)
        self._next_map = next(self._maps, None)
        has_areas = self._next_map is not None
        self._events_at = self._frames.events_by_step()
        robots = trace.cells.shape[1]
        colours = np.array([to_rgb(style.robot_style(robot)[0]) for robot in range(robots)] + [to_rgb(UNASSIGNED)])
        self._covered, self._promised = tint(colours, 0.62), tint(colours, 0.3)
        self._promised[NO_ROBOT], self._covered[NO_ROBOT] = to_rgb(UNASSIGNED), to_rgb(BEFORE)

        boxes = boxes_for(world.shape)
        self.figure = style.new_figure(boxes.size, dpi)
        threat_axes, areas_axes, coverage = (self.figure.add_axes(style.inches(self.figure, box)) for box in boxes.axes)
        fog = self._found is not None
        self._ground, self._painted = draw_threat(threat_axes, boxes, world, plan, has_areas, fog=fog)
        map_frame(areas_axes, world, "coverage and areas by robot" if has_areas else "coverage by robot")
        self._image = areas_axes.imshow(self._area_colours(0), interpolation="nearest", zorder=0)
        points = style.cell_points(threat_axes, world.shape)
        self._fog = [draw_fog(axes, world.shape) for axes in (threat_axes, areas_axes) if self._found is not None]
        self._ways = threat_paths(stage.world, stage.seed, trace.rollout, len(trace.cells))
        self._threats = [draw_moving_threats(axes, points) for axes in (threat_axes, areas_axes) if self._ways.size]
        self._paths = [_path_line(threat_axes, robot, robots, points) for robot in range(robots)]
        self._markers = [_Markers(axes, robots, points) for axes in (threat_axes, areas_axes)]
        self._curves = draw_coverage(coverage, self._frames, int(self._accessible.sum()))
        (self._losses,) = coverage.plot([], [], "X", color=LOST, markersize=7, markeredgecolor="white", zorder=5)
        self._title, self._subtitle, self._lines = _texts(self.figure, boxes.size, boxes.events)
        self._canvas = FigureCanvasAgg(self.figure)
        self._background: Any = None
        self.show(0)

    def show(self, step: int) -> None:
        """Draw the end of `step`, 0 .. time; raises ValueError for a step before the shown one."""
        if not self._map.step <= step <= self._trace.time:
            raise ValueError(f"step {step} is before the shown step, or after the end at {self._trace.time}")
        while self._next_map is not None and self._next_map.step <= step:
            self._map, self._next_map = self._next_map, next(self._maps, None)
        self._image.set_data(self._area_colours(step))
        if self._world.phases is not None:
            self._ground.set_data(self._painted[self._world.phases.number_at(step)])
        if self._found is not None:
            for fog in self._fog:
                fog.set_alpha(np.where(self._found.seen(step), 0.0, FOG_ALPHA))
        for threats in self._threats:
            threats.set_offsets(np.stack(np.divmod(self._ways[step], self._shape[1])[::-1], axis=1))
        rows, cols = np.divmod(self._trace.cells[: step + 1], self._shape[1])
        for robot, line in enumerate(self._paths):
            shift = style.lane(robot, len(self._paths))
            line.set_data(cols[:, robot] + shift, rows[:, robot] + shift)
        for markers in self._markers:
            markers.move(rows[-1], cols[-1], self._frames.alive[step])
        steps, robots = np.arange(step + 1), len(self._paths)
        total = int(self._accessible.sum())
        for curve, cells in zip(self._curves, (self._frames.visited, self._frames.survived), strict=True):
            curve.set_data(steps, cells[: step + 1] / total)
        lost = np.flatnonzero(np.diff(self._frames.alive_count[: step + 1], prepend=robots))
        self._losses.set_data(lost, self._frames.visited[lost] / total)
        self._write(step)

    def pixels(self) -> NDArray[np.uint8]:
        """The picture, uint8 `[pixels down, pixels across, 3]`."""
        canvas = self._canvas
        if self._background is None:
            for artist in self._moving():
                # Blitting: the static parts are drawn once.
                artist.set_animated(True)
            canvas.draw()
            self._background = canvas.copy_from_bbox(self.figure.bbox)
        canvas.restore_region(self._background)
        for artist in self._moving():
            artist.axes.draw_artist(artist) if artist.axes is not None else self.figure.draw_artist(artist)
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

    def _moving(self) -> list[Any]:
        """The artists that `show` changes, bottom to top."""
        marks = [artist for markers in self._markers for artist in markers.artists]
        return [
            *([self._ground] if len(self._painted) > 1 else []),
            self._image, *self._fog, *self._paths, *self._threats, *marks, *self._curves, self._losses,
            self._title, self._subtitle, *self._lines,
        ]  # fmt: skip

    def _area_colours(self, step: int) -> NDArray[np.float64]:
        """The colour of every cell of the areas' map, float64 `[H, W, 3]`."""
        visited = (self._frames.visited_at != NO_STEP) & (self._frames.visited_at <= step)
        owner = np.where(self._map.held == Held.ASSIGNED, self._map.robot, NO_ROBOT)
        colours = self._promised[owner]
        colours[visited] = self._covered[self._frames.visited_by[visited]]
        colours[~self._accessible] = to_rgb(style.UNREACHABLE)
        colours[~self._free] = to_rgb(style.OBSTACLE)
        return colours.reshape(*self._shape, 3)

    def _write(self, step: int) -> None:
        trace, frames = self._trace, self._frames
        robots, total = len(self._paths), int(self._accessible.sum())
        ended = f": {self._plan.clause_of(trace.outcome)}" if step == trace.time else f" of {trace.time}"
        self._title.set_text(f"Rollout {trace.rollout}, step {step}{ended}{self._world.pace.also(step)}")
        visited = int(frames.visited[step])
        parts = [f"{percent(visited / total)} visited ({visited:,} of {counted(total, 'cell')})"]
        parts.append(f"{frames.alive_count[step]} of {counted(robots, 'robot')} alive")
        if self._map.open:
            parts.append(f"{counted(self._map.open, 'area')} unassigned")
        if self._found is not None:
            parts.append(f"{percent(self._found.seen(step).ravel()[self._accessible].mean())} seen")
        self._subtitle.set_text("; ".join(parts))
        events = trace.events[: self._events_at[step + 1]][-LISTED_EVENTS:]
        for line, event in zip(self._lines, events[::-1].tolist(), strict=False):
            lost = event[2] == EventKind.HIT
            colour = LOST if lost else style.INK if event[0] == step else style.FAINT
            text = f"{event[0]:>5}  {event_line(event, self._world).short}"
            line.set(text=text, color=colour, fontweight="bold" if lost else "normal")


def _path_line(axes: Axes, robot: int, robots: int, points: float) -> Line2D:
    colour, dashes = style.robot_style(robot)
    width = float(np.clip(0.7 * points / max(robots, 3), 0.5, 2.0))
    (line,) = axes.plot([], [], color=colour, linestyle=dashes, linewidth=width, zorder=2)
    return line


class _Markers:
    """The robots on a map: numbered discs in their colours, a cross for a lost robot."""

    def __init__(self, axes: Axes, robots: int, points: float) -> None:
        numbered = robots <= NUMBERED
        size = float(np.clip(0.9 * points, 9.0, 14.0) if numbered else np.clip(0.7 * points, 2.5, 8.0))
        self._colours = np.array([to_rgb(style.robot_style(robot)[0]) for robot in range(robots)])
        self._shifts = np.array([style.lane(robot, robots) for robot in range(robots)])
        edge: style.Look = {"edgecolors": "white", "linewidths": 0.9 if numbered else 0.4, "clip_on": False}
        self._alive = axes.scatter([], [], s=size**2, marker="o", zorder=4, **edge)
        self._lost = axes.scatter([], [], s=(0.95 * size) ** 2, marker="X", zorder=3, color=LOST, **edge)
        font: style.Look = {"fontsize": 0.56 * size, "fontweight": "bold", "ha": "center", "va": "center_baseline"}
        self._numbers = [axes.text(0, 0, str(robot), zorder=5, **font) for robot in range(robots if numbered else 0)]
        self._above = 0.95 * size / points if points else 1.0
        self.artists = [self._lost, self._alive, *self._numbers]

    def move(self, rows: NDArray[np.int64], cols: NDArray[np.int64], alive: NDArray[np.bool_]) -> None:
        """Move the robots to the cells `[K]`."""
        places = np.stack([cols, rows], axis=1) + self._shifts[:, None]
        self._alive.set_offsets(places[alive])
        self._alive.set_facecolor(self._colours[alive].tolist())
        self._lost.set_offsets(places[~alive])
        for robot, number in enumerate(self._numbers):
            across, down = places[robot]
            number.set_position((across, down if alive[robot] else down - self._above))
            number.set(color="white" if alive[robot] else LOST, path_effects=[] if alive[robot] else style.HALO)


def _texts(figure: Figure, size: tuple[float, float], events: tuple[float, float]) -> tuple[Text, Text, list[Text]]:
    """Title, subtitle, and the lines of the latest events, without text."""
    width, height = size
    left = 0.62 / width
    title = figure.text(left, 1 - 0.33 / height, "", fontsize=13, fontweight="bold", color=style.INK)
    subtitle = figure.text(left, 1 - 0.56 / height, "", fontsize=9.5, color=style.FAINT)
    across, top = events
    lines = [
        figure.text(across / width, (top - 0.155 * (row + 1)) / height, "", fontsize=7.6, va="baseline")
        for row in range(LISTED_EVENTS)
    ]
    return title, subtitle, lines


# Files for readers without a viewer: a PNG of one step, and an animated GIF of all steps.

MOST_FRAMES = 300
ANIMATION_DPI = 100
"""Pixels per inch of an animation: 800 across."""
PLAYING_SECONDS = 24.0
FASTEST, SLOWEST = 40, 250
"""Milliseconds per frame; browsers slow down faster animations."""
ON_LOSS, AT_END = 500, 3000
"""Milliseconds of a frame with a loss, and of the last one."""
COLOURS = 255
"""Colours of a GIF: of 256, one means "as in the frame before"."""


def picture_png(trace: Trace, stage: Stage, step: int | None = None) -> bytes:
    """The rollout at the end of `step` (None: its last) as a PNG 8 inches wide. Equal input gives equal bytes.

    `stage`: of the trace. Raises UsageError for a step out of range.
    """
    at = trace.time if step is None else step
    if not 0 <= at <= trace.time:
        raise UsageError(f"step {step} of rollout {trace.rollout}", expected=f"0 to {trace.time}, where it ended")
    with style.picture_style():
        dpi = style.FINE_DPI if max(stage.world.shape) > style.FINE_FROM else style.DPI
        picture = RolloutPicture(trace, stage, dpi)
        picture.show(at)
        return style.png_bytes(picture.figure)


def animation_gif(trace: Trace, stage: Stage, most_frames: int = MOST_FRAMES) -> bytes:
    """The rollout as an animated GIF, 800 pixels wide, of about half a minute, repeated.

    Long rollouts show at most `most_frames` steps; the first, the last and those with losses take precedence. Equal
    input gives equal bytes. Memory: one byte for each pixel and frame. Raises UsageError for less than two frames.
    """
    if most_frames < 2:
        raise UsageError(f"{most_frames} frames", expected="2 or more")
    steps = shown_steps(trace, most_frames)

    def pixels(steps: list[int]) -> Iterator[NDArray[np.uint8]]:
        picture = RolloutPicture(trace, stage, ANIMATION_DPI)
        for step in steps:
            picture.show(step)
            yield picture.pixels()

    with style.picture_style():
        colours = _commonest(pixels(sorted({0, trace.time // 2, trace.time})))
        return _gif(pixels(steps), colours, durations(trace, steps))


def shown_steps(trace: Trace, most: int) -> list[int]:
    """Increasing steps, at most `most` (2 or more): first, last, those with losses, the others evenly spaced."""
    # Steps with losses take precedence over evenly spaced ones.
    losses = np.unique(trace.events[trace.events[:, 2] == EventKind.HIT, 0])
    steps = np.unique([0, trace.time, *losses[: most - 2]])
    others = np.setdiff1d(np.arange(trace.time + 1), steps)
    room = most - len(steps)
    if len(others) > room:
        others = others[np.linspace(0, len(others) - 1, room).round().astype(np.int64)]
    return [int(step) for step in np.union1d(steps, others)]


def durations(trace: Trace, steps: list[int]) -> list[int]:
    """Milliseconds for each of `steps`, a multiple of 10: longer at losses and at the end."""
    usual = int(np.clip(PLAYING_SECONDS * 1000 / len(steps), FASTEST, SLOWEST)) // 10 * 10
    losses = set(trace.events[trace.events[:, 2] == EventKind.HIT, 0].tolist())
    return [AT_END if step == trace.time else ON_LOSS if step in losses else usual for step in steps]


def _commonest(pictures: Iterator[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """The most frequent colours of some pictures `[down, across, 3]`, uint8 `[COLOURS, 3]`."""
    found: Any = Image.fromarray(np.concatenate(list(pictures))).getcolors(2**24)
    chosen = [colour for _, colour in sorted(found, key=lambda one: (-one[0], one[1]))[:COLOURS]]
    return np.pad(np.array(chosen, np.uint8), ((0, COLOURS - len(chosen)), (0, 0)), mode="edge")


def _gif(pictures: Iterator[NDArray[np.uint8]], colours: NDArray[np.uint8], milliseconds: list[int]) -> bytes:
    """The pictures as a GIF whose frames store only changes, each pixel in the nearest of the colours."""
    tree, packing = KDTree(colours), np.array([2**16, 2**8, 1])

    def frame(picture: NDArray[np.uint8]) -> Image.Image:
        # A picture has few distinct colours, so the search is done once for each.
        found, which = np.unique(picture @ packing, return_inverse=True)
        nearest = tree.query(found[:, None] // packing % 256)[1].astype(np.uint8)
        image = Image.fromarray(nearest[which].reshape(picture.shape[:2]))
        image.putpalette(colours.tobytes())
        return image

    frames, out = map(frame, pictures), io.BytesIO()
    saved: dict[str, Any] = {"save_all": True, "append_images": frames, "duration": milliseconds, "loop": 0}
    next(frames).save(out, format="GIF", disposal=1, optimize=True, transparency=COLOURS, **saved)
    return out.getvalue()


# Picture and animation of a recorded rollout as files.


def save_pictures(trace: Trace, stage: Stage, picture: Path | None, animation: Path | None) -> Iterator[Path]:
    """Write the files that have a name, completely or not at all; yields each path when written. Raises MapError."""

    for path, draw in ((picture, picture_png), (animation, animation_gif)):
        if path is not None:
            with atomic_write(path, "wb") as out:
                out.write(draw(trace, stage))
            yield path
