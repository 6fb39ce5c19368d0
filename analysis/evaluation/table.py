"""The readable answer of `mrac-jax evaluate`: one sentence, then tables that a person with a deadline can take in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import cell_counts
from analysis.evaluation.words import (
    _heading,
    chances_words,
    formulas_words,
    headline,
    losses_words,
    lost_words,
    mean_words,
    verdict_words,
)
from analysis.kit.words import percent, share
from analysis.statistics.coverage import AT_LEAST, at_least, expected_losses
from analysis.statistics.estimate import Estimate, mean_estimate, proportion, spread
from analysis.theory.bounds import Theorem3
from analysis.theory.verdicts import paper_checks
from planner.tally import Outcome


def print_evaluation(evaluation: Evaluation, console: Console, theory: bool = False) -> None:
    """Print the answer and the losses in words, the figures behind them, and last what was evaluated.

    theory: also the paper's formulas, of which one line says otherwise how many hold.
    """

    def say(*lines: str) -> None:
        for line in lines:
            console.print(line, markup=False, highlight=False)

    say(headline(evaluation), *in_words(evaluation), "")
    for table in answer_tables(evaluation):
        console.print(table)
    if theory:
        console.print(formulas_table(evaluation))
        say(eq2_words(evaluation))
    if not evaluation.certain:  # bounds on what is known
        say(formulas_words(evaluation) + ("." if theory else ": --theory lists them."), *control_words(evaluation))
    say(*_heading(evaluation), *(f"note: {note}" for note in evaluation.notes))


def in_words(evaluation: Evaluation) -> tuple[str, ...]:
    """What the headline leaves out, a sentence each: losses, chances, time."""
    if evaluation.certain:
        return ()
    return tuple(line for line in (losses_words(evaluation), chances_words(evaluation)) if line)


def answer_tables(evaluation: Evaluation) -> list[Table]:
    """The figures behind the answer: chances and time, coverage, other threats."""
    certain, scaled = evaluation.certain, [_scaled_table(evaluation)] if evaluation.scaled else []
    chances = [] if certain else [_chances_table(evaluation)]
    coverage = [] if certain and evaluation.deadline is None else [_coverage_table(evaluation)]
    return [*chances, *coverage, *scaled]


def control_words(evaluation: Evaluation) -> tuple[str, ...]:
    """What the control variate was worth, if there was one."""
    if evaluation.control is None:
        return ()
    gains = [f"{control.gain:.2f}" for control in evaluation.control]
    return (f"open loop as control variate: variance {gains[0]} (visited) and {gains[1]} (survived) times smaller",)


def _table(evaluation: Evaluation, title: str, columns: Sequence[str]) -> Table:
    """A table with a column for names, `columns`, and the open loop's exact values: last where they only compare."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    table.add_column("")
    named = ("exact", *columns) if evaluation.loop == "open" else (*columns, "open loop")
    for column in named:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _add(table: Table, evaluation: Evaluation, name: str, exact: str, shown: Sequence[str]) -> None:
    table.add_row(name, *((exact, *shown) if evaluation.loop == "open" else (*shown, exact)))


def _coverage_table(evaluation: Evaluation) -> Table:
    """Coverage in percent, both meanings, by the deadline too."""
    columns = ("mean", "95 % interval", "5 %", "median", "95 %")
    table = _table(evaluation, "Coverage, % of the accessible cells", columns)
    exact = {"visited": evaluation.closed_form.visited, "survived": evaluation.closed_form.survived}
    cells = cell_counts(evaluation)
    for meaning, value in exact.items():
        _add_coverage(table, evaluation, meaning, value, getattr(evaluation.tally, meaning), cells["accessible"])
    if cells["free"] != cells["accessible"]:
        for meaning, value in exact.items():
            name = f"{meaning}, of all free cells"
            _add_coverage(table, evaluation, name, value, getattr(evaluation.tally, meaning), cells["free"])
    shown_control = evaluation.control if evaluation.closed is None else None
    for meaning, control in zip(exact, shown_control or (), strict=False):
        low, high = (f"{100 * bound:.2f}" for bound in control.estimate.ci95)
        shown = (f"{100 * control.estimate.mean:.2f}", f"{low} .. {high}", "", "", "")
        _add(table, evaluation, f"{meaning}, controlled", "", shown)
    for meaning in exact if evaluation.closed is not None else ():
        value = 100 * getattr(evaluation.closed, meaning).value / cells["accessible"]
        _add(table, evaluation, f"{meaning}, exactly", "", (f"{value:.4f}", "", "", "", ""))
    if evaluation.deadline is not None:
        by_then = evaluation.closed_form.by_deadline(evaluation.deadline.steps)
        for meaning, value in zip(exact, by_then, strict=True):
            name, counts = f"{meaning} by step {evaluation.deadline.steps}", getattr(evaluation.deadline.tally, meaning)
            _add_coverage(table, evaluation, name, value, counts, cells["accessible"])
    return table


