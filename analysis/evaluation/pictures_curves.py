"""The two curves: the distribution of coverage over rollouts, and coverage over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.band import Band, last_shown
from analysis.evaluation.outputs.deadline import Deadline
from analysis.evaluation.words import how_known
from analysis.kit.words import percent
from analysis.pictures.style import FAINT, GRID, INK, Look, heading, whole_ticks
from analysis.statistics.control import complete_chance, tally_mean
from analysis.statistics.estimate import quantile
from planner.shown import counted
from planner.tally import Tally

BAR, COMPLETE, EXACT, SAMPLED, IDEAL, SURVIVED = "#9fb9d3", "#2c7a5b", "#b3263a", "#1f4e86", "#8a7f00", "#7a2fa0"
QUANTILE = "#6b8db0"
MOST_BINS = 60
LONELY = 0.025
"""Width of the bin that holds every rollout, as a share of the axis: a single cell of many would not be seen."""
DASHES = (0, (5, 2.5))
"""Of what is drawn for comparison: the open loop's exact values beside a closed loop's."""


@dataclass(frozen=True)
class Mark:
    """One row of the summary above the histogram, in cells.

    Attributes:
        name: the row's label. value: the point. low, high: the bar round it (equal to `value` where there is none).
        colour: of both. marker: of the point. thick: draw the bar as a band.
        words: what is written at the row's right end. dashed: the line down the histogram, for another loop's value.
    """

    name: str
    value: float
    low: float
    high: float
    colour: str
    marker: str
    words: str
    thick: bool = False
    dashed: bool = False


def summary_marks(evaluation: Evaluation) -> list[Mark]:
    """The figures that the distribution is read against, from what was sampled to what is possible at all."""
    tally, cells, bounds = evaluation.tally, evaluation.tally.accessible, evaluation.formulas
    marks = []

    def point(name: str, value: float, colour: str, marker: str) -> None:
        marks.append(Mark(name, value, value, value, colour, marker, percent(value / cells)))

    if tally.rollouts:
        low, middle, high = (float(quantile(tally.visited, q)) for q in (0.05, 0.5, 0.95))
        words = " / ".join(f"{100 * value / cells:.1f}" for value in (low, middle, high)) + " %"
        marks.append(Mark("5 / 50 / 95 % quantiles", middle, low, high, QUANTILE, "|", words, thick=True))
        mean = tally_mean(tally, "visited")
        half = f" \u00b1 {100 * mean.half_width / cells:.2g}" if mean.half_width else ""
        words = f"{100 * mean.mean / cells:.2f}{half} %"
        marks.append(Mark("sampled mean, 95 % interval", mean.mean, *mean.ci95, SAMPLED, "o", words))
    closed, exact = evaluation.loop == "closed", evaluation.closed_form.visited
    if evaluation.closed_form.is_known:
        name, words = "open loop, exact" if closed else "exact mean", f"{100 * exact / cells:.2f} %"
        marks.append(Mark(name, exact, exact, exact, EXACT, "D", words, dashed=closed))
    if not evaluation.settled:
        return marks
    if evaluation.plan.starts.shape[0] > 1:
        point("ideal of the team", bounds.ideal_team, IDEAL, ">")
    point("ideal of one robot, eq. (7)", bounds.ideal_eq7, IDEAL, "^")
    return marks


def draw_distribution(summary: Axes, axes: Axes, evaluation: Evaluation) -> None:
    """Rollouts by coverage (visited) on `axes`; on `summary`, above it, means, quantiles and ideals, one row each."""
    tally, marks = evaluation.tally, summary_marks(evaluation)
    edges, complete = histogram_bins(tally, max(mark.high for mark in marks) - min(mark.low for mark in marks))
    low, high = _range(edges, marks, tally.accessible)
    if tally.rollouts:
        _draw_bars(axes, tally, edges, complete)
    _draw_marks(summary, axes, marks)
    _coverage_axis(axes, low, high, tally.accessible)
    summary.set_xlim(low, high)
    axes.set_ylabel("share of rollouts" if edges[1] - edges[0] <= 1 else _bin_words(edges))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, min_n_ticks=2))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    heading(summary, *distribution_heading(evaluation), left=-1.5)


def distribution_heading(evaluation: Evaluation) -> tuple[str, str]:
    """(title, subtitle) of the distribution."""
    tally = evaluation.tally
    sampled = f"{counted(tally.rollouts, 'rollout')}, open loop" + (", interrupted" if evaluation.partial else "")
    if evaluation.loop == "closed":
        sampled = how_known(evaluation)
    if not tally.rollouts:
        return (
            f"Coverage: {percent(evaluation.closed_form.visited / tally.accessible)} expected",
            f"{sampled}: nothing drawn",
        )
    done = complete_chance(tally)
    low = quantile(tally.visited, 0.05) / tally.accessible
    title = f"Coverage: {percent(tally_mean(tally, 'visited').mean / tally.accessible)} on average, "
    title += f"at least {percent(low)} in 95 % of rollouts"
    low_end, high_end = percent(done.ci95[0], 2), percent(done.ci95[1], 2)
    often, between = percent(done.mean, 2), f"{low_end} to {high_end}"
    if done.mean in (0, 1):
        often, between = ("all", f"from {low_end}") if done.mean else ("none", f"up to {high_end}")
    return title, f"{sampled}; complete in {often} of them (95 % interval {between})"


def histogram_bins(tally: Tally, shown: float) -> tuple[NDArray[np.float64], int]:
    """Edges in cells of equal bins of whole cells that hold every rollout, the last one ending with the most covered.

    A single bin is wide enough to be seen on an axis of `shown` cells. Also the rollouts in which every accessible
    cell was visited; they all lie in the last bin if there are any.
    """
    held = np.flatnonzero(tally.visited)
    low, high = (int(held[0]), int(held[-1])) if len(held) else (0, tally.accessible)
    bins = int(np.clip(2.5 * max(tally.rollouts, 1) ** (1 / 3), 8, MOST_BINS))
    width = -(-(high - low + 1) // bins) if high > low else max(1, round(LONELY * shown))
    top = (high if high > low else min(high + width // 2, tally.accessible)) + 0.5
    number = -(-(high - low + 1) // width)
    return top - width * np.arange(number, -1, -1.0), int(tally.visited[-1])


def bin_counts(tally: Tally, edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rollouts in each bin, int64 `[len(edges) - 1]`; they sum to the rollouts of the tally."""
    values = np.arange(len(tally.visited))
    return np.histogram(values, bins=edges, weights=tally.visited)[0].round().astype(np.int64)


