"""An evaluation's charts: expected coverage over time, and how far a single run may be from the mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.figures import NAMES, TO_DO, Rest
from analysis.evaluation.table import worst_of
from analysis.page.charts import Chart, Series
from analysis.report.model import CellMaps, Planned
from planner.formatting import counted, percent

if TYPE_CHECKING:
    from analysis.page.maps import CellLayer

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


# An evaluation cell by cell: its maps, for the page and for pictures, and the cells that stand out.

CELLS = "cells"
"""The id of the maps cell by cell, whose pictures and values the head of the page shows too."""
OUTLINED = 5
"""Cells that cost most robots, on their picture."""
NO_KIND = -1
MOST_PHASES = 8
"""Phases whose threats have a map of their own."""


def maps(evaluation: Evaluation) -> CellMaps:
    """Threat, chance covered, robots lost, what is left of the risk, what outputs add, and the areas."""
    own = evaluation.layers
    more = [make() for found in evaluation.blocks for make in found.layers.values()]
    layers = [*threats(evaluation), own.chance, own.losses, own.left, *more, *own.areas]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers, anchor=CELLS)


def threats(evaluation: Evaluation) -> list[CellLayer]:
    """What robots plan on at first; where threats change, those of each phase too, of many the first few."""
    from analysis.page.maps import threat_layer

    own, world, phases = evaluation.layers.threat, evaluation.ground, evaluation.ground.phases
    if phases is None:
        return [own]
    begins = phases.begins[:MOST_PHASES].tolist()
    layers = [threat_layer(replace(world, threat=p, doubt=None), evaluation.plan) for p in phases.threats[:MOST_PHASES]]
    named = [replace(of, name=f"Threat from step {at}", since=at) for at, of in zip(begins, layers, strict=True)]
    return [own, *named] if phases.plan_on == "worst" else [replace(own, since=0), *named[1:]]


def rest_map(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """What is to do, what was done, what is too far, and the chance to cover each cell."""
    mixed = (rest.kinds[evaluation.accessible] != TO_DO).any()
    layers = [*(evaluation.layers.to_do if mixed else []), evaluation.layers.chance]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers)


def plan_map(evaluation: Evaluation) -> CellMaps:
    """The map by threat with every robot's nominal path: what the answer is about, at the head of the page."""
    world, plan = evaluation.ground, evaluation.plan
    return CellMaps(world, plan.starts, [evaluation.layers.plan], plan=plan, runs=evaluation.played, values_of=CELLS)


def world_drawn(evaluation: Evaluation) -> Planned:
    """The world by threat level, areas and every robot's nominal path."""
    closed = "; paths: the nominal ones (no robot lost)" if evaluation.loop == "closed" else ""
    return Planned(evaluation.ground, evaluation.plan, closed)


def covered(evaluation: Evaluation) -> CellMaps:
    """The chance to cover each cell, with those below one half outlined."""
    world, plan, chance = evaluation.ground, evaluation.plan, evaluation.expected.visited_by_cell
    rare = np.flatnonzero(evaluation.accessible.ravel() & (chance < 0.5))
    return CellMaps(world, plan.starts, [evaluation.layers.chance], [("", rare, True)] if len(rare) else ())


def losses(evaluation: Evaluation) -> CellMaps:
    """Robots lost in each cell, with the worst outlined and listed."""
    world, lost = evaluation.ground, evaluation.expected.stops_by_cell
    worst = worst_of(lost, OUTLINED).tolist()
    places = [(*divmod(cell, world.shape[1]), lost[cell]) for cell in worst]
    listed = ("worst cells", *(f"[{row}, {col}]  {number:.3g}" for row, col, number in places))
    lines = listed if worst else ("no robot is lost",)
    outlines = [("", np.array([cell]), True) for cell in worst]
    return CellMaps(world, evaluation.plan.starts, [evaluation.layers.losses], outlines, lines)


def with_route(evaluation: Evaluation, make: Callable[[], CellLayer]) -> CellMaps:
    """What an output adds, and the route that is to be safe."""
    world, route = evaluation.ground, evaluation.ground.team.route
    parts = [] if route is None else [("route", route @ (world.shape[1], 1), True)]
    return CellMaps(world, evaluation.plan.starts, [make()], parts)


def rest_picture(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """The chance to cover each cell, with what is to do, what was done and what is too far outlined."""
    world, starts = evaluation.ground, evaluation.plan.starts
    kinds = np.where(evaluation.accessible, rest.kinds, NO_KIND).ravel()
    parts = [(name, np.flatnonzero(kinds == kind), False) for kind, name in enumerate(NAMES) if (kinds == kind).any()]
    return CellMaps(world, starts, [replace(evaluation.layers.chance, name=rest.title)], parts)
