"""Coverage against robots lost against time: one team on one map under many policies, on common random numbers.

Every setting rolls out the same ids with the same seed, so robot i meets the same luck in all of them (SPEC section 14)
and what they differ in is the setting.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Measured, Trial
from analysis.report.answer import Searched
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import ALPHA, TARGETS, Estimate
from analysis.theory.verdicts import longest_mission
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import MOST_ROLLOUTS, Numbers, argument, exactly, numbers_of
from planner.errors import UsageError
from planner.formatting import UNPACED, Pace
from planner.make_plan import allocated_plan, make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.rollouts.tables import AllPairs
from planner.settings import SETTINGS, Settings
from planner.world.world import World

# The rules behind `mrac-jax front`: which settings are looked at, which of them nothing beats, which one is picked.
#
# Pure functions of numbers; what rolls out is `analysis.search.pareto`.

LANDMARKS = (*(tenth / 10 for tenth in range(1, 10)), 0.95, 0.99)
"""Coverage, fractions of the accessible cells, that prices are named for; missions are cut where they reach it."""
RESERVES = (0.1, 0.25, 0.5)
MOST_WORTHS = 16
"""Steps of the ladder of `robot_value`, each twice the one before."""
NEXT_TO_NONE = 0.02
"""Robots lost on average below which the ladder ends."""
USUAL, CELLS = 4096, 2**23
"""Rollouts of a setting where nobody says how many, and the cells that they cover together at most."""
HALVINGS = 3
"""Values of `robot_value` tried between the two that a goal lies between; and missions ended between those that are
left."""
KNEE = 0.1
"""How far above the straight price between two settings a third has to be to be named: a share of what it costs."""
FAMILIES = ("mrac", "per_cell", "risk_cap", "robot_value")


def usual_rollouts(world: World, starts: NDArray[np.int64]) -> int:
    """Of each setting, where nobody says how many: fewer on large maps, so that a front is a matter of a minute.

    By the map alone, as the same seed has to give the same answer on any machine: a power of two, 16 to USUAL.
    """
    cells = int(world.accessible(starts).sum())
    return max(16, min(USUAL, 1 << (CELLS // cells).bit_length() - 1))


class Setting(NamedTuple):
    """What a point of the front stands for: a policy with its limits, and the step at which the mission is ended."""

    policy: str
    risk_cap: float | None = None
    robot_value: float | None = None
    deadline: int | None = None

    @property
    def family(self) -> str:
        """What it is varied with, one of FAMILIES: a policy alone and cut short, a reserve, a worth."""
        return (
            "robot_value" if self.robot_value is not None else "risk_cap" if self.risk_cap is not None else self.policy
        )

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are set, by name."""
        both = {"risk_cap": self.risk_cap, "robot_value": self.robot_value}
        return {name: value for name, value in both.items() if value is not None}

    def limits_json(self) -> dict[str, str | float | None]:
        """The policy and both limits, for JSON."""
        return {"policy": self.policy, "risk_cap": self.risk_cap, "robot_value": self.robot_value}

    def __str__(self) -> str:
        return self.said(UNPACED)

    def said(self, pace: Pace) -> str:
        """In words: "per_cell, robot value 40, ended at step 120"."""
        cut = "" if self.deadline is None else f", ended at {pace.step(self.deadline)}"
        return self.policy + "".join(f", {SETTINGS[name].title} {value:g}" for name, value in self.limits.items()) + cut

    def options(self) -> list[str]:
        """The options of `evaluate` that ask for it."""
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
        """Nowhere worse, somewhere better."""
        return (
            self.coverage >= other.coverage
            and self.losses <= other.losses
            and self.time <= other.time
            and tuple(self) != tuple(other)
        )


