"""How many robots are needed: the smallest team whose expected coverage, or whose chance of it, reaches a target.

Every team is planned anew for its starts, the first so many of one list, and rolled out with the same seed: robot i
meets the same luck in teams of every size (SPEC section 14), so that the curve over the teams is smooth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Measured, Trial
from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import TARGETS, Estimate, exactly, is_at_least, looks, share_of_doubt
from analysis.theory.exact import Worth
from analysis.theory.verdicts import longest_run
from analysis.utils.notes import Doing, ProgressCallback, of_things, quiet
from planner.arguments import BLOCK, MOST_ROLLOUTS, Numbers, argument, check_word, whole
from planner.errors import UsageError
from planner.formatting import counted
from planner.plan_team import plan_team
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.world.levels import place_starts
from planner.world.world import MAX_ROBOTS, World

# The rules behind `mrac-jax size`: when a team is enough, which teams are looked at, and which cannot be enough.
#
# Pure functions of counts and numbers; what rolls out is `analysis.search.team_size`.

FEW = 32
"""So many teams below the one found are all looked at; of more, the search halves the gap first."""


class TeamVerdict(StrEnum):
    """What is known of one team."""

    ENOUGH = "enough"
    NOT_ENOUGH = "not enough"
    UNDECIDED = "undecided"
    IMPOSSIBLE = "impossible"
    """Not enough whatever the strategy: shown without rollouts."""


def judge_team(interval: tuple[float, float], wanted: float) -> TeamVerdict:
    """Enough if the whole interval lies at or above `wanted`, not enough if it lies below, else undecided."""
    verdicts = {True: TeamVerdict.ENOUGH, False: TeamVerdict.NOT_ENOUGH, None: TeamVerdict.UNDECIDED}
    return verdicts[is_at_least(interval, wanted)]


def smallest_enough(first: int, most: int, verdict_of: Callable[[int], TeamVerdict]) -> int | None:
    """The smallest team found to be enough among `first .. most`, or None; `verdict_of` is asked once for each team.

    Coverage need not grow with the team, so neither end of the search relies on it where that can be afforded: teams
    of `first + 0, 1, 2, 4, 8, ...` are looked at until one is enough (or `most` is reached); then all smaller ones
    that were passed over, in increasing order, if they are at most FEW. Of more, the gap below the team found is
    halved until at most FEW are in it, which are all looked at; those passed over elsewhere are not.
    """
    known: dict[int, bool] = {}

    def enough(robots: int) -> bool:
        if robots not in known:
            known[robots] = verdict_of(robots) is TeamVerdict.ENOUGH
        return known[robots]

    below, found = first - 1, None
    for robots in _strides(first, most):
        if enough(robots):
            found = robots
            break
        below = robots
    passed_over = [k for k in range(first, found or most) if k not in known]
    if len(passed_over) > FEW:
        if found is None:
            return None
        while found - below - 1 > FEW:
            middle = (below + found) // 2
            below, found = (below, middle) if enough(middle) else (middle, found)
        passed_over = list(range(below + 1, found))
    return next((robots for robots in passed_over if enough(robots)), found)


def _strides(first: int, most: int) -> Iterator[int]:
    yield first
    stride = 1
    while first + stride < most:
        yield first + stride
        stride *= 2
    if most > first:
        yield most


@dataclass(frozen=True, eq=False)
class Ideals:
    """Upper bounds for every strategy, by team: entry k - 1 is that of k robots, axis `most`.

    Attributes:
        coverage: float64, expected cells visited as a fraction of `cells`.
        chance: float64, chance to visit at least `needed` cells.
    """

    coverage: NDArray[np.float64]
    chance: NDArray[np.float64]


def team_ideals(world: World, starts: NDArray[np.int64], cells: int, needed: int, last_step: int | None) -> Ideals:
    """The ideals of the first 1, 2, ..., K robots of `starts` `[K, 2]` (row, col), for both meanings of "covered".

    The expectation is that of `analysis.theory.bounds.ideal_team`; its terms are chances, so they bound the chance too:
    who visits `needed` cells has lost fewer than k robots on `needed - 1` different cells before, at best on the least
    dangerous. By the end of step T, k robots have entered at most k (T + 1) cells.

    Args:
        cells: of which coverage is a fraction. needed: cells to visit. last_step: T, or None.
    """
    labels = world.components
    own = labels[starts[:, 0], starts[:, 1]]
    coverage, chance = np.zeros(len(starts)), np.zeros(len(starts))
    for robots in range(1, len(starts) + 1):
        if own[robots - 1] not in own[: robots - 1]:  # a part of the map that no robot before it can reach
            threat = world.threat[np.isin(labels, own[:robots])].astype(np.float64)
            expected, reached = ideals_of(threat, len(starts), needed)
        coverage[robots - 1], chance[robots - 1] = expected[robots - 1], reached[robots - 1]
    if last_step is not None:
        entries = np.arange(1, len(starts) + 1) * (last_step + 1.0)
        coverage, chance = np.minimum(coverage, entries), np.where(entries < needed, 0.0, chance)
    return Ideals(np.minimum(coverage / cells, 1.0), np.minimum(chance, 1.0))


def ideals_of(threat: NDArray[np.float64], most: int, needed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(expected cells visited, chance to visit `needed` cells) at best by 1, 2, ..., `most` robots, float64 `[most]`.

    `threat`: float64 `[accessible]`, the accessible cells' p. One pass over the dangerous cells for all teams.
    """
    dangerous = np.sort(threat[threat > 0])
    safe = len(threat) - len(dangerous)
    total = np.full(most, float(safe))
    chance = np.full(most, 1.0 if needed <= safe else 0.0)
    hits = np.zeros(most)  # chance of so many hits on the cells so far
    hits[0] = 1.0
    for number, p in enumerate(dangerous, start=safe + 1):
        alive = np.cumsum(hits)
        total += alive
        if number == needed:
            chance = alive
        shifted = hits[:-1] * p
        hits *= 1.0 - p
        hits[1:] += shifted
    return total, chance


