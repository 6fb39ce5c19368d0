"""What a chart is made of: curves by name, axes, and the same as arrays, thinned to what a screen can show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.estimate import Estimate

MOST_POINTS = 400
"""Points of a curve that are drawn and shown under the pointer; longer ones are thinned evenly."""
BARS_UP_TO = 40
"""Intervals of so few points are drawn as bars, of more as a band."""
COLOURS = 8
SIDE = 1000
"""Units of the drawing in each direction, stretched to the space that there is."""


@dataclass(frozen=True, eq=False)
class Series:
    """A curve by name.

    Attributes:
        name: in the legend. x, y: of its points; NaN is left out.
        low, high: of the interval of each point, if there are any.
        kind: "line", "step" (holds each value to the next x), "points" (marks alone) or "bars".
        dashed: for what is only compared with. colour: its number in the palette; None: its place among the series.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    kind: Literal["line", "step", "points", "bars"] = "line"
    dashed: bool = False
    colour: int | None = None

    @classmethod
    def of(cls, name: str, x: ArrayLike, estimates: Sequence[Estimate], scale: float = 100.0, **look: Any) -> Series:
        """Means times `scale` with their intervals; none where no interval is known of one."""
        means, low, high = scale * np.array([(one.mean, *one.ci95) for one in estimates]).reshape(-1, 3).T
        known = bool(np.isfinite((low, high)).all())
        return cls(name, x, means, low if known else None, high if known else None, **look)


@dataclass(frozen=True)
class Chart:
    """Curves on one pair of axes.

    Attributes:
        title: its heading. series: the curves. x_name, y_name: of the axes. note: a line below.
        unit: after every value of y, "%" say. digits, x_digits: decimals of the values shown under the pointer.
        x_whole: label whole numbers alone. x_words: of 0, 1, 2, ..., in their place.
        y_range: shown at least; None: what the curves need, from 0. fit: the y axis begins where the curves do,
            not at 0, and `y_range` is what it never leaves.
        at_x: (x, words) of upright lines, where they are on the axis. at_y: (y, words) of level ones.
        interval: what low and high are, in words.
    """

    title: str
    series: tuple[Series, ...]
    x_name: str
    y_name: str
    note: str = ""
    unit: str = ""
    digits: int = 1
    x_digits: int = 0
    x_whole: bool = True
    x_words: Sequence[str] = ()
    y_range: tuple[float, float] | None = None
    fit: bool = False
    at_x: tuple[tuple[float, str], ...] = ()
    at_y: tuple[tuple[float, str], ...] = ()
    interval: str = "95 % interval"


@dataclass(frozen=True, eq=False)
class Points:
    """A series as arrays, thinned; `bars`: how wide a bar is."""

    about: Series
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    colour: int
    bars: float

    @property
    def ends(self) -> list[NDArray[np.float64]]:
        """All that must fit on the y axis."""
        return [values for values in (self.y, self.low, self.high) if values is not None]


def points_of(series: Series, place: int) -> Points:
    """The series as arrays; `place` among the series gives the colour, where it names none."""
    x, y = (np.asarray(values, dtype=np.float64).ravel() for values in (series.x, series.y))
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    bars = float(np.diff(x[known]).min()) if series.kind == "bars" and len(known) > 1 else 1.0
    if len(known) > MOST_POINTS and series.kind != "bars":
        known = known[np.unique(np.linspace(0, len(known) - 1, MOST_POINTS).round().astype(np.int64))]
    low, high = _ends(series.low, series.high, known, y)
    colour = place % COLOURS if series.colour is None else series.colour
    return Points(series, x[known], y[known], low, high, colour, bars)


def _ends(
    low: ArrayLike | None, high: ArrayLike | None, known: NDArray[np.int64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """The intervals of the `known` points; where an end is not known it is the point itself."""
    if low is None or high is None:
        return None, None
    ends = (np.asarray(values, dtype=np.float64).ravel()[known] for values in (low, high))
    lower, upper = (np.where(np.isfinite(end), end, y[known]) for end in ends)
    return lower, upper


def x_range_of(points: Sequence[Points]) -> tuple[float, float]:
    """What the x axis shows."""
    low, high = min(float(one.x.min()) for one in points), max(float(one.x.max()) for one in points)
    wide = max((one.bars for one in points if one.about.kind == "bars"), default=0.0)
    few = wide or (0.03 * (high - low) if max(len(one.x) for one in points) <= BARS_UP_TO else 0.0)
    if high == low:
        few = max(few, 0.5)
    return low - few, high + few


def y_range_of(chart: Chart, points: Sequence[Points]) -> tuple[float, float]:
    """What the y axis shows."""
    every = np.concatenate([end for one in points for end in one.ends])
    low, high = min(float(every.min()), 0.0), max(float(every.max()), *(y for y, _ in chart.at_y), 0.0)
    if chart.fit:
        low = min([float(every.min()), *(y for y, _ in chart.at_y)])
        more, (least, most) = 0.05 * (high - low) or 1.0, chart.y_range or (-math.inf, math.inf)
        return max(low - more, least), min(high + more, most)
    high += 0.04 * (high - low)
    if chart.y_range is not None:
        low, high = min(low, chart.y_range[0]), max(float(every.max()), chart.y_range[1])
    return low, high if high > low else low + 1.0


class Frame:
    """From values to units of the drawing, and to percent of the plot's width and height."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.x, self.y = x, y

    def across(self, x: float) -> float:
        """From 0 at the left to 1 at the right."""
        return (x - self.x[0]) / (self.x[1] - self.x[0])

    def up(self, y: float) -> float:
        """From 0 at the bottom to 1 at the top."""
        return (y - self.y[0]) / (self.y[1] - self.y[0])

    def place(self, x: float, y: float) -> str:
        """The point as the drawing has it: "across down"."""
        return f"{units(self.across(x))} {units(1 - self.up(y))}"


def units(fraction: float) -> str:
    """A part of a side in the drawing's units, kept near the drawing."""
    return f"{min(max(fraction, -1.0), 2.0) * SIDE:.1f}".rstrip("0").rstrip(".")
