"""Policies against the paper's on the same random maps with the same luck, map by map; and the bound beside them.

Map number i of every setting has the same seed, and so have its rollouts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress
from analysis.kit.pool import answers, wanted_processes
from analysis.policies.settings import KINDS, ON_LARGE, PART, SMALL, TEAMS, Setting
from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices
from analysis.statistics.control import tally_mean
from analysis.statistics.estimate import Estimate, over_maps
from analysis.sweeps.cases import Case, generated_case
from analysis.sweeps.engine import Done, Finished, Job, run_cases
from analysis.sweeps.store.store import Store
from analysis.sweeps.worlds import check_maps
from analysis.theory.any_strategy import any_strategy
from planner.tally import Outcome, Tally
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts

WORSE = 0.01
"""Coverage that a policy loses on a map that is listed as worse."""
FIGURES = ("visited", "losses", "time", "complete")
Place = tuple[Kind, int, int]
"""Kind, robots and the number of a map."""


@dataclass(frozen=True)
class Worse:
    """A map on which a policy covers less: its seed, by how much, and that in standard errors of unpaired runs."""

    seed: int
    difference: float
    errors: float


@dataclass(frozen=True, eq=False, repr=False)
class Study(Answer):
    """The answer. Axis `M` = maps, in order of their seeds; those of `ON_LARGE` and of the bound are the first of them.

    Attributes:
        columns: float64 `[M]` by setting and figure: each map's mean of its rollouts; "visited" and "complete" are
            fractions, "losses" robots, "time" steps; "se": the standard error of "visited".
        bounds: float64 `[M]` by kind and team, coverage that no strategy exceeds. seed: of the first map.
        rollouts: of each map and setting. finished: how the run ended.
    """

    columns: dict[Setting, dict[str, NDArray[np.float64]]]
    bounds: dict[tuple[Kind, int], NDArray[np.float64]]
    rollouts: int
    seed: int
    finished: Finished

    @property
    def partial(self) -> bool:  # type: ignore[override]
        """It was interrupted."""
        return self.finished.partial

    def maps(self, setting: Setting) -> int:
        """Maps of a setting."""
        return len(self.columns[setting]["visited"])

    def estimate(self, setting: Setting, figure: str) -> Estimate:
        """Mean over maps."""
        return over_maps(self.columns[setting][figure])

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


@dataclass
class _Collected:
    """Columns of each setting, map by map, as they come."""

    store: Store
    of: dict[Case, tuple[Setting, int]] = field(default_factory=dict)
    found: dict[Setting, dict[int, dict[str, float]]] = field(default_factory=dict)

    def take(self, done: Done) -> None:
        """A finished job."""
        setting, number = self.of.pop(done.job.case)
        tally = self.store.tally(done.keys[0])
        assert tally is not None
        self.found.setdefault(setting, {})[number] = _columns(tally)

    def columns(self, settings: tuple[Setting, ...]) -> dict[Setting, dict[str, NDArray[np.float64]]]:
        """Of the maps, from the first on, that all of these settings have."""
        whole = 0
        while settings and all(whole in self.found.get(setting, ()) for setting in settings):
            whole += 1
        return {
            setting: {
                figure: np.array([self.found[setting][n][figure] for n in range(whole)]) for figure in (*FIGURES, "se")
            }
            for setting in settings
            if whole
        }


def _columns(tally: Tally) -> dict[str, float]:
    visited = tally_mean(tally, "visited", 1.0 / tally.accessible)
    return {
        "visited": visited.mean,
        "se": visited.se,
        "losses": tally_mean(tally, "lost").mean,
        "time": tally_mean(tally, "time").mean,
        "complete": float(tally.outcomes[Outcome.COMPLETE]) / tally.rollouts,
    }


def study_policies(
    *,
    maps: int,
    rollouts: int,
    seed: int = 0,
    store: Store | None = None,
    processes: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Study:
    """Run every setting on `maps` maps, the large ones and the bound on one in PART of them; `store` as of `reproduce`.

    An interruption leaves the maps that are done; none: KeyboardInterrupt again. Raises InputError.
    """
    check_maps(maps, seed)
    held = Store.memory() if store is None else store
    collected, few = _Collected(held), -(-maps // PART)

    def take(done: Done) -> None:
        collected.take(done)
        if progress is not None:
            progress(done.jobs, done.total, done.seconds)

    finished = run_cases(
        _jobs(collected, maps, few, rollouts, seed),
        held,
        processes=processes,
        scheduler=scheduler,
        total=maps * len(SMALL) + few * len(ON_LARGE),
        progress=take,
    )
    columns = collected.columns(SMALL) | collected.columns(ON_LARGE)
    if not any(setting in columns for setting in SMALL):
        raise KeyboardInterrupt
    bounds: dict[tuple[Kind, int], NDArray[np.float64]] = {}
    if not finished.partial:
        try:
            bounds = _bounds(few, seed, processes)
        except KeyboardInterrupt:
            finished = replace(finished, partial=True)
    return Study(columns, bounds, rollouts, seed, finished)


def _jobs(collected: _Collected, maps: int, few: int, rollouts: int, seed: int) -> Iterator[Job]:
    """Map after map, so that an interruption leaves whole maps."""
    for number in range(maps):
        for setting in SMALL + ON_LARGE * (number < few):
            size = (setting.side, setting.side)
            case = generated_case(setting.kind, 0.25, setting.robots, seed + number, size, choices=setting.choices)
            case = replace(case, labels=(*case.labels, ("size", f"{size[0]}x{size[1]}"), ("policy", setting.name)))
            collected.of[case] = (setting, number)
            yield Job(case, (RolloutChoices(seed=seed + number),), rollouts)


def _bounds(maps: int, seed: int, processes: int | None) -> dict[tuple[Kind, int], NDArray[np.float64]]:
    places: list[Place] = [(kind, robots, seed + n) for kind in KINDS for robots in TEAMS for n in range(maps)]
    count = wanted_processes(processes, len(places))
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
