"""The smallest team whose expected coverage, or whose chance of it, reaches a target.

Each team is planned for the first starts of one list and simulated with the same seed. Robot i has the same random
numbers in teams of every size (docs/spec.md section 14), so that the curve over the team size is smooth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import Search
from analysis.estimators.trial import Measured, Trial
from analysis.report.result import Searched, cell_counts
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import TARGETS, Estimate, error_share, exactly, is_at_least, looks
from analysis.theory.exact import CellValues
from analysis.theory.verdicts import longest_run
from analysis.utils.notes import Doing, ProgressCallback, of_things, quiet
from planner.arguments import BLOCK, MOST_ROLLOUTS, Numbers, argument, check_word, whole
from planner.errors import UsageError
from planner.formatting import counted
from planner.open_loop import plan_team
from planner.settings import METRICS, Settings
from planner.world.start_rule import place_starts
from planner.world.world import MAX_ROBOTS, World

# Rules of `mrac-jax size`: verdicts, the order of the search, and upper bounds. Pure functions of numbers.

FEW = 32
"""Up to this many teams below the one found are all simulated; a larger gap is halved first."""


class TeamVerdict(StrEnum):
    """The decision on one team."""

    ENOUGH = "enough"
    NOT_ENOUGH = "not enough"
    UNDECIDED = "undecided"
    IMPOSSIBLE = "impossible"
    """Not enough for any policy: shown by an upper bound, without rollouts."""


def verdict_of_team(interval: tuple[float, float], wanted: float) -> TeamVerdict:
    """ENOUGH if the whole interval is at or above `wanted`, NOT_ENOUGH if it is below, else UNDECIDED."""
    verdicts = {True: TeamVerdict.ENOUGH, False: TeamVerdict.NOT_ENOUGH, None: TeamVerdict.UNDECIDED}
    return verdicts[is_at_least(interval, wanted)]


def smallest_enough(first: int, most: int, verdict_of: Callable[[int], TeamVerdict]) -> int | None:
    """The smallest team found to be enough among `first .. most`, or None; `verdict_of` is called once for each team.

    Coverage need not increase with the team size, so a pure bisection could miss a smaller team. Teams of
    `first + 0, 1, 2, 4, 8, ...` are simulated until one is enough or `most` is reached; then all smaller teams that
    were skipped, in increasing order, if they are at most FEW. If there are more, the gap below the team found is
    halved until at most FEW remain in it, which are all simulated; teams skipped elsewhere are not.
    """
    known: dict[int, bool] = {}

    def enough(robots: int) -> bool:
        if robots not in known:
            known[robots] = verdict_of(robots) is TeamVerdict.ENOUGH
        return known[robots]

    below, found = first - 1, None
    strides = [first + 2**power for power in range(most.bit_length()) if first + 2**power < most]
    for robots in dict.fromkeys([first, *strides, most]):
        if enough(robots):
            found = robots
            break
        below = robots
    # `found` itself is known, so only smaller teams remain.
    passed_over = [k for k in range(first, found or most) if k not in known]
    if len(passed_over) > FEW:
        if found is None:
            return None
        while found - below - 1 > FEW:
            middle = (below + found) // 2
            below, found = (below, middle) if enough(middle) else (middle, found)
        passed_over = list(range(below + 1, found))
    return next((robots for robots in passed_over if enough(robots)), found)


@dataclass(frozen=True, eq=False)
class TeamBounds:
    """Policy-independent upper bounds by team size: entry k - 1 is that of k robots, axis `most`.

    Attributes:
        coverage: float64, expected cells visited as a fraction of `cells`.
        chance: float64, chance to visit at least `needed` cells.
    """

    coverage: NDArray[np.float64]
    chance: NDArray[np.float64]


def team_upper_bounds(
    world: World, starts: NDArray[np.int64], cells: int, needed: int, last_step: int | None
) -> TeamBounds:
    """Upper bounds for the first 1, 2, ..., K robots of `starts` `[K, 2]`, for every metric.

    The bound of the expectation is that of `analysis.theory.bounds.ideal_team`. Its terms bound the chance too: a team
    that visits `needed` cells has lost fewer than k robots on `needed - 1` different cells before, at best on the least
    dangerous ones. By the end of step T, k robots have entered at most k (T + 1) cells.

    Args:
        cells: denominator of the coverage. needed: cells to visit. last_step: T, or None.
    """
    labels = world.components
    own = labels[starts[:, 0], starts[:, 1]]
    coverage, chance = np.zeros(len(starts)), np.zeros(len(starts))
    for robots in range(1, len(starts) + 1):
        # Cells of a component count once, when its first robot joins.
        if own[robots - 1] not in own[: robots - 1]:  # a component that no earlier robot can reach
            threat = world.threat[np.isin(labels, own[:robots])].astype(np.float64)
            expected, reached = upper_bounds_of(threat, len(starts), needed)
        coverage[robots - 1], chance[robots - 1] = expected[robots - 1], reached[robots - 1]
    if last_step is not None:
        entries = np.arange(1, len(starts) + 1) * (last_step + 1.0)
        # A robot enters at most one cell in a step.
        coverage, chance = np.minimum(coverage, entries), np.where(entries < needed, 0.0, chance)
    return TeamBounds(np.minimum(coverage / cells, 1.0), np.minimum(chance, 1.0))


def upper_bounds_of(
    threat: NDArray[np.float64], most: int, needed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Upper bounds of the expected cells visited, and of the chance of `needed`, for 1 .. `most` robots, `[most]` each.

    `threat`: float64 `[accessible]`, p of the accessible cells. One pass over the dangerous cells serves all teams.
    """
    dangerous = np.sort(threat[threat > 0])
    safe = len(threat) - len(dangerous)
    total = np.full(most, float(safe))
    chance = np.full(most, 1.0 if needed <= safe else 0.0)
    hits = np.zeros(most)  # entry k: probability of k losses on the cells so far
    hits[0] = 1.0
    for number, p in enumerate(dangerous, start=safe + 1):
        alive = np.cumsum(hits)
        total += alive
        if number == needed:
            chance = alive
        shifted = hits[:-1] * p
        # Poisson binomial recursion; the last entry is dropped, as a team of `most` can lose no more.
        hits *= 1.0 - p
        hits[1:] += shifted
    return total, chance


