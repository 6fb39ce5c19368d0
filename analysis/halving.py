"""The best of many on common luck: successive halving, with verdicts that hold together.

All contenders roll out the same ids with the same seed, so robot i meets the same luck in all of them (SPEC section 6)
and what they differ in is what is compared. At every look the better half goes on, with twice the rollouts (Karnin,
Koren & Somekh, "Almost optimal exploration in multi-armed bandits", ICML 2013). That one is put aside is no verdict:
whether the best beats it is said by an interval of their paired difference, and all of these hold together with 95 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress
from analysis.sampling import Roll, RolloutChoices
from analysis.statistics.differences import Paired, difference
from analysis.statistics.estimate import Estimate, mean_estimate
from analysis.statistics.intervals import bet_interval, share_of_doubt
from analysis.valuing import UNITS, mean_value
from planner.arguments import argument
from planner.errors import PlanError, UsageError
from planner.limits import MOST_ROLLOUTS
from planner.settings import Settings
from planner.worlds.world import World

USUAL = 4096
"""Rollouts of each that comes through, when nobody says."""


def check_search(world: World, settings: Settings, choices: RolloutChoices, what: str) -> None:
    """Raise InputError for what a search cannot go by: a map in doubt, plans for the open loop, too many rollouts."""
    world.check_settled(what)
    if settings.plan_for != "closed":
        raise PlanError(f"plan_for is {settings.plan_for} in {what}", expected="closed", fix="leave it out")
    if choices.rollouts > MOST_ROLLOUTS // 2:
        expected = f"at most {MOST_ROLLOUTS // 2}: as many others check the best"
        raise UsageError(argument("rollouts", choices.rollouts), expected=expected)


@dataclass(frozen=True, eq=False)
class Runs:
    """Rollouts `start .. start + n - 1` of a contender, `[n]` each.

    Attributes:
        visited, lost: int32, cells and robots. worth: int64, value of those cells in units of `analysis.valuing`; None
            where the map has none, and cells count alike.
    """

    visited: NDArray[np.int32]
    lost: NDArray[np.int32]
    worth: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.visited)

    def __add__(self, other: Runs) -> Runs:
        worth = None if self.worth is None or other.worth is None else np.concatenate([self.worth, other.worth])
        return Runs(np.concatenate([self.visited, other.visited]), np.concatenate([self.lost, other.lost]), worth)

    @property
    def counted(self) -> NDArray[np.int32] | NDArray[np.int64]:
        """What is gone by: value where there is any, else cells."""
        return self.visited if self.worth is None else self.worth

    @property
    def mean(self) -> float:
        """Of that, on average."""
        return float(self.counted.mean())

    def share_of_value(self, cells: int, certain: bool = False) -> Estimate | None:
        """The mean value of visited cells as a fraction of that of all `cells`; None where nobody said it."""
        return None if self.worth is None else mean_value(self.worth, 1.0, cells, certain)

    def value_gain(self, base: Runs, total: float) -> Estimate | None:
        """Value of visited cells more than that of `base` on the same rollouts, of `total`, or None."""
        if self.worth is None or base.worth is None:
            return None
        return _apart(base.worth, self.worth, total, total / UNITS)

    def coverage(self, cells: int, certain: bool = False) -> Estimate:
        """The mean as a fraction of `cells`; `certain`: every run is the same."""
        return mean_estimate(np.bincount(self.visited, minlength=cells + 1), 1.0 / cells, certain=certain)

    def losses(self, robots: int, certain: bool = False) -> Estimate:
        """Robots lost on average."""
        return mean_estimate(np.bincount(self.lost, minlength=robots + 1), 1.0, certain=certain)

    def gain(self, base: Runs, cells: int) -> Estimate:
        """Cells visited more than by `base` on the same rollouts, of `cells`, with its 95 % interval."""
        return _apart(base.visited, self.visited, cells, 1.0)

    def ahead(self, base: Runs, most: int, certain: bool = False) -> Estimate:
        """What is gone by, more than with `base` on the same rollouts, a fraction of `most`; `certain`: of both."""
        return _apart(base.counted, self.counted, 1.0, 1.0 / most, certain)

    def spared(self, base: Runs, robots: int) -> Estimate:
        """Robots lost fewer than by `base` on the same rollouts, with its 95 % interval."""
        return _apart(self.lost, base.lost, robots, 1.0)


def _apart(less: NDArray, more: NDArray, reach: float, unit: float, certain: bool = False) -> Estimate:
    n = min(len(less), len(more))
    return difference(Paired.of(less[:n], more[:n]), unit, unit, float(reach), certain).estimate


def runs_of(roll: Roll, robots: int, start: int, count: int, valued: bool = False) -> Runs:
    """Those rollouts; `valued`: of a map with values."""
    results = roll(start, count)
    return Runs(results.visited, (robots - results.alive).astype(np.int32), results.worth_covered if valued else None)


def schedule(contenders: int, rollouts: int) -> list[tuple[int, int]]:
    """(contenders that are still in, rollouts each has at the end) of every look: the last two get all of them."""
    looks = max(1, math.ceil(math.log2(max(contenders, 1))))
    return [
        (max(-(-contenders // 2**look), min(2, contenders)), -(-rollouts // 2 ** (looks - 1 - look)))
        for look in range(looks)
    ]


class Halving:
    """Contenders of one team size, and what was rolled out of each.

    Attributes:
        runs: by contender, of those that were rolled out. ranked: those still in, the best first.
    """

    def __init__(
        self,
        contenders: Sequence[Callable[[], Roll]],
        robots: int,
        rollouts: int,
        room: int = 64,
        valued: bool = False,
        kept: Sequence[Collection[int]] = (),
    ) -> None:
        """`contenders`: each makes what rolls it out, anew if there is no `room` to keep it; `robots`: of the team.

        `valued`: it goes by value, not by cells. `kept`: contenders of which the best goes on at every look.
        """
        self.contenders, self.robots, self.rollouts, self.room = contenders, robots, rollouts, room
        self.valued, self.kept = valued, kept
        self.runs: dict[int, Runs] = {}
        self.ranked = list(range(len(contenders)))
        self._rolls: dict[int, Roll] = {}

    @property
    def rolled(self) -> int:
        """Rollouts so far, of all."""
        return sum(map(len, self.runs.values()))

    def run(self, progress: Progress | None = None) -> None:
        """Look after look; whoever interrupts it finds `runs` as they were, `best` among them."""
        clock, total, seen = time.perf_counter(), 0, 0
        plan = schedule(len(self.contenders), self.rollouts)
        for size, upto in plan:
            total, seen = total + min(size + len(self.kept), len(self.contenders)) * (upto - seen), upto
        for (size, upto), (after, _) in zip(plan, [*plan[1:], (1, 0)], strict=True):
            self.ranked = self._through(size)
            for place, contender in enumerate(list(self.ranked), 1):
                self._extend(contender, upto)
                self._forget(self.ranked[:place], after)
                if progress is not None:
                    progress(self.rolled, total, time.perf_counter() - clock)
            self.ranked.sort(key=self._rank)

    def _through(self, size: int) -> list[int]:
        """Those that go on: the best so many, and the best of each that is kept."""
        leaders = {next(one for one in self.ranked if one in group) for group in self.kept}
        return [one for place, one in enumerate(self.ranked) if place < size or one in leaders]

    def _extend(self, contender: int, upto: int) -> None:
        if contender not in self._rolls:
            self._rolls[contender] = self.contenders[contender]()
        start = len(self.runs.get(contender, ()))
        more = runs_of(self._rolls[contender], self.robots, start, upto - start, self.valued)
        self.runs[contender] = self.runs[contender] + more if start else more

    def _forget(self, done: Sequence[int], after: int) -> None:
        """Of what rolled out `done` keep that of the best, as many as go on; and no more than there is room for."""
        for contender in sorted(done, key=self._rank)[after:]:
            self._rolls.pop(contender, None)
        for contender in sorted(self._rolls, key=self._rank)[self.room :]:
            del self._rolls[contender]

    def _rank(self, contender: int) -> tuple[float, int]:
        return -self.runs[contender].mean, contender

    @property
    def best(self) -> int:
        """Of those that have most rollouts, the one that visits most (or most value)."""
        return self.best_of(range(len(self.contenders)))

    def best_of(self, some: Collection[int]) -> int:
        """The same of some; of all where none of them was rolled out."""
        known = [contender for contender in self.ranked if contender in self.runs]
        seen = [contender for contender in known if contender in some] or known
        return min(seen, key=lambda contender: (-len(self.runs[contender]), *self._rank(contender)))

    def confirm(self, contender: int) -> Runs:
        """As many other rollouts of one, ids from `rollouts` on, which had no part in the choice."""
        roll = self._rolls.get(contender) or self.contenders[contender]()
        return runs_of(roll, self.robots, self.rollouts, self.rollouts, self.valued)

    def behind(self, contender: int, most: int, ahead: int | None = None) -> tuple[float, float]:
        """Cells (or units of value) that the best visits more, on the rollouts that both have: an interval.

        `most`: the most there are. `ahead`: another one in the place of the best.

        All of one search hold together with 95 %, whichever is the best and whenever the other was put aside:
        `bet_interval`, shared among all pairs.
        """
        best, other = self.runs[self.best if ahead is None else ahead], self.runs[contender]
        n, count = min(len(best), len(other)), len(self.contenders)
        apart = (best.counted[:n].astype(np.int64) - other.counted[:n]) / most
        low, high = bet_interval(apart, share_of_doubt(max(count * (count - 1) // 2, 1), 1))
        return low * most, high * most
