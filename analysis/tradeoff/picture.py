"""The picture of `mrac-jax front`: coverage over robots lost, and over the steps it takes."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from analysis.kit.words import counted
from analysis.pictures.names import Name, write_names
from analysis.pictures.style import (
    GRID,
    INK,
    WIDTH,
    heading,
    inches,
    new_figure,
    plain,
    whole_ticks,
)
from analysis.tradeoff.front import Front, Point
from analysis.tradeoff.table import TITLES, headline

COLOURS = {"mrac": "#c0612b", "per_cell": "#2fa8e6", "reserve": "#8a7f00", "worth": "#1f4e86"}
PICK = "#b3263a"


def front_figure(front: Front) -> Figure:
    """Every setting twice, full marks for the efficient ones; a ring around the pick."""
    figure = new_figure((WIDTH, 5.4))
    lost = figure.add_axes(inches(figure, (0.62, 1.05, 4.3, 3.5)))
    steps = figure.add_axes(inches(figure, (5.12, 1.05, WIDTH - 5.37, 3.5)), sharey=lost)
    for family, name in TITLES.items():
        points = [p for p in front.points if p.setting.family == family]
        if points:
            _draw(lost, front, points, "losses", family, name)
            _draw(steps, front, points, "time", family, name)
    if front.picked is not None:
        _ring(lost, front.picked, front.picked.losses.mean)
        _ring(steps, front.picked, front.picked.time.mean)
    if front.goal.losses is not None:
        lost.axvline(front.goal.losses, color=PICK, linewidth=1.0, linestyle=(0, (5, 2.5)), zorder=1)
    if front.goal.target is not None:
        for axes in (lost, steps):
            axes.axhline(100 * front.goal.target, color=PICK, linewidth=1.0, linestyle=(0, (5, 2.5)), zorder=1)
    _axes(lost, "robots lost on average")
    _axes(steps, "steps on average")
    steps.tick_params(labelleft=False)
    lost.set_ylim(0, 102)
    lost.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} %"))
    write_names(lost, _worths(front))
    lost.legend(loc="upper left", bbox_to_anchor=(0, -0.14), ncols=2, borderaxespad=0, handlelength=1.8)
    heading(lost, *front_heading(front))
    return figure


def front_heading(front: Front) -> tuple[str, str]:
    """(title, subtitle)."""
    said = headline(front).removesuffix(".")
    how = f"{counted(front.choices.rollouts, 'rollout')} each, seed {front.choices.seed}"
    marks = "full marks: efficient; numbers: worth, in new cells"
    return said, f"{counted(len(front.starts), 'robot')}, {front.cells:,} accessible cells, {how}; {marks}"


def _draw(axes: Axes, front: Front, points: list[Point], which: str, family: str, name: str) -> None:
    """A family as a line through its points, with 95 % intervals of both figures."""
    across = [getattr(point, which) for point in points]
    up = [point.coverage for point in points]
    ends = ([[max(e.mean - e.ci95[0], 0) for e in of], [max(e.ci95[1] - e.mean, 0) for e in of]] for of in (across, up))
    x_error, y_error = ends
    x, y = [e.mean for e in across], [100 * e.mean for e in up]
    colour = COLOURS[family]
    style = {"color": colour, "linewidth": 1.2, "elinewidth": 0.8, "zorder": 2, "label": name}
    axes.errorbar(x, y, xerr=x_error, yerr=[[100 * v for v in side] for side in y_error], **style)  # type: ignore[arg-type]
    best = dict(zip(front.points, front.efficient, strict=True))
    fill = [colour if best[point] else "white" for point in points]
    axes.scatter(x, y, s=18, c=fill, edgecolors=colour, linewidths=1.0, zorder=3, clip_on=False)


def _worths(front: Front) -> list[Name]:
    """The values of `worth`, the pick's first, each once: missions that are ended early share one."""
    points = sorted(front.points, key=lambda point: (point is not front.picked, point.losses.mean))
    found: dict[float, Name] = {}
    for point in points:
        worth, at = point.setting.worth, (point.losses.mean, 100 * point.coverage.mean)
        if worth is not None:
            found.setdefault(worth, Name(f"{worth:g}", at, COLOURS["worth"]))
    return list(found.values())


def _ring(axes: Axes, point: Point, x: float) -> None:
    look = {"markersize": 12, "markerfacecolor": "none", "markeredgecolor": PICK, "mew": 1.4, "zorder": 4}
    axes.plot([x], [100 * point.coverage.mean], "o", clip_on=False, **look)  # type: ignore[arg-type]


def _axes(axes: Axes, name: str) -> None:
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(whole_ticks(8 if "robots" in name else 5, integer=False))
    axes.set_xlabel(name, loc="right", labelpad=2, color=INK)
    axes.grid(color=GRID, linewidth=0.6)
    plain(axes)
