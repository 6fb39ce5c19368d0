"""Threats, and what each costs: what `clear` takes away and what an adversary places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.estimate import Estimate
from planner.files import Json
from planner.worlds.sources import Sources, Thing, Things
from planner.worlds.world import World

EVEN = 0.05
"""Robots lost more or fewer that are called none."""


@dataclass(frozen=True, eq=False)
class Threat:
    """A connected area of danger, or a polygon, a point or a site of the scenario's threats; or a cell to threaten.

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

    def placed(self, world: World) -> World:
        """The map with it too, combined with what is there as its scenario says, else as independent threats.

        Its `sources` are what was placed, each to be cleared again, and the map as it was before.
        """
        sources = world.sources
        if sources is None or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
            combine = "product" if sources is None else sources.combine
            sources = Sources(combine, world.free, (np.nan_to_num(world.threat.astype(np.float64)),))
        thing = Thing(self.name, self.name, np.arange(len(self.cells)), np.full(len(self.cells), self.p))
        sources = replace(sources, layers=(*sources.layers, Things((thing,), self.cells)))
        return replace(world, threat=sources.threat(), sources=sources)


@dataclass(frozen=True)
class Gain:
    """What is won on average without a threat: `cells` visited more, `robots` lost fewer, on the same `rollouts`.

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

    def said(self, more: str) -> str:
        """Beside the figure that is gone by: cells that are `more` or fewer, if that is value, and robots lost."""
        words = ("more", "fewer") if more == "more" else ("fewer", "more")
        cells = "" if self.value is None else f"{self.cells.more(unit=' cells', words=words)}, "
        even = max(map(abs, self.robots.ci95))
        if even < EVEN:
            return f"{cells}as many robots lost" + (f" (± {even:.1g})" if even >= EVEN / 10 else "")
        lost = self.robots if self.robots.mean >= 0 else self.robots.negated
        return f"{cells}{lost.said()} robots lost {words[self.robots.mean >= 0]}"

    def to_json(self) -> Json:
        """Cells, with value and robots beside them."""
        worth = {} if self.value is None else {"value": self.value.to_json()}
        return self.cells.to_json() | worth | {"robots": self.robots.to_json(), "rollouts": self.rollouts}


@dataclass(frozen=True, eq=False)
class Weighed:
    """A threat, and what it costs.

    Attributes:
        screen: how much higher the bound for every strategy is without it, in cells (or value); None: it was not
            asked. hits: robots lost in it a run, as things are.
        known: for robots that plan anew; None: it was not simulated. unknown: for robots that do as before.
        behind: cells (or value) that the best costs more, an interval; all of one search hold together with 95 %.
    """

    threat: Threat
    screen: float | None
    hits: float
    unknown: Gain
    known: Gain | None = None
    behind: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Turn:
    """One threat picked: all that were left `options`, `pick` the place of the one that costs most."""

    options: tuple[Weighed, ...]
    pick: int
    rolled: int

    @property
    def picked(self) -> Weighed:
        """What was picked."""
        return self.options[self.pick]

    @property
    def simulated(self) -> tuple[Weighed, ...]:
        """Those that were planned for anew, the best first."""
        rest = [one for one in self.options if one.known is not None and one is not self.picked]
        return (self.picked, *sorted(rest, key=lambda one: -one.known.counted.mean if one.known else 0.0))

    @property
    def best_unknown(self) -> Weighed:
        """The one that costs robots most that do not know."""
        return max(self.options, key=lambda one: one.unknown.counted.mean)

    def certainty(self, more: str) -> str:
        """A sentence: than how many others the pick is surely `more`, as "worth more"."""
        others = [(one.threat.name, one.behind[0] > 0) for one in self.simulated if one.behind is not None]
        if not others:
            return "There is no other."
        how = "95 %, all together" if self.rolled else "exact"
        close = [name for name, beaten in others if not beaten]
        alike = f"{', '.join(close[:4])}{' and more' if len(close) > 4 else ''}"
        rest = f"the other {len(others)}" if len(others) > 1 else "the other one"
        if len(close) == len(others):
            return f"No significant difference from {rest} ({how}): {alike}."
        if not close:
            return f"It is surely {more} than {rest} ({how})."
        beaten = len(others) - len(close)
        return f"It is surely {more} than {beaten} of {rest} ({how}); no significant difference from {alike}."


def by_cell(
    options: Sequence[Weighed], shape: tuple[int, int], gain_of: Callable[[Weighed], Gain | None]
) -> NDArray[np.float64]:
    """What the threat that a cell is in costs, the most where several overlap, `[H, W]`."""
    gains = np.zeros(shape)
    for one in options:
        gain = gain_of(one)
        if gain is not None:
            own = one.threat.cells
            gains.reshape(-1)[own] = np.maximum(gains.reshape(-1)[own], gain.counted.mean)
    return gains
