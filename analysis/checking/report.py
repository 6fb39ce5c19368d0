"""What `mrac-jax check INPUT` says: which formulas hold on this map, by how much, against what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

from analysis.checking.as_json import check_json
from analysis.checking.check_map import MapCheck
from analysis.kit.tables import make_table
from analysis.report.blocks import CellMaps, KeyFigure, Part, Report
from analysis.report.words import asked, map_words
from analysis.statistics.intervals import ALPHA
from analysis.statistics.words import between
from analysis.theory.formulas import FORMULAS, Direction
from analysis.theory.truth import Truth
from analysis.theory.verdicts import Check, Verdict, badness, overall
from planner.arguments import argument
from planner.shown import counted, percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIGITS = {"cells": 2, "chance": 4, "steps": 0}
"""Decimals of a value in its unit."""
SAYS = {
    Direction.LOWER: "at least",
    Direction.UPPER: "at most",
    Direction.EQUAL: "exactly",
    Direction.EVERY_RUN: "in every run, chance",
}


def report(checked: MapCheck) -> Report:
    """Which formulas hold, one by one; what they speak about cell by cell; on one scale in the picture."""
    said = headline(checked)
    return Report(
        "check", "check", asked(checked.world, len(checked.plan.robots), "which formulas hold?"), said,
        lambda: {"answer": said} | check_json(checked),
        findings=_findings(checked), figures=_key_figures(checked), heading=_heading(checked),
        parts=(
            Part("Every formula", [_table(checked)], _footnotes(checked)),
            Part("Cell by cell", drawn=lambda: [_maps(checked)],
                 lead="The open loop, exact: what the formulas speak about."),
        ),
        warnings=_warnings(checked), settings=_settings(checked), pictures={"check.png": lambda: _picture(checked)},
        faults=checked.faults,
    )  # fmt: skip


def headline(checked: MapCheck) -> str:
    """The answer in one sentence: which of the paper's formulas fail, and whether anything proven does."""
    judged = {key: overall(check for check in checked.checks if check.formula == key) for key in FORMULAS}
    paper = [key for key, verdict in judged.items() if verdict is not None and FORMULAS[key].paper]
    failing = [key for key in paper if judged[key] is Verdict.FAILS]
    fail = "fails" if len(failing) == 1 else "fail"
    said = f"{len(failing)} of the paper's {len(paper)} formulas, every reading counted, {fail} on this map"
    if failing:
        said += f": {'; '.join(FORMULAS[key].title for key in failing)}"
    empty = [key for key in paper if judged[key] is Verdict.VACUOUS]
    if empty:
        said += f". {len(empty)} say nothing" if len(empty) > 1 else ". 1 says nothing"
    unsure = sum(judged[key] is Verdict.UNDECIDED for key in paper)
    if unsure:
        said += f". {unsure} undecided"
    if checked.faults:
        names = sorted({check.about.title for check in checked.faults})
        return f"FAULT: proven, and fails on this map: {'; '.join(names)}. {said}."
    ours = [key for key, verdict in judged.items() if verdict is not None and not FORMULAS[key].paper]
    return f"{said}. Of our {len(ours)} bounds none fails."


def _heading(checked: MapCheck) -> list[str]:
    world, plan, exact = checked.world, checked.plan, checked.exact
    lines = [
        f"{map_words(world, checked.cells, len(plan.robots))}, {counted(plan.shares, 'area')} shared in the run "
        "without losses",
        f"open loop, exact: {exact.visited:.2f} cells visited, {exact.survived:.2f} survived, a robot is left with "
        f"chance {figure(exact.some_left, 'chance')}",
    ]
    closed = checked.closed
    if closed is not None:
        how = "exact" if not closed.rollouts else f"{counted(closed.rollouts, 'rollout')}, seed {checked.seed}"
        rolled = (f"{shown(closed.visited, 'cells')} cells visited", f"{shown(closed.survived, 'cells')} survived")
        lines.append(
            f"closed loop, {how}: {', '.join(rolled)}, a robot is left with chance {shown(closed.some_left, 'chance')}"
        )
    return lines


def figure(value: float, unit: str) -> str:
    """A value in its unit; what is not 0, or not 1, is never rounded to it: "1.0e-17", "> 0.9999"."""
    said = f"{value:.{DIGITS[unit]}f}"
    if value and float(said) == 0:
        return f"{value:.1e}"
    return f"> {1 - 10.0 ** -DIGITS[unit]:.{DIGITS[unit]}f}" if unit == "chance" and value < 1 == float(said) else said


def shown(truth: Truth, unit: str) -> str:
    """A truth, with its interval where the unit's digits show one."""
    value, low, high = (figure(one, unit) for one in (truth.value, truth.low, truth.high))
    return value if low == high else f"{value} ({low} to {high})"


def _rows(checked: MapCheck) -> list[list[Check]]:
    """The checks of each row of the table, of both loops.

    Of the readings and meanings of one statement, the one that holds least, unless all are asked for.
    """
    rows: dict[tuple[str, ...], list[Check]] = {}
    for check in checked.rows:
        rows.setdefault((check.formula, check.meaning), []).append(check)
    if checked.theory == "all":
        return list(rows.values())
    statements: dict[str, list[list[Check]]] = {}
    for checks in rows.values():
        statements.setdefault(checks[0].about.plain, []).append(checks)
    return [min(of, key=lambda checks: min(map(badness, checks))) for of in statements.values()]


