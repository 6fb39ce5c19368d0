"""What `mrac-jax check --worlds N` says: which formulas fail on random worlds, how often, over the size of the team."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING

from rich.table import Table

from analysis.checking.as_json import check_head, check_row
from analysis.kit.folder import csv_text
from analysis.kit.tables import make_table
from analysis.page.series import Chart
from analysis.report.answer import json_end
from analysis.report.blocks import KeyFigure, Part, Report
from analysis.statistics.intervals import ALPHA
from analysis.survey.survey import Row, Survey, survey_starts, survey_world
from analysis.theory.formulas import FORMULAS
from analysis.theory.verdicts import Verdict
from planner.files import Json
from planner.shown import counted, in_percent, percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = (
    "seed", "robots", "formula", "meaning", "loop", "robot", "value", "truth", "low", "high", "verdict", "margin",
)  # fmt: skip


def report(survey: Survey) -> Report:
    """How often each formula fails; coverage and what bounds it over the size of the team; every comparison as CSV."""
    said = headline(survey)
    return Report(
        "survey", "check --worlds", f"{survey.said}: which formulas hold?", said,
        lambda: _json(survey, said),
        findings=_findings(survey), figures=_key_figures(survey), heading=_heading(survey),
        parts=(
            Part("Over the size of the team", drawn=lambda: _charts(survey)),
            Part("Every formula", [_table(survey, *one) for one in TABLES.items()], _footnotes(survey), unfolded=True),
        ),
        warnings=(f"Interrupted after {counted(survey.worlds, 'world')}.",) if survey.partial else (),
        settings=survey.choices.settings.shown(), took=[f"{survey.seconds:.0f} s"],
        again="World number i has the seed of the first plus i: the number of processes changes nothing.",
        pictures={"bound_against_truth.png": partial(_scatter, survey), "over_robots.png": partial(_charts, survey)},
        files={"survey.csv": lambda: _csv(survey), **_worst(survey)},
        faults=survey.faults,
    )  # fmt: skip


def headline(survey: Survey) -> str:
    """The answer in one sentence: which of the paper's formulas fail somewhere, and whether anything proven does."""
    paper = {row.check.formula for row in survey.rows if row.check.about.paper}
    worlds = counted(survey.worlds, f"{survey.choices.kind} world")
    said = (
        f"{len(survey.failing)} of the paper's {len(paper)} formulas, every reading counted, fail on some of {worlds}"
    )
    parts = [
        f"{FORMULAS[key].title} on up to {percent(row.fails.mean)} (k = {row.robots})"
        for key, row in survey.failing.items()
    ]
    said += f": {'; '.join(parts)}" if parts else ""
    if survey.faults:
        seed, robots, check = survey.faults[0]
        more = f", {len(survey.faults)} failures in all" if len(survey.faults) > 1 else ""
        return (
            f"FAULT: {check.about.title} is proven, and fails on the world of seed {seed} (k = {robots}){more}. {said}."
        )
    return f"{said}. Of our bounds none fails."


def _heading(survey: Survey) -> list[str]:
    choices, first = survey.choices, survey.rollouts.seed
    return [
        f"{survey.said}, "
        f"{', '.join(map(str, choices.teams))} robots, seeds {first} to {first + choices.worlds - 1}; closed loop: "
        f"{counted(survey.rollouts.rollouts, 'rollout')} a world and team"
    ]


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
    for row in survey.rows:
        by_key.setdefault(row.check.key, {})[row.robots] = row
    for found in by_key.values():
        first = next(iter(found.values())).check
        about = FORMULAS[first.formula]
        of = f"{first.meaning}, {first.loop}" if first.meaning else first.loop
        cells = [cell(found[k]) if k in found else "" for k in survey.choices.teams]
        yield about.title + ("" if about.paper else " *"), of, cells


def _shares(row: Row) -> str:
    """ "79.2/4.2"; "-" where neither happens, "?" after it where a world is undecided."""
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
"""Title of each table, and what stands in its cells."""