Meaning = Literal["visited", "survived"]
CONFIDENCE = 0.95
"""Of `--complete`, when none is given."""
MOST = 64
"""Robots of the largest team that is looked at, when nobody says."""


@dataclass(frozen=True)
class Goal:
    """What a team has to reach to be enough.

    Attributes:
        target: fraction of the accessible cells, 0 < target <= 1.
        confidence: None: the expected coverage is to reach `target`; else the chance to cover at least `target` is to
            reach this, 0 < confidence < 1.
        complete: the target is every accessible cell. meaning: of "covered" (SPEC section 2).
        most: robots of the largest team to look at.
    """

    target: float
    confidence: float | None = None
    complete: bool = False
    meaning: Meaning = "visited"
    most: int = MOST

    @property
    def wanted(self) -> float:
        """What the deciding figure, expected coverage or chance, has to reach."""
        return self.target if self.confidence is None else self.confidence


def make_goal(
    target: float | None,
    confidence: float | None,
    complete: bool,
    meaning: Meaning = "visited",
    most: int | None = None,
) -> Goal:
    """The goal that options ask for; raises UsageError for one out of range, or for a contradiction."""
    check_word("meaning", meaning, ("visited", "survived"))
    if complete and target is not None:
        raise UsageError(f"both {argument('complete')} and {argument('target')} are given", expected="one of them")
    if target is None and not complete:
        expected = f"{argument('target')}, a fraction of the accessible cells, or {argument('complete')}"
        raise UsageError("no target", expected=expected)
    TARGETS.check("target", target, optional=True)
    Numbers(0, 1, "a chance", above=True, below=True).check("confidence", confidence, optional=True)
    whole(1, MAX_ROBOTS).check("most", most, optional=True)
    if complete and confidence is None:
        confidence = CONFIDENCE
    return Goal(1.0 if target is None else target, confidence, complete, meaning, most or MOST)


