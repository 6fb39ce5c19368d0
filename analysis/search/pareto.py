"""Pareto front of coverage, robots lost and mission time over policies and their limits, for one team on one map.

All settings are simulated with the same rollout ids and seed (common random numbers, docs/spec.md section 14), so that
differences between settings have a small variance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import Search
from analysis.estimators.trial import Measured, Trial
from analysis.report.result import Searched, run_again
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import ALPHA, TARGETS, Estimate
from analysis.theory.verdicts import longest_mission
from analysis.utils.notes import Doing, ProgressCallback
from planner.arguments import MOST_ROLLOUTS, Numbers, argument, exactly
from planner.errors import UsageError
from planner.formatting import UNPACED, Pace
from planner.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.rollouts.tables import AllPairs
from planner.settings import SETTINGS, Settings
from planner.world.world import World

# Rules of `mrac-jax front`: settings to simulate, dominance, selection. Pure functions of numbers.

LANDMARKS = (*(tenth / 10 for tenth in range(1, 10)), 0.95, 0.99)
"""Coverage, fractions of the accessible cells: rows of the table of losses; missions are ended early at these marks."""
RISK_CAPS = (0.1, 0.25, 0.5)
MOST_ROBOT_VALUES = 16
"""Largest number of values of `robot_value` in the ladder; each is twice the one before."""
NEARLY_NONE = 0.02
"""Mean robots lost below which the ladder ends."""
USUAL, CELLS = 4096, 2**23
"""Default rollouts of a setting, and the largest number of cells times rollouts for that default."""
HALVINGS = 3
"""Values of `robot_value` tried between two neighbours that bracket a goal; then missions are ended between these."""
LEVELS = 63
"""Levels of coverage between these two neighbours at which a mission may end; bisected, so that six are tried."""
KNEE = 0.1
"""Least height of a knee above the straight line between two settings, as a share of the difference in coverage."""
FAMILIES = ("mrac", "per_cell", "risk_cap", "robot_value")


def usual_rollouts(world: World, starts: NDArray[np.int64]) -> int:
    """Default number of rollouts of a setting: a power of two, 16 to USUAL, smaller on larger maps.

    It depends on the map only, so that the same seed gives the same result on any machine.
    """
    cells = int(world.accessible(starts).sum())
    # A power of two, so that the default does not vary with small changes of the map.
    return max(16, min(USUAL, 1 << (CELLS // cells).bit_length() - 1))


class Setting(NamedTuple):
    """A policy with its limits, and the step at which the mission is ended."""

    policy: str
    risk_cap: float | None = None
    robot_value: float | None = None
    deadline: int | None = None

    @property
    def family(self) -> str:
        """The curve to which the setting belongs, one of FAMILIES: the last limit that is set, else the policy."""
        return [self.policy, *self.limits][-1]

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are set, by name."""
        both = {"risk_cap": self.risk_cap, "robot_value": self.robot_value}
        return {name: value for name, value in both.items() if value is not None}

    def __str__(self) -> str:
        return self.describe(UNPACED)

    def describe(self, pace: Pace) -> str:
        """For reports: "per_cell, robot value 40, ended at step 120"."""
        cut = "" if self.deadline is None else f", ended at {pace.step(self.deadline)}"
        return self.policy + "".join(f", {SETTINGS[name].title} {value:g}" for name, value in self.limits.items()) + cut

    def options(self) -> list[str]:
        """The options of `evaluate` for this setting."""
        words = ["--policy", self.policy]
        for name, value in self.limits.items():
            words += [f"--{name.replace('_', '-')}", exactly(value)]
        return words if self.deadline is None else [*words, "--deadline", str(self.deadline)]


class Figures(NamedTuple):
    """Means that settings are compared by: coverage (more is better), robots lost and steps (less is better)."""

    coverage: float
    losses: float
    time: float

    def beats(self, other: Figures) -> bool:
        """Whether it dominates the other: nowhere worse and somewhere better."""
        no_worse = self.coverage >= other.coverage and self.losses <= other.losses and self.time <= other.time
        return no_worse and self != other


