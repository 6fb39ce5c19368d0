"""What `mrac-jax reproduce online` and `moving` say: coverage by way, what lies between ways, over the team."""

from __future__ import annotations

from functools import partial

from rich.table import Table

from analysis.kit.folder import csv_text
from analysis.kit.tables import make_table
from analysis.knowing.questions import Team
from analysis.knowing.study import Study
from analysis.page.series import Chart, Series
from analysis.report.answer import json_end
from analysis.report.blocks import Part, Report
from analysis.sweeps.by_map import FIGURES
from planner.files import Json
from planner.shown import counted
from planner.worlds.generate import Kind

NOTE = (
    "Visited, % of the accessible cells, and differences in points on the same maps and luck; ± half the 95 % interval "
    "over maps."
)


def report(study: Study) -> Report:
    """Coverage of every way, how far ways are apart, curves over the team, every point as CSV."""
    finished, question = study.finished, study.question
    kinds, _, policies = (list(dict.fromkeys(names)) for names in zip(*study.teams, strict=True))
    charts = {policy: [_chart(study, kind, policy) for kind in kinds] for policy in policies}
    return Report(
        question.name, "reproduce", question.title, headline(study), partial(study_json, study),
        heading=[
            f"{counted(study.maps, 'map')} a point, {counted(study.rollouts, 'rollout')} a map, first seed {study.seed}"
        ],
        took=[finished.said],
        parts=(
            Part("Coverage", [ways_table(study)], drawn=lambda: [one for pair in charts.values() for one in pair]),
            Part("What lies between", [less_table(study), gains_table(study)], [NOTE]),
        ),
        warnings=("Interrupted: the maps that were done.",) if finished.partial else (),
        pictures={f"{policy}.png": partial(list, pair) for policy, pair in charts.items()},
        files={"points.csv": lambda: _csv(study)},
    )  # fmt: skip


def headline(study: Study) -> str:
    """The main differences, from the least to the largest of all teams."""
    said = []
    for pair, words in study.question.main.items():
        found = [100 * study.apart(team, *pair).mean for team in study.teams]
        said.append(words.format(f"{min(found):.1f} to {max(found):.1f}"))
    return "; ".join(said) + "."


def _chart(study: Study, kind: Kind, policy: str) -> Chart:
    series, teams = [], [team for team in study.teams if team[0] == kind and team[2] == policy]
    for way in study.question.ways:
        found = [study.estimate(team, way) for team in teams]
        series.append(Series.of(way, [robots for _, robots, _ in teams], found, dashed=", " in way))
    title = f"{study.question.title} {kind}, {policy}"
    return Chart(title, tuple(series), "robots", "visited", unit="%", y_range=(0.0, 100.0))


def ways_table(study: Study) -> Table:
    """What every team covers, by way."""
    table = _table("Visited, %", list(study.question.ways))
    for team in study.teams:
        table.add_row(*_named(team), *(study.estimate(team, way).around(100, most=100) for way in study.question.ways))
    return table


def less_table(study: Study) -> Table:
    """How much more one way covers than another."""
    pairs = study.question.less
    table = _table("Points more", [f"{one} - {other}" for one, other in pairs])
    for team in study.teams:
        table.add_row(*_named(team), *(study.apart(team, *pair).around(100, "+") for pair in pairs))
    return table


def gains_table(study: Study) -> Table:
    """How much more a team covers by the last rule than by the one before it, by way."""
    before, last = study.question.policies[-2:]
    table = make_table(("kind", "k", *study.question.ways), f"Points more by {last} than by {before}", left=("kind",))
    for kind, robots in dict.fromkeys(team[:2] for team in study.teams):
        gains = [study.gain(kind, robots, way) for way in study.question.ways]
        table.add_row(kind, str(robots), *("" if gain is None else gain.around(100, "+") for gain in gains))
    return table


def _table(title: str, columns: list[str]) -> Table:
    return make_table(("kind", "k", "policy", *columns), title, left=("kind", "policy"), padding=(0, 1, 0, 0))


def _named(team: Team) -> tuple[str, str, str]:
    kind, robots, policy = team
    return kind, str(robots), policy


def study_json(study: Study) -> Json:
    """The JSON object; coverage and differences are fractions."""
    teams = {team: dict(zip(("kind", "robots", "policy"), team, strict=True)) for team in study.teams}
    return {
        "answer": headline(study),
        "question": study.question.name,
        "ways": study.question.ways,
        "points": [
            said | {"way": way} | {figure: study.estimate(team, way, figure).to_json() for figure in FIGURES}
            for team, said in teams.items()
            for way in study.question.ways
        ],
        "differences": [
            said | {"of": one, "less": other, "visited": study.apart(team, one, other).to_json()}
            for team, said in teams.items()
            for one, other in study.question.less
        ],
        "gains": [
            {
                "kind": kind,
                "robots": robots,
                "way": way,
                "of": study.question.policies[-1],
                "less": study.question.policies[-2],
                "visited": gain.to_json(),
            }
            for kind, robots in dict.fromkeys(team[:2] for team in study.teams)
            for way in study.question.ways
            if (gain := study.gain(kind, robots, way)) is not None
        ],
        "maps": study.maps,
        "rollouts": study.rollouts,
        "seed": study.seed,
        "seconds": study.finished.seconds,
        **json_end(study),
    }


def _csv(study: Study) -> str:
    """Every figure of every setting on every map."""
    rows = [
        (*vars(one).values(), study.seed + n, *(f"{columns[figure][n]:.9g}" for figure in (*FIGURES, "se")))
        for one, columns in study.columns.items()
        for n in range(study.maps)
    ]
    return csv_text((*next(iter(study.columns)).__dataclass_fields__, "map", *FIGURES, "se"), rows)
