"""Choices of the rollouts, and the loop that runs them: as tallies or rollout by rollout."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import NDArray

from analysis.statistics.estimates import looks
from analysis.statistics.variance_reduction import LEAST
from analysis.utils.progress import announce_compilation
from planner.arguments import MAX_STEP, MOST_ROLLOUTS, argument, as_whole, check_word, whole
from planner.errors import UsageError
from planner.formatting import SPANS, Pace, seconds_of
from planner.plan.plan import Plan
from planner.rollouts.names import EngineName, check_jax
from planner.settings import METRICS, OPTIONS, Settings
from planner.tally import RolloutResults, Tally
from planner.world.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine
    from planner.rollouts.tables import AllPairs

PRECISION = 0.001
"""Default half-width of the 95 % interval of mean visited coverage at which the rollouts stop."""
EXACT_SECONDS = 2.0
"""Approximate limit of the search for an exact value of the closed loop, in seconds; then it is only sampled."""
SECONDS = 10.0
"""Default limit of the time for rollouts, in seconds, if no size was given."""


Exactness = Literal["auto", "never"] | float


@dataclass(frozen=True)
class RolloutChoices:
    """Choices of the rollouts: loop, number, seed and stopping rule.

    Attributes:
        loop: "open": robots follow the plan until destroyed; "closed": they reallocate and share at run time.
        rollouts: number of rollouts, when `precision` is None.
        precision: stop when the half-width of the 95 % interval of mean visited coverage (a fraction) is below this.
        seconds: limit of the time for rollouts; the chunk under way is completed. None: no limit.
        engine: "auto", "jax" or "numba". seed: of the rollouts.
        deadline: a step at which coverage is also reported, or None; before `timed` also a time, as "45min".
        first_only: only the first visit of a cell by any robot can destroy a robot; closed loop.
        metric: the coverage that is compared, one of METRICS.
        exact: search for the closed loop's exact values: "auto" for EXACT_SECONDS, "never", or the seconds.
    """

    loop: Literal["open", "closed"] = "closed"
    rollouts: int = 100_000
    precision: float | None = None
    seconds: float | None = None
    engine: EngineName = "auto"
    seed: int = 0
    deadline: Any = None
    first_only: bool = False
    exact: Exactness = "auto"
    metric: str = "visited"

    def __post_init__(self) -> None:
        for name in ("rollouts", "seed", "deadline"):
            object.__setattr__(self, name, as_whole(getattr(self, name)))
        self.check()

    def timed(self, pace: Pace) -> RolloutChoices:
        """The same with a deadline in time converted to a step. Raises UsageError if the pace is unknown."""
        return replace(self, deadline=pace.last_step("deadline", self.deadline))

    @property
    def exact_seconds(self) -> float:
        """Limit of the search for the closed loop's exact values, in seconds."""
        return {"auto": EXACT_SECONDS, "never": 0.0}[self.exact] if isinstance(self.exact, str) else self.exact

    def check(self) -> None:
        """Raise UsageError for an unknown word, a value out of range, or a contradictory combination."""
        for name in ("loop", "engine"):
            check_word(name, getattr(self, name), OPTIONS[name].words)
        if self.engine == "jax":
            check_jax()
        for name in ("rollouts", "precision", "seconds", "seed"):
            OPTIONS[name].numbers.check(name, getattr(self, name), optional=name in ("precision", "seconds"))
        if self.exact not in ("auto", "never"):
            OPTIONS["exact"].numbers.check("exact", self.exact)
        if not isinstance(self.deadline, str) or seconds_of(self.deadline) is None:
            whole(0, MAX_STEP + 1, text=f"{SPANS}, at most {MAX_STEP + 1} steps").check(
                "deadline", self.deadline, optional=True
            )
        check_word("metric", self.metric, METRICS)
        if self.metric == "delivered" and self.loop == "open":
            problem = f"{argument('metric', 'delivered')} with {argument('loop', 'open')}"
            raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")
        if self.first_only and self.loop == "open":
            problem = f"{argument('first_only', True)} needs the closed loop"
            raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")


def how_much(
    rollouts: int | None, precision: float | None, seconds: float | None, usual: int | None = None
) -> dict[str, Any]:
    """`rollouts`, `precision` and `seconds` of RolloutChoices. Raises UsageError for both a number and a precision.

    Without either: `usual` rollouts, or until PRECISION is reached; for SECONDS at most.
    """
    if rollouts is not None and precision is not None:
        both = f"both {argument('rollouts')} and {argument('precision')} are given"
        raise UsageError(both, expected="one of them")
    if rollouts is None and precision is None:
        seconds = SECONDS if seconds is None else seconds
        precision = PRECISION if usual is None else None
    number = usual if rollouts is None else rollouts
    return {"precision": precision, "seconds": seconds} | ({} if number is None else {"rollouts": number})


