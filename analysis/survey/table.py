"""What `mrac-jax check --worlds N` says: the answer in a sentence, a table, the JSON object, the folder of `--out`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rich.console import Console
from rich.table import Table

from analysis.kit.tables import make_table, print_lines
from analysis.statistics.intervals import ALPHA
from analysis.survey.survey import Row, Survey
from analysis.theory.formulas import FORMULAS
from analysis.theory.verdicts import Verdict

COLUMNS = (
    "seed", "robots", "formula", "meaning", "loop", "robot", "value", "truth", "low", "high", "verdict", "margin",
)  # fmt: skip


def headline(survey: Survey) -> str:
    """The answer in one sentence: which of the paper's formulas fail somewhere, and whether anything proven does."""
    rows = survey.rows()
    failing: dict[str, Row] = {}
    for row in rows:
        if row.verdicts[Verdict.FAILS] and row.check.about.paper:
            held = failing.get(row.check.formula)
            if held is None or row.fails.mean > held.fails.mean:
                failing[row.check.formula] = row
    paper = {row.check.formula for row in rows if row.check.about.paper}
    worlds = f"{survey.worlds:,} {survey.choices.kind} worlds"
    said = f"{len(failing)} of the paper's {len(paper)} formulas, every reading counted, fail on some of {worlds}"
    if failing:
        parts = [
            f"{FORMULAS[key].title} on up to {100 * failing[key].fails.mean:.1f} % (k = {failing[key].robots})"
            for key in FORMULAS
            if key in failing
        ]
        said += f": {'; '.join(parts)}"
    if survey.faults:
        seed, robots, check = survey.faults[0]
        more = f", {len(survey.faults)} failures in all" if len(survey.faults) > 1 else ""
        return (
            f"FAULT: {check.about.title} is proven, and fails on the world of seed {seed} (k = {robots}){more}. {said}."
        )
    return f"{said}. Of our bounds none fails."


def print_survey(survey: Survey, console: Console) -> None:
    """Print the answer, what was surveyed, and a row for each formula, meaning, loop and size of team."""
    choices = survey.choices
    seeds = (survey.rollouts.seed, survey.rollouts.seed + choices.worlds - 1)
    lines = [
        headline(survey),
        f"{choices.height} x {choices.width} cells, seeds {seeds[0]} to {seeds[1]}; closed loop: "
        f"{survey.rollouts.rollouts:,} rollouts a world and team; {survey.seconds:.0f} s"
        + (f"; interrupted after {survey.worlds:,} worlds" if survey.partial else ""),
    ]
    print_lines(console, lines)
    for title, cell in TABLES.items():
        console.print(_table(survey, title, cell))
    print_lines(console, tuple(_footnotes(survey)))


def _table(survey: Survey, title: str, cell: Callable[[Row], str]) -> Table:
    """A row for each formula, meaning and loop, a column for each size of team."""
    teams = survey.choices.teams
    names = ("formula", "of", *(f"k = {k}" for k in teams))
    table = make_table(names, title, left=("formula", "of"), padding=(0, 1, 0, 0))
    for name, of, cells in _rows(survey, cell):
        table.add_row(name, of, *cells)
    return table


def _rows(survey: Survey, cell: Callable[[Row], str]) -> Iterator[tuple[str, str, list[str]]]:
    """(formula, meaning and loop, a cell for each size of team)."""
    by_key: dict[str, dict[int, Row]] = {}
    for row in survey.rows():
        by_key.setdefault(row.check.key, {})[row.robots] = row
    for found in by_key.values():
        first = next(iter(found.values())).check
        about = FORMULAS[first.formula]
        of = f"{first.meaning}, {first.loop}" if first.meaning else first.loop
        cells = [cell(found[k]) if k in found else "" for k in survey.choices.teams]
        yield about.title + ("" if about.paper else " *"), of, cells


def markdown(survey: Survey) -> str:
    """The tables for a page: a row for each formula, meaning and loop, a column for each size of team."""
    teams = survey.choices.teams
    lines = []
    for title, cell in TABLES.items():
        lines += [f"**{title}**", "", "| formula | of | " + " | ".join(f"k = {k}" for k in teams) + " |"]
        lines += ["|---|---|" + "---:|" * len(teams)]
        for name, of, cells in _rows(survey, cell):
            lines.append(f"| {name.replace('*', chr(92) + '*')} | {of} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += [line.replace("*", chr(92) + "*", 1) for line in _footnotes(survey)]
    return "\n".join(lines) + "\n"


def _shares(row: Row) -> str:
    """ "79.2/4.2"; "-" where neither happens, "?" after it where a world is undecided."""
    fails, vacuous = (100 * row.verdicts[verdict] / row.worlds for verdict in (Verdict.FAILS, Verdict.VACUOUS))
    shown = f"{fails:.3g}/{vacuous:.3g}" if fails or vacuous else "-"
    return shown + ("?" if row.verdicts[Verdict.UNDECIDED] else "")


def _tightness(row: Row) -> str:
    return "" if row.tightness is None else f"{row.tightness:.2f}" if row.tightness < 100 else "> 100"


def _margin(row: Row) -> str:
    least = {"chance": 1e-3, "cells": 0.01, "steps": 0.5}[row.check.about.unit]
    return f"{row.check.margin if abs(row.check.margin) >= least else 0:.3g}"


TABLES: dict[str, Callable[[Row], str]] = {
    "Fails / vacuous, % of worlds": _shares,
    "Median value / truth": _tightness,
    "Worst margin; below 0: fails by that much": _margin,
}
"""Title of each table, and what stands in its cells."""


def _footnotes(survey: Survey) -> list[str]:
    return [
        "* ours, proven. Margins are in cells, steps or chance. ?: undecided on some worlds. Empty: undefined (eq. 5: "
        "plans that share areas).",
        "Sampled truths (closed loop, k > 1): a failure counts only beyond an interval that misses the truth with "
        f"chance {ALPHA:g} / {survey.choices.figures:,}, so all counted failures hold together with "
        f"{100 * (1 - ALPHA):g} % confidence.",
    ]
