"""What could be better: another policy that covers more on this map, without losing more robots.

The other policy is rolled out for the ids 0 .. 4,095, and so is the plan once more: on the same luck the difference is
sharp. Nothing is said unless all of its interval lies above 0, and then only if no more robots are seen to be lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Self

from analysis.evaluation.outputs.output import Output, Run
from analysis.sampling import make_engine_for
from analysis.statistics.control import Paired, difference
from analysis.statistics.estimate import Estimate
from planner.arguments import argument
from planner.errors import PlanError, WorldError
from planner.files import Json
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.policies import DEFAULT
from planner.policies.in_area import cheapest_first
from planner.rollouts.blocks import run_ranges
from planner.tally import RolloutResults

ROLLOUTS = 4096
"""Of the other policy."""
LONG_RUN = 20_000
"""Rollouts of a run beside which they are few."""
OTHER = "per_cell"


@dataclass(frozen=True)
class Advice(Output):
    """The policy that covers more.

    Attributes:
        policy: its name. coverage: its mean coverage minus the plan's, a fraction of the accessible cells.
        losses: its robots lost minus the plan's.
    """

    policy: str
    coverage: Estimate
    losses: Estimate

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        if not _has_another(run) or run.certain or run.last.tally.rollouts < LONG_RUN:
            return
        run.doing(f"would {OTHER} cover more?")
        try:
            settings = replace(run.plan.require(run.world), policy=OTHER)
            found = cls._on_the_same_luck(run, make_plan(run.world, run.plan.starts, settings, run.plan.areas))
        except (PlanError, WorldError):  # costs, or an engine, that have no room for the other policy
            return
        if found.coverage.ci95[0] > 0 >= found.losses.ci95[0]:
            yield found

    @classmethod
    def _on_the_same_luck(cls, run: Run, other: Plan) -> Self:
        choices = replace(run.choices, control=False)
        mine, theirs = (make_engine_for(run.world, plan, choices, kept=run.kept) for plan in (run.plan, other))
        robots = len(run.plan.robots)
        visited, lost, seconds = Paired(), Paired(), 0.0

        def both(start: int, count: int) -> tuple[RolloutResults, RolloutResults]:
            return mine.results(start, count), theirs.results(start, count)

        for start, count, (a, b), took in run_ranges(both, 0, ROLLOUTS, unit=max(mine.least, theirs.least)):
            visited += Paired.of(a.visited, b.visited)
            lost += Paired.of(robots - a.alive, robots - b.alive)
            seconds += took
            run.progress(start + count, ROLLOUTS, seconds)
        cell = 1.0 / run.last.tally.accessible
        more, losses = difference(visited, cell, cell, 1.0), difference(lost, 1.0, 1.0, float(robots))
        return cls(OTHER, more.estimate, losses.estimate)

    def as_json(self) -> Json:
        return {"policy": self.policy, "reserve": None, "worth": None, "difference": self.coverage.to_json()}

    def footnotes(self) -> Iterable[str]:
        low, high = self.losses.ci95
        yield (
            f"{argument('policy', self.policy)} covers {self.coverage.said(100, ' points')} more on this map; "
            f"robots lost: {self.losses.mean:+.3f} ({low:+.3f} .. {high:+.3f}); "
            f"{ROLLOUTS:,} rollouts on the same luck. `mrac-jax front` says what else there is."
        )


def _has_another(run: Run) -> bool:
    """Whether it is the closed loop of a plan of ours by the paper's policy."""
    settings = run.plan.settings
    return (
        run.choices.loop == "closed"
        and settings is not None
        and run.plan.state is None
        and settings.plan_for == "closed"
        and settings.policy == DEFAULT
        and settings.in_area is cheapest_first
    )
