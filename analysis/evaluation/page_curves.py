"""An evaluation's curves: expected coverage over time, and how far a single run may be from the mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.band import Band
from analysis.evaluation.outputs.deadline import Deadline
from analysis.evaluation.pictures_curves import bin_counts, histogram_bins, time_axis
from analysis.page.curves import Chart, Series, curves_html
from analysis.page.markup import Html, element
from analysis.statistics.estimate import proportion
from planner.shown import counted


def over_time(evaluation: Evaluation) -> Html:
    """Expected coverage by the end of each step, with the band of single rollouts."""
    expected, cells, closed = evaluation.expected, evaluation.tally.accessible, evaluation.loop == "closed"
    last = time_axis(evaluation)
    deadline, band = evaluation.output(Deadline), evaluation.output(Band)
    if deadline is not None and deadline.steps <= 2 * last:
        last = max(last, deadline.steps)
    steps = np.unique(np.linspace(0, last, 301).round().astype(np.int64))
    if band is not None:
        shown = band.steps <= last
        steps = band.steps[shown]

    def curve(name: str, values: NDArray[np.float64], colour: int, dashed: bool = False) -> Series:
        held = values[np.minimum(steps, len(values) - 1)]
        return Series(name, steps, 100 * held / cells, kind="step", dashed=dashed, colour=colour)

    mean = "mean, exact" if not closed and evaluation.closed_form.is_known else "mean of rollouts"
    series = [curve(f"{mean}, visited", expected.visited_curve, 0)]
    series.append(curve(f"{mean}, survived", expected.survived_curve, 3, dashed=True))
    if closed and evaluation.closed_form.is_known:
        series.append(curve("open loop, exact, visited", evaluation.closed_form.visited_curve, 1, dashed=True))
    if band is not None:
        middle, low, high = (100 * values[shown] / cells for values in (band.median, band.low, band.high))
        name = f"median of {counted(band.rollouts, 'rollout')}"
        series.append(Series(name, steps, middle, low, high, kind="step", colour=4, dashed=True))
    marks = [(float(evaluation.plan.makespan), "makespan of the plan" if closed else "makespan")]
    if deadline is not None and deadline.steps <= last:
        marks.append((float(deadline.steps), "deadline"))
    chart = Chart(
        title="Expected coverage by the end of each step",
        series=tuple(series),
        x_name="step",
        y_name="share of the accessible cells, %",
        unit="%",
        at_x=tuple(marks),
        at_y=((100 * evaluation.formulas.ideal_team / cells, "ideal of the team"),) if evaluation.settled else (),
        interval="5 % to 95 % of single rollouts",
        note="visited: entered by any robot, the one stopped there included; survived: entered by a robot that was "
        "not stopped there.",
    )
    return element("div", curves_html(chart), class_="charts")


def distribution(evaluation: Evaluation) -> Html:
    """The chance of at least so much coverage, with its intervals; and the histogram."""
    tally, cells = evaluation.tally, evaluation.tally.accessible
    n = tally.rollouts
    reached = np.cumsum(tally.visited[::-1])[::-1]
    held = np.flatnonzero(tally.visited)
    first, last = max(int(held[0]) - 1, 0), min(int(held[-1]) + 1, cells)
    at = np.unique(np.linspace(first, last, 121).round().astype(np.int64))
    chances = [proportion(int(reached[cell]), n, evaluation.certain) for cell in at]
    low, high = (100 * np.array([chance.ci95[side] for chance in chances]) for side in (0, 1))
    mean = 100 * np.array([chance.mean for chance in chances])
    sure = Chart(
        title="Chance to visit at least so much",
        series=(Series("chance", 100 * at / cells, mean, low, high),),
        x_name="at least this share of the accessible cells, %",
        y_name="chance, %",
        unit="%",
        digits=2,
        x_digits=1,
        y_range=(0, 100),
        at_y=((95.0, "95 % of runs"),),
    )
    edges, _ = histogram_bins(tally, cells)
    counts = bin_counts(tally, edges)
    width = edges[1] - edges[0]
    bars = Chart(
        title="Rollouts by coverage",
        series=(
            Series("share of rollouts", 100 * (edges[1:] + edges[:-1]) / 2 / cells, 100 * counts / n, kind="bars"),
        ),
        x_name=f"share of the accessible cells, % (bins of {counted(int(width), 'cell')})",
        y_name="share of the rollouts, %",
        unit="%",
        x_digits=1,
        at_x=((100 * float(tally.visited @ np.arange(cells + 1)) / n / cells, "mean"),),
    )
    return element("div", curves_html(sure), curves_html(bars), class_="charts two")
