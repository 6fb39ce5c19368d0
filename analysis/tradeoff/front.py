"""What a front holds: settings with what they come to, which of them nothing beats, the pick and its plan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.kit.face import Answer
from analysis.sampling import RolloutChoices
from analysis.statistics.coverage import expected_losses
from analysis.statistics.estimate import Estimate, mean_estimate
from analysis.tradeoff.rules import Figures, Goal, Setting, efficient
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.settings import Settings
from planner.tally import Tally
from planner.worlds.world import World


@dataclass(frozen=True)
class Point:
    """A setting, and what it comes to: `coverage` visited, a fraction of the accessible cells; robots lost; steps.

    `value` visited, a fraction of what all free cells are worth; None: nobody said what that is.
    """

    setting: Setting
    coverage: Estimate
    losses: Estimate
    time: Estimate
    value: Estimate | None = None

    @property
    def figures(self) -> Figures:
        """The means."""
        return Figures(self.coverage.mean, self.losses.mean, self.time.mean)


@dataclass(frozen=True, eq=False, repr=False)
class Front(Answer):
    """The answer.

    Attributes:
        world, starts, settings: the map, the team int64 `[K, 2]`, and the planner's other settings.
        choices: what was rolled out: rollouts, seed, the step at which every mission ends.
        goal: what to pick by. points: the settings looked at. cells: accessible cells. engine: that rolled out.
        confirmed: the pick on as many rollouts that had no part in the choice, ids from `rollouts` on.
        words: of the command `evaluate` for this input, without the setting; empty in Python.
        partial: it was interrupted, and holds the settings that were done. notes: what a user should know.
    """

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    choices: RolloutChoices
    goal: Goal
    points: tuple[Point, ...]
    cells: int
    engine: str
    confirmed: Point | None = None
    words: tuple[str, ...] = ()
    partial: bool = False
    notes: tuple[str, ...] = ()

    @cached_property
    def efficient(self) -> tuple[bool, ...]:
        """Of each point, whether no other covers as much with as few robots lost in as little time, or better."""
        return tuple(efficient([point.figures for point in self.points]))

    @property
    def pick(self) -> int | None:
        """The place of the point that the goal picks; None: no goal, nothing meets it, or not all was looked at."""
        return None if self.partial else self.goal.pick([point.figures for point in self.points])

    @property
    def picked(self) -> Point | None:
        """The point itself."""
        return None if self.pick is None else self.points[self.pick]

    def cheapest(self, coverage: float, *families: str) -> Point | None:
        """The point that covers so much, or more, with the fewest robots lost; None if none covers so much."""
        of = [point for point in self.points if not families or point.setting.family in families]
        place = Goal(target=coverage).pick([point.figures for point in of])
        return None if place is None else of[place]

    def plan_of(self, point: Point) -> Plan:
        """The plan of a point; where its mission ends is not the plan's."""
        return make_plan(self.world, self.starts, settings_of(self.settings, point.setting))


def settings_of(settings: Settings, setting: Setting) -> Settings:
    """The planner's settings with the policy of a point, for robots that take over from each other."""
    policy, reserve, worth, _ = setting
    return replace(settings, policy=policy, reserve=reserve, worth=worth, plan_for="closed", effort=None)


def point_of(setting: Setting, tally: Tally, certain: bool, value: Estimate | None = None) -> Point:
    """What a tally says of a setting, and the value visited; `certain`: every run is the same."""
    return Point(
        setting,
        mean_estimate(tally.visited, 1.0 / tally.accessible, certain=certain),
        expected_losses(tally, certain),
        mean_estimate(tally.time, 1.0, bounded=False, certain=certain),
        value,
    )
