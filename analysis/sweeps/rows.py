"""Rows of results: one setting each, its figures as means over maps, whoever made them (`sweep` or `results`)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import isfinite, nan

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import complete_chance, tally_mean
from analysis.statistics.estimate import Estimate
from analysis.statistics.pooled_control import BESIDE, beside_luck
from analysis.statistics.pooled_control import FIGURES as BESIDE_LUCK
from analysis.sweeps.cases import Label
from analysis.sweeps.store.store import Run
from analysis.sweeps.summary import Moments
from planner.limits import MAX_STEP
from planner.tally import Outcome, Tally, counts_by_word

FRACTIONS = ("visited", "survived", "visited_of_free", "survived_of_free")
FIGURES = (*FRACTIONS, "complete", "time", "alive")
"""What runs are summed up in: coverage as a fraction of the accessible or of the free cells, the fraction of rollouts
that covered everything, time in steps, robots alive at the end."""
EXACT = ("visited", "survived")
REACH = {"alive": "robots", "time": "longest"}
"""What a run says of how large a figure of its may be; coverage and chances are 1 at most."""
KEPT = {name: place for place, name in enumerate((*FIGURES, *(f"exact {n}" for n in EXACT), "ideal", *REACH.values()))}
"""Places of what a row's moments are of. `exact`: the open loop's values; `ideal`: of the team, as coverage is."""
DIFFERENCES = ("visited", "time")


@dataclass(eq=False)
class Row:
    """One setting's answer.

    Attributes:
        labels: what it is. rollouts: how many. outcomes: rollouts by the word of each. moments: of KEPT.
        apart: of DIFFERENCES, from the first row on the same maps, beside the luck of both. first: that row's moments.
        single: estimates of a single map's rollouts, by name (FIGURES); empty where there are several maps.
    """

    labels: dict[str, Label]
    rollouts: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    moments: Moments = field(default_factory=lambda: Moments(len(KEPT)))
    apart: Moments = field(default_factory=lambda: Moments(len(DIFFERENCES), 2 * BESIDE - 1))
    first: Moments | None = None
    single: dict[str, Estimate] = field(default_factory=dict)

    def add(
        self,
        means: NDArray[np.float64],
        errors: NDArray[np.float64],
        freedom: int,
        first: NDArray[np.float64] | None = None,
    ) -> None:
        """One more map, as of `Moments.add`; `first`: the first row's means on it."""
        self.moments.add(means, errors, freedom)
        if first is not None:
            here, there = (of[[KEPT[name] for name in DIFFERENCES]] for of in (means, first))
            self.apart.add(np.hstack([here[:, :1] - there[:, :1], here[:, 1:], there[:, 1:]]), 0.0)

    @property
    def maps(self) -> int:
        """How many."""
        return self.moments.maps

    def estimate(self, name: str) -> Estimate:
        """The mean of one of KEPT over maps, or of a figure over the rollouts of a single map."""
        return self.single.get(name) or self.moments.estimate(KEPT[name], 0.0, self.reach(name))

    def known(self, name: str) -> Estimate | None:
        """The mean over maps of one of KEPT that is known of a plan without rolling out; None where it is not."""
        found = self.estimate(name)
        return found if isfinite(found.mean) else None

    def reach(self, name: str) -> float:
        """How large a figure may be on a map like these."""
        return float(self.moments.mean[KEPT[REACH[name]], 0]) if name in REACH else 1.0

    def difference(self, name: str) -> Estimate | None:
        """What it has more of than the first row, "visited" or "time", on the maps that both have; None of that row."""
        if self.apart.maps < 2 or self.first is None or self.first is self.moments:
            return None
        reach, (mine, theirs) = self.reach(name), (of.weights(KEPT[name]) for of in (self.moments, self.first))
        weights = np.concatenate([mine, -theirs[1:]])
        return self.apart.estimate(DIFFERENCES.index(name), -reach, reach, weights)

    @property
    def within_share(self) -> float | None:
        """Share of the rollouts' noise in the variance of the map means of visited coverage."""
        return self.moments.within_share(KEPT["visited"])


