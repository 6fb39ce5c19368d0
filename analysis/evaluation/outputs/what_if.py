"""Sensitivity of a plan: to threats, to differences within the team, and to the uncertainty of the map.

With scaled threats robots plan and decide by the unscaled map: paths, areas, levels and costs stay, and only the threat
of each visit changes. The random numbers stay too. A robot that is lost at one scale is lost at every larger scale, as
long as it follows the same path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Sampled, TreeTruth, Trial
from analysis.evaluation.figures import Elements, Figures, Output, Run, against, team_table
from analysis.page.elements import CellLayer, Chart, Series
from analysis.sampling import make_engine_for, make_roll_out
from analysis.statistics.estimates import QUANTILES, Estimate
from analysis.statistics.variance_reduction import Components, known_between, of_means, of_values
from analysis.theory.exact import OpenLoopExact, coverage_gradient, open_loop_exact
from analysis.theory.verdicts import exact_truth
from analysis.utils.notes import of_things
from analysis.utils.tables import Column, in_percents, make_table, table_of
from planner.arguments import argument, is_real
from planner.errors import UsageError
from planner.files import Json
from planner.formatting import counted, in_percent, percent
from planner.make_plan import allocated_plan
from planner.plan.plan import Plan, is_certain
from planner.rollout_sampling import rows_met, true_map
from planner.rollouts.coverage_gradient import closed_loop_gradient
from planner.rollouts.engine import run_ranges
from planner.settings import Settings
from planner.tally import Tally
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

MOST_SCALES = 100
LARGEST_THREAT = float(np.nextafter(np.float32(1), np.float32(0)))


def scaled_threats(world: World, scale: float) -> World:
    """The world with every threat times `scale` >= 0; raises UsageError for an invalid scale or a threat >= 1."""
    if not (is_real(scale) and scale >= 0):
        raise UsageError(argument("threat_scale", scale), expected="numbers, 0 or above")
    threat = world.threat.astype(np.float64) * scale
    most = float(np.nanmax(world.threat)) if world.free.any() else 0.0
    if most * scale > LARGEST_THREAT:
        row, col = np.unravel_index(int(np.nanargmax(world.threat)), world.shape)
        named = argument("threat_scale", float(f"{scale:.10g}"))
        raise UsageError(
            f"{named}: the threat {most:g} of cell [{row}, {col}] would be {most * scale:.9g}",
            expected=f"at most {LARGEST_THREAT:.9g}: a scale of at most {LARGEST_THREAT / most:.9g}",
        )
    return replace(world, threat=threat.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Scaled:
    """The same plan and random numbers, with threats of `scale` times the map's.

    Attributes:
        scale: factor of the map's p. tally: of as many rollouts as the evaluation's, the same ids.
        exact: the open loop's closed form under those threats.
        certain: all runs are equal under those threats, so that there is one rollout.
        known: `exact` belongs to the evaluated loop, and the table shows it instead of the rollouts' means.
    """

    scale: float
    tally: Tally
    exact: OpenLoopExact
    certain: bool = False
    known: bool = False
    json_keys = """
        scale certain figures.coverage figures.complete figures.losses time.mean=figures.time.mean
        exact.open_loop.visited=exact.visited exact.open_loop.survived=exact.survived
    """

    @cached_property
    def figures(self) -> Figures:
        """Figures of these rollouts."""
        return Figures.of(self.tally, self.certain)

    @property
    def shown(self) -> Figures:
        """The figures of the table."""
        return self.figures.with_formulas(self.exact, None) if self.known else self.figures


@dataclass(frozen=True, eq=False)
class ThreatScale(Output):
    """The plan under scaled threats, in the order of the scales."""

    scaled: tuple[Scaled, ...] = ()

    @classmethod
    def check(cls, asked: Sequence[float], world: World) -> None:
        world.require_certain_map(argument("threat_scale"))
        if len(asked) > MOST_SCALES:
            raise UsageError(f"{argument('threat_scale')} has {len(asked)} scales", expected=f"{MOST_SCALES} at most")
        for scale in asked:
            scaled_threats(world, scale)

    @classmethod
    def measure(cls, asked: Sequence[float], run: Run) -> Iterator[Self]:
        found = cls()
        for scale in asked:
            run.doing(f"rollouts under {scale:g} times the threats")
            threats = scaled_threats(run.world, scale)
            certain = is_certain(threats, run.plan, run.choices.loop)
            count = 1 if certain else run.last.tally.rollouts
            few = replace(run.choices, rollouts=count, precision=None)
            for stage in make_roll_out(run.world, run.plan, few, threats, run.kept)(few, None):
                tally = stage.tally
                run.progress(tally.rollouts, count, stage.seconds)
            exact = open_loop_exact(run.plan, threats)
            known = run.choices.loop == "open"
            known = known or exact_truth(run.plan, threats, exact, run.choices.first_only) is not None
            found = cls((*found.scaled, Scaled(scale, tally, exact, certain, known)))
            yield found

    def to_json(self) -> tuple[Scaled, ...]:
        return self.scaled

    def elements(self) -> Elements:
        unit = 1.0 / self.scaled[0].tally.accessible
        columns = (
            Column("scale", lambda one: f"{one.scale:g}"),
            in_percents("visited, %", lambda one: one.shown.visited.mean.times(unit)),
            in_percents("survived, %", lambda one: one.shown.survived.mean.times(unit), ""),
            Column("every cell, %", lambda one: one.shown.complete.columns()[0]),
            Column("robots lost", lambda one: one.shown.losses),
            Column("time", lambda one: f"{one.shown.time.mean:.1f}"),
        )
        dropped = ("time", "every cell, %")
        return Elements(tables=[table_of(columns, self.scaled, "Results with scaled threats", dropped)])


# The cost of one more percent of threat in a cell, with the plan as it is.
#
# Open loop: the derivative of the closed form. Closed loop: the likelihood ratio on the evaluation's rollout ids, or
# the exact tree if it is complete. Its sums slow rollouts by a quarter to two thirds: it is measured only on request.


WORST = "A percentage point more of p costs most at {cell}: {cost:.3g} cells (standard error {se:.2g})."


@dataclass(frozen=True, eq=False)
class MarginalRisk(Output):
    """Cells lost for each percentage point of p added to a cell; the robots decide by the map as it is.

    Attributes:
        cost, se: float64 `[H, W]`, in cells, and its standard error (0: exact); NaN on obstacles, and in the closed
            loop where p = 0. how: the loop and its rollouts.
    """

    cost: NDArray[np.float64]
    se: NDArray[np.float64]
    how: str
    json_keys = "how cells=costs"

    @classmethod
    def check(cls, asked: bool, world: World) -> None:
        world.require_certain_map(argument("marginal_risk"))

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        plan, closed, loop = run.plan, run.closed, run.choices.loop
        if run.choices.first_only or not plan.failure_model.is_plain:
            problem = f"{argument('marginal_risk')} requires one p for all visits of a cell, each of them checked"
            raise UsageError(problem, fix="leave it out")
        run.doing("the cost of one more percent of threat in each cell")
        if loop == "open":
            cost = np.where(run.world.free, coverage_gradient(plan, run.world) / -100, np.nan)
            yield cls(cost, 0 * cost, "open loop, exact")
            return
        exact = closed is not None and (not isinstance(closed, TreeTruth) or closed.tree.left == 0)
        count = max(run.last.tally.rollouts, LEAST)
        found = closed_loop_gradient(run.world, plan, rollouts=count, seed=run.choices.seed, exact=exact)
        how = f"closed loop, {'exact' if exact else counted(count, 'rollout')}"
        yield cls(found.mean / -100, found.standard_error / 100, how)

    @cached_property
    def costs(self) -> list[Json]:
        """Row, column, cost and standard error of each cell with a cost, the largest first; None: unknown."""
        cells = np.argwhere(np.nan_to_num(self.cost) != 0).tolist()
        found = [{"cell": [*at], "cost": float(self.cost[*at]), "se": float(self.se[*at])} for at in cells]
        return sorted(found, key=lambda one: -one["cost"])

    def elements(self) -> Elements:
        about = f"Cells lost for each percentage point of p added to a cell, with the plan as it is; {self.how}."
        values = np.maximum(np.nan_to_num(self.cost), 0.0)
        layer = CellLayer("Marginal risk", about, values, "losses", root=True, blocks="sum")
        leads = [WORST.format(**one) for one in self.costs[:1]]
        return Elements(leads=leads, layers={"marginal_risk.png": lambda: layer})


# The cost or gain of differences within a team: the same team with equal robots, on common random numbers.

TEAM_MOST, FEW = 8192, 1024
"""Most rollouts of each team; and their number if all runs of the evaluated team are equal."""


@dataclass(frozen=True)
class Other:
    """A team with equal robots in one respect: its description, its figures, and the lead of the evaluated team."""

    description: str
    found: Sampled
    ahead: Estimate
    json_keys = "team=description *found ahead"


def alike(plan: Plan) -> dict[str, Settings]:
    """Settings of the same team with equal robots, by description; empty for a team of equal robots."""
    settings = plan.settings
    if settings is None or plan.state is not None:
        return {}
    types = settings.types if isinstance(settings.types, tuple) else ()
    several = dict.fromkeys(types) if len(set(types)) > 1 else ()
    found = {f"all of type {name}": replace(settings, types=name) for name in several}
    if min(settings.paces, default=0) == 1:  # otherwise the length of a step would change
        found["all as fast as the fastest"] = replace(settings, steps_per_move=None)
    if settings.radio is not None:
        found["with unlimited radio range"] = replace(settings, radio=None)
    return found


@dataclass(frozen=True, eq=False)
class EqualRobots(Output):
    """The team, and the variants of it with equal robots, on the same rollouts."""

    team: Sampled
    others: tuple[Other, ...]
    json_keys = "team.rollouts *team others"

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        world, plan, teams = run.world, run.plan, alike(run.plan)
        if not teams or run.choices.loop == "open":
            return
        # Only this team's runs are known to be equal.
        count = FEW if run.certain else min(run.last.tally.rollouts, TEAM_MOST)
        choices = replace(run.choices, rollouts=count, precision=None, seconds=None, exact="never", engine="numba")
        team, others = Trial(world, plan, choices).sample(0, count), []
        for said, settings in teams.items():
            run.doing(f"the same team, {said}")
            found = Trial(world, allocated_plan(world, plan.starts, settings), choices).sample(0, count)
            others.append(Other(said, found, team.covers_more(found)))
        yield cls(team, tuple(others))

    def elements(self) -> Elements:
        teams = {"this team": self.team} | {other.description: other.found for other in self.others}
        leads = [against(other.description.capitalize(), other.found, self.team) for other in self.others]
        notes = [f"equal robots: {counted(self.team.rollouts, 'rollout')} of each team, common random numbers"]
        table = team_table("Effect of the differences between robots", teams)
        return Elements(leads=leads, tables=[table], notes=notes)


# Components of the variance of coverage: between the possible maps, and between missions on one map.
#
# Closed loop: from the evaluation's own rollouts, whose maps are known (`analysis.statistics.variance_reduction`). If
# few rollouts share a map, maps are drawn as rollouts draw them, with independent random numbers on each. Open loop:
# the mean coverage on each map is exact. Measured automatically for a world with an uncertain map.

ENOUGH = 8
"""Fewest rollouts a map, on average, for which the evaluation's rollouts are used."""
LEAST, MAP_VARIANCE_MOST = 2**10, 2**20
"""Fewest and most of the evaluation's rollouts that are used."""
LEAST_MAPS, MOST_MAPS, EACH = 64, 1024, 16
"""Maps drawn if rollouts hardly share one, fewest and most, and closed-loop rollouts on each."""


