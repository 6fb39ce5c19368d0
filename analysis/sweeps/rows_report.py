"""Rows of results as a table for the terminal, as JSON, as CSV: the same for `sweep` and `results`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table

from analysis.kit.folder import csv_text
from analysis.kit.tables import make_table
from analysis.statistics.estimate import Estimate
from analysis.sweeps.cases import Label
from analysis.sweeps.rows import DIFFERENCES, EXACT, Row
from analysis.sweeps.summary import FIGURES
from planner.files import Json
from planner.shown import counted

PERCENT = ("visited", "survived", "visited_of_free", "survived_of_free", "complete")
SHOWN_ROWS = 200
"""Rows of a table on the terminal; CSV and JSON have all."""


def print_rows(rows: Sequence[Row], console: Console) -> None:
    """The table: one line a row, means with half the width of their 95 % intervals."""
    console.print(rows_table(rows[:SHOWN_ROWS]))
    counts = {(row.maps, row.rollouts) for row in rows}
    if len(counts) == 1:
        maps, rollouts = counts.pop()
        console.print(f"Each row: {counted(maps, 'map')}, {counted(rollouts, 'rollout')}.", highlight=False)
    if any(row.maps == 1 for row in rows):
        where = "±" if all(row.maps == 1 for row in rows) else "where there is 1 map, ±"
        console.print(
            f"{where} (95 %) is the luck of the rollouts on that map; other maps are not in it", highlight=False
        )
    if len(rows) > SHOWN_ROWS:
        console.print(f"... and {len(rows) - SHOWN_ROWS:,} more: --csv or --json has all", highlight=False)


def rows_table(rows: Sequence[Row]) -> Table:
    """The table as a rich one."""
    names = list(dict.fromkeys(name for row in rows for name in row.labels))
    counts = [(row.maps, row.rollouts) for row in rows]
    uneven, compared = len(set(counts)) > 1, any(row.difference("visited") is not None for row in rows[1:])
    labels = [name.replace("_", " ") for name in names]
    figures = (*(("maps", "rollouts") if uneven else ()), "visited, %", "survived, %", "open, %", "complete, %", "time")
    columns = (*labels, *figures, *(("- first, %",) if compared else ()))
    table = make_table(columns, left=labels, dropped=("open, %", "survived, %", "complete, %"))
    for number, row in enumerate(rows):
        cells = [shown(row.labels.get(name)) for name in names]
        cells += [f"{row.maps:,}", f"{row.rollouts:,}"] if uneven else []
        cells += [percent(row.estimate("visited")), percent(row.estimate("survived"))]
        cells += [f"{100 * row.exact('visited').mean:.2f}", percent(row.estimate("complete"))]
        cells.append(around(row.estimate("time")))
        if compared:
            change = row.difference("visited") if number else None
            cells.append("" if change is None else f"{'+' if change.mean > 0 else ''}{percent(change)}")
        table.add_row(*cells)
    return table


def percent(estimate: Estimate) -> str:
    """A fraction with its interval, in percent."""
    digits = 2 if estimate.half_width < 0.01 else 1
    return f"{100 * estimate.mean:.{digits}f} ± {100 * estimate.half_width:.{digits}f}"


def around(estimate: Estimate) -> str:
    """A mean with its interval."""
    digits = 1 if estimate.half_width < 10 else 0
    return f"{estimate.mean:,.{digits}f} ± {estimate.half_width:,.{digits}f}"


def shown(value: Label) -> str:
    """A label's value as text."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def estimate_json(estimate: Estimate | None) -> Json | None:
    """An estimate as JSON; what is undefined is null."""
    return None if estimate is None or not math.isfinite(estimate.mean) else estimate.to_json()


def row_json(row: Row) -> Json:
    """A row as JSON: coverage as fractions, time in steps."""
    return {
        "setting": row.labels,
        "maps": row.maps,
        "rollouts": row.rollouts,
        "timeouts": row.timeouts,
        **{name: estimate_json(row.estimate(name)) for name in FIGURES},
        "open_loop_exact": {name: estimate_json(row.exact(name)) for name in EXACT},
        "ideal_team": estimate_json(row.ideal),
        "difference_from_first": {name: estimate_json(row.difference(name)) for name in DIFFERENCES},
        "within_share": row.within_share,
    }


def rows_csv(rows: Sequence[Row]) -> str:
    """The rows as CSV: labels, counts, then mean, se, low and high of every figure."""
    names = list(dict.fromkeys(name for row in rows for name in row.labels))
    heads = [f"{name}_{part}" for name in FIGURES for part in ("mean", "se", "low", "high")]
    heads = [*names, "maps", "rollouts", *heads, "open_loop_exact_visited", "ideal_team"]

    def values(row: Row) -> Iterator[object]:
        yield from (*(row.labels.get(name) for name in names), row.maps, row.rollouts)
        for found in map(row.estimate, FIGURES):
            yield from (found.mean, found.se, *found.ci95)
        yield from (row.exact("visited").mean, row.ideal.mean)

    return csv_text(heads, map(values, rows))
