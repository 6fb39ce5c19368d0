"""What to roll out, how much of it, and the loop that does it, as tallies or rollout by rollout."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from analysis.statistics.control import Paired
from analysis.statistics.estimate import looks
from planner.arguments import argument, check_word, is_real, is_whole
from planner.errors import UsageError
from planner.plans.plan import Plan, RobotPlan
from planner.tally import RolloutResults, Tally
from planner.worlds.world import World

if TYPE_CHECKING:
    from mrac_jax.open_loop.batch import Engine
    from mrac_jax.open_loop.compiled import Mode

MOST_ROLLOUTS = 2**32


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
        control: pair every closed-loop rollout with the open loop's (`analysis.statistics.control`).
    """

    loop: Literal["open", "closed"] = "closed"
    rollouts: int = 100_000
    precision: float | None = None
    mode: Mode = "fast"
    engine: Engine = "auto"
    seed: int = 0
    deadline: int | None = None
    first_only: bool = False
    control: bool = False

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise UsageError for an unknown word, a value out of range, or a combination that has no answer."""
        check_word("loop", self.loop, ("open", "closed"))
        check_word("mode", self.mode, ("fast", "step"))
        check_word("engine", self.engine, ("auto", "jax", "numba"))
        if not is_whole(self.rollouts, 1, MOST_ROLLOUTS):
            raise UsageError(argument("rollouts", self.rollouts), expected=f"a whole number, 1 to {MOST_ROLLOUTS}")
        if self.precision is not None and not (is_real(self.precision) and 0 < self.precision < 1):
            expected = "a fraction of the accessible cells in (0, 1)"
            raise UsageError(argument("precision", self.precision), expected=expected)
        if not is_whole(self.seed, 0, 2**64 - 1):
            raise UsageError(argument("seed", self.seed), expected="a whole number, 0 to 2**64 - 1")
        if self.deadline is not None and not is_whole(self.deadline, 0, 2**22 - 1):
            raise UsageError(argument("deadline", self.deadline), expected="a step, 0 to 4194303")
        if self.first_only and self.loop == "open":
            problem = f"{argument('first_only', True)} needs the closed loop"
            raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")
        if self.control and self.loop == "open":
            problem = f"{argument('control', True)} needs the closed loop; the open loop's expected values are exact"
            raise UsageError(problem, fix="leave it out")


@dataclass(frozen=True, eq=False)
class Stage:
    """Where a run of rollouts stands: its tally, the engine's name, seconds of running and of compiling.

    `pairs`: the closed loop's coverage beside the open loop's, visited and survived, if they were asked for.
    """

    tally: Tally
    engine: str
    seconds: float
    compile_seconds: float
    pairs: tuple[Paired, Paired] | None = None


RollOut = Callable[[RolloutChoices, int | None], Iterator[Stage]]
"""Rolls out as many as the choices ask for, cut off at a step if one is given; yields where it stands after every
chunk, the numbers of `looks()` among them."""
Singles = Callable[[int, int], RolloutResults]
"""`singles(start, count)`: what each of those rollouts came to."""


def is_certain(world: World, plan: Plan) -> bool:
    """Whether nothing can happen: no robot's planned path enters a dangerous cell, so every run of both loops is it."""
    threat = world.threat.reshape(-1)
    return not any((threat[robot.path] > 0).any() for robot in plan.robots)


def make_roll_out(world: World, plan: Plan, choices: RolloutChoices, threats: World | None = None) -> RollOut:
    """The loop that the choices name, its tables made once. Raises InputError.

    `threats`: the world whose threats stop robots, where they are not those of the map that the plan was made for.
    """
    if choices.loop == "open":
        return _open_loop(world, plan, threats)
    return _closed_loop(world, plan, choices, threats)


def make_singles(world: World, plan: Plan, choices: RolloutChoices, threats: World | None = None) -> Singles:
    """The loop that the choices name, rollout by rollout, up to their deadline. Arguments as of `make_roll_out`."""
    if choices.loop == "open":
        from mrac_jax.open_loop.batch import make_engine

        compiled = _compiled(world, plan if choices.deadline is None else cut_off(plan, choices.deadline), threats)
        return make_engine(compiled, seed=choices.seed, mode=choices.mode, engine=choices.engine).results
    from mrac_jax.closed_loop.batch import make_closed_loop_engine

    loop = _tables(world, plan, choices.first_only, threats)
    if choices.deadline is not None:
        loop = loop.until(choices.deadline)
    return make_closed_loop_engine(loop, choices.seed, choices.engine).results


def _open_loop(world: World, plan: Plan, threats: World | None) -> RollOut:
    from mrac_jax.open_loop.batch import run_chunks

    def roll_out(choices: RolloutChoices, until: int | None) -> Iterator[Stage]:
        compiled = _compiled(world, plan if until is None else cut_off(plan, until), threats)
        for chunk in run_chunks(
            compiled, seed=choices.seed, mode=choices.mode, engine=choices.engine, **_how_many(choices)
        ):
            yield Stage(chunk.tally, chunk.engine, chunk.seconds, chunk.compile_seconds)

    return roll_out


def _closed_loop(world: World, plan: Plan, choices: RolloutChoices, threats: World | None) -> RollOut:
    from mrac_jax.closed_loop.batch import run_closed_chunks

    clock = time.perf_counter()
    whole = _tables(world, plan, choices.first_only, threats)
    same_luck = replace(
        choices, loop="open", mode="step", engine="auto", first_only=False, control=False, deadline=None
    )
    beside = make_singles(world, plan, same_luck, threats) if choices.control else None
    tables_seconds = time.perf_counter() - clock

    def roll_out(choices: RolloutChoices, until: int | None) -> Iterator[Stage]:
        loop = whole if until is None else whole.until(until)
        pairs, paired = (Paired(), Paired()), beside is not None and until is None
        for chunk in run_closed_chunks(
            loop, seed=choices.seed, engine=choices.engine, results=paired, **_how_many(choices)
        ):
            if chunk.results is not None and beside is not None:
                other = beside(chunk.results.start, len(chunk.results.visited))
                new = (
                    Paired.of(chunk.results.visited, other.visited),
                    Paired.of(chunk.results.survived, other.survived),
                )
                pairs = (pairs[0] + new[0], pairs[1] + new[1])
            compile_seconds = tables_seconds + chunk.compile_seconds
            yield Stage(chunk.tally, chunk.engine, chunk.seconds, compile_seconds, pairs if paired else None)

    return roll_out


def _compiled(world: World, plan: Plan, threats: World | None) -> Any:
    from mrac_jax.open_loop.compiled import compile_plan

    if threats is None:
        return compile_plan(plan, world)
    return compile_plan(replace(plan, sha256=threats.sha256), threats)


def _tables(world: World, plan: Plan, first_only: bool, threats: World | None) -> Any:
    from planner.kernels.closed_loop import compile_closed_loop

    loop = compile_closed_loop(plan, world, first_only=first_only)
    return loop if threats is None else loop.under(threats)


def _how_many(choices: RolloutChoices) -> dict[str, Any]:
    """Rollouts to run at most, and after how many a chunk must end to be looked at."""
    return {"count": choices.rollouts if choices.precision is None else MOST_ROLLOUTS, "checkpoints": looks()}


def cut_off(plan: Plan, step: int) -> Plan:
    """The plan as driven until the end of `step`: its rollouts cover what the whole plan's have covered by then."""
    robots = tuple(RobotPlan(robot.path[: step + 1]) for robot in plan.robots)
    return replace(plan, settings=None, areas=(), areas_added=(), robots=robots)