@dataclass(frozen=True)
class Goal:
    """The rule of selection: most coverage with at most `losses` robots lost, or fewest lost with `target` covered."""

    losses: float | None = None
    target: float | None = None

    def __bool__(self) -> bool:
        return self.losses is not None or self.target is not None

    def allows(self, figures: Figures) -> bool:
        """Whether a setting meets the limit."""
        return figures.losses <= self.losses if self.losses is not None else figures.coverage >= (self.target or 0.0)

    def ranked(self, points: Sequence[Figures]) -> list[int]:
        """Indices of the points that meet the limit, best first; equal points keep their order."""

        def rank(place: int) -> tuple[float, float, float]:
            coverage, losses, time = points[place]
            return (-coverage, losses, time) if self.losses is not None else (losses, -coverage, time)

        return sorted((place for place, figures in enumerate(points) if self and self.allows(figures)), key=rank)

    def pick(self, points: Sequence[Figures]) -> int | None:
        """Index of the best point; None: no point meets the limit."""
        return next(iter(self.ranked(points)), None)


def make_goal(losses: float | None, target: float | None) -> Goal:
    """The goal of the options. Raises UsageError for a value out of range, or if both are given."""
    if losses is not None and target is not None:
        raise UsageError(f"both {argument('losses')} and {argument('target')} are given", expected="one of them")
    Numbers(0, what="a number of robots lost on average").check("losses", losses, optional=True)
    TARGETS.check("target", target, optional=True)
    return Goal(losses, target)


def check_goal(goal: Goal, robots: int) -> None:
    """Raise UsageError for a limit on losses above the number of robots."""
    if goal.losses is not None and goal.losses > robots:
        expected = f"at most {robots}, the number of robots"
        raise UsageError(argument("losses", goal.losses), expected=expected, fix="omit it to see the whole front")


def efficient(points: Sequence[Figures]) -> list[bool]:
    """For each point, whether no other point dominates it."""
    return [not any(other.beats(one) for other in points) for one in points]


def knee(points: Sequence[Figures], low: Figures, high: Figures) -> int | None:
    """Index of the knee between two settings: the point farthest above the straight line from `low` to `high`.

    Coverage and robots lost are scaled to their differences between `low` and `high`. None: no point is KNEE above it.
    """
    more, lost = high.coverage - low.coverage, high.losses - low.losses
    if not points or more <= 0 or lost <= 0:
        return None
    # Distance from the diagonal of the unit square that `low` and `high` span.
    above = [(one.coverage - low.coverage) / more - (one.losses - low.losses) / lost for one in points]
    place = max(range(len(points)), key=above.__getitem__)
    return place if above[place] >= KNEE else None


def first_robot_value(largest_threat: float) -> float:
    """Start of the ladder: 1 / p of the most dangerous cell, to two digits."""
    return float(f"{1 / largest_threat:.2g}")


def ladder_of(dangers: NDArray[np.float64], cells: int) -> list[float]:
    """Values of `robot_value`, each twice the one before: from `first_robot_value` to one that excludes all danger.

    `dangers`: the threats of the dangerous cells. Empty without danger.
    """
    if not len(dangers):
        return []
    values = [first_robot_value(float(dangers.max())) * 2**step for step in range(MOST_ROBOT_VALUES)]
    # Larger values than the first above this exclude all threats too, and give the same plan.
    return values[: 1 + sum(value <= cells / float(dangers.min()) for value in values)]


def between(low: float, high: float) -> float:
    """The geometric mean of two values, to three digits."""
    return float(f"{(low * high) ** 0.5:.3g}")


# Results: settings with their estimates, the Pareto front, and the selected point with its plan.


