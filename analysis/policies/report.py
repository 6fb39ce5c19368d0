"""What `mrac-jax reproduce policies` says: gains, fronts, the maps where it is worse."""

from __future__ import annotations

import math
from functools import partial

from rich.table import Table

from analysis.kit.folder import csv_text
from analysis.kit.tables import make_table
from analysis.page.series import Chart, Series
from analysis.policies.settings import (
    FRONT_TEAMS,
    KINDS,
    LARGE,
    LARGE_TEAM,
    ON_LARGE,
    TEAMS,
    Setting,
    cuts,
    ladder,
    rivals,
)
from analysis.policies.study import Study, Worse
from analysis.report.answer import json_end
from analysis.report.blocks import Part, Report
from analysis.sweeps.by_map import FIGURES
from planner.files import Json
from planner.shown import counted, in_percent
from planner.worlds.generate import Kind

LISTED = 6
"""Maps where it is worse that a line of the terminal names."""


def report(study: Study) -> Report:
    """Points won over the team, coverage against losses, every point as CSV."""
    finished, maps = study.finished, f"{study.maps(rivals(KINDS[0], TEAMS[0])[0]):,}"
    fronts = {robots: [_front(study, robots, kind) for kind in KINDS] for robots in FRONT_TEAMS}
    gains, charts = [_gains(study, kind) for kind in KINDS], [one for pair in fronts.values() for one in pair]
    return Report(
        "policies", "reproduce", "What policies bring", headline(study), partial(study_json, study),
        heading=[
            f"{counted(maps, 'map')} a point, {counted(study.rollouts, 'rollout')} a map, first seed {study.seed}"
        ],
        took=[finished.said],
        parts=(
            Part("Gains", [gains_table(study)], drawn=lambda: gains),
            Part("Coverage against losses", [front_table(study, robots) for robots in FRONT_TEAMS],
                 [*_worse_lines(study), *NOTES, *_exact_lines(study)], drawn=lambda: charts),
        ),
        warnings=("Interrupted: the maps that were done.",) if finished.partial else (),
        pictures={"gains.png": lambda: gains}
        | {f"front-{robots}.png": partial(list, pair) for robots, pair in fronts.items()},
        files={"points.csv": lambda: _csv(study)},
    )  # fmt: skip


def _gains(study: Study, kind: Kind) -> Chart:
    """Points more than `mrac` with the same team on the same maps, with 95 % intervals."""
    series = []
    for place, name in ((1, "per_cell"), (2, "per_cell, reserve 1/4")):
        settings = tuple(rivals(kind, robots)[place] for robots in TEAMS if len(rivals(kind, robots)) > place)
        sizes, found = [setting.robots for setting in settings], [study.gain(setting) for setting in settings]
        series.append(Series.of(name, sizes, found, dashed=place == 2))
    return Chart(f"Points more than mrac, {kind}", tuple(series), "robots", "more covered", unit="%")


def _front(study: Study, robots: int, kind: Kind) -> Chart:
    series = []
    for settings, name in ((ladder(kind, robots), "per_cell with a worth"), (cuts(kind, robots), "mrac cut off")):
        lost = [study.estimate(setting, "losses").mean for setting in settings]
        seen = [100 * study.estimate(setting, "visited").mean for setting in settings]
        series.append(Series(name, lost[::-1], seen[::-1], dashed=name != "per_cell with a worth"))
    title = f"Coverage against losses, {counted(robots, 'robot')}, {kind}"
    return Chart(title, tuple(series), "robots lost", "covered", unit="%", y_range=(0.0, 100.0), x_digits=1)


def headline(study: Study) -> str:
    """The answer in a sentence."""
    gains = [100 * study.gain(rivals(kind, robots)[1]).mean for kind in KINDS for robots in TEAMS]
    worse = sum(len(study.worse(rivals(kind, robots)[1])) for kind in KINDS for robots in TEAMS)
    of = sum(study.maps(rivals(kind, robots)[1]) for kind in KINDS for robots in TEAMS)
    return (
        f"per_cell covers {min(gains):.1f} to {max(gains):.1f} points more than mrac with the same team, and over a "
        f"point less on {worse} of {of} maps and teams."
    )


NOTES = (
    "Coverage (visited) in % of the accessible cells; gains in points over mrac on the same maps and luck, ± half the "
    "95 % interval over maps.",
    "left: what no strategy exceeds, less the best here, on the maps that have the bound.",
)


def gains_table(study: Study) -> Table:
    """A row for each kind and team: what each policy covers, its steps, its complete runs, and what is left."""
    columns = ("kind", "k", "mrac", "per_cell", "reserve 1/4", "steps", "all, %", "left")
    title, dropped = "Coverage over the team", ("left", "all, %")
    table = make_table(columns, title, left=("kind",), dropped=dropped, padding=(0, 1, 0, 0))
    for kind in KINDS:
        for robots in TEAMS:
            _add_gains(table, study, kind, robots, rivals(kind, robots))
    for kind in KINDS:
        found = tuple(setting for setting in ON_LARGE if setting.kind == kind and setting in study.columns)
        if found:
            _add_gains(table, study, f"{kind} {LARGE}x{LARGE}", LARGE_TEAM, found)
    return table


