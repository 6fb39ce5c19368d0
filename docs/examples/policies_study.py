"""Policies against the paper's on the same random maps, common random numbers, map by map; and the upper bound."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
from by_map import MAP_FIGURES, ByMap, Columns
from numpy.typing import NDArray
from rich.table import Table

from analysis.page.elements import Chart, Series
from analysis.report.model import Report, Section
from analysis.statistics.estimates import Estimate, over_maps
from analysis.sweeps.cases import Case, check_maps, generated_case
from analysis.sweeps.engine import Finished, Swept
from analysis.sweeps.store import Store
from analysis.theory.upper_bound import any_strategy
from analysis.utils.notes import ProgressCallback
from analysis.utils.pool import answers, wanted_processes
from analysis.utils.tables import csv_text, make_table
from planner.files import Json
from planner.formatting import counted, in_percent
from planner.json_objects import as_json
from planner.settings import Choices
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.start_rule import place_starts

# What the policies are compared on.

KINDS: tuple[Kind, ...] = get_args(Kind)
TEAMS = (1, 2, 4, 8, 20)
FRONT_TEAMS = (4, 8, 20)
RISK_CAP = 0.25
ROBOT_VALUES = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)
CUTS = (20, 40, 60, 80, 150)
"""Steps at which runs of `mrac` are cut off."""
LARGE, LARGE_TEAM = 40, 8
PART = 10
"""One map in so many has the large maps too, and the bound for every strategy."""


@dataclass(frozen=True)
class Setting:
    """A team and its policy on square maps of `side` cells. `cut`: the step at which its runs are cut off."""

    kind: Kind
    robots: int
    policy: str = "mrac"
    risk_cap: float | None = None
    robot_value: float | None = None
    cut: int | None = None
    side: int = 20

    @property
    def choices(self) -> Choices:
        """The planner's settings."""
        policy = None if self.policy == "mrac" else self.policy
        return Choices(policy=policy, risk_cap=self.risk_cap, robot_value=self.robot_value, max_steps=self.cut)

    @property
    def name(self) -> str:
        """The policy with its limits, in words."""
        limits = {"risk_cap": self.risk_cap, "robot_value": self.robot_value, "cut at step": self.cut}
        return ", ".join([self.policy, *(f"{name} {value:g}" for name, value in limits.items() if value is not None)])


def rivals(kind: Kind, robots: int, side: int = 20) -> tuple[Setting, ...]:
    """`mrac`, `per_cell`, and for two robots or more `per_cell` with a risk cap."""
    plain = (Setting(kind, robots, side=side), Setting(kind, robots, "per_cell", side=side))
    return plain + (Setting(kind, robots, "per_cell", RISK_CAP, side=side),) * (robots > 1)


def ladder(kind: Kind, robots: int) -> tuple[Setting, ...]:
    """`per_cell` without and with robot values, ascending."""
    return tuple(Setting(kind, robots, "per_cell", robot_value=robot_value) for robot_value in (None, *ROBOT_VALUES))


def cuts(kind: Kind, robots: int) -> tuple[Setting, ...]:
    """`mrac` to its end, and cut off earlier and earlier."""
    return tuple(Setting(kind, robots, cut=cut) for cut in (None, *reversed(CUTS)))


SMALL: tuple[Setting, ...] = tuple(
    dict.fromkeys(
        setting
        for kind in KINDS
        for found in (
            *(rivals(kind, robots) for robots in TEAMS),
            *(of(kind, robots) for robots in FRONT_TEAMS for of in (ladder, cuts)),
        )
        for setting in found
    )
)
"""The settings of every map."""
ON_LARGE: tuple[Setting, ...] = tuple(setting for kind in KINDS for setting in rivals(kind, LARGE_TEAM, LARGE)[:2])


WORSE = 0.01
"""Coverage that a policy loses on a map that is listed as worse."""
Place = tuple[Kind, int, int]
"""Kind, robots and the number of a map."""


@dataclass(frozen=True)
class Worse:
    """A map on which a policy covers less: its seed, by how much, and that in standard errors of unpaired runs."""

    seed: int
    difference: float
    errors: float