@dataclass(frozen=True)
class TeamPoint:
    """One team of the curve. Estimates are None for a team that was not rolled out.

    Attributes:
        robots: its size. verdict: whether it is enough.
        ideal_coverage, ideal_chance: what no strategy of so many robots exceeds: mean fraction, and chance.
        rollouts: how many were run; 0: all is known without. interval: of the deciding figure, what the verdict is
            drawn from.
        coverage: fraction of the accessible cells. chance: to cover at least the target. time: steps. alive: robots.
        exact: the coverage is known, not sampled.
        value: visited, a fraction of what all free cells are worth; None: nobody said what that is.
    """

    robots: int
    verdict: TeamVerdict
    ideal_coverage: float
    ideal_chance: float
    rollouts: int = 0
    interval: tuple[float, float] | None = None
    coverage: Estimate | None = None
    chance: Estimate | None = None
    time: Estimate | None = None
    alive: Estimate | None = None
    exact: bool = False
    value: Estimate | None = None


@dataclass(frozen=True, eq=False, repr=False)
class TeamSize(Answer):
    """The answer.

    Attributes:
        world, starts: where; int64 `[K, 2]` of the largest team. settings: of its plans. goal, choices: what was asked.
        cells: accessible cells, those that the largest team can reach. needed: how many of them the target is.
        points: the teams looked at or ruled out, by size. robots: the smallest that is enough, or None (also
            when it was interrupted).
        doubt: chance of error of a single look at one team (see `share_of_doubt`).
        confirmed: the team found on fresh rollouts, ids that none of the teams had; None: its figures are exact.
        engine: that rolled out; "" if nothing was. partial: True if it was interrupted. notes: what a user should know.
    """

    reported_by = "analysis.search.reports:size_report"
    listed = "curve"

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    goal: Goal
    choices: RolloutChoices
    cells: int
    needed: int
    points: tuple[TeamPoint, ...]
    robots: int | None
    doubt: float
    confirmed: TeamPoint | None = None
    engine: str = ""
    partial: bool = False
    notes: tuple[str, ...] = ()

    def of(self, verdict: TeamVerdict) -> tuple[int, ...]:
        """The teams with this verdict that could still be the smallest: those below the one found, if there is one."""
        found = self.robots or len(self.starts) + 1
        return tuple(point.robots for point in self.points if point.verdict is verdict and point.robots < found)

    @property
    def deadline(self) -> int | None:
        """The step up to which all is counted: what was asked, else the mission's own."""
        return self.choices.deadline if self.choices.deadline is not None else self.settings.deadline

    @property
    def passed_over(self) -> tuple[int, ...]:
        """The teams below the one found (or all) that were neither looked at nor ruled out."""
        seen = {point.robots for point in self.points}
        return tuple(k for k in range(1, self.robots or len(self.starts) + 1) if k not in seen)

    def point(self, robots: int) -> TeamPoint:
        """The point of a team that is there."""
        return next(point for point in self.points if point.robots == robots)


def team_starts(world: World, goal: Goal) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """(starts of the largest team, int64 `[K, 2]`, notes); smaller teams take the first of them.

    They are the world's own if it has any, at most so many as there are; else those of the start rule.
    """
    if world.starts is None:
        return place_starts(world, goal.most)
    given = len(world.starts)
    if given >= goal.most:
        return world.starts[: goal.most], ()
    return world.starts, (f"{given} starts are given, so no team of more than {given} is looked at",)