CONFIDENCE = 0.95
"""Default confidence with `--complete`."""
MOST = 64
"""Default size of the largest team."""


@dataclass(frozen=True)
class Goal:
    """The target of the search.

    Attributes:
        target: fraction of the accessible cells, 0 < target <= 1.
        confidence: None: the expected coverage must reach `target`; else the probability to cover at least `target`
            must reach this value, 0 < confidence < 1.
        complete: the target is every accessible cell. meaning: the metric, one of METRICS.
        most: size of the largest team.
    """

    target: float
    confidence: float | None = None
    complete: bool = False
    meaning: str = "visited"
    most: int = MOST

    @property
    def wanted(self) -> float:
        """The threshold of the deciding figure, expected coverage or chance."""
        return self.target if self.confidence is None else self.confidence


def make_goal(
    target: float | None, confidence: float | None, complete: bool, meaning: str = "visited", most: int | None = None
) -> Goal:
    """The goal of the options. Raises UsageError for a value out of range, or for a contradiction."""
    check_word("metric", meaning, METRICS)
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
    """One team of the curve. Estimates are None if the team was not simulated.

    Attributes:
        robots: team size. verdict: whether it is enough.
        ideal_coverage, ideal_chance: policy-independent upper bounds: of the mean fraction, and of the chance.
        rollouts: number simulated; 0: all figures are exact. interval: of the deciding figure, for the verdict.
        coverage: fraction of the accessible cells. chance: to cover at least the target. time: steps. alive: robots.
        exact: the coverage is an exact expectation.
        value: visited, a fraction of the value of all free cells; None: the map has no values.
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
    json_keys = """
        robots verdict coverage chance time alive rollouts verdict_interval=interval exact
        ideal.coverage=ideal_coverage ideal.chance=ideal_chance value?
    """


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TeamSize(Searched):
    """The result of `size`; `cells`: number of cells that the largest team can reach.

    Attributes:
        starts: int64 `[K, 2]` of the largest team. goal: as given. needed: number of cells that makes the target.
        points: the teams simulated or excluded by a bound, by size. robots: the smallest that is enough, or None (also
            after an interruption).
        alpha: error probability of one comparison of one team (see `error_share`).
        confirmed: the team found on rollout ids that no team had in the search; None: its figures are exact.
    """

    reported_by = "analysis.search.reports:size_report"
    listed = "curve"

    starts: NDArray[np.int64]
    goal: Goal
    needed: int
    points: tuple[TeamPoint, ...]
    robots: int | None
    alpha: float
    confirmed: TeamPoint | None = None
    json_keys = """
        goal.target goal.confidence goal.complete goal.meaning goal.most deadline robots starts=enough_starts
        undecided not_looked_at=passed_over curve=points confirmed cells=cell_counts choices.loop
    """

    @property
    def enough_starts(self) -> NDArray[np.int64] | None:
        """Start cells `[row, col]` of the smallest team that is enough; None without one."""
        return None if self.robots is None else self.starts[: self.robots]

    @property
    def undecided(self) -> tuple[int, ...]:
        """Teams that are undecided and may still be the smallest."""
        return self.of(TeamVerdict.UNDECIDED)

    @property
    def cell_counts(self) -> dict[str, int]:
        """Numbers of cells: total, free, accessible, dangerous, and needed for the target."""
        return cell_counts(self.world, self.world.accessible(self.starts)) | {"needed": self.needed}

    def of(self, verdict: TeamVerdict) -> tuple[int, ...]:
        """The teams with this verdict that may still be the smallest: those below the one found, if there is one."""
        found = self.robots or len(self.starts) + 1
        return tuple(point.robots for point in self.points if point.verdict is verdict and point.robots < found)

    @property
    def deadline(self) -> int | None:
        """The step up to which all is counted: the given deadline, else the mission's."""
        return self.choices.deadline if self.choices.deadline is not None else self.settings.deadline

    @property
    def passed_over(self) -> tuple[int, ...]:
        """The teams below the one found (or all) that were neither simulated nor excluded by a bound."""
        seen = {point.robots for point in self.points}
        return tuple(k for k in range(1, self.robots or len(self.starts) + 1) if k not in seen)

    def point(self, robots: int) -> TeamPoint:
        """The point of a team that is in `points`."""
        return next(point for point in self.points if point.robots == robots)


