"""Comparison of two plans, settings, teams or maps on common random numbers.

Rollout r of both sides has the same failure thresholds, one for each robot (SPEC section 14). Common effects cancel in
the difference, so that its interval is narrower than for independent runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.estimators.trial import closed_truth
from analysis.report.model import KeyFigure, Report, Section
from analysis.report.result import Result
from analysis.sampling import RolloutChoices, check_deadline, check_metric, home_of, knowing_deadline, make_singles
from analysis.statistics.estimates import Estimate, between, exactly, looks, of_all, proportion, robots_text
from analysis.statistics.variance_reduction import LEAST, CommonThresholds, Difference, Paired, controlled, difference
from analysis.theory.exact import open_loop_exact
from analysis.theory.verdicts import longest_run
from analysis.utils.notes import ProgressCallback
from analysis.utils.tables import failure_text, make_table, span_text
from planner.arguments import MOST_ROLLOUTS
from planner.errors import UsageError
from planner.formatting import UNPACED, Pace, counted, in_percent, percent, share
from planner.plan.plan import Plan, is_certain
from planner.rollouts.closed_loop import MOST_TABLED
from planner.rollouts.engine import rollouts_per_call, run_ranges
from planner.rollouts.tables import AllPairs
from planner.rollouts.threshold_classes import COLUMNS, sums_by_threshold
from planner.simulator.codes import Outcome
from planner.tally import RolloutResults, add_padded, no_counts
from planner.world.world import World

FIGURES = ("visited", "survived", "complete", "alive", "time")
"""Compared figures: cells covered in both meanings, whether all were visited, robots alive at the end, steps."""
OF_HOME = ("home", "all_home")
"""Figures if robots return to base: the number of returned robots, and whether all have returned."""
DELIVERED = ("delivered",)
"""The figure if cells delivered are counted."""
OF_CELLS = ("visited", "survived", *DELIVERED)
VERBS = dict(zip(OF_CELLS, ("visits", "survives", "delivers"), strict=True))


@dataclass(frozen=True, eq=False)
class Side:
    """One side: a plan in its world, its rollouts, and its exact expected (visited, survived) cells, or None."""

    world: World
    plan: Plan
    choices: RolloutChoices
    exact: tuple[float, float] | None
    json_keys = """
        input=world.source robots=plan.team starts=plan.starts accessible=cells choices.loop threat_checks
        choices.deadline plan.plan_for plan.settings exact=exact_shares
    """

    @property
    def exact_shares(self) -> dict[str, float] | None:
        """Exact expected coverage, a fraction of the accessible cells; None if it is not known."""
        if self.exact is None:
            return None
        return {figure: self.unit(figure) * value for figure, value in zip(FIGURES[:2], self.exact, strict=True)}

    @property
    def threat_checks(self) -> str:
        """The visits that can destroy a robot: "first_visit" or "every_visit"."""
        return "first_visit" if self.choices.first_only else "every_visit"

    @cached_property
    def cells(self) -> int:
        """Number of accessible cells."""
        return int(self.world.accessible(self.plan.starts).sum())

    @cached_property
    def longest(self) -> int:
        """Most steps of a run."""
        most = longest_run(self.world, self.plan, self.choices.loop)
        return most if self.choices.deadline is None else min(most, self.choices.deadline)

    @property
    def comes_home(self) -> bool:
        """Whether the figures of OF_HOME apply."""
        choices, plan = self.choices, self.plan
        return plan.ends_home(choices.deadline) if choices.loop == "open" else plan.comes_home

    @property
    def delivers(self) -> bool:
        """Whether cells delivered are counted: in the closed loop, by robots that return to base."""
        known = self.plan.state is None or self.plan.state.delivered is not None
        return self.plan.comes_home and known and self.choices.loop == "closed"

    def unit(self, figure: str) -> float:
        """Factor of a figure: cells become fractions of the accessible cells."""
        return 1.0 / self.cells if figure in OF_CELLS else 1.0


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """The result of a comparison: sums of both sides over the same rollouts.

    Attributes:
        a, b: the sides. pairs: by figure, sums of A's (x) and B's (y).
        ahead, behind: rollouts in which B covers a larger, a smaller fraction than A, by the metric of the choices.
        by_threshold: sums of A's and B's figures by class of S of the larger team
            (`planner.rollouts.threshold_classes`).
        seconds: computing time of the rollouts. partial: whether it was interrupted.
        certain: no robot of either side can be lost, so that all runs are equal.
    """

    reported_by = "analysis.comparison:report"
    listed = "difference"

    a: Side
    b: Side
    pairs: dict[str, Paired]
    ahead: int
    behind: int
    seconds: float
    partial: bool = False
    certain: bool = False
    by_threshold: tuple[NDArray[np.int64], NDArray[np.int64]] = field(
        default_factory=lambda: (no_counts(), no_counts())
    )
    json_keys = """
        answer=summary a a.mean=mean_a b b.mean=mean_b differing=differing_sides rollouts seed=a.choices.seed certain
        difference=differences exact_difference=exact_differences b_ahead b_behind seconds
    """

    @property
    def mean_a(self) -> dict[str, float]:
        """Means of A by figure; coverage is a fraction of the accessible cells."""
        return self.means(self.a)

    @property
    def mean_b(self) -> dict[str, float]:
        """Means of B by figure; coverage is a fraction of the accessible cells."""
        return self.means(self.b)

    @property
    def differing_sides(self) -> dict[str, tuple[str, ...]]:
        """Descriptions of A and B where they differ; empty if they are equal."""
        return dict(zip("ab", self.differing, strict=True))

    @property
    def differences(self) -> dict[str, Difference]:
        """B - A by figure; coverage is a fraction of the accessible cells."""
        return {figure: self.difference(figure) for figure in self.figures}

    @property
    def exact_differences(self) -> dict[str, float | None]:
        """B - A of expected coverage; None where it is not known exactly."""
        return {figure: self.exact_difference(figure) for figure in FIGURES[:2]}

    @property
    def b_ahead(self) -> Estimate:
        """Share of the rollouts in which B visits a larger fraction."""
        return proportion(self.ahead, self.rollouts, self.certain)

    @property
    def b_behind(self) -> Estimate:
        """Share of the rollouts in which B visits a smaller fraction."""
        return proportion(self.behind, self.rollouts, self.certain)

    def means(self, side: Side) -> dict[str, float]:
        """The means of one side by figure."""
        return {figure: self.mean(side, figure) for figure in self.figures_of(side)}

    @property
    def rollouts(self) -> int:
        """Number of rollouts of each side."""
        return self.pairs["visited"].rollouts

    @property
    def figures(self) -> tuple[str, ...]:
        """The figures in which both are compared."""
        a, b = map(self.figures_of, self.sides)
        return tuple(figure for figure in a if figure in b)

    def figures_of(self, side: Side) -> tuple[str, ...]:
        """The figures of one side."""
        return FIGURES + OF_HOME * side.comes_home + DELIVERED * side.delivers

    @property
    def same_cells(self) -> bool:
        """True if both can reach the same cells of maps of one shape."""
        a, b = (side.world.accessible(side.plan.starts) for side in (self.a, self.b))
        return a.shape == b.shape and bool((a == b).all())

    @property
    def differing(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Descriptions of A and B where they differ; empty if they are equal."""
        return differing(self.a, self.b)

    def difference(self, figure: str) -> Difference:
        """B - A: fractions of the accessible cells, probabilities, robots, steps; a point if both are equal."""
        # Equal sides: the difference is 0 by construction, not by sampling.
        if not any(self.differing):
            return Difference(Estimate(0.0, 0.0, (0.0, 0.0)), math.inf)
        reach = 1.0
        if figure in ("alive", "home", "time"):
            reach = float(max(side.longest if figure == "time" else len(side.plan.robots) for side in self.sides))
        units = self.a.unit(figure), self.b.unit(figure)
        return difference(self.pairs[figure], *units, reach, self.certain, self._controls(figure))

    def _controls(self, figure: str) -> CommonThresholds | None:
        if not len(self.by_threshold[0]):
            return None
        a, b = (sums.reshape(-1, len(COLUMNS)) for sums in self.by_threshold)
        if figure not in COLUMNS:
            return None
        column = COLUMNS.index(figure)
        return CommonThresholds(most_robots(self.a, self.b), a[:, 0], a[:, column], b[:, column])

    @property
    def sides(self) -> tuple[Side, Side]:
        """A and B."""
        return self.a, self.b

    def mean(self, side: Side, figure: str) -> float:
        """The mean of one side, with the control variate of the difference."""
        pairs, controls, first = self.pairs[figure], self._controls(figure), side is self.a
        mean = (pairs.x if first else pairs.y) / pairs.rollouts
        if controls is not None and pairs.rollouts >= LEAST and not self.certain:
            # Least squares are linear in the figure: with common controls the means differ by exactly the difference.
            sums, plain = (controls.x, pairs.sample(1.0, 0.0)) if first else (controls.y, pairs.sample(0.0, 1.0))
            mean = controlled(controls.by_class, sums.astype(np.float64), plain, controls.robots).mean
        return mean * side.unit(figure)

    def exact_difference(self, figure: str) -> float | None:
        """B - A of expected "visited" or "survived" coverage, if both are known exactly."""
        a, b = self.a.exact_shares, self.b.exact_shares
        return b[figure] - a[figure] if a is not None and b is not None and figure in a else None


