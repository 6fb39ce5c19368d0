"""The picture of `mrac-jax size`: expected coverage and the chance of the target over the size of the team."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from analysis.design.rules import TeamVerdict
from analysis.design.size import Point, TeamSize
from analysis.kit.words import counted
from analysis.pictures.style import (
    GRID,
    WIDTH,
    heading,
    inches,
    new_figure,
    plain,
    whole_ticks,
)
from analysis.statistics.estimate import Estimate

COVERAGE, CHANCE, IDEAL, WANTED, ANSWER = "#1f4e86", "#c0612b", "#8a7f00", "#b3263a", "#2c7a5b"


def size_figure(size: TeamSize) -> Figure:
    """Both curves with their 95 % intervals, what is wanted, the ideal of the team, and the answer."""
    figure = new_figure((WIDTH, 5.3))
    axes = figure.add_axes(inches(figure, (0.75, 1.3, WIDTH - 1.0, 3.25)))
    by_chance = size.goal.confidence is not None
    rolled = [point for point in size.points if point.rollouts]
    _draw_ideal(axes, size)
    _draw_curve(axes, rolled, "chance", f"chance of {_target_words(size)}", CHANCE, by_chance)
    _draw_curve(axes, rolled, "coverage", f"expected coverage ({size.goal.meaning})", COVERAGE, not by_chance)
    unsure = [point for point in rolled if point.verdict is TeamVerdict.UNDECIDED]
    if unsure:
        values = [_estimate(point, "chance" if by_chance else "coverage").mean for point in unsure]
        look = {"markersize": 11, "markerfacecolor": "none", "markeredgecolor": WANTED, "mew": 1.2, "zorder": 4}
        axes.plot([p.robots for p in unsure], values, "o", label="undecided", clip_on=False, **look)  # type: ignore[arg-type]
    name = "wanted chance" if by_chance else "target"
    label = f"{name}: {100 * size.goal.wanted:g} %"
    axes.axhline(size.goal.wanted, color=WANTED, linewidth=1.1, linestyle=(0, (5, 2.5)), zorder=1.6, label=label)
    if size.robots is not None:
        axes.axvline(size.robots, color=ANSWER, linewidth=1.1, zorder=1.5, label=f"enough: {size.robots}")
    _axes(axes, size)
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.13), ncols=2, borderaxespad=0, handlelength=1.8)
    heading(axes, *size_heading(size))
    return figure


def size_heading(size: TeamSize) -> tuple[str, str]:
    """(title, subtitle)."""
    aim = f"{100 * size.goal.target:g} % expected coverage"
    if size.goal.confidence is not None:
        aim = f"a {100 * size.goal.confidence:g} % chance of {_target_words(size)}"
    undecided = size.of(TeamVerdict.UNDECIDED)
    if size.partial:
        title = f"Interrupted: robots for {aim}"
    elif size.robots is None:
        title = f"No team of up to {len(size.starts)} shown to be enough for {aim}"
    else:
        also = "".join(f"{k} or " for k in undecided) if len(undecided) < 4 else "at most "
        title = f"{also}{counted(size.robots, 'robot')} for {aim}"
    most = max((point.rollouts for point in size.points), default=0)
    by = "" if size.choices.deadline is None else f", by step {size.choices.deadline}"
    how = f"{size.choices.loop} loop{by}, up to {counted(most, 'rollout')} a team, seed {size.choices.seed}"
    return title, f"{how}; bars: 95 % intervals; of {counted(size.cells, 'accessible cell')}"


def _target_words(size: TeamSize) -> str:
    return "every cell" if size.goal.target == 1 else f"{100 * size.goal.target:g} % or more"


def _estimate(point: Point, which: str) -> Estimate:
    value: Estimate = getattr(point, which)
    return value


def _draw_ideal(axes: Axes, size: TeamSize) -> None:
    """What no strategy exceeds, for the figure that decides; teams below the target by it are shaded."""
    by_chance = size.goal.confidence is not None
    values = [point.ideal_chance if by_chance else point.ideal_coverage for point in size.points]
    robots = [point.robots for point in size.points]
    name = f"ideal of the team: no {'chance' if by_chance else 'mean coverage'} is above it"
    axes.plot(robots, values, color=IDEAL, linewidth=1.2, zorder=1.8, label=name)
    impossible = [point.robots for point in size.points if point.verdict is TeamVerdict.IMPOSSIBLE]
    if impossible:
        axes.axvspan(0.5, impossible[-1] + 0.5, color=GRID, alpha=0.5, linewidth=0, zorder=0, label="impossible")


def _draw_curve(axes: Axes, points: list[Point], which: str, name: str, colour: str, decides: bool) -> None:
    """One figure over the teams; the one that decides stands out."""
    if not points:
        return
    estimates = [_estimate(point, which) for point in points]
    robots, means = [point.robots for point in points], [e.mean for e in estimates]
    down = [max(e.mean - e.ci95[0], 0.0) for e in estimates]
    up = [max(e.ci95[1] - e.mean, 0.0) for e in estimates]
    axes.errorbar(
        robots,
        means,
        yerr=[down, up],
        color=colour,
        marker="o",
        markersize=4.5 if decides else 3,
        linewidth=1.8 if decides else 1.0,
        elinewidth=1.2,
        capsize=2.5,
        alpha=1.0 if decides else 0.75,
        zorder=3 if decides else 2.5,
        label=name,
        clip_on=False,
    )


def _axes(axes: Axes, size: TeamSize) -> None:
    last = max(size.points[-1].robots, 2)
    axes.set_xlim(0.5, last + 0.5)
    axes.set_ylim(0, 1.02)
    axes.xaxis.set_major_locator(whole_ticks(12))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    axes.set_xlabel("robots", loc="right", labelpad=2)
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    plain(axes)
