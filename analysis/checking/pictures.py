"""The pictures of `mrac-jax check`: all formulas on a number line; of a survey, bounds against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator

from analysis.checking.check import MapCheck, Survey
from analysis.page.elements import Chart, Series
from analysis.pictures import GRID, INK, WIDTH, heading, inches, new_figure, plain
from analysis.theory.verdicts import FORMULAS, Check, Direction, Verdict
from planner.formatting import counted

VERDICT_COLOURS = {
    Verdict.FAILS: "#b3263a",
    Verdict.UNDECIDED: "#8a7f00",
    Verdict.HOLDS: "#1f4e86",
    Verdict.VACUOUS: "#9aa3ad",
}
OPEN_LOOP, CLOSED_LOOP = "#20242b", "#2c7a5b"


def check_figure(checked: MapCheck) -> Figure:
    """All formulas in cells as marks on one scale, a row each, with the truths as lines."""
    checks = [c for c in checked.rows if c.about.unit == "cells" and c.meaning == "visited" and c.robot is None]
    rows: dict[str, list[Check]] = {}
    for check in checks:
        rows.setdefault(check.formula, []).append(check)
    figure = new_figure((WIDTH, 2.05 + 0.27 * len(rows)))
    axes = figure.add_axes(inches(figure, (2.15, 1.15, WIDTH - 2.45, 0.27 * len(rows))))
    cells = checked.cells
    values = [check.value for check in checks]
    left = min(0.0, max(min(values), -0.35 * cells))
    right = max(float(cells), min(max(values), 1.35 * cells))
    for place, found in enumerate(rows.values()):
        _draw_formula(axes, len(rows) - 1 - place, found, left, right)
    handles = _draw_truths(axes, checked)
    axes.axvspan(left - 0.03 * cells, 0, color=GRID, alpha=0.4, linewidth=0, zorder=0)
    axes.axvspan(cells, right + 0.03 * cells, color=GRID, alpha=0.4, linewidth=0, zorder=0)
    axes.set(xlim=(left - 0.03 * cells, right + 0.03 * cells), ylim=(-0.6, len(rows) - 0.4))
    titles = [FORMULAS[formula].title + ("" if FORMULAS[formula].paper else " *") for formula in rows]
    axes.yaxis.set_major_locator(FixedLocator(range(len(rows))))
    axes.set_yticklabels(titles[::-1])
    axes.set_xlabel("expected cells visited (grey: impossible)", loc="right", labelpad=2)
    plain(axes)
    marks = [
        Line2D([], [], color=colour, marker="o", linestyle="", markersize=5, label=str(verdict))
        for verdict, colour in VERDICT_COLOURS.items()
    ]
    shapes = [("> lower bound", ">"), ("< upper bound", "<")]
    marks += [Line2D([], [], color=INK, marker=m, linestyle="", markersize=5, label=name[2:]) for name, m in shapes]
    axes.legend(
        handles=[*handles, *marks], loc="upper left", bbox_to_anchor=(-0.35, -0.42 / (0.27 * len(rows))), ncols=4
    )
    heading(axes, *_check_heading(checked), left=-2.0)
    return figure


def _draw_formula(axes: Axes, place: int, checks: list[Check], left: float, right: float) -> None:
    """A mark at the value, above for the open loop and below for the closed loop; an arrow if it is off the scale."""
    for check in checks:
        up = 0.0 if len(checks) == 1 else 0.17 if check.loop == "open" else -0.17
        colour = VERDICT_COLOURS[check.verdict]
        at = min(max(check.value, left), right)
        shape = ">" if check.about.direction is Direction.LOWER else "<"
        truth = check.truth.value
        axes.plot([at, truth], [place + up] * 2, color=colour, linewidth=1.0, alpha=0.45, zorder=2)
        axes.plot([at], [place + up], marker=shape, color=colour, markersize=5, zorder=3, linestyle="")
        if at != check.value:
            axes.annotate(f"{check.value:.0f}", (at, place + up), (7 if at == left else -7, 0), "data", "offset points",
                          fontsize=7, color=colour, va="center", ha="left" if at == left else "right")  # fmt: skip


def _draw_truths(axes: Axes, checked: MapCheck) -> list[Line2D]:
    handles = [
        axes.axvline(checked.exact.visited, color=OPEN_LOOP, linewidth=1.2, zorder=1.5, label="open loop, exact")
    ]
    if checked.closed is not None:
        seen = checked.closed.visited
        how = "closed loop, sampled" if checked.closed.rollouts else "closed loop, exact"
        line = axes.axvline(seen.value, color=CLOSED_LOOP, linewidth=1.2, linestyle="--", zorder=1.5, label=how)
        axes.axvspan(seen.low, seen.high, color=CLOSED_LOOP, alpha=0.15, linewidth=0, zorder=1)
        handles.append(line)
    return handles


def _check_heading(checked: MapCheck) -> tuple[str, str]:
    failing = {c.formula for c in checked.checks if c.verdict is Verdict.FAILS and c.about.paper}
    title = f"{counted(len(failing), 'formula')} of the paper fail{'s' if len(failing) == 1 else ''} on this map"
    robots = counted(len(checked.plan.robots), "robot")
    below = f"{robots}; upper mark: against the open loop, lower: the closed loop; * ours, proven"
    return title, below


# The charts of a survey: every bound against the truth.

PANELS = (
    "eq2_printed/open",
    "eq5_printed/survived/open",
    "eq5_with_c00/survived/open",
    "theorem3_interior_set/visited/open",
    "theorem3_travel_set/visited/open",
    "theorem3_interior_multiset/visited/open",
    "mended_count/visited/open",
    "mended_largest/visited/open",
    "mended_spread/visited/open",
    "eq7_team/visited/closed",
    "ideal_connected/visited/closed",
)
"""Keys of the panels, bound against truth."""


def bound_charts(survey: Survey) -> list[Chart]:
    """A chart for each of PANELS, a point for each world and team, in the formula's unit."""
    points: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for entry in survey.entries:
        for check in entry.checks:
            points.setdefault((check.key, entry.robots), []).append((check.truth.value, check.value))
    charts = []
    for key in PANELS:
        about, (_, *meaning, loop) = FORMULAS[key.partition("/")[0]], key.split("/")
        found = {place: np.array(points[key, k]) for place, k in enumerate(survey.choices.teams) if (key, k) in points}
        truths = np.concatenate([np.empty(0), *(pairs[:, 0] for pairs in found.values())])
        ends = [truths.min(), truths.max()] if len(truths) else []
        series = [Series("value = truth", ends, ends, dashed=True, colour=3)]
        for place, pairs in found.items():
            # A point below a third of the axis would hide the others: a bound far below is worthless, however far.
            values = np.maximum(pairs[:, 1], -1.2 * truths.max())
            team = counted(survey.choices.teams[place], "robot")
            series.append(Series(team, pairs[:, 0], values, kind="points", colour=place))
        title = about.title + ("" if about.paper else " *")
        about_it = f"{about.direction}; {meaning[0] if meaning else 'a robot survives'}, {loop} loop"
        charts.append(
            Chart(title, tuple(series), "truth", f"{about_it}{'' if len(truths) else ': undefined'}", fit=True)
        )
    return charts
