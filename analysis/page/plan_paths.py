"""The planned paths over a map of the page: one line a robot, drawn by the browser."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from analysis.page.cell_maps import CellLayer, cell_maps_html
from analysis.page.markup import Html, block
from analysis.page.runs import Run, packed_runs
from analysis.pictures.robots import lane
from analysis.pictures.style import ROBOT_COLOURS
from planner.plans.plan import Plan
from planner.shown import counted
from planner.worlds.world import World

MOST_LETTERS = 400_000
"""Of all paths together; longer ones would make the page heavy and the map a blur."""
LISTED = 16
"""Robots with an entry of their own in the legend."""
DASHES = ("", "5 1.6", "1.5 1.5", "6 1.5 1.2 1.5")


class Line(NamedTuple):
    """A robot's path to draw: letters of an SVG path, a colour's number, dashes, and how far to shift it, in cells."""

    letters: str
    colour: int
    dashes: str
    shift: float


def path_lines(plan: Plan) -> list[Line] | None:
    """Every robot's path over the cells of the plan's map, in cells; None where they are too long to draw."""
    lines, letters, robots = [], 0, len(plan.robots)
    for robot in range(robots):
        line = path_letters(plan, robot)
        letters += len(line)
        if letters > MOST_LETTERS:
            return None
        turn, colour = divmod(robot, len(ROBOT_COLOURS))
        lines.append(Line(line, colour, DASHES[turn % len(DASHES)], round(0.5 + lane(robot, robots), 3)))
    return lines


def thickness(plan: Plan) -> float:
    """Of the lines, in CSS pixels."""
    return round(float(np.clip(270 / max(plan.shape) / max(len(plan.robots), 3), 0.6, 1.6)), 2)


def plan_map_html(
    layers: Sequence[CellLayer], world: World, plan: Plan, runs: Sequence[Run], about: str, values_of: str | None
) -> Html:
    """The map with the plan's paths over it, and runs to be played there; arguments as of `CellMaps`."""
    lines, robots = path_lines(plan), len(plan.robots)
    drawn = None if lines is None else block("paths", plan, lines, thickness(plan))
    maps = cell_maps_html(layers, world, plan.starts, above=drawn, heading="h2", values_of=values_of)
    whose = [(f"swatch r{robot % len(ROBOT_COLOURS)}", f"robot {robot}") for robot in range(robots)]
    note = "" if robots <= LISTED else f"{counted(robots, 'line')}: one a robot."
    if lines is None:
        note = "The paths are too long to be drawn here."
    packed = packed_runs(runs, world.accessible(plan.starts), world.pace)
    return block("plan_map", maps, packed, about, [] if note else whose, note)


def path_letters(plan: Plan, robot: int) -> str:
    """A path as the letters of an SVG path: moves of one direction in one stroke, waiting left out."""
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    moves = zip(np.diff(rows).tolist(), np.diff(cols).tolist(), strict=True)
    strokes = [f"M{cols[0]} {rows[0]}"]
    for (down, across), group in groupby(move for move in moves if move != (0, 0)):
        times = len(list(group))
        strokes.append(f"v{down * times}" if down else f"h{across * times}")
    return "".join(strokes) if len(strokes) > 1 else f"{strokes[0]}h0"
