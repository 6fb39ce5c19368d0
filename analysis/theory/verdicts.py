"""The formulas of `mrac-jax check`, by key, and the verdict on each for a map, by comparison with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.estimates import ALPHA, ROUNDING, chance_interval, is_at_least, mean_interval
from analysis.theory.bounds import Bounds, Theorem3, corrected_theorem3, until_first_loss
from analysis.theory.exact import OpenLoopExact, open_loop_exact, robot_chances
from analysis.theory.flow_programme import optimum
from analysis.theory.upper_bound import AnyStrategy
from planner.mrac.problem import most_steps, unknown_map_of
from planner.plan.plan import Plan, is_certain
from planner.settings import Settings
from planner.simulator.codes import Outcome
from planner.tally import Tally
from planner.world.levels import find_levels
from planner.world.world import World, check_starts

# The formulas of `mrac-jax check`, by key: name, meaning and source. Their values are computed elsewhere.


class Direction(StrEnum):
    """The claim of a formula about its truth."""

    LOWER = "lower bound"
    UPPER = "upper bound"
    EQUAL = "equality"
    EVERY_RUN = "in every run"


@dataclass(frozen=True)
class Formula:
    """One formula in one reading.

    Attributes:
        name, reading: the paper's number, and the reading. plain: its subject in plain words; readings of one statement
            share it. direction: its claim about the truth.
        unit: of its value. paper: it is the paper's, in this reading; else ours.
        proven: a failure would be an error of a proof or of this program, not a finding.
        loops: the loops that it applies to.
    """

    name: str
    reading: str
    plain: str
    direction: Direction
    unit: Literal["cells", "chance", "steps"] = "cells"
    paper: bool = True
    proven: bool = False
    loops: tuple[str, ...] = ("open", "closed")

    @property
    def title(self) -> str:
        """Name and reading."""
        return f"{self.name}, {self.reading}" if self.reading else self.name

    @property
    def source(self) -> str:
        """Source: the paper's number, or "ours"."""
        return self.name if self.paper else "ours"


LOWER, UPPER, EQUAL = Direction.LOWER, Direction.UPPER, Direction.EQUAL
OPEN, CLOSED, NOMINAL = ("open",), ("closed",), ("nominal",)


def _ours(
    name: str, reading: str, plain: str, direction: Direction, loops: tuple[str, ...] = ("open", "closed")
) -> Formula:
    return Formula(name, reading, plain, direction, paper=False, proven=True, loops=loops)


FORMULAS = {
    "eq1": Formula("eq. (1)", "a robot's survival", "survival of one robot", EQUAL, "chance", proven=True, loops=OPEN),
    "eq2_printed": Formula("eq. (2)", "as printed", "chance that a robot survives, as printed", EQUAL, "chance"),
    "eq2_event": Formula(
        "eq. (2)", "the event as stated", "chance that a robot survives", EQUAL, "chance", proven=True, loops=OPEN
    ),
    "eq4": Formula("eq. (4)", "one robot", "coverage of one robot alone", EQUAL, proven=True, loops=OPEN),
    "eq5_printed": Formula("eq. (5)", "as printed", "lower bound on coverage, one robot", LOWER, loops=OPEN),
    "eq5_with_c00": Formula("eq. (5)", "with C_0,0", "lower bound on coverage, one robot", LOWER, loops=OPEN),
    **{
        f"theorem3_{c}_{kind}": Formula("Theorem 3", f"C {c}, {kind}", "lower bound on coverage, the team", LOWER)
        for c in ("interior", "travel")
        for kind in ("set", "multiset")
    },
    "eq7_robot": Formula("eq. (7)", "one robot", "upper bound on coverage, one robot", UPPER, proven=True, loops=OPEN),
    "eq7_team": Formula("eq. (7)", "for the team", "the bound of one robot, applied to the team", UPPER),
    "theorem1": Formula(
        "Theorem 1", "all cells visited", "cells visited if no robot is lost", EQUAL, proven=True, loops=NOMINAL
    ),
    "theorem2": Formula(
        "Theorem 2",
        "complete or all lost",
        "every run ends complete, or with all robots lost",
        Direction.EVERY_RUN,
        "chance",
        proven=True,
        loops=CLOSED,
    ),
    "theorem4_least": Formula(
        "Theorem 4", "time >= T_1 / k", "least time if no robot is lost", LOWER, "steps", loops=NOMINAL
    ),
    "theorem4_most": Formula(
        "Theorem 4", "time <= T_1", "most time if no robot is lost", UPPER, "steps", loops=NOMINAL
    ),
    "ideal_team": _ours("upper bound, any map", "", "upper bound on coverage, the team on any map", UPPER),
    "ideal_connected": _ours("upper bound, this map", "", "upper bound on coverage, the team on this map", UPPER),
    "any_strategy": _ours("policy-independent bound", "certified", "upper bound on coverage, every strategy", UPPER),
    "optimum": _ours("optimum", "of every strategy", "coverage of the best strategy", UPPER),
    **{
        f"corrected_{form}": _ours(
            "Theorem 3 corrected", reading, "lower bound on coverage, the team, corrected", LOWER, loops=OPEN
        )
        for form, reading in (("count", "counts"), ("largest", "chances"), ("spread", "spread"))
    },
    "until_first_loss": _ours("until the first loss", "", "coverage before the first loss", LOWER),
    "eq4_sum": _ours("eq. (4) summed", "", "upper bound on coverage, the robots' own summed", UPPER, loops=OPEN),
}
"""All formulas, in the order of tables."""


