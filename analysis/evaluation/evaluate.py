"""Evaluate a plan: exact values, formulas, rollouts up to a count or a precision, and further outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import TreeTruth, closed_truth
from analysis.evaluation.figures import (
    Coverage,
    Elements,
    Expected,
    Figures,
    Known,
    Limits,
    Losses,
    Output,
    Rest,
    Run,
    last_shown,
    rest_of,
)
from analysis.evaluation.outputs.advice import Advice
from analysis.evaluation.outputs.information import Experience, Knowledge
from analysis.evaluation.outputs.over_time import Band, Deadline, Turning
from analysis.evaluation.outputs.value import Value
from analysis.evaluation.outputs.what_if import EqualRobots, MapVariance, MarginalRisk, ThreatScale, alike
from analysis.page.elements import Run as DrawnRun
from analysis.report.result import Result, cell_counts
from analysis.sampling import (
    RolloutChoices,
    Stage,
    check_deadline,
    home_of,
    knowing_deadline,
    make_roll_out,
    make_singles,
)
from analysis.statistics.estimates import FIRST_LOOK, Amount, Estimate, exactly, looks
from analysis.statistics.variance_reduction import Controlled, of_tally, tally_mean
from analysis.theory.bounds import Bounds, all_bounds
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.upper_bound import AnyStrategy, any_strategy, trimmed
from analysis.theory.verdicts import (
    FORMULAS,
    MEANINGS,
    Check,
    ClosedTruth,
    Verdict,
    longest_run,
    of_formula,
    overall,
    paper_checks,
    worst_of_robots,
)
from analysis.utils.notes import Doing, ProgressCallback, quiet
from analysis.utils.tables import failure_text, frame_of
from planner.arguments import MOST_ROLLOUTS, argument, whole
from planner.errors import UsageError
from planner.files import Json
from planner.formatting import counted
from planner.json_objects import as_json
from planner.plan.plan import Plan, drive_of, is_certain
from planner.rollouts.engine import choose_engine
from planner.rollouts.tables import AllPairs
from planner.simulator.codes import Outcome
from planner.tally import Tally, counts_by_word
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

if TYPE_CHECKING:
    from analysis.evaluation.layers import Layers


# The result of an evaluation: the plan, its exact values and bounds, and the tally of its rollouts.


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Result):
    """The result of the evaluation of one plan.

    Attributes:
        world, plan: the input. closed_form: exact values of the open loop.
        loop: "open" or "closed". engine: "jax" or "numba". seed: of the rollouts.
        tally: counts over the rollouts. outputs: further outputs by key (`analysis.evaluation.outputs`).
        choices: the requested rollouts. closed: exact expected values of the closed loop if they are known, else None.
        seconds: time of the rollouts without compilation. compile_seconds: time of the compilation.
        partial: whether it was interrupted; the tally then holds the rollouts that were done.
        notes: remarks for the user.
        bound: whether the upper bound for every strategy is computed (`flow` of `analysis.theory.upper_bound`).
        certain: no path passes a dangerous cell. All runs are equal in both loops, and the tally holds one rollout.
    """

    reported_by = "analysis.evaluation.report:report"

    world: World
    plan: Plan
    closed_form: OpenLoopExact
    loop: Literal["open", "closed"]
    engine: str
    seed: int
    tally: Tally
    seconds: float
    compile_seconds: float
    closed: ClosedTruth | None = None
    outputs: Mapping[str, Output] = field(default_factory=dict)
    partial: bool = False
    notes: tuple[str, ...] = ()
    certain: bool = False
    choices: RolloutChoices = field(default_factory=RolloutChoices)
    bound: bool | None = None
    json_keys = """
        loop engine robots=plan.team starts=plan.starts cells policy plan.plan_for rollouts=tally.rollouts seed certain
        figures.coverage best.visited=visited best.survived=survived best.losses=losses coverage_of_free_cells outcomes
        *figures alive.mean=figures.alive.mean time.max=longest losses.exact=exact_losses shown.some_left
        control=control_facts bounds=formulas bounds.any_strategy=bounds.any_strategy.cells verdicts=map_verdicts
        exact.open_loop=closed_form exact.closed_loop=closed_facts exact.alive=exact.alive exact.time=exact.time
        plan=plan_facts rollouts_per_second compile_seconds moving_threats?=world.moving_threats phases?=world.phases
        *outputs_json notes?
    """

    @property
    def policy(self) -> Json | None:
        """The policy with its limits; None for an external plan."""
        settings = self.plan.settings
        if settings is None:
            return None
        limited = {} if settings.range is None else {"range": settings.range}
        return {
            "name": settings.rule.name,
            "risk_cap": settings.risk_cap,
            "robot_value": settings.robot_value,
        } | limited

    @property
    def coverage_of_free_cells(self) -> dict[str, float]:
        """Mean coverage by meaning, a fraction of all free cells."""
        return {m: getattr(self.figures, m).mean.mean / self.cells["free"] for m in MEANINGS}

    @property
    def outcomes(self) -> dict[str, int]:
        """Number of rollouts by outcome."""
        return counts_by_word(self.tally.outcomes, self.plan.ends_by_deadline)

    @property
    def longest(self) -> int:
        """Steps of the longest rollout."""
        return int(np.flatnonzero(self.tally.time).max())

    @property
    def exact_losses(self) -> float | None:
        """Expected robots lost; None if they are not known exactly."""
        return None if self.exact.alive is None else self.tally.robots - self.exact.alive

    @property
    def control_facts(self) -> Json | None:
        """By figure: ratio of variances without and with the control variate, and its slopes; None without one."""
        found = self.control
        weights = {name: one.weights for name, one in found.items()}
        return {"gain": {name: one.gain for name, one in found.items()}, "weights": weights} if found else None

    @property
    def map_verdicts(self) -> dict[str, str]:
        """The verdict on each formula of the paper, by formula and meaning, of the robot with the smallest margin."""
        return {check.key: str(check.verdict) for check in worst_of_robots(self.checks)}

    @property
    def closed_facts(self) -> Json | None:
        """The closed loop's exact expected values (or certain bounds), and how they are known; None if they are not."""
        if self.closed is None:
            return None
        truths = {name: getattr(self.closed, name) for name in (*MEANINGS, "some_left")}
        values = {name: one.value if one.low == one.high else one.interval for name, one in truths.items()}
        rest = {"alive": self.closed.alive, "time": self.closed.time, "how": self.closed.visited.how}
        return self.closed.further | values | rest

    @property
    def plan_facts(self) -> Json:
        """Settings of the plan, numbers of areas, levels and shares, and figures of its nominal run."""
        plan, drive = self.plan, drive_of(robot.path for robot in self.plan.robots)
        return {
            "settings": plan.settings,
            "areas": len(plan.areas),
            "levels": len({area.level for area in plan.areas}),
            "makespan": plan.makespan,
            "outcome": plan.outcome,
            "shares": plan.shares,
            "moves": int(drive.moves.sum()),
            "quarter_turns": int(drive.turns.sum()),
        }

    @property
    def rollouts_per_second(self) -> float | None:
        """Rate of the rollouts without compilation."""
        return self.tally.rollouts / self.seconds if self.seconds > 0 else None

    @property
    def outputs_json(self) -> Json:
        """The values of the outputs by key; `advice` is None without that output."""
        found = {name: as_json(output) for name, output in self.outputs.items()}
        return {"advice": None} | {name: value for name, value in found.items() if value is not None}

    def with_outputs(self, more: Mapping[str, Output], partial: bool) -> Evaluation:
        """The same evaluation with further outputs; cached values are kept."""
        whole = replace(self, outputs={**self.outputs, **more}, partial=partial)
        # Cached properties depend on the rollouts only, except `elements`, which depends on the outputs.
        kept = {name: value for name, value in vars(self).items() if name not in vars(whole) and name != "elements"}
        vars(whole).update(kept)
        return whole

    @cached_property
    def elements(self) -> list[Elements]:
        """The report elements of the outputs, in order."""
        return [found.elements() for found in self.outputs.values()]

    def added(self, name: str) -> list[Any]:
        """What the outputs add to one list of the report: a field of `Elements`."""
        return [one for found in self.elements for one in getattr(found, name)]

    def added_files(self, name: str) -> dict[str, Any]:
        """The same of a field that is by name, such as pictures by file name."""
        return {key: value for found in self.elements for key, value in getattr(found, name).items()}

    @cached_property
    def cells(self) -> dict[str, int]:
        """Numbers of cells: total, free, accessible, and accessible with a threat above 0."""
        return cell_counts(self.ground, self.accessible)

    @cached_property
    def ground(self) -> World:
        """The true map, without the robots' knowledge of it."""
        return replace(self.world, threat=self.world.met, knowledge=None)

    @cached_property
    def accessible(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that some robot can reach."""
        return self.world.accessible(self.plan.starts)

    @cached_property
    def figures(self) -> Figures:
        """Figures of the rollouts, or exact figures of all possible histories."""
        longest = longest_run(self.world, self.plan, self.loop)
        sampled = Figures.of(self.tally, self.certain, longest, home_of(self.plan, self.tally, self.loop))
        if self.loop == "open":
            return sampled.with_delivered(self.closed_form)
        return sampled.with_tree(self.closed.tree) if isinstance(self.closed, TreeTruth) else sampled

    @cached_property
    def shown(self) -> Figures:
        """The figures that reports show: exact values if they are known, of either loop."""
        if self.loop == "open":
            return self.figures.with_formulas(self.closed_form, self.closed_form.mean_time)
        if self.closed is None or isinstance(self.closed, TreeTruth):
            return self.figures
        return self.figures.with_formulas(self.closed_form, self.closed.time)

    @cached_property
    def rest(self) -> Rest | None:
        """The remaining part of the mission; None for a whole mission without a range."""
        return rest_of(self.world, self.plan)

    @cached_property
    def p_means(self) -> str:
        """The meaning of p if it is not a probability; else ""."""
        return failure_text(self.plan, self.world)

    @cached_property
    def engine_said(self) -> str:
        """The engine, with the reason if it was selected automatically."""
        chosen = choose_engine(self.choices.engine)
        why = self.choices.engine == "auto" and chosen.name == self.engine
        return f"{self.engine} ({chosen.why})" if why else self.engine

    @property
    def is_exact(self) -> bool:
        """Whether the expected values by cell are exact: open loop, equal closed loop, or exact tree."""
        if self.loop == "open":
            return self.closed_form.is_known
        if isinstance(self.closed, TreeTruth):
            return self.closed.masses is not None
        return self.closed is not None

    @cached_property
    def how_known(self) -> str:
        """The source of the expected values: "open loop, exact" or "closed loop, sampled, 20,000 rollouts"."""
        if self.is_exact:
            return f"{self.loop} loop, exact"
        rollouts = counted(self.tally.rollouts, "rollout")
        return f"{self.loop} loop, sampled, {rollouts}" + (", interrupted" if self.partial else "")

    @cached_property
    def layers(self) -> Layers:
        """Layers by cell for the page and for pictures."""
        from analysis.evaluation.layers import layers_of

        lines = "the plan" if self.world.knowledge is None else "the paths of the run that is played"
        return layers_of(self.ground, self.plan, self.accessible, self.expected, self.how_known, self.rest, lines)

    @cached_property
    def played(self) -> tuple[list[DrawnRun], str]:
        """The runs that a page plays, and their caption; simulated on demand."""
        from analysis.evaluation.layers import runs

        return runs(self.world, self.plan, self.choices, self.tally.rollouts, self.certain)

    @property
    def last_shown(self) -> int:
        """Last step of a time axis."""
        return last_shown(self.plan, self.loop, self.tally)

    @property
    def is_plain(self) -> bool:
        """Whether the paper's assumptions hold: one known map, and each visit destroys the robot with probability p."""
        return self.world.uncertainty is None and self.world.knowledge is None and self.plan.failure_model.is_plain

    @cached_property
    def checks(self) -> list[Check]:
        """The paper's formulas compared with the open loop's exact values; empty if not `is_plain`."""
        if not self.is_plain:
            return []
        return paper_checks(self.plan, self.world, self.closed_form, self.formulas)

    @cached_property
    def verdicts(self) -> dict[str, Verdict | None]:
        """The verdict on each formula over all its meanings and robots; None without a check."""
        return {formula: overall(of_formula(self.checks, formula)) for formula in FORMULAS}

    @property
    def exact(self) -> Known:
        """Expected values of the evaluated loop that are known without sampling."""
        if self.loop == "closed":
            closed = self.closed
            if closed is None:
                return Known(None, None, None, None)
            cells, rest = (closed.visited.value, closed.survived.value), (closed.alive, closed.time)
        else:
            open_loop = self.closed_form
            cells = open_loop.visited, open_loop.survived
            rest = float(open_loop.survival.sum()), open_loop.mean_time
        visited, survived = (Amount.of(value, self.tally.accessible) if isfinite(value) else None for value in cells)
        alive, time = (value if value is not None and isfinite(value) else None for value in rest)
        return Known(visited, survived, alive, time)

    @property
    def bounds(self) -> Limits:
        """Upper bounds of the expected coverage for every strategy; the paper's formulas are in `formulas`."""
        ideals = (self.formulas.ideal_team, self.formulas.ideal_eq7)
        ideal, ideal_one = (Amount.of(cells, self.tally.accessible) for cells in ideals)
        if self.limit is None:
            return Limits(ideal, None, ideal, ideal_one)
        least = Amount.of(self.limit.cells, self.tally.accessible)
        return Limits(least, None if self.limit.flow is None else least, ideal, ideal_one)

    @cached_property
    def formulas(self) -> Bounds:
        """The paper's formulas."""
        return all_bounds(self.plan, self.world)

    @cached_property
    def limit(self) -> AnyStrategy | None:
        """The bound for every strategy; None if not `is_plain`, for first visits only, and from a mission state."""
        if self.choices.first_only or not self.is_plain or self.plan.state is not None:
            return None
        return any_strategy(trimmed(self.world, self.plan), self.plan.starts, self.bound, thresholds=bool(self.bound))

    @property
    def visited(self) -> Coverage:
        """Visited coverage; its mean is exact if that is known."""
        return self._coverage("visited")

    @property
    def survived(self) -> Coverage:
        """Coverage of cells that a robot entered and survived; its mean is exact if that is known."""
        return self._coverage("survived")

    @property
    def delivered(self) -> Coverage | None:
        """Coverage of cells that a robot which visited them brought to a base; None: not known."""
        return None if self.shown.delivered is None else self._coverage("delivered")

    def _coverage(self, meaning: str) -> Coverage:
        covered = getattr(self.shown, meaning)
        mean = covered.mean
        mean = mean.times(1.0 / covered.cells) if mean.half_width else exactly(mean.mean / covered.cells)
        return Coverage(**vars(mean), covered=covered)

    @cached_property
    def control(self) -> dict[str, Controlled]:
        """The control variate of each sampled mean, by figure; empty for few rollouts."""
        sampled = [figure for figure in ("visited", "survived", "time", "alive") if getattr(self.exact, figure) is None]
        found = {figure: of_tally(self.tally, figure) for figure in sampled}
        return {figure: one for figure, one in found.items() if one is not None and not self.certain}

    @property
    def has_danger(self) -> bool:
        """Whether the plan meets any danger: if not, all runs are nominal in both loops."""
        # A sum, because any probability above 0 counts; NaN where it is not known, as among moving threats.
        return float(self.closed_form.stops_by_cell.sum()) != 0

    @property
    def losses(self) -> Losses:
        """Robots lost in a run; the mean is exact if that is known."""
        return self.shown.losses

    @property
    def time(self) -> Estimate:
        """Steps of a run; the mean is exact if that is known."""
        return self.shown.time

    def singles(self, most: int | None = None) -> dict[str, NDArray]:
        """The single rollouts as columns `[B]`: rollout, visited, survived (cells), time (steps), alive, outcome.

        The rollouts are simulated again. Memory: 25 bytes a rollout.

        Args:
            most: number of rollouts; None: all.
        """
        whole(1, MOST_ROLLOUTS, "how many rollouts").check("most", most, optional=True)
        count = self.tally.rollouts if most is None else min(most, self.tally.rollouts)
        # Whole runs, also if coverage by a deadline was requested.
        found = make_singles(self.world, self.plan, replace(self.choices, deadline=None))(0, count)
        names = np.array([self.plan.ending(outcome).word for outcome in Outcome])
        columns = {name: getattr(found, name) for name in ("visited", "survived", "time", "alive")}
        return {"rollout": np.arange(count), **columns, "outcome": names[found.outcome]}

    def to_dataframe(self, most: int | None = None) -> Any:
        """`singles` as a pandas DataFrame (the extra `pandas`)."""
        return frame_of(self.singles(most))

    @cached_property
    def expected(self) -> Expected:
        """Expected values of the evaluated loop: open-loop closed form, exact tree, or means of the rollouts."""
        exact, tally = self.closed_form, self.tally
        if isinstance(self.closed, TreeTruth) and self.closed.masses is not None:
            tally = self.closed.masses
        n = tally.rollouts
        if self.is_exact and tally is self.tally:
            by_cell = (exact.visited_by_cell, exact.stops_by_cell)
            return Expected(*by_cell, exact.visited_curve, exact.survived_curve)
        curves = (np.cumsum(tally.new_visited) / n, np.cumsum(tally.new_survived) / n)
        return Expected(tally.covered_visited / n, tally.stops / n, *curves)


# The outputs of `evaluate` by key, in the order in which they are measured.

OUTPUTS: dict[str, type[Output]] = {
    "deadline": Deadline,
    "threat_scale": ThreatScale,
    "value": Value,
    "turn": Turning,
    "band": Band,
    "knowledge": Knowledge,
    "experience": Experience,
    "team": EqualRobots,
    "map_variance": MapVariance,
    "marginal_risk": MarginalRisk,
    "advice": Advice,
}
"""The keys are those of `Evaluation.outputs` and of the JSON object."""


# The evaluation: exact values, formulas, rollouts up to a count or a precision, and further outputs.

FINE_SECONDS = 0.2
"""Seconds for growing a tree to a precision at which rollouts add nothing."""
TO_LOOK_AT, CONTENT = 8 * FIRST_LOOK, {"band", "advice", "marginal_risk"}
"""Rollouts when the tree is complete, and the outputs for which that number is sufficient."""


def evaluate(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    *,
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
    show: Callable[[Evaluation], None] | None = None,
    bound: bool | None = None,
    **asked: Any,
) -> Evaluation:
    """Evaluate `plan` in `world`: rollouts, exact values and formulas.

    If all runs are equal (`is_certain`), one rollout is run. An interruption (KeyboardInterrupt) ends the evaluation
    with the rollouts done so far, marked `partial`; without any rollout it is raised again.

    Args:
        world, plan, choices: the map, the plan, the rollouts.
        progress, doing: receive the number of rollouts done, and the name of each stage.
        show: receives the result before the `bound` and the `late` outputs are computed, and again after each of these.
        bound: whether the bound for every strategy is computed, as `flow` of `analysis.theory.upper_bound`.
        asked: further outputs by key in `OUTPUTS`, with the argument of their `measure`: `threat_scale=(0.5, 2)`.

    Returns:
        The evaluation.

    Raises:
        InputError: an unknown output, or one that this world does not support.
    """
    choices = choices.timed(world.pace)
    check_deadline(plan, choices)
    plan = knowing_deadline(world, plan, choices)
    wanted = _wanted(choices, {"team": bool(alike(plan))} | asked, world)
    certain = is_certain(world, plan, choices.loop)
    if certain:
        choices = replace(choices, rollouts=1, precision=None, seconds=None)
    begin, tell = doing or quiet, progress or quiet
    begin("exact values")
    exact = open_loop_exact(plan, world)
    last, partial, closed, rolled, kept = None, False, None, choices, AllPairs()
    try:
        roll_out = make_roll_out(world, plan, choices, kept=kept)  # raises if the engine does not support this world
        if choices.loop == "closed":
            closed = closed_truth(plan, world, exact, choices, kept, FINE_SECONDS)
        is_all = isinstance(closed, TreeTruth) and closed.is_all and wanted.keys() <= CONTENT
        # The tree is complete and exact: rollouts only serve outputs that need single runs.
        if is_all and choices.precision is not None:
            rolled = replace(choices, rollouts=TO_LOOK_AT, precision=None)
        begin("rollouts")
        for stage in until_enough(roll_out(rolled, None), rolled, tell):
            last = stage
    except KeyboardInterrupt:
        partial = True
    # Interrupted before the first stage: there is no partial result.
    if last is None:
        raise KeyboardInterrupt
    run = Run(world, plan, choices, last, roll_out, exact, closed, certain, kept, tell, begin)
    # Late outputs are measured after the result was shown for the first time.
    soon, late = ({key: v for key, v in wanted.items() if OUTPUTS[key].late == is_late} for is_late in (False, True))
    outputs, partial = _measured(soon, run, partial)
    answer = Evaluation(
        world=world,
        plan=plan,
        closed_form=exact,
        loop=choices.loop,
        engine=last.engine,
        seed=choices.seed,
        tally=last.tally,
        closed=closed,
        outputs=outputs,
        seconds=last.seconds,
        compile_seconds=last.compile_seconds,
        partial=partial,
        notes=(
            *cut_off(world, last.tally, plan),
            *(() if partial else too_few(last, rolled)),
        ),
        certain=certain,
        choices=choices,
        bound=bound,
    )
    if show is not None:
        show(answer)
    if bound:
        begin("the bound for every strategy")
        answer.limit  # noqa: B018 - computed here, while progress is reported
    for key, value in late.items():
        more, partial = _measured({key: value}, run, partial)
        answer = answer.with_outputs(more, partial)
        if more and show is not None:
            show(answer)
    return answer


def _measured(wanted: dict[str, Any], run: Run, partial: bool) -> tuple[dict[str, Output], bool]:
    """The outputs by key, and whether an interruption occurred, now or before."""
    outputs: dict[str, Output] = {}
    for key, value in wanted.items():
        if OUTPUTS[key].own_rollouts and partial:
            continue
        try:
            for found in OUTPUTS[key].measure(value, run):
                outputs[key] = found
        except KeyboardInterrupt:
            partial = True
    return outputs, partial


def check_asked(world: World, **asked: Any) -> None:
    """Raise InputError for outputs that this world does not support, before planning. Arguments as in `evaluate`."""
    _wanted(RolloutChoices(), asked, world)


def _wanted(choices: RolloutChoices, asked: dict[str, Any], world: World) -> dict[str, Any]:
    """The requested outputs with their arguments, checked, in the order of `OUTPUTS`."""
    unknown = [name for name in asked if name not in OUTPUTS]
    if unknown:
        raise UsageError(f"evaluate has no output `{unknown[0]}`", expected=f"one of {', '.join(OUTPUTS)}")
    given = {
        "deadline": choices.deadline,
        "knowledge": None if world.knowledge is None else (world.knowledge.sensor.range,),
        "experience": world.learned_hazard is not None,
        "map_variance": isinstance(world.uncertainty, Uncertain),
        "turn": world.pace.turn or None,
        "value": world.value is not None or world.detect is not None or world.team.route is not None,
    } | asked
    wanted = {key: given[key] for key in OUTPUTS if given.get(key) not in (None, ()) and given[key] is not False}
    for key, value in wanted.items():
        OUTPUTS[key].check(value, world)
    return wanted


def cut_off(world: World, tally: Tally, plan: Plan) -> tuple[str, ...]:
    """A note if rollouts were ended by the plan's deadline or truncated at T_max, so that their coverage is unknown."""
    count = int(tally.outcomes[Outcome.STEP_LIMIT])
    if plan.settings is not None and plan.settings.deadline is not None:
        home = "robots return to base by then" if plan.comes_home else "the team is recalled then"
        return (f"the plan ends the mission at {world.pace.step(plan.settings.deadline)}: {home}",)
    if count == 0:
        return ()
    cut = (
        f"{count:,} of {counted(tally.rollouts, 'rollout')} {'was' if count == 1 else 'were'} cut off at the step limit"
    )
    return (f"{cut}: raise {argument('max_steps')}",)


def too_few(last: Stage, choices: RolloutChoices) -> tuple[str, ...]:
    """A note if the requested count or precision was not reached."""
    done = last.tally.rollouts
    if choices.precision is None:
        reached = done >= choices.rollouts
        of = counted(choices.rollouts, "rollout")
        return () if reached else (f"{choices.seconds:g} s ended after {done:,} of {of}",)
    half = half_width(last.tally)
    if half < choices.precision:
        return ()
    ends = "the last possible rollout" if choices.seconds is None else f"{choices.seconds:g} s"
    wanted = f"requested: ± {100 * choices.precision:g}"
    return (f"{ends} came before that precision: the interval of mean coverage is ± {100 * half:.3g} points, {wanted}; "
            f"{argument('seconds')} allows more time",)  # fmt: skip


def until_enough(stages: Iterator[Stage], choices: RolloutChoices, progress: ProgressCallback) -> Iterator[Stage]:
    """The stages up to the first that reaches the precision or the time limit, or all stages."""
    marks = set(looks())
    for stage in stages:
        done = stage.tally.rollouts
        half = math.inf if choices.precision is None else half_width(stage.tally)
        progress(done, expected_rollouts(choices, done, half, stage.seconds), stage.seconds)
        yield stage
        # The precision is tested at fixed marks only, so that the end does not depend on chunk sizes.
        enough = choices.precision is not None and done in marks and half < choices.precision
        if enough or (choices.seconds is not None and stage.seconds >= choices.seconds):
            return


def expected_rollouts(choices: RolloutChoices, done: int, half: float, seconds: float) -> int:
    """The expected total number of rollouts: the requested number, or an estimate from the current `half`-width."""
    total = choices.rollouts
    if choices.precision is not None:
        # The half-width falls with the square root of the number of rollouts.
        needed = done * (half / choices.precision) ** 2
        total = next((look for look in looks() if look >= max(needed, done)), looks()[-1])
    if choices.seconds is not None and seconds > 0:
        total = min(total, max(done, int(done * choices.seconds / seconds)))
    return total


def half_width(tally: Tally) -> float:
    """Half the width of the 95 % interval of mean visited coverage, a fraction of the accessible cells."""
    return tally_mean(tally, "visited", 1.0 / tally.accessible).half_width