def figures_of(run: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a run says about its map: means of KEPT beside its luck `[KEPT, L]`, and the covariances of their errors.

    Where the closed loop is known exactly, that, without an error.
    """
    facts, ideal = run.facts, run.facts["ideal_team"]
    assert run.sums is not None
    done = run.sums["outcomes"][Outcome.COMPLETE]
    sums = [(done, done) if name == "complete" else tuple(run.sums[name]) for name in BESIDE_LUCK]
    found = beside_luck(run.rollouts, sums, run.sums.get("luck", ()), facts["robots"])
    if is_exact(run):
        found = np.zeros_like(found[0]), np.zeros_like(found[1])
        found[0][:, 0] = [facts["closed_loop"][name] for name in BESIDE_LUCK]
    means, errors = (np.zeros((len(KEPT), *one.shape[1:])) for one in found)
    for name in FIGURES:
        place, unit = BESIDE_LUCK.index(name.removesuffix("_of_free")), unit_of(run, name)
        own = np.array([unit, *(1.0,) * (BESIDE - 1)])
        means[KEPT[name]], errors[KEPT[name]] = found[0][place] * own, found[1][place] * np.outer(own, own)
    known = [exact_of(run, name) for name in EXACT]
    known.append(nan if ideal is None else ideal / facts["cells"]["accessible"])
    means[len(FIGURES) :, 0] = [*known, facts["robots"], longest_of(run)]
    return means, errors


def is_exact(run: Run) -> bool:
    """Whether the means of its closed loop are known exactly."""
    return bool(run.facts.get("closed_loop"))


def outcomes_of(run: Run) -> Counter[str]:
    """Rollouts by the word of each outcome.

    Whether the deadline cut them off is among the run's facts; stores of 0.3 know a deadline only as a label.
    """
    deadline = "deadline" in run.facts or run.what.get("deadline") is not None
    return Counter(counts_by_word(() if run.sums is None else run.sums["outcomes"], deadline))


def figure_of(run: Run, name: str) -> tuple[float, float]:
    """(mean over a run's rollouts, square of that mean's standard error) of a figure; 0 for a single rollout."""
    assert run.sums is not None
    n = run.sums["rollouts"]
    if name == "complete":
        p = run.sums["outcomes"][0] / n
        return p, p * (1 - p) / max(n - 1, 1)
    first, second = run.sums[name.removesuffix("_of_free")]
    mean, unit = first / n, unit_of(run, name)
    scatter = (second * n - first * first) / n  # whole numbers: exact until divided
    return mean * unit, scatter / max(n - 1, 1) / n * unit * unit


def exact_of(run: Run, name: str) -> float:
    """The open loop's exact mean of a figure of a run; NaN if it is not known."""
    value = run.facts["exact"][name.removesuffix("_of_free")]
    return nan if value is None else float(value) * unit_of(run, name)


def unit_of(run: Run, name: str) -> float:
    """What one cell, step or robot of a figure counts."""
    if name not in FRACTIONS:
        return 1.0
    cells = run.facts["cells"]
    return 1.0 / float(cells["free" if name.endswith("_of_free") else "accessible"])


def longest_of(run: Run) -> int:
    """Steps that a rollout takes at most; T_max of as many levels as there may be where an older store does not say."""
    facts, cells = run.facts, run.facts["cells"]
    if "longest" in facts:
        return int(facts["longest"])
    return min(8 * (cells["dangerous"] + 1) * cells["accessible"] + 64 + facts["makespan"], MAX_STEP)


def single_map(run: Run, tally: Tally) -> dict[str, Estimate]:
    """Estimates of one run's rollouts, as `evaluate` makes them: they hold for rare events and do not collapse."""
    found = {"complete": complete_chance(tally)}
    for name in FIGURES:
        if name != "complete":
            most = longest_of(run) if name == "time" else None
            found[name] = tally_mean(tally, name.removesuffix("_of_free"), unit_of(run, name), most)
    return found
