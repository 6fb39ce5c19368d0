"""What a plan comes to, exactly or sampled: two answers to the same questions.

`Known` is a tree of all that can happen (`planner.kernels.tree`), `Sampled` so many rollouts; means of both are
`Estimate`s, and a difference of two is exact, or on common luck. Which of the two it is, is asked in `trial.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import LEAST, tally_mean
from analysis.statistics.differences import CommonLuck, Paired, difference
from analysis.statistics.estimate import Estimate, exactly, proportion
from analysis.statistics.intervals import ROUNDING, chance_interval, mean_interval
from analysis.trials.exact_loop import SLACK
from analysis.trials.valuing import UNITS, mean_value
from planner.kernels.tree import WHOLE, Tree
from planner.rollouts.by_luck import luck_classes
from planner.tally import RolloutResults, Tally

Between = tuple[float, float]
"""The least and the most that a figure may be."""


@dataclass(frozen=True, eq=False)
class Known:
    """Exact figures: "visited" and "survived" cells, robots "alive" and "lost", "time" in steps, share of "value".

    Attributes:
        tree: of all that can happen. value: visited, a share of that of all free cells; None: nobody said what it is.
    """

    tree: Tree
    value: Between | None = None
    rollouts = 0
    exact = certain = True

    @property
    def counted(self) -> str:
        """The figure that is gone by: value where there is any, else cells."""
        return "visited" if self.value is None else "value"

    @property
    def share(self) -> float:
        """Of all cells, or of all value, that is visited on average."""
        low, high = self.between(self.counted)
        return (low + high) / 2 / self.largest(self.counted)

    def between(self, figure: str) -> Between:
        """The least and the most that the mean may be; alike but for what the tree left."""
        if figure == "value":
            assert self.value is not None
            return self.value
        if figure == "lost":
            low, high = self.tree.alive()
            return self.largest("lost") - high, self.largest("lost") - low
        return {"alive": self.tree.alive, "time": self.tree.time}.get(figure, lambda: self.tree.covered(figure))()

    def mean(self, figure: str, unit: float = 1.0, most: int | None = None) -> Estimate:
        """A mean, times `unit`."""
        return stated(self.between(figure), unit, self.largest(figure))

    def bounds(self, figure: str, doubt: float) -> Between:
        """What the mean lies between, whatever the `doubt`."""
        return self.between(figure)

    def chance(self, figure: str, needed: int) -> Estimate:
        """The chance that so many cells are "visited", or "survived"."""
        return stated(self.chance_bounds(figure, needed, 0.0), 1.0, 1.0)

    def chance_bounds(self, figure: str, needed: int, doubt: float) -> Between:
        """What that chance lies between."""
        return self.tree.chance_of(figure, needed)

    def ahead(self, base: Measured, figure: str, unit: float = 1.0) -> Estimate:
        """How much more of a figure than `base`, which is known too, times `unit`."""
        assert isinstance(base, Known)
        (low, high), (least, most), reach = self.between(figure), base.between(figure), self.largest(figure)
        apart = (low - most, high - least)
        if abs(sum(apart)) <= apart[1] - apart[0] + ROUNDING * reach:  # not told apart
            apart = (min(apart[0], 0.0), -min(apart[0], 0.0)) if apart[1] > apart[0] else (0.0, 0.0)
        return stated(apart, unit, 2 * reach)

    def by_step(self) -> NDArray[np.float64]:
        """Share of the cells visited by the end of each step on average, float64 `[T + 1]`."""
        return np.cumsum(self.tree.counts.new) / WHOLE / self.largest("visited")

    def largest(self, figure: str) -> float:
        """The most that a run may come to."""
        axis = {"lost": "alive", "survived": "visited"}.get(figure, figure)
        return 1.0 if axis == "value" else len(getattr(self.tree.counts, axis)) - 1.0


def stated(between: Between, unit: float, most: float) -> Estimate:
    """Exact where it is within SLACK of the `most` there is, else with what it lies between."""
    low, high = between
    mean = (low + high) / 2 * unit
    return exactly(mean) if high - low <= SLACK * most else Estimate(mean, 0.0, (low * unit, high * unit))


@dataclass(frozen=True, eq=False)
class Sampled:
    """The same figures of `n` rollouts, put right by their luck where that is by tolerance.

    Attributes:
        tally, results: of them; results may be left out where nothing is compared. seed: of luck by tolerance, or None.
        valued: the map has values. certain: every run is the same. seconds: that they took.
    """

    tally: Tally
    results: RolloutResults | None = None
    seed: int | None = None
    valued: bool = False
    certain: bool = False
    seconds: float = 0.0
    exact = False

    def __add__(self, other: Sampled) -> Sampled:
        assert self.results is not None
        assert other.results is not None
        both = RolloutResults.join([self.results, other.results])
        return Sampled(self.tally + other.tally, both, self.seed, self.valued, self.certain)

    @property
    def rollouts(self) -> int:
        """How many."""
        return self.tally.rollouts

    @property
    def counted(self) -> str:
        """As of `Known`."""
        return "value" if self.valued else "visited"

    @cached_property
    def share(self) -> float:
        """As of `Known`, as the rollouts say it."""
        return float(self.column(self.counted).mean()) / self.largest(self.counted)

    def column(self, figure: str) -> NDArray[np.int64]:
        """A figure of each rollout, int64 `[n]`; value in units of `analysis.trials.valuing`."""
        assert self.results is not None
        own = {"value": "worth_covered", "lost": "alive"}.get(figure, figure)
        found = getattr(self.results, own).astype(np.int64)
        return self.tally.robots - found if figure == "lost" else found

    def mean(self, figure: str, unit: float = 1.0, most: int | None = None) -> Estimate:
        """A mean, times `unit`, with its interval; `most`: of time, the longest run that is possible."""
        if figure != "value":
            return tally_mean(self.tally, figure, unit, most, self.certain)
        column, cells = self.column(figure), len(self.tally.covered_visited)
        return mean_value(column, unit, cells, self.certain, self._luck(column))

    def bounds(self, figure: str, doubt: float) -> Between:
        """What the mean lies between but for chance `doubt`, for any distribution (`mean_interval`)."""
        if self.certain:
            return self.mean(figure).ci95
        return mean_interval(self.tally.alive[::-1] if figure == "lost" else getattr(self.tally, figure), doubt)

    def chance(self, figure: str, needed: int) -> Estimate:
        """As of `Known`."""
        return proportion(self._often(figure, needed), self.rollouts, self.certain)

    def chance_bounds(self, figure: str, needed: int, doubt: float) -> Between:
        """What that chance lies between but for chance `doubt`."""
        if self.certain:
            return self.chance(figure, needed).ci95
        return chance_interval(self._often(figure, needed), self.rollouts, doubt)

    def _often(self, figure: str, needed: int) -> int:
        return int(getattr(self.tally, figure)[needed:].sum())

    def ahead(self, base: Measured, figure: str, unit: float = 1.0) -> Estimate:
        """How much more of a figure than `base` on the rollouts that both have, times `unit`."""
        assert isinstance(base, Sampled)
        n = min(self.rollouts, base.rollouts)
        less, more = base.column(figure)[:n], self.column(figure)[:n]
        one = unit / UNITS if figure == "value" else unit
        return difference(
            Paired.of(less, more), one, one, self.largest(figure) * one, self.certain and base.certain,
            self._luck(less, more),
        ).estimate  # fmt: skip

    def by_step(self) -> NDArray[np.float64]:
        """As of `Known`."""
        return np.cumsum(self.tally.new_visited) / (self.rollouts * self.tally.accessible)

    def largest(self, figure: str) -> float:
        """As of `Known`; of value, in units."""
        return float({"value": UNITS, "lost": self.tally.robots}.get(figure, self.tally.accessible))

    def _luck(self, *columns: NDArray[np.int64]) -> CommonLuck | None:
        """Sums of one column, or of two, by the luck of their rollouts; None of few, or of luck by step."""
        n = len(columns[0])
        if self.seed is None or n < LEAST:
            return None
        return CommonLuck.of(self.tally.robots, self._classes[:n], columns[0], columns[-1])

    @cached_property
    def _classes(self) -> NDArray[np.int64]:
        assert self.results is not None
        assert self.seed is not None
        return luck_classes(self.seed, self.results.start, self.rollouts, self.tally.robots)


Measured = Known | Sampled
"""What a plan comes to."""
