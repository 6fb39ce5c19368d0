"""The page of `mrac-jax check --worlds N --out`: how often each formula fails, over the size of the team."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.checking.picture import CURVES
from analysis.kit.words import counted
from analysis.page.curves import Chart, Series, curves_html
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import element
from analysis.page.parts import answer_page, noted_tables
from analysis.page.tables import printed
from analysis.survey.survey import Row, Survey
from analysis.survey.table import headline, print_survey
from analysis.theory.verdicts import Check, Verdict

DRAWN = (
    "eq7_team/visited/closed",
    "ideal_connected/visited/closed",
    "theorem3_interior_set/visited/open",
    "mended_largest/visited/open",
    "until_first_loss/visited/closed",
    "loss_tree_lower/visited/closed",
)
"""What is drawn beside the coverage: as many as there are colours."""
FILES = ("survey.csv", "survey.json", "survey.md", "survey.txt")


def survey_page(survey: Survey, command: str, pictures: Mapping[str, bytes], files: Sequence[str] = FILES) -> str:
    """The page as HTML; the same survey gives the same bytes. Arguments as of `analysis.page.sweep_page.sweep_page`."""
    lines, tables = printed(lambda console: print_survey(survey, console))
    tables = [replace(table, unfolded=place == 0) for place, table in enumerate(tables)]
    notes = [line for line in lines if line.startswith(("*", "Sampled truths"))]
    choices = survey.choices
    worlds = f"{survey.worlds:,} {choices.kind} worlds of {choices.height} x {choices.width} cells"
    charts = element("div", curves_html(_failing(survey)), curves_html(_coverage(survey)), class_="charts")
    return answer_page(
        f"{worlds}: which formulas hold?",
        headline(survey),
        (Section("Over the size of the team", charts), Section("Every formula", noted_tables(tables, notes))),
        command, pictures, files, kind="check --worlds", findings=_findings(survey), settings=_settings(survey),
        figures=_key_figures(survey),
        warnings=(f"Interrupted after {survey.worlds:,} worlds.",) if survey.partial else (),
        note="World number i has the seed of the first plus i: the number of processes changes nothing.",
    )  # fmt: skip


def _key_figures(survey: Survey) -> tuple[KeyFigure, ...]:
    rows = survey.rows()
    failing = {row.check.formula for row in rows if row.verdicts[Verdict.FAILS] and row.check.about.paper}
    paper = {row.check.formula for row in rows if row.check.about.paper}
    ours = {row.check.formula for row in rows if not row.check.about.paper}
    return (
        KeyFigure(f"{len(failing)} of {len(paper)}", "of the paper's formulas fail somewhere", "every reading counted"),
        KeyFigure(f"{len({check.formula for _, _, check in survey.faults})}", "of what is proven fails",
                  f"ours: {len(ours)} bounds"),
        KeyFigure(f"{sum(row.worlds for row in rows):,}", "comparisons", f"on {survey.worlds:,} worlds"),
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
            f"{_name(check)}: worst on the world of seed {row.seed} with {counted(row.robots, 'robot')}, where it says "
            f"{check.value:.{digits}f} and the truth is {check.truth.value:.{digits}f}{unit} "
            f"(worst/{key.replace('/', '-')}-k{row.robots}.npz)."
        )
    return out or ["Nothing fails on any of these worlds."]


def _name(check: Check) -> str:
    of = f"{check.meaning}, {check.loop} loop" if check.meaning else f"{check.loop} loop"
    return f"{check.about.title[0].upper()}{check.about.title[1:]} ({of})"


def _failing(survey: Survey) -> Chart:
    """The share of worlds on which each of the paper's formulas fails, where it fails most: a curve for each."""
    by_key: dict[str, list[Row]] = {}
    for row in survey.rows():
        if row.check.about.paper:
            by_key.setdefault(row.check.key, []).append(row)
    failing: dict[str, list[Row]] = {}
    for rows in by_key.values():
        formula = rows[0].check.formula
        if _most(rows) > _most(failing.get(formula, [])):
            failing[formula] = rows
    series = []
    for rows in failing.values():
        ends = [(100 * row.fails.mean, *(100 * end for end in row.fails.ci95)) for row in rows]
        mean, low, high = zip(*ends, strict=True)
        series.append(Series(_name(rows[0].check), [row.robots for row in rows], mean, low, high))
    return Chart(
        title="How often the paper's formulas fail",
        series=tuple(series),
        x_name="robots",
        y_name="share of the worlds on which it fails, %",
        unit="%",
        y_range=(0, 100),
        note="Of the worlds where the formula is defined, in the meaning and loop in which it fails most. Press a name "
        "to hide a curve.",
    )


def _most(rows: list[Row]) -> float:
    """The largest share of worlds on which it fails."""
    return max((row.fails.mean for row in rows if row.verdicts[Verdict.FAILS]), default=0.0)


def _coverage(survey: Survey) -> Chart:
    """Coverage, ideals and bounds, means over the worlds, with 95 % intervals of these means."""
    series = [
        _mean(survey, f"ideal_team/visited/{loop}", f"coverage, {loop} loop", lambda check: check.truth.value, place)
        for place, loop in enumerate(("open", "closed"))
    ]
    names = {key: name for key, name, _, _ in CURVES}
    for place, key in enumerate(DRAWN):
        name = names[key]
        series.append(_mean(survey, key, name, lambda check: check.value, place + 2))
    shown = [one for one in series if one is not None]
    return Chart(
        title="Coverage, what bounds it, and what claims to",
        series=tuple(shown),
        x_name="robots",
        y_name="mean over the worlds, % of the accessible cells",
        unit="%",
        y_range=(0, 100),
        at_y=((100.0, "every cell"),),
        interval="95 % interval of the mean over worlds",
        note="The picture over_robots.png has more readings.",
    )


def _mean(survey: Survey, key: str, name: str, value: Callable[[Check], float], place: int) -> Series | None:
    sizes, found = [], []
    for robots in survey.choices.teams:
        known = [
            100 * value(check) / entry.cells
            for entry in survey.entries
            if entry.robots == robots
            for check in entry.checks
            if check.key == key
        ]
        if known:
            half = 1.96 * float(np.std(known, ddof=1)) / np.sqrt(len(known)) if len(known) > 1 else 0.0
            sizes.append(robots)
            found.append((float(np.mean(known)), float(np.mean(known)) - half, float(np.mean(known)) + half))
    if not sizes:
        return None
    mean, low, high = zip(*found, strict=True)
    return Series(name, sizes, mean, low, high, dashed=place > 1, colour=place % 8)


def _settings(survey: Survey) -> dict[str, object]:
    choices = survey.choices
    first = survey.rollouts.seed
    return {
        "worlds": f"{survey.worlds:,}, {choices.kind}",
        "size": f"{choices.height} x {choices.width} cells",
        "robots": ", ".join(map(str, choices.teams)),
        "seeds": f"{first} to {first + choices.worlds - 1}",
        "closed loop": f"{survey.rollouts.rollouts:,} rollouts a world and team",
        **choices.settings.shown(),
    }
