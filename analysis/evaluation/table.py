"""The figures behind an evaluation's answer: chances, losses, time and coverage; the worst cells; the robots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.figures import Figures
from analysis.evaluation.outputs.output import Row, coverage_row, known_words
from analysis.report.model import Part
from analysis.statistics.estimates import AT_LEAST, losses_shown, of_all
from analysis.theory.bounds import Theorem3
from analysis.theory.verdicts import FORMULAS, MEANINGS, Verdict
from analysis.utils.tables import make_table
from planner.formatting import at_least_words, in_percent, percent
from planner.plan.plan import drive_of
from planner.tally import Outcome

LISTED = 10
"""Cells that are worst in a way."""
SAID_BY_COVERAGE = (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.END_OF_PATHS)
"""Outcomes whose chances other rows of the table give."""


def answer_tables(evaluation: Evaluation) -> list[Table]:
    """The figures behind the answer: chances and time, coverage, what outputs add."""
    rows = [row for found in evaluation.blocks for row in found.rows]
    chances = [] if evaluation.certain else [_chances_table(evaluation)]
    coverage = [] if evaluation.certain and not rows else [_coverage_table(evaluation, rows)]
    return [*chances, *coverage, *(table for found in evaluation.blocks for table in found.tables)]


def _table(evaluation: Evaluation, title: str, columns: Sequence[str]) -> Table:
    """A table with a column for names, `columns`, and the open loop's exact values: last where they only compare."""
    named = ("exact", *columns) if evaluation.loop == "open" else (*columns, "open loop")
    return make_table(("", *named), title)


def _add(table: Table, evaluation: Evaluation, name: str, exact: str, shown: Sequence[str]) -> None:
    table.add_row(name, *((exact, *shown) if evaluation.loop == "open" else (*shown, exact)))


def _beside(evaluation: Evaluation) -> Figures:
    """Of the open loop what the rollouts tell, as its exact values have a column of their own."""
    return evaluation.figures if evaluation.loop == "open" else evaluation.shown


def _coverage_table(evaluation: Evaluation, more: Sequence[Row]) -> Table:
    """Coverage in percent, both meanings; and the outputs' rows."""
    columns = ("mean", "95 % interval", "5 %", "median", "95 %")
    table = _table(evaluation, "Coverage, % of the accessible cells", columns)
    cells, found = evaluation.cells, _beside(evaluation)
    of = {"": cells["accessible"]} | (
        {} if cells["free"] == cells["accessible"] else {", of all free cells": cells["free"]}
    )
    rows = [
        coverage_row(meaning + name, getattr(found, meaning), number, getattr(evaluation.closed_form, meaning))
        for name, number in of.items()
        for meaning in MEANINGS
    ]
    for row in (*rows, *more):
        _add(table, evaluation, *row)
    return table


def _chances_table(evaluation: Evaluation) -> Table:
    """What a decision hangs on: chances of coverage, losses, time."""
    found, exact = _beside(evaluation), evaluation.closed_form
    named = ("sampled" if found.visited.known is None else "chance", "95 % interval")
    table = _table(evaluation, "Chances in %, losses and time", named)
    chances = {f"chance to visit {100 * x:g} % or more": found.visited.at_least[x] for x in AT_LEAST[:-1]}
    chances["chance to visit every cell"] = found.complete
    ends = {outcome: chance for outcome, chance in found.ends.items() if outcome not in SAID_BY_COVERAGE}
    chances |= {f"chance that it {evaluation.plan.clause_of(outcome)}": chance for outcome, chance in ends.items()}
    for name, chance in chances.items():
        _add(table, evaluation, name, "", chance.columns())
    known = in_percent(exact.some_left, 2)
    _add(table, evaluation, "chance that a robot is left at the end", known, found.some_left.columns())
    robots = len(evaluation.plan.robots)
    known = "" if math.isnan(exact.expected_losses) else f"{of_all(exact.expected_losses, robots)} of {robots}"
    _add(table, evaluation, "robots lost", known, found.losses.columns())
    if found.home is not None:
        _add(table, evaluation, "robots home", "", losses_shown(found.home, robots))
        for least, chance in found.home.shown.items():
            _add(table, evaluation, f"chance that {at_least_words(least, robots)} home", "", chance.columns())
    _add(table, evaluation, "time, steps", known_words(exact.mean_time, "{:,.1f}"), found.time.columns())
    if pace := evaluation.world.pace:
        known = known_words(pace.minutes * exact.mean_time, "{:,.1f}")
        _add(table, evaluation, "time, minutes", known, found.time.columns(pace.minutes))
    return table


def worst_cells(evaluation: Evaluation) -> list[Table]:
    """The cells that cost most robots, and those that are covered least."""
    world, expected = evaluation.ground, evaluation.expected
    accessible = np.flatnonzero(evaluation.accessible)
    chance, lost, threat = expected.visited_by_cell, expected.stops_by_cell, world.threat.ravel()
    least = accessible[np.argsort(chance[accessible], kind="stable")][:LISTED]
    found = []
    for title, cells in (("Cells that cost most robots", worst_of(lost, LISTED)), ("Cells covered least", least)):
        table = make_table(("row", "column", "threat", "chance covered", "robots lost"), title)
        for cell in cells.tolist():
            row, col = divmod(cell, world.shape[1])
            chances = (percent(float(of[cell]), 2) for of in (threat, chance))
            table.add_row(f"{row}", f"{col}", *chances, f"{lost[cell]:.4f}")
        found.append(table)
    return [table for table in found if table.rows]


