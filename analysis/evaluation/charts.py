"""An evaluation's charts: expected coverage over time, and how far a single run may be from the mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.page.series import Chart, Series
from planner.shown import counted, percent

MOST_BINS = 60
STEPS = 301
"""Steps of a curve over time."""


def over_time(evaluation: Evaluation) -> Chart:
    """Expected coverage by the end of each step, with the curves and marks of outputs."""
    expected, cells, closed = evaluation.expected, evaluation.tally.accessible, evaluation.loop == "closed"
    makespan, exact = evaluation.plan.makespan, evaluation.closed_form
    marks = [mark for found in evaluation.blocks for mark in found.marks]
    last = evaluation.last_shown
    last = max([last, *(int(step) for step, _ in marks if step <= 2 * last)])
    more = [_until(last, one) for found in evaluation.blocks for one in found.curves]
    steps = np.asarray(more[0].x) if more else np.unique(np.linspace(0, last, STEPS).round().astype(np.int64))

    def curve(name: str, values: NDArray[np.float64], colour: int, dashed: bool = False) -> Series:
        held = values[np.minimum(steps, len(values) - 1)]
        return Series(name, steps, 100 * held / cells, kind="step", dashed=dashed, colour=colour)

    mean = "mean, exact" if evaluation.is_exact else "mean of rollouts"
    own = [
        curve(f"{mean}, visited", expected.visited_curve, 0),
        curve(f"{mean}, survived", expected.survived_curve, 3, dashed=True),
    ]
    if closed and exact.is_known:
        own.append(curve("open loop, exact, visited", exact.visited_curve, 1, dashed=True))
    return Chart(
        title="Expected coverage by the end of each step",
        series=(*own, *more),
        x_name=f"step{evaluation.world.pace.each}",
        y_name="share of the accessible cells, %",
        unit="%",
        at_x=((makespan, "makespan of the plan" if closed else "makespan"), *(m for m in marks if m[0] <= last)),
        at_y=((100 * evaluation.formulas.ideal_team / cells, "ideal of the team"),) if evaluation.settled else (),
        interval="5 % to 95 % of single rollouts",
        note="visited: entered by any robot, the one stopped there included; survived: entered by a robot that was "
        "not stopped there.",
    )


def _until(last: int, series: Series) -> Series:
    """A curve up to a step."""
    shown = np.asarray(series.x) <= last
    x, y, low, high = (None if line is None else np.asarray(line)[shown] for line in
                       (series.x, series.y, series.low, series.high))  # fmt: skip
    assert x is not None and y is not None
    return replace(series, x=x, y=y, low=low, high=high)


def over_time_words(evaluation: Evaluation) -> str:
    """How soon half and nine tenths of the final coverage are reached."""
    curve = evaluation.expected.visited_curve
    half, most = (int(np.searchsorted(curve, share * curve[-1] - 1e-9)) for share in (0.5, 0.9))
    mean, step = " mean" if evaluation.loop == "open" else "", evaluation.world.pace.step
    return f"{evaluation.how_known}{mean}; half of the final coverage by {step(half)}, nine tenths by {step(most)}."


def distribution(evaluation: Evaluation, *, picture: bool = False) -> Sequence[Chart]:
    """The chance of at least so much coverage, with its intervals; and the histogram.

    picture: it has room for quantiles and what is possible at all beside the mean.
    """
    found, cells = evaluation.figures.visited, evaluation.tally.accessible
    (at, chances), of = found.curve, "rollouts" if found.known is None else "runs"
    sure = Chart(
        title="Chance to visit at least so much",
        series=(Series.of("chance", 100 * at / cells, chances),),
        x_name="at least this share of the accessible cells, %",
        y_name="chance, %",
        unit="%",
        digits=2,
        x_digits=1,
        y_range=(0, 100),
        at_y=((95.0, "95 % of runs"),),
    )
    edges = histogram_bins(found.counts)
    share = 100 * bin_counts(found.counts, edges) / int(found.counts.sum())
    shown = marks(evaluation) if picture else {"mean": found.mean.mean}
    bars = Chart(
        title=f"{of.capitalize()} by coverage",
        series=(Series(f"share of {of}", 100 * (edges[1:] + edges[:-1]) / 2 / cells, share, kind="bars"),),
        x_name=f"share of the accessible cells, % (bins of {counted(int(edges[1] - edges[0]), 'cell')})",
        y_name=f"share of the {of}, %",
        unit="%",
        x_digits=1,
        at_x=tuple((100 * value / cells, name) for name, value in shown.items()),
    )
    return sure, bars


def marks(evaluation: Evaluation) -> dict[str, float]:
    """What the distribution is read against, in cells, from what was sampled to what is possible at all."""
    found, closed, exact = evaluation.figures, evaluation.loop == "closed", evaluation.closed_form
    ends = {q: value for q, value in found.visited.quantiles.items() if q != 0.5 and not math.isnan(value)}
    of, mean = ("rollouts", "mean of rollouts") if found.visited.known is None else ("runs", "mean, exact")
    out = {f"{percent(q, 0)} of {of}": float(value) for q, value in ends.items()}
    out[mean] = found.visited.mean.mean
    if exact.is_known:
        out["open loop, exact" if closed else "exact mean"] = exact.visited
    if evaluation.settled:
        ideals = {"ideal of the team": evaluation.formulas.ideal_team} if len(evaluation.plan.robots) > 1 else {}
        out |= ideals | {"ideal of one robot, eq. (7)": evaluation.formulas.ideal_eq7}
    return {f"{name}: {percent(value / found.visited.cells)}": value for name, value in out.items()}


def histogram_bins(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Edges in cells of equal bins of whole cells that hold every one of `counts` by cells covered `[cells + 1]`.

    The last ends with the most covered. Where that is the least too, one bin is a fortieth of all cells, to be seen.
    """
    held, cells = np.flatnonzero(counts), len(counts) - 1
    low, high = int(held[0]), int(held[-1])
    bins = int(np.clip(2.5 * int(counts.sum()) ** (1 / 3), 8, MOST_BINS))
    width = -(-(high - low + 1) // bins) if high > low else max(1, cells // 40)
    top = (high if high > low else min(high + width // 2, cells)) + 0.5
    number = -(-(high - low + 1) // width)
    return top - width * np.arange(number, -1, -1.0)


def bin_counts(counts: NDArray[np.int64], edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """What of `counts` `[cells + 1]` is in each bin, int64 `[len(edges) - 1]`; none is lost."""
    return np.histogram(np.arange(len(counts)), bins=edges, weights=counts)[0].round().astype(np.int64)