@dataclass(frozen=True, eq=False)
class Stage:
    """Progress of a run of rollouts: its tally, the engine's name, seconds of running and of compiling.

    The closed loop's tally also has the sums of the control variate (`analysis.statistics.variance_reduction`).
    """

    tally: Tally
    engine: str
    seconds: float
    compile_seconds: float


RollOut = Callable[[RolloutChoices, int | None], Iterator[Stage]]
"""Runs the rollouts of the choices, up to a step if one is given, and yields a Stage after every chunk. With a
precision, chunks also end at the numbers of `looks()`."""
Roll = Callable[[int, int], RolloutResults]
"""`roll(start, count)`: the result of each of those rollouts."""


def check_deadline(plan: Plan, choices: RolloutChoices) -> None:
    """Raise UsageError for a deadline after the step at which the plan itself ends the mission."""
    ends = None if plan.settings is None else plan.settings.deadline
    if ends is not None and choices.deadline is not None and choices.deadline > ends:
        problem = f"{argument('deadline', choices.deadline)}, but the plan ends the mission at step {ends:,}"
        raise UsageError(problem, expected=f"a step up to {ends}", fix="leave it out, or plan anew")


def check_metric(choices: RolloutChoices, settings: Settings | None) -> None:
    """Raise UsageError for cells delivered by robots that have no base."""
    if choices.metric == "delivered" and (settings is None or settings.return_to is None):
        raise UsageError(f"{argument('metric', 'delivered')} for robots without a base", fix="give return_to (home)")


def knowing_deadline(world: World, plan: Plan, choices: RolloutChoices, *, nominal: bool = True) -> Plan:
    """A plan with return to a base, made anew for the deadline of the choices; any other plan unchanged.

    `nominal`: include its run without losses, which rollouts do not need. Raises PlanError if a robot cannot return
    in time even without losses.
    """
    from planner.make_plan import make_plan

    if not plan.comes_home or choices.loop == "open" or choices.deadline is None:
        return plan
    settings = replace(plan.require(world), deadline=choices.deadline)
    if not nominal or settings == plan.settings:
        return replace(plan, settings=settings)
    return replace(make_plan(world, plan.starts, settings, plan.areas, plan.state), notes=plan.notes)


def home_of(plan: Plan, found: Tally | RolloutResults, loop: str, deadline: int | None = None) -> NDArray | None:
    """Robots at a base at the end, counted as `found` counts robots alive; None for plans without return.

    In the open loop robots follow their paths: if all paths are at a base at the `deadline`, or at their end, every
    robot alive then is at a base.
    """
    if loop == "open":
        return found.alive if plan.ends_home(deadline) else None
    return found.home if plan.comes_home else None


def make_engine_for(
    world: World, plan: Plan, choices: RolloutChoices, threats: World | None = None, kept: AllPairs | None = None
) -> Engine:
    """The engine that the choices name, for the whole run. Raises InputError.

    `kept`: cache of the tables that do not depend on the team, for the next team.
    `threats`: the world whose threats destroy robots, if it is not the world that the plan was made for.
    """
    from planner.rollouts.engine import Rolling, make_engine

    announce_compilation(plan, choices.loop)
    how = Rolling(choices.loop, choices.first_only, choices.seed)
    engine = make_engine(plan, world, how, choices.engine, kept)
    return engine if threats is None else engine.with_threat(threats)


def make_singles(world: World, plan: Plan, choices: RolloutChoices, kept: AllPairs | None = None) -> Roll:
    """The loop that the choices name, rollout by rollout, up to their deadline. `kept`: as of `make_engine_for`."""
    engine = make_engine_for(world, plan, choices, kept=kept)
    return (engine if choices.deadline is None else engine.truncated_at(choices.deadline)).results


def make_roll_out(
    world: World, plan: Plan, choices: RolloutChoices, threats: World | None = None, kept: AllPairs | None = None
) -> RollOut:
    """The loop that the choices name, with its tables built once. Arguments as of `make_engine_for`.

    The result may be called for other numbers of rollouts; choices that differ otherwise are a ValueError.
    """
    from planner.rollouts.engine import run_chunks

    made_for = choices
    clock = time.perf_counter()
    whole = make_engine_for(world, plan, choices, threats, kept)
    tables_seconds = time.perf_counter() - clock

    def roll_out(choices: RolloutChoices, until: int | None) -> Iterator[Stage]:
        same = {"rollouts": made_for.rollouts, "precision": made_for.precision, "seconds": made_for.seconds}
        if replace(choices, **same) != made_for:  # type: ignore[arg-type]
            raise ValueError(f"made for {made_for}, called with {choices}")
        engine = whole if until is None else whole.truncated_at(until)
        most = choices.rollouts if choices.precision is None else MOST_ROLLOUTS
        controlled = choices.loop == "closed" and most >= LEAST
        by_threshold = choices.seed if controlled else None
        marks = () if choices.precision is None else looks()
        for chunk in run_chunks(engine, most, checkpoints=marks, by_threshold=by_threshold):
            yield Stage(chunk.tally, engine.name, chunk.seconds, tables_seconds + chunk.compile_seconds)

    return roll_out