def _add_gains(table: Table, study: Study, name: str, robots: int, settings: tuple[Setting, ...]) -> None:
    gains = [study.gain(setting).around(100, "+") for setting in settings[1:]]
    steps = " / ".join(f"{study.estimate(setting, 'time').mean:.0f}" for setting in settings)
    whole = " / ".join(in_percent(study.estimate(setting, "complete").mean) for setting in settings)
    gap = study.gap(best_of(study, settings)) if settings[0].side != LARGE else None
    left = "" if gap is None else gap.around(100, "+")
    paper = in_percent(study.estimate(settings[0], "visited").mean)
    table.add_row(name, str(robots), paper, *[*gains, ""][:2], steps, whole, left)


def best_of(study: Study, settings: tuple[Setting, ...]) -> Setting:
    """The one that covers most."""
    return max(settings, key=lambda setting: study.estimate(setting, "visited").mean)


def front_table(study: Study, robots: int) -> Table:
    """What is covered, lost and how long it takes: `per_cell` over its worth, `mrac` cut off."""
    columns = ("policy", *(name for kind in KINDS for name in (f"{kind}, %", "lost", "steps")))
    title = f"Coverage against losses, {counted(robots, 'robot')}"
    table = make_table(columns, title, left=("policy",), padding=(0, 1, 0, 0))
    for of in (ladder, cuts):
        for settings in zip(*(of(kind, robots) for kind in KINDS), strict=True):
            shown: list[str] = []
            for setting in settings:
                losses, steps = (study.estimate(setting, figure).mean for figure in ("losses", "time"))
                shown += [study.estimate(setting, "visited").around(100, most=100), f"{losses:.1f}", f"{steps:.0f}"]
            table.add_row(settings[0].name, *shown)
    return table


def _worse_lines(study: Study) -> list[str]:
    lines = []
    for kind in KINDS:
        for robots in TEAMS:
            line = worse_line(study, kind, robots)
            lines += [line] if line else []
    return lines


def _exact_lines(study: Study) -> list[str]:
    """For which teams the maps' means are exact."""
    whole = [k for k in TEAMS if all(study.exact(one) == study.maps(one) for kind in KINDS for one in rivals(kind, k))]
    return [f"Each map's means are exact for k = {' and '.join(map(str, whole))}."] if whole else []


def worse_line(study: Study, kind: Kind, robots: int) -> str:
    """Where `per_cell` covers over a point less; "" if nowhere."""
    setting = rivals(kind, robots)[1]
    found = study.worse(setting)
    if not found:
        return ""
    named = ", ".join(f"seed {one.seed} ({100 * one.difference:+.1f})" for one in found[:LISTED])
    more = f" and {len(found) - LISTED} more" if len(found) > LISTED else ""
    sure = sum(one.errors > 3 for one in found)
    return (
        f"per_cell over a point worse: {kind}, k = {robots}: {len(found)} of {counted(study.maps(setting), 'map')}, "
        f"{sure} of them beyond 3 standard errors: {named}{more}"
    )


def study_json(study: Study) -> Json:
    """The JSON object of `reproduce policies`; coverage and gains are fractions."""
    finished = study.finished
    points = [
        {
            "kind": setting.kind,
            "size": [setting.side, setting.side],
            "robots": setting.robots,
            "policy": {"name": setting.policy, "reserve": setting.reserve, "worth": setting.worth},
            "deadline": setting.cut,
            "maps": study.maps(setting),
            "exact": study.exact(setting),
            **{figure: study.estimate(setting, figure).to_json() for figure in FIGURES},
            "gain": study.gain(setting).to_json(),
        }
        for setting in study.columns
    ]
    worse = [
        {"kind": kind, "robots": robots, "maps": [_worse_json(one) for one in study.worse(rivals(kind, robots)[1])]}
        for kind in KINDS
        for robots in TEAMS
    ]
    gaps = [
        {"kind": kind, "robots": robots, "maps": len(found), "mean": float(found.mean()), "left": left.to_json()}
        for (kind, robots), found in study.bounds.items()
        if (left := study.gap(best_of(study, rivals(kind, robots)))) is not None
    ]
    return {
        "answer": headline(study),
        "points": points,
        "worse": worse,
        "any_strategy": gaps,
        "rollouts": study.rollouts,
        "seed": study.seed,
        "seconds": finished.seconds,
        **json_end(study),
    }


def _worse_json(one: Worse) -> Json:
    return vars(one) | {"errors": one.errors if math.isfinite(one.errors) else None}


def _csv(study: Study) -> str:
    """Every figure of every setting on every map."""
    names = (*Setting.__dataclass_fields__, "map", *FIGURES)
    rows = [
        (*vars(s).values(), study.seed + n, *(f"{study.columns[s][figure][n]:.9g}" for figure in FIGURES))
        for s in study.columns
        for n in range(study.maps(s))
    ]
    return csv_text(names, rows)
