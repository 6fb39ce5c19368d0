"""Charts (`analysis.page.series`) as a picture for slides and papers: the curves that a page shows, on paper."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from analysis.page.series import BARS_UP_TO, Chart, Points, points_of
from analysis.pictures.style import (
    FAINT,
    GRID,
    INK,
    LINE_STYLES,
    ROBOT_COLOURS,
    WIDTH,
    inches,
    new_figure,
    plain,
)

HIGH, ABOVE, ENTRY = 2.4, 0.85, 0.19
"""Inches: a chart's height, what is above it, a line of its legend."""
LETTERS = 95
"""Of a title in a figure's whole width."""
FEW = 12
"""Values of x that are each labelled."""


def charts_figure(charts: Sequence[Chart]) -> Figure:
    """The charts, two abreast where there are several; bars and bands are 95 % intervals unless a chart says else."""
    across = min(len(charts), 2)
    wide = (WIDTH - 0.75 * across - 0.2) / across
    below = 0.65 + ENTRY * max(len(chart.series) for chart in charts)
    rows = ceil(len(charts) / across)
    figure = new_figure((WIDTH, rows * (ABOVE + HIGH + below)))
    for number, chart in enumerate(charts):
        row, column = divmod(number, across)
        bottom = (rows - 1 - row) * (ABOVE + HIGH + below) + below
        _draw(figure.add_axes(inches(figure, (0.65 + column * (wide + 0.75), bottom, wide, HIGH))), chart)
    return figure


def _draw(axes: Axes, chart: Chart) -> None:
    points = [one for place, series in enumerate(chart.series) if len((one := points_of(series, place)).x)]
    for one in points:
        _draw_series(axes, one)
    for y, words in chart.at_y:
        axes.axhline(y, color=FAINT, linewidth=0.8, linestyle=":", label=words)
    for x, words in chart.at_x:
        axes.axvline(x, color=FAINT, linewidth=0.8, linestyle=":", label=words)
    places = np.unique(np.concatenate([one.x for one in points])) if points else np.empty(0)
    if 0 < len(places) <= FEW:
        axes.xaxis.set_major_locator(FixedLocator(places.tolist()))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.4g}"))
    axes.set_xlabel(chart.x_name, loc="right", labelpad=2)
    if chart.unit:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} {chart.unit}"))
    axes.set_ylim(*(chart.y_range or (min(0.0, axes.get_ylim()[0]), None)))
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    plain(axes)
    interval = f"; {chart.interval}" if any(one.low is not None for one in points) else ""
    title = fill(chart.title, int(LETTERS * axes.get_position().width))
    axes.set_title(title, loc="left", fontsize=10.5, fontweight="bold", color=INK, pad=20)
    axes.annotate(chart.y_name + interval, (0, 1), (0, 7), "axes fraction", "offset points", fontsize=9, color=FAINT)
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.16), borderaxespad=0, handlelength=2.2)


def _draw_series(axes: Axes, one: Points) -> None:
    about, colour = one.about, INK if one.about.kind == "points" else ROBOT_COLOURS[one.colour]
    line: dict[str, Any] = {"color": colour, "label": about.name, "clip_on": False}
    if about.kind == "bars":
        axes.bar(one.x, one.y, width=0.92 * one.bars, color=colour, label=about.name)
        return
    if one.low is not None and one.high is not None:
        if len(one.x) <= BARS_UP_TO:
            axes.vlines(one.x, one.low, one.high, color=colour, linewidth=0.9)
        else:
            axes.fill_between(one.x, one.low, one.high, color=colour, alpha=0.2, linewidth=0)
    if about.kind == "points":
        axes.plot(one.x, one.y, "D", markersize=4, **line)
        return
    style = LINE_STYLES[1] if about.dashed else LINE_STYLES[0]
    marks: dict[str, Any] = {"marker": "o", "markersize": 3.2} if len(one.x) <= BARS_UP_TO else {}
    steps = "steps-post" if about.kind == "step" else "default"
    axes.plot(one.x, one.y, linestyle=style, linewidth=1.3, drawstyle=steps, **marks, **line)
