"""Tables and charts of an evaluation: probabilities, losses, time and coverage; cells; robots; formulas; maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.evaluation.evaluate import Evaluation
from analysis.evaluation.figures import NAMES, TO_DO, Figures, Rest, Row, coverage_row, known_text
from analysis.page.elements import CellLayer, Chart, Series
from analysis.report.model import CellMaps, Section
from analysis.statistics.estimates import AT_LEAST
from analysis.theory.bounds import Theorem3
from analysis.theory.verdicts import FORMULAS, MEANINGS, Verdict
from analysis.utils.tables import Column, make_table, table_of
from planner.formatting import at_least_text, counted, percent
from planner.simulator.codes import Outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Tables of an evaluation: probabilities, losses, time and coverage; the worst cells; the robots.

LISTED = 10
"""Rows of the tables of the worst cells."""
SAID_BY_COVERAGE = (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.END_OF_PATHS)
"""Outcomes whose probabilities appear in other rows of the table."""


def answer_tables(evaluation: Evaluation) -> list[Table]:
    """The tables of the figures: probabilities and time, coverage, and those of the outputs."""
    more, tables = evaluation.added("rows"), list[Table]()
    if not evaluation.certain:
        sampled = "sampled" if _shown_figures(evaluation).visited.known is None else "chance"
        chances = list(_chance_rows(evaluation))
        tables.append(_table(evaluation, "Chances in %, losses and time", (sampled, "95 % interval"), chances))
    if not evaluation.certain or more:
        columns = ("mean", "95 % interval", "5 %", "median", "95 %")
        rows = [*_coverage_rows(evaluation), *more]
        tables.append(_table(evaluation, "Coverage, % of the accessible cells", columns, rows))
    return [*tables, *evaluation.added("tables")]


def _table(evaluation: Evaluation, title: str, columns: Sequence[str], rows: Sequence[Row]) -> Table:
    """A table with a column of names, `columns`, and the open loop's exact values (last in the closed loop)."""
    first = evaluation.loop == "open"
    cells = ((name, exact, *shown) if first else (name, *shown, exact) for name, exact, shown in rows)
    return make_table(("", *(("exact", *columns) if first else (*columns, "open loop"))), title, cells)


def _shown_figures(evaluation: Evaluation) -> Figures:
    """In the open loop the sampled figures, because the exact values have a separate column."""
    return evaluation.figures if evaluation.loop == "open" else evaluation.shown


def _coverage_rows(evaluation: Evaluation) -> Iterator[Row]:
    """Coverage in percent, in each meaning, of the accessible cells and of all free cells where these differ."""
    cells, found = evaluation.cells, _shown_figures(evaluation)
    of = {"": cells["accessible"], ", of all free cells": cells["free"]}
    for name, number in list(of.items())[: 1 + (cells["free"] > cells["accessible"])]:
        for meaning in found.meanings:
            covered, exact = getattr(found, meaning), getattr(evaluation.closed_form, meaning)
            yield coverage_row(meaning + name, covered, number, exact)


def _chance_rows(evaluation: Evaluation) -> Iterator[Row]:
    """The probabilities of coverage and of outcomes, and a row for each field of `Figures` with a title."""
    found, exact, pace = _shown_figures(evaluation), evaluation.closed_form, evaluation.world.pace
    for x in AT_LEAST[:-1]:
        yield Row(f"chance to visit {100 * x:g} % or more", "", found.visited.at_least[x].columns())
    for one in fields(Figures):
        value, title = getattr(found, one.name), one.metadata.get("title")
        if one.name == "ends":
            for outcome, chance in found.ends.items():
                if outcome not in SAID_BY_COVERAGE:
                    yield Row(f"chance that it {evaluation.plan.clause_of(outcome)}", "", chance.columns())
        if title is None or value is None:
            continue
        yield Row(title, one.metadata["exact"](exact), value.columns())
        if pace and (minutes := one.metadata["scaled"]):
            yield Row(minutes, known_text(pace.minutes * exact.mean_time, "{:,.1f}"), value.columns(pace.minutes))
        if one.name == "home" and found.home is not None:
            for least, chance in found.home.shown.items():
                name = f"chance that {at_least_text(least, found.home.robots)} back at base"
                yield Row(name, "", chance.columns())


