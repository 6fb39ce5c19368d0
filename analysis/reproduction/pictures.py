"""The picture of the paper's Fig. 4: where its single runs fall among those on our maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from analysis.pictures.style import FAINT, INK, WIDTH, heading, inches, new_figure
from analysis.reproduction.points import FIGURE4, TIME_BIN, Point
from planner.shown import counted


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