@dataclass(frozen=True, eq=False, repr=False)
class Study(Swept):
    """The answer. Axis `M` = maps, in order of their seeds; those of `ON_LARGE` and of the bound are the first of them.

    Attributes:
        columns: of each setting, map by map.
        bounds: float64 `[M]` by kind and team, coverage that no strategy exceeds. seed: of the first map.
        rollouts: of each map and setting. finished: how the run ended.
    """

    reported_by = "policies_study:report"

    columns: dict[Setting, Columns]
    bounds: dict[tuple[Kind, int], NDArray[np.float64]]
    rollouts: int
    seed: int
    finished: Finished

    def maps(self, setting: Setting) -> int:
        """Maps of a setting."""
        return len(self.columns[setting]["visited"])

    def estimate(self, setting: Setting, figure: str) -> Estimate:
        """Mean over maps."""
        return over_maps(self.columns[setting][figure])

    def exact(self, setting: Setting) -> int:
        """Maps of a setting whose figures are known exactly."""
        return int(self.columns[setting]["exact"].sum())

    def gain(self, setting: Setting) -> Estimate:
        """Coverage beyond `mrac`'s with that team, map by map."""
        return over_maps(self._apart(setting))

    def _apart(self, setting: Setting) -> NDArray[np.float64]:
        paper = Setting(setting.kind, setting.robots, side=setting.side)
        return self.columns[setting]["visited"] - self.columns[paper]["visited"]

    def worse(self, setting: Setting) -> list[Worse]:
        """The maps on which it covers less than `mrac` by more than WORSE, the worst first."""
        apart = self._apart(setting)
        paper = Setting(setting.kind, setting.robots, side=setting.side)
        errors = np.hypot(self.columns[setting]["se"], self.columns[paper]["se"])
        order = np.argsort(apart, kind="stable")
        found = [(int(n), float(apart[n]), float(errors[n])) for n in order if apart[n] < -WORSE]
        return [Worse(self.seed + n, gap, -gap / se if se > 0 else math.inf) for n, gap, se in found]

    def gap(self, setting: Setting) -> Estimate | None:
        """What no strategy exceeds, less what this one covers, on the maps that have both."""
        bounds = self.bounds.get((setting.kind, setting.robots), np.empty(0))
        shared = min(len(bounds), self.maps(setting))
        return over_maps(bounds[:shared] - self.columns[setting]["visited"][:shared]) if shared else None


