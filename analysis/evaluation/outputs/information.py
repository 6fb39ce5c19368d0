"""The value of map information: the same team with a known map, learning with a sensor, and without a sensor.

The teams share their random numbers and differ only in the sensor. A known map is a sensor with unlimited range
(SPEC section 15).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from itertools import pairwise
from math import inf, isinf
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import only, sample_with_known_hazards, sample_with_known_maps, with_eyes
from analysis.estimators.trial import Measured, Sampled, Trial, alike
from analysis.evaluation.figures import Elements, Output, Run, against, team_table
from analysis.page.elements import CellLayer, Chart, Series
from analysis.statistics.estimates import Estimate
from analysis.utils.tables import Column
from planner.arguments import argument
from planner.errors import UsageError
from planner.formatting import counted
from planner.make_plan import allocated_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, final_odds
from planner.world.map_knowledge import Sensor, chance_of
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import World

MOST_RANGES = 20
LEAST = 1024
"""Rollouts of each team, if the evaluation had so many, for any number of teams."""


@dataclass(frozen=True, eq=False)
class Team:
    """The figures of the team with a sensor `range`, in cells; `found`: on common random numbers."""

    range: float
    found: Measured
    json_keys = "range=stated_range *found"

    @property
    def stated_range(self) -> float | str:
        """The range in cells; "inf": unlimited."""
        return "inf" if isinf(self.range) else self.range

    def ahead(self, other: Team) -> Estimate:
        """Mean visited coverage minus the other team's, a fraction of the accessible cells."""
        return self.found.covers_more(other.found)


@dataclass(frozen=True)
class OnCurve:
    """A team, and the coverage that it lacks of the team with a known map."""

    team: Team
    behind: Estimate
    json_keys = "*team behind"


@dataclass(frozen=True)
class Step:
    """Two neighbouring sensor ranges, and the gain in coverage from the first to the second."""

    near: Team
    far: Team
    gain: Estimate
    json_keys = "from=near.range to=far.range gain"


def _sees(far: float) -> str:
    return "no sensor" if far == 0 else f"sensor range {'unlimited' if isinf(far) else f'{far:g}'}"


