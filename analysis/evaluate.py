"""Evaluate a plan open loop: closed form and formulas, rollouts until a count or a precision, the deadline, the band."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.bounds import all_bounds
from analysis.estimate import QUANTILES, looks, mean_estimate, quantile
from analysis.evaluation import Band, Deadline, Evaluation
from analysis.exact import open_loop_exact
from planner.errors import UsageError
from planner.plan import Plan, RobotPlan
from planner.world import World

if TYPE_CHECKING:
    from mrac_jax.batch import Chunk, Engine
    from mrac_jax.compiled import Mode
    from planner.tally import Tally

Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk."""
MOST_ROLLOUTS = 2**32
BAND_STEPS, BAND_ROLLOUTS = 40, 16_384


@dataclass(frozen=True)
class RolloutChoices:
    """How much to roll out, and how.

    Attributes:
        rollouts: how many, when `precision` is None.
        precision: stop when the half-width of the 95 % interval of mean visited coverage (a fraction) is below this.
        mode, engine, seed: see mrac_jax.batch. deadline: a step at which coverage is reported too, or None.
    """

    rollouts: int = 100_000
    precision: float | None = None
    mode: Mode = "fast"
    engine: Engine = "auto"
    seed: int = 0
    deadline: int | None = None

    def check(self) -> None:
        """Raise UsageError for a value out of range."""
        if not 1 <= self.rollouts <= MOST_ROLLOUTS:
            raise UsageError(f"--rollouts {self.rollouts}", expected=f"1 to {MOST_ROLLOUTS}")
        if self.precision is not None and not 0 < self.precision < 1:
            raise UsageError(f"--precision {self.precision:g}", expected="a fraction of the accessible cells in (0, 1)")
        if not 0 <= self.seed < 2**64:
            raise UsageError(f"--seed {self.seed}", expected="0 to 2**64 - 1")
        if self.deadline is not None and not 0 <= self.deadline < 2**22:
            raise UsageError(f"--deadline {self.deadline}", expected="a step, 0 to 4194303")


def evaluate_open_loop(
    world: World, plan: Plan, choices: RolloutChoices, *, progress: Progress | None = None, band: bool = False
) -> Evaluation:
    """Roll `plan` out in `world` and put the counts beside the exact values and the formulas.

    An interruption (KeyboardInterrupt) ends it with what was done so far, marked `partial`; if that is nothing, it is
    raised again. `band`: also sample coverage over time, for the picture.
    """
    choices.check()
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    run = _roll_out(world, plan, choices, progress)
    tally = run.last.tally
    deadline = None
    if choices.deadline is not None:
        deadline = Deadline(choices.deadline, _roll_out_until(world, plan, choices.deadline, choices, tally.rollouts))
    return Evaluation(
        world=world,
        plan=plan,
        exact=exact,
        bounds=bounds,
        loop="open",
        mode=choices.mode,
        engine=run.last.engine,
        seed=choices.seed,
        tally=tally,
        seconds=run.last.seconds,
        compile_seconds=run.last.compile_seconds,
        deadline=deadline,
        band=_band(world, plan, choices) if band else None,
        partial=run.interrupted,
        notes=run.notes,
    )


@dataclass(frozen=True, eq=False)
class _Run:
    last: Chunk
    interrupted: bool
    notes: tuple[str, ...]


def _roll_out(world: World, plan: Plan, choices: RolloutChoices, progress: Progress | None) -> _Run:
    """Rollouts from id 0 until the count or the precision is reached, or somebody interrupts."""
    from mrac_jax.batch import run_chunks
    from mrac_jax.compiled import compile_plan

    most = choices.rollouts if choices.precision is None else MOST_ROLLOUTS
    last, notes = None, ()
    try:
        for last in run_chunks(
            compile_plan(plan, world),
            seed=choices.seed,
            count=most,
            mode=choices.mode,
            engine=choices.engine,
            checkpoints=() if choices.precision is None else looks(),
        ):
            done = last.tally.rollouts
            if progress is not None:
                progress(done, most if choices.precision is None else 0, last.seconds)
            if choices.precision is not None and done in looks() and _half_width(last.tally) < choices.precision:
                break
        else:
            if choices.precision is not None:
                notes = (f"precision {choices.precision:g} not reached in all {MOST_ROLLOUTS} rollouts",)
    except KeyboardInterrupt:
        if last is None:
            raise
        return _Run(last, True, notes)
    assert last is not None
    return _Run(last, False, notes)


def _half_width(tally: Tally) -> float:
    return mean_estimate(tally.visited, 1.0 / tally.accessible).half_width


def cut_off(plan: Plan, step: int) -> Plan:
    """The plan as driven until the end of `step`: its rollouts cover what the whole plan's have covered by then."""
    robots = tuple(RobotPlan(robot.path[: step + 1]) for robot in plan.robots)
    return replace(plan, settings=None, areas=(), areas_added=(), robots=robots)


def _roll_out_until(world: World, plan: Plan, step: int, choices: RolloutChoices, rollouts: int) -> Tally:
    from mrac_jax.batch import rollouts as roll_out
    from mrac_jax.compiled import compile_plan

    compiled = compile_plan(cut_off(plan, step), world)
    return roll_out(compiled, seed=choices.seed, count=rollouts, mode=choices.mode, engine=choices.engine)


def _band(world: World, plan: Plan, choices: RolloutChoices) -> Band:
    """Quantiles of coverage at BAND_STEPS steps, each from the first BAND_ROLLOUTS rollouts cut off there."""
    steps = np.unique(np.linspace(0, plan.makespan, BAND_STEPS).round().astype(np.int64))
    tallies = [_roll_out_until(world, plan, int(step), choices, BAND_ROLLOUTS) for step in steps]
    low, median, high = (np.array([quantile(tally.visited, q) for tally in tallies]) for q in QUANTILES)
    return Band(steps, low, median, high)
