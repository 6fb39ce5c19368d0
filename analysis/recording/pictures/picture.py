"""One rollout as a picture that moves on: threat map and paths, who covers what, coverage over time, latest events.

Axis letters: `K` robots, `N = H * W` cells, `T` = time + 1 steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from numpy.typing import NDArray

from analysis.pictures.robots import lane
from analysis.pictures.style import (
    FAINT,
    HALO,
    INK,
    OBSTACLE,
    UNREACHABLE,
    Look,
    cell_points,
    inches,
    new_figure,
    robot_style,
)
from analysis.recording.events import event_line
from analysis.recording.frames import Held, make_frames, no_areas
from analysis.recording.pictures.parts import (
    BEFORE,
    FOG_ALPHA,
    LOST,
    NOBODY,
    boxes_for,
    draw_coverage,
    draw_fog,
    draw_movers,
    draw_threat,
    map_frame,
    tint,
)
from analysis.recording.viewers.topics import Stage
from planner.none import NO_ROBOT, NO_STEP
from planner.roaming import ways_of_movers
from planner.shown import counted, percent
from planner.trace import EventKind, Trace

NUMBERED = 40
"""Robots up to which the markers carry numbers."""
LISTED_EVENTS = 8


class RolloutPicture:
    """A rollout drawn at one step after another: `show(step)`, then `pixels()`, or `figure` for a file."""

    def __init__(self, trace: Trace, stage: Stage, dpi: int) -> None:
        """Draw all that never changes, and step 0. For use within `plots_style.house_style()`.

        `dpi`: pixels an inch of the figure, `plots_style.WIDTH` inches wide.
        """
        plan, self._found = stage.plan, stage.discovery(trace)
        world = stage.world
        if self._found is not None:  # what is true, behind the fog
            world = replace(world, threat=self._found.truth, knowledge=None, doubt=None)
        self._trace, self._plan, self._world, self._shape = trace, plan, world, world.shape
        self._frames = make_frames(trace, plan.state)
        self._accessible = world.accessible(plan.starts).ravel()
        self._free = world.free.ravel()
        self._maps, self._map = stage.area_maps(trace), no_areas(world.threat.size)
        self._next_map = next(self._maps, None)
        has_areas = self._next_map is not None
        self._events_at = self._frames.events_by_step()
        robots = trace.cells.shape[1]
        colours = np.array([to_rgb(robot_style(robot)[0]) for robot in range(robots)] + [to_rgb(NOBODY)])
        self._covered, self._promised = tint(colours, 0.62), tint(colours, 0.3)
        self._promised[NO_ROBOT], self._covered[NO_ROBOT] = to_rgb(NOBODY), to_rgb(BEFORE)

        boxes = boxes_for(world.shape)
        self.figure = new_figure(boxes.size, dpi)
        threat_axes, areas_axes, coverage = (self.figure.add_axes(inches(self.figure, box)) for box in boxes.axes)
        fog = self._found is not None
        self._ground, self._painted = draw_threat(threat_axes, boxes, world, plan, has_areas, fog=fog)
        map_frame(areas_axes, world, "who covered it, and whose area it is" if has_areas else "who covered it")
        self._image = areas_axes.imshow(self._area_colours(0), interpolation="nearest", zorder=0)
        points = cell_points(threat_axes, world.shape)
        self._fog = [draw_fog(axes, world.shape) for axes in (threat_axes, areas_axes) if self._found is not None]
        self._ways = ways_of_movers(stage.world, stage.seed, trace.rollout, len(trace.cells))
        self._movers = [draw_movers(axes, points) for axes in (threat_axes, areas_axes) if self._ways.size]
        self._paths = [_path_line(threat_axes, robot, robots, points) for robot in range(robots)]
        self._markers = [_Markers(axes, robots, points) for axes in (threat_axes, areas_axes)]
        self._curves = draw_coverage(coverage, self._frames, int(self._accessible.sum()))
        (self._losses,) = coverage.plot([], [], "X", color=LOST, markersize=7, markeredgecolor="white", zorder=5)
        self._title, self._subtitle, self._lines = _texts(self.figure, boxes.size, boxes.events)
        self._canvas = FigureCanvasAgg(self.figure)
        self._background: Any = None
        self.show(0)

    def show(self, step: int) -> None:
        """Move on to the end of `step`, 0 .. time; a step before the one shown is a ValueError."""
        if not self._map.step <= step <= self._trace.time:
            raise ValueError(f"step {step} is before the one shown, or after the end at {self._trace.time}")
        while self._next_map is not None and self._next_map.step <= step:
            self._map, self._next_map = self._next_map, next(self._maps, None)
        self._image.set_data(self._area_colours(step))
        if self._world.phases is not None:
            self._ground.set_data(self._painted[self._world.phases.number_at(step)])
        if self._found is not None:
            for fog in self._fog:
                fog.set_alpha(np.where(self._found.seen(step), 0.0, FOG_ALPHA))
        for movers in self._movers:
            movers.set_offsets(np.stack(np.divmod(self._ways[step], self._shape[1])[::-1], axis=1))
        rows, cols = np.divmod(self._trace.cells[: step + 1], self._shape[1])
        for robot, line in enumerate(self._paths):
            shift = lane(robot, len(self._paths))
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
        """The picture as it stands, uint8 `[pixels down, pixels across, 3]`."""
        canvas = self._canvas
        if self._background is None:
            for artist in self._moving():
                artist.set_animated(True)
            canvas.draw()
            self._background = canvas.copy_from_bbox(self.figure.bbox)
        canvas.restore_region(self._background)
        for artist in self._moving():
            artist.axes.draw_artist(artist) if artist.axes is not None else self.figure.draw_artist(artist)
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

    def _moving(self) -> list[Any]:
        """What `show` changes, from the lowest to the highest."""
        marks = [artist for markers in self._markers for artist in markers.artists]
        return [
            *([self._ground] if len(self._painted) > 1 else []),
            self._image, *self._fog, *self._paths, *self._movers, *marks, *self._curves, self._losses,
            self._title, self._subtitle, *self._lines,
        ]  # fmt: skip

    def _area_colours(self, step: int) -> NDArray[np.float64]:
        """The colour of every cell of the areas' map, float64 `[H, W, 3]`."""
        visited = (self._frames.visited_at != NO_STEP) & (self._frames.visited_at <= step)
        owner = np.where(self._map.held == Held.ASSIGNED, self._map.robot, NO_ROBOT)
        colours = self._promised[owner]
        colours[visited] = self._covered[self._frames.visited_by[visited]]
        colours[~self._accessible] = to_rgb(UNREACHABLE)
        colours[~self._free] = to_rgb(OBSTACLE)
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
            parts.append(f"{counted(self._map.open, 'area')} nobody's")
        if self._found is not None:
            parts.append(f"{percent(self._found.seen(step).ravel()[self._accessible].mean())} seen")
        self._subtitle.set_text("; ".join(parts))
        events = trace.events[: self._events_at[step + 1]][-LISTED_EVENTS:]
        for line, event in zip(self._lines, events[::-1].tolist(), strict=False):
            line.set_text(f"{event[0]:>5}  {event_line(event, self._world).short}")
            lost = event[2] == EventKind.HIT
            line.set(
                color=LOST if lost else INK if event[0] == step else FAINT, fontweight="bold" if lost else "normal"
            )


