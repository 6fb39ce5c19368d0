"""Evaluate a plan: closed form, formulas, rollouts until a count or a precision, and what else was asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from analysis.estimators.trial import TreeTruth, closed_truth
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.output import Output, Run
from analysis.evaluation.outputs.table import OUTPUTS
from analysis.evaluation.outputs.what_if import alike
from analysis.sampling import RolloutChoices, Stage, check_deadline, knowing_deadline, make_roll_out
from analysis.statistics.estimates import FIRST_LOOK, looks
from analysis.statistics.variance_reduction import tally_mean
from analysis.theory.exact import open_loop_exact
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import argument
from planner.errors import UsageError
from planner.formatting import counted
from planner.plan.plan import Plan, is_certain
from planner.simulator.tables import AllPairs
from planner.tally import Outcome, Tally
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

FINE_SECONDS = 0.2
"""Of a tree that is grown until rollouts have nothing to add."""
TO_LOOK_AT, CONTENT = 8 * FIRST_LOOK, {"band", "advice"}
"""Rollouts where they have nothing to add, and the outputs that are content with so many."""


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
    """Roll `plan` out in `world` and put the counts beside the exact values and the formulas.

    Where nothing can happen (`is_certain`) one rollout is run, whatever was asked for: every run is the same.
    An interruption (KeyboardInterrupt) ends it with what was done so far, marked `partial`; if that is nothing, it is
    raised again. Raises InputError.

    Args:
        progress, doing: told how far it has come, and in words what begins.
        show: given the answer before the `bound` and `late` outputs are worked out, and again with each of these.
        bound: whether the bound for every strategy is worked out, as `flow` of `analysis.theory.upper_bound`.
        asked: further outputs by their key in `OUTPUTS`, with what its `measure` takes: `threat_scale=(0.5, 2)`.
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
        roll_out = make_roll_out(world, plan, choices, kept=kept)  # an engine that cannot do it says so at once
        if choices.loop == "closed":
            closed = closed_truth(plan, world, exact, choices, kept, FINE_SECONDS)
        is_all = isinstance(closed, TreeTruth) and closed.is_all and wanted.keys() <= CONTENT
        if is_all and choices.precision is not None:
            rolled = replace(choices, rollouts=TO_LOOK_AT, precision=None)
        begin("rollouts")
        for stage in until_enough(roll_out(rolled, None), rolled, tell):
            last = stage
    except KeyboardInterrupt:
        partial = True
    if last is None:
        raise KeyboardInterrupt
    run = Run(world, plan, choices, last, roll_out, exact, closed, certain, kept, tell, begin)
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
        notes=(*cut_off(world, last.tally, plan), *(() if partial else too_few(last, rolled))),
        certain=certain,
        choices=choices,
        bound=bound,
    )
    if show is not None:
        show(answer)
    if bound:
        begin("the bound for every strategy")
        answer.limit  # noqa: B018 - worked out here, where progress is told
    for key, value in late.items():
        more, partial = _measured({key: value}, run, partial)
        answer = answer.with_outputs(more, partial)
        if more and show is not None:
            show(answer)
    return answer


def _measured(wanted: dict[str, Any], run: Run, partial: bool) -> tuple[dict[str, Output], bool]:
    """The outputs by key, and whether it was interrupted, then or before."""
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
    """Raise InputError for outputs that this world has none of, before anything is planned. Arguments as `evaluate`."""
    _wanted(RolloutChoices(), asked, world)


def _wanted(choices: RolloutChoices, asked: dict[str, Any], world: World) -> dict[str, Any]:
    """What was asked for of each output, in the order of `OUTPUTS`, checked; what was not asked for is left out."""
    unknown = [name for name in asked if name not in OUTPUTS]
    if unknown:
        raise UsageError(f"evaluate has no output `{unknown[0]}`", expected=f"one of {', '.join(OUTPUTS)}")
    given = {
        "deadline": choices.deadline,
        "knowledge": None if world.knowledge is None else (world.knowledge.sense.range,),
        "experience": world.learned_hazard is not None,
        "map_doubt": isinstance(world.doubt, Uncertain),
        "turn": world.pace.turn or None,
        "value": _metrics(world),
    } | asked
    wanted = {key: given[key] for key in OUTPUTS if given.get(key) not in (None, ()) and given[key] is not False}
    for key, value in wanted.items():
        OUTPUTS[key].check(value, world)
    return wanted


def _metrics(world: World) -> str | None:
    """Whose words the map asks for; None where it says nothing of values, and none are worked out."""
    says = world.value is not None or world.detect is not None or world.team.route is not None
    return world.team.metrics or ("coverage" if says else None)


def cut_off(world: World, tally: Tally, plan: Plan) -> tuple[str, ...]:
    """A note if rollouts were ended by the plan's deadline, or cut off at T_max: what they would cover is not known."""
    count = int(tally.outcomes[Outcome.STEP_LIMIT])
    if plan.settings is not None and plan.settings.deadline is not None:
        home = "robots turn so as to be home by then" if plan.comes_home else "the team is called home then"
        return (f"the plan ends the mission at {world.pace.step(plan.settings.deadline)}: {home}",)
    if count == 0:
        return ()
    cut = (
        f"{count:,} of {counted(tally.rollouts, 'rollout')} {'was' if count == 1 else 'were'} cut off at the step limit"
    )
    return (f"{cut}: raise {argument('max_steps')}",)


def too_few(last: Stage, choices: RolloutChoices) -> tuple[str, ...]:
    """A note if it ended before what was asked for was reached."""
    done = last.tally.rollouts
    if choices.precision is None:
        reached = done >= choices.rollouts
        of = counted(choices.rollouts, "rollout")
        return () if reached else (f"{choices.seconds:g} s were over after {done:,} of {of}",)
    half = half_width(last.tally)
    if half < choices.precision:
        return ()
    ends = "the last rollout that there is" if choices.seconds is None else f"{choices.seconds:g} s"
    wanted = f"asked for was ± {100 * choices.precision:g}"
    return (f"{ends} came before that precision: mean coverage is sure to ± {100 * half:.3g} points, {wanted}; "
            f"{argument('seconds')} gives it longer",)  # fmt: skip


def until_enough(stages: Iterator[Stage], choices: RolloutChoices, progress: ProgressCallback) -> Iterator[Stage]:
    """The stages up to the one that is precise enough, or with which the time is over, or all."""
    marks = set(looks())
    for stage in stages:
        done = stage.tally.rollouts
        half = math.inf if choices.precision is None else half_width(stage.tally)
        progress(done, expected_rollouts(choices, done, half, stage.seconds), stage.seconds)
        yield stage
        enough = choices.precision is not None and done in marks and half < choices.precision
        if enough or (choices.seconds is not None and stage.seconds >= choices.seconds):
            return


def expected_rollouts(choices: RolloutChoices, done: int, half: float, seconds: float) -> int:
    """How many there will be, as far as one can tell: those asked for; or so many as a `half`-width of now tells of."""
    total = choices.rollouts
    if choices.precision is not None:
        needed = done * (half / choices.precision) ** 2
        total = next((look for look in looks() if look >= max(needed, done)), looks()[-1])
    if choices.seconds is not None and seconds > 0:
        total = min(total, max(done, int(done * choices.seconds / seconds)))
    return total


def half_width(tally: Tally) -> float:
    """Half the width of the 95 % interval of mean visited coverage, a fraction of the accessible cells."""
    return tally_mean(tally, "visited", 1.0 / tally.accessible).half_width
