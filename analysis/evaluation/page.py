"""The page of `mrac-jax evaluate --out`: the answer, coverage over time and by cell, chances, bounds, and the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import cell_counts, expected_losses
from analysis.evaluation.page_curves import distribution, over_time
from analysis.evaluation.page_findings import findings
from analysis.evaluation.page_maps import maps, worst_cells
from analysis.evaluation.pictures_curves import over_time_heading
from analysis.evaluation.table import print_evaluation
from analysis.evaluation.words import headline
from analysis.kit.words import counted
from analysis.page.document import KeyFigure, Page, Section
from analysis.page.markup import Html, element, join
from analysis.page.parts import findings_section, input_name, pictures_section, reproduce_section, settings_section
from analysis.page.tables import TableData, printed, tables_html
from analysis.pictures.style import percent
from analysis.statistics.estimate import mean_estimate, proportion, quantile
from analysis.theory.verdicts import paper_checks
from planner.tally import Outcome

FILES = ("evaluation.json", "plan.json")


def evaluation_page(evaluation: Evaluation, command: str, pictures: Sequence[str], files: Sequence[str] = FILES) -> str:
    """The page as HTML. It holds nothing of when or how fast it was made: the same answer gives the same bytes.

    Args:
        command: the command line that made it. pictures, files: names of the files beside it.
    """
    lines, tables = printed(lambda console: print_evaluation(evaluation, console))
    controlled = [line for line in lines if line.startswith("controlled:")]
    time, spread = over_time(evaluation), distribution(evaluation)
    sections = (
        findings_section([*findings(evaluation), *controlled]),
        Section("Coverage over time", time, over_time_heading(evaluation)[1] + "."),
        Section("Single runs", spread, "How far one run may be from the mean."),
        Section("Cell by cell", maps(evaluation), _map_lead(evaluation)),
        Section("Figures", tables_html([*tables, *worst_cells(evaluation)]), _figures_lead(evaluation)),
        Section("Robots", tables_html([_robots(evaluation)])),
        settings_section(settings(evaluation)),
        pictures_section(pictures),
        reproduce_section(command, files),
    )
    robots = counted(len(evaluation.plan.robots), "robot")
    return Page(
        title=f"{input_name(evaluation.world.source)}, {robots}: how much is covered?",
        answer=headline(evaluation),
        sections=sections,
        kind="evaluate",
        figures=key_figures(evaluation),
        warnings=warnings(evaluation),
    ).html()


def key_figures(evaluation: Evaluation) -> tuple[KeyFigure, ...]:
    """The few to take away."""
    tally, cells, robots = evaluation.tally, evaluation.tally.accessible, len(evaluation.plan.robots)
    mean = mean_estimate(tally.visited, 100.0 / cells)
    sure = f"{mean.ci95[0]:.1f} .. {mean.ci95[1]:.1f} %, of {cells:,} accessible cells"
    shown = f"{mean.mean:.1f} %"
    if evaluation.closed is not None:
        shown, sure = f"{100 * evaluation.closed.visited.value / cells:.2f} %", f"exact, of {cells:,} accessible cells"
    elif evaluation.control is not None:
        low, high = evaluation.control[0].estimate.ci95
        shown = f"{100 * evaluation.control[0].estimate.mean:.2f} %"
        sure = f"{100 * low:.2f} .. {100 * high:.2f} %, of {cells:,} accessible cells"
    done = proportion(int(tally.outcomes[Outcome.COMPLETE]), tally.rollouts)
    lost, time = expected_losses(tally), mean_estimate(tally.time, 1.0)
    assured = quantile(tally.visited, 0.05) / cells
    rest = f"{percent(done.ci95[0], 2)} to {percent(done.ci95[1], 2)}"
    return (
        KeyFigure(shown, "visited on average", sure),
        KeyFigure(f"{100 * assured:.1f} %", "or more in 95 % of runs", "of the accessible cells"),
        KeyFigure(percent(done.mean), "chance to visit every cell", rest),
        KeyFigure(f"{lost.mean:.2f} of {robots}", "robots lost", f"{lost.ci95[0]:.2f} .. {lost.ci95[1]:.2f}"),
        KeyFigure(f"{time.mean:,.0f} steps", "mean time", f"{time.ci95[0]:,.1f} .. {time.ci95[1]:,.1f}"),
    )


def warnings(evaluation: Evaluation) -> tuple[str, ...]:
    """What must not be overlooked."""
    cut = ("Interrupted: these are the rollouts that were done until then.",) if evaluation.partial else ()
    return (*cut, *(f"Note: {note}" for note in (*evaluation.notes, *evaluation.world.notes, *evaluation.plan.notes)))


def settings(evaluation: Evaluation) -> dict[str, object]:
    """Everything that the figures depend on."""
    world, plan, cells = evaluation.world, evaluation.plan, cell_counts(evaluation)
    out: dict[str, object] = {
        "map": input_name(world.source),
        "size": f"{world.shape[0]} x {world.shape[1]} cells of {world.cell_size:g} m",
        "cells": f"{cells['free']:,} free, {cells['accessible']:,} accessible, {cells['dangerous']:,} dangerous",
        "map's SHA-256": element("code", world.sha256[:16] + "..."),
        "robots": f"{len(plan.robots)}",
        "loop": f"{evaluation.loop}" + (f", {evaluation.mode} mode" if evaluation.loop == "open" else ""),
        "rollouts": f"{evaluation.tally.rollouts:,}",
        "seed": f"{evaluation.seed}",
        "engine": evaluation.engine,
    }
    if plan.settings is None:
        out["plan"] = "of another planner"
    else:
        chosen = plan.settings
        limit = "8 x levels x cells + 64" if chosen.max_steps is None else f"{chosen.max_steps:,}"
        out |= {
            "plan": f"{counted(len(plan.areas), 'area')}, nominal run {plan.outcome}, {plan.shares} shared",
            "threat levels at most": f"{chosen.levels}",
            "density d": f"{chosen.density:g}",
            "risk": chosen.risk,
            "transit": chosen.transit,
            "limit of steps": limit,
        }
    out["makespan"] = f"{plan.makespan:,} steps"
    if evaluation.deadline is not None:
        out["deadline"] = f"step {evaluation.deadline.steps:,}"
    return out


def _map_lead(evaluation: Evaluation) -> str:
    rows, cols = evaluation.world.shape
    return f"{counted(rows, 'row')} and {counted(cols, 'column')}, row 0 at the top."


def _robots(evaluation: Evaluation) -> TableData:
    """A row for each robot; its survival is that of its nominal path."""
    plan, survival = evaluation.plan, evaluation.exact.survival
    rows = []
    for number, robot in enumerate(plan.robots):
        row, col = divmod(int(robot.path[0]), plan.shape[1])
        moves = int(np.count_nonzero(np.diff(robot.path)))
        areas = "" if plan.is_foreign else str(sum(leg.kind == "cover" for leg in robot.legs))
        rows.append((str(number), f"[{row}, {col}]", f"{moves:,}", areas, percent(float(survival[number]), 2)))
    columns = ("robot", "start [row, col]", "moves", "areas covered", "survives its nominal path")
    return TableData("Robots of the plan, and the chance that each ends its path", columns, tuple(rows), frozenset({0}))


def _figures_lead(evaluation: Evaluation) -> Html | str:
    checks = paper_checks(evaluation.plan, evaluation.world, evaluation.exact, evaluation.bounds)
    if not checks:
        return ""
    return join(("Coverage in both meanings, chances, and the paper's formulas with a verdict on each.",))
