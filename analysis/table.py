"""The readable answer of `mrac-jax evaluate`: a few tables that a person with a deadline can take in."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from analysis.estimate import Estimate, mean_estimate, proportion, spread
from analysis.evaluation import Evaluation
from analysis.report import AT_LEAST, at_least, cell_counts, expected_losses
from planner.tally import Outcome


def print_evaluation(evaluation: Evaluation, console: Console) -> None:
    """Print what was evaluated, the answer, and the formulas beside it."""
    _print_heading(evaluation, console)
    console.print(_coverage_table(evaluation))
    console.print(_chances_table(evaluation))
    console.print(_bounds_table(evaluation))
    for note in evaluation.notes:
        console.print(f"note: {note}", markup=False, highlight=False)


def _print_heading(evaluation: Evaluation, console: Console) -> None:
    cells, plan, tally = cell_counts(evaluation), evaluation.plan, evaluation.tally
    height, width = evaluation.world.shape
    lines = [
        f"{evaluation.world.source}: {height} x {width} cells of {evaluation.world.cell_size:g} m, "
        f"{cells['free']} free, {cells['accessible']} accessible, {cells['dangerous']} of them dangerous",
        f"{len(plan.robots)} robot{'' if len(plan.robots) == 1 else 's'}; "
        + ("plan of another planner" if plan.is_foreign else f"{len(plan.areas)} areas, nominal run {plan.outcome}")
        + f", makespan {plan.makespan} steps",
        f"{tally.rollouts:,} rollouts, {_loop(evaluation)}, seed {evaluation.seed}, "
        f"{evaluation.engine}: {tally.rollouts / max(evaluation.seconds, 1e-9):,.0f} a second"
        + (" (interrupted: what was done so far)" if evaluation.partial else ""),
    ]
    for line in lines:
        console.print(line, markup=False, highlight=False)


def _loop(evaluation: Evaluation) -> str:
    return f"open loop, {evaluation.mode} mode" if evaluation.loop == "open" else "closed loop"


def _exact_column(evaluation: Evaluation) -> str:
    """What the exact values are of: the closed form holds for the open loop alone."""
    return "exact mean" if evaluation.loop == "open" else "open loop, exact"


def _coverage_table(evaluation: Evaluation) -> Table:
    """Coverage in percent, both meanings, sampled beside exact; by the deadline too."""
    cells = cell_counts(evaluation)
    table = Table(title="Coverage, % of the accessible cells", box=box.SIMPLE_HEAD, title_justify="left")
    columns = ("", _exact_column(evaluation), "sampled mean", "95 % interval", "5 %", "median", "95 %", "% of all free")
    for column in columns:
        table.add_column(column, justify="left" if not column else "right")
    exact = {"visited": evaluation.exact.visited, "survived": evaluation.exact.survived}
    for meaning, value in exact.items():
        _add_coverage_row(table, meaning, value, getattr(evaluation.tally, meaning), cells)
    if evaluation.deadline is not None:
        by_then = evaluation.exact.by_deadline(evaluation.deadline.steps)
        for (meaning, _), value in zip(exact.items(), by_then, strict=True):
            name = f"{meaning} by step {evaluation.deadline.steps}"
            _add_coverage_row(table, name, value, getattr(evaluation.deadline.tally, meaning), cells)
    return table


def _add_coverage_row(table: Table, name: str, exact_cells: float, counts, cells: dict[str, int]) -> None:  # type: ignore[no-untyped-def]
    known = spread(counts, 100.0 / cells["accessible"])
    low, high = known.estimate.ci95
    table.add_row(
        name,
        f"{100 * exact_cells / cells['accessible']:.2f}",
        f"{known.estimate.mean:.2f}",
        f"{low:.2f} .. {high:.2f}",
        *(f"{value:.1f}" for value in known.quantiles.values()),
        f"{known.estimate.mean * cells['accessible'] / cells['free']:.2f}",
    )


def _chances_table(evaluation: Evaluation) -> Table:
    """What a decision hangs on: chances of coverage, losses, time."""
    tally, exact, plan = evaluation.tally, evaluation.exact, evaluation.plan
    table = Table(title="Chances, losses and time", box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("", _exact_column(evaluation), "sampled", "95 % interval"):
        table.add_column(column, justify="left" if not column else "right")

    def add(name: str, estimate: Estimate, value: float | None, scale: float, form: str) -> None:
        low, high = (scale * bound for bound in estimate.ci95)
        shown = "" if value is None else form.format(scale * value)
        table.add_row(name, shown, form.format(scale * estimate.mean), f"{form.format(low)} .. {form.format(high)}")

    for fraction in AT_LEAST[:-1]:
        add(f"P(visited >= {100 * fraction:g} %), %", at_least(tally.visited, fraction), None, 100, "{:.2f}")
    complete = proportion(int(tally.outcomes[Outcome.COMPLETE]), tally.rollouts)
    add("P(complete), %", complete, None, 100, "{:.2f}")
    stuck = sum(int(tally.outcomes[outcome]) for outcome in (Outcome.STUCK, Outcome.TIMEOUT))
    if stuck:
        add("P(stuck or timeout), %", proportion(stuck, tally.rollouts), None, 100, "{:.2f}")
    survives = proportion(tally.rollouts - int(tally.alive[0]), tally.rollouts)
    add("P(some robot finishes), %", survives, evaluation.bounds.team_survival, 100, "{:.2f}")
    add(f"robots lost of {len(plan.robots)}", expected_losses(tally), exact.expected_losses, 1, "{:.2f}")
    add("time, steps", mean_estimate(tally.time, 1.0), exact.mean_time, 1, "{:.1f}")
    return table


def _bounds_table(evaluation: Evaluation) -> Table:
    """The paper's formulas for this plan, in cells, beside the exact expected coverage."""
    bounds, exact = evaluation.bounds, evaluation.exact
    table = Table(title="Formulas, in cells", box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("", "visited", "survived"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("exact expected coverage, open loop", f"{exact.visited:.2f}", f"{exact.survived:.2f}")
    table.add_row("ideal of the team (no strategy exceeds it)", f"{bounds.ideal_team:.2f}", "")
    table.add_row("ideal of one robot, eq. (7)", f"{bounds.ideal_eq7:.2f}", "")
    alone = [sum(getattr(gain, meaning) for gain in bounds.eq4) for meaning in ("visited", "survived")]
    table.add_row("sum of eq. (4) over the robots", *(f"{value:.2f}" for value in alone))
    if bounds.theorem3_visited is not None and bounds.theorem3_survived is not None:
        for reading in bounds.theorem3_visited.__dataclass_fields__:
            values = (getattr(t, reading) for t in (bounds.theorem3_visited, bounds.theorem3_survived))
            table.add_row(f"Theorem 3, |C| {reading.replace('_', ', ')}", *(f"{value:.2f}" for value in values))
    for reading, name in (("printed", "as printed"), ("with_c00", "with C_0,0")):
        terms = [getattr(bound, reading) for bound in bounds.eq5]
        if all(term is not None for term in terms):
            table.add_row(f"sum of eq. (5) over the robots, {name}", "", f"{sum(terms):.2f}")
    table.add_row("eq. (2) as printed, %", f"{100 * bounds.eq2_printed:.2f}", "")
    return table
