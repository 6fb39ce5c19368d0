"""A world and a plan on it: cells by threat level, the areas' borders, every robot's nominal path and start."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from analysis.pictures.maps import SMALLEST, draw_borders, map_figure, paint, terrain_handles, with_key
from analysis.pictures.robots import MOST_LABELS, MOST_LEVELS, group_labels, lane
from analysis.pictures.style import FAINT, INK, Key, Look, ThreatScale, cell_points, robot_style, threat_scale
from planner.none import NO_AREA
from planner.plans.plan import Plan
from planner.shown import chance, counted
from planner.worlds.levels import ThreatLevels, find_levels
from planner.worlds.world import World

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
