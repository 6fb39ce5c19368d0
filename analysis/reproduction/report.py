"""What `mrac-jax reproduce` says: the paper's statements, and the points of its figures from our maps."""

from __future__ import annotations

from functools import partial

import numpy as np
from rich.table import Table

from analysis.kit.folder import csv_text
from analysis.kit.tables import make_table
from analysis.page.series import Chart, Series
from analysis.report.answer import json_end
from analysis.report.blocks import Part, Report
from analysis.reproduction.points import FIGURE4, TIME_BIN, Point
from analysis.reproduction.reproduce import Reproduction
from analysis.reproduction.statements import Finding, StatementVerdict
from planner.files import Json
from planner.shown import counted

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
CURVES = {
    "coverage": (
        ("closed", "visited", "closed loop, visited"),
        ("closed", "survived", "... survived"),
        ("closed", "visited_free", "... visited, of all free cells"),
        ("first", "visited", "closed loop, first visits alone checked"),
        ("open", "visited", "open loop, exact"),
        ("ideal", "visited", "ideal of the team"),
    ),
    "time": (
        ("closed", "time", "closed loop"),
        ("first", "time", "first visits alone checked"),
        ("open", "time", "open loop: last move of a live robot"),
    ),
}
"""(loop, figure, name) of the curves of each chart."""


def report(answer: Reproduction) -> Report:
    """What became of the statements; coverage and time over the team or the ratio of threats, on the paper's axes."""
    finished, said = answer.finished, headline(answer)
    over = [figure for figure in answer.figures if figure != "fig4"]
    charts = {figure: [_chart(answer, figure, what) for what in CURVES] for figure in answer.figures}
    return Report(
        "reproduction", "reproduce", "The paper's experiments, again", said,
        lambda: {"answer": said} | reproduction_json(answer),
        heading=[
            f"{counted(answer.maps, 'map')} a point, {counted(answer.rollouts, 'rollout')} a map and loop, "
            f"first seed {answer.seed}"
        ],
        took=[finished.said],
        parts=(
            Part("Statements", [_statements(answer.findings)] if answer.findings else (), [DEVIATION]),
            Part("Points", [_points(figure, answer.of(figure)) for figure in over], [POINTS] if over else (),
                 drawn=lambda: [chart for pair in charts.values() for chart in pair]),
        ),
        warnings=("Interrupted: the maps that were done.",) if finished.partial else (),
        pictures={f"{name}.png": partial(list, pair) for name, pair in charts.items()},
        files={"points.csv": lambda: _csv(answer)},
    )  # fmt: skip


DEVIATION = "Deviation: in standard errors; of Fig. 4's runs in those of a bell of our runs. Beyond 3 decides."
POINTS = (
    "Coverage in %, time in steps, means over maps; se: the largest standard error of a coverage and of a time in the "
    "row. visited, survived: of the accessible cells, every visit checked; first: only the first visit of a cell can "
    "stop a robot."
)


def _chart(answer: Reproduction, figure: str, what: str) -> Chart:
    """Coverage or time over the points of a figure; of Fig. 4, how often which was reached."""
    if figure == "fig4":
        return _runs(answer.of(figure), what)
    scale, unit, limits = (100.0, "%", (0.0, 100.0)) if what == "coverage" else (1.0, "", None)
    series = [_series(answer.of(figure), figure, curve, scale) for curve in CURVES[what]]
    if what == "coverage" and figure in STATED:
        at, stated = zip(*STATED[figure], strict=True)
        series.append(Series("stated in the paper", at, [100 * value for value in stated], kind="points"))
    axis = "threats, % of the cells" if figure == "fig7" else "robots"
    words = "steps" if what == "time" else "covered"
    return Chart(f"{TITLES[figure]}: {what}", tuple(series), axis, words, unit=unit, y_range=limits)


def _runs(points: list[Point], what: str) -> Chart:
    """Where the single runs of Fig. 4 fall among all runs on our maps."""
    covered, series, marks = what == "coverage", [], []
    for point in points:
        counts, (coverage, steps) = np.trim_zeros(point.runs[what], "b"), FIGURE4[point.robots]
        at = (1 if covered else TIME_BIN) * np.arange(len(counts))
        series.append(Series(counted(point.robots, "robot"), at, 100 * counts / counts.sum(), kind="step"))
        marks.append((100 * coverage if covered else steps, f"the paper's, {counted(point.robots, 'robot')}"))
    axis = "coverage of the free cells, %" if covered else "steps"
    return Chart(f"{TITLES['fig4']}: {what}", tuple(series), axis, "runs, %", unit="%", at_x=tuple(marks))


def _series(points: list[Point], figure: str, curve: tuple[str, str, str], scale: float) -> Series:
    loop, what, name = curve
    estimates = [point.estimate(loop, what) for point in points]
    at = [_at(figure, point) for point in points]
    return Series.of(name, at, estimates, scale, dashed=name.startswith("..."))


def headline(answer: Reproduction) -> str:
    """How many of the paper's statements are reproduced."""
    found = answer.findings
    counts = {verdict: sum(one.verdict is verdict for one in found) for verdict in StatementVerdict}
    said = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"Of {len(found)} statements of the paper on these figures: {said}." if found else "Nothing to compare."


def _statements(found: list[Finding]) -> Table:
    columns = ("figure", "statement", "here", "deviation", "")
    left = tuple(name for name in columns if name != "deviation")
    table = make_table(columns, "What the paper says", left=left, padding=(0, 1, 0, 0))
    for one in found:
        table.add_row(one.figure, one.statement, one.found, f"{one.deviation:+.1f}", str(one.verdict))
    return table


def _points(figure: str, points: list[Point]) -> Table:
    columns = ("threats, %" if figure == "fig7" else "robots", *(name for name, *_ in TABLE), "se")
    table = make_table(columns, TITLES[figure], padding=(0, 1, 0, 0))
    for point in points:
        estimates = [(scale, point.estimate(loop, name)) for _, loop, name, scale in TABLE]
        largest = [max(s * e.se for s, e in estimates if (s == 1) == steps) for steps in (False, True)]
        shown = (f"{scale * estimate.mean:.1f}" for scale, estimate in estimates)
        table.add_row(f"{_at(figure, point):g}", *shown, " / ".join(f"{se:.1f}" for se in largest))
    return table


def _at(figure: str, point: Point) -> float:
    return 100 * point.ratio if figure == "fig7" else point.robots


def reproduction_json(answer: Reproduction) -> Json:
    """The JSON object of `reproduce`, but for its sentence; coverage is a fraction."""
    finished = answer.finished
    return {
        "maps": answer.maps,
        "rollouts": answer.rollouts,
        "seed": answer.seed,
        "figures": {name: [_point_json(point) for point in answer.of(name)] for name in answer.figures},
        "statements": answer.findings,
        "seconds": finished.seconds,
        "rollouts_run": finished.rollouts,
        "rollouts_reused": finished.reused,
        **json_end(answer),
    }


def _point_json(point: Point) -> Json:
    out: Json = {"kind": point.kind, "robots": point.robots, "ratio": point.ratio}
    for loop, figure in point.means:
        out.setdefault(loop, {})[figure] = point.estimate(loop, figure)
    return out


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