def team_starts(world: World, goal: Goal) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """(starts of the largest team, int64 `[K, 2]`, notes); smaller teams take the first of them.

    They are the world's starts if it has any, at most the given number; else those of the start rule.
    """
    if world.starts is None:
        return place_starts(world, goal.most)
    given = len(world.starts)
    if given >= goal.most:
        return world.starts[: goal.most], ()
    return world.starts, (f"{given} starts are given, so teams of more than {given} are not simulated",)


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

    A team is simulated until the interval of its deciding figure lies on one side of the threshold. The interval is
    computed only after 1,024 * 2**j rollouts and after `choices.rollouts`. With `choices.precision` a team is simulated
    until the 95 % interval of its mean coverage has that half-width. The verdicts of the search are simultaneous with
    95 % confidence (`error_share`); their intervals are valid for every number of rollouts (`mean_interval`,
    `chance_interval`). Teams whose expectations are computed exactly in time are not sampled
    (`analysis.estimators.trial`); expected coverage of the open loop is always exact. Coverage is a fraction of the
    cells that the largest team can reach; a smaller team may reach fewer components. With `choices.deadline` all is
    counted up to the end of that step.

    Returns:
        The result. After an interruption (KeyboardInterrupt): the teams done so far, `partial`.

    Raises:
        InputError: an argument or setting out of range.
        KeyboardInterrupt: before the first team was simulated.
    """
    settings.check()
    search = _Search(world, settings, goal, choices, progress, doing)
    robots: int | None = None
    with search.stoppable(lambda: any(point.coverage is not None for point in search.points.values())):
        if search.first is not None:  # no team is enough if even the bound of the largest one is too low
            robots = smallest_enough(search.first, len(search.starts), search.look_at)
    confirmed = None
    if robots is not None:
        with search.stoppable(lambda: True):
            confirmed = search.confirm(robots)
    return TeamSize(
        **search.fields(), starts=search.starts, goal=goal, needed=search.needed,
        points=tuple(search.points[k] for k in sorted(search.points)), robots=robots, alpha=search.alpha,
        confirmed=confirmed,
    )  # fmt: skip


def _check_alike(settings: Settings) -> None:
    """Raise UsageError for settings with one value for each robot: they do not fit teams of other sizes."""
    for name in ("range", "hazard_multiplier", "types", "steps_per_move"):
        given = getattr(settings, name)
        if isinstance(given, tuple):
            problem = f"{argument(name)} of {len(given)} robots, and teams of other sizes"
            raise UsageError(problem, expected="one number for all")


class _Search(Search):
    """State of the search: the teams simulated so far."""

    def __init__(
        self, world: World, settings: Settings, goal: Goal, choices: RolloutChoices, progress: ProgressCallback,
        doing: Doing,
    ) -> None:  # fmt: skip
        world.require_certain_map("the search for the smallest team", hazards=choices.loop == "open")
        starts, notes = team_starts(world, goal)
        super().__init__(world, starts, settings, choices, progress, doing)
        choices, self.goal = self.choices, goal
        self.notes += notes
        self.safe = not (world.threat[self.accessible] > 0).any()
        self._check()
        # The tolerance keeps 0.7 * 10 from becoming 8 by rounding.
        self.needed = math.ceil(goal.target * self.cells - 1e-9)
        _check_alike(settings)
        moves = settings.range if settings.recharge is None else None
        ends = [end for end in (choices.deadline, settings.last_step, moves) if isinstance(end, int)]
        self.ideals: TeamBounds = team_upper_bounds(
            world, self.starts, self.cells, self.needed, min(ends, default=None)
        )
        if not settings.failure_model().is_plain:  # the bounds assume that a visit destroys a robot with probability p
            self.ideals = TeamBounds(np.ones(len(self.starts)), np.ones(len(self.starts)))
        bound = self.ideals.coverage if goal.confidence is None else self.ideals.chance
        able = np.array([is_at_least((0.0, float(best)), goal.wanted) is not False for best in bound])
        self.first = int(able.argmax()) + 1 if able.any() else None
        marks = set(looks(BLOCK))
        if choices.precision is None:
            # The last check is at the given number of rollouts, whatever its size.
            marks = {mark for mark in marks if mark < choices.rollouts} | {choices.rollouts}
        self.marks = marks
        able_teams = len(self.starts) + 1 - self.first if self.first else 1
        # Union bound over all teams and checks of the search.
        self.alpha = error_share(able_teams, len(marks))
        ruled_out = range(1, self.first or len(self.starts) + 1)
        self.points = {k: self._unseen(k, TeamVerdict.IMPOSSIBLE) for k in ruled_out}

    def _check(self) -> None:
        """Reject a target that no number of rollouts can decide."""
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
        """Plan and simulate a team until its verdict is clear, or up to the limit of the choices."""
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
            # An interrupted team keeps its figures, but has no verdict.
            if last is not None:
                self.points[robots] = replace(self._point(trial, last), verdict=TeamVerdict.UNDECIDED)
            raise
        self.points[robots] = point
        return point.verdict

    def _trial(self, robots: int) -> Trial:
        plan = plan_team(self.world, self.starts[:robots], self.settings)
        return Trial(self.world, plan, self.choices, self.kept)

    def _rolled(self, trial: Trial, start: int = 0, count: int | None = None) -> Iterator[Measured]:
        """The team's estimates: exact, or cumulative after every block of rollouts."""
        known, choices = trial.known() if trial.loop else None, self.choices
        if known is not None and known.tree is not None:
            histories = known.tree.histories
            of_things(self.progress, "histories")(histories, histories, known.tree.seconds)
            yield known
            return
        most = choices.rollouts if choices.precision is None else MOST_ROLLOUTS
        total = count or (choices.rollouts if choices.precision is None else 0)
        for found in trial.roll(start, 1 if trial.certain else count or most, looks()):
            self.exact = False
            self.progress(found.rollouts, total, found.seconds)
            yield found

    def _enough_rollouts(self, point: TeamPoint) -> bool:
        if self.choices.precision is None:
            return point.verdict is not TeamVerdict.UNDECIDED
        assert point.coverage is not None
        return point.coverage.half_width < self.choices.precision

    def _point(self, trial: Trial, found: Measured) -> TeamPoint:
        """The team's estimates and verdict; in the open loop means are exact."""
        meaning, known = self.goal.meaning, trial.open_loop
        coverage, chance = found.mean(meaning, 1.0 / self.cells), found.chance(meaning, self.needed)
        value = found.mean("value") if found.valued else None
        low, high = (end / self.cells for end in found.bounds(meaning, self.alpha))
        if known is not None and known.is_known:
            coverage = exactly(getattr(known, meaning) / self.cells)
            # An exact mean has a degenerate interval.
            low, high = coverage.ci95
            if self.world.value is not None:
                cell_values = CellValues.of(self.world)
                value = exactly(float(cell_values.value @ known.visited_by_cell) / cell_values.total)
        if self.goal.confidence is not None:
            low, high = found.chance_bounds(meaning, self.needed, self.alpha)
        robots = len(trial.plan.robots)
        return replace(
            self._unseen(robots, verdict_of_team((low, high), self.goal.wanted)),
            rollouts=found.rollouts,
            interval=(low, high),
            coverage=coverage,
            chance=chance,
            time=found.mean("time", 1.0, longest_run(self.world, trial.plan, self.choices.loop)),
            alive=found.mean("alive"),
            exact=found.exact or coverage.half_width == 0,
            value=value,
        )

    def confirm(self, robots: int) -> TeamPoint | None:
        """The team on the same number of fresh rollouts, ids from the first that no team used.

        None if its figures are exact, or if there are not enough ids.
        """
        count, start = self.points[robots].rollouts, max(point.rollouts for point in self.points.values())
        trial = self._trial(robots)
        if not count or trial.certain or start + count > MOST_ROLLOUTS:
            return None
        # Only the estimate after all rollouts counts.
        *_, last = self._rolled(trial, start, count)
        return self._point(trial, last)
