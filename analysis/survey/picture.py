"""The pictures of a survey: every bound against the truth, and how coverage grows with the team."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from analysis.checking.picture import CLOSED_LOOP, CURVES, OPEN_LOOP, PANELS, TEAM_COLOURS, whole_or_fraction
from analysis.pictures.style import (
    FAINT,
    GRID,
    INK,
    WIDTH,
    heading,
    inches,
    new_figure,
    plain,
)
from analysis.survey.survey import Entry, Survey
from analysis.theory.formulas import FORMULAS, Direction
from analysis.theory.verdicts import Check
from planner.shown import counted


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
    plain(axes)
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
