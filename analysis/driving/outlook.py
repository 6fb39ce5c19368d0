"""What will come of a mission from where it stands, and what if it went on otherwise: rollouts on common luck."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices, make_singles
from analysis.statistics.differences import Paired, difference
from analysis.statistics.estimate import Estimate, mean_estimate, mean_of, proportion
from planner.arguments import POSITIVE, whole
from planner.errors import UsageError
from planner.files import Json
from planner.kernels.tables import AllPairs
from planner.limits import MOST_ROLLOUTS
from planner.missions.mission import Mission
from planner.mrac.homecoming import is_home
from planner.tally import Outcome, RolloutResults

SECONDS = 0.5
"""For an answer, if nobody says how many or how long."""
BLOCK = 512
"""Rollouts of a call; a multiple of it is made in the seconds."""


@dataclass(frozen=True)
class Outlook:
    """What a mission will have come to at its end, from where it stands.

    Attributes:
        rollouts: behind the figures.
        covered: share of the accessible cells visited at the end, what is visited already included.
        lost: robots more than now. steps: until the end. complete: chance that every cell is visited.
        home: robots that are home then; None: they need not come home.
    """

    rollouts: int
    covered: Estimate
    lost: Estimate
    steps: Estimate
    complete: Estimate
    home: Estimate | None = None

    def to_json(self) -> Json:
        """As a JSON object."""
        figures = {name: getattr(self, name).to_json() for name in ("covered", "lost", "steps", "complete")}
        home = {} if self.home is None else {"home": self.home.to_json()}
        return {"rollouts": self.rollouts, **figures, **home}


@dataclass(frozen=True)
class WhatIf:
    """A mission gone on with as it is, and otherwise, on the same luck.

    Attributes:
        now, then: both. covered, lost: differences, then - now.
    """

    now: Outlook
    then: Outlook
    covered: Estimate
    lost: Estimate

    def to_json(self) -> Json:
        """As a JSON object."""
        difference = {"covered": self.covered.to_json(), "lost": self.lost.to_json()}
        return {"now": self.now.to_json(), "then": self.then.to_json(), "difference": difference}


class DrivenMission(Mission):
    """A mission that also says what will come of it, by the compiled simulator, from the end of the last step."""

    def check_foreseen(self) -> None:
        """Raise UsageError where the mission is over, WorldError for hazards, maps in doubt and phases."""
        if self.outcome is not None:
            raise UsageError("the mission is over", expected="one that goes on")
        self.given.check_settled("the rest of a mission")

    def outlook(self, rollouts: int | None = None, seconds: float | None = None, seed: int = 0) -> Outlook:
        """What will be covered, robots lost, steps left, each with its 95 % interval.

        Args:
            rollouts: how many; None: as many as `seconds` (half a second in all) leave time for, in blocks of 512.
            seed: of the rollouts.

        Raises UsageError, PlanError for a rule of one's own, WorldError for hazards and maps in doubt.
        """
        (found,) = self._roll_out([{}], rollouts, seconds, seed)
        return self._seen(found)

    def what_if(
        self,
        *,
        without: Iterable[int] = (),
        call_off: bool = False,
        rollouts: int | None = None,
        seconds: float | None = None,
        seed: int = 0,
        **changes: Any,
    ) -> WhatIf:
        """The same beside a mission that goes on otherwise from here, on common luck.

        Args:
            without: robots that do no more from here on. call_off: it ends here; robots that come home turn now.
            changes: settings, as `policy="per_cell"`, `worth=12`.
            rollouts, seconds, seed: as of `outlook`.

        Raises UsageError where it is called off and goes on otherwise, and as `outlook` does.
        """
        without = tuple(without)
        if call_off and (without or changes):
            raise UsageError("a mission that is called off, and goes on otherwise", expected="one of the two")
        otherwise = [changes | {"without": without}]
        if call_off:
            otherwise = [{"call_off": True}] if self.settings.return_to is not None and self.step > 0 else []
        mine, *others = self._roll_out([{}, *otherwise], rollouts, seconds, seed)
        other = others[0] if others else self._ended(mine)
        cells, lost = self.accessible, [self._lost(found) for found in (mine, other)]
        covered = difference(Paired.of(mine.visited, other.visited), 1 / cells, 1 / cells, 1.0).estimate
        return WhatIf(
            self._seen(mine),
            self._seen(other),
            covered,
            difference(Paired.of(*lost), 1.0, 1.0, float(self._alive)).estimate,
        )

    @cached_property
    def _tables(self) -> AllPairs:
        """Of all pairs of cells, made once."""
        return AllPairs()

    @property
    def _past(self) -> int:
        """Steps that are over; entering the starts, step 0, takes no time."""
        return max(self.step - 1, 0)

    @property
    def _alive(self) -> int:
        return self.robots - len(self.lost)

    def _roll_out(
        self, ways: list[dict[str, Any]], rollouts: int | None, seconds: float | None, seed: int
    ) -> list[RolloutResults]:
        """The same rollouts of each way to go on (arguments of `rest`): so many, or blocks of them for so long."""
        POSITIVE.check("seconds", seconds, optional=True)
        ends = time.monotonic() + (SECONDS if seconds is None else seconds)
        self.check_foreseen()
        whole(1, MOST_ROLLOUTS).check("rollouts", rollouts, optional=True)
        choices = RolloutChoices(seed=seed, exact="never")
        rolls = [make_singles(self.world, self.rest(**way, nominal=False), choices, self._tables) for way in ways]
        if rollouts is not None:
            return [roll(0, rollouts) for roll in rolls]
        parts = [[roll(0, BLOCK)] for roll in rolls]
        while time.monotonic() < ends:
            for roll, part in zip(rolls, parts, strict=True):
                part.append(roll(len(part) * BLOCK, BLOCK))
        return [RolloutResults.join(part) for part in parts]

    def _seen(self, found: RolloutResults) -> Outlook:
        """The figures of rollouts."""
        count, step = len(found.visited), self._past
        lost = np.bincount(self._lost(found), minlength=self._alive + 1)
        left = np.bincount(found.time - step)
        most = self.last_step - step
        values = np.flatnonzero(left)
        complete = int((found.outcome == Outcome.COMPLETE).sum())
        return Outlook(
            count,
            mean_estimate(np.bincount(found.visited, minlength=self.accessible + 1), 1 / self.accessible),
            mean_estimate(lost, 1.0),
            mean_of(values, left[values], 1.0, most),
            proportion(complete, count),
            None
            if self.settings.return_to is None
            else mean_estimate(np.bincount(found.home, minlength=self.robots + 1), 1),
        )

    def _lost(self, found: RolloutResults) -> NDArray[np.int64]:
        """int64 `[B]`: robots lost from now on."""
        return (self._alive - found.alive).astype(np.int64)

    def _ended(self, found: RolloutResults) -> RolloutResults:
        """The same rollouts of a mission that ends here."""
        fleet, ways = self._fleet, self._fleet.problem.home
        visited, survived = (int(np.count_nonzero(cells)) for cells in (fleet.visited, fleet.survived))
        same = {"visited": visited, "survived": survived, "time": self._past, "alive": self._alive}
        same["home"] = sum(ways is not None and robot.alive and is_home(ways, robot) for robot in fleet.robots)
        ended = {name: np.full_like(getattr(found, name), value) for name, value in same.items()}
        return replace(found, outcome=np.full_like(found.outcome, Outcome.ENDED_BY_OPERATOR), **ended)
