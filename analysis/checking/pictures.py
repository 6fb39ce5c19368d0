"""The pictures of `mrac-jax check`: all formulas on a number line; of a survey, bounds against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, Locator, NullLocator
from numpy.typing import NDArray

from analysis.checking.check import MapCheck, Survey
from analysis.pictures import FAINT, GRID, INK, WIDTH, heading, inches, new_figure, plain, whole_ticks
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


# The picture of a survey: every bound against the truth.

TEAM_COLOURS = ("#0072b2", "#00916a", "#7a2fa0", "#c0612b", "#111111", "#d6409f", "#8a7f00", "#2fa8e6")
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


def scatter_figure(survey: Survey) -> Figure:
    """A panel for each formula, a point for each world and team, in the formula's unit; failures lie on red ground."""
    columns, side, gap = 3, 2.05, 0.5
    rows = -(-len(PANELS) // columns)
    figure = new_figure((WIDTH, 1.35 + rows * (side + gap + 0.2)))
    height = figure.get_size_inches()[1]
    points = _points(survey)
    for number, key in enumerate(PANELS):
        row, column = divmod(number, columns)
        box = (0.55 + column * (side + gap), height - 0.95 - (row + 1) * (side + gap + 0.2) + gap + 0.05, side, side)
        axes = figure.add_axes(inches(figure, box))
        _draw_scatter(axes, key, points.get(key, {}), survey.choices.teams)
    handles = [
        Line2D([], [], color=_team_colour(place), marker="o", linestyle="", markersize=4, label=counted(k, "robot"))
        for place, k in enumerate(survey.choices.teams)
    ]
    handles.append(Line2D([], [], color=INK, linewidth=0.8, label="value = truth"))
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.05, 0.0), ncols=6)
    figure.text(0.069, 1 - 0.28 / height, "Formula against truth", fontsize=13, fontweight="bold", va="center")
    below = f"{survey.description}; a point a world and team; red ground: the formula fails"
    figure.text(0.069, 1 - 0.5 / height, below, fontsize=9, color=FAINT, va="center")
    return figure


def _points(survey: Survey) -> dict[str, dict[int, NDArray[np.float64]]]:
    """By key and size of team: (truth, value) of every world, float64 `[worlds, 2]`."""
    found: dict[str, dict[int, list[tuple[float, float]]]] = {}
    for entry in survey.entries:
        for check in entry.checks:
            found.setdefault(check.key, {}).setdefault(entry.robots, []).append((check.truth.value, check.value))
    return {key: {k: np.array(pairs) for k, pairs in teams.items()} for key, teams in found.items()}


def _draw_scatter(axes: Axes, key: str, teams: dict[int, NDArray[np.float64]], sizes: tuple[int, ...]) -> None:
    about = FORMULAS[key.split("/")[0]]
    loop, meaning = key.split("/")[-1], key.split("/")[1] if key.count("/") == 2 else "a robot survives"
    title = about.title + ("" if about.paper else " *")
    axes.set_title(title, loc="left", fontsize=8.5, fontweight="bold", color=INK, pad=14)
    axes.annotate(f"{about.direction}; {meaning}, {loop} loop", (0, 1), (0, 4), "axes fraction", "offset points",
                  fontsize=7.5, color=FAINT)  # fmt: skip
    plain(axes)
    axes.tick_params(labelsize=7)
    if not teams:
        axes.text(0.5, 0.5, "undefined on all worlds", ha="center", va="center", transform=axes.transAxes, color=FAINT)
        axes.xaxis.set_major_locator(NullLocator())
        axes.yaxis.set_major_locator(NullLocator())
        return
    every = np.concatenate(list(teams.values()))
    least, most = float(every.min()), float(every.max())
    pad = 0.04 * max(most - least, 1e-9)
    xs = np.array([every[:, 0].min() - pad, every[:, 0].max() + pad])
    low, high = max(every[:, 1].min(), -1.2 * most) - pad, every[:, 1].max() + pad
    low, high = min(low, xs[0]), max(high, xs[1])
    axes.plot([low, high], [low, high], color=INK, linewidth=0.8, zorder=2)
    if about.direction is Direction.LOWER:
        axes.fill_between(xs, xs, high, color="#b3263a", alpha=0.08, linewidth=0, zorder=0)
    elif about.direction is Direction.UPPER:
        axes.fill_between(xs, low, xs, color="#b3263a", alpha=0.08, linewidth=0, zorder=0)
    for robots, points in teams.items():
        colour = _team_colour(sizes.index(robots))
        axes.scatter(points[:, 0], points[:, 1], s=4, color=colour, alpha=0.45, linewidths=0, zorder=3)
    axes.set(xlim=tuple(xs), ylim=(low, high))
    axes.xaxis.set_major_locator(whole_or_fraction(about.unit))
    axes.yaxis.set_major_locator(whole_or_fraction(about.unit))
    axes.set_xlabel("truth", fontsize=7.5, labelpad=1)
    axes.set_ylabel("value", fontsize=7.5, labelpad=1)


def _team_colour(place: int) -> str:
    return TEAM_COLOURS[place % len(TEAM_COLOURS)]


def whole_or_fraction(unit: str) -> Locator:
    """Ticks at whole numbers, or at fifths of a probability."""
    return FixedLocator(np.linspace(0, 1, 6).tolist()) if unit == "chance" else whole_ticks(5)
