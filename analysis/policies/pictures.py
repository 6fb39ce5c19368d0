"""What policies bring, as pictures: points gained over the team, and what is covered for each robot lost."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from analysis.kit.words import counted
from analysis.pictures.names import Name, write_names
from analysis.pictures.style import GRID, WIDTH, heading, inches, new_figure, plain
from analysis.policies.settings import KINDS, TEAMS, Setting, cuts, ladder, rivals
from analysis.policies.study import Study

LOOKS = {"per_cell": ("per_cell", "#1f4e86", "-"), "reserve": ("per_cell, reserve 1/4", "#c0612b", "--")}
PAPER = ("mrac, cut off at a step", "#20242b", ":")


def gains_figure(study: Study) -> Figure:
    """Points more than `mrac` with the same team on the same maps, by team and kind, with 95 % intervals."""
    figure = new_figure((WIDTH, 4.1))
    panels = [figure.add_axes(inches(figure, (left, 1.05, 3.2, 2.2))) for left in (0.65, 4.55)]
    for axes, kind in zip(panels, KINDS, strict=True):
        for place, (name, colour, line) in enumerate(LOOKS.values(), start=1):
            settings = [rivals(kind, robots)[place] for robots in TEAMS if len(rivals(kind, robots)) > place]
            gains = [study.gain(setting) for setting in settings]
            half = [100 * g.half_width if np.isfinite(g.half_width) else 0.0 for g in gains]
            axes.errorbar(
                [s.robots * (0.98 if place == 1 else 1.02) for s in settings], [100 * g.mean for g in gains], yerr=half,
                color=colour, linestyle=line, marker="o", markersize=3.5, elinewidth=0.9, capsize=2, label=name,
            )  # fmt: skip
        axes.axhline(0, color="#20242b", linewidth=0.9)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(TEAMS))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.set_xlabel("robots", loc="right", labelpad=2)
        axes.set_ylabel(f"points more than mrac, {kind}")
        axes.set_ylim(min(0.0, axes.get_ylim()[0]), None)
        axes.grid(axis="y", color=GRID, linewidth=0.6)
        plain(axes)
    panels[0].legend(loc="upper left", bbox_to_anchor=(-0.02, -0.19), borderaxespad=0, ncols=2)
    maps = counted(study.maps(rivals(KINDS[0], TEAMS[0])[0]), "map")
    said = f"{maps} of 20 x 20 cells a point, {counted(study.rollouts, 'rollout')} each; bars: 95 % intervals over maps"
    heading(panels[0], "The same team covers more if it asks what a risk is worth", said)
    return figure


def front_figure(study: Study, robots: int) -> Figure:
    """Coverage against robots lost: `per_cell` from never refusing to very careful, `mrac` stopped ever earlier."""
    figure = new_figure((WIDTH, 4.1))
    panels = [figure.add_axes(inches(figure, (left, 1.05, 3.2, 2.2))) for left in (0.65, 4.55)]
    for axes, kind in zip(panels, KINDS, strict=True):
        names: list[Name] = []
        for settings, (name, colour, line) in (
            (ladder(kind, robots), ("per_cell with a worth", "#1f4e86", "-")),
            (cuts(kind, robots), PAPER),
        ):
            lost = [study.estimate(setting, "losses").mean for setting in settings]
            seen = [100 * study.estimate(setting, "visited").mean for setting in settings]
            axes.plot(lost, seen, color=colour, linestyle=line, marker="o", markersize=3.5, label=name)
            names += [Name(_mark(s), at, colour) for s, at in zip(settings, zip(lost, seen, strict=True), strict=True)]
        axes.set_xlim(0, robots * 1.05)
        axes.set_ylim(0, 102)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} %"))
        axes.set_xlabel(f"robots lost, of {robots}", loc="right", labelpad=2)
        axes.set_ylabel(f"coverage, {kind}")
        axes.grid(color=GRID, linewidth=0.6)
        plain(axes)
        write_names(axes, names)
    panels[0].legend(loc="upper left", bbox_to_anchor=(-0.02, -0.19), borderaxespad=0, ncols=2)
    said = "numbers: new cells that a robot is worth (worth), and the step at which mrac is cut off"
    heading(panels[0], f"What {robots} robots cover for each that is lost", said)
    return figure


def _mark(setting: Setting) -> str:
    value = setting.worth if setting.policy != "mrac" else setting.cut
    return "no worth" if value is None and setting.policy != "mrac" else "end" if value is None else f"{value:g}"