def study_policies(
    *,
    maps: int,
    rollouts: int,
    seed: int = 0,
    store: Store | None = None,
    processes: int | None = None,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
) -> Study:
    """Run every setting on `maps` maps, the large ones and the bound on one in PART of them; `store` as of `reproduce`.

    An interruption leaves the maps that are done; none: KeyboardInterrupt again. Raises InputError.
    """
    check_maps(maps, seed)
    few = -(-maps // PART)
    by_map = ByMap(
        lambda number: [(one, _case(one, seed + number)) for one in SMALL + ON_LARGE * (number < few)],
        seed,
        rollouts,
        exact=True,
    )
    total = maps * len(SMALL) + few * len(ON_LARGE)
    finished = by_map.run(maps, total, store, progress, processes=processes, scheduler=scheduler)
    columns = by_map.columns(SMALL) | by_map.columns(ON_LARGE)
    if not any(setting in columns for setting in SMALL):
        raise KeyboardInterrupt
    bounds: dict[tuple[Kind, int], NDArray[np.float64]] = {}
    if not finished.partial:
        try:
            bounds = _bounds(few, seed, processes)
        except KeyboardInterrupt:
            finished = replace(finished, partial=True)
    return Study(columns, bounds, rollouts, seed, finished)


def _case(setting: Setting, seed: int) -> Case:
    size = (setting.side, setting.side)
    case = generated_case(setting.kind, 0.25, setting.robots, seed, size, choices=setting.choices)
    return replace(case, labels=(*case.labels, ("size", f"{size[0]}x{size[1]}"), ("policy", setting.name)))


def _bounds(maps: int, seed: int, processes: int | None) -> dict[tuple[Kind, int], NDArray[np.float64]]:
    places: list[Place] = [(kind, robots, seed + n) for kind in KINDS for robots in TEAMS for n in range(maps)]
    count = wanted_processes(processes, len(places))
    here = str(Path(__file__).parent)  # where the processes find `bound_of`
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    found = dict(answers(bound_of, places, count, lambda place: f"bound of {place[0]} map {place[2]}"))
    return {
        (kind, robots): np.array([found[kind, robots, seed + n] for n in range(maps)])
        for kind in KINDS
        for robots in TEAMS
    }


def bound_of(place: Place) -> float:
    """Coverage that no strategy exceeds on a map, proven."""
    kind, robots, seed = place
    world = random_world(pattern=ThreatPattern(kind, seed=seed))
    starts = place_starts(world, robots)[0]
    return any_strategy(world, starts, flow=True).cells / int(world.accessible(starts).sum())


# The report: gains, fronts, the maps where it is worse.

LISTED = 6
"""Maps where it is worse that a line of the terminal names."""


def report(study: Study) -> Report:
    """Points won over the team, coverage against losses, every point as CSV."""
    finished, maps = study.finished, study.maps(rivals(KINDS[0], TEAMS[0])[0])
    fronts = {robots: [_front(study, robots, kind) for kind in KINDS] for robots in FRONT_TEAMS}
    gains, charts = [_gains(study, kind) for kind in KINDS], [one for pair in fronts.values() for one in pair]
    return Report(
        "policies", "reproduce", "What policies bring", summary(study), study_json(study),
        heading=[
            f"{counted(maps, 'map')} a point, {counted(study.rollouts, 'rollout')} a map, first seed {study.seed}"
        ],
        took=[finished.description],
        parts=(
            Section("Gains", [gains_table(study)], figures=lambda: gains),
            Section("Coverage against losses", [front_table(study, robots) for robots in FRONT_TEAMS],
                 [*_worse_lines(study), *NOTES, *_exact_lines(study)], figures=lambda: charts),
        ),
        warnings=("Interrupted: the maps that were done.",) if finished.partial else (),
        pictures={"gains.png": lambda: gains}
        | {f"front-{robots}.png": partial(list, pair) for robots, pair in fronts.items()},
        files={"points.csv": lambda: _csv(study)},
    )  # fmt: skip


def _gains(study: Study, kind: Kind) -> Chart:
    """Points more than `mrac` with the same team on the same maps, with 95 % intervals."""
    series = []
    for place, name in ((1, "per_cell"), (2, "per_cell, risk cap 1/4")):
        settings = tuple(rivals(kind, robots)[place] for robots in TEAMS if len(rivals(kind, robots)) > place)
        sizes, found = [setting.robots for setting in settings], [study.gain(setting) for setting in settings]
        series.append(Series.of(name, sizes, found, dashed=place == 2))
    return Chart(f"Points more than mrac, {kind}", tuple(series), "robots", "more covered", unit="%")


def _front(study: Study, robots: int, kind: Kind) -> Chart:
    series = []
    for settings, name in (
        (ladder(kind, robots), "per_cell with a robot value"),
        (cuts(kind, robots), "mrac ended early"),
    ):
        lost = [study.estimate(setting, "losses").mean for setting in settings]
        seen = [100 * study.estimate(setting, "visited").mean for setting in settings]
        series.append(Series(name, lost[::-1], seen[::-1], dashed=name != "per_cell with a robot value"))
    title = f"Coverage against losses, {counted(robots, 'robot')}, {kind}"
    return Chart(title, tuple(series), "robots lost", "covered", unit="%", y_range=(0.0, 100.0))


def summary(study: Study) -> str:
    """The answer in a sentence."""
    gains = [100 * study.gain(rivals(kind, robots)[1]).mean for kind in KINDS for robots in TEAMS]
    worse = sum(len(study.worse(rivals(kind, robots)[1])) for kind in KINDS for robots in TEAMS)
    of = sum(study.maps(rivals(kind, robots)[1]) for kind in KINDS for robots in TEAMS)
    return (
        f"per_cell covers {min(gains):.1f} to {max(gains):.1f} points more than mrac with the same team, and over a "
        f"point less on {worse} of {of} maps and teams."
    )


NOTES = (
    "Coverage (visited) in % of the accessible cells; gains in points over mrac, common random numbers, ± half the "
    "95 % interval over maps.",
    "left: what no strategy exceeds, less the best here, on the maps that have the bound.",
)


def gains_table(study: Study) -> Table:
    """A row for each kind and team: what each policy covers, its steps, its complete runs, and what is left."""
    columns = ("kind", "k", "mrac", "per_cell", "risk cap 1/4", "steps", "all, %", "left")
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
    """What is covered, lost and how long it takes: `per_cell` by robot value, `mrac` ended early."""
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
            "policy": {"name": setting.policy, "risk_cap": setting.risk_cap, "robot_value": setting.robot_value},
            "deadline": setting.cut,
            "maps": study.maps(setting),
            "exact": study.exact(setting),
            **{figure: study.estimate(setting, figure).to_json() for figure in MAP_FIGURES},
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
        "answer": summary(study),
        "points": points,
        "worse": worse,
        "any_strategy": gaps,
        "rollouts": study.rollouts,
        "seed": study.seed,
        "seconds": finished.seconds,
        **as_json(study),
    }


def _worse_json(one: Worse) -> Json:
    return vars(one) | {"errors": one.errors if math.isfinite(one.errors) else None}


def _csv(study: Study) -> str:
    """Every figure of every setting on every map."""
    names = (*Setting.__dataclass_fields__, "map", *MAP_FIGURES)
    rows = [
        (*vars(s).values(), study.seed + n, *(f"{study.columns[s][figure][n]:.9g}" for figure in MAP_FIGURES))
        for s in study.columns
        for n in range(study.maps(s))
    ]
    return csv_text(names, rows)