def _draw_bars(axes: Axes, tally: Tally, edges: NDArray[np.float64], complete: int) -> None:
    share = bin_counts(tally, edges) / tally.rollouts
    centres, width = (edges[1:] + edges[:-1]) / 2, float(edges[1] - edges[0])
    if width == 1 and len(share) <= 12:
        width = 0.8
    axes.bar(centres, share, width, color=BAR, edgecolor="white", linewidth=0.4, zorder=2)
    if complete:
        part = complete / tally.rollouts
        axes.bar(centres[-1:], [part], width, color=COMPLETE, zorder=2.1, label=f"complete: {percent(part)}")
        beside: Look = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0}
        axes.legend(handlelength=1.0, handleheight=1.0, **beside)
    axes.set_ylim(0, 1.06 * float(share.max()))


def _draw_marks(summary: Axes, axes: Axes, marks: list[Mark]) -> None:
    """One row a mark: its name at the left, its value in words at the right, and a hair line down the histogram."""
    for row, mark in enumerate(marks):
        if mark.high > mark.low:
            width, alpha = (7.0, 0.45) if mark.thick else (1.6, 1.0)
            x, y = [mark.low, mark.high], [row, row]
            summary.plot(x, y, color=mark.colour, solid_capstyle="butt", linewidth=width, alpha=alpha)
        size = 9 if mark.marker == "|" else 5.5
        summary.plot([mark.value], [row], mark.marker, color=mark.colour, markersize=size, mew=1.6, clip_on=False)
        dots = ":" if mark.thick else DASHES if mark.dashed else "-"
        for place in {mark.low, mark.value, mark.high} if mark.thick else {mark.value}:
            for on, end, above in ((summary, 1 - (row + 0.5) / len(marks), 1), (axes, 1.0, 3)):
                on.axvline(place, 0, end, color=mark.colour, linewidth=0.8, alpha=0.7, linestyle=dots, zorder=above)
        frame = ("axes fraction", "data")
        summary.annotate(mark.words, (1, row), (8, 0), frame, "offset points", va="center", color=INK, fontsize=8.5)
    summary.set_ylim(len(marks) - 0.5, -0.5)
    summary.set_yticks(range(len(marks)), [mark.name for mark in marks], color=INK, fontsize=8.5)
    summary.tick_params(length=0, labelbottom=False)
    summary.grid(axis="y", color=GRID, linewidth=0.6)
    summary.set_axisbelow(True)
    summary.spines[:].set_visible(False)
    axes.spines[["top", "right"]].set_visible(False)


