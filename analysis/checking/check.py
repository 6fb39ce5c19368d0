"""Checks of all formulas on one map, and on many random worlds of the paper's kind."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import closed_truth
from analysis.inputs import map_size
from analysis.page.elements import Chart, Series
from analysis.report.result import Result
from analysis.sampling import Exactness, RolloutChoices, make_roll_out
from analysis.statistics.estimates import ALPHA, Estimate, over_maps, proportion
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.upper_bound import any_strategy, trimmed
from analysis.theory.verdicts import (
    FIGURES,
    FORMULAS,
    MEANINGS,
    Check,
    ClosedTruth,
    Truth,
    Verdict,
    closed_checks,
    error_of_each,
    nominal_checks,
    of_formula,
    own_bounds,
    own_checks,
    paper_checks,
    proven_failures,
    sampled_truth,
    worst_of_robots,
)
from analysis.utils.notes import ProgressCallback
from analysis.utils.pool import answers, wanted_processes
from planner.arguments import argument, whole
from planner.errors import UsageError
from planner.formatting import counted
from planner.make_plan import make_plan
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.tables import AllPairs
from planner.settings import Choices, Settings
from planner.tally import Tally
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# Checks of all formulas on one map; the closed loop is simulated if it is not known exactly.


@dataclass(frozen=True, eq=False, repr=False)
class MapCheck(Result):
    """Checks of all formulas on one map.

    Attributes:
        world, plan: the input. exact: the open loop. closed: the closed loop, or None if it was not computed.
        checks: for every robot, formula, meaning and loop. left_out: omitted formulas, with reasons.
        alpha: error probability of the interval of one sampled figure. seed: of the rollouts.
        partial: whether the rollouts were interrupted.
        theory: rows of the table: "main", one for each formula; "all", every reading and meaning.
    """

    reported_by = "analysis.checking.report:check_report"
    listed = "checks"

    world: World
    plan: Plan
    exact: OpenLoopExact
    closed: ClosedTruth | None
    checks: tuple[Check, ...]
    left_out: tuple[str, ...]
    alpha: float
    seed: int = 0
    partial: bool = False
    theory: Literal["main", "all"] = "main"
    json_keys = """
        answer=summary robots=plan.team starts=plan.starts cells.total=world.threat.size cells.accessible=cells
        plan.shares plan.plan_for rollouts seed alpha truth.open_loop.visited=exact.visited
        truth.open_loop.survived=exact.survived truth.closed_loop=closed checks failing faults=faulty left_out
    """

    @property
    def rollouts(self) -> int:
        """Number of rollouts; 0: the closed loop is exact, or was not computed."""
        return 0 if self.closed is None else self.closed.rollouts

    @property
    def failing(self) -> list[str]:
        """Keys of the formulas, meanings and loops that fail."""
        return [check.key for check in self.rows if check.verdict is Verdict.FAILS]

    @property
    def faulty(self) -> list[str]:
        """Keys of the proven formulas that fail."""
        return sorted({check.key for check in self.faults})

    @cached_property
    def cells(self) -> int:
        """Number of accessible cells."""
        return int(self.world.accessible(self.plan.starts).sum())

    @property
    def faults(self) -> list[Check]:
        """Failures of proven formulas."""
        return proven_failures(self.checks)

    @property
    def rows(self) -> list[Check]:
        """One check for each formula, meaning and loop: that of the worst robot."""
        return worst_of_robots(self.checks)


def check_world(world: World) -> None:
    """Raise WorldError for a world that the formulas do not apply to."""
    world.require_certain_map("a check of the formulas")


def check_map(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    sample: Callable[[], Tally | None],
    *,
    alone: Plan | None = None,
    figures: int = FIGURES,
    bound: bool | None = None,
    thresholds: bool = False,
    kept: AllPairs | None = None,
) -> MapCheck:
    """Check all formulas on one map.

    Args:
        world, plan: the input.
        choices: of the closed loop: checked visits, and the time for its exact values.
        sample: simulates the closed loop, and is called only if it is not known exactly; returns None without rollouts.
        alone: the plan of the first robot alone, if available.
        figures: number of sampled figures with simultaneous 95 % intervals, including the three of this map.
        bound, thresholds: of the bound for every strategy, as `flow` and `thresholds` of `any_strategy`.
        kept: cache of all-pairs tables.
    """
    check_world(world)
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    cells = float(world.accessible(plan.starts).sum())
    limit = any_strategy(trimmed(world, plan), plan.starts, bound, thresholds=thresholds)
    own = own_bounds(plan, world, bounds, limit)
    truths = {meaning: Truth.known(getattr(exact, meaning)) for meaning in MEANINGS}
    checks = [*paper_checks(plan, world, exact, bounds), *own_checks(own, truths, "open", cells)]
    if alone is None and not plan.is_external:
        alone = make_plan(world, plan.starts[:1], plan.settings and plan.settings.alone)
    checks += nominal_checks(plan, world, alone)
    alpha, closed = error_of_each(figures), None
    if not plan.is_external:
        closed = closed_truth(plan, world, exact, choices, kept)
        if closed is None:
            tally = sample()
            closed = None if tally is None else sampled_truth(plan, world, tally, alpha)
    if closed is not None:
        checks += closed_checks(plan, world, bounds, own, closed, choices.first_only)
    no_bound = (
        f"the bound for every strategy is omitted: {argument('bound')} computes it, "
        "which may take a minute on a large map"
    )
    left_out = (*_left_out(plan, checks, closed), *(() if limit.flow is not None else (no_bound,)))
    return MapCheck(world, plan, exact, closed, tuple(checks), left_out, alpha)


def _left_out(plan: Plan, checks: list[Check], closed: ClosedTruth | None) -> tuple[str, ...]:
    """Notes on the omitted formulas."""
    if plan.is_external:
        return (f"the {plan.origin} has no areas: eq. (5), the theorems and the closed loop are omitted",)
    made, out = {check.formula for check in checks}, []
    robots = {check.robot for check in of_formula(checks, "eq5_printed")}
    ranged = plan.settings is not None and plan.settings.range is not None
    if ranged or plan.comes_home:
        kind = "robots with a range" if ranged else "robots that return to base, nor do Theorems 3 and 4"
        out.append(f"eq. (5) is omitted: it does not apply to {kind}")
    elif plan.shares:
        out.append("eq. (5) is undefined here: areas are shared in the run without losses")
    elif len(robots) < len(plan.robots):
        without = len(plan.robots) - len(robots)
        out.append(f"eq. (5) is undefined for {without} of {len(plan.robots)} robots: a dangerous start, or no area")
    with_worth = plan.settings is not None and plan.settings.robot_value is not None
    if with_worth or ranged:
        why = "the rest may not be worth the risk (robot value)" if with_worth else "robots have a range"
        out.append(f"Theorems 1, 2 and 4 are omitted: they do not apply to runs in which {why}")
    elif "theorem4_most" not in made and not plan.comes_home:
        out.append("Theorem 4 is omitted: one robot alone cannot cover these cells, or the run was cut off")
    if closed is None:
        out.append("the closed loop is omitted: there are no rollouts")
    elif closed.as_stated is None and not (with_worth or ranged):
        out.append("Theorem 2 is omitted: max_steps may cut runs off")
    return tuple(out)


def check_input(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    progress: ProgressCallback | None = None,
    bound: bool | None = None,
    theory: Literal["main", "all"] = "main",
) -> MapCheck:
    """Check all formulas on one map; the closed loop by `choices`, if it is not known exactly.

    An interruption (KeyboardInterrupt) keeps the rollouts done so far, `partial`.

    Args:
        world, plan, choices: the input. progress: receives the number of rollouts. theory: as in `MapCheck`.
        bound: as in `check_map`.

    Raises:
        InputError: the formulas do not apply to this input.
    """
    plan.failure_model.check_known("a check of the formulas")
    if plan.settings is not None:
        plan.settings.require_uniform("a check of the formulas")
    if plan.state is not None:
        raise UsageError(
            "the plan resumes a mission; the formulas apply to whole missions", fix="check one from a start"
        )
    partial, kept = False, AllPairs()

    def sample() -> Tally | None:
        nonlocal partial
        tally = None
        try:
            for stage in make_roll_out(world, plan, choices, kept=kept)(choices, None):
                tally = stage.tally
                if progress is not None:
                    progress(tally.rollouts, choices.rollouts, stage.seconds)
        except KeyboardInterrupt:
            partial = True
        return tally

    checked = check_map(world, plan, choices, sample, bound=bound, thresholds=bool(bound), kept=kept)
    return replace(checked, seed=choices.seed, partial=partial, theory=theory)


# Formulas on many random worlds of the paper's kind: rate of failure, size of the error, and the worst world.
#
# World number i of a survey with seed S is `random_world` with seed S + i; its rollouts have the same seed (worlds and
# rollouts share no stream). So a survey is a pure function of its choices: neither the number of processes nor an
# interruption changes a world.
#
# Multiple comparisons: against an exact truth a formula fails or does not. A sampled truth (closed loop, two robots or
# more) has an interval with error probability at most 0.05 / (3 figures x worlds x sizes of team), by Bonferroni:
# empirical Bernstein for the means, Clopper & Pearson for the probability. A failure counts only outside the interval,
# so that with 95 % confidence none of the counted failures of the survey is a sampling error.

MOST_WORLDS = 1_000_000
EXACT: Exactness = 0.1
"""Seconds for the exact closed loop of each world and team (`RolloutChoices.exact`)."""


@dataclass(frozen=True)
class SurveyChoices:
    """Settings of a survey.

    Attributes:
        worlds: number of worlds. kind, height, width: of each world. teams: sizes of team, increasing.
        settings: of the planner. bound: whether the bound for every strategy is computed.
    """

    worlds: int
    kind: Literal["contiguous", "scattered"]
    height: int
    width: int
    teams: tuple[int, ...]
    settings: Settings
    bound: bool = False

    @property
    def figures(self) -> int:
        """Sampled figures with simultaneous intervals: those of every world and team of two robots or more."""
        return FIGURES * self.worlds * max(1, sum(robots > 1 for robots in self.teams))


@dataclass(frozen=True)
class Entry:
    """One world with one team; `checks`: that of the worst robot for each formula, meaning and loop."""

    seed: int
    robots: int
    cells: int
    checks: tuple[Check, ...]


@dataclass(frozen=True)
class Row:
    """One formula in one meaning and loop for one size of team, over all worlds on which it is defined.

    Attributes:
        check: the worst one, with the smallest margin. seed: of its world.
        robots: size of team. worlds: number of worlds. verdicts: number of worlds with each verdict.
        tightness: median of value / truth. fails: fraction of the worlds on which it fails, with its interval.
    """

    check: Check
    seed: int
    robots: int
    worlds: int
    verdicts: dict[Verdict, int]
    tightness: float | None
    fails: Estimate
    json_keys = """
        check.key formula=check.about.name check.about.reading check.about.paper check.about.proven
        check.about.direction check.about.unit meaning=check.meaning_or_none check.loop robots worlds *verdicts
        fails_fraction.mean=fails.mean fails_fraction.ci95=fails.ci95 worst=failure median_tightness=tightness
    """

    @property
    def failure(self) -> dict[str, float]:
        """The worst world by seed, with the value, the truth and the margin there."""
        check = self.check
        return {"seed": self.seed, "margin": check.margin, "value": check.value, "truth": check.truth.value}


@dataclass(frozen=True)
class Fault:
    """The failure of a proven formula on the world with this seed."""

    seed: int
    robots: int
    check: Check
    json_keys = "seed robots *check"


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Result):
    """The result of a survey; `entries` are sorted by (seed, robots). partial: whether it was interrupted."""

    reported_by = "analysis.checking.report:survey_report"

    choices: SurveyChoices
    rollouts: RolloutChoices
    entries: tuple[Entry, ...]
    seconds: float
    partial: bool = False
    json_keys = """
        answer=summary worlds choices.kind size robots=choices.teams rollouts.seed rollouts=rollouts.rollouts alpha
        rows worst=worst_worlds faults seconds
    """

    @property
    def faults(self) -> list[Fault]:
        """Every failure of a proven formula."""
        return [Fault(e.seed, e.robots, check) for e in self.entries for check in proven_failures(e.checks)]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the worlds, cells."""
        return self.choices.height, self.choices.width

    @property
    def alpha(self) -> float:
        """Error probability of the interval of one sampled figure."""
        return ALPHA / self.choices.figures

    @property
    def worst_worlds(self) -> dict[str, dict[str, int]]:
        """Seed of the world and size of the team with the worst failure, by key."""
        return {key: {"seed": row.seed, "robots": row.robots} for key, row in self.worst_failures().items()}

    @property
    def worlds(self) -> int:
        """Number of worlds."""
        return len({entry.seed for entry in self.entries})

    @property
    def formulas(self) -> tuple[set[str], set[str]]:
        """The formulas of the paper, counting all readings, and ours."""
        paper, ours = ({row.check.formula for row in self.rows if row.check.about.paper is of} for of in (True, False))
        return paper, ours

    @property
    def description(self) -> str:
        """ "200 contiguous worlds of 20 x 20 cells"."""
        worlds = counted(self.worlds, f"{self.choices.kind} world")
        return f"{worlds} of {self.choices.height} x {self.choices.width} cells"

    @cached_property
    def rows(self) -> list[Row]:
        """All formulas, meanings and loops by size of team."""
        return [make_row(robots, found) for _, robots, found in self.grouped()]

    @property
    def by_key(self) -> list[list[Row]]:
        """The rows of each formula, meaning and loop."""
        return [list(rows) for _, rows in groupby(self.rows, lambda row: row.check.key)]

    @cached_property
    def failing(self) -> dict[str, Row]:
        """For each of the paper's formulas that fails on some world, the row with the highest rate of failure."""
        fails = [row for row in self.rows if row.verdicts[Verdict.FAILS] and row.check.about.paper]
        by_formula = {key: [row for row in fails if row.check.formula == key] for key in FORMULAS}
        return {key: max(rows, key=lambda row: row.fails.mean) for key, rows in by_formula.items() if rows}

    def grouped(self) -> Iterator[tuple[str, int, list[tuple[int, Check]]]]:
        """(key, robots, [(seed, check)]) in the order of tables."""
        groups: dict[tuple[str, int], list[tuple[int, Check]]] = {}
        for entry in self.entries:
            for check in entry.checks:
                groups.setdefault((check.key, entry.robots), []).append((entry.seed, check))
        longest = max(self.entries, key=lambda entry: len(entry.checks), default=None)
        keys = [check.key for check in longest.checks] if longest else []
        keys += sorted({key for key, _ in groups} - set(keys))
        for key in keys:
            for robots in self.choices.teams:
                if (key, robots) in groups:
                    yield key, robots, groups[key, robots]

    def worst_failures(self) -> dict[str, Row]:
        """For each key that fails on some world, the row of the team with its worst failure."""
        failed = [[row for row in rows if row.check.verdict is Verdict.FAILS] for rows in self.by_key]
        return {rows[0].check.key: min(rows, key=lambda row: row.check.margin) for rows in failed if rows}