@dataclass(frozen=True)
class Point:
    """A setting with its estimates.

    Attributes:
        coverage: by the metric of the choices, a fraction of the accessible cells. losses: robots. time: steps.
        value: visited, a fraction of the value of all free cells; None: the map has no values.
        least, most: lower confidence bound of the mean coverage, upper bound of the mean losses; each is wrong with
            probability at most `alpha` of `point_of`.
        exact: exact expectations, without sampling.
    """

    setting: Setting
    coverage: Estimate
    losses: Estimate
    time: Estimate
    value: Estimate | None
    least: float
    most: float
    exact: bool = False
    json_keys = """
        setting.policy setting.risk_cap setting.robot_value setting.deadline coverage losses time value?
    """

    @property
    def figures(self) -> Figures:
        """The means."""
        return Figures(self.coverage.mean, self.losses.mean, self.time.mean)

    @property
    def sure(self) -> Figures:
        """The bounds in place of the means: a goal that allows them is met with confidence."""
        return Figures(self.least, self.most, self.time.mean)

    @property
    def ample(self) -> Figures:
        """AMPLE margins of the bounds beyond the means: fresh rollouts mostly confirm a goal that allows them."""
        coverage, losses, steps = self.figures
        return Figures(coverage - AMPLE * (coverage - self.least), losses + AMPLE * (self.most - losses), steps)


@dataclass(frozen=True)
class ListedPoint:
    """A point in the JSON object.

    Attributes:
        efficient: it is on the Pareto front of coverage, losses and time. first_rollout: the first id of its rollouts.
    """

    point: Point
    efficient: bool | None = None
    first_rollout: int | None = None
    json_keys = "*point efficient? first_rollout?"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Front(Searched):
    """The result of `front`; `words`: arguments of the command without the policy and its limits.

    Attributes:
        starts: of the team, int64 `[K, 2]`. goal: the rule of selection. points: the simulated settings.
        pick: index of the selected point; None: no goal, no point that meets it with confidence, or an interruption.
        confirmed: the selected point on fresh rollouts, ids from `rollouts` on, as many as were used for the choice.
        tried: number of settings that were simulated there, best first, until one met the limit. The error probability
            of each try is half that of the one before, so that the selected point meets the limit with 95 % confidence.
        priced: without a goal: the settings of the summary, on fresh rollouts.
        plan_file: path of the selected point's plan; "" if none is written.
    """

    reported_by = "analysis.search.reports:front_report"
    listed = "points"

    starts: NDArray[np.int64]
    goal: Goal
    points: tuple[Point, ...]
    pick: int | None = None
    confirmed: Point | None = None
    tried: int = 0
    priced: tuple[Point, ...] = ()
    plan_file: str = ""
    json_keys = """
        points=listed_points pick choices.metric asked.losses=goal.losses asked.target=goal.target confirmed
        confirmed.first_rollout=first_fresh confirmed.bound=bound confirmed.tried=tried fresh=listed_corners
        command
    """

    @property
    def listed_points(self) -> tuple[ListedPoint, ...]:
        """All settings."""
        return tuple(map(ListedPoint, self.points, self.efficient))

    @property
    def listed_corners(self) -> tuple[ListedPoint, ...]:
        """Without a goal: the settings of the summary, on fresh rollouts."""
        return tuple(ListedPoint(point, first_rollout=self.first_fresh) for point in self.priced)

    @property
    def bound(self) -> float | None:
        """Confidence bound of the limited figure of the selected point: most robots lost, or least coverage."""
        again = self.confirmed
        if again is None:
            return None
        return again.most if self.goal.losses is not None else again.least

    @property
    def command(self) -> str | None:
        """The command that evaluates the selected point on other rollouts; None in Python or without a point."""
        return None if self.confirmed is None or not self.words else self.command_of(self.confirmed)

    def command_of(self, point: Point) -> str:
        """The command that evaluates a point; sampled points get another seed."""
        closed = [] if self.settings.plan_for == "closed_loop" else ["--plan-for", "closed_loop"]
        how = ["--plan", self.plan_file] if self.plan_file else [*closed, *point.setting.options()]
        return run_again(self.words, how, self.choices, exact=point.exact)

    @property
    def verb(self) -> str:
        """What a team does with cells, for sentences."""
        return "deliver" if self.choices.metric == "delivered" else "cover"

    @cached_property
    def efficient(self) -> tuple[bool, ...]:
        """For each point, whether it is on the Pareto front of coverage, losses and time."""
        return tuple(efficient([point.figures for point in self.points]))

    @cached_property
    def cheap(self) -> tuple[bool, ...]:
        """For each point, whether it is on the Pareto front of coverage and losses, whatever its time."""
        return tuple(efficient([point.figures._replace(time=0.0) for point in self.points]))

    @property
    def picked(self) -> Point | None:
        """The selected point."""
        return None if self.pick is None else self.points[self.pick]

    def cheapest(self, coverage: float, *families: str) -> Point | None:
        """The point with the fewest robots lost that covers at least `coverage`; None if there is none."""
        of = [point for point in self.points if not families or point.setting.family in families]
        place = Goal(target=coverage).pick([point.figures for point in of])
        return None if place is None else of[place]

    def corners(self) -> tuple[Point, ...]:
        """The point with most coverage at nearly no losses, the knee if there is one, and the point with most coverage.

        Where every point loses robots, the first is the one that loses the fewest. One point if the first covers most.
        """
        most = max(self.points, key=lambda point: point.coverage.mean)
        fewest = min(point.losses.mean for point in self.points)
        # Without NEARLY_NONE, noise of 0.001 robots would select a point that covers nearly nothing.
        free = [point for point in self.points if point.losses.mean <= max(fewest, NEARLY_NONE)]
        first = max(free, key=lambda point: (point.coverage.mean, -point.losses.mean))
        if most.coverage.mean <= first.coverage.mean:
            return (most,)
        place = knee([point.figures for point in self.points], first.figures, most.figures)
        return (first, most) if place is None else (first, self.points[place], most)

    def plan_of(self, point: Point) -> Plan:
        """The plan of a point; it has the point's deadline."""
        return make_plan(self.world, self.starts, settings_of(self.settings, point.setting))