@dataclass(frozen=True, eq=False)
class MapVariance(Output):
    """Mean visited coverage by map, in fractions of the accessible cells.

    Attributes:
        parts: standard deviations of the maps' means and of single runs on one map, and the means, sorted.
        of: number of possible maps; None: more than 2**53. rollouts: sample size; 0: the means are exact.
    """

    parts: Components
    of: int | None
    rollouts: int
    json_keys = """
        maps of mean_of_means quantiles sd.maps=parts.between.mean sd.random_numbers=parts.within.mean
        sd_ci95.maps=parts.between.ci95 sd_ci95.random_numbers=parts.within.ci95 rollouts
    """

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        uncertainty = run.world.uncertainty
        if not isinstance(uncertainty, Uncertain) or run.certain:
            return
        run.doing("the maps one by one")
        # Up to 2**53 the number of maps is exact as a float of JSON.
        count, numbers = uncertainty.count, len(np.unique(uncertainty.number[run.world.threat > 0]))
        of = count**numbers if numbers * np.log2(count) <= 53 else None
        rollouts = int(np.clip(run.last.tally.rollouts, LEAST, MAP_VARIANCE_MOST))
        if run.choices.loop == "open":
            yield cls(_exactly(run, uncertainty), of, 0)
        elif uncertainty.whole and rollouts >= ENOUGH * count:
            yield cls(_of_rollouts(run, uncertainty, rollouts), of, rollouts)
        else:
            yield cls(_of_drawn(run, uncertainty, maps := _maps(run)), of, maps * EACH)

    @property
    def means(self) -> NDArray[np.float64]:
        """float64 `[maps]`, sorted; their standard deviation is the estimate of the true means' one."""
        return self.parts.means

    @property
    def maps(self) -> int:
        """Number of maps in the sample."""
        return len(self.means)

    @property
    def mean_of_means(self) -> float:
        """The mean over the maps."""
        return float(self.means.mean())

    @property
    def quantiles(self) -> dict[str, float]:
        """Quantiles of the means over the maps."""
        return {f"{q:g}": float(np.quantile(self.means, q, method="inverted_cdf")) for q in QUANTILES}

    @property
    def behind(self) -> str:
        """The maps and the sample size, as text."""
        all_of = "" if self.of == self.maps else " drawn" + ("" if self.of is None else f" of {self.of:,}")
        how = "exact on each" if self.rollouts == 0 else counted(self.rollouts, "rollout")
        return f"{counted(self.maps, 'map')}{all_of}, {how}"

    def elements(self) -> Elements:
        columns = ("maps", "mean of means", "5 % of maps", "median", "95 % of maps", "sd between maps", "sd on one map")
        means = (in_percent(value, 2) for value in (self.mean_of_means, *self.quantiles.values()))
        scatter = (f"{100 * side.mean:.2f}" for side in (self.parts.between, self.parts.within))
        title = "Mean coverage by map, % visited: deviation between maps and between runs on a map"
        table = make_table(columns, title, [(str(self.maps), *means, *scatter)])
        note = (
            f"map uncertainty: {self.behind}; standard deviation between maps {_points(self.parts.between)}, "
            f"between runs on one map {_points(self.parts.within)} points"
        )
        return Elements(tables=[table], notes=[note], pictures={"map_variance.png": lambda: [self.chart()]})

    def chart(self) -> Chart:
        """Mean coverage over the share of maps with at most that coverage, with the deviation of single runs."""
        low, _, high = map(percent, self.quantiles.values())
        share, means = 100 * (np.arange(self.maps) + 0.5) / self.maps, self.means
        lower, upper = (100 * np.clip(means + side * self.parts.within.mean, 0, 1) for side in (-1, 1))
        return Chart(
            f"Mean coverage by true map: {low} to {high} (5 % to 95 % of {self.behind})",
            (Series("mean coverage on a map", share, 100 * means, lower, upper),),
            "share of the maps, %", "visited, % of the accessible cells", unit="%",
            interval="single runs on it, ± 1 sd",
        )  # fmt: skip