# Verdicts: every formula of SPEC section 7 and of our own, compared with the truth, as data.
#
# A `Check` is one formula in one meaning and one loop (and of one robot, if it is about robots): its value, the truth,
# the verdict and the margin. The open loop's truth is exact (`analysis.theory.exact`); the closed loop's is exact or
# sampled with an interval.

# The truths: exact values, or means of rollouts with simultaneous intervals.

FIGURES = 3
"""Sampled figures of a closed loop, with an interval each: visited, survived, and P(some robot survives)."""


@dataclass(frozen=True)
class Truth:
    """A value and an interval that contains it.

    Attributes:
        value, low, high: low <= value <= high; equal if the value is known.
        how: "exact" (by a formula), "tree" (all histories, or all but negligible ones: then low < high) or "sampled".
    """

    value: float
    low: float
    high: float
    how: str = "exact"
    json_keys = "value interval how"

    @property
    def interval(self) -> tuple[float, float]:
        """The interval that contains the value."""
        return self.low, self.high

    @staticmethod
    def known(value: float, how: str = "exact") -> Truth:
        """An exact value."""
        return Truth(float(value), float(value), float(value), how)


@dataclass(frozen=True)
class ClosedTruth:
    """Figures of the closed loop.

    Attributes:
        visited, survived: expected cells. some_left: probability that a robot is alive at the end.
        as_stated: share of the runs that end as Theorem 2 states, complete or with every robot lost that could reach
            the rest; None if runs may end earlier (`_is_cut_off`).
        rollouts: sample size; 0 if all figures are exact.
        alive, time: expected robots alive at the end, and steps; None: not known exactly.
    """

    visited: Truth
    survived: Truth
    some_left: Truth
    as_stated: Truth | None
    rollouts: int
    alive: float | None = None
    time: float | None = None
    json_keys = "visited survived some_left"

    @property
    def further(self) -> dict[str, Any]:
        """Further exact figures, as a JSON object."""
        return {}


def exact_truth(plan: Plan, world: World, exact: OpenLoopExact, first_only: bool = False) -> ClosedTruth | None:
    """The closed loop's figures by formulas, if it equals the open loop; else None.

    The loops are equal for a plan of one robot (every visit checked, nothing learned), and if no path is dangerous.
    """
    alone = len(plan.robots) == 1 and not (first_only or plan.is_external or world.is_learned)
    if not (alone and exact.is_known) and not is_certain(world, plan):
        return None
    stated = None if _is_cut_off(plan) else Truth.known(1.0)
    left, alive = Truth.known(exact.some_left), float(exact.survival.sum())
    # A run that ends early waits first; the wait is known only for one robot among moving threats.
    ends = world.moving_threats is not None or (plan.state is None and plan.outcome == Outcome.COMPLETE.word)
    time = exact.mean_time if ends else None
    return ClosedTruth(Truth.known(exact.visited), Truth.known(exact.survived), left, stated, 0, alive, time)


