"""Policies against the paper's on the same random maps with the same luck, map by map; and the bound beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress
from analysis.kit.pool import answers, wanted_processes
from analysis.policies.settings import KINDS, ON_LARGE, PART, SMALL, TEAMS, Setting
from analysis.statistics.estimate import Estimate, over_maps
from analysis.sweeps.by_map import ByMap, Columns
from analysis.sweeps.cases import Case, generated_case
from analysis.sweeps.engine import Finished, Swept
from analysis.sweeps.store.store import Store
from analysis.sweeps.worlds import check_maps
from analysis.theory.any_strategy import any_strategy
from planner.worlds.generate import Kind, ThreatPattern, random_world
from planner.worlds.starts import place_starts

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

    reported_by = "analysis.policies.report:report"

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
    progress: Progress | None = None,
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
