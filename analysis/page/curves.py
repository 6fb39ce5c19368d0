"""Curves with intervals: drawn as SVG here, so that they are there without a script; the script adds the values.

The plot is stretched to whatever width there is, lines keep their width, and every word is HTML beside it: so it reads
the same on a phone, on paper and on a wide screen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from analysis.page.markup import Html, block
from analysis.page.plot import plot_of
from analysis.page.series import BARS_UP_TO, Chart, Frame, Points, Series, points_of, x_range_of, y_range_of
from analysis.page.tables import TableData

__all__ = ["Chart", "Series", "curves_html"]
TABLE_ROWS = 40


def curves_html(chart: Chart, heading: str = "h3") -> Html:
    """The chart as a figure: `heading`, legend, plot, the values as a table folded away. Nothing of no points."""
    points = [points_of(series, place) for place, series in enumerate(chart.series)]
    points = [one for one in points if len(one.x)]
    if not points:
        return Html()
    frame = Frame(x_range_of(points), y_range_of(chart, points))
    sizes = [len(one.x) for one in points if one.low is not None]
    upright, shaded = any(size <= BARS_UP_TO for size in sizes), any(size > BARS_UP_TO for size in sizes)
    looks = "Upright lines, shaded" if upright and shaded else "Upright lines" if upright else "Shaded"
    note = [f"{looks}: {chart.interval}." if sizes else "", chart.note]
    words = " ".join(part for part in note if part)
    return block("chart", chart, plot_of(chart, points, frame), words, _values(chart, points), heading)


def _values(chart: Chart, points: Sequence[Points]) -> TableData:
    """The curves as a table: for those who cannot see them, and for those who want to copy them."""
    every = np.unique(np.concatenate([one.x for one in points]))
    if len(every) > TABLE_ROWS:
        every = every[np.unique(np.linspace(0, len(every) - 1, TABLE_ROWS).round().astype(np.int64))]
    rows = []
    for x in every:
        cells = [chart.x_words[round(x)] if chart.x_words else f"{x:,.{chart.x_digits}f}"]
        for one in points:
            found = np.flatnonzero(one.x == x)
            cells.append(_value(one, int(found[0]), chart.digits) if len(found) else "")
        rows.append(tuple(cells))
    unit = f", {chart.unit}" if chart.unit else ""
    names = (chart.x_name.split("(")[0].strip(), *(f"{one.about.name}{unit}" for one in points))
    return TableData("", names, tuple(rows), frozenset())


def _value(one: Points, place: int, digits: int) -> str:
    shown = f"{one.y[place]:,.{digits}f}"
    if one.low is None or one.high is None or math.isclose(one.low[place], one.high[place]):
        return shown
    return f"{shown} ({one.low[place]:,.{digits}f} .. {one.high[place]:,.{digits}f})"
