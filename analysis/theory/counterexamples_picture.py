"""The counterexamples as one picture: a row of cells each, the robots' starts and paths, and what is claimed."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from analysis.kit.folder import write_all
from analysis.pictures.style import (
    FAINT,
    INK,
    SAFE,
    THREAT,
    WIDTH,
    inches,
    new_figure,
    png_of,
    robot_style,
)
from analysis.theory.counterexamples import COUNTEREXAMPLES, Counterexample
from analysis.theory.formulas import FORMULAS, Direction
from planner.mrac.make_plan import make_plan

ROW, TOP, BOTTOM = 0.98, 0.85, 0.2
"""Inches: of an example, above the first, below the last."""
MOST_CELLS = 7
SIDE = 0.42
"""Inches of a cell's side."""
CLAIMS = {Direction.LOWER: "at least", Direction.UPPER: "at most", Direction.EQUAL: ""}


def counterexamples_figure(examples: Sequence[Counterexample]) -> Figure:
    """All of them, one below the other."""
    height = TOP + ROW * len(examples) + BOTTOM
    figure = new_figure((WIDTH, height))
    axes = figure.add_axes(inches(figure, (0.0, 0.0, WIDTH, height)))
    axes.set(xlim=(0, WIDTH), ylim=(0, height))
    axes.set_axis_off()
    axes.text(0.3, height - 0.38, "Where the paper's formulas fail", fontsize=14, fontweight="bold", color=INK)
    said = "the smallest worlds known; figures: chance that one visit stops the robot; circles: starts; lines: paths"
    axes.text(0.3, height - 0.62, said, fontsize=9, color=FAINT)
    for number, example in enumerate(examples):
        _draw(axes, example, height - TOP - ROW * (number + 0.5))
    return figure


def _draw(axes: Axes, example: Counterexample, middle: float) -> None:
    left, low = 0.3, middle - SIDE / 2
    for col, p in enumerate(example.threat):
        colour = SAFE if p == 0 else THREAT(p)
        axes.add_patch(
            Rectangle((left + SIDE * col, low), SIDE, SIDE, facecolor=colour, edgecolor=FAINT, linewidth=0.8)
        )
        at = (left + SIDE * col + SIDE - 0.04, low + 0.04)
        axes.text(*at, f"{p:g}" if p else "0", fontsize=6.5, color=INK, ha="right", va="bottom")
    _draw_robots(axes, example, left, middle)
    text = left + SIDE * MOST_CELLS + 0.35
    formula, *meaning = example.fails.split("/")
    about = FORMULAS[formula]
    loop = " (visited)" if "visited" in meaning else " (survived)" if "survived" in meaning else ""
    unit = {"cells": "cells", "chance": "", "steps": "steps"}[about.unit]
    claim = " ".join(filter(None, (CLAIMS[about.direction], f"{example.value:g}", unit)))
    truth = " ".join(filter(None, (f"{example.truth:g}", unit)))
    axes.text(text, middle + 0.16, f"{about.title}{loop}", fontsize=9.5, fontweight="bold", color=INK, va="center")
    axes.text(text, middle - 0.04, f"says {claim}; the truth is {truth}", fontsize=9, color=INK, va="center")
    axes.text(text, middle - 0.23, example.why, fontsize=7.6, color=FAINT, va="center")


def _draw_robots(axes: Axes, example: Counterexample, left: float, middle: float) -> None:
    """A circle with the robot's number at its start; its moves as a line below or above the others'."""
    plan = make_plan(example.world, [(0, col) for col in example.starts])
    for robot, made in enumerate(plan.robots):
        colour, _ = robot_style(robot)
        here = [col for col in range(robot) if example.starts[col] == example.starts[robot]]
        lane = middle - SIDE / 2 - 0.06 - 0.075 * robot
        xs = [left + SIDE * (int(cell) + 0.5) for cell in made.path]
        start = left + SIDE * (example.starts[robot] + 0.28 + 0.22 * len(here))
        axes.plot(start, middle + 0.06, "o", markersize=9, color=colour, zorder=3)
        axes.text(start, middle + 0.055, str(robot), fontsize=6.5, color="white", ha="center", va="center", zorder=4)
        if len(set(xs)) > 1:
            turns = [xs[0], *(now for before, now in itertools.pairwise(xs) if now != before)]
            spread = [(x, lane - 0.012 * step) for step, x in enumerate(turns)]
            axes.plot(*zip(*spread, strict=True), color=colour, linewidth=1.3, solid_capstyle="round")
            axes.plot(*spread[-1], marker="s", markersize=3.2, color=colour)


def save_all(folder: Path) -> list[Path]:
    """The picture and the worlds, in `folder` (made if it is not there); returns the files."""
    written = write_all(folder, {"counterexamples.png": png_of(counterexamples_figure, COUNTEREXAMPLES)})
    worlds = {found.name: found.world for found in COUNTEREXAMPLES}
    files = [folder / f"{name.replace(',', '').replace(' ', '-')}.npz" for name in worlds]
    for file, world in zip(files, worlds.values(), strict=True):
        world.save(file)
    return [*written, *files]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m analysis.theory.counterexamples_picture FOLDER")
    save_all(Path(sys.argv[1]))
