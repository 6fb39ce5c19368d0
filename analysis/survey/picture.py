"""The picture of a survey: every bound against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, Locator, NullLocator
from numpy.typing import NDArray

from analysis.pictures.style import FAINT, INK, WIDTH, inches, new_figure, plain, whole_ticks
from analysis.survey.survey import Survey
from analysis.theory.formulas import FORMULAS, Direction
from planner.shown import counted

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
"""What is drawn as bound against truth, by key."""


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
    figure.text(0.069, 1 - 0.28 / height, "Formula against truth", fontsize=13, fontweight="bold", va="center")
    below = f"{survey.said}; a point a world and team; red ground: the formula fails"
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


def _team_colour(place: int) -> str:
    return TEAM_COLOURS[place % len(TEAM_COLOURS)]


def whole_or_fraction(unit: str) -> Locator:
    """Ticks at whole numbers, or at fifths of a chance."""
    return FixedLocator(np.linspace(0, 1, 6).tolist()) if unit == "chance" else whole_ticks(5)
