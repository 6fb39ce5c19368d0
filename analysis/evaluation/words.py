"""TODO what this file is for."""

from __future__ import annotations

from collections.abc import Iterable

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import cell_counts, expected_losses
from analysis.kit.words import counted
from analysis.statistics.estimate import mean_estimate, quantile
from analysis.theory.verdicts import Check, Verdict, overall


def headline(evaluation: Evaluation) -> str:
    """The answer in one sentence. Quantiles are of single runs."""
    tally, robots = evaluation.tally, len(evaluation.plan.robots)
    mean = mean_estimate(tally.visited, 100.0 / tally.accessible)
    shown = f"{mean.mean:.1f} % of the accessible cells on average (sampling error {mean.half_width:.2g})"
    if evaluation.closed is not None:
        shown = f"{100 * evaluation.closed.visited.value / tally.accessible:.2f} % of the accessible cells (exact)"
    elif evaluation.control is not None:
        mean = evaluation.control[0].estimate
        shown = (
            f"{100 * mean.mean:.2f} % of the accessible cells on average (sampling error {100 * mean.half_width:.2g})"
        )
    assured = 100.0 * quantile(tally.visited, 0.05) / tally.accessible
    who = "1 robot visits" if robots == 1 else f"{robots} robots visit"
    return (
        f"{who} {shown}, at least "
        f"{assured:.1f} % in 95 % of runs, and {expected_losses(tally).mean:.2f} of {robots} are lost."
    )


def _heading(evaluation: Evaluation) -> list[str]:
    cells, plan, tally, world = cell_counts(evaluation), evaluation.plan, evaluation.tally, evaluation.world
    ground = f" ({_area(cells['accessible'] * world.cell_size**2)})" if world.cell_size != 1 else ""
    made = "plan of another planner"
    if not plan.is_foreign:
        made = f"{len(plan.areas)} areas, nominal run {plan.outcome}, {plan.shares} areas shared"
    loop = f"open loop, {evaluation.mode} mode" if evaluation.loop == "open" else "closed loop"
    return [
        f"{world.source}: {world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m; {cells['free']} free, "
        f"{cells['accessible']} accessible{ground}, {cells['dangerous']} of these dangerous",
        f"plan: {made}, makespan {plan.makespan} steps",
        f"{tally.rollouts:,} rollouts, {loop}, seed {evaluation.seed}, {evaluation.engine}: "
        f"{tally.rollouts / max(evaluation.seconds, 1e-9):,.0f} a second"
        + (" (interrupted: what was done so far)" if evaluation.partial else ""),
    ]


def _area(square_metres: float) -> str:
    return f"{square_metres:,.0f} m2" if square_metres < 1e6 else f"{square_metres / 1e6:,.0f} km2"


WORDS = {
    Verdict.FAILS: "FAILS",
    Verdict.HOLDS: "holds",
    Verdict.VACUOUS: "says nothing",
    Verdict.UNDECIDED: "undecided",
}


def verdict_words(checks: Iterable[Check], formula: str) -> str:
    """The verdict on a formula in all its meanings and robots."""
    verdict = overall(check for check in checks if check.formula == formula)
    return "" if verdict is None else WORDS[verdict]


def how_known(evaluation: Evaluation) -> str:
    """Where the expected values come from: "open loop, exact", or "closed loop, sampled, 20,000 rollouts"."""
    if evaluation.loop == "open":
        return evaluation.expected.how
    rollouts = counted(evaluation.tally.rollouts, "rollout")
    return f"{evaluation.expected.how}, {rollouts}" + (", interrupted" if evaluation.partial else "")
