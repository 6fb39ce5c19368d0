"""Reports of `mrac-jax sweep` and `results`: a row for each setting with means over maps, and curves over settings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from analysis.page.elements import CURVE_COLOURS as COLOURS
from analysis.page.elements import Chart, Series
from analysis.report.model import Report, Section
from analysis.statistics.estimates import Estimate
from analysis.sweeps.cases import Label, format_label
from analysis.sweeps.results import FIGURES, FRACTIONS, Results, Row
from analysis.sweeps.sweep import Sweep
from analysis.utils.tables import Column, csv_text, table_of
from planner.arguments import check_word
from planner.files import atomic_write
from planner.formatting import counted, duration, in_percent

NAMES = {
    "visited": "cells visited, of the accessible ones",
    "survived": "cells visited and left alive, of the accessible ones",
    "visited_of_free": "cells visited, of all free ones",
    "survived_of_free": "cells visited and left alive, of all free ones",
    "complete": "rollouts that covered everything",
    "time": "time, steps",
    "alive": "robots alive at the end",
}
PERCENT = (*FRACTIONS, "complete")
CHARTS = ("visited", "survived", "time", "complete")
PICTURES = ("visited", "time")
MOST_LINES = 2 * COLOURS
SHOWN_ROWS, PAGE_ROWS = 200, 2000
"""Rows of a table on the terminal, and on a page; CSV and JSON have all rows."""


def of_sweep(sweep: Sweep) -> Report:
    """The lowest and highest coverage of the settings; the rows; curves over the settings."""
    spec, rows = sweep.spec, sweep.rows
    settings: dict[str, Label] = {"sweep": spec.source.name, "maps": spec.maps or 1, "rollouts a map": spec.rollouts}
    settings |= {f"base: {name}": str(value) for name, value in spec.base.items()}
    settings |= {f"swept: {name}": ", ".join(str(value) for value in values)[:200] for name, values in spec.swept}
    return Report(
        "sweep", "sweep", spec.source.stem, summary(sweep), sweep,
        took=[done_words(sweep)], parts=[_rows_part(rows, charted=True)], notes=sweep.notes, settings=settings,
        pictures={f"{figure}.png": partial(_charts, rows, [figure]) for figure in PICTURES},
        files={"rows.csv": partial(rows_csv, rows)},
    )  # fmt: skip


def of_results(results: Results) -> Report:
    """The number of runs, their common labels, and the rows."""
    common = ", ".join(f"{name} {format_label(value)}" for name, value in results.common.items())
    said = f"{counted(results.runs, 'run')}{': ' if common else ''}{common}"
    return Report("results", "results", "", said, results, parts=[_rows_part(results.rows)], notes=results.notes)


def summary(sweep: Sweep) -> str:
    """The result in one sentence: the lowest and highest coverage of the settings."""
    low, high = (pick(sweep.rows, key=lambda row: row.estimate("visited").mean) for pick in (min, max))
    on = "one map" if sweep.spec.maps is None else f"a mean over {counted(high.maps, 'map')}"
    if low is high:
        return f"{percent(high.estimate('visited'), ' %')} of the accessible cells visited, {on}."
    ends = (f"{percent(row.estimate('visited'), ' %')} ({named(row)})" for row in (low, high))
    return f"Visited of the accessible cells, {on}: from {' to '.join(ends)}."


def named(row: Row) -> str:
    """A row's labels as text."""

    def text(name: str, value: Label | None) -> str:
        team = name == "robots" and isinstance(value, int)
        return counted(int(value), "robot") if team and value else f"{name.replace('_', ' ')} {format_label(value)}"

    return ", ".join(text(name, value) for name, value in row.labels.items())


def done_words(sweep: Sweep) -> str:
    """The work done and the precision reached, in one sentence."""
    finished = sweep.finished
    on = "one map" if sweep.spec.maps is None else counted(max(row.maps for row in sweep.rows), "map")
    ran = f"{counted(finished.rollouts, 'rollout')} run" if finished.rollouts else "nothing to run"
    reused = f", {finished.reused:,} taken from the store" if finished.reused else ""
    begins = "Interrupted: " if sweep.partial else ""
    said = f"{begins}{counted(len(sweep.rows), 'setting')} on {on}: {ran}{reused} in {duration(finished.seconds)}"
    if not math.isnan(sweep.widest):
        said += f"; every mean visited coverage is within ± {100 * sweep.widest:.2f} points (95 %)"
    return said + "."


def _rows_part(rows: Sequence[Row], charted: bool = False) -> Section:
    """The table with its notes; `charted`: with curves on a page."""
    notes, counts = list[str](), {(row.maps, row.rollouts) for row in rows}
    if len(counts) == 1:
        maps, rollouts = counts.pop()
        notes.append(f"Each row: {counted(maps, 'map')}, {counted(rollouts, 'rollout')}.")
    if any(row.difference("visited") is not None for row in rows[1:]):
        notes.append("more than first: visited coverage minus that of the first row, in points, on the same maps")
    if any(row.maps == 1 for row in rows):
        where = "±" if all(row.maps == 1 for row in rows) else "where there is 1 map, ±"
        notes.append(f"{where} (95 %) is the error over rollouts on that map; it does not include other maps")
    if len(rows) > SHOWN_ROWS:
        notes.append(f"... and {len(rows) - SHOWN_ROWS:,} more: --csv and --json have all")
    whole = [rows_table(rows[:PAGE_ROWS])] if len(rows) > SHOWN_ROWS else []
    drawn = partial(_charts, rows, CHARTS) if charted and len(lines_of(rows)[2]) < len(rows) else tuple
    return Section("Results", [rows_table(rows[:SHOWN_ROWS])], notes, figures=drawn, whole=whole)


