"""The unit of work: one team with its models and the rollout ids wanted of each; a pure function, wherever it runs.

A task carries all that its results depend on, and no settings of the machine: run twice, in another
order, by another process or on another machine, it gives the same counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import Case, Label, Team, labels_of, naming
from analysis.sweeps.store.ranges import Ranges, cut
from planner.errors import InputError
from planner.files import Json
from planner.limits import BLOCK
from planner.luck_names import LuckName
from planner.plans.plan import Plan
from planner.policies import DEFAULT
from planner.rules import NOW
from planner.settings import BEARING, Settings
from planner.tally import Tally

if TYPE_CHECKING:
    from planner.kernels.loop import ClosedLoop
    from planner.kernels.tables import AllPairs
    from planner.mrac.problem import Problem
    from planner.rollouts.engine import Engine

ONCE_UNDER_WAY: dict[str, Any] = {
    "policy": DEFAULT, **dict.fromkeys(("reserve", "worth", "range", "recharge", "max_steps", "deadline")),
    **{name: getattr(Settings(), name) for name in BEARING},
}  # fmt: skip
"""Settings, by their defaults, that the areas at t = 0 do not depend on."""


@dataclass(frozen=True, eq=False)
class Wanted:
    """Rollout ids of one model to run: `key` of the run (`cases.run_key`), what it is found by, and the ids.

    `exact_seconds`: as of `engine.Job`.
    """

    key: str
    model: RolloutChoices
    ids: Ranges
    exact_seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Task:
    """The team of a case, and what is wanted of it; `ticket` is for whoever sent it."""

    case: Case
    team: Team
    wanted: tuple[Wanted, ...]
    ticket: int = 0


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a task found of one run.

    Attributes:
        key: the run's. what: labels that it is found by. facts: what is known without rolling out (`facts_of`).
        tallies: one for each aligned block of ids that was rolled out, or part of one.
    """

    key: str
    what: dict[str, Label]
    facts: Json
    tallies: tuple[Tally, ...]


Stream = Callable[[Iterable[Task]], Iterator[tuple[Task, list[RunResult]]]]
"""Runs tasks, taken from the iterable as there is room; yields each with its results, in any order."""


def run_task(task: Task) -> list[RunResult]:
    """Plan once, make the tables once, roll out every model's ids on one thread. Raises InputError naming the case."""
    try:
        closed = any(wanted.model.loop == "closed" for wanted in task.wanted)
        loops = _prepared(_Same(task.team.identity, task.team), closed)
        return [_run(wanted, task, loops) for wanted in task.wanted]
    except InputError as error:
        raise naming(error, task.case.name) from error


def run_tasks(tasks: list[Task]) -> list[list[RunResult]]:
    """`run_task` of one after the other."""
    return [run_task(task) for task in tasks]


def _run(wanted: Wanted, task: Task, loops: _Loops) -> RunResult:
    from planner.rollouts.engine import run_by_luck

    engine = loops.of(wanted.model)
    controlled = wanted.model.luck == "tolerance" and wanted.model.loop == "closed"
    tallies = tuple(
        run_by_luck(engine, wanted.model.seed, start, stop - start)[0]
        if controlled
        else engine.tally(start, stop - start)
        for start, stop in cut(wanted.ids, BLOCK)
    )
    facts = dict(loops.facts)
    if controlled and wanted.exact_seconds:
        facts["closed_loop"] = exact_means(loops.closed(wanted.model), wanted.exact_seconds)
    return RunResult(wanted.key, labels_of(task.case, task.team, wanted.model), facts, tallies)


class _Loops:
    """The models of one plan, ready to roll out; the closed loop's tables are made once for all of them.

    Where they are made anyway, the compiled simulator makes the nominal run too.
    """

    def __init__(self, team: Team, closed: bool) -> None:
        self._team = team
        self._closed: ClosedLoop | None = None
        known = team.world.draws is None  # the compiled nominal run is of one truth
        if closed and known and team.plan is None and team.settings.plan_for == "closed":
            from planner.kernels.nominal import with_nominal_run

            alike = replace(team, settings=replace(team.settings, **ONCE_UNDER_WAY))
            problem, begun = _allocated(_Same(alike.identity, alike))
            own = problem if team.settings == alike.settings else None
            begun = replace(begun, settings=team.settings)
            self._closed = self._compiled(begun, "tolerance", own)
            self._plan = with_nominal_run(begun, self._closed)
        else:
            self._plan = team.build()
        self.facts = facts_of(team, self._plan, None if self._closed is None else self._closed.max_steps)

    def of(self, model: RolloutChoices) -> Engine:
        """What rolls a model out, on one thread."""
        from planner.rollouts.engine import closed_loop_engine, open_loop_engine
        from planner.rollouts.open_loop.compiled import compile_plan

        world = self._team.world
        if model.loop == "open":
            drawn: Any = model.drawn
            return open_loop_engine(compile_plan(self._plan, world), model.seed, drawn, "numba", 1)
        return closed_loop_engine(self.closed(model), model.seed, "numba", threads=1)

    def closed(self, model: RolloutChoices) -> ClosedLoop:
        """A model's closed loop."""
        if self._closed is None:
            self._closed = self._compiled(self._plan, model.luck)
        loop = self._closed
        if model.first_only:
            loop = loop.again(identity=f"{loop.identity}!first_visit", first_only=True)
        return loop if model.luck == loop.luck else loop.by(model.luck, self._team.world)

    def _compiled(self, plan: Plan, luck: LuckName, problem: Problem | None = None) -> ClosedLoop:
        from planner.kernels.closed_loop import compile_closed_loop

        kept = _of_world(self._team.world.sha256).pairs
        return compile_closed_loop(plan, self._team.world, kept=kept, luck=luck, problem=problem)


