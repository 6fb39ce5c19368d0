"""Evaluate a plan: closed form, formulas, rollouts until a count or a precision, the deadline, the band over time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.bounds import all_bounds
from analysis.estimate import QUANTILES, looks, mean_estimate, quantile
from analysis.evaluation import Band, Deadline, Evaluation
from analysis.exact import open_loop_exact
from planner.errors import UsageError
from planner.plan import Plan, RobotPlan
from planner.tally import Outcome, Tally
from planner.world import World

if TYPE_CHECKING:
    from mrac_jax.batch import Engine
    from mrac_jax.compiled import Mode

Progress = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""
MOST_ROLLOUTS = 2**32
BAND_STEPS = {"open": 40, "closed": 24}
BAND_ROLLOUTS = {"open": 16_384, "closed": 2_048}
"""Steps at which the band is sampled, and rollouts for each, by loop."""


@dataclass(frozen=True)
class RolloutChoices:
    """What to roll out, and how much.

    Attributes:
        loop: "open": follow the plan until stopped; "closed": reallocate and share at run time.
        rollouts: how many, when `precision` is None.
        precision: stop when the half-width of the 95 % interval of mean visited coverage (a fraction) is below this.
        mode: of the open loop. engine: "auto", "jax" or "numba". seed: of the rollouts.
        deadline: a step at which coverage is reported too, or None.
        first_only: only the first visit of a cell by anybody can stop a robot; closed loop.
    """

    loop: Literal["open", "closed"] = "closed"
    rollouts: int = 100_000
    precision: float | None = None
    mode: Mode = "fast"
    engine: Engine = "auto"
    seed: int = 0
    deadline: int | None = None
    first_only: bool = False

    def check(self) -> None:
        """Raise UsageError for a value out of range, or a combination that has no answer."""
        if not 1 <= self.rollouts <= MOST_ROLLOUTS:
            raise UsageError(f"--rollouts {self.rollouts}", expected=f"1 to {MOST_ROLLOUTS}")
        if self.precision is not None and not 0 < self.precision < 1:
            raise UsageError(f"--precision {self.precision:g}", expected="a fraction of the accessible cells in (0, 1)")
        if not 0 <= self.seed < 2**64:
            raise UsageError(f"--seed {self.seed}", expected="0 to 2**64 - 1")
        if self.deadline is not None and not 0 <= self.deadline < 2**22:
            raise UsageError(f"--deadline {self.deadline}", expected="a step, 0 to 4194303")
        if self.first_only and self.loop == "open":
            raise UsageError("--threat-checks first_visit needs the closed loop", fix="use --loop closed")


@dataclass(frozen=True, eq=False)
class Stage:
    """Where a run of rollouts stands: its tally, the engine's name, seconds of running and of compiling."""

    tally: Tally
    engine: str
    seconds: float
    compile_seconds: float


def evaluate(
    world: World, plan: Plan, choices: RolloutChoices, *, progress: Progress | None = None, band: bool = False
) -> Evaluation:
    """Roll `plan` out in `world` and put the counts beside the open loop's exact values and the formulas.

    An interruption (KeyboardInterrupt) ends it with what was done so far, marked `partial`; if that is nothing, it is
    raised again. `band`: also sample coverage over time, for the picture. Raises InputError.
    """
    choices.check()
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    last, partial = None, False
    try:
        roll_out = make_roll_out(world, plan, choices)
        for stage in _until_enough(roll_out(choices, None), choices, progress):
            last = stage
    except KeyboardInterrupt:
        partial = True
    if last is None:
        raise KeyboardInterrupt
    deadline, over_time = None, None
    try:
        if choices.deadline is not None and not partial:
            cut = _exactly(roll_out, replace(choices, rollouts=last.tally.rollouts), choices.deadline)
            deadline = Deadline(choices.deadline, cut)
        if band and not partial:
            over_time = _band(roll_out, plan, choices, last.tally)
    except KeyboardInterrupt:
        partial = True
    too_few = choices.precision is not None and not partial and half_width(last.tally) >= choices.precision
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


RollOut = Callable[[RolloutChoices, int | None], Iterator[Stage]]
"""Rolls out as many as the choices ask for, cut off at a step if one is given; yields where it stands after every
chunk, the numbers of `looks()` among them."""


def make_roll_out(world: World, plan: Plan, choices: RolloutChoices) -> RollOut:
    """The loop that the choices name, its tables made once. Raises InputError."""
    closed = choices.loop == "closed"
    return _closed_loop(world, plan, choices.first_only) if closed else _open_loop(world, plan)


def _until_enough(stages: Iterator[Stage], choices: RolloutChoices, progress: Progress | None) -> Iterator[Stage]:
    """The stages up to the one that is precise enough, or all."""
    total, marks = (choices.rollouts if choices.precision is None else 0), set(looks())
    for stage in stages:
        if progress is not None:
            progress(stage.tally.rollouts, total, stage.seconds)
        yield stage
        looked_at = choices.precision is not None and stage.tally.rollouts in marks
        if looked_at and half_width(stage.tally) < choices.precision:  # type: ignore[operator]
            return


def half_width(tally: Tally) -> float:
    """Half the width of the 95 % interval of mean visited coverage, a fraction of the accessible cells."""
    return mean_estimate(tally.visited, 1.0 / tally.accessible).half_width


def _open_loop(world: World, plan: Plan) -> RollOut:
    from mrac_jax.batch import run_chunks
    from mrac_jax.compiled import compile_plan

    def roll_out(choices: RolloutChoices, until: int | None) -> Iterator[Stage]:
        compiled = compile_plan(plan if until is None else cut_off(plan, until), world)
        for chunk in run_chunks(
            compiled, seed=choices.seed, mode=choices.mode, engine=choices.engine, **_how_many(choices)
        ):
            yield Stage(chunk.tally, chunk.engine, chunk.seconds, chunk.compile_seconds)

    return roll_out


def _closed_loop(world: World, plan: Plan, first_only: bool) -> RollOut:
    from mrac_jax.closed_batch import run_closed_chunks
    from planner.closed_loop import compile_closed_loop

    clock = time.perf_counter()
    whole = compile_closed_loop(plan, world, first_only=first_only)
    tables_seconds = time.perf_counter() - clock

    def roll_out(choices: RolloutChoices, until: int | None) -> Iterator[Stage]:
        loop = whole if until is None else whole.until(until)
        for chunk in run_closed_chunks(loop, seed=choices.seed, engine=choices.engine, **_how_many(choices)):
            yield Stage(chunk.tally, chunk.engine, chunk.seconds, tables_seconds + chunk.compile_seconds)

    return roll_out


def _how_many(choices: RolloutChoices) -> dict[str, Any]:
    """Rollouts to run at most, and after how many a chunk must end to be looked at."""
    return {"count": choices.rollouts if choices.precision is None else MOST_ROLLOUTS, "checkpoints": looks()}


def cut_off(plan: Plan, step: int) -> Plan:
    """The plan as driven until the end of `step`: its rollouts cover what the whole plan's have covered by then."""
    robots = tuple(RobotPlan(robot.path[: step + 1]) for robot in plan.robots)
    return replace(plan, settings=None, areas=(), areas_added=(), robots=robots)


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
