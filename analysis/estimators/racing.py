"""The best of many on common luck: successive halving, with verdicts that hold together.

Where all are known exactly (`analysis.estimators.trial`) there is nothing to race for. Else
all contenders roll out the same ids with the same seed, so robot i meets the same luck in all of them (SPEC section 14)
and what they differ in is what is compared. At every look the better half goes on, with twice the rollouts (Karnin,
Koren & Somekh, "Almost optimal exploration in multi-armed bandits", ICML 2013). That one is put aside is no verdict:
whether the best beats it is said by an interval of their paired difference, and all of these hold together with 95 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Known, Measured, Sampled, Trial, alike
from analysis.sampling import SECONDS, RolloutChoices
from analysis.statistics.estimates import bet_interval, share_of_doubt
from analysis.utils.notes import ProgressCallback, of_things, quiet
from analysis.utils.tables import policy_words
from planner.arguments import MOST_ROLLOUTS, POSITIVE, argument
from planner.errors import PlanError, UsageError
from planner.formatting import counted
from planner.make_plan import allocated, allocated_plan, make_plan
from planner.mrac.problem import Problem, worth_of
from planner.plan.plan import Plan
from planner.policies import DEFAULT
from planner.policies.rules import PER_CELL, WATCHFUL
from planner.rollout_sampling import hazards_met, rows_met
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.tables import AllPairs, by_price
from planner.rollouts.threshold_classes import sums_by_luck
from planner.settings import BEST, MOST_PRIORITY, Settings
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults
from planner.world.features import seeing
from planner.world.uncertain_maps import LARGEST, Hazard, Uncertain
from planner.world.world import World

USUAL = 4096
"""Rollouts of each that comes through, when nobody says."""


def check_search(world: World, settings: Settings, choices: RolloutChoices, what: str) -> None:
    """Raise InputError for what a search cannot go by: a map in doubt, plans for the open loop, too many rollouts."""
    world.check_settled(what)
    settings.check_alike(what)
    if settings.plan_for != "closed_loop":
        raise PlanError(f"plan_for is {settings.plan_for} in {what}", expected="closed_loop", fix="leave it out")
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

    def run(self, progress: ProgressCallback | None = None) -> None:
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


# A better order of areas on a map: what a cell of each counts for, found by trying (SPEC section 11, `priority`).
#
# A rule prices areas one by one; which of them had better come first, because of what lies behind it or of who else is
# near, a number for each says. Moves of a few numbers at a time, of larger areas more often, are kept where the team
# covers no less: exactly where a tree tells it at once, else on common luck.

ROLLOUTS = 512
"""Of each order that is tried, where its tree takes too long."""
AT_ONCE = 0.01
"""The share of the seconds for a tree in which an order has to be known exactly."""
FINE = 8
"""Numbers are whole powers of 2 ** (1 / FINE)."""
FURTHEST = 5
"""A move multiplies by 2 ** (2 ** n / FINE), or divides, n below this: from 1.1 to 4 times."""


def can_order(settings: Settings) -> bool:
    """Whether the policy goes by prices, and nothing is refused for its price."""
    return settings.rule.by_price and settings.robot_value is None


def order_areas(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    kept: AllPairs,
    tries: int,
    in_time: Callable[[], bool],
) -> Settings:
    """The settings with the best `priority` of so many tries, or of those that were `in_time`."""
    alike = replace(settings, priority=(MOST_PRIORITY,) * world.threat.size)
    problem, plan = allocated(world, starts, alike)
    base = Trial(world, plan, choices, kept)
    loop, draw, areas = base.loop, np.random.default_rng(choices.seed), len(plan.areas)
    assert loop is not None
    exact = base.known(AT_ONCE) is not None
    size = np.sqrt([len(area.cells) for area in plan.areas])
    best, most = np.zeros(areas, dtype=np.int64), _covered(base, exact)
    for _ in range(tries):
        if not in_time():
            break
        tried = best.copy()
        for area in draw.choice(areas, size=int(draw.integers(1, 4)), p=size / size.sum()):
            tried[area] += int(draw.choice((-1, 1))) << int(draw.integers(FURTHEST))
        counted = Trial(world, plan, choices, loop=_counting(loop, problem, _priority(plan, tried)))
        covered = _covered(counted, exact)
        if covered >= most:
            best, most = tried, covered
    return replace(settings, priority=tuple(_priority(plan, best).tolist()))


def _priority(plan: Plan, powers: NDArray[np.int64]) -> NDArray[np.int64]:
    """What each cell counts, int64 `[N]`, the powers `[areas]` of the areas at t = 0 given."""
    found = np.full(plan.shape[0] * plan.shape[1], MOST_PRIORITY, dtype=np.int64)
    shares = np.rint(MOST_PRIORITY * 2.0 ** ((powers - powers.max()) / FINE)).astype(np.int64)
    for area, share in zip(plan.areas, np.maximum(shares, 1), strict=True):
        found[area.cells] = share
    return found


def _counting(loop: ClosedLoop, problem: Problem, priority: NDArray[np.int64]) -> ClosedLoop:
    """The loop of robots that count cells so."""
    assert loop.policy is not None
    value = worth_of(problem.world, problem.levels.accessible, tuple(priority.tolist()))
    assert value is not None
    t = loop.tables
    ranks = by_price(replace(problem, value=value), t.area_cost, loop.cells, t.order, t.begin, t.level)
    return replace(loop, tables=t._replace(**ranks), policy=loop.policy._replace(value=value[loop.cells]))


def _covered(trial: Trial, exact: bool) -> float:
    """The share that is covered (or of all value); of one that is not known as the others are, less than any."""
    if not exact:
        return trial.sample(0, ROLLOUTS).share
    known = trial.known(2 * AT_ONCE)
    return -1.0 if known is None else known.share


# The policy that covers most on a map: a few settings raced on common luck, the best told on luck of its own.
#
# Which settings are worth a try was found on random maps: `watchful` with so many robots at risk at once, and with the
# safe areas at t = 0 left to one robot each; `per_cell`, and the paper's rule. Then a better order of areas is sought.

SHARES = (1 / 8, 1 / 4, 1 / 2)
"""Of the robots alive, that may be at risk at once; a single one too."""
ALONE = 1e6
"""A density d at which no safe area is shared at t = 0."""
BASE = PER_CELL.name
"""The rule that limits on the team go with."""
TRIES = 50
"""Orders of areas that are tried for a second of the search, however fast the machine is."""
LUCK = 2**64 - 1
"""Seed of the search: nobody evaluates by it who does not ask for it, so that what is found is judged on other luck."""

BEST_OF = "the best of "
"""How the note of a plan that was searched for begins."""


class _TimeOver(Exception):
    """The search's own, caught where it began."""