def _range(edges: NDArray[np.float64], marks: list[Mark], accessible: int) -> tuple[float, float]:
    low = min(edges[0], *(mark.low for mark in marks))
    high = max(edges[-1], *(mark.high for mark in marks))
    pad = max(0.03 * (high - low), 0.6 if accessible < 30 else 0.0)
    return max(low - pad, -0.8), min(high + pad, accessible + max(0.5, 0.02 * (high - low)))


def _coverage_axis(axes: Axes, low: float, high: float, accessible: int) -> None:
    """x is in cells, labelled in percent of the accessible cells; a second axis below it counts cells."""
    axes.set_xlim(low, high)
    step = _nice_step((high - low) / accessible * 100 / 8)
    ticks = step * np.arange(np.floor(100 / step + 1e-9) + 1)
    places = ticks / 100 * accessible
    shown = (places >= low) & (places <= high)
    axes.set_xticks(places[shown], [f"{tick:g} %" for tick in ticks[shown]])
    cells = axes.secondary_xaxis(-0.12)
    cells.xaxis.set_major_locator(whole_ticks(8))
    cells.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}" if 0 <= x <= accessible else ""))
    cells.spines["bottom"].set_visible(False)
    cells.tick_params(length=0, pad=1)
    cells.set_xlabel(f"covered (visited): share of the {counted(accessible, 'accessible cell')}, and cells")