@dataclass(frozen=True, eq=False)
class Knowledge(Output):
    """The team with other sensors, and with a known map.

    Attributes:
        sensor: the sensor of the world. teams: by ascending sensor range; the last one has a known map.
        believed: the prior map.
    """

    sensor: Sensor
    teams: tuple[Team, ...]
    believed: CellLayer
    json_keys = """
        known=known_map learning no_sensor price_of_not_knowing value_of_sensing steps curve
        rollouts=known_map.found.rollouts
    """

    @classmethod
    def check(cls, asked: Sequence[float], world: World) -> None:
        if world.knowledge is None:
            world.with_sensor_range(0)  # raises the more specific error
            drawn = world.uncertainty is not None
            fix = "give the scenario `sensor_range: 0`" if drawn else "give a `true_map` or a `prior_map`"
            raise UsageError(
                argument("sensor_range", ",".join(map(str, asked))), expected="a map that robots learn", fix=fix
            )
        if len(asked) > MOST_RANGES:
            raise UsageError(f"{argument('sensor_range')} has {len(asked)} ranges", expected=f"{MOST_RANGES} at most")
        for far in asked:
            world.with_range(far)

    @classmethod
    def measure(cls, asked: Sequence[float], run: Run) -> Iterator[Self]:
        world, known = run.world, run.world.knowledge
        by_level = isinstance(world.uncertainty, Uncertain) and not world.uncertainty.whole
        if known is None or run.choices.loop == "open" or by_level:
            return
        no_sensor = {0.0} if known.safe_without_sensor(world.free) else set()
        drawn = world.uncertainty is not None  # even with an unlimited range robots plan before they see
        ranges = sorted({*map(float, asked), *no_sensor, known.sensor.range, *([] if drawn else [inf])})
        done = run.last.tally.rollouts
        count = max(min(done, LEAST), done // len(ranges))
        choices = replace(run.choices, rollouts=count, precision=None, seconds=None, deadline=None)
        if run.closed is None:  # a tree too large for the team is too large for the others
            choices = replace(choices, exact="never")
        trials = []
        for far in ranges:
            run.doing(f"the same team, {_sees(far)}")
            trials.append(with_eyes(world, run.plan, far, choices))
        if drawn:
            run.doing("the same team, known map")
            known_map, kept = sample_with_known_maps(world, run.plan, choices, count)
            found: Sequence[Measured] = [*(only(trial.sample(0, count), kept) for trial in trials), known_map]
        else:
            found = alike(trials, 0, count)
        yield cls(known.sensor, tuple(map(Team, [*ranges, inf], found)), _believed(world, run.plan))

    @property
    def known_map(self) -> Team:
        """The team with a known map."""
        return self.teams[-1]

    @property
    def learning(self) -> Team:
        """The team that was evaluated."""
        return next(team for team in self.teams if team.range == self.sensor.range)

    @property
    def no_sensor(self) -> Team | None:
        """The team without a sensor; None: its robots might drive into unknown obstacles."""
        return self.teams[0] if self.teams[0].range == 0 else None

    @property
    def behind(self) -> str:
        """The source of the figures."""
        found = self.known_map.found
        sampled = f"{counted(found.rollouts, 'rollout')} of each, common random numbers"
        return sampled if isinstance(found, Sampled) else "exact"

    @property
    def price_of_not_knowing(self) -> Estimate:
        """Gain in coverage of a known map over learning."""
        return self.known_map.ahead(self.learning)

    @property
    def value_of_sensing(self) -> Estimate | None:
        """Gain in coverage of learning over no sensor; None without that team."""
        return None if self.no_sensor is None else self.learning.ahead(self.no_sensor)

    @property
    def curve(self) -> list[OnCurve]:
        """Every team."""
        return [OnCurve(team, self.known_map.ahead(team)) for team in self.teams]

    def elements(self) -> Elements:
        names = {_sees(team.range) if team is not self.known_map else "known map": team for team in self.teams}
        more = Column("known map: more", lambda name: "" if names[name] is self.known_map
                      else self.known_map.ahead(names[name]).describe(100, " points"))  # fmt: skip
        table = team_table("Value of map information", {name: team.found for name, team in names.items()}, more)
        pictures = {} if len(self.teams) < 4 else {"sense.png": lambda: [self.chart()]}
        return Elements(
            leads=list(self._leads()), tables=[table], notes=[f"value of map information: {self.behind}"],
            pictures=pictures, below=[self.chart()] if pictures else [],
            layers={"believed.png": lambda: self.believed}, settings={"knowledge": self.sensor.description},
        )  # fmt: skip

    def _leads(self) -> Iterator[str]:
        learning, no_sensor = self.learning, self.no_sensor
        if learning is not self.known_map:
            yield against("With a known map", self.known_map.found, learning.found)
        if no_sensor is not None and no_sensor is not learning:
            yield against("Without a sensor", no_sensor.found, learning.found)
        gain = "{} from {:g} to {:g}"
        if said := [gain.format(s.gain.describe(100, " points"), s.near.range, s.far.range) for s in self.steps]:
            yield f"Gain by sensor range, cells: {', '.join(said)}."

    @property
    def steps(self) -> list[Step]:
        """Each pair of neighbouring sensor ranges with the gain in coverage, if several ranges were requested."""
        near = [team for team in self.teams if 0 < team.range < inf]
        return [Step(one, other, other.ahead(one)) for one, other in pairwise(near)]

    def chart(self) -> Chart:
        """Coverage over the sensor range."""
        near = [team for team in self.teams if not isinf(team.range)]
        seen = Series.of("by sensor range", [team.range for team in near], [team.found.coverage for team in near])
        return Chart(
            "Coverage by sensor range", (seen,), "sensor range, cells", "visited, % of the cells",
            unit="%", at_y=((100 * self.known_map.found.coverage.mean, "known map"),),
        )  # fmt: skip


def _believed(world: World, plan: Plan) -> CellLayer:
    from analysis.page.maps import threat_layer

    same = world.knowledge is not None and world.knowledge.safe_without_sensor(world.free)
    dark = "The obstacles are known." if same else "Dark: true obstacles, which the prior map does not show."
    about = f"The probability that one visit destroys a robot, by the prior map. {dark}"
    threat, (rows, cols) = world.threat.copy(), plan.starts.T
    threat[rows, cols] = np.nan_to_num(threat[rows, cols])  # a start is free, whatever the prior map shows
    believed = replace(world, threat=threat, knowledge=None, uncertainty=None)
    return replace(threat_layer(believed, plan), name="Prior map", about=about)


# The value of learning about latent hazards: teams with known hazards, with learning, and without it, on common random
# numbers.
#
# With known hazards each rollout is planned for the hazards that it has. The posterior is the team's probability of a
# hazard in each cell at the end of a run; its entropy is the remaining uncertainty (SPEC section 15).

MOST, MOST_MAPS, MOST_ENDS = 8192, 128, 256
"""Most rollouts of each team, of known hazards (a plan each), and of those whose final posterior is averaged."""
BANDS = {
    "prior": "probability of a hazard in the cell before the mission",
    "posterior": "the team's probability of a hazard at the end of a run, mean over runs",
    "entropy": "uncertainty left at the end of a run, bits, mean over runs",
}


@dataclass(frozen=True)
class Bits:
    """Mean entropy of the reachable cells, bits a cell, before the mission and at its end."""

    before: float
    after: float


@dataclass(frozen=True, eq=False)
class Experience(Output):
    """Three teams, and their knowledge at the end.

    Attributes:
        known_hazards, learning, no_learning: the figures; `known_hazards` on the first of the others' rollouts.
        world: the world in which robots learn. reach: bool `[H, W]`, cells that robots can reach.
        posterior, entropy: float64 `[H, W]`, mean over `ends` runs; entropy in bits.
    """

    known_hazards: Measured
    learning: Measured
    no_learning: Measured
    world: World
    reach: NDArray[np.bool_]
    posterior: NDArray[np.float64]
    entropy: NDArray[np.float64]
    ends: int
    json_keys = """
        known_hazards learning no_learning price_of_not_knowing=price value_of_learning maps=known_hazards.rollouts
        learning.rollouts posterior.rollouts=ends posterior.entropy=bits
    """

    @classmethod
    def check(cls, asked: Any, world: World) -> None:
        if world.learned_hazard is None:
            fix = "give the scenario `latent_hazard: {..., learn: true}`"
            raise UsageError(argument("experience", asked), expected="robots that learn about hazards", fix=fix)

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        world, plan, hazard = run.world, run.plan, run.world.uncertainty
        if not isinstance(hazard, Hazard) or run.choices.loop == "open":
            return
        count = min(run.last.tally.rollouts, MOST)
        choices = replace(
            run.choices, rollouts=count, precision=None, seconds=None, deadline=None, exact="never", engine="numba"
        )
        run.doing("the same team, without learning")
        unaware = replace(world, uncertainty=replace(hazard, learn=False, detector=None))
        by_prior = allocated_plan(unaware, plan.starts, plan.require(world))
        no_learning = Trial(unaware, by_prior, choices).sample(0, count)
        learning = Trial(world, plan, choices).sample(0, count)
        run.doing("the same team, known hazards")
        known_hazards = sample_with_known_hazards(world, plan, choices, min(count, MOST_MAPS))
        run.doing("the posterior at the end")
        loop, ends = compile_closed_loop(plan, world), min(count, MOST_ENDS)
        prior = np.where(world.free, hazard.q, np.nan).astype(np.float64).ravel()
        posterior, entropy = prior.copy(), entropy_of(prior)
        if loop.learns:
            known = chance_of(final_odds(loop, choices.seed, 0, ends))
            posterior[loop.cells], entropy[loop.cells] = known.mean(axis=0), entropy_of(known).mean(axis=0)
        layers = (world.accessible(plan.starts), posterior.reshape(world.shape), entropy.reshape(world.shape))
        yield cls(known_hazards, learning, no_learning, world, *layers, ends)

    @property
    def prior(self) -> NDArray[np.float64]:
        """float64 `[H, W]`: probability of a hazard in each cell before the mission."""
        assert isinstance(self.world.uncertainty, Hazard)
        return self.world.uncertainty.q.astype(np.float64)

    @cached_property
    def price(self) -> Estimate:
        """Gain in coverage of known hazards over learning, a fraction of the cells."""
        return self.known_hazards.covers_more(self.learning)

    @cached_property
    def value_of_learning(self) -> Estimate:
        """Gain in coverage of learning over no learning, a fraction of the cells."""
        return self.learning.covers_more(self.no_learning)

    @property
    def bits(self) -> Bits:
        """Mean entropy of the reachable cells, bits a cell, before the mission and at its end."""
        return Bits(float(entropy_of(self.prior)[self.reach].mean()), float(self.entropy[self.reach].mean()))

    def elements(self) -> Elements:
        bits = self.bits
        runs = counted(self.known_hazards.rollouts, "run")
        leads = [
            against("Without learning", self.no_learning, self.learning),
            against(f"With known hazards, in {runs}", self.known_hazards, self.learning),
        ]
        notes = [
            f"value of learning: {counted(self.learning.rollouts, 'rollout')} of each, common random numbers; "
            f"known hazards: the first {self.known_hazards.rollouts:,}, a plan for each",
            f"uncertainty about hazards: {bits.before:.3f} bits a cell before the mission, {bits.after:.3f} at the end "
            f"of a run (mean of {self.ends:,})",
        ]
        files: dict[str, Callable[[], str | bytes]] = {}
        if find_spec("rasterio") is not None:
            from analysis.exporting import raster

            bands = np.stack([self.prior, self.posterior, self.entropy])
            files["posterior.tif"] = lambda: raster(self.world, BANDS, bands)
        layers = {"posterior.png": lambda: self._posterior(), "entropy.png": lambda: self._entropy()}
        teams = {"known hazards": self.known_hazards, "learning": self.learning, "no learning": self.no_learning}
        table = team_table("Value of learning about hazards", teams)
        return Elements(leads=leads, tables=[table], notes=notes, layers=layers, files=files)

    def _posterior(self) -> CellLayer:
        about = f"The team's probability of a hazard in the cell at the end of a run; mean of {self.ends:,} runs."
        values = np.nan_to_num(self.posterior)
        return CellLayer("Posterior of hazards", about, values, "losses", "%", root=True, digits=2, short="Posterior")

    def _entropy(self) -> CellLayer:
        about = f"Bits: 1 for a probability of one half, 0 for certainty. Mean of {self.ends:,} runs."
        return CellLayer("Uncertainty about hazards", about, np.nan_to_num(self.entropy), "covered", top=1.0,
                         labels=(0, 0.5, 1), short="Uncertainty")  # fmt: skip


def entropy_of(chance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Entropy in bits of a hazard with this probability; NaN for NaN."""
    sides = np.stack([chance, 1 - chance])
    return np.asarray(-(sides * np.log2(np.where(sides > 0, sides, 1))).sum(axis=0))
