"""Evaluate a plan: closed form, formulas, rollouts until a count or a precision, the deadline, the band over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from analysis.evaluation.answer import Deadline, Evaluation
from analysis.evaluation.over_time import band_over_time
from analysis.evaluation.threat_scale import roll_out_scaled, scaled_threats
from analysis.sampling import RollOut, RolloutChoices, Stage, is_certain, make_roll_out
from analysis.statistics.control import Controlled, controlled
from analysis.statistics.coverage import Coverage
from analysis.statistics.estimate import exactly, looks
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.truth import exact_truth
from planner.plans.plan import Plan
from planner.tally import Outcome, Tally
from planner.worlds.world import World

Doing = Callable[[str], None]
Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""


def evaluate(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    *,
    scales: tuple[float, ...] = (),
    progress: Progress | None = None,
    doing: Doing | None = None,
    band: bool = False,
) -> Evaluation:
    """Roll `plan` out in `world` and put the counts beside the exact values and the formulas.

    Where nothing can happen (`is_certain`) one rollout is run, whatever was asked for: every run is the same.
    An interruption (KeyboardInterrupt) ends it with what was done so far, marked `partial`; if that is nothing, it is
    raised again. Raises InputError.

    Args:
        scales: also roll out under threats that are so many times the map's (`analysis.evaluation.threat_scale`).
        progress, doing: told how far it has come, and in words what begins.
        band: also coverage over time of single rollouts, for the picture.
    """
    choices.check()
    asked, certain = choices, is_certain(world, plan)
    if certain:
        choices = replace(choices, rollouts=1, precision=None, control=False)
    scaled_worlds = [scaled_threats(world, scale) for scale in scales]
    begin: Doing = doing or (lambda what: None)
    begin("exact values")
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    last, partial, closed = None, False, None
    try:
        if choices.loop == "closed":
            closed = exact_truth(plan, world, exact, choices.first_only)
        begin("rollouts")
        roll_out = make_roll_out(world, plan, choices)
        for stage in until_enough(roll_out(choices, None), choices, exact, progress):
            last = stage
    except KeyboardInterrupt:
        partial = True
    if last is None:
        raise KeyboardInterrupt
    deadline, over_time, scaled = None, None, []
    try:
        for scale, threats in zip(scales, scaled_worlds, strict=True):
            if not partial:
                begin(f"rollouts under {scale:g} times the threats")
                count = asked.rollouts if certain else last.tally.rollouts
                scaled.append(roll_out_scaled(world, plan, asked, count, scale, threats, progress))
        if choices.deadline is not None and not partial:
            begin(f"rollouts up to the deadline, step {choices.deadline:,}")
            cut = _exactly(roll_out, replace(choices, rollouts=last.tally.rollouts), choices.deadline, progress)
            deadline = Deadline(choices.deadline, cut)
        if band and not partial:
            begin("coverage over time")
            over_time = band_over_time(world, plan, choices, last.tally, progress)
    except KeyboardInterrupt:
        partial = True
    too_few = choices.precision is not None and not partial and half_width(last, exact) >= choices.precision
    return Evaluation(
        world=world,
        plan=plan,
        closed_form=exact,
        formulas=bounds,
        loop=choices.loop,
        mode=choices.mode if choices.loop == "open" else "step",
        engine=last.engine,
        seed=choices.seed,
        tally=last.tally,
        closed=closed,
        control=_control(last, exact) if last.pairs else _no_spread(last.tally) if asked.control else None,
        scaled=tuple(scaled),
        seconds=last.seconds,
        compile_seconds=last.compile_seconds,
        deadline=deadline,
        band=over_time,
        partial=partial,
        notes=(*timeouts(last.tally), *(("--precision was not reached in 2**32 rollouts",) if too_few else ())),
        certain=certain,
        choices=choices,
    )


def timeouts(tally: Tally) -> tuple[str, ...]:
    """A note if rollouts were cut off at T_max: what they would have covered is not known."""
    count = int(tally.outcomes[Outcome.TIMEOUT])
    if count == 0:
        return ()
    cut = f"{count:,} of {tally.rollouts:,} rollouts were cut off at the limit of steps (timeout)"
    return (f"{cut}: raise --max-steps",)


def until_enough(
    stages: Iterator[Stage], choices: RolloutChoices, exact: OpenLoopExact, progress: Progress | None
) -> Iterator[Stage]:
    """The stages up to the one that is precise enough, or all."""
    total, marks = (choices.rollouts if choices.precision is None else 0), set(looks())
    for stage in stages:
        if progress is not None:
            progress(stage.tally.rollouts, total, stage.seconds)
        yield stage
        looked_at = choices.precision is not None and stage.tally.rollouts in marks
        if looked_at and half_width(stage, exact) < choices.precision:  # type: ignore[operator]
            return


def half_width(stage: Stage, exact: OpenLoopExact) -> float:
    """Half the width of the 95 % interval of mean visited coverage, a fraction of the accessible cells.

    With a control, of the tighter of the two intervals.
    """
    control = None if stage.pairs is None else _control(stage, exact)[0].estimate
    return Coverage.of(stage.tally.visited, other=control).half_width


def _control(stage: Stage, exact: OpenLoopExact) -> tuple[Controlled, Controlled]:
    """Visited and survived coverage, fractions, with the open loop as the control."""
    assert stage.pairs is not None
    cells, known = stage.tally.accessible, (exact.visited, exact.survived)
    visited, survived = (controlled(p, k, cells, 1.0 / cells) for p, k in zip(stage.pairs, known, strict=True))
    return visited, survived


def _no_spread(tally: Tally) -> tuple[Controlled, Controlled]:
    """Visited and survived coverage where every run is the same: there is nothing to sharpen."""
    sums = (int(counts @ np.arange(len(counts))) for counts in (tally.visited, tally.survived))
    visited, survived = (Controlled(exactly(cells / tally.rollouts / tally.accessible), 0.0, 1.0) for cells in sums)
    return visited, survived


def _exactly(roll_out: RollOut, choices: RolloutChoices, until: int, progress: Progress | None) -> Tally:
    """The tally of `choices.rollouts` rollouts cut off at the end of step `until`."""
    for stage in roll_out(replace(choices, precision=None), until):
        tally = stage.tally
        if progress is not None:
            progress(tally.rollouts, choices.rollouts, stage.seconds)
    return tally
