"""The charts of a survey's page: how often formulas fail, and coverage with what bounds it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from analysis.checking.picture import CURVES
from analysis.page.series import Chart, Series
from analysis.survey.survey import Row, Survey, check_name
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


def failing(survey: Survey) -> Chart:
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
        sizes = [row.robots for row in rows]
        series.append(Series.of(check_name(rows[0].check), sizes, [row.fails for row in rows]))
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


def coverage(survey: Survey) -> Chart:
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
