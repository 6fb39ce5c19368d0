"""Evaluate a plan: closed form, formulas, rollouts until a count or a precision, the deadline, the band over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from analysis.evaluation.answer import Band, Deadline, Evaluation
from analysis.evaluation.threat_scale import roll_out_scaled, scaled_threats
from analysis.sampling import RollOut, RolloutChoices, Stage, make_roll_out
from analysis.statistics.control import Controlled, controlled
from analysis.statistics.estimate import QUANTILES, looks, mean_estimate, quantile
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.truth import exact_truth
from planner.plans.plan import Plan
from planner.tally import Outcome, Tally
from planner.worlds.world import World

Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""
BAND_STEPS = {"open": 40, "closed": 24}
BAND_ROLLOUTS = {"open": 16_384, "closed": 2_048}
"""Steps at which the band is sampled, and rollouts for each, by loop."""


def evaluate(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    *,
    scales: tuple[float, ...] = (),
    progress: Progress | None = None,
    band: bool = False,
) -> Evaluation:
    """Roll `plan` out in `world` and put the counts beside the exact values and the formulas.

    An interruption (KeyboardInterrupt) ends it with what was done so far, marked `partial`; if that is nothing, it is
    raised again. Raises InputError.

    Args:
        scales: also roll out under threats that are so many times the map's (`analysis.evaluation.threat_scale`).
        band: also sample coverage over time, for the picture.
    """
    choices.check()
    scaled_worlds = [scaled_threats(world, scale) for scale in scales]
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    last, partial, closed = None, False, None
    try:
        if choices.loop == "closed":
            closed = exact_truth(plan, world, exact, choices.first_only)
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
                scaled.append(roll_out_scaled(world, plan, choices, last.tally.rollouts, scale, threats))
        if choices.deadline is not None and not partial:
            cut = _exactly(roll_out, replace(choices, rollouts=last.tally.rollouts), choices.deadline)
            deadline = Deadline(choices.deadline, cut)
        if band and not partial:
            over_time = _band(roll_out, plan, choices, last.tally)
    except KeyboardInterrupt:
        partial = True
    too_few = choices.precision is not None and not partial and half_width(last, exact) >= choices.precision
    return Evaluation(
        world=world,
        plan=plan,
        exact=exact,
        bounds=bounds,
        loop=choices.loop,
        mode=choices.mode if choices.loop == "open" else "step",
        engine=last.engine,
        seed=choices.seed,
        tally=last.tally,
        closed=closed,
        control=None if last.pairs is None else _control(last, exact),
        scaled=tuple(scaled),
        seconds=last.seconds,
        compile_seconds=last.compile_seconds,
        deadline=deadline,
        band=over_time,
        partial=partial,
        notes=(*timeouts(last.tally), *(("--precision was not reached in 2**32 rollouts",) if too_few else ())),
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

    Of the controlled estimate, if there is a control.
    """
    if stage.pairs is not None:
        return _control(stage, exact)[0].estimate.half_width
    return mean_estimate(stage.tally.visited, 1.0 / stage.tally.accessible).half_width


def _control(stage: Stage, exact: OpenLoopExact) -> tuple[Controlled, Controlled]:
    """Visited and survived coverage, fractions, with the open loop as the control."""
    assert stage.pairs is not None
    cells, known = stage.tally.accessible, (exact.visited, exact.survived)
    visited, survived = (controlled(p, k, cells, 1.0 / cells) for p, k in zip(stage.pairs, known, strict=True))
    return visited, survived


def _exactly(roll_out: RollOut, choices: RolloutChoices, until: int) -> Tally:
    """The tally of `choices.rollouts` rollouts cut off at the end of step `until`."""
    for stage in roll_out(replace(choices, precision=None), until):
        tally = stage.tally
    return tally


def _band(roll_out: RollOut, plan: Plan, choices: RolloutChoices, tally: Tally) -> Band:
    """Quantiles of coverage over time, each from the first rollouts cut off there."""
    last = plan.makespan if choices.loop == "open" else quantile(tally.time, 0.999)
    steps = np.unique(np.linspace(0, last, BAND_STEPS[choices.loop]).round().astype(np.int64))
    few = replace(choices, rollouts=BAND_ROLLOUTS[choices.loop])
    tallies = [_exactly(roll_out, few, int(step)) for step in steps]
    low, median, high = (np.array([quantile(cut.visited, q) for cut in tallies]) for q in QUANTILES)
    return Band(steps, low, median, high, few.rollouts)