def sampled_truth(plan: Plan, world: World, tally: Tally, alpha: float) -> ClosedTruth:
    """The closed loop's figures from a tally; each interval misses with probability <= `alpha`.

    Means: the empirical Bernstein bound; the probability: Clopper & Pearson (`analysis.statistics.estimates`).
    """
    n = tally.rollouts
    stated = as_stated(plan, world, tally.outcomes / n, "sampled")
    alive = n - int(tally.alive[0])
    low, high = chance_interval(alive, n, alpha)
    left = Truth(alive / n, low, high, "sampled")
    return ClosedTruth(_mean(tally.visited, alpha), _mean(tally.survived, alpha), left, stated, n)


def error_of_each(figures: int) -> float:
    """Error probability of each of `figures` sampled figures: ALPHA divided by Bonferroni."""
    return ALPHA / max(figures, 1)


def _mean(counts: NDArray[np.int64], alpha: float) -> Truth:
    low, high = mean_interval(counts, alpha)
    mean = float(counts @ np.arange(len(counts))) / float(counts.sum())
    return Truth(mean, min(low, mean), max(high, mean), "sampled")


def as_stated(plan: Plan, world: World, outcomes: NDArray[np.float64], how: str) -> Truth | None:
    """Share of runs that end as Theorem 2 states; None if they may end earlier (`_is_cut_off`).

    A run without progress is as stated only if the remaining robots cannot reach the rest, which is impossible on a
    connected map.

    Args:
        outcomes: probability of each `Outcome`. The share counts runs outside these probabilities (unexplored
            histories) as stated.
    """
    if _is_cut_off(plan):
        return None
    starts, (halted, cut) = plan.starts, outcomes[[Outcome.NO_PROGRESS, Outcome.STEP_LIMIT]].tolist()
    parts = len(np.unique(world.components[starts[:, 0], starts[:, 1]]))
    unknown = halted if parts > 1 else 0.0
    high = 1.0 - cut - (halted - unknown)
    return Truth(high, high - unknown, high, how)


def _is_cut_off(plan: Plan) -> bool:
    """True if runs may end before all is covered or lost (cut off, risk, range, wrecks), or began mid-mission."""
    settings = plan.settings
    return (
        plan.state is not None
        or settings is None
        or settings.blocks
        or any(limit is not None for limit in (settings.last_step, settings.robot_value, settings.range))
    )


MEANINGS = ("visited", "survived")
EVERY_VISIT = ("any_strategy", "optimum", "ideal_connected")
LOOPS = ("nominal", "open", "closed")


class Verdict(StrEnum):
    """The result of a check, in descending order of importance."""

    FAILS = "fails"
    UNDECIDED = "undecided"
    HOLDS = "holds"
    VACUOUS = "vacuous"


@dataclass(frozen=True)
class Check:
    """One formula compared with the truth.

    Attributes:
        formula: key in FORMULAS. meaning: "visited", "survived" or "" if neither applies.
        loop: "open", "closed" or "nominal" (the run without losses). robot: index, or None for the team.
        value: of the formula, in the formula's unit. truth: in the same unit.
        verdict: see `judge`. margin: distance to the truth's point value; negative if the formula fails.
    """

    formula: str
    meaning: str
    loop: str
    robot: int | None
    value: float
    truth: Truth
    verdict: Verdict
    margin: float
    json_keys = """
        key formula=about.name about.reading about.paper about.proven about.direction about.unit
        meaning=meaning_or_none loop robot value truth verdict margin
    """

    @property
    def meaning_or_none(self) -> str | None:
        """ "visited" or "survived"; None if neither applies."""
        return self.meaning or None

    @property
    def about(self) -> Formula:
        """The formula's definition."""
        return FORMULAS[self.formula]

    @property
    def key(self) -> str:
        """Formula, meaning and loop: shared by checks of different robots and maps."""
        return "/".join(part for part in (self.formula, self.meaning, self.loop) if part)

    @property
    def named(self) -> str:
        """The formula with its meaning and loop, as the start of a sentence."""
        run = "nominal run" if self.loop == "nominal" else f"{self.loop} loop"
        of = f"{self.meaning}, {run}" if self.meaning else run
        return f"{self.about.title[0].upper()}{self.about.title[1:]} ({self.about.plain}; {of})"

    @property
    def tightness(self) -> float | None:
        """Value over truth: 1 is tight; None if the truth is 0."""
        return self.value / self.truth.value if self.truth.value else None


