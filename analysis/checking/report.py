"""The reports of `mrac-jax check`: the formulas that hold on this map, or on many worlds, with values and truths."""

from __future__ import annotations

from collections.abc import Callable, Sized
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from rich.table import Table

from analysis.checking.check import (
    MapCheck,
    Row,
    Survey,
    bound_charts,
    coverage,
    failing,
    survey_starts,
    survey_world,
)
from analysis.page.elements import Chart, Series
from analysis.report.model import CellMaps, KeyFigure, Report, Section
from analysis.report.result import asked, map_text
from analysis.statistics.estimates import ALPHA, between
from analysis.theory.verdicts import FORMULAS, Check, Direction, Truth, Verdict, badness, overall
from analysis.utils.tables import Column, csv_text, table_of
from planner.arguments import argument
from planner.formatting import counted, in_percent, percent

DIGITS = {"cells": 2, "chance": 4, "steps": 0}
"""Decimals of a value in its unit."""
SAYS = {
    Direction.LOWER: ("at least", ">="),
    Direction.UPPER: ("at most", "<="),
    Direction.EQUAL: ("exactly", "="),
    Direction.EVERY_RUN: ("in every run, chance", "every"),
}
"""Relation of the truth to a value, in a sentence and in a table."""


WORDS = {verdict: f"{verdict.upper() if verdict is Verdict.FAILS else verdict:9}" for verdict in Verdict}
"""Verdicts in a table; failures in capitals."""
UNCERTAIN = {Verdict.VACUOUS: "say nothing", Verdict.UNDECIDED: "are undecided"}
"""What else the summary counts."""


def check_report(checked: MapCheck) -> Report:
    """The report of one map: all formulas in a table, their subject cell by cell, one scale in the picture."""
    return Report(
        "check", "check", asked(checked.world, len(checked.plan.robots), "which formulas hold?"),
        check_summary(checked), checked,
        findings=_check_findings(checked), figures=_check_key_figures(checked), heading=_check_heading(checked),
        parts=(
            Section("Every formula", [_check_table(checked)], _check_footnotes(checked)),
            Section("Cell by cell", figures=lambda: [_maps(checked)],
                 intro="The open loop, exact: the subject of the formulas."),
        ),
        warnings=_warnings(checked), settings=_settings(checked), faults=checked.faults,
        pictures={"check.png": lambda: [_formula_chart(checked)]},
    )  # fmt: skip


def check_summary(checked: MapCheck) -> str:
    """The summary: the paper's formulas that fail, and whether a proven one fails."""
    found = {key: overall(check for check in checked.checks if check.formula == key) for key in FORMULAS}
    paper, ours = (
        {key: verdict for key, verdict in found.items() if verdict and FORMULAS[key].paper is is_paper}
        for is_paper in (True, False)
    )
    failing = [FORMULAS[key].title for key, verdict in paper.items() if verdict is Verdict.FAILS]
    counts = {word: list(paper.values()).count(verdict) for verdict, word in UNCERTAIN.items()}
    said = "".join(f", {number} {word}" for word, number in counts.items() if number)
    formulas = (
        f"{len(failing)} of the paper's {len(paper)} formulas, counting all readings, {_fail(failing)} on this map"
    )
    return _with_faults(f"{formulas}{said}", failing, len(ours), [check.about.title for check in checked.faults])


def _fail(failing: Sized) -> str:
    return "fails" if len(failing) == 1 else "fail"


def _with_faults(said: str, failing: list[str], ours: int, faults: list[str]) -> str:
    """The summary with the names of the paper's formulas that fail, after the proven ones that do."""
    fault = f"FAULT: proven, but fails: {'; '.join(sorted(set(faults)))}. " if faults else ""
    return f"{fault}{said}{': ' * bool(failing)}{'; '.join(failing)}. Of our {ours} bounds, {len(set(faults))} fail."


def _check_heading(checked: MapCheck) -> list[str]:
    world, plan, exact = checked.world, checked.plan, checked.exact
    lines = [
        f"{map_text(world, checked.cells, len(plan.robots))}, {counted(plan.shares, 'area')} shared in the run "
        "without losses",
        f"open loop, exact: {exact.visited:.2f} cells visited, {exact.survived:.2f} survived, a robot survives with "
        f"chance {figure(exact.some_left, 'chance')}",
    ]
    closed = checked.closed
    if closed is not None:
        how = "exact" if not closed.rollouts else f"{counted(closed.rollouts, 'rollout')}, seed {checked.seed}"
        rolled = (
            f"{format_truth(closed.visited, 'cells')} cells visited",
            f"{format_truth(closed.survived, 'cells')} survived",
        )
        lines.append(
            f"closed loop, {how}: {', '.join(rolled)}, a robot survives with chance "
            f"{format_truth(closed.some_left, 'chance')}"
        )
    return lines