@dataclass(frozen=True)
class Goal:
    """What to pick by: most coverage at no more than `losses` robots lost, or fewest lost with `target` covered."""

    losses: float | None = None
    target: float | None = None

    def __bool__(self) -> bool:
        return self.losses is not None or self.target is not None

    def allows(self, figures: Figures) -> bool:
        """Whether a setting may be picked."""
        return figures.losses <= self.losses if self.losses is not None else figures.coverage >= (self.target or 0.0)

    def ranked(self, points: Sequence[Figures]) -> list[int]:
        """The places of those that it allows, the best first; of equal ones the first."""

        def rank(place: int) -> tuple[float, float, float]:
            coverage, losses, time = points[place]
            return (-coverage, losses, time) if self.losses is not None else (losses, -coverage, time)

        return sorted((place for place, figures in enumerate(points) if self and self.allows(figures)), key=rank)

    def pick(self, points: Sequence[Figures]) -> int | None:
        """The place of the best; None: it allows none."""
        return next(iter(self.ranked(points)), None)


def make_goal(losses: float | None, target: float | None) -> Goal:
    """The goal that options ask for; raises UsageError for one out of range, or for both."""
    if losses is not None and target is not None:
        raise UsageError(f"both {argument('losses')} and {argument('target')} are given", expected="one of them")
    Numbers(0, what="a number of robots lost on average").check("losses", losses, optional=True)
    TARGETS.check("target", target, optional=True)
    return Goal(losses, target)


def check_goal(goal: Goal, robots: int) -> None:
    """Raise UsageError for a limit on losses that no team of so many robots can break."""
    if goal.losses is not None and goal.losses > robots:
        expected = f"at most {robots}, the robots that there are to lose"
        raise UsageError(argument("losses", goal.losses), expected=expected, fix="leave it out to see what all costs")


def efficient(points: Sequence[Figures]) -> list[bool]:
    """Which of them no other one beats."""
    return [not any(other.beats(one) for other in points) for one in points]


def knee(points: Sequence[Figures], low: Figures, high: Figures) -> int | None:
    """The place of the best bargain between two settings: farthest above the straight line from one to the other.

    Coverage and robots lost are counted in shares of the way from `low` to `high`. None: no point is KNEE above it.
    """
    more, lost = high.coverage - low.coverage, high.losses - low.losses
    if not points or more <= 0 or lost <= 0:
        return None
    above = [(one.coverage - low.coverage) / more - (one.losses - low.losses) / lost for one in points]
    place = max(range(len(points)), key=above.__getitem__)
    return place if above[place] >= KNEE else None


def first_worth(largest_threat: float) -> float:
    """Where the ladder begins: a robot is worth what the worst cell costs, 1 / p, in two digits."""
    return float(f"{1 / largest_threat:.2g}")


def careful_first(largest_threat: float, smallest_threat: float, cells: int) -> list[float]:
    """The whole ladder of `robot_value` from its end, with which every danger is refused, down to `first_worth`."""
    first, ladder = first_worth(largest_threat), list[float]()
    for step in range(MOST_WORTHS):
        ladder.insert(0, first * 2**step)
        if ladder[0] > cells / smallest_threat:
            break
    return ladder


def between(low: float, high: float) -> float:
    """The worth half-way between two, as a ratio, in three digits."""
    return float(f"{(low * high) ** 0.5:.3g}")


def parse_numbers(name: str, text: str | None) -> tuple[float, ...] | None:
    """The numbers of "5,10,20"; "" for none of them; None stays None. Raises UsageError naming the option."""
    if text is None:
        return None
    return numbers_of(name, text, 'numbers, as "5,10,20"') if text.strip() else ()


# What a front holds: settings with what they come to, which of them nothing beats, the pick and its plan.