@dataclass(frozen=True)
class _Same:
    """A team, equal to another of the same content."""

    identity: str
    team: Team = field(compare=False)


@lru_cache(maxsize=1)
def _prepared(what: _Same, closed: bool) -> _Loops:
    """Plan, facts and tables; the last team's are kept, for a run that is split into tasks by ids."""
    return _Loops(what.team, closed)


@lru_cache(maxsize=1)
def _allocated(what: _Same) -> tuple[Problem, Plan]:
    """The plan before its nominal run; the last one is kept, for other settings of a team on the same map."""
    from planner.mrac.make_plan import allocated

    kept, team = _of_world(what.team.world.sha256), what.team
    kept.problem, plan = allocated(team.world, team.starts, team.settings, before=kept.problem)
    return kept.problem, plan


@dataclass
class _Kept:
    """What teams in one world hand on to the next: its all-pairs tables, and the problem of the last team."""

    pairs: AllPairs
    problem: Problem | None = None


@lru_cache(maxsize=1)
def _of_world(world: str) -> _Kept:
    """Of a world, known by its hash; the last world's."""
    from planner.kernels.tables import AllPairs

    return _Kept(AllPairs())


def exact_means(loop: ClosedLoop, seconds: float) -> Json | None:
    """Means of the figures of a closed loop, cells, steps, robots and a chance; None where its tree is too dear."""
    from analysis.trials.exact_loop import tree_of
    from analysis.trials.measured import Known

    tree = tree_of(loop, seconds)
    if tree is None:
        return None
    known = Known(tree)
    found = {name: known.mean(name) for name in ("visited", "survived", "time", "alive")}
    found["complete"] = known.chance("visited", len(tree.counts.visited) - 1)
    return (
        {name: one.mean for name, one in found.items()}
        if all(one.se == one.half_width == 0 for one in found.values())
        else None
    )


def facts_of(team: Team, plan: Plan, most: int | None = None) -> Json:
    """What is known of a team's plan without rolling out, as JSON: cells, the open loop's exact values, the ideal.

    `exact`: of the open loop, in cells, steps and robots; None what is not known. `ideal_team`: SPEC
    section 7, cells; None where robots wear or differ, and where threats move.
    `most`: T_max, if it is known.
    `rules`: the latest of the release that made it; `longest`: steps that a run of either loop takes at most;
    `deadline`: only where it, not the step limit, cuts runs off; stores of earlier releases lack all three. Where a job
    asks for exact values, its runs' facts have `closed_loop` too (`exact_means`).
    """
    from analysis.theory.bounds import ideal_team
    from analysis.theory.exact import open_loop_exact
    from analysis.theory.longest import longest_run

    world, robots = team.world, len(team.starts)
    accessible = world.accessible(team.starts)
    threat = np.sort(world.met[accessible].astype(np.float64))
    exact = open_loop_exact(plan, world)
    values = {
        "visited": exact.visited, "survived": exact.survived, "time": exact.mean_time,
        "alive": float(exact.survival.sum()),
    }  # fmt: skip
    ideal = plan.bearing.is_plain and world.doubt is None
    return {
        "shape": list(world.shape),
        "world": world.luck_sha256,
        "robots": robots,
        "cells": {
            "total": world.threat.size,
            "free": int(world.free.sum()),
            "accessible": len(threat),
            "dangerous": int((threat > 0).sum()),
        },
        "exact": {name: value if math.isfinite(value) else None for name, value in values.items()},
        "ideal_team": ideal_team(threat, robots) if ideal else None,
        "makespan": plan.makespan,
        "longest": longest_run(world, plan, "closed", most),
        "rules": NOW,
        "nominal": {"outcome": plan.outcome, "time": plan.time, "shares": plan.shares},
        **({"deadline": plan.settings.deadline} if plan.settings and plan.ends_by_deadline else {}),
    }
