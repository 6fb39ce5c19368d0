"""The folder of `check --worlds --out`: page, tables, JSON, pictures, the worst worlds."""

from __future__ import annotations

from pathlib import Path

from analysis.kit.folder import as_text, csv_text, json_text, write_all
from analysis.survey.as_json import survey_json
from analysis.survey.survey import Survey, survey_starts, survey_world
from analysis.survey.table import COLUMNS, markdown, print_survey


def save_survey(survey: Survey, folder: Path, command: str) -> list[Path]:
    """Write page, table, JSON, every comparison as CSV, pictures, and the worst world of every formula that fails.

    `command`: the command line that made it, for the page.
    """
    from analysis.pictures.style import png_of
    from analysis.survey.page import survey_page
    from analysis.survey.picture import over_robots_figure, scatter_figure

    figures = {"bound_against_truth.png": scatter_figure, "over_robots.png": over_robots_figure}
    pictures = {name: png_of(figure, survey) for name, figure in figures.items()}
    written = write_all(
        folder,
        {
            "index.html": survey_page(survey, command, pictures),
            "survey.txt": as_text(lambda console: print_survey(survey, console), 140),
            "survey.md": markdown(survey),
            "survey.json": json_text(survey_json(survey)),
            "survey.csv": _csv(survey),
            **pictures,
        },
    )
    worst = folder / "worst"
    for key, row in survey.worst_failures().items():
        worst.mkdir(exist_ok=True)
        world = survey_world(survey.choices, row.seed)
        path = worst / f"{key.replace('/', '-')}-k{row.robots}.npz"
        world.with_starts(survey_starts(world, row.robots)).save(path)
        written.append(path)
    return written


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