def find_size(
    world: World,
    settings: Settings,
    goal: Goal,
    choices: RolloutChoices,
    *,
    progress: ProgressCallback = quiet,
    doing: Doing = quiet,
) -> TeamSize:
    """The smallest team that is enough.

    A team is rolled out until the interval of its deciding figure leaves the wanted value on one side, looked at only
    after 1,024 * 2**j rollouts and after `choices.rollouts`; with `choices.precision` until the 95 % interval of its
    mean coverage is that narrow. All verdicts of the search together hold with 95 % confidence (`share_of_doubt`); the
    intervals behind them hold for every number of rollouts (`mean_interval`, `chance_interval`). Nothing is rolled out
    of a team whose tree ends in time (`analysis.estimators.trial`), and expected coverage of the open loop is exact.
    Coverage is a fraction of the cells that the largest team can reach: where starts lie in several parts of the map, a
    smaller team reaches fewer. With `choices.deadline` everything is counted up to the end of that step.

    An interruption (KeyboardInterrupt) ends it with what was done, `partial`; if that is nothing, it is raised again.
    Raises InputError.
    """
    settings.check()
    choices = choices.timed(world.pace)
    search = _Search(world, settings, goal, choices, progress, doing)
    robots, partial = None, False
    try:
        if search.first is not None:
            robots = smallest_enough(search.first, len(search.starts), search.look_at)
    except KeyboardInterrupt:
        if all(point.coverage is None for point in search.points.values()):
            raise
        partial = True
    answer = search.result(robots, partial)
    try:
        return answer if robots is None else replace(answer, confirmed=search.confirm(robots))
    except KeyboardInterrupt:
        return replace(answer, partial=True)


def _check_alike(settings: Settings) -> None:
    """Raise UsageError for ranges or susceptibilities one a robot: teams of other sizes have none."""
    for name in ("range", "hazard_multiplier", "types", "steps_per_move"):
        given = getattr(settings, name)
        if isinstance(given, tuple):
            problem = f"{argument(name)} of {len(given)} robots, and teams of other sizes"
            raise UsageError(problem, expected="one number for all")


