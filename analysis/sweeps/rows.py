"""Rows of results: one setting each, its figures as means over maps, whoever made them (`sweep` or `results`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.control import complete_chance, tally_mean
from analysis.statistics.estimate import Estimate
from analysis.sweeps.cases import Label
from analysis.sweeps.store.store import Run
from analysis.sweeps.summary import FIGURES, Moments, exact_of, figure_of, unit_of
from planner.limits import MAX_STEP
from planner.tally import Tally

EXACT = ("visited", "survived")
DIFFERENCES = ("visited", "time")
REACH = {"alive": "robots", "time": "longest"}
"""What a run says of how large a figure of its may be; coverage and chances are 1 at most."""
KEPT = (
    *FIGURES,
    *(f"exact {name}" for name in EXACT),
    "ideal",
    *REACH.values(),
    *(f"difference {name}" for name in DIFFERENCES),
)
"""Moments of a row by name. `exact`: the open loop's; `difference`: from the first row, on the same maps."""
NUMBERS = 5
"""Numbers of a Moments."""


@dataclass(frozen=True, eq=False)
class Row:
    """One setting's answer.

    Attributes:
        labels: what it is. maps, rollouts, timeouts: how many. moments: by name (KEPT).
        single: estimates of a single map's rollouts, by name (FIGURES); empty where there are several maps.
    """

    labels: dict[str, Label]
    maps: int
    rollouts: int
    timeouts: int
    moments: dict[str, Moments]
    single: dict[str, Estimate] = field(default_factory=dict)

    def estimate(self, name: str) -> Estimate:
        """A figure's mean over maps, or over the rollouts of a single map."""
        return self.single[name] if name in self.single else self.moments[name].estimate(0.0, self.reach(name))

    def reach(self, name: str) -> float:
        """How large a figure may be on a map like these."""
        return self.moments[REACH[name]].mean if name in REACH else 1.0

    def exact(self, name: str) -> Estimate:
        """The open loop's exact value, "visited" or "survived": a mean over maps."""
        return self.moments[f"exact {name}"].estimate(0.0, 1.0)

    def difference(self, name: str) -> Estimate | None:
        """What it has more of than the first row, "visited" or "time", on the maps that both have."""
        moments = self.moments[f"difference {name}"]
        reach = self.reach(name)
        return moments.estimate(-reach, reach) if moments.maps > 1 else None

    @property
    def ideal(self) -> Estimate:
        """The ideal of the team, a fraction of the accessible cells."""
        return self.moments["ideal"].estimate(0.0, 1.0)

    @property
    def within_share(self) -> float | None:
        """Share of the rollouts' noise in the variance of the map means of visited coverage."""
        return self.moments["visited"].within_share


def figures_of(run: Run) -> dict[str, tuple[float, float]]:
    """(mean, squared standard error) of everything that a run says about its map, by name; no differences."""
    found = {name: figure_of(run, name) for name in FIGURES}
    found |= {f"exact {name}": (exact_of(run, name), 0.0) for name in EXACT}
    ideal = run.facts["ideal_team"]
    found["ideal"] = (nan if ideal is None else ideal / run.facts["cells"]["accessible"], 0.0)
    return found | {"robots": (float(run.facts["robots"]), 0.0), "longest": (float(longest_of(run)), 0.0)}


def longest_of(run: Run) -> int:
    """Steps that a rollout takes at most; T_max of as many levels as there may be where an older store does not say."""
    facts, cells = run.facts, run.facts["cells"]
    if "longest" in facts:
        return int(facts["longest"])
    return min(8 * (cells["dangerous"] + 1) * cells["accessible"] + 64 + facts["makespan"], MAX_STEP)


def moments_of(row: NDArray[np.float64]) -> Moments:
    """Moments from the numbers that `put` keeps."""
    maps, mean, scatter, lean, within = row.tolist()
    return Moments(int(maps), mean, scatter, lean, within)


def put(row: NDArray[np.float64], mean: float, squared_error: float) -> None:
    """Add a map to moments that are kept as numbers, float64 `[NUMBERS]`: 40 bytes instead of a few hundred."""
    moments = moments_of(row)
    moments.add(mean, squared_error)
    row[:] = (moments.maps, moments.mean, moments.scatter, moments.lean, moments.within)


def single_map(run: Run, tally: Tally) -> dict[str, Estimate]:
    """Estimates of one run's rollouts, as `evaluate` makes them: they hold for rare events and do not collapse."""
    found = {}
    for name in FIGURES:
        if name == "complete":
            found[name] = complete_chance(tally)
        else:
            most = longest_of(run) if name == "time" else None
            found[name] = tally_mean(tally, name.removesuffix("_of_free"), unit_of(run, name), most)
    return found
