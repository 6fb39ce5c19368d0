"""The planned paths over a map of the page: one line a robot, drawn by the browser."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from analysis.kit.words import counted
from analysis.page.markup import Html, element
from analysis.pictures.robots import lane
from analysis.pictures.style import ROBOT_COLOURS
from planner.plans.plan import Plan

MOST_LETTERS = 400_000
"""Of all paths together; longer ones would make the page heavy and the map a blur."""
LISTED = 16
"""Robots with an entry of their own in the legend."""
DASHES = ("", "5 1.6", "1.5 1.5", "6 1.5 1.2 1.5")


def paths_svg(plan: Plan) -> Html | None:
    """Every robot's path over the cells of the plan's map, in cells; None where they are too long to draw."""
    height, width = plan.shape
    number = len(plan.robots)
    thin = float(np.clip(270 / max(plan.shape) / max(number, 3), 0.6, 1.6))
    lines, letters = [], 0
    for robot in range(number):
        line = path_letters(plan, robot)
        letters += len(line)
        if letters > MOST_LETTERS:
            return None
        shift = 0.5 + lane(robot, number)
        turn, colour = divmod(robot, len(ROBOT_COLOURS))
        lines.append(
            element(
                "path",
                d=line,
                class_=f"r{colour}",
                stroke_dasharray=DASHES[turn % len(DASHES)] or None,
                transform=f"translate({shift:.3f} {shift:.3f})",
            )
        )
    box = f"0 0 {width} {height}"
    return element(
        "svg",
        *lines,
        class_="paths",
        viewBox=box,
        preserveAspectRatio="none",
        stroke_width=f"{thin:.2f}",
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
