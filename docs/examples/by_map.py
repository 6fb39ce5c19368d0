"""Figures of settings on many maps, map by map, for the studies in this folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Known, tree_of
from analysis.sampling import RolloutChoices
from analysis.statistics.variance_reduction import controlled_means
from analysis.sweeps.cases import Case, Places
from analysis.sweeps.engine import Done, Finished, Job, run_cases
from analysis.sweeps.results import KEPT, figures_of, unit_of
from analysis.sweeps.store import Run, Store
from analysis.utils.notes import ProgressCallback
from planner.rollouts.closed_loop import compile_closed_loop

SettingName = TypeVar("SettingName")
Columns = dict[str, NDArray[np.float64]]
"""Float64 `[M]` by figure, M maps: means of each map's rollouts, with a control variate, or exact. "visited" and
"complete" are fractions, "losses" robots, "time" steps; "se": the standard error of "visited"; "exact": 1 where the
figures are known exactly."""
OfMap = tuple[NDArray[np.float64], NDArray[np.float64], bool]
"""Means and errors of `figures_of`, and whether they are exact."""
MAP_FIGURES = ("visited", "losses", "time", "complete")
EXACT_TEAM, EXACT_SECONDS = 2, 0.01
"""Robots whose tree takes about as long as some hundred rollouts (four take a second a map), and what it may take."""


class ByMap(Generic[SettingName]):
    """The figures of settings, map by map, as they come.

    Args:
        cases: of a map's number, its settings with the case of each. seed: of the first map and its rollouts.
        rollouts: of each map and setting. exact: whether the exact values of teams of up to EXACT_TEAM are looked for.
    """

    def __init__(
        self, cases: Callable[[int], Iterable[tuple[SettingName, Case]]], seed: int, rollouts: int, exact: bool = False
    ) -> None:
        self._cases, self._seed, self._rollouts, self._exact = cases, seed, rollouts, exact
        self._places = Places()
        self._under_way: dict[Case, tuple[SettingName, int]] = {}
        self._found: dict[SettingName, dict[int, OfMap]] = {}

    def run(
        self, maps: int, total: int, store: Store | None, progress: ProgressCallback | None, **where: Any
    ) -> Finished:
        """Run `maps` maps, `total` jobs, into the store if there is one.

        `where`: `processes` and `scheduler` of `run_cases`.
        """
        held = Store() if store is None else store

        def take(done: Done) -> None:
            setting, number = self._under_way.pop(done.job.case)
            run = held.run(done.keys[0])
            assert run is not None
            exact = self._exact_of(done.job.case, run)
            self._found.setdefault(setting, {})[number] = (*figures_of(run), False) if exact is None else exact
            if store is None:
                held.forget(done.keys)
            if progress is not None:
                progress(done.jobs, done.total, done.seconds)

        return run_cases(self._jobs(maps), held, total=total, progress=take, **where)

    def _jobs(self, maps: int) -> Iterator[Job]:
        """Map after map, so that an interruption leaves whole maps."""
        for number in range(maps):
            for setting, case in self._cases(number):
                self._under_way[case] = (setting, number)
                yield Job(case, (RolloutChoices(seed=self._seed + number),), self._rollouts)

    def _exact_of(self, case: Case, run: Run) -> OfMap | None:
        """The run's exact expectations, without errors; None if the team is too large, or its tree too expensive."""
        if not self._exact or case.robots is None or case.robots > EXACT_TEAM:
            return None
        team = self._places.team(case)
        tree = tree_of(compile_closed_loop(team.build(), team.world), EXACT_SECONDS)
        if tree is None:
            return None
        known = Known(tree)
        found = {name: known.mean(name) for name in ("visited", "survived", "time", "alive")}
        found["complete"] = known.chance("visited", len(tree.counts.visited) - 1)
        if any(one.se or one.half_width for one in found.values()):
            return None
        means, errors = figures_of(run)
        for name, place in KEPT.items():
            figure = name.removesuffix("_of_free")
            if figure in found:
                means[place], errors[place] = 0.0, 0.0
                means[place, 0] = found[figure].mean * unit_of(run, name)
        return means, errors, True

    def columns(self, settings: Sequence[SettingName]) -> dict[SettingName, Columns]:
        """Of the maps, from the first on, that all of these settings have; nothing if there is none."""
        whole = 0
        while settings and all(whole in self._found.get(setting, ()) for setting in settings):
            whole += 1
        return {
            setting: _columns([self._found[setting][n] for n in range(whole)], self._rollouts)
            for setting in settings
            if whole
        }


def _columns(maps: Sequence[OfMap], rollouts: int) -> Columns:
    means, errors, exact = (np.array(of_all) for of_all in zip(*maps, strict=True))
    names, freedom = ("visited", "alive", "time", "complete"), len(maps) * (rollouts - 1)
    found = {name: controlled_means(means[:, KEPT[name]], errors[:, KEPT[name]], freedom) for name in names}
    (visited, se), (alive, _), (time, _), (complete, _) = (found[name] for name in names)
    losses = means[:, KEPT["robots"], 0] - alive
    figures = {"visited": visited, "losses": losses, "time": time, "complete": complete}
    return figures | {"se": se, "exact": exact.astype(np.float64)}
