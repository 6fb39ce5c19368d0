"""The best of many on common luck: successive halving, with verdicts that hold together.

Where all are known exactly (`analysis.trials.trial`) there is nothing to race for. Else
all contenders roll out the same ids with the same seed, so robot i meets the same luck in all of them (SPEC section 6)
and what they differ in is what is compared. At every look the better half goes on, with twice the rollouts (Karnin,
Koren & Somekh, "Almost optimal exploration in multi-armed bandits", ICML 2013). That one is put aside is no verdict:
whether the best beats it is said by an interval of their paired difference, and all of these hold together with 95 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence

import numpy as np

from analysis.kit.notes import Progress, of_things, quiet
from analysis.sampling import RolloutChoices
from analysis.statistics.intervals import bet_interval, share_of_doubt
from analysis.trials.measured import Known, Measured, Sampled
from analysis.trials.trial import Trial
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
    settings.check_alike(what)
    if settings.plan_for != "closed":
        raise PlanError(f"plan_for is {settings.plan_for} in {what}", expected="closed", fix="leave it out")
    if choices.rollouts > MOST_ROLLOUTS // 2:
        expected = f"at most {MOST_ROLLOUTS // 2}: as many others check the best"
        raise UsageError(argument("rollouts", choices.rollouts), expected=expected)


def screened(settings: Settings) -> tuple[str, ...]:
    """A note where bounds that candidates are screened by are none: they presume that every visit stops with p."""
    said = settings.bearing().said
    return (f"screened as if it were not for {said}: the bounds shown order the candidates alone",) if said else ()


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
        contenders: Sequence[Callable[[], Trial]],
        rollouts: int,
        room: int = 64,
        kept: Sequence[Collection[int]] = (),
        exact: bool = True,
        least: bool = False,
    ) -> None:
        """`contenders`: each makes a trial, anew if there is no `room` to keep it.

        `kept`: contenders of which the best goes on at every look. `exact`: whether exact values are looked for.
        `least`: the best visits the least, as who places threats would have it.
        """
        self.contenders, self.rollouts, self.room, self.kept = contenders, rollouts, room, kept
        self._looks_for_exact, self._sign = exact, 1.0 if least else -1.0
        self.runs: dict[int, Measured] = {}
        self.ranked = list(range(len(contenders)))
        self._trials: dict[int, Trial] = {}

    @property
    def rolled(self) -> int:
        """Rollouts so far, of all."""
        return sum(found.rollouts for found in self.runs.values())

    @property
    def exact(self) -> bool:
        """Whether what each comes to is known exactly."""
        return all(found.exact for found in self.runs.values())

    def run(self, progress: Progress | None = None) -> None:
        """Look after look; whoever interrupts it finds `runs` as they were, `best` among them."""
        clock, total, seen = time.perf_counter(), 0, 0
        tell = progress or quiet
        known = of_things(tell, "exact values")
        if self._all_known(lambda done: known(done, len(self.contenders), time.perf_counter() - clock)):
            return
        plan = schedule(len(self.contenders), self.rollouts)
        for size, upto in plan:
            total, seen = total + min(size + len(self.kept), len(self.contenders)) * (upto - seen), upto
        for (size, upto), (after, _) in zip(plan, [*plan[1:], (1, 0)], strict=True):
            self.ranked = self._through(size)
            for place, contender in enumerate(list(self.ranked), 1):
                self._extend(contender, upto)
                self._forget(self.ranked[:place], after)
                tell(self.rolled, total, time.perf_counter() - clock)
            self.ranked.sort(key=self._rank)

    def _all_known(self, tell: Callable[[int], None]) -> bool:
        """Whether all are known exactly, each in its share of the time; their `runs` then say so, and else are none."""
        if not self._looks_for_exact:
            return False
        for contender in self.ranked:
            known = self._trial(contender).known(1 / len(self.contenders))
            if known is None:
                self.runs.clear()
                self._trials = {contender: self._trials[contender]}
                return False
            self.runs[contender] = known
            self._forget(range(contender + 1), len(self.ranked))
            tell(contender + 1)
        self.ranked.sort(key=self._rank)
        return True

    def _through(self, size: int) -> list[int]:
        """Those that go on: the best so many, and the best of each that is kept."""
        leaders = {next(one for one in self.ranked if one in group) for group in self.kept}
        return [one for place, one in enumerate(self.ranked) if place < size or one in leaders]

    def _trial(self, contender: int) -> Trial:
        if contender not in self._trials:
            self._trials[contender] = self.contenders[contender]()
        return self._trials[contender]

    def _extend(self, contender: int, upto: int) -> None:
        start = self.runs[contender].rollouts if contender in self.runs else 0
        more, before = self._trial(contender).sample(start, upto - start), self.runs.get(contender)
        self.runs[contender] = before + more if isinstance(before, Sampled) else more

    def _forget(self, done: Sequence[int], after: int) -> None:
        """Of what rolled out `done` keep that of the best, as many as go on; and no more than there is room for."""
        for contender in sorted(done, key=self._rank)[after:]:
            self._trials.pop(contender, None)
        for contender in sorted(self._trials.keys() & self.runs.keys(), key=self._rank)[self.room :]:
            del self._trials[contender]

    def _rank(self, contender: int) -> tuple[float, int]:
        return self._sign * self.runs[contender].share, contender

    @property
    def best(self) -> int:
        """Of those that have most rollouts, the one that visits most (or most value, or least)."""
        return self.best_of(range(len(self.contenders)))

    def best_of(self, some: Collection[int]) -> int:
        """The same of some; of all where none of them was rolled out."""
        known = [contender for contender in self.ranked if contender in self.runs]
        seen = [contender for contender in known if contender in some] or known
        return min(seen, key=lambda contender: (-self.runs[contender].rollouts, *self._rank(contender)))

    def confirm(self, contender: int) -> Measured:
        """As many other rollouts of one, ids from `rollouts` on, which had no part in the choice; or what is known."""
        found = self.runs[contender]
        return found if found.exact else self._trial(contender).sample(self.rollouts, self.rollouts)

    def behind(self, contender: int, ahead: int | None = None) -> tuple[float, float]:
        """Share of all cells (or of all value) that the best visits more (or less), on what both have: an interval.

        `ahead`: another one in the place of the best.

        All of one search hold together with 95 %, whichever is the best and whenever the other was put aside:
        `bet_interval`, shared among all pairs.
        """
        best, other = self.runs[self.best if ahead is None else ahead], self.runs[contender]
        best, other = (other, best) if self._sign > 0 else (best, other)
        figure, count = best.counted, len(self.contenders)
        most = best.largest(figure)
        if isinstance(best, Known) or isinstance(other, Known):
            return best.ahead(other, figure, 1.0 / most).ci95
        n = min(best.rollouts, other.rollouts)
        apart = (best.column(figure)[:n] - other.column(figure)[:n]) / most
        return bet_interval(np.clip(apart, -1.0, 1.0), share_of_doubt(max(count * (count - 1) // 2, 1), 1))