@dataclass(frozen=True)
class Point:
    """A setting, and what it comes to: `coverage` visited, a fraction of the accessible cells; robots lost; steps.

    `value` visited, a fraction of what all free cells are worth; None: nobody said what that is. `least`, `most`: one
    bound each that coverage is not below, and that losses are not above, by chance `doubt` of `point_of`. `exact`: all
    of it is known, not sampled.
    """

    setting: Setting
    coverage: Estimate
    losses: Estimate
    time: Estimate
    value: Estimate | None
    least: float
    most: float
    exact: bool = False

    @property
    def figures(self) -> Figures:
        """The means."""
        return Figures(self.coverage.mean, self.losses.mean, self.time.mean)

    @property
    def sure(self) -> Figures:
        """The bounds in the place of the means: what a goal has to allow to be kept for sure."""
        return Figures(self.least, self.most, self.time.mean)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Front(Searched):
    """The answer; `words`: without the setting.

    Attributes:
        starts: of the team, int64 `[K, 2]`. goal: what to pick by. points: the settings looked at.
        pick: the place of the point that the goal picks; None: no goal, nothing is sure to keep it, or not all was
            looked at.
        confirmed: the pick on as many rollouts that had no part in the choice, ids from `rollouts` on. tried: so many
            settings were rolled out there, the best first, until one was sure to keep the limit: each with a chance of
            error of half the one before, so that the pick keeps it with 95 %.
        priced: without a goal: the settings that the headline speaks of on those other rollouts.
        plan_file: that the plan of the pick is written to; "" for none.
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

    @cached_property
    def efficient(self) -> tuple[bool, ...]:
        """Of each point, whether no other covers as much with as few robots lost in as little time, or better."""
        return tuple(efficient([point.figures for point in self.points]))

    @cached_property
    def cheap(self) -> tuple[bool, ...]:
        """Of each point, whether no other covers as much with as few robots lost, or better, however long it takes."""
        return tuple(efficient([point.figures._replace(time=0.0) for point in self.points]))

    @property
    def picked(self) -> Point | None:
        """The point itself."""
        return None if self.pick is None else self.points[self.pick]

    def cheapest(self, coverage: float, *families: str) -> Point | None:
        """The point that covers so much, or more, with the fewest robots lost; None if none covers so much."""
        of = [point for point in self.points if not families or point.setting.family in families]
        place = Goal(target=coverage).pick([point.figures for point in of])
        return None if place is None else of[place]

    def corners(self) -> tuple[Point, ...]:
        """The setting that covers most at next to no robot lost, the one that covers most of all, and the knee between.

        Where each costs robots, the first is the one that loses the fewest. One alone where the first covers most.
        """
        most = max(self.points, key=lambda point: point.coverage.mean)
        fewest = min(point.losses.mean for point in self.points)
        free = [point for point in self.points if point.losses.mean <= max(fewest, NEXT_TO_NONE)]
        first = max(free, key=lambda point: (point.coverage.mean, -point.losses.mean))
        if most.coverage.mean <= first.coverage.mean:
            return (most,)
        place = knee([point.figures for point in self.points], first.figures, most.figures)
        return (first, most) if place is None else (first, self.points[place], most)

    def plan_of(self, point: Point) -> Plan:
        """The plan of a point; it ends the mission where the point does."""
        return make_plan(self.world, self.starts, settings_of(self.settings, point.setting))


def settings_of(settings: Settings, setting: Setting) -> Settings:
    """The planner's settings with the policy of a point, for robots that take over from each other."""
    return replace(settings, **setting._asdict(), plan_for="closed_loop", effort=None)


def point_of(setting: Setting, found: Measured, cells: int, doubt: float, longest: int) -> Point:
    """A setting with what it comes to.

    `doubt`: the chance that either of its bounds is wrong, for any distribution: one end of `Sampled.bounds`.
    `longest`: steps that a run takes at most.
    """
    return Point(
        setting,
        found.mean("visited", 1.0 / cells),
        found.mean("lost"),
        found.mean("time", 1.0, longest if setting.deadline is None else min(longest, setting.deadline)),
        found.mean("value") if found.counted == "value" else None,
        found.bounds("visited", 2 * doubt)[0] / cells,
        found.bounds("lost", 2 * doubt)[1],
        found.exact,
    )


RESERVED_CELLS = 1000
"""Accessible cells up to which reserves are looked at unasked: held robots ask again in every step, which is slow."""
FIRST_DOUBT = ALPHA / 2
"""Chance that a bound on a setting is wrong, on the rollouts that choose and at the first try on others."""
TRIES = 6
"""Settings that are tried on other rollouts, at most, until one is sure to keep a goal."""
AMPLE = 1.5
"""Margins between a mean and its bound that a mission is ended beyond a target, so that other rollouts bear it out."""
SETTINGS_ABOUT = 32
"""Of a front: the share of its exact seconds that each may take."""
ENDS_AT_HOME = "robots come home: a mission that is ended early is one whose robots turn so as to be home by that step"
BY_CELLS = "what is picked, and what nothing beats, goes by cells covered; value is told beside them"


