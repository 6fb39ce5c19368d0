"""The charts of a survey's page: how often formulas fail, and coverage with what bounds it."""

from __future__ import annotations

import numpy as np

from analysis.page.series import Chart, Series
from analysis.statistics.estimate import Estimate, over_maps
from analysis.survey.survey import Survey

DRAWN = {
    "eq7_team/visited/closed": "ideal of one robot, eq. (7)",
    "ideal_connected/visited/closed": "our ideal on this map",
    "theorem3_interior_set/visited/open": "Theorem 3, C interior, set",
    "mended_largest/visited/open": "ours: chances",
    "until_first_loss/visited/closed": "ours: until the first loss",
}
"""What is drawn beside the coverage, by key of the check: as many as there are colours."""


def failing(survey: Survey) -> Chart:
    """The share of worlds on which each of the paper's formulas fails, where it fails most: a curve for each."""
    series = []
    for most in survey.failing.values():
        rows = [row for row in survey.rows if row.check.key == most.check.key]
        series.append(Series.of(most.check.named, [row.robots for row in rows], [row.fails for row in rows]))
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


def coverage(survey: Survey) -> Chart:
    """Coverage, ideals and bounds, means over the worlds, with 95 % intervals of these means."""
    names = {f"ideal_team/visited/{loop}": f"coverage, {loop} loop" for loop in ("open", "closed")} | DRAWN
    cells = {(entry.seed, entry.robots): entry.cells for entry in survey.entries}
    means: dict[str, dict[int, Estimate]] = {}
    for key, robots, found in survey.grouped():
        shares = [(check.value if key in DRAWN else check.truth.value) / cells[seed, robots] for seed, check in found]
        means.setdefault(key, {})[robots] = over_maps(np.array(shares))
    series = [
        Series.of(name, list(means[key]), list(means[key].values()), dashed=key in DRAWN, colour=place)
        for place, (key, name) in enumerate(names.items())
        if key in means
    ]
    return Chart(
        title="Coverage, what bounds it, and what claims to",
        series=tuple(series),
        x_name="robots",
        y_name="mean over the worlds, % of the accessible cells",
        unit="%",
        y_range=(0, 100),
        at_y=((100.0, "every cell"),),
        interval="95 % interval of the mean over worlds",
    )
