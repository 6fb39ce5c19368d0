"""The readable answer of `mrac-jax evaluate`: one sentence, then tables that a person with a deadline can take in."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.output import Row, coverage_row, known_words
from analysis.evaluation.words import (
    _heading,
    chance_columns,
    chances_words,
    formulas_words,
    headline,
    limit_words,
    losses_words,
    verdict_words,
)
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import percent
from analysis.statistics.control import complete_chance
from analysis.statistics.coverage import AT_LEAST, at_least, expected_losses, losses_shown
from analysis.statistics.estimate import Estimate, assured, proportion
from analysis.statistics.words import lost_words
from analysis.theory.bounds import Theorem3
from analysis.theory.verdicts import MEANINGS
from planner.tally import Outcome


def print_evaluation(evaluation: Evaluation, console: Console, theory: bool = False) -> None:
    """Print the answer and the losses in words, the figures behind them, and last what was evaluated.

    theory: also the paper's formulas, and how many of them hold.
    """
    print_lines(console, (headline(evaluation), *in_words(evaluation), ""))
    for table in answer_tables(evaluation):
        console.print(table)
    if theory and evaluation.settled:
        console.print(formulas_table(evaluation))
        print_lines(console, (eq2_words(evaluation),))
    if theory and not evaluation.certain:
        print_lines(console, (formulas_words(evaluation) + ".",))
    if not evaluation.certain:  # bounds on what is known
        print_lines(console, footnotes(evaluation))
    print_lines(console, (*_heading(evaluation), *(f"note: {note}" for note in evaluation.notes)))


def in_words(evaluation: Evaluation) -> tuple[str, ...]:
    """What the headline leaves out, a sentence each: losses, chances, time."""
    opens = [line for found in evaluation.outputs.values() for line in found.opens()]
    if evaluation.certain:
        return tuple(opens)
    own = (losses_words(evaluation), chances_words(evaluation), limit_words(evaluation))
    leads = (line for found in evaluation.outputs.values() for line in found.leads())
    return tuple(line for line in (*opens, *own, *leads) if line)


def answer_tables(evaluation: Evaluation) -> list[Table]:
    """The figures behind the answer: chances and time, coverage, other threats."""
    chances = [] if evaluation.certain else [_chances_table(evaluation)]
    rows = [row for found in evaluation.outputs.values() for row in found.rows()]
    coverage = [] if evaluation.certain and not rows else [_coverage_table(evaluation, rows)]
    own = [table for found in evaluation.outputs.values() if (table := found.table()) is not None]
    return [*chances, *coverage, *own]


def footnotes(evaluation: Evaluation) -> list[str]:
    """What the quantiles of the table are beside the headline's, and what the outputs add below the tables."""
    own = []
    if not evaluation.certain and assured(evaluation.tally.visited) is not None:
        own = [
            "5 %, median, 95 %: of the runs that were done; what the headline says of 95 % of runs is sure with 95 %."
        ]
    return own + [line for found in evaluation.outputs.values() for line in found.footnotes()]


def _table(evaluation: Evaluation, title: str, columns: Sequence[str]) -> Table:
    """A table with a column for names, `columns`, and the open loop's exact values: last where they only compare."""
    named = ("exact", *columns) if evaluation.loop == "open" else (*columns, "open loop")
    return make_table(("", *named), title)


def _add(table: Table, evaluation: Evaluation, name: str, exact: str, shown: Sequence[str]) -> None:
    table.add_row(name, *((exact, *shown) if evaluation.loop == "open" else (*shown, exact)))


def _coverage_table(evaluation: Evaluation, more: Sequence[Row]) -> Table:
    """Coverage in percent, both meanings; and the outputs' rows."""
    columns = ("mean", "95 % interval", "5 %", "median", "95 %")
    table = _table(evaluation, "Coverage, % of the accessible cells", columns)
    cells, closed, certain = evaluation.cells, evaluation.closed, evaluation.certain
    of = {"": cells["accessible"]} | (
        {} if cells["free"] == cells["accessible"] else {", of all free cells": cells["free"]}
    )
    rows = [
        coverage_row(
            meaning + name,
            evaluation.tally,
            meaning,
            number,
            getattr(evaluation.closed_form, meaning),
            certain,
        )
        for name, number in of.items()
        for meaning in MEANINGS
    ]
    for meaning in MEANINGS if closed is not None else ():
        exactly = 100 * getattr(closed, meaning).value / cells["accessible"]
        rows.append(Row(f"{meaning}, exactly", "", (f"{exactly:.4f}", "", "", "", "")))
    for row in (*rows, *more):
        _add(table, evaluation, *row)
    return table


