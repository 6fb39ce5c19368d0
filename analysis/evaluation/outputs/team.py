"""What it costs or is worth that the robots of a team differ: the same team, were they alike, on the same luck."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.kit.tables import make_table
from analysis.statistics.estimate import Estimate
from analysis.trials.measured import Sampled
from analysis.trials.trial import Trial
from planner.files import Json
from planner.mrac.make_plan import allocated_plan
from planner.plans.plan import Plan
from planner.settings import Settings
from planner.shown import counted, percent

MOST, FEW = 8192, 1024
"""Rollouts of each team, at most; and where every run of this team is the same."""


class Other(NamedTuple):
    """A team whose robots are alike in something, in words, and what it comes to."""

    said: str
    found: Sampled


def alike(plan: Plan) -> dict[str, Settings]:
    """The settings of the same team, were its robots alike, by what they then are; none where they are."""
    settings = plan.settings
    if settings is None or plan.state is not None:
        return {}
    types = settings.types if isinstance(settings.types, tuple) else ()
    several = dict.fromkeys(types) if len(set(types)) > 1 else ()
    found = {f"all of type {name}": replace(settings, types=name) for name in several}
    if min(settings.paces, default=0) == 1:  # else its steps would be others
        found["all as fast as the fastest"] = replace(settings, steps_per_move=None)
    if settings.radio is not None:
        found["that hear each other everywhere"] = replace(settings, radio=None)
    return found


@dataclass(frozen=True, eq=False)
class Mates(Output):
    """The team, and the others that it might be, on the same rollouts."""

    team: Sampled
    others: tuple[Other, ...]

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        world, plan, teams = run.world, run.plan, alike(run.plan)
        if not teams or run.choices.loop == "open":
            return
        count = min(run.last.tally.rollouts, MOST) if not run.certain else FEW  # that nothing happens is of this team
        choices = replace(run.choices, rollouts=count, precision=None, seconds=None, exact="never", engine="numba")
        team, others = Trial(world, plan, choices).sample(0, count), []
        for said, settings in teams.items():
            run.doing(f"the same team, {said}")
            one = allocated_plan(world, plan.starts, settings)
            others.append(Other(said, Trial(world, one, choices).sample(0, count)))
        yield cls(team, tuple(others))

    def ahead(self, other: Other) -> Estimate:
        """How much more of the cells the team visits than the other one."""
        return self.team.ahead(other.found, "visited", self._unit)

    @property
    def _unit(self) -> float:
        return 1.0 / self.team.largest("visited")

    def as_json(self) -> Json:
        return {
            "rollouts": self.team.rollouts,
            **self._figures(self.team),
            "others": [
                {"team": other.said, **self._figures(other.found), "ahead": self.ahead(other).to_json()}
                for other in self.others
            ],
        }

    def _figures(self, found: Sampled) -> Json:
        figures = {"coverage": found.mean("visited", self._unit), "losses": found.mean("lost")}
        return {name: value.to_json() for name, value in (figures | {"time": found.mean("time")}).items()}

    def blocks(self) -> Blocks:
        table = make_table(("robots", "visited %", "95 %", "lost", "steps"), "What their differences cost")
        leads = []
        for said, found in (("as they are", self.team), *self.others):
            visited, time = found.mean("visited", self._unit), f"{found.mean('time').mean:.1f}"
            table.add_row(said, *visited.columns(100.0, 100), found.mean("lost").columns()[0], time)
        for said, found in self.others:
            share, less = percent(found.mean("visited", self._unit).mean), self.ahead(Other(said, found))
            apart = less if less.mean > 0 else found.ahead(self.team, "visited", self._unit)
            words = f"{apart.said(100, ' points')} {'less' if less.mean > 0 else 'more'}"
            leads.append(f"Robots {said} would visit {share}: {words}.")
        notes = [f"robots that differ: {counted(self.team.rollouts, 'rollout')} of each team, common random numbers"]
        return Blocks(leads=leads, tables=[table], notes=notes)