def figure(value: float, unit: str) -> str:
    """A value in its unit; a value near 0 or 1 is not rounded to it: "1.0e-17", "> 0.9999"."""
    said = f"{value:.{DIGITS[unit]}f}"
    if value and float(said) == 0:
        return f"{value:.1e}"
    return f"> {1 - 10.0 ** -DIGITS[unit]:.{DIGITS[unit]}f}" if unit == "chance" and value < 1 == float(said) else said


def format_truth(truth: Truth, unit: str) -> str:
    """A truth, with its interval if the unit's digits show one."""
    value, low, high = (figure(one, unit) for one in (truth.value, truth.low, truth.high))
    return value if low == high else f"{value} ({low} to {high})"


def _check_rows(checked: MapCheck) -> list[list[Check]]:
    """The checks of each row of the table, of both loops.

    By default one reading and meaning of each statement, the one that holds least.
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


def _check_table(checked: MapCheck) -> Table:
    """A row for each statement, or each formula and meaning, with the verdicts of both loops."""
    look: dict[str, Any] = {"padding": (0, 1), "pad_edge": False, "collapse_padding": True}

    def truth(*loops: str) -> Callable[[list[Check]], str | None]:
        def text(checks: list[Check]) -> str | None:
            found = (f"{figure(c.truth.value, c.about.unit)} {WORDS[c.verdict]}" for c in checks if c.loop in loops)
            return next(found, None)

        return text

    columns = (
        Column("statement", lambda checks: checks[0].about.plain, words=True),
        Column("source", lambda checks: checks[0].about.title if checked.theory == "all" else checks[0].about.source,
               words=True),
        Column("says", lambda checks: SAYS[checks[0].about.direction][1], words=True),
        Column("of", lambda checks: _of(checks[0]), words=True),
        Column("value", lambda checks: figure(checks[0].value, checks[0].about.unit)),
        Column("open loop", truth("open", "nominal")),
        Column("closed loop", truth("closed")),
    )  # fmt: skip
    return table_of(columns, _check_rows(checked), "Formulas against the truth", **look)


def _of(check: Check) -> str:
    """The subject of the check."""
    if check.robot is not None:
        return f"{check.meaning or 'alive'}, R{check.robot}"
    if check.formula == "theorem2":
        return "runs"
    return check.meaning or {"chance": "survival", "steps": "steps"}.get(check.about.unit, "cells")


def _check_footnotes(checked: MapCheck) -> list[str]:
    lines = [
        "ours: proven. >=: the truth is at least the value; vacuous: the formula says no more than the trivial limits. "
        "R0, R1, ...: one robot, the one for which it holds least. Bounds in cells are on the average: a "
        "single run may cover more than a bound."
    ]
    if (hidden := len({(c.formula, c.meaning) for c in checked.rows}) - len(_check_rows(checked))) > 0:
        lines.append(
            f"For a formula with several readings or meanings, the one that holds least is shown; {hidden} more "
            f"with {argument('theory', 'all')}."
        )
    if checked.closed is not None and checked.closed.rollouts:
        lines.append(
            f"The closed loop's intervals hold simultaneously with {100 * (1 - ALPHA):g} % confidence; undecided: the "
            f"interval contains the value; more {argument('rollouts')} may decide."
        )
    elif any(check.verdict is Verdict.UNDECIDED for check in checked.rows):
        lines.append("The closed loop is exact except for the least likely histories; undecided: these decide.")
    return lines


def _check_key_figures(checked: MapCheck) -> tuple[KeyFigure, ...]:
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
    cut = ("Interrupted: the closed loop's figures are from the rollouts done so far.",) if checked.partial else ()
    if checked.faults:
        return (*cut, "A proven formula fails: an error of the proof or of this program.")
    return cut


def _check_findings(checked: MapCheck) -> list[str]:
    out = []
    for check in (check for checks in _check_rows(checked) for check in checks):
        if check.verdict is Verdict.FAILS:
            unit = "" if check.about.unit == "chance" else f" {check.about.unit}"
            said = f"{SAYS[check.about.direction][0]} {check.value:.4g}{unit}"
            out.append(
                f"{check.named} fails: it says {said}, the truth is {format_truth(check.truth, check.about.unit)}."
            )
    return [*out, *(f"{note[0].upper()}{note[1:]}." for note in checked.left_out)]


def _maps(checked: MapCheck) -> CellMaps:
    from analysis.page.maps import chance_layers

    world, plan, exact = checked.world, checked.plan, checked.exact
    layers = chance_layers(world, plan, exact.visited_by_cell, exact.stops_by_cell, "open loop, exact")
    return CellMaps(world, plan.starts, layers)


def _formula_chart(checked: MapCheck) -> Chart:
    """The formulas in cells on one scale, marked by their verdicts, and the truths of both loops as lines."""
    checks = [c for c in checked.rows if c.about.unit == "cells" and c.meaning == "visited" and c.robot is None]
    marked = {True: "", False: " *"}
    names = {c.formula: f"{SAYS[c.about.direction][1]} {c.about.title}{marked[c.about.paper]}" for c in checks[::-1]}
    row, cells, truths = {formula: place for place, formula in enumerate(names)}, checked.cells, checked.exact.visited
    lines = [(0.0, "none"), (float(cells), "every cell"), (truths, "open loop, exact")]
    if (closed := checked.closed) is not None:
        lines.append((closed.visited.value, f"closed loop, {'sampled' if closed.rollouts else 'exact'}"))
    series = []
    for colour, verdict in zip((None, 5, 0, 3), Verdict, strict=True):
        shown = [c for c in checks if c.verdict is verdict]
        # Values far outside 0 .. cells would compress the scale.
        at = np.clip([c.value for c in shown], -0.35 * cells, 1.35 * cells)
        rows = [row[c.formula] + {"open": 0.17, "closed": -0.17}.get(c.loop, 0.0) for c in shown]
        series.append(Series(verdict, at, rows, kind="points", colour=colour))
    failing = {c.formula for c in checked.checks if c.verdict is Verdict.FAILS and c.about.paper}
    title = f"{counted(len(failing), 'formula')} of the paper fail{'s' * (len(failing) == 1)} on this map"
    below = f"{counted(len(checked.plan.robots), 'robot')}; upper mark: against the open loop, lower: the closed loop"
    return Chart(
        title, tuple(series), "expected cells visited (marks at the edge: farther out)", f"{below}; * ours, proven",
        at_x=tuple(lines), y_words=tuple(names.values()),
    )  # fmt: skip


def _settings(checked: MapCheck) -> dict[str, object]:
    plan, closed = checked.plan, checked.closed
    out: dict[str, object] = {"seed": f"{checked.seed}"}
    if closed is not None and closed.rollouts:
        out["error probability of one interval"] = f"{checked.alpha:.3g}"
    return out | ({} if plan.settings is None else plan.settings.described(checked.world.pace))


# The report of `mrac-jax check --worlds N`: formulas that fail on random worlds, and how often, by size of team.

COLUMNS = (
    "seed", "robots", "formula", "meaning", "loop", "robot", "value", "truth", "low", "high", "verdict", "margin",
)  # fmt: skip


def survey_report(survey: Survey) -> Report:
    """The report of a survey: rates of failure; coverage and its bounds by size of team; all comparisons as CSV."""
    return Report(
        "survey", "check --worlds", f"{survey.description}: which formulas hold?", survey_summary(survey),
        survey,
        findings=_survey_findings(survey), figures=_survey_key_figures(survey), heading=_survey_heading(survey),
        parts=(
            Section("By size of the team", figures=lambda: _charts(survey)),
            Section("Every formula", [_survey_table(survey, *one) for one in TABLES.items()],
                    _survey_footnotes(survey)),
        ),
        warnings=(f"Interrupted after {counted(survey.worlds, 'world')}.",) if survey.partial else (),
        settings=survey.choices.settings.described(), took=[f"{survey.seconds:.0f} s"],
        again="World number i has the seed of the first plus i. The number of processes does not change the result.",
        pictures={"bound_against_truth.png": partial(bound_charts, survey),
                  "over_robots.png": partial(_charts, survey)},
        files={"survey.csv": lambda: _csv(survey), **_worst(survey)},
        faults=survey.faults,
    )  # fmt: skip


def survey_summary(survey: Survey) -> str:
    """The summary: the paper's formulas that fail on some world, and whether a proven one fails."""
    paper, ours = survey.formulas
    worlds = counted(survey.worlds, f"{survey.choices.kind} world")
    said = (
        f"{len(survey.failing)} of the paper's {len(paper)} formulas, counting all readings, "
        f"{_fail(survey.failing)} on some of {worlds}"
    )
    failing = [
        f"{FORMULAS[key].title} on up to {percent(row.fails.mean)} (k = {row.robots})"
        for key, row in survey.failing.items()
    ]
    faults = [f"{one.check.about.title} (seed {one.seed}, k = {one.robots})" for one in survey.faults]
    return _with_faults(said, failing, len(ours), faults)


