"""What `mrac-jax reproduce` says: the statements in a table, the points in another, JSON, and the folder of `--out`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from analysis.kit.face import json_end
from analysis.kit.folder import as_text, csv_text, json_text, write_all
from analysis.kit.tables import make_table, print_lines
from analysis.reproduction.points import Point
from analysis.reproduction.reproduce import Reproduction
from analysis.reproduction.statements import Finding, StatementVerdict
from planner.files import Json

TITLES = {
    "fig4": "Fig. 4: single runs on contiguous maps",
    "fig5": "Fig. 5: 1 to 20 robots, contiguous threats",
    "fig6": "Fig. 6: 1 to 20 robots, scattered threats",
    "fig7": "Fig. 7: 8 robots, threats on 0 to 35 % of the cells",
}
STATED: dict[str, tuple[tuple[float, float], ...]] = {"fig5": ((1, 0.44), (2, 0.62))}
"""(abscissa, coverage) that the paper's text gives."""
TABLE = (
    ("visited", "closed", "visited", 100.0),
    ("survived", "closed", "survived", 100.0),
    ("of free", "closed", "visited_free", 100.0),
    ("first", "first", "visited", 100.0),
    ("open", "open", "visited", 100.0),
    ("ideal", "ideal", "visited", 100.0),
    ("time", "closed", "time", 1.0),
    ("first", "first", "time", 1.0),
    ("open", "open", "time", 1.0),
)
"""(heading, loop, figure, scale)."""


def headline(answer: Reproduction) -> str:
    """How many of the paper's statements are reproduced."""
    found = answer.findings
    counts = {verdict: sum(one.verdict is verdict for one in found) for verdict in StatementVerdict}
    said = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"Of {len(found)} statements of the paper on these figures: {said}." if found else "Nothing to compare."


def print_reproduction(answer: Reproduction, console: Console) -> None:
    """Print the answer, the statements, and the points of each figure."""
    console.print(headline(answer), markup=False, highlight=False)
    finished = answer.finished
    cut = "; interrupted: the maps that were done" if finished.partial else ""
    console.print(
        f"{answer.maps:,} maps a point, {answer.rollouts:,} rollouts a map and loop, {finished.seconds:.0f} s"
        f" ({finished.rollouts:,} rollouts run, {finished.reused:,} from the store){cut}",
        markup=False,
        highlight=False,
    )
    if answer.findings:
        console.print(_statements(answer.findings))
    for figure in answer.figures:
        if figure != "fig4":
            console.print(_points(figure, answer.of(figure)))
    notes = ["Deviation: in standard errors; of Fig. 4's runs in those of a bell of our runs. Beyond 3 decides."]
    if set(answer.figures) != {"fig4"}:
        notes.append(
            "Coverage in %, time in steps, means over maps; se: the largest standard error of a coverage and of a time "
            "in the row. visited, survived: of the accessible cells, every visit checked; first: only the first visit "
            "of a cell can stop a robot."
        )
    print_lines(console, notes)


def _statements(found: list[Finding]) -> Table:
    columns = ("figure", "statement", "here", "deviation", "")
    left = tuple(name for name in columns if name != "deviation")
    table = make_table(columns, "What the paper says", left=left, padding=(0, 1, 0, 0))
    for one in found:
        table.add_row(one.figure, one.statement, one.found, f"{one.deviation:+.1f}", str(one.verdict))
    return table


def _points(figure: str, points: list[Point]) -> Table:
    columns = (_axis(figure)[0], *(name for name, *_ in TABLE), "se")
    table = make_table(columns, TITLES[figure], padding=(0, 1, 0, 0))
    for point in points:
        estimates = [(scale, point.estimate(loop, name)) for _, loop, name, scale in TABLE]
        largest = [max(s * e.se for s, e in estimates if (s == 1) == steps) for steps in (False, True)]
        shown = (f"{scale * estimate.mean:.1f}" for scale, estimate in estimates)
        table.add_row(f"{_at(figure, point):g}", *shown, " / ".join(f"{se:.1f}" for se in largest))
    return table


def _axis(figure: str) -> tuple[str, bool]:
    return ("threats, %", True) if figure == "fig7" else ("robots", False)


def _at(figure: str, point: Point) -> float:
    return 100 * point.ratio if figure == "fig7" else point.robots


def reproduction_json(answer: Reproduction) -> Json:
    """The JSON object of `reproduce`; coverage is a fraction."""
    finished = answer.finished
    return {
        "answer": headline(answer),
        "maps": answer.maps,
        "rollouts": answer.rollouts,
        "seed": answer.seed,
        "figures": {name: [_point_json(point) for point in answer.of(name)] for name in answer.figures},
        "statements": [
            {
                "figure": one.figure,
                "statement": one.statement,
                "found": one.found,
                "deviation": one.deviation if abs(one.deviation) < float("inf") else None,
                "verdict": str(one.verdict),
            }
            for one in answer.findings
        ],
        "seconds": finished.seconds,
        "rollouts_run": finished.rollouts,
        "rollouts_reused": finished.reused,
        **json_end(answer),
    }


