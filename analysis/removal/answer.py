"""What a search for threats to clear holds: each threat, what is won without it, the picks and how sure they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices
from analysis.statistics.estimate import Estimate
from analysis.theory.exact import coverage_gradient
from planner.files import Json
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.settings import Settings
from planner.worlds.world import World

Remove = Literal["areas", "sources"]


@dataclass(frozen=True, eq=False)
class Threat:
    """What can be cleared: a connected area of danger, or a polygon, a point or a site of the scenario's threats.

    Attributes:
        name: of the area, or as the user's file says. cells: int64 `[n]` (indices).
        p: the largest chance that a visit stops, of it alone. thing: its number in `World.sources`; None: an area.
    """

    name: str
    cells: NDArray[np.int64]
    p: float
    thing: int | None = None

    def cleared(self, world: World) -> World:
        """The map without it; where others overlap it, with theirs."""
        if self.thing is not None and world.sources is not None:
            sources = world.sources.without(self.thing)
            return replace(world, threat=sources.threat(), sources=sources)
        threat = world.threat.copy()
        threat.reshape(-1)[self.cells] = 0.0
        threat.setflags(write=False)
        return replace(world, threat=threat)


@dataclass(frozen=True)
class Gain:
    """What is won on average: `cells` visited more, `robots` lost fewer, on the same `rollouts`.

    `value`: of visited cells, more; None where nobody said what they are worth.
    """

    cells: Estimate
    robots: Estimate
    rollouts: int
    value: Estimate | None = None

    @property
    def counted(self) -> Estimate:
        """What is gone by: value where there is any, else cells."""
        return self.cells if self.value is None else self.value

    def to_json(self) -> Json:
        """Cells, with value and robots beside them."""
        worth = {} if self.value is None else {"value": self.value.to_json()}
        return self.cells.to_json() | worth | {"robots": self.robots.to_json(), "rollouts": self.rollouts}


@dataclass(frozen=True, eq=False)
class Cleared:
    """A threat, and what clearing it is worth.

    Attributes:
        screen: how much the bound for every strategy rises, in cells (or value). hits: robots lost in it a run,
            as things are.
        known: for robots that plan anew; None: it was not simulated. unknown: for robots that do as before.
        behind: cells (or value) that the best gains more, an interval; all of one search hold together with 95 %.
    """

    threat: Threat
    screen: float
    hits: float
    unknown: Gain
    known: Gain | None = None
    behind: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Turn:
    """One threat picked: all that were left `options`, `pick` the place of the one that is cleared."""

    options: tuple[Cleared, ...]
    pick: int
    rolled: int

    @property
    def picked(self) -> Cleared:
        """What is cleared."""
        return self.options[self.pick]

    @property
    def simulated(self) -> tuple[Cleared, ...]:
        """Those that were planned for anew, the best first."""
        rest = [one for one in self.options if one.known is not None and one is not self.picked]
        return (self.picked, *sorted(rest, key=lambda one: -one.known.counted.mean if one.known else 0.0))

    @property
    def best_unknown(self) -> Cleared:
        """The one that is worth most to robots that do not know."""
        return max(self.options, key=lambda one: one.unknown.counted.mean)


@dataclass(frozen=True, eq=False, repr=False)
class Clearing(Answer):
    """The answer.

    Attributes:
        world, starts, settings: the map, the team int64 `[K, 2]`, what plans are made with. choices: what was rolled
            out: most rollouts of a threat, seed, the step at which every mission ends.
        remove: what threats are: "areas", or the "sources" of the scenario.
        turns: one for each threat that is cleared. cells: accessible cells. engine: that rolled out; "": all is exact.
        gain: of clearing all picks, on rollouts that had no part in the choice, ids from `choices.rollouts` on.
        partial: it was interrupted. notes: what a user should know.
    """

    listed = "threats"

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    choices: RolloutChoices
    remove: Remove
    turns: tuple[Turn, ...]
    cells: int
    engine: str
    gain: Gain | None = None
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Of gains."""
        return "cells" if self.world.value is None else "of value"

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
    def options(self) -> tuple[Cleared, ...]:
        """All threats, as the first to be cleared."""
        return self.turns[0].options

    def by_cell(self, gain_of: Callable[[Cleared], Gain | None]) -> NDArray[np.float64]:
        """What is gained by the first to be cleared that a cell is in, the most where several overlap, `[H, W]`."""
        gains = np.zeros(self.world.shape)
        for one in self.options:
            gain = gain_of(one)
            if gain is not None:
                own = one.threat.cells
                gains.reshape(-1)[own] = np.maximum(gains.reshape(-1)[own], gain.counted.mean)
        return gains

    @cached_property
    def plan(self) -> Plan:
        """Of the map as it is."""
        return make_plan(self.world, self.starts, self.settings)

    @cached_property
    def risk_paid(self) -> NDArray[np.float64]:
        """Cells lost on average for each percent of threat more in a cell, on the plan's paths, float64 `[H, W]`."""
        return -coverage_gradient(self.plan, self.world) / 100.0
