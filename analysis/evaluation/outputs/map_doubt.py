"""How much of the scatter is doubt about the map, and how much is the luck of a mission on it.

Closed loop: from the evaluation's own rollouts, which know their map (`analysis.statistics.components`); where few of
them share one, from maps drawn as rollouts draw theirs, with luck of its own on each. Open loop: mean coverage on each
map is exact. Asked for by itself where a world's map is uncertain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.kit.notes import of_things
from analysis.kit.tables import make_table
from analysis.page.series import Chart, Series
from analysis.sampling import make_engine_for
from analysis.statistics.components import Components, known_between, of_means, of_values
from analysis.statistics.estimate import QUANTILES, Estimate
from analysis.theory.exact import open_loop_exact
from planner.files import Json
from planner.luck import rows_met, true_map
from planner.rollouts.blocks import run_ranges
from planner.shown import counted, in_percent, percent
from planner.worlds.doubt import Uncertain

ENOUGH = 8
"""Rollouts a map, on average, that make it known enough to take the rollouts as they are."""
LEAST, MOST = 2**10, 2**20
"""Of the evaluation's rollouts so many are looked at."""
LEAST_MAPS, MOST_MAPS, EACH = 64, 1024, 16
"""Maps that are drawn where rollouts hardly share one, and rollouts on each in the closed loop."""


@dataclass(frozen=True, eq=False)
class MapDoubt(Output):
    """Mean visited coverage by map, in fractions of the accessible cells.

    Attributes:
        parts: standard deviations of the maps' means and of single runs on one map, and the means, rising.
        of: maps that may be true; None: more than a file can count. rollouts: behind all of it; 0: means are exact.
    """

    parts: Components
    of: int | None
    rollouts: int

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        doubt = run.world.doubt
        if not isinstance(doubt, Uncertain) or run.certain:
            return
        run.doing("the maps one by one")
        count, numbers = doubt.count, len(np.unique(doubt.number[run.world.threat > 0]))
        of = count**numbers if numbers * np.log2(count) <= 53 else None
        if run.choices.loop == "open":
            yield cls(_exactly(run, doubt), of, 0)
        elif doubt.whole and (rollouts := int(np.clip(run.last.tally.rollouts, LEAST, MOST))) >= ENOUGH * count:
            yield cls(_of_rollouts(run, doubt, rollouts), of, rollouts)
        else:
            yield cls(_of_drawn(run, doubt, maps := _maps(run)), of, maps * EACH)

    @property
    def means(self) -> NDArray[np.float64]:
        """float64 `[maps]`, rising; they scatter as the true ones do."""
        return self.parts.means

    @property
    def luck(self) -> float:
        """Standard deviation of single runs on one map."""
        return self.parts.within.mean

    @property
    def quantiles(self) -> dict[str, float]:
        """Of the means over the maps."""
        return {f"{q:g}": float(np.quantile(self.means, q, method="inverted_cdf")) for q in QUANTILES}

    @property
    def behind(self) -> str:
        """Of which maps it speaks, and what it rests on, in words."""
        all_of = "" if self.of == len(self.means) else " drawn" + ("" if self.of is None else f" of {self.of:,}")
        return f"{counted(len(self.means), 'map')}{all_of}, " + (
            "exact on each" if self.rollouts == 0 else counted(self.rollouts, "rollout")
        )

    def as_json(self) -> Json:
        sides = {"maps": self.parts.between, "luck": self.parts.within}
        return {
            "maps": len(self.means),
            "of": self.of,
            "mean_of_means": float(self.means.mean()),
            "quantiles": self.quantiles,
            "sd": {name: side.mean for name, side in sides.items()},
            "sd_ci95": {name: list(side.ci95) for name, side in sides.items()},
            "rollouts": self.rollouts,
        }

    def blocks(self) -> Blocks:
        columns = ("maps", "mean of means", "5 % of maps", "median", "95 % of maps", "sd of maps", "sd of luck")
        table = make_table(columns, "Mean coverage by map, % visited: doubt about the map, apart from luck on it")
        means = (in_percent(value, 2) for value in (float(self.means.mean()), *self.quantiles.values()))
        scatter = (f"{100 * value:.2f}" for value in (self.parts.between.mean, self.luck))
        table.add_row(str(len(self.means)), *means, *scatter)
        note = (
            f"doubt about the map: {self.behind}; standard deviation of maps {_points(self.parts.between)}, "
            f"of luck {_points(self.parts.within)} points"
        )
        return Blocks(tables=[table], notes=[note], pictures={"doubt.png": lambda: [self.chart()]})

    def chart(self) -> Chart:
        """Mean coverage over the share of the maps on which it is at most that, beside the luck of single runs."""
        low, _, high = map(percent, self.quantiles.values())
        share, means = 100 * (np.arange(len(self.means)) + 0.5) / len(self.means), self.means
        lower, upper = (100 * np.clip(means + side * self.luck, 0, 1) for side in (-1, 1))
        return Chart(
            f"Which map is true: {low} to {high} on average (5 % to 95 % of {self.behind})",
            (Series("mean coverage on a map", share, 100 * means, lower, upper),),
            "share of the maps, %", "visited, % of the accessible cells", unit="%",
            interval="single runs on it, ± 1 sd of luck",
        )  # fmt: skip


def _points(side: Estimate) -> str:
    low, high = (100 * end for end in side.ci95)
    return f"{100 * side.mean:.1f}" + (f" ({low:.1f} to {high:.1f}, 95 %)" if low < high else "")


def _maps(run: Run) -> int:
    return int(np.clip(run.last.tally.rollouts // EACH, LEAST_MAPS, MOST_MAPS))


def _exactly(run: Run, doubt: Uncertain) -> Components:
    """Of the open loop: on all maps, or on some drawn from a spread by level."""
    tally = run.last.tally
    maps = map(doubt.threat_at, range(doubt.count)) if doubt.whole else _drawn(run, doubt, MOST_MAPS)
    means = [open_loop_exact(run.plan, replace(run.world, threat=one, doubt=None)).visited for one in maps]
    return known_between(np.array(means) / tally.accessible, doubt.whole, tally.visited)


def _of_rollouts(run: Run, doubt: Uncertain, count: int) -> Components:
    """Of the evaluation's rollouts, and further ids where those are few, each on the map that it met."""
    engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept)
    parts, seconds = [], 0.0
    for start, size, found, took in run_ranges(engine.results, 0, count, unit=engine.least):
        parts.append(found.visited)
        seconds += took
        run.progress(start + size, count, seconds)
    maps = rows_met(doubt, run.choices.seed, np.arange(count))[:, 0]
    return of_values(maps, np.concatenate(parts) / run.last.tally.accessible, 1.0)


def _of_drawn(run: Run, doubt: Uncertain, maps: int) -> Components:
    """Of maps drawn as rollouts draw theirs, other luck on each: what they share would hide in their means."""
    engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept)
    values = np.empty((maps, EACH))
    for place, threat in enumerate(_drawn(run, doubt, maps)):
        one = engine.under(replace(run.world, threat=threat, doubt=None))
        values[place] = one.results(place * EACH, EACH).visited / run.last.tally.accessible
        of_things(run.progress, "maps")(place + 1, maps, 0.0)
    return of_means(values.mean(axis=1), values.var(axis=1, ddof=1), EACH, 1.0)


def _drawn(run: Run, doubt: Uncertain, maps: int) -> Iterator[NDArray[np.float32]]:
    return (true_map(doubt, run.choices.seed, rollout) for rollout in range(maps))