def worst_cells(evaluation: Evaluation) -> list[Table]:
    """The cells with the highest losses, and those with the lowest coverage."""
    world, expected = evaluation.ground, evaluation.expected
    accessible = np.flatnonzero(evaluation.accessible)
    chance, lost, threat = expected.visited_by_cell, expected.stops_by_cell, world.threat.ravel()
    least = accessible[np.argsort(chance[accessible], kind="stable")][:LISTED]
    columns = (
        Column("row", lambda cell: cell // world.shape[1]),
        Column("column", lambda cell: cell % world.shape[1]),
        Column("threat", lambda cell: percent(float(threat[cell]), 2)),
        Column("chance covered", lambda cell: percent(float(chance[cell]), 2)),
        Column("robots lost", lambda cell: f"{lost[cell]:.4f}"),
    )
    titled = {"Cells that cost most robots": worst_of(lost, LISTED), "Cells covered least": least}
    return [table_of(columns, cells.tolist(), title) for title, cells in titled.items() if len(cells)]


def worst_of(lost: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """The cells `[up to most]` with the highest losses, in descending order; ties by index."""
    order = np.argsort(-lost, kind="stable")[:most]
    return order[lost[order] > 0]


# The paper's formulas for an evaluated plan, compared with the open loop's exact values.

FORMULA_WORDS = {
    Verdict.HOLDS: "hold", Verdict.FAILS: "fail", Verdict.UNDECIDED: "are undecided", Verdict.VACUOUS: "say nothing",
}  # fmt: skip
WORDS = {
    None: "",
    Verdict.FAILS: "FAILS",
    Verdict.HOLDS: "holds",
    Verdict.VACUOUS: "says nothing",
    Verdict.UNDECIDED: "undecided",
}


def formulas_part(evaluation: Evaluation, asked: bool) -> Section:
    """The section on the formulas: collapsed on a page, and omitted on a terminal, unless `asked`."""
    title, said = "The paper's formulas", formulas_text(evaluation) + "."
    if not evaluation.is_plain:
        return Section(title, notes=[said], page_only=not asked)
    if asked:
        return Section(title, [formulas_table(evaluation)], [eq2_text(evaluation), *[said] * (not evaluation.certain)])
    return Section(title, [formulas_table(evaluation)], [eq2_text(evaluation)], intro=said,
                collapsed="Every formula, with its verdict", page_only=True)  # fmt: skip


def formula_counts(evaluation: Evaluation) -> dict[Verdict, int]:
    """The number of formulas, each reading counted, by verdict against the open loop."""
    found = [evaluation.verdicts[key] for key in FORMULAS if FORMULAS[key].paper]
    return {verdict: found.count(verdict) for verdict in FORMULA_WORDS}


def formulas_text(evaluation: Evaluation) -> str:
    """One sentence: the number of formulas that hold on this plan and of those that fail."""
    if not evaluation.is_plain:
        return (
            "The paper's formulas and bounds are omitted: they assume one known map and independent visits, each of "
            "which destroys the robot with the cell's p"
        )
    if evaluation.plan.state is not None:
        return "The paper's formulas are omitted: they apply to whole missions, and this plan resumes one"
    counts = formula_counts(evaluation)
    said = ", ".join(f"{number} {FORMULA_WORDS[verdict]}" for verdict, number in counts.items())
    return f"Of the paper's {sum(counts.values())} formulas for the open loop, counting all readings, {said}"


def formulas_table(evaluation: Evaluation) -> Table:
    """The formulas for this plan, in cells, and whether each holds against the open loop's exact values."""
    bounds, exact = evaluation.formulas, evaluation.closed_form
    title, said = "The paper's formulas against the open loop, in cells", ("", "as a bound")
    table = make_table(("", *MEANINGS, "as a bound"), title, left=said)
    table.add_row("exact expected coverage", f"{exact.visited:.2f}", f"{exact.survived:.2f}", "")
    above, limit = WORDS[evaluation.verdicts["ideal_team"]], evaluation.bounds.any_strategy
    if limit is not None:
        table.add_row("policy-independent upper bound (proven)", f"{limit.cells:.2f}", "", "")
    table.add_row("upper bound for the team on any map", f"{bounds.ideal_team:.2f}", "", above)
    table.add_row("upper bound for one robot, eq. (7)", f"{bounds.ideal_eq7:.2f}", "", "")
    alone = [sum(getattr(gain, meaning) for gain in bounds.eq4) for meaning in MEANINGS]
    table.add_row("eq. (4), summed over robots", *(f"{value:.2f}" for value in alone), "")
    if bounds.theorem3_visited is not None and bounds.theorem3_survived is not None:
        for reading in Theorem3.__dataclass_fields__:
            pair = [getattr(theorem, reading) for theorem in (bounds.theorem3_visited, bounds.theorem3_survived)]
            name = f"Theorem 3, C = {reading.replace('_', ' as a ')}"
            table.add_row(name, *(f"{value:.2f}" for value in pair), WORDS[evaluation.verdicts[f"theorem3_{reading}"]])
    for reading, name in (("printed", "as printed"), ("with_c00", "with C_0,0")):
        terms = [getattr(bound, reading) for bound in bounds.eq5]
        if all(term is not None for term in terms):
            verdict = WORDS[evaluation.verdicts[f"eq5_{reading}"]]
            table.add_row(f"eq. (5) {name}, robots summed", "", f"{sum(terms):.2f}", verdict)
        elif not evaluation.plan.is_external:
            table.add_row(f"eq. (5) {name}", "", "", "undefined here")
    return table


def eq2_text(evaluation: Evaluation) -> str:
    """The result for eq. (2), a probability and not a number of cells, as a line below the table of formulas."""
    bounds, verdict = evaluation.formulas, WORDS[evaluation.verdicts["eq2_printed"]]
    return (
        f"eq. (2) as printed, the probability that a robot survives: {percent(bounds.eq2_printed, 2)}, "
        f"exactly {percent(bounds.team_survival, 2)} ({verdict})."
    )


# Charts of an evaluation: expected coverage over time, and the distribution over single runs.

MOST_BINS = 60
STEPS = 301
"""Points of a curve over time."""


def over_time(evaluation: Evaluation) -> Chart:
    """Expected coverage by the end of each step, with the curves and marks of the outputs."""
    expected, cells, closed = evaluation.expected, evaluation.tally.accessible, evaluation.loop == "closed"
    makespan, exact = evaluation.plan.makespan, evaluation.closed_form
    marks = evaluation.added("marks")
    last = evaluation.last_shown
    # A mark far beyond the end would compress the curves, and is omitted.
    last = max([last, *(int(step) for step, _ in marks if step <= 2 * last)])
    more = [_until(last, one) for one in evaluation.added("curves")]
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
        "Expected coverage by the end of each step", (*own, *more), f"step{evaluation.world.pace.each}",
        "share of the accessible cells, %", unit="%", interval="5 % to 95 % of single rollouts",
        at_x=((makespan, "makespan of the plan" if closed else "makespan"), *(m for m in marks if m[0] <= last)),
        at_y=((100 * evaluation.formulas.ideal_team / cells, "upper bound, team"),) if evaluation.is_plain else (),
        note="visited: entered by any robot, also one that is lost there; survived: entered by a robot that survives "
             "the visit.",
    )  # fmt: skip


def _until(last: int, series: Series) -> Series:
    """A curve truncated at step `last`."""
    shown = np.asarray(series.x) <= last
    x, y, low, high = (None if line is None else np.asarray(line)[shown] for line in
                       (series.x, series.y, series.low, series.high))  # fmt: skip
    assert x is not None and y is not None
    return replace(series, x=x, y=y, low=low, high=high)


def over_time_text(evaluation: Evaluation) -> str:
    """The steps at which half and nine tenths of the final coverage are reached."""
    curve = evaluation.expected.visited_curve
    half, most = (int(np.searchsorted(curve, share * curve[-1] - 1e-9)) for share in (0.5, 0.9))
    mean, step = " mean" if evaluation.loop == "open" else "", evaluation.world.pace.step
    return f"{evaluation.how_known}{mean}; half of the final coverage by {step(half)}, nine tenths by {step(most)}."


def distribution(evaluation: Evaluation, *, picture: bool = False) -> Sequence[Chart]:
    """The probability of at least each coverage, with intervals; and the histogram.

    `picture`: mark quantiles and bounds too, not only the mean.
    """
    found, cells = evaluation.figures.visited, evaluation.tally.accessible
    (at, chances), of = found.curve, "rollouts" if found.known is None else "runs"
    edges = histogram_bins(found.counts)
    share = 100 * bin_counts(found.counts, edges) / int(found.counts.sum())
    shown = marks(evaluation) if picture else {"mean": found.mean.mean}
    return (
        Chart("Chance of at least this coverage", (Series.of("chance", 100 * at / cells, chances),),
              "at least this share of the accessible cells, %", "chance, %", unit="%", y_range=(0, 100),
              at_y=((95.0, "95 % of runs"),)),
        Chart(f"{of.capitalize()} by coverage",
              (Series(f"share of {of}", 100 * (edges[1:] + edges[:-1]) / 2 / cells, share, kind="bars"),),
              f"share of the accessible cells, % (bins of {counted(int(edges[1] - edges[0]), 'cell')})",
              f"share of the {of}, %", unit="%",
              at_x=tuple((100 * value / cells, name) for name, value in shown.items())),
    )  # fmt: skip


def marks(evaluation: Evaluation) -> dict[str, float]:
    """Reference values of the distribution, in cells: quantiles, means and upper bounds."""
    found, closed, exact = evaluation.figures, evaluation.loop == "closed", evaluation.closed_form
    ends = {q: value for q, value in found.visited.quantiles.items() if q != 0.5 and not math.isnan(value)}
    of, mean = ("rollouts", "mean of rollouts") if found.visited.known is None else ("runs", "mean, exact")
    out = {f"{percent(q, 0)} of {of}": float(value) for q, value in ends.items()}
    out[mean] = found.visited.mean.mean
    if exact.is_known:
        out["open loop, exact" if closed else "exact mean"] = exact.visited
    if evaluation.is_plain:
        ideals = {"upper bound, team": evaluation.formulas.ideal_team} if len(evaluation.plan.robots) > 1 else {}
        out |= ideals | {"upper bound, one robot, eq. (7)": evaluation.formulas.ideal_eq7}
    return {f"{name}: {percent(value / found.visited.cells)}": value for name, value in out.items()}


def histogram_bins(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Edges, in cells, of equal bins that hold all of `counts` `[cells + 1]` (rollouts by cells covered).

    The last bin ends at the largest coverage. A single value gets a bin of a fortieth of all cells, to be visible.
    """
    held, cells = np.flatnonzero(counts), len(counts) - 1
    low, high = int(held[0]), int(held[-1])
    bins = int(np.clip(2.5 * int(counts.sum()) ** (1 / 3), 8, MOST_BINS))
    # Bins of whole cells: each holds the same number of possible values.
    width = -(-(high - low + 1) // bins) if high > low else max(1, cells // 40)
    top = (high if high > low else min(high + width // 2, cells)) + 0.5
    number = -(-(high - low + 1) // width)
    return top - width * np.arange(number, -1, -1.0)


def bin_counts(counts: NDArray[np.int64], edges: NDArray[np.float64]) -> NDArray[np.int64]:
    """The sum of `counts` `[cells + 1]` in each bin, int64 `[len(edges) - 1]`."""
    return np.histogram(np.arange(len(counts)), bins=edges, weights=counts)[0].round().astype(np.int64)


# Maps of an evaluation by cell, for the page and for pictures.

CELLS = "cells"
"""HTML id of the maps by cell; the first map of the page shows their values too."""
OUTLINED = 5
"""Number of cells that are outlined in the picture of the losses."""
NO_KIND = -1
MOST_PHASES = 8
"""Most phases whose threats are shown as a map."""


def maps(evaluation: Evaluation) -> CellMaps:
    """Threat, probability of coverage, robots lost, residual risk, the outputs' layers, and the areas."""
    own = evaluation.layers
    more = [make() for make in evaluation.added_files("layers").values()]
    layers = [*threats(evaluation), own.chance, own.losses, own.left, *more, *own.areas]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers, anchor=CELLS)


def threats(evaluation: Evaluation) -> list[CellLayer]:
    """The threat by which robots plan at first; for changing threats, also that of each of the first phases."""
    from analysis.page.maps import threat_layer

    own, world, phases = evaluation.layers.threat, evaluation.ground, evaluation.ground.phases
    if phases is None:
        return [own]
    begins = phases.begins[:MOST_PHASES].tolist()
    layers = [
        threat_layer(replace(world, threat=p, uncertainty=None), evaluation.plan) for p in phases.threats[:MOST_PHASES]
    ]
    named = [replace(of, name=f"Threat from step {at}", since=at) for at, of in zip(begins, layers, strict=True)]
    return [own, *named] if phases.plan_on == "worst" else [replace(own, since=0), *named[1:]]


def rest_map(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """Cells to visit, visited before, and too far; and the probability of coverage."""
    mixed = (rest.kinds[evaluation.accessible] != TO_DO).any()
    layers = [*(evaluation.layers.to_do if mixed else []), evaluation.layers.chance]
    return CellMaps(evaluation.ground, evaluation.plan.starts, layers)


def plan_map(evaluation: Evaluation) -> CellMaps:
    """The map by threat with every robot's nominal path, at the head of the page."""
    world, plan = evaluation.ground, evaluation.plan
    return CellMaps(world, plan.starts, [evaluation.layers.plan], plan=plan, runs=evaluation.played, values_of=CELLS)


def world_drawn(evaluation: Evaluation) -> Figure:
    """The world by threat level, areas and every robot's nominal path, for a picture."""
    from analysis.pictures import plan_figure

    closed = "; paths: the nominal ones (no robot lost)" if evaluation.loop == "closed" else ""
    return plan_figure(evaluation.ground, evaluation.plan, closed)


def covered(evaluation: Evaluation) -> CellMaps:
    """The probability of coverage, with cells below one half outlined."""
    world, plan, chance = evaluation.ground, evaluation.plan, evaluation.expected.visited_by_cell
    rare = np.flatnonzero(evaluation.accessible.ravel() & (chance < 0.5))
    return CellMaps(world, plan.starts, [evaluation.layers.chance], [("", rare, True)] if len(rare) else ())


def losses(evaluation: Evaluation) -> CellMaps:
    """Robots lost by cell, with the worst cells outlined and listed."""
    world, lost = evaluation.ground, evaluation.expected.stops_by_cell
    worst = worst_of(lost, OUTLINED).tolist()
    places = [(*divmod(cell, world.shape[1]), lost[cell]) for cell in worst]
    listed = ("worst cells", *(f"[{row}, {col}]  {number:.3g}" for row, col, number in places))
    lines = listed if worst else ("no robot is lost",)
    outlines = [("", np.array([cell]), True) for cell in worst]
    return CellMaps(world, evaluation.plan.starts, [evaluation.layers.losses], outlines, lines)


def with_route(evaluation: Evaluation, make: Callable[[], CellLayer]) -> CellMaps:
    """A layer of an output, with the route outlined."""
    world, route = evaluation.ground, evaluation.ground.team.route
    parts = [] if route is None else [("route", route @ (world.shape[1], 1), True)]
    return CellMaps(world, evaluation.plan.starts, [make()], parts)


def rest_picture(evaluation: Evaluation, rest: Rest) -> CellMaps:
    """The probability of coverage, with the cells to visit, visited before, and too far outlined."""
    world, starts = evaluation.ground, evaluation.plan.starts
    kinds = np.where(evaluation.accessible, rest.kinds, NO_KIND).ravel()
    parts = [(name, np.flatnonzero(kinds == kind), False) for kind, name in enumerate(NAMES) if (kinds == kind).any()]
    return CellMaps(world, starts, [replace(evaluation.layers.chance, name=rest.title)], parts)