def rows_table(rows: Sequence[Row]) -> Table:
    """One line for each row: means with half the width of their 95 % intervals."""
    uneven = len({(row.maps, row.rollouts) for row in rows}) > 1
    compared = any(row.difference("visited") is not None for row in rows)

    def label(name: str) -> Column:
        return Column(name.replace("_", " "), lambda row: format_label(row.labels.get(name)), words=True)

    columns = (
        *map(label, dict.fromkeys(name for row in rows for name in row.labels)),
        Column("maps", lambda row: f"{row.maps:,}", shown=uneven),
        Column("rollouts", lambda row: f"{row.rollouts:,}", shown=uneven),
        Column("visited, %", lambda row: percent(row.estimate("visited"))),
        Column("survived, %", lambda row: percent(row.estimate("survived"))),
        Column("open, %", lambda row: (known := row.known("exact visited")) and in_percent(known.mean, 2)),
        Column("complete, %", lambda row: percent(row.estimate("complete"))),
        Column("time", lambda row: around(row.estimate("time"))),
        Column("more than first, points", lambda row: (more := row.difference("visited")) and percent(more, sign="+"),
               shown=compared),
    )  # fmt: skip
    return table_of(columns, rows, dropped=("open, %", "survived, %", "complete, %"))


def percent(estimate: Estimate, unit: str = "", sign: str = "") -> str:
    """A fraction with its interval, in percent; `unit` follows the mean, or the half-width. `sign`: "+", a change."""
    most = None if sign else 100
    return estimate.around(100, sign, most=most, digits=2 if estimate.half_width < 0.01 else 1, unit=unit)


def around(estimate: Estimate) -> str:
    """A mean with its interval."""
    return estimate.around(digits=1 if estimate.half_width < 10 else 0)


def _charts(rows: Sequence[Row], figures: Sequence[str]) -> list[Chart]:
    return [rows_chart(rows, figure) for figure in figures]


def rows_chart(rows: Sequence[Row], figure: str) -> Chart:
    """A figure over one of the settings, a line for each combination of the others."""
    axis, words, lines = lines_of(rows)
    scale = 100.0 if figure in PERCENT else 1.0
    series = tuple(
        Series.of(name or NAMES[figure], [at for at, _ in points], [row.estimate(figure) for _, row in points], scale,
                  dashed=number >= COLOURS)
        for number, (name, points) in enumerate(list(lines.items())[:MOST_LINES])
    )  # fmt: skip
    maps = [row.maps for row in rows]
    over = "mean over " + (f"{min(maps):,} to " if min(maps) < max(maps) else "") + counted(max(maps), "map")
    more = f"; {len(lines) - MOST_LINES} further lines are omitted" if len(lines) > MOST_LINES else ""
    look: dict[str, Any] = {"unit": "%", "y_range": (0.0, 100.0)} if figure in PERCENT else {}
    return Chart(NAMES[figure], series, axis.replace("_", " "), over + more, x_words=words, **look)


def write_chart(rows: Sequence[Row], figure: str, path: Path) -> None:
    """Write the chart as a picture, completely or not at all. Raises InputError."""
    from analysis.page.charts import charts_figure
    from analysis.pictures import png_of

    check_word("figure", figure, FIGURES)
    with atomic_write(path, "wb") as out:
        out.write(png_of(charts_figure, [rows_chart(rows, figure)]))


def lines_of(rows: Sequence[Row]) -> tuple[str, tuple[str, ...], dict[str, list[tuple[float, Row]]]]:
    """(name of the abscissa, its words if it is not a number, lines by name: rows with abscissae from left to right).

    The abscissa is the first numeric setting, else the first setting: its words have the positions 0, 1, 2, ...
    """
    names = list(dict.fromkeys(name for row in rows for name in row.labels))
    numeric = [name for name in names if all(_is_number(row.labels.get(name)) for row in rows)]
    axis = next(iter([*numeric, *names]), "")
    words = [] if axis in numeric else list(dict.fromkeys(format_label(row.labels.get(axis)) for row in rows))
    lines: dict[str, list[tuple[float, Row]]] = {}
    for row in rows:
        value = row.labels.get(axis)
        at = float(words.index(format_label(value))) if words else float(value or 0)
        others = ", ".join(f"{name} {format_label(row.labels.get(name))}" for name in names if name != axis)
        lines.setdefault(others, []).append((at, row))
    return axis, tuple(words), {name: sorted(points, key=lambda point: point[0]) for name, points in lines.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def rows_csv(rows: Sequence[Row]) -> str:
    """Labels, counts, then mean, se, low and high of every figure."""
    names = list(dict.fromkeys(name for row in rows for name in row.labels))
    heads = [f"{name}_{part}" for name in FIGURES for part in ("mean", "se", "low", "high")]
    heads = [*names, "maps", "rollouts", *heads, "open_loop_exact_visited", "ideal_team"]

    def values(row: Row) -> Iterator[object]:
        yield from (*(row.labels.get(name) for name in names), row.maps, row.rollouts)
        for found in row.figures.values():
            yield from (found.mean, found.se, *found.ci95)
        yield from (row.estimate("exact visited").mean, row.estimate("ideal").mean)

    return csv_text(heads, map(values, rows))
