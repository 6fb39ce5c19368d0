"""The paper's Figs. 5 to 7 from our maps: coverage and time over the team or the ratio of threats, same axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from analysis.kit.words import counted
from analysis.pictures.style import FAINT, GRID, INK, WIDTH, heading, inches, new_figure, plain
from analysis.reproduction.points import FIGURE4, TIME_BIN, Point

Curve = tuple[str, str, str, str, str]
"""(loop, figure, name, colour, line style)."""
COVERAGE_CURVES: tuple[Curve, ...] = (
    ("closed", "visited", "closed loop, visited", "#1f4e86", "-"),
    ("closed", "survived", "... survived", "#1f4e86", ":"),
    ("closed", "visited_free", "... visited, of all free cells", "#1f4e86", "--"),
    ("first", "visited", "closed loop, first visits alone checked", "#c0612b", "-"),
    ("open", "visited", "open loop, exact", "#20242b", "-"),
    ("ideal", "visited", "ideal of the team", "#8a7f00", "-"),
)
TIME_CURVES: tuple[Curve, ...] = (
    ("closed", "time", "closed loop", "#1f4e86", "-"),
    ("first", "time", "first visits alone checked", "#c0612b", "-"),
    ("open", "time", "open loop: last move of a live robot", "#20242b", "-"),
)
PAPER = "#b3263a"


def draw_figure(points: Sequence[Point], title: str, stated: Sequence[tuple[float, float]], by_ratio: bool) -> Figure:
    """Coverage on the left, time on the right, with 95 % intervals over maps."""
    figure = new_figure((WIDTH, 5.3))
    left = figure.add_axes(inches(figure, (0.85, 1.75, 3.0, 2.6)))
    right = figure.add_axes(inches(figure, (4.8, 1.75, 3.0, 2.6)))
    where: Callable[[Point], float] = (lambda p: 100 * p.ratio) if by_ratio else (lambda p: p.robots)
    for axes, curves, scale in ((left, COVERAGE_CURVES, 100.0), (right, TIME_CURVES, 1.0)):
        for curve in curves:
            _draw_curve(axes, points, where, curve, scale)
        _axes(axes, [where(point) for point in points], by_ratio)
    for number, (at, coverage) in enumerate(stated):
        label = "stated in the paper" if number == 0 else None
        left.plot(at, 100 * coverage, "D", color=PAPER, markersize=5, zorder=5, label=label, clip_on=False)
    left.set_ylim(0, 102)
    left.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} %"))
    right.set_ylim(0, None)
    for axes in (left, right):
        axes.legend(loc="upper left", bbox_to_anchor=(-0.02, -0.19), borderaxespad=0, handlelength=2.2)
    maps = len(points[0].means["closed", "visited"])
    rollouts = counted(points[0].rollouts, "rollout")
    said = f"{counted(maps, 'map')} of 20 x 20 cells a point, {rollouts} each; bars: 95 % intervals"
    heading(left, title, said)
    left.set_ylabel("coverage of the accessible cells")
    right.set_ylabel("time, steps")
    return figure


def runs_figure(points: Sequence[Point], title: str) -> Figure:
    """Where the single runs of Fig. 4 fall among all runs on our maps."""
    figure = new_figure((WIDTH, 4.0))
    panels = [figure.add_axes(inches(figure, (left, 0.95, 3.2, 2.35))) for left in (0.65, 4.6)]
    for point, colour in zip(points, ("#1f4e86", "#c0612b"), strict=False):
        coverage, steps = FIGURE4[point.robots]
        marks = {"coverage": 100 * coverage, "time": steps}
        for axes, (what, mark) in zip(panels, marks.items(), strict=True):
            counts = point.runs[what]
            share = 100 * counts / counts.sum()
            width = 1 if what == "coverage" else TIME_BIN
            label = f"{point.robots} robots; line: the paper's run"
            axes.stairs(share, width * np.arange(len(share) + 1), color=colour, fill=True, alpha=0.25)
            axes.stairs(share, width * np.arange(len(share) + 1), color=colour, linewidth=1.2, label=label)
            axes.axvline(mark, color=colour, linewidth=1.4, linestyle=(0, (4, 2)))
    for axes, name in zip(panels, ("coverage of the free cells, %", "time, steps"), strict=True):
        axes.set_xlabel(name, loc="right", labelpad=2)
        axes.set_ylabel("runs, %")
        axes.set_ylim(0, None)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(length=2.5, width=0.7, labelcolor=INK, color=FAINT)
        axes.legend(loc="upper left", bbox_to_anchor=(-0.02, -0.18), borderaxespad=0)
    last = max(int(np.searchsorted(np.cumsum(p.runs["time"]), 0.999 * p.runs["time"].sum())) for p in points)
    panels[0].set_xlim(0, 101)
    panels[1].set_xlim(0, TIME_BIN * (last + 1))
    maps = len(points[0].means["closed", "visited"])
    heading(panels[0], title, f"closed loop, {counted(maps, 'map')}, {counted(points[0].rollouts, 'rollout')} each")
    return figure


def _draw_curve(
    axes: Axes, points: Sequence[Point], where: Callable[[Point], float], curve: Curve, scale: float
) -> None:
    loop, figure, name, colour, line = curve
    estimates = [point.estimate(loop, figure) for point in points]
    means = np.array([e.mean for e in estimates]) * scale
    half = np.array([e.ci95[1] - e.mean for e in estimates]) * scale
    at = [where(point) for point in points]
    wide = loop == "closed" and line == "-"
    axes.errorbar(
        at, means, yerr=np.where(np.isfinite(half), half, 0.0), color=colour, linestyle=line, label=name,
        linewidth=1.8 if wide else 1.0, marker="o", markersize=3.5 if wide else 2.0, elinewidth=0.9, capsize=1.5,
        zorder=3 if wide else 2, clip_on=False,
    )  # fmt: skip


def _axes(axes: Axes, at: list[float], by_ratio: bool) -> None:
    axes.xaxis.set_major_locator(FixedLocator(sorted(set(at))))
    axes.set_xlabel("threats, % of the cells" if by_ratio else "robots", loc="right", labelpad=2)
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    plain(axes)