def judge(value: float, truth: Truth, direction: Direction, least: float, most: float) -> Verdict:
    """The verdict on `value` as a claim about a truth in `truth.low .. truth.high`.

    FAILS if the claim is wrong for every truth in the interval, HOLDS if it is right for every one, else UNDECIDED.
    VACUOUS: a lower bound that is not above `least`, or an upper bound that is not below `most`, the trivial limits. An
    equality with a sampled truth is never HOLDS. "In every run" fails with the first run that differs.
    """
    slack = ROUNDING * max(1.0, abs(truth.value))
    if direction is Direction.LOWER and value <= least + slack:
        return Verdict.VACUOUS
    if direction is Direction.UPPER and value >= most - slack:
        return Verdict.VACUOUS
    not_above = is_at_least((truth.low, truth.high), value, slack)
    not_below = is_at_least((-truth.high, -truth.low), -value, slack)
    one_sided = {Direction.LOWER: [not_above], Direction.UPPER: [not_below]}
    right = one_sided.get(direction, [not_above, not_below])
    if False in right:
        return Verdict.FAILS
    return Verdict.HOLDS if all(right) else Verdict.UNDECIDED


def make_check(
    formula: str, value: float, truth: Truth, loop: str, most: float, meaning: str = "", robot: int | None = None
) -> Check:
    """A check of a formula. `most`: the largest possible value, in the formula's unit (the least is 0)."""
    direction = FORMULAS[formula].direction
    above = truth.value - value
    margin = {Direction.LOWER: above, Direction.UPPER: -above}.get(direction, -abs(above))
    verdict = judge(value, truth, direction, 0.0, most)
    return Check(formula, meaning, loop, robot, float(value), truth, verdict, float(margin) + 0.0)


def worst_of_robots(checks: Iterable[Check]) -> list[Check]:
    """One check for each key, in order: that of the robot which fails most, or holds most narrowly."""
    groups = groupby(sorted(checks, key=_place), key=_place)
    return [min(group, key=badness) for _, group in groups]


def badness(check: Check) -> tuple[int, float]:
    """Sort key: the lower, the more a check fails, or the more narrowly it holds."""
    return list(Verdict).index(check.verdict), check.margin


def _place(check: Check) -> tuple[int, int, int]:
    """Sort key of tables: formula, meaning, loop."""
    return list(FORMULAS).index(check.formula), ("", *MEANINGS).index(check.meaning), LOOPS.index(check.loop)


def overall(checks: Iterable[Check]) -> Verdict | None:
    """The most important verdict of several checks; None without checks. VACUOUS only if all are."""
    order = list(Verdict)
    return min((check.verdict for check in checks), key=order.index, default=None)


def of_formula(checks: Iterable[Check], formula: str) -> list[Check]:
    """The checks of one formula."""
    return [check for check in checks if check.formula == formula]


# The open loop: every truth is exact.


