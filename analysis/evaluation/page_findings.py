"""What an evaluation shows, in sentences: what limits it, where robots are lost, what is missed, what fails."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.words import proven
from analysis.kit.words import percent
from analysis.theory.formulas import FORMULAS
from analysis.theory.verdicts import Verdict, overall
from planner.shown import counted
from planner.tally import Outcome

ENDS = {
    Outcome.COMPLETE: "every accessible cell was visited",
    Outcome.STOPPED: "all robots were lost before every cell was visited",
    Outcome.STUCK: "robots were left but could not go on",
    Outcome.TIMEOUT: "the limit of steps was reached",
    Outcome.PATH_END: "robots were left at the end of their paths, cells too",
    Outcome.CALLED_OFF: "robots were called off: the rest was not worth one of them",
}


def findings(evaluation: Evaluation) -> list[str]:
    """Sentences, the most useful first."""
    told = (found.sentences() for found in reversed(tuple(evaluation.outputs.values())))
    return [*_limits(evaluation), *_ends(evaluation), *_losses(evaluation), *_missed(evaluation), *chain(*told)]


def _limits(evaluation: Evaluation) -> Iterator[str]:
    cells = evaluation.tally.accessible
    mean = evaluation.visited.mean * cells
    limits = evaluation.bounds
    least, how = limits.least.cells, f"a bound, {proven(evaluation)}" if limits.any_strategy else "ideal of the team"
    if evaluation.settled:
        yield (
            f"Of the {percent(least / cells)} that no strategy exceeds on average with this team on this map ({how}), "
            f"this plan reaches {percent(min(mean / least, 1.0)) if least else '0 %'}."
        )
    if evaluation.loop == "closed" and evaluation.closed_form.is_known:
        exact, half = evaluation.closed_form.visited, 100 * evaluation.visited.half_width
        gain = 100 * (mean - exact) / cells
        sure = f" ± {half:.2g} (95 %)" if half else ""
        word = "gains" if gain >= 0 else "loses"
        yield (
            f"Giving the areas of lost robots to the others {word} {abs(gain):.1f} points{sure} over robots that "
            f"follow their own plans alone ({percent(exact / cells)}, exact)."
        )


def _ends(evaluation: Evaluation) -> Iterator[str]:
    tally = evaluation.tally
    ended = [(outcome, int(tally.outcomes[outcome])) for outcome in Outcome if tally.outcomes[outcome]]
    parts = [f"{ENDS[outcome]}: {percent(number / tally.rollouts, 2)}" for outcome, number in ended]
    yield f"How the {tally.rollouts:,} rollouts ended. {'; '.join(parts).capitalize()}."


def _losses(evaluation: Evaluation) -> Iterator[str]:
    lost, width = evaluation.expected.stops_by_cell, evaluation.world.shape[1]
    total = float(lost.sum())
    if total <= 0:
        yield "No robot is lost."
        return
    order = np.argsort(-lost, kind="stable")
    row, col = divmod(int(order[0]), width)
    said = f"Most robots are lost in row {row}, column {col}: {lost[order[0]]:.3g} a run"
    dangerous = int((lost > 0).sum())
    few = int(np.searchsorted(np.cumsum(lost[order]), 0.5 * total - 1e-12)) + 1
    if dangerous > 1:
        yield f"{said}. {counted(few, 'cell')} of the {dangerous:,} where robots are lost take half of all losses."
    else:
        yield f"{said}, the only cell where one is."


def _missed(evaluation: Evaluation) -> Iterator[str]:
    world, chance = evaluation.world, evaluation.expected.visited_by_cell
    cells = np.flatnonzero(world.accessible(evaluation.plan.starts))
    rare = int((chance[cells] < 0.5).sum())
    least = int(cells[np.argmin(chance[cells])])
    row, col = divmod(least, world.shape[1])
    of = " of the rollouts" if evaluation.loop == "closed" else ""
    worst = f"least likely: row {row}, column {col} ({percent(float(chance[least]))}{of})"
    some = f"{counted(rare, 'cell')} of {len(cells):,} are covered in fewer than half of the runs" if rare else (
        "every accessible cell is covered in at least half of the runs"
    )  # fmt: skip
    yield f"{some[0].upper()}{some[1:]}; {worst}."
    out = int(world.free.sum()) - len(cells)
    if out:
        yield f"{counted(out, 'free cell')} cannot be reached by any robot; they count only in 'of all free cells'."


def formula_findings(evaluation: Evaluation) -> Iterator[str]:
    """Which of the paper's formulas fail on this plan, and which say nothing."""
    judged = {key: overall(check for check in evaluation.checks if check.formula == key) for key in FORMULAS}
    for verdict, words in ((Verdict.FAILS, "fail"), (Verdict.VACUOUS, "say nothing")):
        names = [FORMULAS[key].title for key, found in judged.items() if found is verdict and FORMULAS[key].paper]
        if names:
            yield f"Of the paper's formulas, {counted(len(names), 'reading')} {words} here: {'; '.join(names)}."
