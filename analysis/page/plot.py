"""A plot: the drawing that is stretched, and the words and the pointer's data beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.page.series import BARS_UP_TO, SIDE, Chart, Frame, Points, units
from analysis.page.ticks import label, ticks
from planner.files import Json

Shape = tuple[str, str]
"""How a path looks, and its letters."""
Word = tuple[str, str, float, str]
"""How a word looks, from which side it stands how far (0 to 1), and its text."""


@dataclass(frozen=True, eq=False)
class Plot:
    """What the template draws.

    Attributes:
        points: the curves. label: the plot in words. axes: paths below the curves. curves: each with its paths.
        words: beside the drawing. under_the_pointer: what the script shows.
    """

    points: Sequence[Points]
    label: str
    axes: Sequence[Shape]
    curves: Sequence[tuple[Points, Sequence[Shape]]]
    words: Sequence[Word]
    under_the_pointer: Json
    side: int = SIDE


def plot_of(chart: Chart, points: Sequence[Points], frame: Frame) -> Plot:
    """The plot of a chart."""
    y_ticks = ticks(*frame.y, 6)
    x_ticks = ticks(*frame.x, 8, chart.x_whole)
    x_set = np.unique(np.concatenate([one.x for one in points]))
    if len(x_set) <= 10 and chart.x_whole:
        x_ticks = x_set
    at_x = [(x, words) for x, words in chart.at_x if 0 <= frame.across(x) <= 1]
    at_y = [(y, words) for y, words in chart.at_y if 0 <= frame.up(y) <= 1]
    gap = float(np.diff(x_ticks).min()) if len(x_ticks) > 1 else 1.0
    step = float(np.diff(y_ticks).min()) if len(y_ticks) > 1 else 1.0
    unit = f" {chart.unit}" if chart.unit else ""
    return Plot(
        points,
        f"{chart.title}: {chart.y_name} over {chart.x_name}; {', '.join(one.about.name for one in points)}",
        [
            ("grid", "".join(f"M0 {units(1 - frame.up(y))}H{SIDE}" for y in y_ticks)),
            *(("mark", f"M{units(frame.across(x))} 0V{SIDE}") for x, _ in at_x),
            *(("mark", f"M0 {units(1 - frame.up(y))}H{SIDE}") for y, _ in at_y),
        ],
        [(one, _shapes(one, frame)) for one in points],
        [
            *(("y", "top", 1 - frame.up(y), label(y, step) + unit) for y in y_ticks),
            *_across_words(x_ticks, gap, frame, chart.x_words),
            *(("at-x end" if frame.across(x) > 0.5 else "at-x", "left", frame.across(x), words) for x, words in at_x),
            *(("at-y", "top", 1 - frame.up(y), words) for y, words in at_y),
        ],
        _under_the_pointer(chart, points, frame),
    )


def _across_words(places: NDArray[np.floating], gap: float, frame: Frame, words: Sequence[str]) -> list[Word]:
    """Labels of the x axis; those that a phone has no room for are marked, and those that nobody has are left out."""
    out, last, narrow = [], -1.0, -1.0
    for x in places:
        text, at = words[round(x)] if words else label(float(x), gap), frame.across(float(x))
        if at - last < 0.045:
            continue
        tight = at - narrow < 0.025 * (len(text) + 1.5)
        out.append(("x tight" if tight else "x", "left", at, text))
        last, narrow = at, narrow if tight else at
    return out


def _shapes(one: Points, frame: Frame) -> list[Shape]:
    """The marks of a series."""
    out, kind = [], one.about.kind
    if kind == "bars":
        half = 0.46 * one.bars
        path = "".join(
            f"M{frame.place(x - half, frame.y[0])}V{units(1 - frame.up(y))}H{units(frame.across(x + half))}"
            f"V{units(1 - frame.up(frame.y[0]))}Z"
            for x, y in zip(one.x, one.y, strict=True)
            if y > 0
        )
        return [("bars", path)]
    few = len(one.x) <= BARS_UP_TO
    if one.low is not None and one.high is not None:
        if few:
            bars = zip(one.x, one.low, one.high, strict=True)
            d = "".join(f"M{frame.place(x, low)}V{units(1 - frame.up(high))}" for x, low, high in bars)
            out.append(("whisker", d))
        else:
            there = _line(one.x, one.high, frame, kind)
            back = _line(one.x, one.low, frame, kind, back=True)
            out.append(("band", f"{there}L{back[1:]}Z"))
    if kind != "points":
        out.append(("line", _line(one.x, one.y, frame, kind)))
    if few or kind == "points":
        dots = "".join(f"M{frame.place(x, y)}h.01" for x, y in zip(one.x, one.y, strict=True))
        out.append(("dots" if kind == "points" or len(one.x) <= 25 else "dots small", dots))
    return out


def _line(x: NDArray[np.float64], y: NDArray[np.float64], frame: Frame, kind: str, back: bool = False) -> str:
    if kind == "step" and len(x) > 1:
        x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    order = slice(None, None, -1) if back else slice(None)
    return "M" + "L".join(frame.place(a, b) for a, b in zip(x[order], y[order], strict=True))


def _under_the_pointer(chart: Chart, points: Sequence[Points], frame: Frame) -> Json:
    """What the script shows at each x."""
    digits = chart.digits + 1

    def listed(values: NDArray[np.float64] | None) -> list[float] | None:
        return None if values is None else [round(float(value), digits) + 0.0 for value in values]

    return {
        "x": [round(bound, 9) for bound in frame.x],
        "y": [round(bound, 9) for bound in frame.y],
        "xName": chart.x_name,
        "unit": chart.unit,
        "digits": chart.digits,
        "xDigits": chart.x_digits,
        "xWords": list(chart.x_words),
        "series": [
            {
                "name": one.about.name,
                "colour": one.colour,
                "x": [round(float(x), 6) for x in one.x],
                "y": listed(one.y),
                "low": listed(one.low),
                "high": listed(one.high),
            }
            for one in points
        ],
    }