def _nice_step(rough: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is at least `rough`."""
    power = 10.0 ** np.floor(np.log10(rough))
    return float(next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9)))


def _bin_words(edges: NDArray[np.float64]) -> str:
    return f"share of rollouts, bins of {edges[1] - edges[0]:.0f} cells"


def draw_over_time(axes: Axes, evaluation: Evaluation) -> None:
    """Expected coverage by the end of each step, with the band of sampled rollouts and the deadline.

    The curves are those of the evaluated loop; beside a closed loop's stands the open loop's exact one, dashed.
    """
    closed, cells, makespan = evaluation.loop == "closed", evaluation.tally.accessible, evaluation.plan.makespan
    band, deadline, steps = evaluation.output(Band), evaluation.output(Deadline), time_axis(evaluation)
    last = max(steps + 0.5, 1.02 * steps, 1.0)
    if deadline is not None and deadline.steps <= 2 * last:
        last = max(last, 1.02 * deadline.steps)
    top = float(np.fmax(evaluation.expected.visited, evaluation.closed_form.visited)) / cells
    if band is not None:
        _draw_band(axes, band, last, cells, closed)
        top = max(top, float(band.high.max()) / cells)
    _draw_means(axes, evaluation, last)
    if deadline is not None:
        _mark_deadline(axes, evaluation, deadline.steps)
    name = f"{'makespan of the plan' if closed else 'makespan'}: step {makespan:,}"
    axes.axvline(makespan, color=FAINT, linewidth=0.9, linestyle=":", zorder=1, label=name)
    _time_axes(axes, last, cells)
    _name_steps(axes, evaluation, last)
    axes.set_ylim(0, 1.02 * min(1.0, 1.15 * top))
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.17), ncols=2, borderaxespad=0, labelspacing=0.3)
    heading(axes, *over_time_heading(evaluation))


def time_axis(evaluation: Evaluation) -> int:
    """The last step to show (`outputs.band.last_shown`): what comes after it is a long flat tail."""
    return last_shown(evaluation.plan, evaluation.loop, evaluation.tally)


def _name_steps(axes: Axes, evaluation: Evaluation, last: float) -> None:
    """Name the x axis, and say so where it ends before the last rollout does."""
    time = evaluation.tally.time
    beyond, longest = int(time[int(last) + 1 :].sum()), int(np.flatnonzero(time).max(initial=0))
    rest = ""
    if evaluation.loop == "closed" and beyond:
        share = percent(beyond / evaluation.tally.rollouts, 2)
        rest = f"  ({share} of the rollouts run on, the longest to step {longest:,})"
    axes.set_xlabel(f"step{rest}")


def _draw_means(axes: Axes, evaluation: Evaluation, last: float) -> None:
    expected, cells, closed = evaluation.expected, evaluation.tally.accessible, evaluation.loop == "closed"
    mean, colour = ("mean of rollouts", SAMPLED) if closed else ("mean", EXACT)
    visited, survived = expected.visited_curve / cells, expected.survived_curve / cells
    _draw_curve(axes, visited, last, f"{mean}, visited", color=colour, linewidth=2.0, zorder=3.0)
    _draw_curve(axes, survived, last, f"{mean}, survived", color=SURVIVED, linewidth=1.0, zorder=2.0)
    if closed and evaluation.closed_form.is_known:
        look: Look = {"color": EXACT, "linewidth": 1.0, "linestyle": DASHES, "zorder": 2.2}
        _draw_curve(axes, evaluation.closed_form.visited_curve / cells, last, "open loop, exact, visited", **look)


def _draw_curve(axes: Axes, curve: NDArray[np.float64], last: float, name: str, **look: Any) -> None:
    """A curve over the steps, held to `last` or cut off there; its label holds the final value."""
    shown = curve[: int(last) + 1]
    x, y = np.append(np.arange(len(shown)), last), np.append(shown, shown[-1])
    axes.step(x, y, where="post", label=f"{name}: {percent(curve[-1])}", **look)


def _draw_band(axes: Axes, band: Band, last: float, cells: int, closed: bool) -> None:
    """The quantiles at the steps looked at, held to `last` after the longest rollout's end."""
    x = np.append(band.steps, max(last, band.steps[-1]))
    low, middle, high = (np.append(y, y[-1]) / cells for y in (band.low, band.median, band.high))
    label = f"5 to 95 % of the first {counted(band.rollouts, 'rollout')}"
    axes.fill_between(x, low, high, step="post", color=BAR, alpha=0.5, linewidth=0, zorder=1, label=label)
    colour, dashes, width = (QUANTILE, ":", 1.4) if closed else (SAMPLED, "--", 1.1)
    look: Look = {"color": colour, "linestyle": dashes, "linewidth": width, "zorder": 2.5}
    axes.plot(x, middle, drawstyle="steps-post", label="median", **look)


def over_time_heading(evaluation: Evaluation) -> tuple[str, str]:
    """(title, subtitle) of coverage over time: how soon half and nine tenths of the final coverage are reached."""
    curve, cells = evaluation.expected.visited_curve, evaluation.tally.accessible
    half, most = (int(np.searchsorted(curve, share * curve[-1] - 1e-9)) for share in (0.5, 0.9))
    soon = f"half of that by step {half:,}, nine tenths by step {most:,}"
    title = f"Coverage over time: {percent(curve[-1] / cells)}"
    if evaluation.loop == "open":
        return f"{title} after {counted(evaluation.plan.makespan, 'step')}", f"{how_known(evaluation)} mean; {soon}"
    title += " on average"
    if evaluation.closed_form.is_known:
        title += f", {percent(evaluation.closed_form.visited / cells)} in the open loop"
    return title, f"{how_known(evaluation)}; {soon}"


def _mark_deadline(axes: Axes, evaluation: Evaluation, deadline: int) -> None:
    colour = SAMPLED if evaluation.loop == "closed" else EXACT
    curve = evaluation.expected.visited_curve
    reached = float(curve[min(deadline, len(curve) - 1)]) / evaluation.tally.accessible
    label = f"deadline, step {deadline:,}: {percent(reached)}"
    axes.axvline(deadline, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label=label, zorder=1.5)
    axes.plot([deadline], [reached], "o", color=colour, markersize=6, markeredgecolor="white", zorder=4)


def _time_axes(axes: Axes, last: float, cells: int) -> None:
    axes.set_xlim(0, last)
    axes.set_ylabel("share of the accessible cells")
    axes.xaxis.set_major_locator(whole_ticks(8))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    other = axes.secondary_yaxis("right", functions=(lambda y: np.multiply(y, cells), lambda c: np.divide(c, cells)))
    other.yaxis.set_major_locator(whole_ticks(6))
    other.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.0f}"))
    other.set_ylabel("cells")
    other.spines["right"].set_visible(False)
