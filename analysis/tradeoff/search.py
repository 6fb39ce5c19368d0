"""Coverage against robots lost against time: one team on one map under many policies, on common random numbers.

Every setting rolls out the same ids with the same seed, so robot i meets the same luck in all of them (SPEC section 6)
and what they differ in is the setting.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Doing, Progress, quiet
from analysis.sampling import RolloutChoices
from analysis.statistics.intervals import ALPHA
from analysis.theory.longest import longest_mission
from analysis.tradeoff.front import Front, Point, point_of, settings_of
from analysis.tradeoff.rules import (
    FAMILIES,
    HALVINGS,
    LANDMARKS,
    MOST_WORTHS,
    NEXT_TO_NONE,
    RESERVES,
    Goal,
    Setting,
    between,
    careful_first,
    check_goal,
    first_worth,
)
from analysis.trials.measured import Measured
from analysis.trials.trial import Trial
from planner.arguments import argument
from planner.errors import UsageError
from planner.kernels.tables import AllPairs
from planner.limits import MOST_ROLLOUTS
from planner.mrac.make_plan import allocated_plan
from planner.mrac.problem import prepare
from planner.settings import SETTINGS, Settings
from planner.worlds.world import World

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

    reserves: tuple[float, ...] | None = None
    worths: tuple[float, ...] | None = None
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
    progress: Progress | None = None,
    doing: Doing | None = None,
) -> Front:
    """Look at `mrac` and `per_cell`, whole and ended early, and at `per_cell` over ladders of `reserve` and `worth`.

    All are rolled out with the same ids and seed; the ladder of `worth` doubles from 1 / p of the worst cell until next
    to no robot is lost, and is refined around a goal. With `choices.deadline` every mission ends there. Nothing is
    rolled out of settings whose trees end in time (`analysis.trials.trial`). The pick is chosen and told on other ids:
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
    """A few settings in a moment: `per_cell` from the most careful `worth` down to where so many `losses` are reached,
    then the policies as they are.

    The careful ones come first, as they are cheap and say what costs no robot. None is begun after `seconds` of work;
    that of the first is not counted, as code may be compiled in it: `clock`, in seconds. `kept`: where tables of this
    map are kept. Raises InputError.
    """
    choices = replace(choices, exact="never", deadline=settings.deadline)
    search = _Search(world, starts, settings, choices, Goal(), Ladders((), None, ()), None, doing)
    search.kept, begun = kept, math.inf
    if len(search.dangers):
        for worth in careful_first(float(search.dangers.max()), float(search.dangers.min()), search.cells):
            point = search.look_at(Setting("per_cell", worth=worth))
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
        progress: Progress | None,
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
        _check_ladder("worth", ladders.worths or ())
        self.reserves = self._reserves()

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
        asked = {"reserve": self.ladders.reserves is not None, "worth": self.ladders.worths is not None}
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
        for setting in self.reserves:
            self.look_at(setting)

    def _reserves(self) -> list[Setting]:
        values = self.ladders.reserves
        if values is None:
            values = () if len(self.starts) == 1 or not len(self.dangers) else RESERVES
            if values and self.cells > RESERVED_CELLS:
                values = ()
                self.notes.append(
                    f"Reserves were skipped (slow above {RESERVED_CELLS:,} cells); add {argument('reserves')}"
                )
        _check_ladder("reserve", values)
        return [Setting("per_cell", reserve=value) for value in values]

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
        """The values of `worth` that were named; or each twice the one before, until next to no robot is lost."""
        if self.ladders.worths is not None:
            for worth in self.ladders.worths:
                self.look_at(Setting("per_cell", worth=worth))
        elif len(self.dangers):
            worth = first_worth(float(self.dangers.max()))
            all_refused = self.cells / float(self.dangers.min())
            for step in range(MOST_WORTHS):
                point = self.look_at(Setting("per_cell", worth=worth * 2**step))
                if point.losses.mean < NEXT_TO_NONE or worth * 2**step > all_refused:
                    return

    def _refine(self) -> None:
        """Further values of `worth` between two neighbours of which one meets the goal; then the lower one ended early.

        A small change of `worth` may refuse a large area, so that nothing lies between; a step can be any.
        """
        if not self.goal or self.ladders.worths is not None:
            return
        for _ in range(HALVINGS):
            if (parted := self._parted()) is None:
                return
            self.look_at(Setting("per_cell", worth=between(*parted)))
        if (parted := self._parted()) is not None:
            setting = Setting("per_cell", worth=parted[0])
            more, less = (self.points[self._ended(setting._replace(worth=v))].coverage.mean for v in parted)
            marks = [less + (more - less) * part / (HALVINGS + 1) for part in range(1, HALVINGS + 1)]
            self._cut(setting, [*marks, *self._target(setting)])

    def _parted(self) -> tuple[float, float] | None:
        """The first two neighbours of the ladder of `worth` of which one meets the goal."""
        known = [(s.worth, self.goal.allows(p.sure)) for s, p in self.points.items() if s.worth is not None]
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
