"""What a search for starts holds: the places that were looked at, how good each is, the best and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.report.searched import Searched
from analysis.statistics.estimate import Estimate
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.worlds.world import World


@dataclass(frozen=True, eq=False)
class Place:
    """A team's starts, and what is known of them.

    Attributes:
        starts: int64 `[K, 2]`.
        screen: expected cells visited (or their value) that no strategy exceeds from there, `sum_c g_c` of
            `reach_chances`.
        one_robot: eq. (4): expected cells (or value) visited by one robot alone; None: it was not planned for.
        coverage: visited by the team, a fraction of the accessible cells; None: it was not simulated.
        value: visited, a fraction of what all free cells are worth; None: nobody said what that is.
        losses: robots lost. rollouts: behind both.
        behind: points of coverage (or value) that the best found is ahead, an interval; all of one search hold together
            with 95 %.
        entered: it was simulated. now: the team stands there now.
    """

    starts: NDArray[np.int64]
    screen: float
    one_robot: float | None = None
    coverage: Estimate | None = None
    value: Estimate | None = None
    losses: Estimate | None = None
    rollouts: int = 0
    behind: tuple[float, float] | None = None
    entered: bool = False
    now: bool = False

    @property
    def is_depot(self) -> bool:
        """All robots start in one cell."""
        return bool((self.starts == self.starts[0]).all())

    @property
    def counted(self) -> Estimate | None:
        """What is gone by, a fraction: value where there is any, else coverage."""
        return self.coverage if self.value is None else self.value

    @property
    def at(self) -> str:
        """Where, in words: one place for all, or one each."""
        places = self.starts[:1] if self.is_depot else self.starts
        return " ".join(f"[{row}, {col}]" for row, col in places.tolist())


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Starts(Searched):
    """The answer; `words`: without the starts.

    Attributes:
        depot: one place for all robots.
        places: looked at: depots in order of screening, or teams of starts and depots; then where the team stands.
        best: place of the best found, of the depots with `depot`.
        gain: how much more is covered (or of the value) from the best than from `here`, on fresh rollouts, a fraction.
        candidates: cells that robots may start at. rolled: rollouts of all places.
        confirmed: `chosen` on fresh rollouts, ids from `choices.rollouts` on.
    """

    reported_by = "analysis.depots.report:report"
    listed = "candidates"

    depot: bool
    places: tuple[Place, ...]
    best: int
    candidates: NDArray[np.int64]
    rolled: int
    gain: Estimate | None = None
    confirmed: Place | None = None

    @property
    def covered(self) -> str:
        """What the figures are shares of, in a word."""
        return "covered" if self.world.value is None else "of the value covered"

    @property
    def here(self) -> int | None:
        """The place where the team stands now, by the input's starts or its rule; None: in another part of the map."""
        return next((number for number, place in enumerate(self.places) if place.now), None)

    @property
    def stay(self) -> bool:
        """Whether nothing found is better than where the team stands now, with 95 %."""
        return self.here is not None and (self.best == self.here or (self.gain is not None and self.gain.ci95[0] <= 0))

    @property
    def chosen(self) -> Place:
        """What is recommended: where the team stands if it is to stay, else the best found; with `depot` the latter."""
        return self.places[self.here if self.here is not None and self.stay and not self.depot else self.best]

    @property
    def starts(self) -> NDArray[np.int64]:
        """Of that place, int64 `[K, 2]`."""
        return self.chosen.starts

    @cached_property
    def simulated(self) -> tuple[Place, ...]:
        """Those that were rolled out, the best first, then by coverage."""
        rest = [p for p in self.places if p.coverage is not None and p is not self.chosen]
        return (self.chosen, *sorted(rest, key=lambda p: -p.counted.mean if p.counted else 0.0))

    @property
    def beaten(self) -> int:
        """How many of the others the best found surely beats, all together with 95 %."""
        return sum(p.behind is not None and p.behind[0] > 0 for p in self.places)

    @property
    def world_with_starts(self) -> World:
        """The map with these starts, to save or to evaluate."""
        return self.world.with_starts(self.starts)

    def plan(self) -> Plan:
        """The plan from there."""
        return make_plan(self.world, self.starts, self.settings)