def make_row(robots: int, found: list[tuple[int, Check]]) -> Row:
    """The row of [(seed, check)] of one key and one size of team; the worst is a failure if there is one."""
    seed, worst = min(found, key=lambda one: (one[1].verdict is not Verdict.FAILS, one[1].margin, one[0]))
    verdicts = {verdict: sum(check.verdict is verdict for _, check in found) for verdict in Verdict}
    tight = [check.tightness for _, check in found if check.tightness is not None]
    fails = proportion(verdicts[Verdict.FAILS], len(found))
    return Row(worst, seed, robots, len(found), verdicts, float(np.median(tight)) if tight else None, fails)


def make_survey(
    worlds: int,
    kind: Literal["contiguous", "scattered"] | None,
    size: str | None,
    teams: tuple[int, ...],
    given: Choices,
    bound: bool = False,
) -> SurveyChoices:
    """The settings, checked on a first world. Raises InputError."""
    whole(1, MOST_WORLDS).check("worlds", worlds)
    height, width = map_size(size or "20x20")
    settings = Settings(**given.given())
    settings.check()
    choices = SurveyChoices(worlds, kind or "contiguous", height, width, teams, settings, bound)
    survey_world(choices, 0)
    return choices


def survey_world(choices: SurveyChoices, seed: int) -> World:
    """The survey's world with this seed."""
    return random_world(choices.height, choices.width, ThreatPattern(choices.kind, seed=seed))