def settings_of(settings: Settings, setting: Setting) -> Settings:
    """The planner's settings with the policy and limits of a point, for closed-loop missions."""
    return replace(settings, **setting._asdict(), plan_for="closed_loop", effort=None)


def point_of(setting: Setting, found: Measured, cells: int, alpha: float, longest: int) -> Point:
    """A setting with its estimates.

    Args:
        alpha: probability that a bound is wrong, for any distribution: one end of `Sampled.bounds`.
        longest: upper bound of a rollout's steps.
    """
    return Point(
        setting,
        found.mean(found.metric, 1.0 / cells),
        found.mean("lost"),
        found.mean("time", 1.0, longest if setting.deadline is None else min(longest, setting.deadline)),
        found.mean("value") if found.counted == "value" else None,
        found.bounds(found.metric, 2 * alpha)[0] / cells,
        found.bounds("lost", 2 * alpha)[1],
        found.exact,
    )


RISK_CAP_CELLS = 1000
"""Accessible cells up to which risk caps are simulated by default: with a cap, waiting robots decide in every step."""
FIRST_ERROR = ALPHA / 2
"""Error probability of a bound, on the rollouts of the choice and at the first try on fresh rollouts."""
TRIES = 6
"""Largest number of settings that are tried on fresh rollouts."""
AMPLE = 1.5
"""Margins between a mean and its bound by which a mission ends beyond a target, so that fresh rollouts confirm it."""
SETTINGS_ABOUT = 32
"""Number of settings of a typical front: each may use this fraction of the time limit for exact expectations."""
ENDS_AT_HOME = "A mission that is ended early has a deadline: robots start the return so as to be at the base by it"
BY_CELLS = "The Pareto front and the selected point count cells; value is shown in addition"


@dataclass(frozen=True)
class Ladders:
    """Settings in addition to the policies without limits; None: values that suit the map.

    Attributes:
        risk_caps, robot_values: each with the policy `per_cell`.
        landmarks: fractions; a mission is also ended at the step by which its mean coverage reaches one of them.
    """

    risk_caps: tuple[float, ...] | None = None
    robot_values: tuple[float, ...] | None = None
    landmarks: tuple[float, ...] = LANDMARKS


