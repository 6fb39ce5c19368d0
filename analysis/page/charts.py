"""Charts drawn by matplotlib: as SVG in a page, and as pictures for slides and papers."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import ceil
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter
from numpy.typing import NDArray

from analysis.page.document import Html, TableData, block
from analysis.page.elements import CURVE_COLOURS, Chart, Series
from analysis.pictures import (
    FAINT,
    GRID,
    INK,
    LINE_STYLES,
    PICK,
    ROBOT_COLOURS,
    WIDTH,
    inches,
    new_figure,
    picture_style,
    plain,
)
from planner.errors import visible

HIGH, ABOVE, ENTRY = 2.4, 0.85, 0.19
"""Inches: height of a chart, space above it, height of a line of its legend."""
NAMED, ROW = 1.95, 0.24
"""Inches: space for labels of y, and height of each."""
ON_PAGE = 5.4
"""Inches: width of a chart on a page, where a CSS pixel is 1/72 inch or more."""
LETTERS, SMALLER = 95, 125
"""Characters over the width of a figure: of a title, and of the text below it."""
FEW = 12
"""Most values of x, whole numbers, that are labelled one by one."""
BARS_UP_TO = 40
"""Most points whose intervals are drawn as bars; with more points they form a band."""
TABLE_ROWS = 40
"""Most rows of the table of a chart's values."""
PAGE_COLOURS = {INK: "var(--ink)", FAINT: "var(--faint)", GRID: "var(--line)", PICK: "var(--fails)"} | {
    colour: f"var(--c{place})" for place, colour in enumerate(ROBOT_COLOURS)
}
"""The style sheet's colours in the place of a picture's: a page is light or dark."""


def charts_figure(charts: Sequence[Chart]) -> Figure:
    """The charts in one figure, two or three in a row; bars and bands are 95 % intervals unless stated otherwise."""
    across = min(len(charts), 2 if len(charts) <= 4 else 3)
    labels = max(len(chart.y_words) for chart in charts)
    high, named = max(HIGH, ROW * labels), NAMED * bool(labels)
    wide = (WIDTH - (0.75 + named) * across - 0.2) / across
    below = 0.65 + ENTRY * max(len((*chart.series, *chart.at_x, *chart.at_y)) for chart in charts)
    rows = ceil(len(charts) / across)
    figure = new_figure((WIDTH, rows * (ABOVE + high + below)))
    for number, chart in enumerate(charts):
        row, column = divmod(number, across)
        bottom, left = (rows - 1 - row) * (ABOVE + high + below) + below, 0.65 + named + column * (wide + 0.75 + named)
        axes = figure.add_axes(inches(figure, (left, bottom, wide, high)))
        shown = _draw(axes, chart)
        share = axes.get_position().width
        interval = f"; {chart.interval}" if any(one.low is not None for one in shown) else ""
        title, text = fill(chart.title, int(LETTERS * share)), fill(chart.y_name + interval, int(SMALLER * share))
        axes.set_title(title, loc="left", fontsize=10.5, fontweight="bold", color=INK, pad=20 + 12 * text.count("\n"))
        axes.annotate(text, (0, 1), (0, 7), "axes fraction", "offset points", fontsize=9, color=FAINT)
    return figure


def chart_html(chart: Chart, heading: str = "h3") -> Html:
    """The chart on a page: `heading`, SVG, a collapsed table of its values; "" without points."""
    shown = _with_points(chart)
    if not shown:
        return Html()
    sizes = [len(np.asarray(one.x)) for one in shown if one.low is not None]
    looks = [word for word, there in (("upright lines", any(size <= BARS_UP_TO for size in sizes)),
                                      ("shaded", any(size > BARS_UP_TO for size in sizes))) if there]  # fmt: skip
    note = f"{', '.join(looks).capitalize()}: {chart.interval}." if sizes else ""
    text = f"{chart.title}: {chart.y_name} over {chart.x_name}; {', '.join(one.name for one in shown)}"
    return block("chart", chart, _svg(chart), text, f"{note} {chart.note}".strip(), _values(chart, shown), heading)