def _survey_heading(survey: Survey) -> list[str]:
    choices, first = survey.choices, survey.rollouts.seed
    return [
        f"{survey.description}, "
        f"{', '.join(map(str, choices.teams))} robots, seeds {first} to {first + choices.worlds - 1}; closed loop: "
        f"{counted(survey.rollouts.rollouts, 'rollout')} a world and team"
    ]


def _survey_table(survey: Survey, title: str, cell: Callable[[Row], str]) -> Table:
    """A row for each formula, meaning and loop, a column for each size of team."""

    def team(k: int) -> Column:
        return Column(f"k = {k}", lambda rows: next((cell(row) for row in rows if row.robots == k), ""))

    columns = (
        Column("formula", lambda rows: rows[0].check.about.title + " *" * (not rows[0].check.about.paper), words=True),
        Column("of", lambda rows: ", ".join(filter(None, (rows[0].check.meaning, rows[0].check.loop))), words=True),
        *map(team, survey.choices.teams),
    )
    return table_of(columns, survey.by_key, title, padding=(0, 1, 0, 0))


def _shares(row: Row) -> str:
    """ "79.2/4.2"; "-" if both are 0, with "?" if a world is undecided."""
    counts = [row.verdicts[verdict] for verdict in (Verdict.FAILS, Verdict.VACUOUS)]
    shown = "/".join(in_percent(Fraction(count, row.worlds)) for count in counts) if any(counts) else "-"
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
"""Title of each table, and the function of its cells."""


