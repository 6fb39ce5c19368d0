"""What a front holds: settings with what they come to, which of them nothing beats, the pick and its plan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.report.searched import Searched
from analysis.statistics.estimate import Estimate
from analysis.tradeoff.rules import NEXT_TO_NONE, Figures, Goal, Setting, efficient, knee
from analysis.trials.measured import Measured
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.settings import Settings


@dataclass(frozen=True)
class Point:
    """A setting, and what it comes to: `coverage` visited, a fraction of the accessible cells; robots lost; steps.

    `value` visited, a fraction of what all free cells are worth; None: nobody said what that is. `least`, `most`: one
    bound each that coverage is not below, and that losses are not above, by chance `doubt` of `point_of`. `exact`: all
    of it is known, not sampled.
    """

    setting: Setting
    coverage: Estimate
    losses: Estimate
    time: Estimate
    value: Estimate | None
    least: float
    most: float
    exact: bool = False

    @property
    def figures(self) -> Figures:
        """The means."""
        return Figures(self.coverage.mean, self.losses.mean, self.time.mean)

    @property
    def sure(self) -> Figures:
        """The bounds in the place of the means: what a goal has to allow to be kept for sure."""
        return Figures(self.least, self.most, self.time.mean)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Front(Searched):
    """The answer; `words`: without the setting.

    Attributes:
        starts: of the team, int64 `[K, 2]`. goal: what to pick by. points: the settings looked at.
        pick: the place of the point that the goal picks; None: no goal, nothing is sure to keep it, or not all was
            looked at.
        confirmed: the pick on as many rollouts that had no part in the choice, ids from `rollouts` on. tried: so many
            settings were rolled out there, the best first, until one was sure to keep the limit: each with a chance of
            error of half the one before, so that the pick keeps it with 95 %.
        priced: without a goal: the settings that the headline speaks of on those other rollouts.
        plan_file: that the plan of the pick is written to; "" for none.
    """

    reported_by = "analysis.tradeoff.report:report"
    listed = "points"

    starts: NDArray[np.int64]
    goal: Goal
    points: tuple[Point, ...]
    pick: int | None = None
    confirmed: Point | None = None
    tried: int = 0
    priced: tuple[Point, ...] = ()
    plan_file: str = ""

    @cached_property
    def efficient(self) -> tuple[bool, ...]:
        """Of each point, whether no other covers as much with as few robots lost in as little time, or better."""
        return tuple(efficient([point.figures for point in self.points]))

    @cached_property
    def cheap(self) -> tuple[bool, ...]:
        """Of each point, whether no other covers as much with as few robots lost, or better, however long it takes."""
        return tuple(efficient([point.figures._replace(time=0.0) for point in self.points]))

    @property
    def picked(self) -> Point | None:
        """The point itself."""
        return None if self.pick is None else self.points[self.pick]

    def cheapest(self, coverage: float, *families: str) -> Point | None:
        """The point that covers so much, or more, with the fewest robots lost; None if none covers so much."""
        of = [point for point in self.points if not families or point.setting.family in families]
        place = Goal(target=coverage).pick([point.figures for point in of])
        return None if place is None else of[place]

    def corners(self) -> tuple[Point, ...]:
        """The setting that covers most at next to no robot lost, the one that covers most of all, and the knee between.

        Where each costs robots, the first is the one that loses the fewest. One alone where the first covers most.
        """
        most = max(self.points, key=lambda point: point.coverage.mean)
        fewest = min(point.losses.mean for point in self.points)
        free = [point for point in self.points if point.losses.mean <= max(fewest, NEXT_TO_NONE)]
        first = max(free, key=lambda point: (point.coverage.mean, -point.losses.mean))
        if most.coverage.mean <= first.coverage.mean:
            return (most,)
        place = knee([point.figures for point in self.points], first.figures, most.figures)
        return (first, most) if place is None else (first, self.points[place], most)

    def plan_of(self, point: Point) -> Plan:
        """The plan of a point; it ends the mission where the point does."""
        return make_plan(self.world, self.starts, settings_of(self.settings, point.setting))


def settings_of(settings: Settings, setting: Setting) -> Settings:
    """The planner's settings with the policy of a point, for robots that take over from each other."""
    return replace(settings, **setting._asdict(), plan_for="closed", effort=None)


def point_of(setting: Setting, found: Measured, cells: int, doubt: float, longest: int) -> Point:
    """A setting with what it comes to.

    `doubt`: the chance that either of its bounds is wrong, for any distribution: one end of `Sampled.bounds`.
    `longest`: steps that a run takes at most.
    """
    return Point(
        setting,
        found.mean("visited", 1.0 / cells),
        found.mean("lost"),
        found.mean("time", 1.0, longest if setting.deadline is None else min(longest, setting.deadline)),
        found.mean("value") if found.counted == "value" else None,
        found.bounds("visited", 2 * doubt)[0] / cells,
        found.bounds("lost", 2 * doubt)[1],
        found.exact,
    )