def worst_of(lost: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """The cells `[up to most]` that cost most robots, the worst first; ties by index."""
    order = np.argsort(-lost, kind="stable")[:most]
    return order[lost[order] > 0]


def robots_table(evaluation: Evaluation) -> Table:
    """A row for each robot; its survival is that of its nominal path."""
    plan, survival = evaluation.plan, evaluation.closed_form.survival.tolist()
    columns = ("robot", "start [row, col]", "moves", "quarter turns", "areas covered", "survives its nominal path")
    drive = drive_of(robot.path for robot in plan.robots)
    table = make_table(columns, "Robots of the plan, and the chance that each ends its path", left=columns[:1])
    for number, (robot, chance) in enumerate(zip(plan.robots, survival, strict=True)):
        row, col = divmod(int(robot.path[0]), plan.shape[1])
        areas = "" if plan.is_foreign else f"{sum(leg.kind == 'cover' for leg in robot.legs)}"
        known = "not known" if math.isnan(chance) else percent(chance, 2)
        table.add_row(
            f"{number}", f"[{row}, {col}]", f"{drive.moves[number]:,}", f"{drive.turns[number]:,}", areas, known
        )
    return table


# The paper's formulas for an evaluated plan, held against the open loop's exact values.

FORMULA_WORDS = {
    Verdict.HOLDS: ("holds", "hold"),
    Verdict.FAILS: ("fails", "fail"),
    Verdict.UNDECIDED: ("is undecided", "are undecided"),
    Verdict.VACUOUS: ("says nothing", "say nothing"),
}
WORDS = {
    None: "",
    Verdict.FAILS: "FAILS",
    Verdict.HOLDS: "holds",
    Verdict.VACUOUS: "says nothing",
    Verdict.UNDECIDED: "undecided",
}


def formulas_part(evaluation: Evaluation, asked: bool) -> Part:
    """The section on them: folded away on a page, and left out on a terminal, unless somebody `asked`."""
    title, said = "The paper's formulas", formulas_words(evaluation) + "."
    if not evaluation.settled:
        return Part(title, notes=[said], aside=not asked)
    if asked:
        return Part(title, [formulas_table(evaluation)], [eq2_words(evaluation), *[said] * (not evaluation.certain)])
    return Part(title, [formulas_table(evaluation)], [eq2_words(evaluation)], lead=said,
                fold="Every formula, with its verdict", aside=True)  # fmt: skip


def formula_counts(evaluation: Evaluation) -> dict[Verdict, int]:
    """How many of the paper's formulas, every reading counted, have each verdict against the open loop."""
    judged = [evaluation.verdicts[key] for key in FORMULAS if FORMULAS[key].paper]
    return {verdict: judged.count(verdict) for verdict in FORMULA_WORDS}


def formulas_words(evaluation: Evaluation) -> str:
    """One line: how many of the paper's formulas hold on this plan and how many fail."""
    if not evaluation.settled:
        return (
            "No formula and no bound of the paper is given: they presume one known map, each of whose visits stops a "
            "robot with the cell's p, whatever came before"
        )
    if evaluation.plan.state is not None:
        return "The paper's formulas are left out: they are about whole missions, this is the rest of one"
    counts = formula_counts(evaluation)
    said = [
        f"{number} {FORMULA_WORDS[verdict][number != 1]}"
        for verdict, number in counts.items()
        if number or verdict in (Verdict.HOLDS, Verdict.FAILS)
    ]
    return f"Of the paper's {sum(counts.values())} formulas for the open loop, every reading counted, {', '.join(said)}"


def formulas_table(evaluation: Evaluation) -> Table:
    """The paper's formulas for this plan, in cells, and whether each holds against the open loop's exact values."""
    bounds, exact = evaluation.formulas, evaluation.closed_form
    title, said = "The paper's formulas against the open loop, in cells", ("", "as a bound")
    table = make_table(("", *MEANINGS, "as a bound"), title, left=said)
    table.add_row("exact expected coverage", f"{exact.visited:.2f}", f"{exact.survived:.2f}", "")
    above, limit = WORDS[evaluation.verdicts["ideal_team"]], evaluation.bounds.any_strategy
    if limit is not None:
        table.add_row("no strategy exceeds on average (proven)", f"{limit.cells:.2f}", "", "")
    table.add_row("ideal of the team: the same, of any map", f"{bounds.ideal_team:.2f}", "", above)
    table.add_row("ideal of one robot, eq. (7)", f"{bounds.ideal_eq7:.2f}", "", "")
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
        elif not evaluation.plan.is_foreign:
            table.add_row(f"eq. (5) {name}", "", "", "undefined here")
    return table


def eq2_words(evaluation: Evaluation) -> str:
    """Eq. (2) is about a chance, not about cells: a line below the table of formulas."""
    bounds, verdict = evaluation.formulas, WORDS[evaluation.verdicts["eq2_printed"]]
    return (
        f"eq. (2) as printed, the chance that a robot is left: {percent(bounds.eq2_printed, 2)}, "
        f"exactly {percent(bounds.team_survival, 2)} ({verdict})."
    )