def _svg(chart: Chart) -> Html:
    """The curves with axes and legend as SVG: selectable text, colours of the style sheet, equal bytes if equal."""
    entries, out = len((*chart.series, *chart.at_x, *chart.at_y)), io.StringIO()
    below = 0.5 + ENTRY * entries
    # The salt keeps the ids of two charts of a page apart.
    with picture_style(), rc_context({"svg.fonttype": "none", "svg.hashsalt": visible(chart.title)}):
        figure = new_figure((ON_PAGE, HIGH + below + 0.1))
        _draw(figure.add_axes(inches(figure, (0.55, below, ON_PAGE - 0.65, HIGH))), chart)
        none = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(out, format="svg", metadata=none, transparent=True)
    drawn = out.getvalue()
    drawn = re.sub(r"<style.*?</style>|(?<=<g) id=\"[^\"]*\"| (width|height)=\"[^\"]*pt\"", "",
                   drawn[drawn.index("<svg") :], flags=re.DOTALL)  # fmt: skip
    drawn = re.sub(r"#[0-9a-f]{6}\b", lambda found: PAGE_COLOURS.get(found[0], found[0]), drawn)
    return Html(re.sub(r"\s*\n\s*", " ", drawn))


def _with_points(chart: Chart) -> list[Series]:
    """The series that have points, finite and with their colours."""
    series = [_finite(one, place) for place, one in enumerate(chart.series)]
    return [one for one in series if len(np.asarray(one.x))]


def _finite(series: Series, place: int) -> Series:
    """The series without undefined points; an unknown end of an interval is replaced by the point."""
    x, y = (np.asarray(values, dtype=np.float64).ravel() for values in (series.x, series.y))
    known = np.isfinite(x) & np.isfinite(y)
    low, high = series.low, series.high
    if low is not None and high is not None:
        ends = (np.asarray(end, dtype=np.float64).ravel()[known] for end in (low, high))
        low, high = (np.where(np.isfinite(end), end, y[known]) for end in ends)
    colour = series.colour
    if colour is None and series.kind != "points":
        colour = place % CURVE_COLOURS
    return replace(series, name=visible(series.name), x=x[known], y=y[known], low=low, high=high, colour=colour)


def _draw(axes: Axes, chart: Chart) -> list[Series]:
    """Draw the chart without its title; returns the series drawn."""
    shown = _with_points(chart)
    for one in shown:
        _draw_series(axes, one)
    for y, words in chart.at_y:
        axes.axhline(y, color=FAINT, linewidth=0.8, linestyle=":", label=visible(words))
    used = {one.colour for one in shown}
    free = [colour for place, colour in enumerate(ROBOT_COLOURS) if place not in used] or ROBOT_COLOURS
    for number, (x, words) in enumerate(chart.at_x):
        colour = free[number % len(free)] if len(chart.at_x) > 1 else FAINT
        axes.axvline(x, color=colour, linewidth=1.1, linestyle=LINE_STYLES[1 + number % 3], label=visible(words))
    places = _abscissae([one for one in shown if one.kind != "bars"])
    if 0 < len(places) <= FEW and (places == places.round()).all():
        axes.xaxis.set_major_locator(FixedLocator(places.tolist()))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: _x_text(chart, x)))
    axes.set_xlabel(visible(chart.x_name), loc="right", labelpad=2)
    if unit := visible(chart.unit):
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} {unit}"))
    if chart.y_words:
        axes.set_yticks(range(len(chart.y_words)), map(visible, chart.y_words))
        axes.set_ylim(-0.6, len(chart.y_words) - 0.4)
    elif shown:
        axes.set_ylim(*_y_range(chart, shown))
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    plain(axes)
    below = -0.16 * HIGH / max(HIGH, ROW * len(chart.y_words))
    axes.legend(loc="upper left", bbox_to_anchor=(0, below), borderaxespad=0, handlelength=2.2)
    return shown