def _footnotes(survey: Survey) -> list[str]:
    return [
        "* ours, proven. Margins are in cells, steps or chance. ?: undecided on some worlds. Empty: undefined (eq. 5: "
        "plans that share areas).",
        "Sampled truths (closed loop, k > 1): a failure counts only beyond an interval that misses the truth with "
        f"chance {ALPHA:g} / {survey.choices.figures:,}, so all counted failures hold together with "
        f"{100 * (1 - ALPHA):g} % confidence.",
    ]


def _key_figures(survey: Survey) -> tuple[KeyFigure, ...]:
    rows, failing = survey.rows, survey.failing
    paper, ours = ({row.check.formula for row in rows if row.check.about.paper is of} for of in (True, False))
    return (
        KeyFigure(f"{len(failing)} of {len(paper)}", "of the paper's formulas fail somewhere", "every reading counted"),
        KeyFigure(f"{len({check.formula for _, _, check in survey.faults})}", "of what is proven fails",
                  f"ours: {len(ours)} bounds"),
        KeyFigure(f"{sum(row.worlds for row in rows):,}", "comparisons", f"on {counted(survey.worlds, 'world')}"),
    )  # fmt: skip


def _findings(survey: Survey) -> list[str]:
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


def _json(survey: Survey, said: str) -> Json:
    choices = survey.choices
    return {
        "answer": said,
        "worlds": survey.worlds,
        "kind": choices.kind,
        "size": [choices.height, choices.width],
        "robots": list(choices.teams),
        "seed": survey.rollouts.seed,
        "rollouts": survey.rollouts.rollouts,
        "doubt": ALPHA / choices.figures,
        "rows": [_row_json(row) for row in survey.rows],
        "worst": {key: {"seed": row.seed, "robots": row.robots} for key, row in survey.worst_failures().items()},
        "faults": [{"seed": seed, "robots": robots, **check_row(check)} for seed, robots, check in survey.faults],
        "seconds": survey.seconds,
        **json_end(survey),
    }


def _row_json(row: Row) -> Json:
    return check_head(row.check) | {
        "robots": row.robots,
        "worlds": row.worlds,
        **{str(verdict): count for verdict, count in row.verdicts.items()},
        "fails_fraction": {"mean": row.fails.mean, "ci95": list(row.fails.ci95)},
        "worst": {
            "seed": row.seed,
            "margin": row.check.margin,
            "value": row.check.value,
            "truth": row.check.truth.value,
        },
        "median_tightness": row.tightness,
    }


def _csv(survey: Survey) -> str:
    """Every comparison, one a line."""
    rows = []
    for entry in survey.entries:
        for check in entry.checks:
            truth = check.truth
            named = (check.formula, check.meaning, check.loop, "" if check.robot is None else check.robot)
            values = (f"{value:.9g}" for value in (check.value, truth.value, truth.low, truth.high))
            rows.append((entry.seed, entry.robots, *named, *values, check.verdict, f"{check.margin:.9g}"))
    return csv_text(COLUMNS, rows)


def _charts(survey: Survey) -> tuple[Chart, Chart]:
    from analysis.survey.charts import coverage, failing

    return failing(survey), coverage(survey)


def _scatter(survey: Survey) -> Figure:
    from analysis.survey.picture import scatter_figure

    return scatter_figure(survey)


def _worst(survey: Survey) -> dict[str, Callable[[], bytes]]:
    """The worst world of every formula that fails, as world files with the starts."""
    failures = survey.worst_failures().items()
    return {_file(key): partial(_world_file, survey, row) for key, row in failures}


def _file(key: str) -> str:
    return f"worst/{key.replace('/', '-')}.npz"


def _world_file(survey: Survey, row: Row) -> bytes:
    world = survey_world(survey.choices, row.seed)
    return world.with_starts(survey_starts(world, row.robots)).to_bytes()
