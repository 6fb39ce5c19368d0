"""The page of `mrac-jax sweep --out`: curves over the swept settings, the table, what was run, how to run it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.page.curves import Chart, Series
from analysis.page.sweep_page import sweep_page
from analysis.page.tables import from_rich
from analysis.sweeps.cases import Label
from analysis.sweeps.plots_rows import MOST_LINES, NAMES, lines_of
from analysis.sweeps.rows_report import PERCENT, rows_table
from analysis.sweeps.sweep import Sweep
from analysis.sweeps.sweep_report import answer_of, notes_of

CHARTS = ("visited", "survived", "time", "complete")
MOST_ROWS = 2000


def sweep_html(sweep: Sweep, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML; the same answer gives the same bytes."""
    spec = sweep.spec
    settings: dict[str, Label] = {"sweep": spec.source.name, "maps": spec.maps or 1, "rollouts a map": spec.rollouts}
    settings |= {f"base: {name}": str(value) for name, value in spec.base.items()}
    settings |= {f"swept: {name}": ", ".join(str(value) for value in values)[:200] for name, values in spec.swept}
    return sweep_page(
        spec.source.stem,
        answer_of(sweep),
        [chart for name in CHARTS if (chart := _chart(sweep, name)) is not None],
        [from_rich(rows_table(sweep.rows[:MOST_ROWS]))],
        notes_of(sweep),
        settings,
        command,
        pictures,
        files=files,
    )


def _chart(sweep: Sweep, name: str) -> Chart | None:
    axis, lines, words = lines_of(sweep.rows)
    if not any(len(line.points) > 1 for line in lines):
        return None
    scale = 100.0 if name in PERCENT else 1.0
    series = []
    for line in lines[:MOST_LINES]:
        found = [row.estimate(name) for _, row in line.points]
        series.append(
            Series(
                line.name or NAMES[name],
                [at for at, _ in line.points],
                [scale * each.mean for each in found],
                [scale * each.ci95[0] for each in found],
                [scale * each.ci95[1] for each in found],
                kind="points" if words else "line",
            )
        )
    places = [at for line in lines for at, _ in line.points]
    note = "; ".join(f"{number}: {word}" for number, word in enumerate(words))
    return Chart(
        NAMES[name],
        tuple(series),
        axis.replace("_", " "),
        "mean over maps",
        note=note,
        unit="%" if name in PERCENT else "",
        digits=2 if name in PERCENT else 1,
        x_digits=0 if all(at == int(at) for at in places) else 2,
        x_whole=all(at == int(at) for at in places),
        y_range=(0.0, 100.0) if name in PERCENT else None,
    )