def _draw_series(axes: Axes, one: Series) -> None:
    x, y = np.asarray(one.x), np.asarray(one.y)
    colour, few = PICK if one.colour is None else ROBOT_COLOURS[one.colour % CURVE_COLOURS], len(x) <= BARS_UP_TO
    line: dict[str, Any] = {"color": colour, "label": one.name, "clip_on": False}
    if one.kind == "bars":
        axes.bar(x, y, width=0.92 * float(np.diff(x).min() if len(x) > 1 else 1), color=colour, label=one.name)
        return
    if one.low is not None and one.high is not None:
        ends = partial(axes.vlines, linewidth=0.9) if few else partial(axes.fill_between, alpha=0.2, linewidth=0)
        ends(x, one.low, one.high, color=colour)
    if one.kind == "points":
        look: dict[str, Any] = (
            {"marker": "D", "markersize": 4} if few else {"marker": "o", "markersize": 2, "alpha": 0.45}
        )
        axes.plot(x, y, linestyle="", **look, **line)
        return
    marks: dict[str, Any] = {"marker": "o", "markersize": 3.2} if few else {}
    steps = "steps-post" if one.kind == "step" else "default"
    axes.plot(x, y, linestyle=LINE_STYLES[one.dashed], linewidth=1.3, drawstyle=steps, **marks, **line)


def _y_range(chart: Chart, shown: Sequence[Series]) -> tuple[float, float]:
    """The range of the y axis."""
    ends = [float(value) for one in shown for end in (one.y, one.low, one.high) if end is not None
            for value in np.asarray(end)]  # fmt: skip
    marks = [y for y, _ in chart.at_y]
    low, high = min([*ends, *marks]), max([*ends, *marks])
    if chart.fit:
        more, (least, most) = 0.05 * (high - low) or 1.0, chart.y_range or (-math.inf, math.inf)
        return max(low - more, least), min(high + more, most)
    low, high = min(*ends, 0.0), max(high, 0.0)
    high += 0.04 * (high - low)
    if chart.y_range is not None:
        low, high = min(low, chart.y_range[0]), max(*ends, chart.y_range[1])
    return low, high if high > low else low + 1.0


def _abscissae(shown: Sequence[Series]) -> NDArray[np.float64]:
    return np.unique(np.concatenate([np.empty(0), *(np.asarray(one.x) for one in shown)]))


def _x_text(chart: Chart, x: float) -> str:
    return chart.x_words[round(x)] if chart.x_words else f"{x:,.2f}".rstrip("0").rstrip(".")


def _values(chart: Chart, shown: Sequence[Series]) -> TableData:
    """The curves as a table, for screen readers and for copying."""
    every = _abscissae(shown)
    if len(every) > TABLE_ROWS:
        every = every[np.unique(np.linspace(0, len(every) - 1, TABLE_ROWS).round().astype(np.int64))]
    columns = [dict(zip(np.asarray(one.x).tolist(), _texts(one), strict=True)) for one in shown]
    rows = tuple((_x_text(chart, x), *(column.get(x, "") for column in columns)) for x in every.tolist())
    unit = f", {chart.unit}" if chart.unit else ""
    names = (chart.x_name.partition("(")[0].strip(), *(f"{one.name}{unit}" for one in shown))
    return TableData("", names, rows, frozenset())


def _texts(one: Series) -> list[str]:
    """Each value of a series, with its interval if it has one."""
    means = [f"{value:,.2f}" for value in np.asarray(one.y)]
    if one.low is None or one.high is None:
        return means
    ends = zip(means, np.asarray(one.low), np.asarray(one.high), strict=True)
    return [text if math.isclose(low, high) else f"{text} ({low:,.2f} .. {high:,.2f})" for text, low, high in ends]
