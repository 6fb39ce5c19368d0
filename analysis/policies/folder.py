"""The folder of `reproduce policies --out`: page, tables, JSON, points as CSV, pictures."""

from __future__ import annotations

from pathlib import Path

from analysis.kit.folder import as_text, csv_text, json_text, write_all
from analysis.policies.settings import FRONT_TEAMS, KINDS, TEAMS, Setting, cuts, ladder, rivals
from analysis.policies.study import FIGURES, Study
from analysis.policies.table import NOTES, front_table, gains_table, headline, print_study, study_json, worse_line


def save_study(study: Study, folder: Path, command: str) -> list[Path]:
    """Write it all; `command`: what made it, for the page. Returns the files."""
    from analysis.pictures.style import png_of
    from analysis.policies.pictures import front_figure, gains_figure

    pictures = {"gains.png": png_of(gains_figure, study)}
    pictures |= {f"front-{robots}.png": png_of(front_figure, study, robots) for robots in FRONT_TEAMS}
    files: dict[str, str | bytes] = {
        "policies.txt": as_text(lambda console: print_study(study, console), 140),
        "policies.json": json_text(study_json(study)),
        "points.csv": _csv(study),
    }
    page = study_page(study, command, pictures, list(files))
    return write_all(folder, {"index.html": page, **files, **pictures})


def study_page(study: Study, command: str, pictures: dict[str, bytes], files: list[str]) -> str:
    """The page of the folder, as HTML."""
    from analysis.page.curves import Chart, Series
    from analysis.page.sweep_page import sweep_page
    from analysis.page.tables import from_rich

    charts = []
    for kind in KINDS:
        gains = []
        for place, name in ((1, "per_cell"), (2, "per_cell, reserve 1/4")):
            settings = tuple(rivals(kind, robots)[place] for robots in TEAMS if len(rivals(kind, robots)) > place)
            found = [study.gain(setting) for setting in settings]
            ends = [[100 * gain.ci95[end] for gain in found] for end in (0, 1)]
            low, high = ends if study.maps(settings[0]) > 1 else (None, None)
            mean = [100 * gain.mean for gain in found]
            gains.append(Series(name, [setting.robots for setting in settings], mean, low, high, dashed=place == 2))
        charts.append(Chart(f"Points more than mrac, {kind} threats", tuple(gains), "robots", "more covered", unit="%"))
    for robots in FRONT_TEAMS:
        for kind in KINDS:
            fronts = []
            for settings, name in (
                (ladder(kind, robots), "per_cell with a worth"),
                (cuts(kind, robots), "mrac cut off"),
            ):
                lost = [study.estimate(setting, "losses").mean for setting in settings]
                seen = [100 * study.estimate(setting, "visited").mean for setting in settings]
                fronts.append(Series(name, lost[::-1], seen[::-1], dashed=name != "per_cell with a worth"))
            title = f"{robots} robots, {kind} threats: coverage against losses"
            charts.append(
                Chart(title, tuple(fronts), "robots lost", "covered", unit="%", y_range=(0.0, 100.0), x_digits=1)
            )
    tables = [from_rich(gains_table(study)), *(from_rich(front_table(study, robots)) for robots in FRONT_TEAMS)]
    worse = [line for kind in KINDS for robots in TEAMS if (line := worse_line(study, kind, robots))]
    settings_shown = {
        "maps a point": f"{study.maps(rivals(KINDS[0], TEAMS[0])[0]):,}",
        "rollouts a map": f"{study.rollouts:,}",
        "seed of the first map": str(study.seed),
    }
    return sweep_page(
        "What policies bring", headline(study), charts, tables, [*worse, *NOTES], settings_shown, command, pictures,
        files=tuple(files), kind="reproduce",
    )  # fmt: skip


def _csv(study: Study) -> str:
    """Every figure of every setting on every map."""
    names = (*Setting.__dataclass_fields__, "map", *FIGURES)
    rows = [
        (*vars(s).values(), study.seed + n, *(f"{study.columns[s][figure][n]:.9g}" for figure in FIGURES))
        for s in study.columns
        for n in range(study.maps(s))
    ]
    return csv_text(names, rows)
