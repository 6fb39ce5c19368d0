"""What the map is worth to robots that are not told it: told, learning by what they see, and blind, on the same luck.

Everything but the sensor is alike: the team that is told the map sees all of it at once (SPEC section 15).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import inf, isinf
from typing import Self

import numpy as np

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.kit.tables import make_table
from analysis.page.cell_maps import CellLayer
from analysis.page.plan_layers import threat_layer
from analysis.page.series import Chart, Series
from analysis.statistics.coverage import more_said
from analysis.statistics.estimate import Estimate
from analysis.trials.measured import Measured, Sampled
from analysis.trials.told import only, told_of_drawn, with_eyes
from analysis.trials.trial import alike
from planner.arguments import argument, numbers_of
from planner.errors import UsageError
from planner.files import Json
from planner.plans.plan import Plan
from planner.shown import counted, percent
from planner.worlds.doubt import Uncertain
from planner.worlds.learning import seeing, with_sense
from planner.worlds.sight import RANGE, Sense
from planner.worlds.world import World

MOST_RANGES = 20
LEAST = 1024
"""Rollouts of each team, if the evaluation had so many, however many teams there are."""


def parse_ranges(text: str | None) -> tuple[float, ...]:
    """The ranges of "0,1,2,inf"; raises UsageError for what is no such list."""
    found = numbers_of("sense", text, 'ranges in cells, such as "0,1,2,inf"') if text is not None else ()
    if len(found) > MOST_RANGES:
        raise UsageError(f"{argument('sense')} has {len(found)} ranges", expected=f"{MOST_RANGES} at most")
    for one in found:
        if one != inf:
            RANGE.check("sense", one)
    return found


@dataclass(frozen=True, eq=False)
class Team:
    """What the team comes to if it sees so many cells far; `found`: on common random numbers as the others."""

    range: float
    found: Measured

    @cached_property
    def coverage(self) -> Estimate:
        """Visited on average, a fraction of the accessible cells."""
        return self.found.mean("visited", 1.0 / self.found.largest("visited"))

    def ahead(self, other: Team) -> Estimate:
        """How much more of the cells it visits."""
        return self.found.ahead(other.found, "visited", 1.0 / self.found.largest("visited"))

    def as_json(self) -> Json:
        """Its figures."""
        figures = {"coverage": self.coverage, "losses": self.found.mean("lost"), "time": self.found.mean("time")}
        return {"range": _shown(self.range)} | {name: value.to_json() for name, value in figures.items()}


def _sees(far: float) -> str:
    return "blind" if far == 0 else f"see {'everything' if isinf(far) else f'{far:g}'}"


def _shown(far: float) -> float | str:
    return "inf" if isinf(far) else far


@dataclass(frozen=True, eq=False)
class Knowledge(Output):
    """Teams with other eyes.

    Attributes:
        sense: the world's own. teams: by range, rising; the last one is told the map.
        believed: the map as robots think that it is before they see anything.
    """

    sense: Sense
    teams: tuple[Team, ...]
    believed: CellLayer

    @classmethod
    def check(cls, asked: Sequence[float], world: World) -> None:
        if world.knowledge is None:
            with_sense(world, 0)  # says why there is nothing to sense
            fix = "give a `truth` or a `prior`" if world.doubt is None else "give the scenario `sense: 0`"
            raise UsageError(argument("sense", ",".join(map(str, asked))), expected="a map that robots learn", fix=fix)
        for far in asked:
            seeing(world, far)

    @classmethod
    def measure(cls, asked: Sequence[float], run: Run) -> Iterator[Self]:
        world, known = run.world, run.world.knowledge
        if (
            known is None
            or run.choices.loop == "open"
            or (isinstance(world.doubt, Uncertain) and not world.doubt.whole)
        ):
            return
        blind = {0.0} if known.may_be_blind(world.free) else set()
        drawn = world.doubt is not None  # then who sees everything still plans before the first look
        ranges = sorted({*map(float, asked), *blind, known.sense.range, *([] if drawn else [inf])})
        done = run.last.tally.rollouts
        count = max(min(done, LEAST), done // len(ranges))
        choices = replace(run.choices, rollouts=count, precision=None, seconds=None, deadline=None)
        if run.closed is None:  # a tree that is too dear for the team itself is for the others too
            choices = replace(choices, exact="never")
        trials = []
        for far in ranges:
            run.doing(f"the same team, {_sees(far)}")
            trials.append(with_eyes(world, run.plan, far, choices))
        if drawn:
            run.doing("the same team, told which map is true")
            told, kept = told_of_drawn(world, run.plan, choices, count)
            found: Sequence[Measured] = [*(only(trial.sample(0, count), kept) for trial in trials), told]
        else:
            found = alike(trials, 0, count)
        yield cls(known.sense, tuple(map(Team, [*ranges, inf], found)), _believed(world, run.plan))

    @property
    def told(self) -> Team:
        """Robots that are told the map."""
        return self.teams[-1]

    @property
    def learning(self) -> Team:
        """The team that was evaluated."""
        return next(team for team in self.teams if team.range == self.sense.range)

    @property
    def blind(self) -> Team | None:
        """Robots that see nothing; None: they might run into what they do not believe."""
        return self.teams[0] if self.teams[0].range == 0 else None

    @property
    def behind(self) -> str:
        """What the figures rest on."""
        found = self.told.found
        return (
            f"{counted(found.rollouts, 'rollout')} of each, common random numbers"
            if isinstance(found, Sampled)
            else "exact"
        )

    def as_json(self) -> Json:
        learning, blind = self.learning, self.blind
        return {
            "known": self.told.as_json(),
            "learning": learning.as_json(),
            "blind": None if blind is None else blind.as_json(),
            "price_of_not_knowing": self.told.ahead(learning).to_json(),
            "worth_of_sensing": None if blind is None else learning.ahead(blind).to_json(),
            "steps": [
                {"from": one.range, "to": other.range, "worth": more.to_json()} for one, other, more in self.steps
            ],
            "curve": [team.as_json() | {"behind": self.told.ahead(team).to_json()} for team in self.teams],
            "rollouts": self.told.found.rollouts,
        }

    def blocks(self) -> Blocks:
        columns = ("robots that are", "visited %", "95 %", "told visit more", "lost", "steps")
        table = make_table(columns, "What knowing the map is worth")
        for team in self.teams:
            behind = "" if team is self.told else self.told.ahead(team).said(100, " points")
            lost, time = team.found.mean("lost"), team.found.mean("time")
            table.add_row(
                "told the map" if team is self.told else _sees(team.range),
                *team.coverage.columns(100.0, 100),
                behind,
                lost.columns()[0],
                f"{time.mean:.1f}",
            )
        note = f"what knowing the map is worth: {self.behind}"
        pictures = {} if len(self.teams) < 4 else {"sense.png": lambda: [self.chart()]}
        return Blocks(
            leads=list(self._leads()), tables=[table], notes=[note], pictures=pictures,
            below=[self.chart()] if pictures else [], layers={"believed.png": lambda: self.believed},
            settings={"knowledge": self.sense.said},
        )  # fmt: skip

    def _leads(self) -> Iterator[str]:
        learning, blind = self.learning, self.blind
        if learning is not self.told:
            price = more_said(self.told.ahead(learning), "not knowing it costs", "robots that are not told it visit")
            yield f"Robots that are told the map visit {percent(self.told.coverage.mean)}: {price}."
        if blind is not None and blind is not learning:
            worth = more_said(learning.ahead(blind), "to see is worth", "robots that see visit", "less")
            yield f"Robots that do not look visit {percent(blind.coverage.mean)}: {worth}."
        if steps := [
            f"{more.said(100, ' points')} from {near.range:g} to {far.range:g}" for near, far, more in self.steps
        ]:
            yield f"A better sensor, cells: {', '.join(steps)}."

    @property
    def steps(self) -> list[tuple[Team, Team, Estimate]]:
        """From each sensor to the next better one, where more than one was asked for, and what it covers more."""
        near = [team for team in self.teams if 0 < team.range < inf]
        return [(one, other, other.ahead(one)) for one, other in pairwise(near)]

    def chart(self) -> Chart:
        """Coverage over how far robots see."""
        near = [team for team in self.teams if not isinf(team.range)]
        seen = Series.of("by how far robots see", [team.range for team in near], [team.coverage for team in near])
        return Chart(
            "What is a better sensor worth?", (seen,), "how far a robot sees, cells", "visited, % of the cells",
            unit="%", at_y=((100 * self.told.coverage.mean, "told the map"),), x_whole=False, x_digits=1,
        )  # fmt: skip


def _believed(world: World, plan: Plan) -> CellLayer:
    same = world.knowledge is not None and world.knowledge.may_be_blind(world.free)
    dark = "They know the obstacles." if same else "Dark: the true obstacles, of which they believe otherwise."
    about = f"The chance that one visit stops a robot, as robots think before they see anything. {dark}"
    threat, (rows, cols) = world.threat.copy(), plan.starts.T
    threat[rows, cols] = np.nan_to_num(threat[rows, cols])  # nobody stands on an obstacle, whatever else is believed
    believed = replace(world, threat=threat, knowledge=None, doubt=None)
    return replace(threat_layer(believed, plan), name="As believed", about=about)
