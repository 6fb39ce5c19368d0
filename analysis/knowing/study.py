"""A question's ways on the same random maps with the same luck, for teams of both rules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from analysis.kit.notes import Progress
from analysis.knowing.questions import QUESTIONS, Question, Setting, Team, settings_of
from analysis.statistics.estimate import Estimate, over_maps
from analysis.sweeps.by_map import ByMap, Columns
from analysis.sweeps.engine import Finished, Swept
from analysis.sweeps.store.store import Store
from analysis.sweeps.worlds import check_maps
from planner.worlds.generate import Kind


@dataclass(frozen=True, eq=False, repr=False)
class Study(Swept):
    """The answer.

    Attributes:
        question: what was compared. teams: that met it. columns: of each setting, map by map.
        rollouts: of each map and setting. seed: of the first map. finished: how the run ended.
    """

    reported_by = "analysis.knowing.report:report"

    question: Question
    teams: tuple[Team, ...]
    columns: dict[Setting, Columns]
    rollouts: int
    seed: int
    finished: Finished

    @property
    def maps(self) -> int:
        """Of every setting."""
        return len(next(iter(self.columns.values()))["visited"])

    def estimate(self, team: Team, way: str, figure: str = "visited") -> Estimate:
        """Mean over maps."""
        return over_maps(self._of(team, way)[figure])

    def apart(self, team: Team, one: str, other: str) -> Estimate:
        """Coverage by which one way is ahead of another, map by map."""
        return over_maps(self._of(team, one)["visited"] - self._of(team, other)["visited"])

    def gain(self, kind: Kind, robots: int, way: str) -> Estimate | None:
        """Coverage by which the question's last rule is ahead of the one before; None if one of them was not asked."""
        before, last = ((kind, robots, policy) for policy in self.question.policies[-2:])
        if not {before, last} <= set(self.teams):
            return None
        return over_maps(self._of(last, way)["visited"] - self._of(before, way)["visited"])

    def _of(self, team: Team, way: str) -> Columns:
        kind, robots, policy = team
        return self.columns[Setting(kind, way, robots, policy)]


def study_knowing(
    question: str,
    *,
    maps: int,
    rollouts: int,
    seed: int = 0,
    store: Store | None = None,
    teams: tuple[Team, ...] | None = None,
    progress: Progress | None = None,
    **where: Any,
) -> Study:
    """Run every setting of "online" or "moving" on `maps` maps; `store` and `where` as of `reproduce`.

    An interruption leaves the maps that are done; none: KeyboardInterrupt again. Raises InputError.
    """
    check_maps(maps, seed)
    asked = QUESTIONS[question]
    teams = asked.teams if teams is None else teams
    settings = settings_of(asked, teams)
    by_map = ByMap(lambda number: ((one, one.case(asked, seed + number)) for one in settings), seed, rollouts)
    finished = by_map.run(maps, maps * len(settings), store, progress, **where)
    columns = by_map.columns(settings)
    if not columns:
        raise KeyboardInterrupt
    return Study(asked, teams, columns, rollouts, seed, finished)
