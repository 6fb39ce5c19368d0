"""The picture of `mrac-jax check`: every formula on a number line."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator

from analysis.checking.check_map import MapCheck
from analysis.pictures.style import GRID, INK, WIDTH, heading, inches, new_figure, plain
from analysis.theory.formulas import FORMULAS, Direction
from analysis.theory.verdicts import Check, Verdict
from planner.shown import counted

VERDICT_COLOURS = {
    Verdict.FAILS: "#b3263a",
    Verdict.UNDECIDED: "#8a7f00",
    Verdict.HOLDS: "#1f4e86",
    Verdict.VACUOUS: "#9aa3ad",
}
OPEN_LOOP, CLOSED_LOOP = "#20242b", "#2c7a5b"


def check_figure(checked: MapCheck) -> Figure:
    """Every formula in cells as a mark on one scale, a row each, with the truths as lines."""
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
    axes.set_xlabel("expected cells visited (grey: what no team can cover)", loc="right", labelpad=2)
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
    """A mark at the value, above for the open loop and below for the closed one; an arrow if it is off the scale."""
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