def _table(checked: MapCheck) -> Table:
    """A row for each statement, or each formula and meaning; what each loop says of it side by side."""
    words, numbers = ("what", "source", "says", "of"), ("value", "open loop", "closed loop")
    look: dict[str, Any] = {"padding": (0, 1), "pad_edge": False, "collapse_padding": True}
    table = make_table((*words, *numbers), "Formulas against the truth", left=words, **look)
    for checks in _rows(checked):
        about, first = checks[0].about, checks[0]
        cells = {check.loop: f"{figure(check.truth.value, about.unit)} {_word(check)}" for check in checks}
        left = cells.get("open", cells.get("nominal", ""))
        source = about.title if checked.theory == "all" else about.source
        table.add_row(about.plain, source, _says(first), _of(first), figure(first.value, about.unit), left,
                      cells.get("closed", ""))  # fmt: skip
    return table


def _says(check: Check) -> str:
    return {"lower bound": ">=", "upper bound": "<=", "equality": "=", "in every run": "every"}[check.about.direction]


def _of(check: Check) -> str:
    """What it is about."""
    if check.robot is not None:
        return f"{check.meaning or 'alive'}, R{check.robot}"
    if check.formula == "theorem2":
        return "runs"
    return check.meaning or {"chance": "a robot left", "steps": "steps"}.get(check.about.unit, "cells")


def _word(check: Check) -> str:
    """The verdict; failures stand out."""
    return f"{str(check.verdict).upper() if check.verdict is Verdict.FAILS else check.verdict:9}"


def _footnotes(checked: MapCheck) -> list[str]:
    lines = [
        "ours: proven. >=: the truth is at least the value; vacuous: the formula says nothing that is not plain "
        "without it. R0, R1, ...: one robot, the one for which it holds least. Bounds in cells are on the average: a "
        "single run may cover more than a bound."
    ]
    if (hidden := len({(c.formula, c.meaning) for c in checked.rows}) - len(_rows(checked))) > 0:
        lines.append(
            f"Of a formula with several readings or meanings, the one that holds least; {hidden} more "
            f"with {argument('theory', 'all')}."
        )
    if checked.closed is not None and checked.closed.rollouts:
        lines.append(
            f"The closed loop's intervals hold together with {100 * (1 - ALPHA):g} % confidence; undecided: the value "
            f"is in one; more {argument('rollouts')} may tell."
        )
    elif any(check.verdict is Verdict.UNDECIDED for check in checked.rows):
        lines.append("The closed loop is exact but for the least likely histories; undecided: it depends on them.")
    return lines


def _key_figures(checked: MapCheck) -> tuple[KeyFigure, ...]:
    cells, exact, closed, rows = checked.cells, checked.exact, checked.closed, checked.rows
    out = [KeyFigure(percent(exact.visited / cells, 2), "visited, open loop", "exact")]
    if closed is not None:
        seen = closed.visited
        how = f"{between(100 * seen.low / cells, 100 * seen.high / cells)} %" if closed.rollouts else "exact"
        out.append(KeyFigure(percent(seen.value / cells, 2), "visited, closed loop", how))
    for verdict, words in ((Verdict.FAILS, "comparisons fail"), (Verdict.HOLDS, "hold")):
        number = sum(check.verdict is verdict for check in rows)
        out.append(KeyFigure(f"{number}", words, f"of {len(rows)}: each formula, meaning and loop"))
    return tuple(out)


def _warnings(checked: MapCheck) -> tuple[str, ...]:
    cut = ("Interrupted: the closed loop's figures are of the rollouts that were done.",) if checked.partial else ()
    if checked.faults:
        return (*cut, "A formula that is marked as proven fails: a fault of a proof or of this program.")
    return cut


def _findings(checked: MapCheck) -> list[str]:
    out = []
    for check in (check for checks in _rows(checked) for check in checks):
        if check.verdict is Verdict.FAILS:
            unit = "" if check.about.unit == "chance" else f" {check.about.unit}"
            said = f"{SAYS[check.about.direction]} {check.value:.4g}{unit}"
            out.append(f"{check.named} fails: it says {said}, the truth is {shown(check.truth, check.about.unit)}.")
    return [*out, *(f"{note[0].upper()}{note[1:]}." for note in checked.left_out)]


def _maps(checked: MapCheck) -> CellMaps:
    from analysis.page.plan_layers import chance_layers

    world, plan, exact = checked.world, checked.plan, checked.exact
    layers = chance_layers(world, plan, exact.visited_by_cell, exact.stops_by_cell, "open loop, exact")
    return CellMaps(world, plan.starts, layers)


def _picture(checked: MapCheck) -> Figure:
    from analysis.checking.picture import check_figure

    return check_figure(checked)


def _settings(checked: MapCheck) -> dict[str, object]:
    plan, closed = checked.plan, checked.closed
    out: dict[str, object] = {"seed": f"{checked.seed}"}
    if closed is not None and closed.rollouts:
        out["chance that one interval misses"] = f"{checked.doubt:.3g}"
    return out | ({} if plan.settings is None else plan.settings.shown(checked.world.pace))
