"""How much of the scatter is doubt about the map, and how much is the luck of a mission on it.

Mean coverage on each of the maps that may be true, one after the other: exact in the open loop, in the closed loop by
rollouts of the same luck on each. Asked for by itself where a world's map is uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.evaluation.outputs.output import Output, Run
from analysis.kit.tables import make_table
from analysis.kit.words import percent
from analysis.sampling import make_engine_for
from analysis.statistics.estimate import QUANTILES, spread
from analysis.theory.exact import open_loop_exact
from planner.files import Json
from planner.luck import true_map
from planner.worlds.doubt import Uncertain
from planner.worlds.world import World

MOST_MAPS = 64
"""Maps looked at in the closed loop; in the open loop of more than are drawn from a spread by level."""
LEAST, MOST = 256, 4096
"""Rollouts on each map in the closed loop: all maps together have about as many as the evaluation."""


@dataclass(frozen=True, eq=False)
class MapDoubt(Output):
    """Mean visited coverage by map.

    Attributes:
        means: float64 `[maps]`, fractions of the accessible cells, rising. rollouts: behind each; 0: it is exact.
        luck: standard deviation of single runs on one map, of the same unit.
    """

    means: NDArray[np.float64]
    rollouts: int
    luck: float

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        maps = list(maps_of(run.world, run.choices.seed, run.choices.loop == "open"))
        if not maps or run.certain:
            return
        run.doing("the maps one by one")
        cells, rollouts = run.last.tally.accessible, 0
        if run.choices.loop == "open":
            means = [open_loop_exact(run.plan, one).visited / cells for one in maps]
        else:
            rollouts = int(np.clip(run.last.tally.rollouts // len(maps), LEAST, MOST))
            engine = make_engine_for(run.world, run.plan, replace(run.choices, control=False), kept=run.kept)
            means = []
            for one in maps:
                tally = engine.under(one).tally(0, rollouts)
                means.append(float(tally.visited @ np.arange(cells + 1)) / rollouts / cells)
                run.progress(len(means), len(maps), 0.0)
        deviation = spread(run.last.tally.visited, 1.0 / cells, False).estimate.se * math.sqrt(run.last.tally.rollouts)
        luck = math.sqrt(max(deviation**2 - float(np.var(means)), 0.0))
        yield cls(np.sort(means), rollouts, luck)

    @property
    def quantiles(self) -> dict[str, float]:
        """Of the means over the maps."""
        return {f"{q:g}": float(np.quantile(self.means, q, method="inverted_cdf")) for q in QUANTILES}

    def as_json(self) -> Json:
        return {
            "maps": len(self.means),
            "mean_of_means": float(self.means.mean()),
            "quantiles": self.quantiles,
            "sd": {"maps": float(self.means.std()), "luck": self.luck},
            "rollouts": self.rollouts,
        }

    def table(self) -> Table:
        columns = ("maps", "mean of means", "5 % of maps", "median", "95 % of maps", "sd of maps", "sd of luck")
        table = make_table(columns, "Mean coverage by map, % visited: doubt about the map, apart from luck on it")
        shown = (self.means.mean(), *self.quantiles.values(), self.means.std(), self.luck)
        table.add_row(str(len(self.means)), *(f"{100 * value:.2f}" for value in shown))
        return table

    def sentences(self) -> Iterable[str]:
        low, _, high = map(percent, self.quantiles.values())
        how = "exact" if self.rollouts == 0 else f"{self.rollouts:,} rollouts of the same luck on each"
        yield (
            f"Which of the {len(self.means)} maps is true decides between {low} and {high} visited on average "
            f"(5 % to 95 % of maps, {how}): a standard deviation of {100 * self.means.std():.1f} points, beside "
            f"{100 * self.luck:.1f} points of luck from run to run."
        )


def maps_of(world: World, seed: int, all_of_them: bool) -> Iterator[World]:
    """The maps that may be true, as worlds: all, evenly chosen ones of many, or those of the first rollouts.

    None unless the world's map is uncertain.
    """
    doubt = world.doubt
    if not isinstance(doubt, Uncertain):
        return
    if doubt.whole:
        count = doubt.count if all_of_them else min(doubt.count, MOST_MAPS)
        maps = (doubt.threat_at((2 * place + 1) * doubt.count // (2 * count)) for place in range(count))
    else:
        maps = (true_map(doubt, seed, rollout) for rollout in range(MOST_MAPS))
    for threat in maps:
        yield replace(world, threat=threat, doubt=None)
