"""The best of many candidates on common random numbers: successive halving, with simultaneous confidence intervals.

If all candidates are known exactly (`analysis.estimators.trial`), no rollouts are needed. Otherwise all candidates run
the same ids with the same seed, so that robot i has the same failure threshold in all of them (SPEC section 14). In
each round the better half continues with twice the rollouts (Karnin, Koren & Somekh, "Almost optimal exploration in
multi-armed bandits", ICML 2013). Elimination itself is no statement of significance. The claim that the best candidate
beats another one rests on an interval of their paired difference; all these intervals hold simultaneously with 95 %.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Known, Measured, Sampled, Trial, alike
from analysis.sampling import SECONDS, RolloutChoices, check_metric
from analysis.statistics.estimates import bet_interval, error_share
from analysis.utils.notes import Doing, ProgressCallback, of_things, quiet
from analysis.utils.tables import policy_text
from planner.arguments import MOST_ROLLOUTS, POSITIVE, argument
from planner.errors import PlanError, UsageError
from planner.formatting import counted
from planner.make_plan import allocated, allocated_plan, make_plan
from planner.mrac.problem import Problem, decision_values
from planner.plan.plan import Plan
from planner.policies import DEFAULT
from planner.policies.rules import PER_CELL, WATCHFUL
from planner.rollout_sampling import hazards_met, rows_met
from planner.rollouts.engine import choose_engine
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.tables import AllPairs, by_price
from planner.rollouts.threshold_classes import sums_by_threshold
from planner.settings import AUTO, MOST_PRIORITY, SEARCHED, Settings
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults
from planner.world.uncertain_maps import LARGEST, Hazard, Uncertain
from planner.world.world import World

USUAL = 4096
"""Default number of rollouts of each finalist."""


def check_search(world: World, settings: Settings, choices: RolloutChoices, name: str) -> None:
    """Raise InputError for input that searches do not support: uncertain maps, open-loop plans, too many rollouts."""
    world.require_certain_map(name, hazards=choices.loop == "open")
    settings.require_uniform(name)
    if settings.plan_for != "closed_loop":
        raise PlanError(f"plan_for is {settings.plan_for} in {name}", expected="closed_loop", fix="leave it out")
    if choices.rollouts > MOST_ROLLOUTS // 2:
        expected = f"at most {MOST_ROLLOUTS // 2}: the best is confirmed on as many others"
        raise UsageError(argument("rollouts", choices.rollouts), expected=expected)


def screened(settings: Settings, world: World) -> tuple[str, ...]:
    """A note if the bounds used for screening are invalid because some failures do not follow p of each visit."""
    said = settings.failure_model().description or (world.uncertainty and world.uncertainty.description)
    return (f"screened without {said}: the bounds only order the candidates",) if said else ()


# The state of every search: its map, settings and rollouts, the trials of its candidates, and its interruption.


class Search:
    """State that the searches share.

    Attributes:
        cells: number of cells that robots at the starts can reach. exact: whether all results so far are exact.
        partial: whether the search was interrupted. notes: for the user. kept: cache of the map's distance tables.
    """

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        progress: ProgressCallback | None = None,
        doing: Doing | None = None,
    ) -> None:
        """`starts`: int64 `[K, 2]`, of the team; of searches for a team, cells in the same part of the map."""
        self.world, self.starts, self.settings = world, starts, settings
        check_metric(choices, settings)
        self.choices = choices.timed(world.pace)
        self.progress, self.doing = progress or quiet, doing or quiet
        self.accessible = world.accessible(starts)
        self.cells = int(self.accessible.sum())
        self.kept, self.exact, self.partial, self.notes = AllPairs(), True, False, list[str]()

    def trial(self, **other: Any) -> Trial:
        """A trial of a new plan, before its nominal run; `other`: a `world`, `starts`, `settings` or `choices`."""
        made = {name: other.get(name, getattr(self, name)) for name in ("world", "starts", "settings", "choices")}
        # The open loop follows the paths of the nominal run.
        planner = make_plan if self.choices.loop == "open" else allocated_plan
        plan = planner(made["world"], made["starts"], made["settings"])
        return Trial(made["world"], plan, made["choices"], self.kept)

    @contextmanager
    def stoppable(self, found: Callable[[], object]) -> Iterator[None]:
        """Work that an interrupt ends, after which the search is `partial`; it is raised while nothing is `found`."""
        try:
            yield
        except KeyboardInterrupt:
            if not found():
                raise
            self.partial = True

    def fields(self) -> dict[str, Any]:
        """The fields that all results have (`analysis.report.result.Searched`)."""
        engine = "" if self.exact else choose_engine(self.choices.engine).name
        return {
            "world": self.world, "settings": self.settings, "choices": self.choices, "cells": self.cells,
            "engine": engine, "partial": self.partial, "notes": tuple(self.notes),
        }  # fmt: skip


def schedule(contenders: int, rollouts: int) -> list[tuple[int, int]]:
    """(remaining candidates, total rollouts of each) for every round; the last two candidates get all rollouts."""
    looks = max(1, math.ceil(math.log2(max(contenders, 1))))
    return [
        (max(-(-contenders // 2**look), min(2, contenders)), -(-rollouts // 2 ** (looks - 1 - look)))
        for look in range(looks)
    ]


class Halving:
    """Successive halving over candidates of one team size.

    Attributes:
        runs: results by candidate. ranked: the remaining candidates, the best first.
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
        """Set up the race.

        Args:
            contenders: functions that make a trial each; a trial that is not kept is made again.
            rollouts: of each finalist. room: number of trials kept in memory.
            kept: groups of candidates; the best of each group stays in every round.
            exact: whether exact values are attempted. least: the best candidate is the one with the least coverage.
        """
        self.contenders, self.rollouts, self.room, self.kept = contenders, rollouts, room, kept
        self._looks_for_exact, self._sign = exact, 1.0 if least else -1.0
        self.runs: dict[int, Measured] = {}
        self.ranked = list(range(len(contenders)))
        self._trials: dict[int, Trial] = {}

    @property
    def rolled(self) -> int:
        """Rollouts done so far, of all candidates."""
        return sum(found.rollouts for found in self.runs.values())

    @property
    def exact(self) -> bool:
        """Whether all results are exact."""
        return all(found.exact for found in self.runs.values())

    def run(self, progress: ProgressCallback | None = None) -> None:
        """Run all rounds. After an interruption `runs` and `best` hold the results so far."""
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
        """Whether all candidates are known exactly, each within its share of the time; then `runs` holds the values."""
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
        """The `size` best candidates, and the best of each group that is kept."""
        leaders = {next(one for one in self.ranked if one in group) for group in self.kept}
        return [one for place, one in enumerate(self.ranked) if place < size or one in leaders]

    def _trial(self, contender: int) -> Trial:
        if contender not in self._trials:
            self._trials[contender] = self.contenders[contender]()
        return self._trials[contender]

    def _extend(self, contender: int, upto: int) -> None:
        # Rollouts are numbered: a later round continues at the next id.
        start = self.runs[contender].rollouts if contender in self.runs else 0
        more, before = self._trial(contender).sample(start, upto - start), self.runs.get(contender)
        self.runs[contender] = before + more if isinstance(before, Sampled) else more

    def _forget(self, done: Sequence[int], after: int) -> None:
        """Drop the trials of `done` except the `after` best, and all trials beyond `room`."""
        for contender in sorted(done, key=self._rank)[after:]:
            self._trials.pop(contender, None)
        for contender in sorted(self._trials.keys() & self.runs.keys(), key=self._rank)[self.room :]:
            del self._trials[contender]

    def _rank(self, contender: int) -> tuple[float, int]:
        return self._sign * self.runs[contender].share, contender

    @property
    def best(self) -> int:
        """Of the candidates with most rollouts, the one with the highest coverage or value (the lowest, if `least`)."""
        return self.best_of(range(len(self.contenders)))

    def best_of(self, some: Collection[int]) -> int:
        """The best of `some` candidates; of all, if none of these has rollouts."""
        known = [contender for contender in self.ranked if contender in self.runs]
        seen = [contender for contender in known if contender in some] or known
        return min(seen, key=lambda contender: (-self.runs[contender].rollouts, *self._rank(contender)))

    def confirm(self, contender: int) -> Measured:
        """The result of a candidate on as many other rollouts, ids from `rollouts` on; or its exact result."""
        found = self.runs[contender]
        return found if found.exact else self._trial(contender).sample(self.rollouts, self.rollouts)

    def behind(self, contender: int, ahead: int | None = None) -> tuple[float, float]:
        """Interval of the difference between the best and a candidate, a share of all cells (or of all value).

        Args:
            contender: the candidate. ahead: another candidate instead of the best.

        The intervals of one search hold simultaneously with 95 %, for any best candidate and any round of elimination:
        `bet_interval` at a level that is divided among all pairs.
        """
        best, other = self.runs[self.best if ahead is None else ahead], self.runs[contender]
        best, other = (other, best) if self._sign > 0 else (best, other)
        figure, count = best.counted, len(self.contenders)
        most = best.largest(figure)
        if isinstance(best, Known) or isinstance(other, Known):
            return best.ahead(other, figure, 1.0 / most).ci95
        # A candidate may be eliminated in any round, so the interval must hold at any stopping time.
        n = min(best.rollouts, other.rollouts)
        apart = (best.column(figure)[:n] - other.column(figure)[:n]) / most
        return bet_interval(np.clip(apart, -1.0, 1.0), error_share(max(count * (count - 1) // 2, 1), 1))


# A better order of the areas of a map: weights of the cells of each area by local search (SPEC section 11, `priority`)
#
# A rule prices areas one by one, and ignores the areas behind them and the other robots nearby. A weight for each area
# corrects that. Moves of a few weights, more often of large areas, are kept if the coverage does not fall: by the exact
# tree if that is fast, else on common random numbers.

ROLLOUTS = 512
"""Rollouts of each order, if its tree takes too long."""
AT_ONCE = 0.01
"""Share of the seconds for a tree within which an order must be known exactly."""
FINE = 8
"""Weights are integer powers of 2 ** (1 / FINE)."""
FURTHEST = 5
"""A move multiplies or divides a weight by 2 ** (2 ** n / FINE), n below this: by 1.1 to 4."""


def can_order(settings: Settings) -> bool:
    """Whether the policy orders areas by price, without a robot value that excludes areas."""
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
    """The settings with the best `priority` after `tries` moves, or as many as were `in_time`."""
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
        # Equal coverage is accepted, so that the search can cross plateaus.
        if covered >= most:
            best, most = tried, covered
    return replace(settings, priority=tuple(_priority(plan, best).tolist()))


def _priority(plan: Plan, powers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Weight of each cell, int64 `[N]`, from the exponents `[areas]` of the areas at t = 0."""
    found = np.full(plan.shape[0] * plan.shape[1], MOST_PRIORITY, dtype=np.int64)
    shares = np.rint(MOST_PRIORITY * 2.0 ** ((powers - powers.max()) / FINE)).astype(np.int64)
    for area, share in zip(plan.areas, np.maximum(shares, 1), strict=True):
        found[area.cells] = share
    return found


def _counting(loop: ClosedLoop, problem: Problem, priority: NDArray[np.int64]) -> ClosedLoop:
    """The loop of robots that weight cells by `priority`."""
    assert loop.policy is not None
    value = decision_values(problem.world, problem.levels.accessible, tuple(priority.tolist()))
    assert value is not None
    t = loop.tables
    ranks = by_price(replace(problem, value=value), t.area_cost, loop.cells, t.order, t.begin, t.level)
    return replace(loop, tables=t._replace(**ranks), policy=loop.policy._replace(value=value[loop.cells]))


def _covered(trial: Trial, exact: bool) -> float:
    """The share of cells (or of value) covered; -1 if the exact value is missing where others are exact."""
    if not exact:
        return trial.sample(0, ROLLOUTS).share
    known = trial.known(2 * AT_ONCE)
    return -1.0 if known is None else known.share


# The best policy on a map: a few settings raced on common random numbers, and the winner confirmed on other ones.
#
# The settings were selected on random maps: `watchful` with several caps on the robots at risk, and with safe areas at
# t = 0 shared or not; `per_cell`; and the paper's rule. Then the order of the areas is improved.

SHARES = (1 / 8, 1 / 4, 1 / 2)
"""Shares of the robots alive that may be at risk at once (a single robot is raced too), and shares of a robot's part of
the cells that it carries home at once."""
ALONE = 1e6
"""A density d at which no safe area is shared at t = 0."""
BASE = PER_CELL.name
"""The rule that is raced under limits on the team."""
TRIES = 50
"""Orders of areas tried for each second of the search, on any machine."""
SEARCH_SEED = 2**64 - 1
"""Seed of the search. It is reserved, so that the result is evaluated on other random numbers."""

BEST_OF = "the best of "
"""Start of the note in a plan that was searched for."""


class _TimeOver(Exception):
    """Ends the race; it is caught in `plan_best`."""


def plan_best(
    world: World, starts: NDArray[np.int64], settings: Settings, seconds: float | None, *searched: str
) -> Plan:
    """The plan of the best of `contenders` and `deliveries`; its last note names the setting and its gain.

    Args:
        world, starts: the map, and int64 `[K, 2]`. settings: common settings of all candidates.
        seconds: time limit of the race (None: SECONDS). A race that ends earlier gives the same plan everywhere.
        searched: what to search for, one or more of SEARCHED. With `deliver_every` the best is the one that delivers
            most cells.

    Raises:
        InputError: the world or the settings are not supported.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    asked, delivers = argument(searched[0], SEARCHED[searched[0]][0]), "deliver_every" in searched
    if delivers and settings.return_to is None:
        fix = f"give it, or leave {argument('deliver_every')} out"
        raise PlanError(f"{argument('deliver_every', AUTO)} without {argument('return_to')}", fix=fix)
    choices = RolloutChoices(rollouts=USUAL, seed=SEARCH_SEED, metric="delivered" if delivers else "visited")
    check_search(world, settings, choices, asked)
    raced, kept = contenders(settings, len(starts)) if "policy" in searched else [settings], AllPairs()
    if delivers:
        raced = [replace(one, deliver_every=most) for most in deliveries(world, starts, settings) for one in raced]
    makers = [partial(_trial, world, starts, one, choices, kept) for one in raced]
    for maker in (*makers[:2], makers[-1]):  # compile before the clock starts
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
    if in_time and "policy" in searched and can_order(found):
        tries = round(TRIES * (seconds or SECONDS))
        found = order_areas(world, starts, found, choices, kept, tries, lambda: time.perf_counter() < ends)
        ordered = partial(_trial, world, starts, found, choices, kept)
        before, after = alike([maker(), ordered()], 0, USUAL)
        found, maker = (found, ordered) if after.share > before.share else (raced[race.best], maker)
        in_time = time.perf_counter() < ends
    made = make_plan(world, starts, found)
    # Rollouts from id USUAL on had no part in the choice, so that the gain is unbiased.
    best, plain = alike([maker(), makers[0]()], USUAL, USUAL)
    gain = best.ahead(plain, best.counted, 1.0 / best.largest(best.counted))
    gained = gain.more(100, " points", ("more", "less")) + " delivered" * delivers
    more = f", {gained} than {policy_text(raced[0])} on other random numbers" if found != raced[0] else ""
    over = "" if in_time else f"; the search ended after {seconds or SECONDS:g} s"
    note = f"{BEST_OF}{counted(len(raced), 'setting')} is {policy_text(found)}{more}{over}"
    return replace(made, notes=(*made.notes, note))


def is_best(plan: Plan) -> bool:
    """Whether the plan is the result of `plan_best`."""
    return any(note.startswith(BEST_OF) for note in plan.notes)


def contenders(settings: Settings, robots: int) -> list[Settings]:
    """The candidates: the paper's rule first, or the plainest rule under limits; given settings are not varied."""
    watchful = replace(settings, policy=WATCHFUL.name)
    most = {max(1, math.ceil(share * robots)): share for share in (*SHARES[::-1], 1 / robots)}
    risk_caps = [settings.risk_cap] if settings.risk_cap is not None else [None, *(most[m] for m in most if m < robots)]
    densities = [settings.density, ALONE] if settings.density == Settings.density else [settings.density]
    limited = settings.risk_cap is not None or settings.robot_value is not None
    return [replace(settings, policy=policy) for policy in (DEFAULT, BASE)[limited:]] + [
        replace(watchful, risk_cap=risk_cap, density=density) for density in densities for risk_cap in risk_caps
    ]


def deliveries(world: World, starts: NDArray[np.int64], settings: Settings) -> list[int | None]:
    """Cells with which a robot returns: only at the end, then those of a mean area, and SHARES of a robot's part."""
    areas, cells = len(allocated_plan(world, starts, settings).areas), int(world.accessible(starts).sum())
    counts = {max(round(cells * share), 1) for share in (1 / areas, *(share / len(starts) for share in SHARES))}
    return [None, *sorted(counts)]


def _trial(
    world: World, starts: NDArray[np.int64], settings: Settings, choices: RolloutChoices, kept: AllPairs
) -> Trial:
    return Trial(world, allocated_plan(world, starts, settings), choices, kept)


# The team of a plan with another sensor; with a known map; with known hazards. In the last two each rollout has its own
# plan.

MOST_MAPS = 64
"""Most maps that are planned on: those of the first rollouts."""
HISTOGRAMS = ("visited", "survived", "time", "alive")


def with_eyes(world: World, plan: Plan, far: float, choices: RolloutChoices) -> Trial:
    """The team with a sensor of range `far`, in cells, and a new plan; inf: a known map, unless the map is drawn."""
    assert world.knowledge is not None
    if far == world.knowledge.sensor.range:
        return Trial(world, plan, choices)
    other = world.with_range(far)
    return Trial(other, allocated_plan(other, plan.starts, plan.require(world)), choices)


def sample_with_known_maps(
    world: World, plan: Plan, choices: RolloutChoices, count: int
) -> tuple[Sampled, NDArray[np.bool_]]:
    """Rollouts `0 .. count - 1` of the plan's team, each with a plan for its own, known map.

    Returns:
        The sample, and bool `[count]`: the rollouts in it, whose map is one of the first MOST_MAPS.
    """
    uncertainty, settings = world.uncertainty, plan.require(world)
    assert isinstance(uncertainty, Uncertain)
    rows = rows_met(uncertainty, choices.seed, np.arange(count))[:, 0]
    met, first, which = np.unique(rows, return_index=True, return_inverse=True)
    kept = np.sort(np.argsort(first)[:MOST_MAPS])
    results = []
    for row in met[kept].tolist():
        one = replace(world, threat=uncertainty.threat_at(row), uncertainty=None, knowledge=None)
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


def sample_with_known_hazards(world: World, plan: Plan, choices: RolloutChoices, count: int) -> Sampled:
    """Rollouts `0 .. count - 1` of the plan's team, each with a plan for its own, known hazards.

    A visit of a hazard destroys the robot with probability h; h = 1 is planned as the largest value below 1.
    """
    uncertainty, settings, results = world.uncertainty, plan.require(world), []
    assert isinstance(uncertainty, Hazard)
    for rollout, there in enumerate(hazards_met(uncertainty, choices.seed, np.arange(count))):
        q = np.where(there.reshape(world.shape), np.where(uncertainty.h < 1, 1.0, LARGEST), 0.0)
        known = replace(uncertainty, q=np.where(world.free, q, np.nan).astype(np.float32), detector=None)
        one = replace(world, threat=known.threat, uncertainty=known)
        sample = Trial(one, allocated_plan(one, plan.starts, settings), choices).sample(rollout, 1)
        assert sample.results is not None
        results.append(sample.results)
    joined = RolloutResults.join(results)
    return only(replace(sample, results=joined), np.ones(count, dtype=np.bool_))


def only(sample: Sampled, kept: NDArray[np.bool_]) -> Sampled:
    """Selected rollouts of a sample that starts at id 0; the sums for the control variate only if all are kept."""
    assert sample.results is not None
    columns = {of.name: getattr(sample.results, of.name)[kept] for of in fields(RolloutResults)[1:]}
    results, tally, seed = RolloutResults(0, **columns), sample.tally, sample.seed if kept.all() else None
    sizes = {name: max(len(getattr(tally, name)), getattr(results, name).max(initial=0) + 1) for name in HISTOGRAMS}
    counts: dict[str, Any] = {name: np.bincount(getattr(results, name), minlength=size) for name, size in sizes.items()}
    counts["outcomes"] = np.bincount(results.outcome, minlength=len(Outcome))
    if seed is not None:
        counts["by_threshold"] = sums_by_threshold(results, seed, tally.robots)
    ids = ((0, int(kept.sum())),)
    return replace(sample, tally=replace(tally, ids=ids, **counts), results=results, seed=seed)
