"""The paper's formulas for an evaluated plan, held against the open loop's exact values."""

from __future__ import annotations

from rich.table import Table

from analysis.evaluation.answer import Evaluation
from analysis.kit.tables import make_table
from analysis.report.blocks import Part
from analysis.theory.bounds import Theorem3
from analysis.theory.formulas import FORMULAS
from analysis.theory.verdicts import MEANINGS, Verdict
from planner.shown import percent

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
