"""What `mrac-jax check INPUT` says: the answer in a sentence, the table of formulas, the JSON object, the folder."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from analysis.checking.check_map import MapCheck
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import counted
from analysis.statistics.intervals import ALPHA
from analysis.theory.formulas import FORMULAS
from analysis.theory.truth import Truth
from analysis.theory.verdicts import Check, Verdict, overall

DIGITS = {"cells": 2, "chance": 4, "steps": 0}
"""Decimals of a value in its unit."""


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


def print_check(checked: MapCheck, console: Console) -> None:
    """Print the answer, what was checked, the truth, and every formula."""
    print_lines(console, (headline(checked), *_heading(checked)))
    console.print(_table(checked))
    print_lines(console, _footnotes(checked))


def _heading(checked: MapCheck) -> list[str]:
    world, plan, exact = checked.world, checked.plan, checked.exact
    cells = int(world.accessible(plan.starts).sum())
    robots = counted(len(plan.robots), "robot")
    lines = [
        f"{world.source}: {world.shape[0]} x {world.shape[1]} cells, {cells} accessible; {robots}, {plan.shares} areas "
        "shared in the run without losses",
        f"open loop, exact: {exact.visited:.2f} cells visited, {exact.survived:.2f} survived, a robot is left with "
        f"chance {1 - exact.alive_chance[0]:.4f}",
    ]
    closed = checked.closed
    if closed is not None:
        how = closed.visited.how if not closed.rollouts else f"{closed.rollouts:,} rollouts, seed {checked.seed}"
        rolled = (f"{shown(closed.visited, 2)} cells visited", f"{shown(closed.survived, 2)} survived")
        lines.append(
            f"closed loop, {how}: {', '.join(rolled)}, a robot is left with chance {shown(closed.some_left, 4)}"
        )
    return lines


def shown(truth: Truth, digits: int) -> str:
    """A truth, with its interval where it has one."""
    if truth.high - truth.low < 10.0 ** -(digits + 2):
        return f"{truth.value:.{digits}f}"
    return f"{truth.value:.{digits}f} ({truth.low:.{digits}f} to {truth.high:.{digits}f})"


def _table(checked: MapCheck) -> Table:
    """A row for each formula and meaning; what each loop says of it side by side."""
    words, numbers = ("formula", "says", "of"), ("value", "open loop", "closed loop")
    look: dict[str, Any] = {"padding": (0, 1), "pad_edge": False, "collapse_padding": True}
    table = make_table((*words, *numbers), "Formulas against the truth", left=words, **look)
    rows: dict[tuple[str, str], list[Check]] = {}
    for check in checked.rows:
        rows.setdefault((check.formula, check.meaning), []).append(check)
    for (formula, _), checks in rows.items():
        about, first = FORMULAS[formula], checks[0]
        digits = DIGITS[about.unit]
        cells = {check.loop: f"{check.truth.value:.{digits}f} {_word(check)}" for check in checks}
        left = cells.get("open", cells.get("nominal", ""))
        title = about.title + ("" if about.paper else " *")
        table.add_row(title, _says(first), _of(first), f"{first.value:.{digits}f}", left, cells.get("closed", ""))
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
        "* ours, proven. >=: the truth is at least the value; vacuous: the formula says nothing that is not plain "
        "without it. R0, R1, ...: one robot, the one for which it holds least. Cells are those of the average: a "
        "single run may cover more than a bound."
    ]
    if checked.closed is not None and checked.closed.rollouts:
        lines.append(
            f"The closed loop's intervals hold together with {100 * (1 - ALPHA):g} % confidence; undecided: the value "
            "is in one; more --rollouts may tell."
        )
    lines += [f"note: {note}" for note in checked.left_out]
    return lines + (["interrupted: the rollouts that were done"] if checked.partial else [])