def plan_best(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    seconds: float | None = None,
) -> Plan:
    """The plan of the best of `contenders`; its last note says which that is, and what it gains.

    Args:
        settings: what all have in common. seconds: after which the race ends as it stands (default: SECONDS); whoever
            ends in time finds the same on every machine.

    Raises InputError.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    choices = RolloutChoices(rollouts=USUAL, seed=LUCK)
    check_search(world, settings, choices, argument("policy", BEST))
    raced, kept = contenders(settings, len(starts)), AllPairs()
    makers = [partial(_trial, world, starts, one, choices, kept) for one in raced]
    for maker in (makers[0], makers[1], makers[-1]):  # what is compiled costs the race no time
        maker().sample(0, 1)
    race, ends = Halving(makers, USUAL), time.perf_counter() + (seconds or SECONDS)

    def watch(*_: float) -> None:
        if time.perf_counter() > ends:
            raise _TimeOver

    in_time = True
    try:
        race.run(watch)
    except _TimeOver:
        in_time = False
    found, maker = raced[race.best], makers[race.best]
    if in_time and can_order(found):
        tries = round(TRIES * (seconds or SECONDS))
        found = order_areas(world, starts, found, choices, kept, tries, lambda: time.perf_counter() < ends)
        ordered = partial(_trial, world, starts, found, choices, kept)
        before, after = alike([maker(), ordered()], 0, USUAL)
        found, maker = (found, ordered) if after.share > before.share else (raced[race.best], maker)
        in_time = time.perf_counter() < ends
    made = make_plan(world, starts, found)
    told, plain = alike([maker(), makers[0]()], USUAL, USUAL)
    gain = told.ahead(plain, told.counted, 1.0 / told.largest(told.counted))
    gained = gain.more(100, " points", ("more", "less"))
    more = f", {gained} than {policy_words(raced[0])} on other luck" if found != raced[0] else ""
    over = "" if in_time else f"; the search ended after {seconds or SECONDS:g} s"
    note = f"{BEST_OF}{counted(len(raced), 'setting')} is {policy_words(found)}{more}{over}"
    return replace(made, notes=(*made.notes, note))


def is_best(plan: Plan) -> bool:
    """Whether the plan is one of `plan_best`."""
    return any(note.startswith(BEST_OF) for note in plan.notes)


def contenders(settings: Settings, robots: int) -> list[Settings]:
    """What is raced: the paper's rule, or with limits on the team the plainest first; what is given stays."""
    watchful = replace(settings, policy=WATCHFUL.name)
    most = {max(1, math.ceil(share * robots)): share for share in (*SHARES[::-1], 1 / robots)}
    risk_caps = [settings.risk_cap] if settings.risk_cap is not None else [None, *(most[m] for m in most if m < robots)]
    densities = [settings.density, ALONE] if settings.density == Settings.density else [settings.density]
    limited = settings.risk_cap is not None or settings.robot_value is not None
    return [replace(settings, policy=policy) for policy in (DEFAULT, BASE)[limited:]] + [
        replace(watchful, risk_cap=risk_cap, density=density) for density in densities for risk_cap in risk_caps
    ]