class _Search:
    """The teams looked at so far."""

    def __init__(
        self, world: World, settings: Settings, goal: Goal, choices: RolloutChoices, progress: ProgressCallback,
        doing: Doing,
    ) -> None:  # fmt: skip
        world.check_settled("the search for the smallest team")
        self.world, self.settings, self.goal, self.choices = world, settings, goal, choices
        self.progress, self.doing = progress, doing
        self.starts, self.notes = team_starts(world, goal)
        accessible = world.accessible(self.starts)
        self.cells = int(accessible.sum())
        self.safe = not (world.threat[accessible] > 0).any()
        self._check()
        self.needed = math.ceil(goal.target * self.cells - 1e-9)
        _check_alike(settings)
        moves = settings.range if settings.recharge is None else None
        ends = [end for end in (choices.deadline, settings.last_step, moves) if isinstance(end, int)]
        self.ideals: Ideals = team_ideals(world, self.starts, self.cells, self.needed, min(ends, default=None))
        if not settings.bearing().is_plain:  # they presume that a visit stops with p
            self.ideals = Ideals(np.ones(len(self.starts)), np.ones(len(self.starts)))
        bound = self.ideals.coverage if goal.confidence is None else self.ideals.chance
        able = np.array([is_at_least((0.0, float(best)), goal.wanted) is not False for best in bound])
        self.first = int(able.argmax()) + 1 if able.any() else None
        marks = set(looks(BLOCK))
        if choices.precision is None:
            marks = {mark for mark in marks if mark < choices.rollouts} | {choices.rollouts}
        self.marks = marks
        able_teams = len(self.starts) + 1 - self.first if self.first else 1
        self.doubt = share_of_doubt(able_teams, len(marks))
        self.engine, self.all_pairs = "", AllPairs()
        ruled_out = range(1, self.first or len(self.starts) + 1)
        self.points = {k: self._unseen(k, TeamVerdict.IMPOSSIBLE) for k in ruled_out}

    def _check(self) -> None:
        """Refuse what no number of rollouts can decide."""
        sampled = self.choices.loop == "closed" and not self.safe
        if sampled and self.goal.confidence is None and self.goal.target == 1:
            raise UsageError(
                f"{argument('target', 1)}: no number of rollouts shows that the average is exactly 1",
                expected="a target below 1",
                fix=f"or use {argument('complete')}, or {argument('confidence')} with it",
            )

    def _unseen(self, robots: int, verdict: TeamVerdict) -> TeamPoint:
        best = self.ideals
        return TeamPoint(robots, verdict, float(best.coverage[robots - 1]), float(best.chance[robots - 1]))

    def look_at(self, robots: int) -> TeamVerdict:
        """Plan and roll out a team until its verdict is clear, or for as long as the choices allow."""
        self.doing(counted(robots, "robot"))
        trial, last = self._trial(robots), None
        try:
            for found in self._rolled(trial):
                last = found
                if found.certain or found.rollouts in self.marks:
                    point = self._point(trial, found)
                    if found.certain or self._enough_rollouts(point):
                        break
        except KeyboardInterrupt:
            if last is not None:
                self.points[robots] = replace(self._point(trial, last), verdict=TeamVerdict.UNDECIDED)
            raise
        self.points[robots] = point
        return point.verdict

    def _trial(self, robots: int) -> Trial:
        plan = plan_team(self.world, self.starts[:robots], self.settings)
        return Trial(self.world, plan, self.choices, self.all_pairs)

    def _rolled(self, trial: Trial, start: int = 0, count: int | None = None) -> Iterator[Measured]:
        """What the team comes to: exactly; or where it stands after every so many rollouts."""
        known, choices = trial.known(), self.choices
        if known is not None:
            histories = known.tree.histories
            of_things(self.progress, "histories")(histories, histories, known.tree.seconds)
            yield known
            return
        most = choices.rollouts if choices.precision is None else MOST_ROLLOUTS
        total = count or (choices.rollouts if choices.precision is None else 0)
        for found in trial.roll(start, 1 if trial.certain else count or most, looks()):
            self.engine = trial.engine.name
            self.progress(found.rollouts, total, found.seconds)
            yield found

    def _enough_rollouts(self, point: TeamPoint) -> bool:
        if self.choices.precision is None:
            return point.verdict is not TeamVerdict.UNDECIDED
        assert point.coverage is not None
        return point.coverage.half_width < self.choices.precision

    def _point(self, trial: Trial, found: Measured) -> TeamPoint:
        """What a team comes to; in the open loop means are exact."""
        meaning, known = self.goal.meaning, trial.open_loop
        coverage, chance = found.mean(meaning, 1.0 / self.cells), found.chance(meaning, self.needed)
        value = found.mean("value") if found.counted == "value" else None
        low, high = (end / self.cells for end in found.bounds(meaning, self.doubt))
        if known is not None:
            coverage = exactly(getattr(known, meaning) / self.cells)
            low, high = coverage.ci95
            if self.world.value is not None:
                worth = Worth.of(self.world)
                value = exactly(float(worth.value @ known.visited_by_cell) / worth.total)
        if self.goal.confidence is not None:
            low, high = found.chance_bounds(meaning, self.needed, self.doubt)
        robots = len(trial.plan.robots)
        return replace(
            self._unseen(robots, judge_team((low, high), self.goal.wanted)),
            rollouts=found.rollouts,
            interval=(low, high),
            coverage=coverage,
            chance=chance,
            time=found.mean("time", 1.0, longest_run(self.world, trial.plan, self.choices.loop)),
            alive=found.mean("alive"),
            exact=found.exact or known is not None,
            value=value,
        )

    def confirm(self, robots: int) -> TeamPoint | None:
        """The team on as many rollouts that had no part in the choice, from the first that none of the teams had.

        None where its figures are exact, or there are not so many ids.
        """
        count, start = self.points[robots].rollouts, max(point.rollouts for point in self.points.values())
        trial = self._trial(robots)
        if not count or trial.certain or start + count > MOST_ROLLOUTS:
            return None
        *_, last = self._rolled(trial, start, count)
        return self._point(trial, last)

    def result(self, robots: int | None, partial: bool) -> TeamSize:
        """The answer from the points as they stand."""
        return TeamSize(
            world=self.world,
            starts=self.starts,
            settings=self.settings,
            goal=self.goal,
            choices=self.choices,
            cells=self.cells,
            needed=self.needed,
            points=tuple(self.points[k] for k in sorted(self.points)),
            robots=robots,
            doubt=self.doubt,
            engine=self.engine,
            partial=partial,
            notes=self.notes,
        )