def survey_starts(world: World, robots: int) -> NDArray[np.int64]:
    """Starts of its team, int64 `[K, 2]`."""
    return place_starts(world, robots)[0]


def look_at(choices: SurveyChoices, rollouts: RolloutChoices, seed: int) -> list[Entry]:
    """Check one world with every team. The closed loop uses one thread, because worlds run in parallel processes."""
    world = survey_world(choices, seed)
    # Theorem 4 compares every team with the plan of a single robot.
    alone = plan_team(world, survey_starts(world, 1), choices.settings)
    entries, kept = [], AllPairs()
    for robots in choices.teams:
        plan = alone if robots == 1 else plan_team(world, survey_starts(world, robots), choices.settings)
        soon, sample = replace(rollouts, exact=EXACT), partial(_sample, rollouts, world, plan, seed, kept)
        many, bound = choices.figures, choices.bound
        checked = check_map(world, plan, soon, sample, alone=alone, figures=many, bound=bound, kept=kept)
        entries.append(Entry(seed, robots, checked.cells, tuple(checked.rows)))
    return entries


def _sample(rollouts: RolloutChoices, world: World, plan: Plan, seed: int, kept: AllPairs) -> Tally:
    loop = compile_closed_loop(plan, world, first_only=rollouts.first_only, kept=kept)
    return run_range(loop, seed, 0, rollouts.rollouts, threads=1)[0]