def paper_checks(plan: Plan, world: World, exact: OpenLoopExact, bounds: Bounds) -> list[Check]:
    """Eqs. (1)-(7) and Theorem 3 in all readings, and the team's upper bound, against the open loop.

    Empty for a plan that resumes a mission: the formulas apply to whole missions.
    """
    if plan.state is not None:
        return []
    cells, left = float(world.accessible(plan.starts).sum()), Truth.known(exact.some_left)
    return [
        make_check("eq2_printed", bounds.eq2_printed, left, "open", 1.0),
        make_check("eq2_event", bounds.team_survival, left, "open", 1.0),
        *_alone_checks(plan, world, bounds, cells),
        *_theorem3_checks(bounds, {m: Truth.known(getattr(exact, m)) for m in MEANINGS}, "open", cells),
        *_ideal_checks(bounds, Truth.known(exact.visited), "open", cells),
    ]


def _alone_checks(plan: Plan, world: World, bounds: Bounds, cells: float) -> Iterator[Check]:
    """Eqs. (1), (4), (5) and (7) for each robot, against the closed form of a team of that robot alone.

    Its survival is the product of the probabilities to survive each entry, computed by logarithms.
    """
    for number, robot in enumerate(plan.robots):
        alone = open_loop_exact(replace(plan, robots=(robot,)), world)
        with np.errstate(divide="ignore"):  # by logarithms: 1 - P(lost) would lose values below 1e-16
            left = Truth.known(float(np.exp(np.log1p(-robot_chances(robot, world).threat).sum())))
        yield make_check("eq1", bounds.eq1[number], left, "open", 1.0, robot=number)
        for meaning in MEANINGS:
            truth = Truth.known(getattr(alone, meaning))
            yield make_check("eq4", getattr(bounds.eq4[number], meaning), truth, "open", cells, meaning, number)
        for reading in ("printed", "with_c00"):
            value = getattr(bounds.eq5[number], reading)
            if value is not None:
                truth = Truth.known(alone.survived)
                yield make_check(f"eq5_{reading}", value, truth, "open", cells, "survived", number)
        truth = Truth.known(alone.visited)
        yield make_check("eq7_robot", bounds.ideal_eq7, truth, "open", cells, "visited", number)


def _theorem3_checks(bounds: Bounds, truths: dict[str, Truth], loop: str, cells: float) -> Iterator[Check]:
    for meaning, truth in truths.items():
        theorem: Theorem3 | None = getattr(bounds, f"theorem3_{meaning}")
        if theorem is not None:
            for reading in Theorem3.__dataclass_fields__:
                value = getattr(theorem, reading)
                yield make_check(f"theorem3_{reading}", value, truth, loop, cells, meaning)


def _ideal_checks(bounds: Bounds, truth: Truth, loop: str, cells: float) -> Iterator[Check]:
    yield make_check("eq7_team", bounds.ideal_eq7, truth, loop, cells, "visited")
    yield make_check("ideal_team", bounds.ideal_team, truth, loop, cells, "visited")


# Our bounds, the closed loop, and the nominal run.


OwnBounds = dict[tuple[str, str], float]
"""Our bounds for one plan in cells, by formula and meaning."""


def own_bounds(plan: Plan, world: World, bounds: Bounds, limit: AnyStrategy) -> OwnBounds:
    """Our bounds of `analysis.theory.bounds`, and the sum of eq. (4).

    `limit`: the bounds for every strategy. Bounds that were not computed, and an optimum that is too expensive, are
    omitted.
    """
    corrected, calm = corrected_theorem3(plan, world), until_first_loss(plan, world)
    values: OwnBounds = {}
    for meaning in MEANINGS:
        for form in ("count", "largest", "spread"):
            values[f"corrected_{form}", meaning] = getattr(getattr(corrected, meaning), form)
        values["until_first_loss", meaning] = getattr(calm, meaning)
        values["eq4_sum", meaning] = sum(getattr(gain, meaning) for gain in bounds.eq4)
    values["ideal_connected", "visited"] = limit.connected
    if limit.flow is not None:
        values["any_strategy", "visited"] = limit.flow
    best = optimum(world, plan.starts)
    if best is not None:
        values["optimum", "visited"] = best
    return values