def _chances_table(evaluation: Evaluation) -> Table:
    """What a decision hangs on: chances of coverage, losses, time."""
    tally, exact, bounds = evaluation.tally, evaluation.closed_form, evaluation.formulas
    table = _table(evaluation, "Chances in %, losses and time", ("sampled", "95 % interval"))

    def chance(name: str, estimate: Estimate, known: float | None = None) -> None:
        exactly = "" if known is None else percent(known, 2).removesuffix(" %")
        _add(table, evaluation, name, exactly, chance_columns(estimate, tally.rollouts))

    for fraction in AT_LEAST[:-1]:
        chance(f"chance to visit {100 * fraction:g} % or more", at_least(tally.visited, fraction))
    chance("chance to visit every cell", complete_chance(tally))
    settings = evaluation.plan.settings
    limit = "limit of steps" if settings is None or settings.deadline is None else "deadline"
    ends = {
        Outcome.STUCK: "chance to end stuck: no robot can go on",
        Outcome.TIMEOUT: f"chance to end at the {limit}",
        Outcome.CALLED_OFF: "chance to end as the rest is not worth a robot",
    }
    for outcome, name in ends.items():
        if seen := int(tally.outcomes[outcome]):
            chance(name, proportion(seen, tally.rollouts))
    left = proportion(tally.rollouts - int(tally.alive[0]), tally.rollouts)
    some_left = bounds.team_survival if evaluation.settled else 1.0 - float(exact.alive_chance[0])
    chance("chance that a robot is left at the end", left, None if math.isnan(some_left) else some_left)
    lost, time = expected_losses(tally), evaluation.sampled_time
    exactly = evaluation.exact if evaluation.loop == "closed" else None
    robots = len(evaluation.plan.robots)
    known = "" if math.isnan(exact.expected_losses) else lost_words(exact.expected_losses, robots)
    _add(table, evaluation, "robots lost", known, losses_shown(lost, robots))
    if exactly is not None and exactly.alive is not None:
        _add(table, evaluation, "robots lost, exactly", "", (f"{robots - exactly.alive:.4g} of {robots}", ""))
    _add(table, evaluation, "time, steps", known_words(exact.mean_time, "{:,.1f}"), time.columns())
    if exactly is not None and exactly.time is not None:
        _add(table, evaluation, "time, steps, exactly", "", (f"{exactly.time:,.2f}", ""))
    return table


def formulas_table(evaluation: Evaluation) -> Table:
    """The paper's formulas for this plan, in cells, and whether each holds against the open loop's exact values."""
    bounds, exact, checks = evaluation.formulas, evaluation.closed_form, evaluation.checks
    title, said = "The paper's formulas against the open loop, in cells", ("", "as a bound")
    table = make_table(("", *MEANINGS, "as a bound"), title, left=said)
    table.add_row("exact expected coverage", f"{exact.visited:.2f}", f"{exact.survived:.2f}", "")
    above, limit = verdict_words(checks, "ideal_team"), evaluation.bounds.any_strategy
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
            table.add_row(name, *(f"{value:.2f}" for value in pair), verdict_words(checks, f"theorem3_{reading}"))
    for reading, name in (("printed", "as printed"), ("with_c00", "with C_0,0")):
        terms = [getattr(bound, reading) for bound in bounds.eq5]
        if all(term is not None for term in terms):
            verdict = verdict_words(checks, f"eq5_{reading}")
            table.add_row(f"eq. (5) {name}, robots summed", "", f"{sum(terms):.2f}", verdict)
        elif not evaluation.plan.is_foreign:
            table.add_row(f"eq. (5) {name}", "", "", "undefined here")
    return table


def eq2_words(evaluation: Evaluation) -> str:
    """Eq. (2) is about a chance, not about cells: a line below the table of formulas."""
    bounds = evaluation.formulas
    printed, known = percent(bounds.eq2_printed, 2), percent(bounds.team_survival, 2)
    verdict = verdict_words(evaluation.checks, "eq2_printed")
    return f"eq. (2) as printed, the chance that a robot is left: {printed}, exactly {known} ({verdict})."