def _survey_footnotes(survey: Survey) -> list[str]:
    return [
        "* ours, proven. Margins: cells, steps or probability. ?: undecided on some worlds. Empty: undefined (eq. 5: "
        "plans that share areas).",
        "Sampled truths (closed loop, k > 1): a failure counts only outside an interval that misses the truth with "
        f"chance {ALPHA:g} / {survey.choices.figures:,}, so that all counted failures hold simultaneously with "
        f"{100 * (1 - ALPHA):g} % confidence.",
    ]


def _survey_key_figures(survey: Survey) -> tuple[KeyFigure, ...]:
    rows, failing, (paper, ours) = survey.rows, survey.failing, survey.formulas
    return (
        KeyFigure(f"{len(failing)} of {len(paper)}", "of the paper's formulas fail somewhere", "counting all readings"),
        KeyFigure(f"{len({one.check.formula for one in survey.faults})}", "proven formulas fail",
                  f"ours: {len(ours)} bounds"),
        KeyFigure(f"{sum(row.worlds for row in rows):,}", "comparisons", f"on {counted(survey.worlds, 'world')}"),
    )  # fmt: skip


def _survey_findings(survey: Survey) -> list[str]:
    worst: dict[str, tuple[str, Row]] = {}
    for key, row in survey.worst_failures().items():
        held = worst.get(row.check.formula)
        if held is None or row.check.margin < held[1].check.margin:
            worst[row.check.formula] = (key, row)
    out = []
    for key, row in worst.values():
        check = row.check
        digits, unit = (4, "") if check.about.unit == "chance" else (1, f" {check.about.unit}")
        out.append(
            f"{check.named}: worst on the world of seed {row.seed} with {counted(row.robots, 'robot')}, where it "
            f"says {check.value:.{digits}f} and the truth is {check.truth.value:.{digits}f}{unit} ({_file(key)})."
        )
    return out or ["Nothing fails on any of these worlds."]


def _csv(survey: Survey) -> str:
    """All comparisons, one a line."""
    rows = []
    for entry in survey.entries:
        for check in entry.checks:
            truth = check.truth
            named = (check.formula, check.meaning, check.loop, "" if check.robot is None else check.robot)
            values = (f"{value:.9g}" for value in (check.value, truth.value, truth.low, truth.high))
            rows.append((entry.seed, entry.robots, *named, *values, check.verdict, f"{check.margin:.9g}"))
    return csv_text(COLUMNS, rows)


def _charts(survey: Survey) -> tuple[Chart, Chart]:
    return failing(survey), coverage(survey)


def _worst(survey: Survey) -> dict[str, Callable[[], bytes]]:
    """The worst world of every formula that fails, as world files with the starts."""
    failures = survey.worst_failures().items()
    return {_file(key): partial(_world_file, survey, row) for key, row in failures}


def _file(key: str) -> str:
    return f"worst/{key.replace('/', '-')}.npz"


def _world_file(survey: Survey, row: Row) -> bytes:
    world = survey_world(survey.choices, row.seed)
    return world.with_starts(survey_starts(world, row.robots)).to_bytes()