def _point_json(point: Point) -> Json:
    out: Json = {"kind": point.kind, "robots": point.robots, "ratio": point.ratio}
    for loop, figure in point.means:
        out.setdefault(loop, {})[figure] = point.estimate(loop, figure).to_json()
    return out


def save_reproduction(answer: Reproduction, folder: Path, command: str) -> list[Path]:
    """Write page, tables, JSON, every point as CSV, and the pictures; `command`: what made it, for the page."""
    from analysis.pictures.style import png_of
    from analysis.reproduction.pictures import draw_figure, runs_figure

    pictures: dict[str, bytes] = {}
    for name in answer.figures:
        if name == "fig4":
            pictures["fig4.png"] = png_of(runs_figure, answer.of(name), TITLES[name])
        else:
            pictures[f"{name}.png"] = png_of(
                draw_figure, answer.of(name), TITLES[name], STATED.get(name, ()), _axis(name)[1]
            )
    files: dict[str, str | bytes] = {
        "reproduction.txt": as_text(lambda console: print_reproduction(answer, console), 140),
        "reproduction.json": json_text(reproduction_json(answer)),
        "points.csv": _csv(answer),
    }
    page = reproduction_page(answer, command, pictures, list(files))
    return write_all(folder, {"index.html": page, **files, **pictures})


def reproduction_page(answer: Reproduction, command: str, pictures: dict[str, bytes], files: list[str]) -> str:
    """The page of the folder, as HTML."""
    from analysis.page.curves import Chart
    from analysis.page.sweep_page import sweep_page
    from analysis.page.tables import from_rich
    from analysis.reproduction.pictures import COVERAGE_CURVES, TIME_CURVES

    charts = []
    for figure in answer.figures:
        if figure == "fig4":
            continue
        name = "threats, % of the cells" if figure == "fig7" else "robots"
        for curves, what, scale in ((COVERAGE_CURVES, "coverage", 100.0), (TIME_CURVES, "time", 1.0)):
            series = [_series(answer.of(figure), figure, curve, scale) for curve in curves]
            if what == "coverage" and figure in STATED:
                stated = [(at, 100 * value) for at, value in STATED[figure]]
                series.append(_stated(stated))
            unit, limits = ("%", (0.0, 100.0)) if what == "coverage" else ("", None)
            words = "steps" if what == "time" else "covered"
            charts.append(Chart(f"{TITLES[figure]}: {what}", tuple(series), name, words, unit=unit, y_range=limits))
    tables = [from_rich(_statements(answer.findings))] if answer.findings else []
    tables += [from_rich(_points(figure, answer.of(figure))) for figure in answer.figures if figure != "fig4"]
    missed = [one for one in answer.findings if one.verdict is StatementVerdict.NOT_REPRODUCED]
    findings = [f"Not reproduced: {one.figure}, {one.statement} ({one.found})." for one in missed]
    settings = {
        "maps a point": f"{answer.maps:,}",
        "rollouts a map and loop": f"{answer.rollouts:,}",
        "seed of the first map": str(answer.seed),
    }
    return sweep_page(
        "The paper's experiments, again", headline(answer), charts, tables, findings, settings, command, pictures,
        files=tuple(files), kind="reproduce",
    )  # fmt: skip


def _series(points: list[Point], figure: str, curve: tuple[str, ...], scale: float) -> Any:
    from analysis.page.curves import Series

    loop, what, name, _, line = curve
    estimates = [point.estimate(loop, what) for point in points]
    low, high = ([scale * estimate.ci95[end] for estimate in estimates] for end in (0, 1))
    at, means = [_at(figure, point) for point in points], [scale * estimate.mean for estimate in estimates]
    known = all(math.isfinite(value) for value in (*low, *high))
    return Series(name, at, means, low if known else None, high if known else None, dashed=line != "-")


def _stated(points: list[tuple[float, float]]) -> Any:
    from analysis.page.curves import Series

    return Series("stated in the paper", [at for at, _ in points], [value for _, value in points], kind="points")


def _csv(answer: Reproduction) -> str:
    """Mean, standard error and interval of every figure at every point."""
    names, rows = ("kind", "robots", "ratio", "loop", "figure", "maps", "rollouts", "mean", "se", "low", "high"), []
    for point in answer.points.values():
        for loop, figure in point.means:
            estimate = point.estimate(loop, figure)
            values = (f"{value:.9g}" for value in (estimate.mean, estimate.se, *estimate.ci95))
            where = (point.kind, point.robots, point.ratio, loop, figure, answer.maps, point.rollouts)
            rows.append((*where, *values))
    return csv_text(names, rows)