def find_front(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    goal: Goal | None = None,
    ladders: Ladders | None = None,
    words: Sequence[str] = (),
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
) -> Front:
    """Simulate `mrac` and `per_cell`, in full and ended early, and `per_cell` over ladders of its two limits.

    All settings use the same rollout ids and seed. The ladder of `robot_value` doubles from 1 / p of the most dangerous
    cell until nearly no robot is lost, and is refined around a goal. With `choices.deadline` every mission ends there.
    Settings whose expectation can be computed exactly in time are not sampled (`analysis.estimators.trial`). Fresh
    rollout ids confirm the selected point: `_Search.confirmed`.

    Returns:
        The front. After an interruption (KeyboardInterrupt): the settings done so far, `partial`; if there are none,
        the interruption is raised again.

    Raises:
        InputError: an argument or setting out of range.
    """
    if choices.rollouts > MOST_ROLLOUTS // 2:
        raise UsageError(
            argument("rollouts", choices.rollouts),
            expected=f"at most {MOST_ROLLOUTS // 2} (as many more confirm the selected point)",
        )
    check_goal(goal or Goal(), len(starts))
    search = _Search(world, starts, settings, choices, goal or Goal(), ladders or Ladders(), progress, doing)
    with search.stoppable(lambda: search.points):
        search.look_at_all()
    answer = Front(
        **search.fields(), starts=starts, goal=search.goal, points=tuple(search.distinct), words=tuple(words)
    )
    if not search.partial:
        with search.stoppable(lambda: True):
            return search.confirmed(answer)
    return replace(answer, partial=True)


def quick_points(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    losses: float,
    seconds: float,
    kept: AllPairs,
    doing: Doing,
    clock: Callable[[], float] = time.process_time,
) -> tuple[Point, ...]:
    """A few settings within a time limit: `per_cell` from the largest `robot_value` down to one that loses `losses`
    robots, then both policies without limits.

    Large values come first because they are cheap to simulate and lose few robots. No setting is started after
    `seconds` of `clock`; the first setting is not counted, as it may compile code. `kept`: cache of the map's distance
    tables. Raises InputError.
    """
    choices = replace(choices, exact="never", deadline=settings.deadline)
    search = _Search(world, starts, settings, choices, Goal(), Ladders((), None, ()), None, doing)
    search.kept, begun = kept, math.inf
    for robot_value in reversed(ladder_of(search.dangers, search.cells)):
        point = search.look_at(Setting("per_cell", robot_value=robot_value))
        # The first setting compiles code, so the time limit starts after it.
        begun = min(begun, clock())
        if point.losses.mean >= losses or clock() - begun >= seconds:
            break
    for policy in ("per_cell", "mrac"):
        if clock() - begun < seconds:
            search.look_at(Setting(policy))
    return tuple(search.distinct)


