"""The planned paths over a map of the page: one line a robot, drawn by the browser."""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np

from analysis.page.markup import Html, element
from analysis.pictures.robots import lane
from analysis.pictures.style import ROBOT_COLOURS
from planner.plans.plan import Plan
from planner.shown import counted

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


def paths_svg(plan: Plan) -> Html | None:
    """`path_lines` as a picture."""
    lines = path_lines(plan)
    if lines is None:
        return None
    paths = [
        element(
            "path",
            d=line.letters,
            class_=f"r{line.colour}",
            stroke_dasharray=line.dashes or None,
            transform=f"translate({line.shift:.3f} {line.shift:.3f})",
        )
        for line in lines
    ]
    return element(
        "svg",
        *paths,
        class_="paths",
        viewBox=f"0 0 {plan.shape[1]} {plan.shape[0]}",
        preserveAspectRatio="none",
        stroke_width=f"{thickness(plan):.2f}",
        aria_hidden="true",
    )


def path_letters(plan: Plan, robot: int) -> str:
    """A path as the letters of an SVG path: moves of one direction in one stroke, waiting left out."""
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    moves = zip(np.diff(rows).tolist(), np.diff(cols).tolist(), strict=True)
    strokes = [f"M{cols[0]} {rows[0]}"]
    for (down, across), group in groupby(move for move in moves if move != (0, 0)):
        times = len(list(group))
        strokes.append(f"v{down * times}" if down else f"h{across * times}")
    return "".join(strokes) if len(strokes) > 1 else f"{strokes[0]}h0"


def paths_legend(plan: Plan, drawn: bool) -> Html:
    """Whose line is whose."""
    robots = len(plan.robots)
    if not drawn:
        return element("p", "The paths are too long to be drawn here.", class_="note")
    if robots > LISTED:
        return element("p", f"{counted(robots, 'line')}: one a robot.", class_="note")
    names = [
        element(
            "li", element("i", class_=f"swatch r{robot % len(ROBOT_COLOURS)}", aria_hidden="true"), f"robot {robot}"
        )
        for robot in range(robots)
    ]
    return element("ul", *names, class_="legend key")
