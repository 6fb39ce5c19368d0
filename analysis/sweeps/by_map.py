"""Settings on the same random maps with the same luck: figures of each, map by map, to compare them map by map.

Map number i of every setting has the same seed, and so have its rollouts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress
from analysis.sampling import RolloutChoices
from analysis.statistics.control import tally_mean
from analysis.sweeps.cases import Case
from analysis.sweeps.engine import Done, Finished, Job, run_cases
from analysis.sweeps.store.store import Store
from planner.tally import Outcome, Tally

Setting = TypeVar("Setting")
Columns = dict[str, NDArray[np.float64]]
"""Float64 `[M]` by figure, M maps: means of each map's rollouts. "visited" and "complete" are fractions, "losses"
robots, "time" steps; "se": the standard error of "visited"."""
FIGURES = ("visited", "losses", "time", "complete")


class ByMap(Generic[Setting]):
    """The figures of settings, map by map, as they come.

    Args:
        cases: of a map's number, its settings with the case of each. seed: of the first map and its rollouts.
        rollouts: of each map and setting.
    """

    def __init__(self, cases: Callable[[int], Iterable[tuple[Setting, Case]]], seed: int, rollouts: int) -> None:
        self._cases, self._seed, self._rollouts = cases, seed, rollouts
        self._under_way: dict[Case, tuple[Setting, int]] = {}
        self._found: dict[Setting, dict[int, dict[str, float]]] = {}

    def run(self, maps: int, total: int, store: Store | None, progress: Progress | None, **where: Any) -> Finished:
        """Run `maps` maps, `total` jobs, into the store if there is one.

        `where`: `processes` and `scheduler` of `run_cases`.
        """
        held = Store.memory() if store is None else store

        def take(done: Done) -> None:
            setting, number = self._under_way.pop(done.job.case)
            tally = held.tally(done.keys[0])
            assert tally is not None
            self._found.setdefault(setting, {})[number] = _columns(tally)
            if progress is not None:
                progress(done.jobs, done.total, done.seconds)

        return run_cases(self._jobs(maps), held, total=total, progress=take, **where)

    def _jobs(self, maps: int) -> Iterator[Job]:
        """Map after map, so that an interruption leaves whole maps."""
        for number in range(maps):
            for setting, case in self._cases(number):
                self._under_way[case] = (setting, number)
                yield Job(case, (RolloutChoices(seed=self._seed + number),), self._rollouts)

    def columns(self, settings: Sequence[Setting]) -> dict[Setting, Columns]:
        """Of the maps, from the first on, that all of these settings have; nothing if there is none."""
        whole = 0
        while settings and all(whole in self._found.get(setting, ()) for setting in settings):
            whole += 1
        return {
            setting: {
                figure: np.array([self._found[setting][n][figure] for n in range(whole)]) for figure in (*FIGURES, "se")
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