class _Search(Search):
    """State of the search: `points`, and each setting's mean coverage by step, `covered`, `[T + 1]`."""

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        goal: Goal,
        ladders: Ladders,
        progress: ProgressCallback | None,
        doing: Doing | None,
    ) -> None:
        super().__init__(world, starts, settings, choices, progress, doing)
        if self.choices.deadline is None:  # the mission's own deadline also ends the settings without one
            self.choices = replace(self.choices, deadline=settings.deadline)
        self.goal, self.ladders, self.points = goal, ladders, dict[Setting, Point]()
        self.made: tuple[Setting, Trial] | None = None
        self.covered: dict[Setting, NDArray[np.float64]] = {}
        self.dangers = world.threat[self.accessible & (world.threat > 0)].astype(np.float64)
        self.longest = longest_mission(world, starts, settings)
        self.least_deadline = self._way_home()
        self.notes += [] if world.value is None else [BY_CELLS]
        self.notes += [] if settings.return_to is None else [ENDS_AT_HOME]
        _check_ladder("robot_value", ladders.robot_values or ())
        self.risk_caps = self._risk_caps()

    def _way_home(self) -> int:
        """Most moves of any robot's way from its start to the base; earlier deadlines leave no time to return."""
        problem = None
        if self.settings.return_to is not None:
            problem = prepare(self.world, self.starts, replace(self.settings, deadline=None))
        if problem is None or problem.home is None:
            return 0
        return max(problem.home.moves(robot, cell) for robot, cell in enumerate(problem.starts.tolist()))

    @property
    def distinct(self) -> list[Point]:
        """The points in order. Default values of a limit that give the figures of a lower value are dropped."""
        asked = {"risk_cap": self.ladders.risk_caps is not None, "robot_value": self.ladders.robot_values is not None}
        found: dict[tuple[object, ...], Point] = {}
        for setting, point in sorted(self.points.items(), key=lambda item: tuple(item[0].limits.values())):
            own = setting if asked.get(setting.family, True) else None
            # Points are sorted by their limits, so the lowest of equal limits is kept.
            found.setdefault((setting.family, point.figures, own), point)
        return sorted(found.values(), key=_by_family)

    def look_at_all(self) -> None:
        """Simulate all settings, cheap ones first: risk caps are slow."""
        for setting in (Setting("mrac"), Setting("per_cell")):
            self._with_cuts(setting)
        self._up_the_ladder()
        self._refine()
        for setting in self.risk_caps:
            self.look_at(setting)

    def _risk_caps(self) -> list[Setting]:
        values = self.ladders.risk_caps
        if values is None:
            values = () if len(self.starts) == 1 or not len(self.dangers) else RISK_CAPS
            if values and self.cells > RISK_CAP_CELLS:
                values = ()
                self.notes.append(
                    f"Risk caps were skipped (slow above {RISK_CAP_CELLS:,} cells); add {argument('risk_caps')}"
                )
        _check_ladder("risk_cap", values)
        return [Setting("per_cell", risk_cap=value) for value in values]

    def _with_cuts(self, setting: Setting) -> None:
        """A policy without limits, in full and ended early."""
        point, marks = self.look_at(setting), [*self.ladders.landmarks]
        if self.goal.target is not None:
            marks.append(self.goal.target + point.coverage.mean - point.ample.coverage)
        for step in self._steps(setting, marks):
            self.look_at(setting._replace(deadline=step))

    def _steps(self, setting: Setting, marks: Iterable[float]) -> list[int]:
        """The steps before the end by which the mean coverage of a simulated setting reaches `marks`."""
        covered = self.covered[self._ended(setting)]
        # argmax is the first step that reaches the mark; `covered` does not decrease.
        steps = {int(np.argmax(covered >= mark)) for mark in marks if covered[-1] >= mark}
        return sorted(step for step in steps - {len(covered) - 1} if step >= self.least_deadline)

    def _up_the_ladder(self) -> None:
        """The given values of `robot_value`; by default a ladder that doubles until nearly no robot is lost."""
        given = self.ladders.robot_values
        for robot_value in ladder_of(self.dangers, self.cells) if given is None else given:
            point = self.look_at(Setting("per_cell", robot_value=robot_value))
            if given is None and point.losses.mean < NEARLY_NONE:
                return

    def _refine(self) -> None:
        """Values of `robot_value` between two neighbours of which one meets the goal; then the lower one ended early.

        A small change of `robot_value` can exclude a large area, so that no value lies between; any step can be chosen.
        """
        if not self.goal or self.ladders.robot_values is not None:
            return
        for _ in range(HALVINGS):
            if (bracket := self._bracket()) is None:
                return
            self.look_at(Setting("per_cell", robot_value=between(*bracket)))
        if (bracket := self._bracket()) is not None:
            setting = Setting("per_cell", robot_value=bracket[0])
            more, less = (self.points[self._ended(setting._replace(robot_value=v))].coverage.mean for v in bracket)
            steps = self._steps(setting, np.linspace(less, more, LEVELS))
            while steps:
                middle = len(steps) // 2
                point = self.look_at(setting._replace(deadline=steps[middle]))
                met = self.goal.allows(point.sure)
                if met and not self.goal.allows(point.ample):
                    return  # about a standard error from the limit: closer ends would be the same try several times
                # An earlier end loses fewer robots and covers less.
                steps = steps[middle + 1 :] if met == (self.goal.losses is not None) else steps[:middle]

    def _bracket(self) -> tuple[float, float] | None:
        """The first two neighbours of the ladder of `robot_value` of which one meets the goal."""
        known = [(s.robot_value, self.goal.allows(p.sure)) for s, p in self.points.items() if s.robot_value is not None]
        return next(((a, b) for (a, met), (b, other) in pairwise(sorted(known)) if met != other), None)

    def _ended(self, setting: Setting) -> Setting:
        """The setting with its own deadline, else with the deadline of all missions."""
        return setting if setting.deadline is not None else setting._replace(deadline=self.choices.deadline)

    def look_at(self, asked: Setting) -> Point:
        """Simulate a setting and store its estimates."""
        setting = self._ended(asked)
        found = self._measured(setting, 0)
        self.covered[setting] = found.by_step()
        point = self.points[setting] = point_of(setting, found, self.cells, FIRST_ERROR, self.longest)
        return point

    def confirmed(self, answer: Front) -> Front:
        """The result with fresh rollouts of the settings that the summary names.

        With a goal, settings are tried in the order of the first rollouts until one meets it on fresh rollouts too. The
        n-th try has error probability ALPHA / 2**n; by the union bound the sum is at most ALPHA.
        """
        if not self.goal:
            return replace(answer, priced=tuple(self._again(point, FIRST_ERROR) for point in answer.corners()))
        order = self.goal.ranked([point.figures for point in answer.points])
        # A point that fails its bound on the first rollouts would waste a try.
        eligible = [place for place in order if self.goal.allows(answer.points[place].sure)][:TRIES]
        for tried, place in enumerate(eligible, 1):
            again = self._again(answer.points[place], ALPHA / 2**tried)
            if self.goal.allows(again.sure):
                return replace(answer, pick=place, confirmed=again, tried=tried)
        return replace(answer, tried=len(eligible))

    def _again(self, point: Point, alpha: float) -> Point:
        """The point on fresh rollouts; an exact point is returned unchanged."""
        if point.exact:
            return point
        found = self._measured(point.setting, self.choices.rollouts)
        return point_of(point.setting, found, self.cells, alpha, self.longest)

    def _measured(self, setting: Setting, start: int) -> Measured:
        """The setting's expectations: exact, or estimated from the given number of rollouts, ids from `start` on."""
        self.doing(f"{setting} on fresh rollouts" if start else f"setting {len(self.points) + 1}, {setting}")
        began, count = time.perf_counter(), self.choices.rollouts
        if self.settings.return_to is None:
            # Without a return to base the deadline changes no decision: one trial serves all cuts.
            trial = self._trial(setting._replace(deadline=None)).truncated_at(setting.deadline)
        else:  # The return depends on the deadline: a truncated mission is not the mission with that deadline.
            trial = self._trial(setting)
        found = trial.known(1 / SETTINGS_ABOUT) or trial.sample(start, count)
        self.exact &= found.exact
        self.progress(count, count, time.perf_counter() - began)
        return found

    def _trial(self, setting: Setting) -> Trial:
        """The trial of a setting's full mission; the last one is cached."""
        # Cuts of one setting come one after the other, so one cached trial is enough.
        if self.made is None or self.made[0] != setting:
            how = {"settings": settings_of(self.settings, setting), "choices": replace(self.choices, deadline=None)}
            self.made = setting, self.trial(**how)
        return self.made[1]


def _check_ladder(name: str, values: Sequence[float]) -> None:
    """Raise UsageError for a value that the setting does not accept."""
    setting = SETTINGS[name]
    for value in values:
        if not setting.accepts(value):
            raise UsageError(argument(f"{name}s", value), expected=setting.expected(""))


def _by_family(point: Point) -> tuple[int, float, float]:
    """Sort key: family, then coverage. The order does not depend on the order of simulation, so ties break alike."""
    return FAMILIES.index(point.setting.family), -point.coverage.mean, point.losses.mean
