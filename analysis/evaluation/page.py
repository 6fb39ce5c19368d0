"""The page of `mrac-jax evaluate --out`: the answer in words beside the map and the plan, then the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.page_curves import distribution, over_time
from analysis.evaluation.page_findings import findings, formula_findings
from analysis.evaluation.page_front import front_curve
from analysis.evaluation.page_maps import maps, plan_map, rest_map, worst_cells
from analysis.evaluation.pictures_curves import over_time_heading
from analysis.evaluation.rest import rest_of, rest_words
from analysis.evaluation.table import answer_tables, eq2_words, footnotes, formulas_table, in_words
from analysis.evaluation.words import chance_columns, formulas_words, headline
from analysis.kit.words import bearing_words, percent, plan_words
from analysis.page.document import KeyFigure, Page, Section
from analysis.page.markup import element, items, join
from analysis.page.parts import (
    findings_section,
    input_name,
    map_settings,
    pictures_section,
    reproduce_section,
    settings_section,
)
from analysis.page.tables import TableData, from_rich, tables_html
from analysis.pictures.style import length_words
from analysis.statistics.control import complete_chance
from analysis.statistics.coverage import losses_shown
from analysis.statistics.estimate import assured
from planner.shown import counted

FILES = ("evaluation.json", "plan.json")


def evaluation_page(
    evaluation: Evaluation, command: str, pictures: Mapping[str, bytes], files: Sequence[str] = FILES
) -> str:
    """The page as HTML. It holds nothing of when or how fast it was made: the same answer gives the same bytes.

    Arguments as of `analysis.page.parts.answer_page`.
    """
    height, width = evaluation.world.shape
    robots = counted(len(evaluation.plan.robots), "robot")
    return Page(
        title=f"{input_name(evaluation.world.source)}, {robots}: how much is covered?",
        answer=headline(evaluation),
        words=in_words(evaluation),
        picture=plan_map(evaluation),
        below=front_curve(evaluation),
        broad=width > 1.6 * height,
        sections=_sections(evaluation, command, pictures, files),
        kind="evaluate",
        figures=key_figures(evaluation),
        warnings=warnings(evaluation),
    ).html()


def _sections(
    evaluation: Evaluation, command: str, pictures: Mapping[str, bytes], files: Sequence[str]
) -> tuple[Section, ...]:
    """In the order in which they are asked for: chances, then why, then how it was found, and notes last."""
    tables = [from_rich(table) for table in answer_tables(evaluation)]
    cells = join((maps(evaluation), tables_html(worst_cells(evaluation))))
    said = [*evaluation.plan.notes, *findings(evaluation), *footnotes(evaluation)]
    return (
        Section("Chances and coverage", tables_html(tables)),
        findings_section(said),
        *_rest(evaluation),
        Section("Coverage over time", over_time(evaluation), over_time_heading(evaluation)[1] + "."),
        Section("Single runs", distribution(evaluation), "How far one run may be from the mean."),
        Section("Cell by cell", cells, _map_lead(evaluation)),
        Section("Robots", tables_html([_robots(evaluation)])),
        *(() if evaluation.certain else (_theory(evaluation),)),
        settings_section(settings(evaluation)),
        pictures_section(pictures, f"{counted(len(pictures), 'picture')} of what is above"),
        reproduce_section(command, files),
        Section("Notes", items(evaluation.world.notes), "How the map was read."),
    )


def _rest(evaluation: Evaluation) -> tuple[Section, ...]:
    """Of robots with a range, and from a state."""
    rest = rest_of(evaluation.world, evaluation.plan)
    if rest is None:
        return ()
    return (Section(rest.title, join((items(rest_words(evaluation, rest)), rest_map(evaluation, rest)))),)


def _theory(evaluation: Evaluation) -> Section:
    title, said = "The paper's formulas", formulas_words(evaluation) + "."
    if not evaluation.settled:
        return Section(title, element("p", said))
    formulas = [from_rich(formulas_table(evaluation))]
    listed = join((tables_html(formulas), element("p", eq2_words(evaluation)), items(formula_findings(evaluation))))
    return Section(title, listed, said, "Every formula, with its verdict")


def key_figures(evaluation: Evaluation) -> tuple[KeyFigure, ...]:
    """The few to take away."""
    tally, cells, robots = evaluation.tally, evaluation.tally.accessible, len(evaluation.plan.robots)
    shown, sure = evaluation.visited.columns(100.0)
    sure += "" if sure == "exact" else " %"
    (lost, certainty), (time, steps) = losses_shown(evaluation.losses, robots), evaluation.time.columns()
    least = assured(tally.visited)
    runs = (
        []
        if least is None
        else [KeyFigure(f"{100 * least / cells:.1f} %", "or more in 95 % of runs", "sure with 95 %")]
    )
    complete, rest = chance_columns(complete_chance(tally, evaluation.certain), tally.rollouts)
    return (
        KeyFigure(f"{shown} %", "visited on average", f"{sure}, of {cells:,} accessible cells"),
        *runs,
        KeyFigure(f"{complete} %", "chance to visit every cell", rest),
        KeyFigure(lost, "robots lost", certainty),
        KeyFigure(f"{time} steps", "mean time", steps),
    )


def warnings(evaluation: Evaluation) -> tuple[str, ...]:
    """What must not be overlooked."""
    cut = ("Interrupted: these are the rollouts that were done until then.",) if evaluation.partial else ()
    return (*cut, *(f"Note: {note}" for note in evaluation.notes))


def settings(evaluation: Evaluation) -> dict[str, object]:
    """Everything that the figures depend on."""
    world, plan, cells = evaluation.world, evaluation.plan, evaluation.cells
    out: dict[str, object] = {
        **map_settings(world),
        "cells": f"{cells['free']:,} free, {cells['accessible']:,} accessible, {cells['dangerous']:,} dangerous",
        "map's SHA-256": element("code", world.sha256[:16] + "..."),
        **({} if world.doubt is None else {"in doubt": world.doubt.said}),
        "robots": f"{len(plan.robots)}",
        "loop": f"{evaluation.loop}" + (f", {evaluation.mode} mode" if evaluation.loop == "open" else ""),
        "rollouts": f"{evaluation.tally.rollouts:,}",
        "seed": f"{evaluation.seed}",
        "engine": evaluation.engine,
    }
    if plan.settings is None:
        out["plan"] = plan.origin
    else:
        out |= {"plan": plan_words(plan)} | plan.settings.shown()
    if not plan.bearing.is_plain:
        out["what p means"] = bearing_words(plan, world)
    out["makespan"] = f"{plan.makespan:,} steps"
    for found in evaluation.outputs.values():
        out |= found.settings()
    return out


def _map_lead(evaluation: Evaluation) -> str:
    rows, cols = evaluation.world.shape
    side = evaluation.world.cell_size
    ground = f"{length_words(cols * side)} by {length_words(rows * side)}"
    return f"{counted(rows, 'row')} and {counted(cols, 'column')}, row 0 at the top: {ground} in cells of {side:g} m."


def _robots(evaluation: Evaluation) -> TableData:
    """A row for each robot; its survival is that of its nominal path."""
    plan, survival = evaluation.plan, evaluation.closed_form.survival
    rows = []
    for number, robot in enumerate(plan.robots):
        row, col = divmod(int(robot.path[0]), plan.shape[1])
        moves = int(np.count_nonzero(np.diff(robot.path)))
        areas = "" if plan.is_foreign else str(sum(leg.kind == "cover" for leg in robot.legs))
        chance = float(survival[number])
        known = "not known" if math.isnan(chance) else percent(chance, 2)
        rows.append((str(number), f"[{row}, {col}]", f"{moves:,}", areas, known))
    columns = ("robot", "start [row, col]", "moves", "areas covered", "survives its nominal path")
    return TableData("Robots of the plan, and the chance that each ends its path", columns, tuple(rows), frozenset({0}))
