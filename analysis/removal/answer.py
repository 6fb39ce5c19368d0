"""What a search for threats to clear holds: each threat, what it costs, the picks and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.removal.threat import Gain, Threat, Turn, Weighed
from analysis.report.searched import Searched
from analysis.theory.exact import coverage_gradient
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.worlds.world import World

Remove = Literal["areas", "sources"]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Weighing(Searched):
    """What the answers to both searches for threats hold; `starts`: of the team, int64 `[K, 2]`."""

    listed = "threats"

    starts: NDArray[np.int64]

    @property
    def unit(self) -> str:
        """Of what a threat costs."""
        return "cells" if self.world.value is None else "of value"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Clearing(Weighing):
    """The answer to what to clear first.

    Attributes:
        remove: what threats are: "areas", or the "sources" of the scenario.
        turns: one for each threat that is cleared.
        gain: of clearing all picks, on rollouts that had no part in the choice, ids from `choices.rollouts` on.
    """

    reported_by = "analysis.removal.report:report"

    remove: Remove
    turns: tuple[Turn, ...]
    gain: Gain | None = None

    @property
    def picks(self) -> tuple[Threat, ...]:
        """What to clear, in this order."""
        return tuple(turn.picked.threat for turn in self.turns)

    @property
    def cleared_world(self) -> World:
        """The map without them."""
        world = self.world
        for threat in self.picks:
            world = threat.cleared(world)
        return world

    @property
    def options(self) -> tuple[Weighed, ...]:
        """All threats, as the first to be cleared."""
        return self.turns[0].options

    @cached_property
    def plan(self) -> Plan:
        """Of the map as it is."""
        return make_plan(self.world, self.starts, self.settings)

    @cached_property
    def risk_paid(self) -> NDArray[np.float64]:
        """Cells lost on average for each percent of threat more in a cell, on the plan's paths, float64 `[H, W]`."""
        return -coverage_gradient(self.plan, self.world) / 100.0