def own_checks(values: OwnBounds, truths: dict[str, Truth], loop: str, cells: float) -> Iterator[Check]:
    """Checks of our bounds that apply to this loop, against its truths by meaning."""
    for (formula, meaning), value in values.items():
        if loop in FORMULAS[formula].loops:
            yield make_check(formula, value, truths[meaning], loop, cells, meaning)


def closed_checks(
    plan: Plan, world: World, bounds: Bounds, own: OwnBounds, truth: ClosedTruth, first_only: bool = False
) -> list[Check]:
    """Checks of the formulas that apply to the closed loop.

    Those of EVERY_VISIT assume that every visit can destroy a robot, and are omitted with `first_only`.
    """
    cells = float(world.accessible(plan.starts).sum())
    truths = {"visited": truth.visited, "survived": truth.survived}
    holding = {key: value for key, value in own.items() if not (first_only and key[0] in EVERY_VISIT)}
    checks = [
        make_check("eq2_printed", bounds.eq2_printed, truth.some_left, "closed", 1.0),
        *_theorem3_checks(bounds, truths, "closed", cells),
        *_ideal_checks(bounds, truth.visited, "closed", cells),
        *own_checks(holding, truths, "closed", cells),
    ]
    if truth.as_stated is not None:
        checks.append(make_check("theorem2", 1.0, truth.as_stated, "closed", 1.0))
    return checks


def nominal_checks(plan: Plan, world: World, alone: Plan | None) -> list[Check]:
    """Theorems 1 and 4 on the run without losses; `alone`: the plan of the first robot alone, for T_1.

    Empty for runs that were cut off, with a robot value or a range, and for external plans: the theorems do not apply.
    Theorem 4 does not apply to robots that return to base.
    """
    settings = plan.settings
    cut_off = plan.outcome in (Outcome.STEP_LIMIT.word, Outcome.DEADLINE.word)
    if settings is None or settings.robot_value is not None or settings.range is not None or cut_off:
        return []
    accessible = np.flatnonzero(world.accessible(plan.starts))
    seen = np.unique(np.concatenate([robot.path for robot in plan.robots]))
    missed = len(np.setdiff1d(accessible, seen))
    checks = [make_check("theorem1", len(accessible), Truth.known(len(accessible) - missed), "nominal", np.inf)]
    if alone is None or plan.comes_home or world.accessible(alone.starts).sum() != len(accessible):
        return checks
    if (alone.outcome, plan.outcome) == ("complete", "complete"):
        took = Truth.known(float(plan.makespan))
        checks.append(make_check("theorem4_least", alone.makespan / len(plan.robots), took, "nominal", np.inf))
        checks.append(make_check("theorem4_most", float(alone.makespan), took, "nominal", np.inf))
    return checks


def proven_failures(checks: Iterable[Check]) -> list[Check]:
    """Checks that fail although their formula is proven: an error of the proof or of the program."""
    return [check for check in checks if check.verdict is Verdict.FAILS and check.about.proven]


# The longest possible run, for intervals of mean time.


def longest_mission(world: World, starts: ArrayLike, settings: Settings, given: int = 0) -> int:
    """T_max of the closed loop of robots at `starts` `[K, 2]`, in steps; `given`: steps of external paths."""
    checked = check_starts(starts, world.met, world.source)
    unknown = unknown_map_of(world, checked, settings.levels)
    if unknown is not None:
        return most_steps(settings, unknown.highest, given)
    levels = find_levels(world.threat, world.accessible(checked), settings.levels)
    return most_steps(settings, levels, given)


def longest_run(world: World, plan: Plan, loop: Literal["open", "closed"], known: int | None = None) -> int:
    """Most steps of a run of this plan; `known`: T_max, if it was computed already.

    Open loop: the length of the longest path. One robot with a known map: its nominal run, which a loss only shortens.
    Otherwise T_max, at which every run is cut off.
    """
    if loop == "open":
        return plan.makespan
    if len(plan.robots) == 1 and not plan.is_external and world.knowledge is None:
        return plan.time
    if known is not None:
        return known
    return longest_mission(world, plan.starts, plan.require(world), plan.makespan if plan.is_external else 0)
