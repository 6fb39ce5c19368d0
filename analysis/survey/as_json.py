"""A survey as JSON."""

from __future__ import annotations

from analysis.checking.as_json import check_head, check_row
from analysis.report.answer import json_end
from analysis.statistics.intervals import ALPHA
from analysis.survey.survey import Row, Survey
from planner.files import Json


def survey_json(survey: Survey) -> Json:
    """The JSON object of `check --worlds`, but for its sentence."""
    choices = survey.choices
    return {
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