def _path_line(axes: Axes, robot: int, robots: int, points: float) -> Line2D:
    colour, dashes = robot_style(robot)
    width = float(np.clip(0.7 * points / max(robots, 3), 0.5, 2.0))
    (line,) = axes.plot([], [], color=colour, linestyle=dashes, linewidth=width, zorder=2)
    return line


class _Markers:
    """The robots on a map: numbered discs in their colours, a cross where one was lost."""

    def __init__(self, axes: Axes, robots: int, points: float) -> None:
        numbered = robots <= NUMBERED
        size = float(np.clip(0.9 * points, 9.0, 14.0) if numbered else np.clip(0.7 * points, 2.5, 8.0))
        self._colours = np.array([to_rgb(robot_style(robot)[0]) for robot in range(robots)])
        self._shifts = np.array([lane(robot, robots) for robot in range(robots)])
        edge: Look = {"edgecolors": "white", "linewidths": 0.9 if numbered else 0.4, "clip_on": False}
        self._alive = axes.scatter([], [], s=size**2, marker="o", zorder=4, **edge)
        self._lost = axes.scatter([], [], s=(0.95 * size) ** 2, marker="X", zorder=3, color=LOST, **edge)
        font: Look = {"fontsize": 0.56 * size, "fontweight": "bold", "ha": "center", "va": "center_baseline"}
        self._numbers = [axes.text(0, 0, str(robot), zorder=5, **font) for robot in range(robots if numbered else 0)]
        self._above = 0.95 * size / points if points else 1.0
        self.artists = [self._lost, self._alive, *self._numbers]

    def move(self, rows: NDArray[np.int64], cols: NDArray[np.int64], alive: NDArray[np.bool_]) -> None:
        """To the cells `[K]`."""
        places = np.stack([cols, rows], axis=1) + self._shifts[:, None]
        self._alive.set_offsets(places[alive])
        self._alive.set_facecolor(self._colours[alive].tolist())
        self._lost.set_offsets(places[~alive])
        for robot, number in enumerate(self._numbers):
            across, down = places[robot]
            number.set_position((across, down if alive[robot] else down - self._above))
            number.set(color="white" if alive[robot] else LOST, path_effects=[] if alive[robot] else HALO)


def _texts(figure: Figure, size: tuple[float, float], events: tuple[float, float]) -> tuple[Text, Text, list[Text]]:
    """Title, subtitle, and the lines of the latest events, empty."""
    width, height = size
    left = 0.62 / width
    title = figure.text(left, 1 - 0.33 / height, "", fontsize=13, fontweight="bold", color=INK)
    subtitle = figure.text(left, 1 - 0.56 / height, "", fontsize=9.5, color=FAINT)
    across, top = events
    lines = [
        figure.text(across / width, (top - 0.155 * (row + 1)) / height, "", fontsize=7.6, va="baseline")
        for row in range(LISTED_EVENTS)
    ]
    return title, subtitle, lines