def _points(side: Estimate) -> str:
    low, high = (100 * end for end in side.ci95)
    return f"{100 * side.mean:.1f}" + (f" ({low:.1f} to {high:.1f}, 95 %)" if low < high else "")


def _maps(run: Run) -> int:
    return int(np.clip(run.last.tally.rollouts // EACH, LEAST_MAPS, MOST_MAPS))


def _exactly(run: Run, uncertainty: Uncertain) -> Components:
    """Components of the open loop: over all maps, or over some drawn by level."""
    tally = run.last.tally
    every = map(uncertainty.threat_at, range(uncertainty.count))
    maps = every if uncertainty.whole else _drawn(run, uncertainty, MOST_MAPS)
    means = [open_loop_exact(run.plan, replace(run.world, threat=one, uncertainty=None)).visited for one in maps]
    return known_between(np.array(means) / tally.accessible, uncertainty.whole, tally.visited)


def _of_rollouts(run: Run, uncertainty: Uncertain, count: int) -> Components:
    """Components from the evaluation's rollouts, and further ids if those are few, each with its own map."""
    engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept)
    parts, seconds = [], 0.0
    for start, size, found, took in run_ranges(engine.results, 0, count, unit=engine.least):
        parts.append(found.visited)
        seconds += took
        run.progress(start + size, count, seconds)
    maps = rows_met(uncertainty, run.choices.seed, np.arange(count))[:, 0]
    return of_values(maps, np.concatenate(parts) / run.last.tally.accessible, 1.0)


def _of_drawn(run: Run, uncertainty: Uncertain, maps: int) -> Components:
    """Components from drawn maps, with other random numbers on each: common ones would correlate their means."""
    engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept)
    values = np.empty((maps, EACH))
    for place, threat in enumerate(_drawn(run, uncertainty, maps)):
        one = engine.with_threat(replace(run.world, threat=threat, uncertainty=None))
        values[place] = one.results(place * EACH, EACH).visited / run.last.tally.accessible
        of_things(run.progress, "maps")(place + 1, maps, 0.0)
    return of_means(values.mean(axis=1), values.var(axis=1, ddof=1), EACH, 1.0)


def _drawn(run: Run, uncertainty: Uncertain, maps: int) -> Iterator[NDArray[np.float32]]:
    return (true_map(uncertainty, run.choices.seed, rollout) for rollout in range(maps))
