"""The pictures of `mrac-jax check`: formulas on a number line; bound against truth; everything over the team's size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, Locator, NullLocator
from numpy.typing import NDArray

from analysis.check import Check, Verdict
from analysis.check_formulas import FORMULAS, Direction
from analysis.check_map import MapCheck
from analysis.plots_style import (
    FAINT,
    GRID,
    INK,
    WIDTH,
    heading,
    house_style,
    inches,
    new_figure,
    png_bytes,
    whole_ticks,
)
from analysis.survey import Entry, Survey
from analysis.words import counted

VERDICT_COLOURS = {
    Verdict.FAILS: "#b3263a",
    Verdict.UNDECIDED: "#8a7f00",
    Verdict.HOLDS: "#1f4e86",
    Verdict.VACUOUS: "#9aa3ad",
}
TEAM_COLOURS = ("#0072b2", "#00916a", "#7a2fa0", "#c0612b", "#111111", "#d6409f", "#8a7f00", "#2fa8e6")
OPEN_LOOP, CLOSED_LOOP = "#20242b", "#2c7a5b"
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
    "loss_tree_lower/visited/closed",
    "eq7_team/visited/closed",
    "ideal_connected/visited/closed",
)
"""What is drawn as bound against truth, by key."""
CURVES = (
    ("eq7_team/visited/closed", "ideal of one robot, eq. (7)", "#d6409f", "--"),
    ("ideal_connected/visited/closed", "our ideal on this map", "#8a7f00", "-"),
    ("theorem3_interior_set/visited/open", "Theorem 3, C interior, set", "#b3263a", "-"),
    ("theorem3_travel_set/visited/open", "Theorem 3, C travel, set", "#b3263a", "--"),
    ("theorem3_interior_multiset/visited/open", "Theorem 3, C interior, multiset", "#b3263a", ":"),
    ("mended_count/visited/open", "ours: Theorem 3 mended, counts", "#1f4e86", ":"),
    ("mended_largest/visited/open", "ours: chances", "#1f4e86", "--"),
    ("until_first_loss/visited/closed", "ours: until the first loss", "#2fa8e6", ":"),
    ("loss_tree_lower/visited/closed", "ours: tree of losses, closed loop", "#2fa8e6", "-"),
)
"""(key, name, colour, line) of what is drawn over the size of the team."""


def check_png(checked: MapCheck) -> bytes:
    """The picture of one map as PNG."""
    with house_style():
        return png_bytes(check_figure(checked))


def check_figure(checked: MapCheck) -> Figure:
    """Every formula in cells as a mark on one scale, a row each, with the truths as lines."""
    checks = [c for c in checked.rows if c.about.unit == "cells" and c.meaning == "visited" and c.robot is None]
    rows: dict[str, list[Check]] = {}
    for check in checks:
        rows.setdefault(check.formula, []).append(check)
    figure = new_figure((WIDTH, 2.05 + 0.27 * len(rows)))
    axes = figure.add_axes(inches(figure, (2.15, 1.15, WIDTH - 2.45, 0.27 * len(rows))))
    cells = int(checked.world.accessible(checked.plan.starts).sum())
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
    _plain(axes)
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


def scatter_png(survey: Survey) -> bytes:
    """Bound against truth as PNG."""
    with house_style():
        return png_bytes(scatter_figure(survey))


def scatter_figure(survey: Survey) -> Figure:
    """One panel a formula, one point a world and team, in the formula's unit; where it fails the ground is red."""
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
    kind = f"{survey.worlds:,} {survey.choices.kind} worlds of {survey.choices.height} x {survey.choices.width} cells"
    figure.text(0.069, 1 - 0.28 / height, "Formula against truth", fontsize=13, fontweight="bold", va="center")
    below = f"{kind}; a point a world and team; red ground: the formula fails"
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
    loop, meaning = key.split("/")[-1], key.split("/")[1] if key.count("/") == 2 else "a robot is left"
    title = about.title + ("" if about.paper else " *")
    axes.set_title(title, loc="left", fontsize=8.5, fontweight="bold", color=INK, pad=14)
    axes.annotate(f"{about.direction}; {meaning}, {loop} loop", (0, 1), (0, 4), "axes fraction", "offset points",
                  fontsize=7.5, color=FAINT)  # fmt: skip
    _plain(axes)
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


def whole_or_fraction(unit: str) -> Locator:
    """Ticks at whole numbers, or at fifths of a chance."""
    return FixedLocator(np.linspace(0, 1, 6).tolist()) if unit == "chance" else whole_ticks(5)


def over_robots_png(survey: Survey) -> bytes:
    """Everything over the size of the team as PNG."""
    with house_style():
        return png_bytes(over_robots_figure(survey))


def over_robots_figure(survey: Survey) -> Figure:
    """Means over the worlds, as fractions of the accessible cells: coverage, bounds and ideals."""
    figure = new_figure((WIDTH, 5.9))
    axes = figure.add_axes(inches(figure, (0.75, 1.75, WIDTH - 1.0, 3.4)))
    teams = survey.choices.teams
    truth: Callable[[Check], float] = lambda check: check.truth.value  # noqa: E731
    for loop, colour, line in (("open", OPEN_LOOP, "-"), ("closed", CLOSED_LOOP, "-")):
        name = f"coverage, {loop} loop ({'exact' if loop == 'open' else 'rollouts'})"
        _draw_mean(axes, survey, f"ideal_team/visited/{loop}", truth, (name, colour, line, 2.4))
    for key, name, colour, line in CURVES:
        _draw_mean(axes, survey, key, lambda check: check.value, (name, colour, line, 1.3))
    axes.axhspan(-0.3, 0, color=GRID, alpha=0.45, linewidth=0, zorder=0)
    axes.set(xlim=(min(teams) - 0.3, max(teams) + 0.3), ylim=(-0.25, 1.25))
    axes.axhspan(1, 1.25, color=GRID, alpha=0.45, linewidth=0, zorder=0)
    axes.xaxis.set_major_locator(FixedLocator(list(teams)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    axes.set_xlabel("robots", loc="right", labelpad=2)
    _plain(axes)
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    axes.legend(loc="upper left", bbox_to_anchor=(-0.06, -0.12), ncols=2, handlelength=2.4)
    kind = f"{survey.worlds:,} {survey.choices.kind} worlds of {survey.choices.height} x {survey.choices.width} cells"
    title = "Coverage, what bounds it, and what claims to"
    heading(axes, title, f"means over {kind}, visited, of the accessible cells; grey: what no team can cover")
    return figure


def _draw_mean(
    axes: Axes, survey: Survey, key: str, value: Callable[[Check], float], look: tuple[str, str, str, float]
) -> None:
    """The mean over worlds of a value, as a fraction of each world's accessible cells, for each size of team."""
    name, colour, line, width = look
    sizes, means = [], []
    for robots in survey.choices.teams:
        found = [_fraction(entry, key, value) for entry in survey.entries if entry.robots == robots]
        known = [fraction for fraction in found if fraction is not None]
        if known:
            sizes.append(robots)
            means.append(float(np.mean(known)))
    axes.plot(sizes, means, color=colour, linestyle=line, linewidth=width, marker="o", markersize=3, label=name)


def _fraction(entry: Entry, key: str, value: Callable[[Check], float]) -> float | None:
    return next((value(check) / entry.cells for check in entry.checks if check.key == key), None)


def _team_colour(place: int) -> str:
    return TEAM_COLOURS[place % len(TEAM_COLOURS)]


def _plain(axes: Axes) -> None:
    """No frame on the right and on top, small ticks."""
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(length=2.5, width=0.7, labelcolor=INK, color=FAINT)