def run_survey(
    choices: SurveyChoices,
    rollouts: RolloutChoices,
    *,
    processes: int | None = None,
    progress: ProgressCallback | None = None,
) -> Survey:
    """Run a survey. The number of `processes` (None: one a core) does not change the result.

    An interruption (KeyboardInterrupt) ends it with the worlds done so far, `partial`; without any it is raised again.
    Raises InputError.
    """
    count = min(wanted_processes(processes, choices.worlds), choices.worlds)
    if rollouts.seed + choices.worlds > 2**64:
        raise UsageError(argument("seed", rollouts.seed), expected=f"at most 2**64 - {choices.worlds}")
    seeds = range(rollouts.seed, rollouts.seed + choices.worlds)
    clock, entries, interrupted, done = time.perf_counter(), [], False, 0
    try:
        for _, found in answers(partial(look_at, choices, rollouts), seeds, count, lambda seed: f"world {seed}"):
            entries += found
            done += 1
            if progress is not None:
                progress(done, choices.worlds, time.perf_counter() - clock)
    except KeyboardInterrupt:
        if not entries:
            raise
        interrupted = True
    # Worlds finish in any order; the result must not depend on it.
    entries.sort(key=lambda entry: (entry.seed, entry.robots))
    return Survey(choices, rollouts, tuple(entries), time.perf_counter() - clock, interrupted)


