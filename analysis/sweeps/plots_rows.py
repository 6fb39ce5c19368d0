"""The picture of a sweep: a figure over one of its settings, a line for each combination of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from analysis.pictures.style import (
    FAINT,
    GRID,
    LINE_STYLES,
    ROBOT_COLOURS,
    WIDTH,
    heading,
    inches,
    new_figure,
)
from analysis.sweeps.rows import Row
from analysis.sweeps.rows_report import PERCENT, shown
from planner.shown import counted

MOST_LINES = 24
NAMES = {
    "visited": "cells visited, of the accessible ones",
    "survived": "cells visited and left alive, of the accessible ones",
    "visited_of_free": "cells visited, of all free ones",
    "survived_of_free": "cells visited and left alive, of all free ones",
    "complete": "rollouts that covered everything",
    "time": "time, steps",
    "alive": "robots alive at the end",
}


@dataclass(frozen=True)
class Line:
    """A line: its name, and its rows from left to right with their abscissae."""

    name: str
    points: tuple[tuple[float, Row], ...]


def lines_of(rows: Sequence[Row], across: str | None = None) -> tuple[str, tuple[Line, ...], tuple[str, ...]]:
    """(name of the abscissa, lines, its words where it is no number): `across`, else the first setting of numbers.

    A setting of words takes the places 0, 1, 2, ...
    """
    names = list(dict.fromkeys(name for row in rows for name in row.labels))
    numeric = [name for name in names if all(_number(row.labels.get(name)) for row in rows)]
    axis = across or next(iter([*numeric, *names]), "")
    words: list[str] = []
    if axis not in numeric:
        words = list(dict.fromkeys(shown(row.labels.get(axis)) for row in rows))
    lines: dict[tuple[str, ...], list[tuple[float, Row]]] = {}
    for row in rows:
        value = row.labels.get(axis)
        at = float(words.index(shown(value))) if axis not in numeric else float(value or 0)
        others = tuple(f"{name} {shown(row.labels.get(name))}" for name in names if name != axis)
        lines.setdefault(others, []).append((at, row))
    made = [Line(", ".join(name), tuple(sorted(found, key=lambda p: p[0]))) for name, found in lines.items()]
    return axis, tuple(made), tuple(words)


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def rows_figure(rows: Sequence[Row], name: str, title: str, across: str | None = None) -> Figure:
    """Means over maps with their 95 % intervals."""
    axis, lines, words = lines_of(rows, across)
    drawn = lines[:MOST_LINES]
    below = 0.2 * -(-len(drawn) // 2) + 0.75
    figure = new_figure((WIDTH, 4.3 + below))
    axes = figure.add_axes(inches(figure, (0.75, below, WIDTH - 1.0, 3.4)))
    scale = 100.0 if name in PERCENT else 1.0
    for number, line in enumerate(drawn):
        _draw(axes, line, name, number, scale)
    axes.set_xlabel(axis.replace("_", " "))
    places = sorted({at for line in lines for at, _ in line.points})
    if words:
        axes.xaxis.set_major_locator(FixedLocator(range(len(words))))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda at, _: words[round(at)] if 0 <= at < len(words) else ""))
    elif len(places) <= 12:
        axes.xaxis.set_major_locator(FixedLocator(places))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda at, _: f"{at:g}"))
    if name in PERCENT:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} %"))
        axes.set_ylim(0, 102)
    else:
        axes.set_ylim(0, None)
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if len(drawn) > 1 or drawn[0].name:
        axes.legend(loc="upper left", bbox_to_anchor=(0, -0.13), ncols=2, borderaxespad=0, handlelength=2.2)
    maps = sorted({row.maps for row in rows})
    said = f"{maps[0]:,} to {counted(maps[-1], 'map')}" if len(maps) > 1 else counted(maps[0], "map")
    more = f"; {len(lines) - len(drawn)} lines more are left out" if len(lines) > len(drawn) else ""
    of = " of its rollouts" if maps == [1] else ""
    heading(axes, title, f"{NAMES[name]}; {said} a point, bars: 95 % intervals{of}{more}")
    return figure


def _draw(axes: Axes, line: Line, name: str, number: int, scale: float) -> None:
    estimates = [row.estimate(name) for _, row in line.points]
    values = [scale * found.mean for found in estimates]
    reach = [
        [scale * (found.mean - found.ci95[0]) for found in estimates],
        [scale * (found.ci95[1] - found.mean) for found in estimates],
    ]
    colours = ROBOT_COLOURS
    axes.errorbar(
        [at for at, _ in line.points],
        values,
        reach,
        color=colours[number % len(colours)],
        linestyle=LINE_STYLES[number // len(colours) % len(LINE_STYLES)],
        marker="o",
        markersize=3.6,
        linewidth=1.4,
        elinewidth=0.9,
        capsize=2.2,
        label=line.name or None,
        ecolor=colours[number % len(colours)] if len(line.points) < 40 else FAINT,
    )
