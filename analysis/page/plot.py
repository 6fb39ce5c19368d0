"""A plot: the drawing that is stretched, and the words and the pointer's data beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.page.markup import Html, data, element
from analysis.page.series import BARS_UP_TO, SIDE, Chart, Frame, Points, units
from analysis.page.ticks import label, ticks
from planner.files import Json


def plot_html(chart: Chart, points: Sequence[Points], frame: Frame) -> Html:
    """The plot of a chart."""
    y_ticks = ticks(*frame.y, 6)
    x_ticks = ticks(*frame.x, 8, chart.x_whole)
    x_set = np.unique(np.concatenate([one.x for one in points]))
    if len(x_set) <= 10 and chart.x_whole:
        x_ticks = x_set
    at_x = [(x, words) for x, words in chart.at_x if 0 <= frame.across(x) <= 1]
    at_y = [(y, words) for y, words in chart.at_y if 0 <= frame.up(y) <= 1]
    lines = "".join(f"M0 {units(1 - frame.up(y))}H{SIDE}" for y in y_ticks)
    shapes = [element("path", d=lines, class_="grid")]
    shapes += [element("path", d=f"M{units(frame.across(x))} 0V{SIDE}", class_="mark") for x, _ in at_x]
    shapes += [element("path", d=f"M0 {units(1 - frame.up(y))}H{SIDE}", class_="mark") for y, _ in at_y]
    for number, one in enumerate(points):
        look = f"series {one.about.kind} s{one.colour}" + (" dashed" if one.about.dashed else "")
        shapes.append(element("g", *_shapes(one, frame), class_=look, data_series=number))
    words = f"{chart.title}: {chart.y_name} over {chart.x_name}; {', '.join(one.about.name for one in points)}"
    drawing = element(
        "svg", *shapes, viewBox=f"0 0 {SIDE} {SIDE}", preserveAspectRatio="none", aria_hidden="true", focusable="false"
    )
    gap = float(np.diff(x_ticks).min()) if len(x_ticks) > 1 else 1.0
    step = float(np.diff(y_ticks).min()) if len(y_ticks) > 1 else 1.0
    names = [
        *(_word("y", 1 - frame.up(y), label(y, step) + (f" {chart.unit}" if chart.unit else "")) for y in y_ticks),
        *_across_words(x_ticks, gap, frame, chart.x_words),
        *(_word("at-x", frame.across(x), words, "end" if frame.across(x) > 0.5 else "") for x, words in at_x),
        *(_word("at-y", 1 - frame.up(y), words) for y, words in at_y),
    ]
    keys = "arrow keys move along the curve"
    return element(
        "div",
        drawing,
        *names,
        element("div", class_="cursor", hidden=True),
        data(_under_the_pointer(chart, points, frame)),
        class_="plot",
        tabindex="0",
        role="img",
        aria_label=words,
        aria_description=keys,
    )


def _across_words(places: NDArray[np.floating], gap: float, frame: Frame, words: Sequence[str]) -> list[Html]:
    """Labels of the x axis; those that a phone has no room for are marked, and those that nobody has are left out."""
    out, last, narrow = [], -1.0, -1.0
    for x in places:
        text, at = words[round(x)] if words else label(float(x), gap), frame.across(float(x))
        if at - last < 0.045:
            continue
        tight = at - narrow < 0.025 * (len(text) + 1.5)
        out.append(_word("x", at, text, "tight" if tight else ""))
        last, narrow = at, narrow if tight else at
    return out


def _word(look: str, fraction: float, text: str, more: str = "") -> Html:
    side = "left" if look in ("x", "at-x") else "top"
    return element("span", text, class_=f"word {look} {more}".strip(), style=f"{side}:{100 * fraction:.2f}%")


def _shapes(one: Points, frame: Frame) -> list[Html]:
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
        return [element("path", d=path, class_="bars")]
    few = len(one.x) <= BARS_UP_TO
    if one.low is not None and one.high is not None:
        if few:
            bars = zip(one.x, one.low, one.high, strict=True)
            d = "".join(f"M{frame.place(x, low)}V{units(1 - frame.up(high))}" for x, low, high in bars)
            out.append(element("path", d=d, class_="whisker"))
        else:
            there = _line(one.x, one.high, frame, kind)
            back = _line(one.x, one.low, frame, kind, back=True)
            out.append(element("path", d=f"{there}L{back[1:]}Z", class_="band"))
    if kind != "points":
        out.append(element("path", d=_line(one.x, one.y, frame, kind), class_="line"))
    if few or kind == "points":
        dots = "".join(f"M{frame.place(x, y)}h.01" for x, y in zip(one.x, one.y, strict=True))
        out.append(element("path", d=dots, class_="dots" if kind == "points" or len(one.x) <= 25 else "dots small"))
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