# The charts of a survey: rates of failure, coverage with its bounds, and every bound against the truth.

DRAWN = {
    "eq7_team/visited/closed": "upper bound, one robot, eq. (7)",
    "ideal_connected/visited/closed": "ours: upper bound, this map",
    "theorem3_interior_set/visited/open": "Theorem 3, C interior, set",
    "corrected_largest/visited/open": "ours: chances",
    "until_first_loss/visited/closed": "ours: until the first loss",
}
"""Bounds that are drawn with the coverage, by key of the check; as many as there are colours."""


def failing(survey: Survey) -> Chart:
    """The share of worlds on which each of the paper's formulas fails, in its worst meaning and loop: a curve each."""
    series = []
    for most in survey.failing.values():
        rows = [row for row in survey.rows if row.check.key == most.check.key]
        series.append(Series.of(most.check.named, [row.robots for row in rows], [row.fails for row in rows]))
    return Chart(
        "How often the paper's formulas fail", tuple(series), "robots", "share of the worlds on which it fails, %",
        unit="%", y_range=(0, 100),
        note="Of the worlds where the formula is defined, in the meaning and loop in which it fails most.",
    )  # fmt: skip


def coverage(survey: Survey) -> Chart:
    """Coverage and its bounds, means over the worlds, with 95 % intervals of these means."""
    names = {f"ideal_team/visited/{loop}": f"coverage, {loop} loop" for loop in ("open", "closed")} | DRAWN
    cells = {(entry.seed, entry.robots): entry.cells for entry in survey.entries}
    means: dict[str, dict[int, Estimate]] = {}
    for key, robots, found in survey.grouped():
        shares = [(check.value if key in DRAWN else check.truth.value) / cells[seed, robots] for seed, check in found]
        means.setdefault(key, {})[robots] = over_maps(np.array(shares))
    series = [
        Series.of(name, list(means[key]), list(means[key].values()), dashed=key in DRAWN, colour=place)
        for place, (key, name) in enumerate(names.items())
        if key in means
    ]
    return Chart(
        "Coverage, and formulas for its bounds", tuple(series), "robots",
        "mean over the worlds, % of the accessible cells", unit="%", y_range=(0, 100),
        at_y=((100.0, "every cell"),), interval="95 % interval of the mean over worlds",
    )  # fmt: skip