def _add_coverage(
    table: Table, evaluation: Evaluation, name: str, exact_cells: float, counts: NDArray[np.int64], of: int
) -> None:
    known = spread(counts, 100.0 / of, evaluation.certain)
    low, high = known.estimate.ci95
    shown = (
        f"{known.estimate.mean:.2f}",
        f"{low:.2f} .. {high:.2f}",
        *(f"{value:.1f}" for value in known.quantiles.values()),
    )
    _add(table, evaluation, name, f"{100 * exact_cells / of:.2f}", shown)


def _chances_table(evaluation: Evaluation) -> Table:
    """What a decision hangs on: chances of coverage, losses, time."""
    tally, exact, bounds = evaluation.tally, evaluation.closed_form, evaluation.formulas
    table = _table(evaluation, "Chances in %, losses and time", ("sampled", "95 % interval"))

    def add(name: str, shown: str, estimate: Estimate, known: str, form: str, scale: float = 1.0) -> None:
        low, high = (form.format(scale * bound) for bound in estimate.ci95)
        _add(table, evaluation, name, known, (shown, f"{low} .. {high}"))

    def chance(name: str, estimate: Estimate, known: float | None = None) -> None:
        seen = share(round(estimate.mean * tally.rollouts), tally.rollouts, 2)
        exactly = "" if known is None else percent(known, 2).removesuffix(" %")
        add(name, seen.removesuffix(" %"), estimate, exactly, "{:.2f}", 100.0)

    for fraction in AT_LEAST[:-1]:
        chance(f"chance to visit {100 * fraction:g} % or more", at_least(tally.visited, fraction))
    chance("chance to visit every cell", proportion(int(tally.outcomes[Outcome.COMPLETE]), tally.rollouts))
    stuck = sum(int(tally.outcomes[outcome]) for outcome in (Outcome.STUCK, Outcome.TIMEOUT))
    if stuck:
        chance("chance to end stuck or at the limit", proportion(stuck, tally.rollouts))
    if called_off := int(tally.outcomes[Outcome.CALLED_OFF]):
        chance("chance that robots are called off", proportion(called_off, tally.rollouts))
    left = proportion(tally.rollouts - int(tally.alive[0]), tally.rollouts)
    chance("chance that a robot is left at the end", left, bounds.team_survival)
    lost, time = expected_losses(tally), mean_estimate(tally.time, 1.0)
    robots = len(evaluation.plan.robots)
    known = lost_words(exact.expected_losses, robots)
    add(f"robots lost of {robots}", mean_words(evaluation), lost, known, "{:.2f}")
    add("time, steps", f"{time.mean:.1f}", time, f"{exact.mean_time:.1f}", "{:.1f}")
    return table


def _scaled_table(evaluation: Evaluation) -> Table:
    """What becomes of the plan if the threats are other than the map says, one scale a row."""
    table = Table(title="If every threat is so many times the map's", box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("times", "visited, %", "from", "to", "survived, %", "every cell, %", "robots lost", "time"):
        table.add_column(column, justify="right")
    for scaled in evaluation.scaled:
        tally = scaled.tally
        visited = mean_estimate(tally.visited, 100.0 / tally.accessible, certain=scaled.certain)
        low, high = visited.ci95
        table.add_row(
            f"{scaled.scale:g}",
            f"{visited.mean:.2f}",
            f"{low:.2f}",
            f"{high:.2f}",
            f"{mean_estimate(tally.survived, 100.0 / tally.accessible).mean:.2f}",
            share(int(tally.outcomes[Outcome.COMPLETE]), tally.rollouts, 2).removesuffix(" %"),
            lost_words(expected_losses(tally).mean, len(evaluation.plan.robots)),
            f"{mean_estimate(tally.time, 1.0).mean:.1f}",
        )
    return table


def formulas_table(evaluation: Evaluation) -> Table:
    """The paper's formulas for this plan, in cells, and whether each holds against the open loop's exact values."""
    bounds, exact = evaluation.formulas, evaluation.closed_form
    checks = paper_checks(evaluation.plan, evaluation.world, exact, bounds)
    title = "The paper's formulas against the open loop, in cells"
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("", "visited", "survived", "as a bound"):
        table.add_column(column, justify="right" if column in ("visited", "survived") else "left")
    table.add_row("exact expected coverage", f"{exact.visited:.2f}", f"{exact.survived:.2f}", "")
    above = verdict_words(checks, "ideal_team")
    table.add_row("ideal of the team: no strategy exceeds it", f"{bounds.ideal_team:.2f}", "", above)
    table.add_row("ideal of one robot, eq. (7)", f"{bounds.ideal_eq7:.2f}", "", "")
    alone = [sum(getattr(gain, meaning) for gain in bounds.eq4) for meaning in ("visited", "survived")]
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
    checks = paper_checks(evaluation.plan, evaluation.world, evaluation.closed_form, bounds)
    printed, known = percent(bounds.eq2_printed, 2), percent(bounds.team_survival, 2)
    verdict = verdict_words(checks, "eq2_printed")
    return f"eq. (2) as printed, the chance that a robot is left: {printed}, exactly {known} ({verdict})."