def differing(a: Side, b: Side) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Descriptions of both sides where they differ: map, plan, team, loop, settings; empty if they are equal."""
    words: tuple[list[str], list[str]] = ([], [])
    both_planned = not a.plan.is_external and not b.plan.is_external
    mine, theirs = _traits(a, both_planned), _traits(b, both_planned)
    for name in mine:
        if mine[name] != theirs[name]:
            words[0].append(mine[name])
            words[1].append(theirs[name])
    # Equal descriptions may still belong to different maps, paths or mission states.
    if mine == theirs:
        paths = [[robot.path.tolist() for robot in side.plan.robots] for side in (a, b)]
        if a.world.randomness_sha256 != b.world.randomness_sha256:
            words[0].append("its map")
            words[1].append("another map of that name")
        elif paths[0] != paths[1]:
            same_starts = np.array_equal(a.plan.starts, b.plan.starts)
            kind = "plan" if same_starts else "starts"
            words[0].append(f"its own {kind}")
            words[1].append(f"another {kind}" if kind == "plan" else "other starts")
        else:
            one, other = _begun(a.plan), _begun(b.plan)
            for kind in [kind for kind in one if one[kind] != other[kind]]:
                words[0].append(f"its own {kind}")
                words[1].append(f"another {kind}")
    return tuple(words[0]), tuple(words[1])


def _begun(plan: Plan) -> dict[str, object]:
    """The start of a plan: the mission state that it resumes, and its allocation."""
    areas = [(area.level, area.robot, area.cells.tolist()) for area in plan.areas]
    return {"state": None if plan.state is None else plan.state.to_json(), "allocation": areas}


def _traits(side: Side, with_settings: bool) -> dict[str, str]:
    """The description of a side by aspect; the keys are the same for both sides."""
    plan, choices = side.plan, side.choices
    known, uncertainty = side.world.knowledge, side.world.uncertainty
    found = {
        "map": f"map {side.world.source}",
        "map uncertainty": "a certain map" if uncertainty is None else uncertainty.description,
        "knowledge": "known map" if known is None else known.sensor.description,
        "robots": counted(len(plan.robots), "robot"),
        "plan": f"{'a' if plan.for_open_loop else 'an'} {plan.origin}",
        "loop": "open loop" if choices.loop == "open" else "closed loop",
        "checks": "first visits only" if choices.first_only else "every visit checked",
    }
    if plan.is_external:
        found["failures"] = plan.failure_model.description or "Weibull shape 1, equal robots"
    settings = plan.settings.as_json() if with_settings and plan.settings is not None else {}
    if settings and choices.deadline is not None:  # it ends both sides, also a plan made without it
        settings["deadline"] = choices.deadline
    return found | {
        name: f"no {name.replace('_', ' ')}" if value is None else f"{name.replace('_', ' ')} {_short(value)}"
        for name, value in settings.items()
    }


def _short(value: object) -> object:
    """A setting as text: 30.8, and 40 for 40.0."""
    return f"{value:g}" if isinstance(value, float) else value


def make_side(world: World, plan: Plan, choices: RolloutChoices) -> Side:
    """A side, with its exact expected coverage if that is fast to compute. Raises InputError."""
    choices = choices.timed(world.pace)
    check_deadline(plan, choices)
    check_metric(choices, plan.settings)
    plan = knowing_deadline(world, plan, choices)
    exact = open_loop_exact(plan, world)
    if choices.loop == "open":
        last = plan.makespan if choices.deadline is None else choices.deadline
        return Side(world, plan, choices, exact.by_deadline(last) if exact.is_known else None)
    closed = None if choices.deadline is not None else closed_truth(plan, world, exact, choices)
    known = None if closed is None else (closed.visited.value, closed.survived.value)
    return Side(world, plan, choices, known)


def compare(a: Side, b: Side, progress: ProgressCallback | None = None, kept: AllPairs | None = None) -> Comparison:
    """Compare both sides on the same rollouts.

    An interruption (KeyboardInterrupt) returns the rollouts done so far, `partial`; without any it is raised again.

    Args:
        a, b: the sides. A's choices give the number of rollouts, or the precision of the difference of mean visited
            coverage. If no robot of either side can be lost, one rollout is run.
        progress: receives the number of rollouts done. kept: cache of tables that do not depend on the team.

    Raises:
        UsageError: the sides have different seeds, rollouts or precisions.
    """
    choices = a.choices
    for name in ("seed", "rollouts", "precision"):
        mine, theirs = getattr(choices, name), getattr(b.choices, name)
        if mine != theirs:
            raise UsageError(f"the sides differ in {name}: {mine} and {theirs}", expected="the same rollouts of both")
    certain = all(is_certain(side.world, side.plan, side.choices.loop) for side in (a, b))
    if certain:
        choices = replace(choices, rollouts=1, precision=None, seconds=None)
    answer = Comparison(
        a, b, {figure: Paired() for figure in FIGURES + OF_HOME + DELIVERED}, 0, 0, 0.0, certain=certain
    )
    most, total = (choices.rollouts, choices.rollouts) if choices.precision is None else (MOST_ROLLOUTS, 0)
    cells = max(a.cells, b.cells)
    # The precision is tested at fixed marks only, so that the result does not depend on chunk sizes.
    marks, unit = looks(), rollouts_per_call(cells) if cells <= MOST_TABLED else 1
    try:
        singles = [make_singles(side.world, side.plan, side.choices, kept=kept) for side in (a, b)]

        def both(start: int, count: int) -> tuple[RolloutResults, RolloutResults]:
            return singles[0](start, count), singles[1](start, count)

        for _, _, found, took in run_ranges(both, 0, most, checkpoints=marks, unit=unit):
            answer = _add(answer, *found, answer.seconds + took)
            if progress is not None:
                progress(answer.rollouts, total, answer.seconds)
            if choices.seconds is not None and answer.seconds >= choices.seconds:
                break
            looked_at = choices.precision is not None and answer.rollouts in marks
            if looked_at and answer.difference(choices.metric).estimate.half_width < choices.precision:  # type: ignore[operator]
                break
    except KeyboardInterrupt:
        if answer.rollouts == 0:
            raise
        answer = replace(answer, partial=True)
    return answer


def _add(so_far: Comparison, a: RolloutResults, b: RolloutResults, seconds: float) -> Comparison:
    sides = (so_far.a, a), (so_far.b, b)
    pairs = {f: before + Paired.of(*(_figure(*side, f) for side in sides)) for f, before in so_far.pairs.items()}
    # Cross-multiplied, so that integers compare the fractions of the accessible cells exactly.
    covered = (_figure(*side, so_far.a.choices.metric).astype(np.int64) for side in sides)
    mine, theirs = (cells * other for cells, other in zip(covered, (so_far.b.cells, so_far.a.cells), strict=True))
    ahead, behind = int((theirs > mine).sum()), int((theirs < mine).sum())
    found = replace(so_far, pairs=pairs, ahead=so_far.ahead + ahead, behind=so_far.behind + behind, seconds=seconds)
    sums = (sums_by_threshold(side, so_far.a.choices.seed, most_robots(so_far.a, so_far.b)) for side in (a, b))
    one, other = (add_padded(before, more) for before, more in zip(so_far.by_threshold, sums, strict=True))
    return replace(found, by_threshold=(one, other))


def most_robots(a: Side, b: Side) -> int:
    """Size of the larger team."""
    return max(len(side.plan.robots) for side in (a, b))


def _figure(side: Side, results: RolloutResults, figure: str) -> NDArray[np.int32]:
    if figure in OF_HOME:
        home = home_of(side.plan, results, side.choices.loop, side.choices.deadline)
        if home is None:
            return np.zeros(len(results.visited), dtype=np.int32)
        return home if figure == "home" else (home == len(side.plan.robots)).astype(np.int32)
    if figure == "complete":
        return (results.outcome == Outcome.COMPLETE).astype(np.int32)
    values: NDArray[np.int32] = getattr(results, figure)
    return values


# The report of `mrac-jax compare`: the difference in a sentence, a row for each figure.

SHOWN = {
    "visited": ("visited, %", 100.0),
    "survived": ("survived, %", 100.0),
    "complete": ("chance to visit every cell, %", 100.0),
    "alive": ("robots alive at the end", 1.0),
    "time": ("time, steps", 1.0),
    "home": ("robots back at base", 1.0),
    "all_home": ("chance that all are back at base, %", 100.0),
    "delivered": ("delivered, %", 100.0),
}
"""Name and scale of each figure in the table."""
NARROW = 0.1
"""Width of an interval (a share, robots or steps) up to which it is never called too wide."""
TABLE_NOTE = "from .. to: 95 % interval of B - A; gain: variance of the difference of independent runs / of these"


def report(answer: Comparison) -> Report:
    """The report of a comparison."""
    rate, a, b = answer.rollouts / max(answer.seconds, 1e-9), answer.a, answer.b
    names = dict.fromkeys(side.world.name for side in (a, b))
    certain = "no cell on the way of either is dangerous, so every run is the same and 1 rollout is enough"
    return Report(
        "compare", "compare", f"{' and '.join(names)}: which covers more?",
        summary(answer), answer, figures=_key_figures(answer),
        heading=(f"A: {_description(a)}", f"B: {_description(b)}", *[certain] * answer.certain,
                 f"{counted(answer.rollouts, 'rollout')} on common random numbers, seed {a.choices.seed}"),
        took=[f"{rate:,.0f} rollouts a second of both"], parts=[Section("Figures", [_table(answer)], [TABLE_NOTE])],
        notes=_notes(answer), warnings=["Interrupted: the rollouts done so far are shown."] * answer.partial,
        pace=_pace(answer),
    )  # fmt: skip


def summary(answer: Comparison) -> str:
    """The difference of expected coverage in one sentence, with the descriptions of A and B."""
    if not any(answer.differing):
        return "A and B are equal: no difference (exact)."
    one, other = (f"{name} ({', '.join(words)})" for name, words in zip("AB", answer.differing, strict=True))
    metric = answer.a.choices.metric
    known, estimate = answer.exact_difference(metric), answer.difference(metric).estimate
    mean, (low, high) = 100 * (estimate.mean if known is None else known), (100 * end for end in estimate.ci95)
    sure = f"B - A: {low:.2f} .. {high:.2f}, confidence 0.95" if known is None else "exact"
    seen = "No difference seen: " * (known is None and low <= 0 <= high)
    ahead, behind = (share(count, answer.rollouts) for count in (answer.ahead, answer.behind))
    by = f"{abs(mean):.{2 if known is None else 3}f} points {'more' if mean > 0 else 'less'} of the accessible cells"
    more = f"{seen}{other} {VERBS[metric]} {by} than {one} on average ({sure})"
    return f"{more}; B is ahead in {ahead} of runs, behind in {behind}."


def _notes(answer: Comparison) -> list[str]:
    """Notes on the validity of the difference."""
    found, many = [], len(answer.differing[0]) > 1
    if not answer.same_cells:
        found.append("A and B can reach different cells; coverage is a share of each side's own cells")
    if answer.a.choices.loop != answer.b.choices.loop:
        closed, open_ = ("A", "B") if answer.a.choices.loop == "closed" else ("B", "A")
        found.append(
            f"in {closed} the areas of lost robots are reassigned, in {open_} not: the difference includes the "
            "effect of the loop" + (f"; {closed}'s plan alone: --loop open" if many else "")
        )
    for name, side in zip("AB", answer.sides, strict=True):
        if side.comes_home and "home" not in answer.figures:
            mean, every = (answer.mean(side, figure) for figure in OF_HOME)
            said = f"{name}'s robots return to base, {robots_text(mean, len(side.plan.robots))}"
            found.append(f"{said}, all of them in {percent(every)} of runs; the other side's need not")
    if vague := [SHOWN[figure][0] for figure in answer.figures if _is_vague(answer, figure)]:
        found.append(f"too few rollouts to compare {', '.join(vague)}: the intervals are wider than the figures")
    if many:
        found.append("A and B differ in more than one aspect; the difference is the effect of all of them")
    return found


def _is_vague(answer: Comparison, figure: str) -> bool:
    """Whether the interval of a difference is wider than the figures of both sides."""
    apart = answer.difference(figure).estimate
    low, high = apart.ci95
    largest = max(abs(answer.mean(side, figure)) for side in answer.sides)
    return low < 0 < high and not high - low <= max(largest, NARROW)


def _description(side: Side) -> str:
    plan, choices = side.plan, side.choices
    made = plan.origin if plan.is_external else counted(len(plan.areas), "area")
    first = ", first visits only" if choices.first_only else ""
    by = "" if choices.deadline is None else f", by step {choices.deadline}{side.world.pace.also(choices.deadline)}"
    input_said = f"{side.world.source}, {counted(len(plan.robots), 'robot')}"
    means = failure_text(plan, side.world)
    span = span_text(plan, side.world.pace)
    return f"{input_said}, {made}, {span}; {choices.loop} loop{first}{by}{'; ' if means else ''}{means}"


def _pace(answer: Comparison) -> Pace:
    """The length of a step, if it is the same on both sides."""
    pace = answer.a.world.pace
    return pace if pace == answer.b.world.pace else UNPACED


def _coverages(answer: Comparison) -> list[tuple[str, str, float]]:
    """Figure, name and scale of each row."""
    pace = _pace(answer)
    minutes = [("time", "time, minutes", pace.minutes)] * bool(pace)
    return [*((figure, *SHOWN[figure]) for figure in answer.figures), *minutes]


def _key_figures(answer: Comparison) -> list[KeyFigure]:
    out = []
    for figure, name, scale in _coverages(answer):
        known = answer.exact_difference(figure)
        estimate = (answer.difference(figure).estimate if known is None else exactly(known)).times(scale)
        interval = "exact" if estimate.half_width == 0 else between(*estimate.ci95)
        out.append(KeyFigure(f"{estimate.mean:+.2f}", f"{name}: B - A", interval))
    return out


def _table(answer: Comparison) -> Table:
    known = answer.exact_differences
    exactly = ["exact"] * any(value is not None for value in known.values())
    differ = zip("AB", answer.differing, strict=True)
    title = "; ".join(f"{name}: {', '.join(words)}" for name, words in differ if words)
    columns = ("", "A", "B", "B - A", "from", "to", *exactly, "gain")
    rows = []
    for figure, name, scale in _coverages(answer):
        apart, exact = answer.difference(figure), known.get(figure)
        means = [_mean(answer, side, figure, scale) for side in answer.sides]
        ends = [f"{scale * value:+.3f}" for value in (apart.estimate.mean, *apart.estimate.ci95)]
        certain = ["" if exact is None else f"{scale * exact:+.4f}"] * len(exactly)
        rows.append([name, *means, *ends, *certain, f"{apart.gain:.2f}" if math.isfinite(apart.gain) else ""])
    return make_table(columns, title or None, rows, dropped=("gain",), padding=(0, 1, 0, 0))


def _mean(answer: Comparison, side: Side, figure: str, scale: float) -> str:
    """A side's mean, exact if that is known."""
    mean = (side.exact_shares or {}).get(figure, answer.mean(side, figure))
    if scale == 100:
        return in_percent(mean, 2)
    robots = len(side.plan.robots)
    return of_all(mean, robots) if figure in ("alive", "home") else f"{scale * mean:.2f}"