def _trial(
    world: World, starts: NDArray[np.int64], settings: Settings, choices: RolloutChoices, kept: AllPairs
) -> Trial:
    return Trial(world, allocated_plan(world, starts, settings), choices, kept)


# The team of a plan with other eyes; and told which of several maps is true, or where hazards are, each rollout
# on a plan for its own.

MOST_MAPS = 64
"""That are planned on: those that the first rollouts meet."""
HISTOGRAMS = ("visited", "survived", "time", "alive")


def with_eyes(world: World, plan: Plan, far: float, choices: RolloutChoices) -> Trial:
    """The team if it saw so many cells far, by a plan that is its own; inf: told the map, if it is not drawn."""
    assert world.knowledge is not None
    if far == world.knowledge.sense.range:
        return Trial(world, plan, choices)
    other = seeing(world, far)
    return Trial(other, allocated_plan(other, plan.starts, plan.require(world)), choices)


def told_of_drawn(world: World, plan: Plan, choices: RolloutChoices, count: int) -> tuple[Sampled, NDArray[np.bool_]]:
    """Rollouts `0 .. count - 1` of the plan's team, each on the map drawn for it, which it is told and plans for.

    And bool `[count]`, which of them those are: the ones that meet one of the first MOST_MAPS maps.
    """
    doubt, settings = world.doubt, plan.require(world)
    assert isinstance(doubt, Uncertain)
    rows = rows_met(doubt, choices.seed, np.arange(count))[:, 0]
    met, first, which = np.unique(rows, return_index=True, return_inverse=True)
    kept = np.sort(np.argsort(first)[:MOST_MAPS])
    results = []
    for row in met[kept].tolist():
        one = replace(world, threat=doubt.threat_at(row), doubt=None, knowledge=None)
        trial = Trial(one, allocated_plan(one, plan.starts, settings), choices)
        sample = trial.sample(0, count)
        results.append(sample.results)
    within = np.isin(which, kept)
    place = np.where(within, np.searchsorted(kept, which), 0)
    columns = {
        of.name: np.stack([getattr(one, of.name) for one in results])[place, np.arange(count)]
        for of in fields(RolloutResults)[1:]
    }
    return only(replace(sample, results=RolloutResults(0, **columns)), within), within


def told_of_hazards(world: World, plan: Plan, choices: RolloutChoices, count: int) -> Sampled:
    """Rollouts `0 .. count - 1` of the plan's team, each told which cells have a hazard in it, and planning for that.

    Where one is a visit stops a robot with h; a sure stop is planned on as the largest chance below 1.
    """
    doubt, settings, results = world.doubt, plan.require(world), []
    assert isinstance(doubt, Hazard)
    for rollout, there in enumerate(hazards_met(doubt, choices.seed, np.arange(count))):
        q = np.where(there.reshape(world.shape), np.where(doubt.h < 1, 1.0, LARGEST), 0.0)
        told = replace(doubt, q=np.where(world.free, q, np.nan).astype(np.float32), detector=None)
        one = replace(world, threat=told.threat, doubt=told)
        sample = Trial(one, allocated_plan(one, plan.starts, settings), choices).sample(rollout, 1)
        assert sample.results is not None
        results.append(sample.results)
    joined = RolloutResults.join(results)
    return only(replace(sample, results=joined), np.ones(count, dtype=np.bool_))


def only(sample: Sampled, kept: NDArray[np.bool_]) -> Sampled:
    """Some rollouts of a sample that begins with id 0, with what means are made of; by luck only if all are kept."""
    assert sample.results is not None
    columns = {of.name: getattr(sample.results, of.name)[kept] for of in fields(RolloutResults)[1:]}
    results, tally, seed = RolloutResults(0, **columns), sample.tally, sample.seed if kept.all() else None
    sizes = {name: max(len(getattr(tally, name)), getattr(results, name).max(initial=0) + 1) for name in HISTOGRAMS}
    counts: dict[str, Any] = {name: np.bincount(getattr(results, name), minlength=size) for name, size in sizes.items()}
    counts["outcomes"] = np.bincount(results.outcome, minlength=len(Outcome))
    if seed is not None:
        counts["by_luck"] = sums_by_luck(results, seed, tally.robots)
    ids = ((0, int(kept.sum())),)
    return replace(sample, tally=replace(tally, ids=ids, **counts), results=results, seed=seed)