PANELS = (
    "eq2_printed/open",
    "eq5_printed/survived/open",
    "eq5_with_c00/survived/open",
    "theorem3_interior_set/visited/open",
    "theorem3_travel_set/visited/open",
    "theorem3_interior_multiset/visited/open",
    "corrected_count/visited/open",
    "corrected_largest/visited/open",
    "corrected_spread/visited/open",
    "eq7_team/visited/closed",
    "ideal_connected/visited/closed",
)
"""Keys of the panels, bound against truth."""


def bound_charts(survey: Survey) -> list[Chart]:
    """A chart for each of PANELS, a point for each world and team, in the formula's unit."""
    charts, points = [], {(key, robots): np.array([(check.truth.value, check.value) for _, check in found])
                          for key, robots, found in survey.grouped()}  # fmt: skip
    for key in PANELS:
        about, (_, *meaning, loop) = FORMULAS[key.partition("/")[0]], key.split("/")
        found = {place: points[key, k] for place, k in enumerate(survey.choices.teams) if (key, k) in points}
        truths = np.concatenate([np.empty(0), *(pairs[:, 0] for pairs in found.values())])
        ends = [truths.min(), truths.max()] if len(truths) else []
        series = [Series("value = truth", ends, ends, dashed=True, colour=3)]
        for place, pairs in found.items():
            # A point below a third of the axis would hide the others: a bound far below is worthless, however far.
            values = np.maximum(pairs[:, 1], -1.2 * truths.max())
            team = counted(survey.choices.teams[place], "robot")
            series.append(Series(team, pairs[:, 0], values, kind="points", colour=place))
        title = about.title + ("" if about.paper else " *")
        about_it = f"{about.direction}; {meaning[0] if meaning else 'a robot survives'}, {loop} loop"
        about_it += "" if len(truths) else ": undefined"
        charts.append(Chart(title, tuple(series), "truth", about_it, fit=True))
    return charts
