"""The table: what everybody covers on every world, the score between a random walk and the bound, and the rank."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.judging.judge import estimate_of, scores_of, share_of
from analysis.report.answer import Answer
from analysis.statistics.estimate import Estimate

RANDOM = "random walk"


class Rolled(NamedTuple):
    """Cells visited and robots lost by rollout, int64 `[B]` each."""

    visited: NDArray[np.int64]
    lost: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Played:
    """A world and what everybody made of it.

    Attributes:
        robots: K. cells: accessible ones. bound: cells that no strategy exceeds on average, certified.
        optimum: the most that a strategy visits on average; None where that is not known.
        rolled: by name, rollout r of each on the same luck.
    """

    name: str
    robots: int
    cells: int
    bound: float
    optimum: float | None
    rolled: dict[str, Rolled]

    def coverage(self, entry: str) -> Estimate | None:
        """Mean visited coverage, a fraction of the accessible cells; None where it has not played."""
        return share_of(self.rolled[entry].visited, self.cells) if entry in self.rolled else None

    def lost(self, entry: str) -> float:
        """The share of the team that is lost on average."""
        return float(self.rolled[entry].lost.mean()) / self.robots

    @cached_property
    def scores(self) -> dict[str, NDArray[np.float64]]:
        """By name, float64 `[B]` as of `scores_of`; empty where the bound leaves no room above the random walk."""
        walk = self.rolled[RANDOM].visited / self.cells
        found = {
            name: scores_of(of.visited / self.cells, walk, self.bound / self.cells) for name, of in self.rolled.items()
        }
        return {name: scores for name, scores in found.items() if scores is not None}

    @property
    def first(self) -> set[str]:
        """Those that nobody is surely ahead of here: the best, and whose distance from it may be none."""
        best = max(self.rolled.values(), key=lambda of: float(of.visited.mean())).visited
        return {name for name, of in self.rolled.items() if _least(best - of.visited) <= 0}


def _least(apart: NDArray[np.int64]) -> float:
    return 0.0 if len(apart) < 2 else estimate_of(apart.astype(np.float64)).ci95[0]


@dataclass(frozen=True)
class Row:
    """An entry over all worlds.

    Attributes:
        rank: by its score, from 1; None where it has not played on all of them. worlds: on which it has.
        score: mean over these worlds of (J - J_random) / (bound - J_random). behind: of the first of all, common luck.
        coverage: mean over these worlds of what it visits. lost: of the share of the team that it loses.
        first: worlds on which nobody is surely ahead of it.
    """

    name: str
    rank: int | None
    worlds: int
    score: Estimate
    behind: Estimate | None
    coverage: float
    lost: float
    first: int


@dataclass(frozen=True, eq=False, repr=False)
class Standing(Answer):
    """Who stands where.

    Attributes:
        worlds: in the suite's order. rollouts, seed: of each. own: the name of the policy that was given.
        seconds: that it took. partial: it was interrupted: not all worlds that were asked for.
    """

    reported_by = "analysis.standings.report:report"
    listed = "entries"

    worlds: tuple[Played, ...]
    rollouts: int
    seed: int
    own: str | None
    seconds: float
    partial: bool = False

    @cached_property
    def entries(self) -> tuple[Row, ...]:
        """Everybody, the first first; then who has not played on all worlds."""
        names = list(dict.fromkeys(name for played in self.worlds for name in played.rolled))
        scores = {name: [played.scores[name] for played in self.worlds if name in played.scores] for name in names}
        mean = {name: np.mean(of, axis=0) for name, of in scores.items() if of}
        most = max(map(len, scores.values()), default=0)
        ranked = sorted((name for name in mean if len(scores[name]) == most), key=lambda name: -mean[name].mean())
        rank = {name: place for place, name in enumerate(ranked, start=1)}
        order = sorted(names, key=lambda name: rank.get(name, math.inf))
        return tuple(self._row(name, rank.get(name), mean.get(name), mean[ranked[0]] if ranked else None)
                     for name in order)  # fmt: skip

    def _row(self, name: str, rank: int | None, mean: NDArray | None, best: NDArray | None) -> Row:
        played = [one for one in self.worlds if name in one.rolled]
        coverage = float(np.mean([one.rolled[name].visited.mean() / one.cells for one in played]))
        unknown = Estimate(math.nan, math.nan, (math.nan, math.nan))
        return Row(
            name, rank, len(played), unknown if mean is None else estimate_of(mean),
            None if rank is None or mean is None or best is None else estimate_of(best - mean),
            coverage, float(np.mean([one.lost(name) for one in played])), sum(name in one.first for one in played),
        )  # fmt: skip