@dataclass(frozen=True)
class Ladders:
    """What is looked at besides the policies as they are; None: as the map suggests.

    Attributes:
        reserves: with `per_cell`. worths: with `per_cell`.
        landmarks: a mission is also ended at the step by which so much is covered on average, fractions.
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
    """Look at `mrac` and `per_cell`, whole and ended early, and at `per_cell` over ladders of `risk_cap` and
    `robot_value`.

    All are rolled out with the same ids and seed; the ladder of `robot_value` doubles from 1 / p of the worst cell
    until next
    to no robot is lost, and is refined around a goal. With `choices.deadline` every mission ends there. Nothing is
    rolled out of settings whose trees end in time (`analysis.estimators.trial`). The pick is chosen and told on other
    ids:
    `_Search.confirmed`.

    An interruption (KeyboardInterrupt) ends it with the settings that were done, `partial`; if that is none, it is
    raised again. Raises InputError.
    """
    if choices.rollouts > MOST_ROLLOUTS // 2:
        raise UsageError(
            argument("rollouts", choices.rollouts),
            expected=f"at most {MOST_ROLLOUTS // 2}: as many others check the pick",
        )
    check_goal(goal or Goal(), len(starts))
    choices = choices.timed(world.pace)
    choices = replace(choices, deadline=settings.deadline if choices.deadline is None else choices.deadline)
    search = _Search(world, starts, settings, choices, goal or Goal(), ladders or Ladders(), progress, doing)
    partial = False
    try:
        search.look_at_all()
    except KeyboardInterrupt:
        if not search.points:
            raise
        partial = True
    answer = Front(
        world=world,
        starts=starts,
        settings=settings,
        choices=choices,
        goal=search.goal,
        points=tuple(search.distinct),
        cells=search.cells,
        engine=search.engine,
        words=tuple(words),
        partial=partial,
        notes=tuple(search.notes),
    )
    try:
        return answer if partial else search.confirmed(answer)
    except KeyboardInterrupt:
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
    """A few settings in a moment: `per_cell` from the most careful `robot_value` down to where so many `losses` are
    reached,
    then the policies as they are.

    The careful ones come first, as they are cheap and say what costs no robot. None is begun after `seconds` of work;
    that of the first is not counted, as code may be compiled in it: `clock`, in seconds. `kept`: where tables of this
    map are kept. Raises InputError.
    """
    choices = replace(choices, exact="never", deadline=settings.deadline)
    search = _Search(world, starts, settings, choices, Goal(), Ladders((), None, ()), None, doing)
    search.kept, begun = kept, math.inf
    if len(search.dangers):
        for robot_value in careful_first(float(search.dangers.max()), float(search.dangers.min()), search.cells):
            point = search.look_at(Setting("per_cell", robot_value=robot_value))
            begun = min(begun, clock())
            if point.losses.mean >= losses or clock() - begun >= seconds:
                break
    for policy in ("per_cell", "mrac"):
        if clock() - begun < seconds:
            search.look_at(Setting(policy))
    return tuple(search.distinct)


class _Search:
    """The settings looked at so far, `points`, and how much they `covered` by each step on average, `[T + 1]`."""

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
        self.world, self.starts, self.settings, self.choices, self.goal = world, starts, settings, choices, goal
        self.ladders, self.kept, self.points, self.engine = ladders, AllPairs(), dict[Setting, Point](), ""
        self.made: tuple[Setting, Trial] | None = None
        self.covered: dict[Setting, NDArray[np.float64]] = {}
        self.progress, self.doing = progress or quiet, doing or quiet
        accessible = world.accessible(starts)
        self.cells = int(accessible.sum())
        self.dangers = world.threat[accessible & (world.threat > 0)].astype(np.float64)
        self.longest = longest_mission(world, starts, settings)
        self.least_deadline = self._way_home()
        self.notes: list[str] = [] if world.value is None else [BY_CELLS]
        if settings.return_to is not None:
            self.notes.append(ENDS_AT_HOME)
        _check_ladder("robot_value", ladders.robot_values or ())
        self.risk_caps = self._reserves()

    def _way_home(self) -> int:
        """The moves of the longest way home from a start: a mission that ends before has none."""
        problem = None
        if self.settings.return_to is not None:
            problem = prepare(self.world, self.starts, replace(self.settings, deadline=None))
        if problem is None or problem.home is None:
            return 0
        return max(problem.home.moves(robot, cell) for robot, cell in enumerate(problem.starts.tolist()))

    @property
    def distinct(self) -> list[Point]:
        """The points, sorted; limits that nobody named and that come to the same as a lower one are left out."""
        asked = {"risk_cap": self.ladders.risk_caps is not None, "robot_value": self.ladders.robot_values is not None}
        found: dict[tuple[object, ...], Point] = {}
        for setting, point in sorted(self.points.items(), key=lambda item: tuple(item[0].limits.values())):
            own = setting if asked.get(setting.family, True) else None
            found.setdefault((setting.family, point.figures, own), point)
        return sorted(found.values(), key=_by_family)

    def look_at_all(self) -> None:
        """Every setting, the cheap and telling ones first."""
        for policy in ("mrac", "per_cell"):
            self._with_cuts(policy)
        self._up_the_ladder()
        self._refine()
        for setting in self.risk_caps:
            self.look_at(setting)

    def _reserves(self) -> list[Setting]:
        values = self.ladders.risk_caps
        if values is None:
            values = () if len(self.starts) == 1 or not len(self.dangers) else RESERVES
            if values and self.cells > RESERVED_CELLS:
                values = ()
                self.notes.append(
                    f"Reserves were skipped (slow above {RESERVED_CELLS:,} cells); add {argument('reserves')}"
                )
        _check_ladder("risk_cap", values)
        return [Setting("per_cell", risk_cap=value) for value in values]

    def _with_cuts(self, policy: str) -> None:
        """A policy as it is, and ended early."""
        self.look_at(Setting(policy))
        self._cut(Setting(policy), [*self.ladders.landmarks, *self._target(Setting(policy))])

    def _cut(self, setting: Setting, marks: Sequence[float]) -> None:
        """A setting that was looked at, ended at the steps by which it has covered so much on average."""
        covered = self.covered[self._ended(setting)]
        steps = {int(np.argmax(covered >= mark)) for mark in marks if covered[-1] >= mark}
        for step in sorted(step for step in steps - {len(covered) - 1} if step >= self.least_deadline):
            self.look_at(setting._replace(deadline=step))

    def _up_the_ladder(self) -> None:
        """The values of `robot_value` that were named; or each twice the one before, until next to no robot is lost."""
        if self.ladders.robot_values is not None:
            for robot_value in self.ladders.robot_values:
                self.look_at(Setting("per_cell", robot_value=robot_value))
        elif len(self.dangers):
            robot_value = first_worth(float(self.dangers.max()))
            all_refused = self.cells / float(self.dangers.min())
            for step in range(MOST_WORTHS):
                point = self.look_at(Setting("per_cell", robot_value=robot_value * 2**step))
                if point.losses.mean < NEXT_TO_NONE or robot_value * 2**step > all_refused:
                    return

    def _refine(self) -> None:
        """Further values of `robot_value` between two neighbours of which one meets the goal; then the lower one
        ended early.

        A small change of `robot_value` may refuse a large area, so that nothing lies between; a step can be any.
        """
        if not self.goal or self.ladders.robot_values is not None:
            return
        for _ in range(HALVINGS):
            if (parted := self._parted()) is None:
                return
            self.look_at(Setting("per_cell", robot_value=between(*parted)))
        if (parted := self._parted()) is not None:
            setting = Setting("per_cell", robot_value=parted[0])
            more, less = (self.points[self._ended(setting._replace(robot_value=v))].coverage.mean for v in parted)
            marks = [less + (more - less) * part / (HALVINGS + 1) for part in range(1, HALVINGS + 1)]
            self._cut(setting, [*marks, *self._target(setting)])

    def _parted(self) -> tuple[float, float] | None:
        """The first two neighbours of the ladder of `robot_value` of which one meets the goal."""
        known = [(s.robot_value, self.goal.allows(p.sure)) for s, p in self.points.items() if s.robot_value is not None]
        return next(((a, b) for (a, met), (b, other) in pairwise(sorted(known)) if met != other), None)

    def _target(self, setting: Setting) -> tuple[float, ...]:
        """What a setting that was looked at has to have covered on average to be sure of the target, and a little."""
        if self.goal.target is None:
            return ()
        point = self.points[self._ended(setting)]
        return (self.goal.target + AMPLE * (point.coverage.mean - point.least),)

    def _ended(self, setting: Setting) -> Setting:
        """The setting as it was asked for, unless it says otherwise: with the step at which every mission ends."""
        return setting if setting.deadline is not None else setting._replace(deadline=self.choices.deadline)

    def look_at(self, asked: Setting) -> Point:
        """Roll a setting out, and keep what it came to."""
        setting = self._ended(asked)
        found = self._measured(setting, 0)
        self.covered[setting] = found.by_step()
        point = self.points[setting] = point_of(setting, found, self.cells, FIRST_DOUBT, self.longest)
        return point

    def confirmed(self, answer: Front) -> Front:
        """With what the headline speaks of on other rollouts, which had no part in the choice.

        With a goal that is the best setting that is sure to keep it, there as here: they are tried in the order of the
        first rollouts, the `n`-th with a chance of error of ALPHA / 2**n, which all together come to ALPHA at most.
        """
        if not self.goal:
            return replace(answer, priced=tuple(self._again(point, FIRST_DOUBT) for point in answer.corners()))
        order = self.goal.ranked([point.figures for point in answer.points])
        hopeful = [place for place in order if self.goal.allows(answer.points[place].sure)][:TRIES]
        for tried, place in enumerate(hopeful, 1):
            again = self._again(answer.points[place], ALPHA / 2**tried)
            if self.goal.allows(again.sure):
                return replace(answer, pick=place, confirmed=again, tried=tried)
        return replace(answer, tried=len(hopeful))

    def _again(self, point: Point, doubt: float) -> Point:
        """On fresh rollouts; what is exact stays as it is."""
        if point.exact:
            return point
        found = self._measured(point.setting, self.choices.rollouts)
        return point_of(point.setting, found, self.cells, doubt, self.longest)

    def _measured(self, setting: Setting, start: int) -> Measured:
        """What a setting comes to: exactly, or by as many rollouts as were asked for, ids from `start` on."""
        self.doing(f"{setting} on fresh rollouts" if start else f"setting {len(self.points) + 1}, {setting}")
        began, count = time.perf_counter(), self.choices.rollouts
        if self.settings.return_to is None:
            trial = self._trial(setting._replace(deadline=None)).until(setting.deadline)
        else:  # robots turn in time: another deadline is another mission, not the same one cut off
            trial = self._trial(setting)
        found = trial.known(1 / SETTINGS_ABOUT) or trial.sample(start, count)
        self.engine = self.engine if found.exact else trial.engine.name
        self.progress(count, count, time.perf_counter() - began)
        return found

    def _trial(self, setting: Setting) -> Trial:
        """Of a setting's whole mission; the last one is kept."""
        if self.made is None or self.made[0] != setting:
            plan = allocated_plan(self.world, self.starts, settings_of(self.settings, setting))
            self.made = setting, Trial(self.world, plan, replace(self.choices, deadline=None), self.kept)
        return self.made[1]


def _check_ladder(name: str, values: Sequence[float]) -> None:
    """Raise UsageError for a value that the setting of this name cannot have."""
    setting = SETTINGS[name]
    for value in values:
        if not setting.accepts(value):
            raise UsageError(argument(f"{name}s", value), expected=setting.expected(""))


def _by_family(point: Point) -> tuple[int, float, float]:
    """By family, the most coverage first: the same order wherever it stands, so equal ones are picked alike."""
    return FAMILIES.index(point.setting.family), -point.coverage.mean, point.losses.mean
