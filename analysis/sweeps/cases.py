"""Units of work of a sweep: a case (world, team, plan), a model (rollout choices), and the key of both.

The key of a run is a hash of content: threats, starts, inputs of the plan, the model with its seed, and the version of
the simulation rules. It does not depend on file names, labels, the number of rollouts, the engine or the machine.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.sweeps.store_files import Ranges, cut
from analysis.utils.pool import AHEAD
from planner.arguments import BLOCK, argument, is_whole
from planner.errors import InputError, UsageError, names_of_0_3
from planner.files import Json
from planner.make_plan import read_plan_on
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.policies import DEFAULT
from planner.settings import BEARING, Choices, Settings
from planner.tally import Tally
from planner.world.generate import PAPER_LEVELS, Kind, ThreatPattern, random_world
from planner.world.keys import Key
from planner.world.scenario import read_on, read_scenario
from planner.world.start_rule import BEFORE, check_same_team, place_starts, rules_of
from planner.world.world import World, check_starts

if TYPE_CHECKING:
    from distributed import Client, Future

    from planner.mrac.problem import Problem
    from planner.rollouts.engine import Engine
    from planner.rollouts.loop import ClosedLoop
    from planner.rollouts.tables import AllPairs

# The worlds of a sweep: the paper's random ones, and those of scenarios. Hashable; generated when needed.

MOST_MAPS = 1_000_000
"""Limit of random maps in one run."""
SCENARIO_KEYS = ("prior_map", "sensor_range", "moving_threats", "phases", "plan_on", "latent_hazard", "map_uncertainty")
"""Keys of a scenario that a random map may have: the team's map knowledge, and changes of the threats."""


def check_maps(maps: int, seed: int) -> None:
    """Raise UsageError unless the seeds `seed .. seed + maps - 1` are those of random maps."""
    if not is_whole(maps, 1, MOST_MAPS):
        raise UsageError(argument("maps", maps), expected=f"1 to {MOST_MAPS}")
    if not 0 <= seed <= 2**64 - maps:
        raise UsageError(argument("seed", seed), expected=f"0 to 2**64 - {maps}")


@dataclass(frozen=True)
class Generated:
    """One of the paper's random worlds (docs/spec.md section 8); `seed` is the world's.

    Attributes:
        kind, areas, threat_levels, seed: as in `planner.world.generate.ThreatPattern`. size: rows, columns.
        ratio, obstacles: fractions of all cells that have a threat, and that are obstacles.
        unsaid: further keys of a scenario, of SCENARIO_KEYS, as canonical JSON.
    """

    kind: Kind = "contiguous"
    ratio: float = 0.25
    seed: int = 0
    size: tuple[int, int] = (20, 20)
    areas: int = ThreatPattern.areas
    threat_levels: tuple[float, ...] = PAPER_LEVELS
    obstacles: float = 0.25
    unsaid: str = "{}"

    def world(self) -> World:
        """The world. Raises InputError."""
        pattern = ThreatPattern(self.kind, self.areas, self.threat_levels, self.seed)
        world = random_world(*self.size, pattern, obstacles=self.obstacles, threats=self.ratio)
        unsaid = json.loads(self.unsaid)
        return read_on(world, Key(unsaid, "", "random map")) if unsaid else world


@dataclass(frozen=True)
class Written:
    """A world from a scenario.

    Attributes:
        scenario: the scenario's keys as canonical JSON. source: file for relative paths and for messages.
    """

    scenario: str
    source: str

    def world(self) -> World:
        """The world with the scenario's team settings. Raises InputError."""
        source = Path(self.source)
        return read_scenario(Key(json.loads(self.scenario), "", source), source)


RULES, LATEST = "rules", "0.4"
"""Label of runs whose rules changed between releases (`rules_of`), and its value."""
REMEMBERED = 4
"""Number of worlds that `Places` caches: the next case is mostly another team in the same world."""
Label = str | int | float | bool | None


@dataclass(frozen=True)
class Case:
    """World, team and plan.

    Attributes:
        world: to simulate. robots: team size for the start rule; None: as in the scenario, else 1.
        starts: (row, col) of each robot, instead of `robots`; None: the scenario's, else those of the start rule.
        choices: given settings of the planner. plan: a plan file instead of planning.
        labels: (name, value) for queries; not part of the case's identity.
    """

    world: Generated | Written
    robots: int | None = None
    starts: tuple[tuple[int, int], ...] | None = None
    choices: Choices = Choices()  # noqa: RUF009 (frozen)
    plan: str | None = None
    labels: tuple[tuple[str, Label], ...] = field(default=(), compare=False)

    @property
    def name(self) -> str:
        """The labels as text, for messages."""
        return " ".join(f"{name}={value}" for name, value in self.labels) or "case"


@dataclass(frozen=True, eq=False)
class Team:
    """A case ready for planning; teams are equal if their plans have equal inputs.

    Attributes:
        starts: int64 `[K, 2]`. plan: from a file, else None.
    """

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    plan: Plan | None = None

    @cached_property
    def identity(self) -> str:
        """Hash of all inputs of its plan."""
        said = {
            "shape": list(self.world.shape),
            "world": self.world.randomness_sha256,
            "starts": self.starts.tolist(),
            "plan": names_of_0_3(self.settings.to_json()) if self.plan is None else _plan_hash(self.plan),
        }
        return hashlib.sha256(canonical(said).encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Team) and self.identity == other.identity

    def __hash__(self) -> int:
        return hash(self.identity)

    def build(self) -> Plan:
        """The plan. Raises InputError."""
        return plan_team(self.world, self.starts, self.settings) if self.plan is None else self.plan


def labels_of(case: Case, team: Team, model: RolloutChoices) -> dict[str, Label]:
    """Labels of a run for queries: the case's, the number of robots, and the model's."""
    checks = "first_visit" if model.first_only else "every_visit"
    drawn: dict[str, Label] = {"loop": model.loop, "threat_checks": checks}
    labels = dict(case.labels) | {"robots": len(team.starts)} | drawn | {"rollout_seed": model.seed}
    return labels if _rules(team, model) == BEFORE else labels | {RULES: LATEST}


def generated_case(
    kind: Kind = "contiguous",
    ratio: float = 0.25,
    robots: int = 1,
    seed: int = 0,
    size: tuple[int, int] = (20, 20),
    *,
    choices: Choices | None = None,
) -> Case:
    """A team on the paper's random world with this seed."""
    labels = (("kind", kind), ("ratio", ratio), ("robots", robots), ("map", seed))
    return Case(Generated(kind, ratio, seed, size), robots, choices=choices or Choices(), labels=labels)


class Places:
    """Creates teams of cases; caches the last few worlds."""

    def __init__(self) -> None:
        self._world = lru_cache(REMEMBERED)(lambda where: where.world())
        self._plan = lru_cache(REMEMBERED)(lambda path, where: read_plan_on(path, self._world(where)))

    def team(self, case: Case) -> Team:
        """The case's world, starts and settings. Raises InputError that names the case."""
        try:
            team = self._team(case)
            team.world.require_uniform("a sweep")
            team.settings.require_uniform("a sweep")
            team.settings.check_team(len(team.starts))
            return team
        except InputError as error:
            raise naming(error, case.name) from error

    def _team(self, case: Case) -> Team:
        world: World = self._world(case.world)
        if case.plan is not None:
            return self._planned(case)
        if case.starts is not None:
            if case.robots not in (None, len(case.starts)):
                raise UsageError(f"{case.robots} robots and {len(case.starts)} starts", fix="omit `robots`")
            starts = check_starts(np.array(case.starts), world.threat, case.name)
        elif world.starts is not None:
            if case.robots is None or case.robots > len(world.starts):
                check_same_team(case.robots, world.starts, world.source)
            starts = world.starts[: case.robots]  # smaller teams take the first starts, as in `size`
        else:
            count = case.robots if case.robots is not None else (world.team.robots or 1)
            starts, _ = place_starts(world, count, world.team.start)
        settings = case.choices.settings(world.team.settings, world.pace, case.name, by=world.source)
        return Team(world, starts, settings)

    def _planned(self, case: Case) -> Team:
        world, plan = self._plan(case.plan, case.world)
        if case.robots not in (None, len(plan.robots)) or case.starts is not None or case.choices.given():
            expected = f"its own {len(plan.robots)} robots, starts and settings"
            raise UsageError(f"{case.plan} with other robots, starts or settings", expected=expected)
        # External plans have no settings.
        return Team(world, plan.starts, plan.settings or Settings(), plan)


def _rules(team: Team, model: RolloutChoices) -> int:
    return rules_of(team.world, team.settings, closed=model.loop == "closed")


def run_key(team: Team, model: RolloutChoices) -> str:
    """The identity of a run: sha256, 64 hex digits, of all inputs of its rollouts. Nothing is planned."""
    # Keys and values of 0.3, so that its stores are resumed: also the version of the rules that concern such a team.
    drawn = {"loop": model.loop, "first_only": model.first_only, "seed": model.seed, "mode": "tolerance"}
    said = {"semantics": _rules(team, model), "team": team.identity, "model": drawn}
    return hashlib.sha256(canonical(said).encode()).hexdigest()


def _plan_hash(plan: Plan) -> str:
    """Hash of a plan file: its paths, and for an MRAC plan its allocation, settings and state to resume from."""
    width = plan.shape[1]
    paths = [[list(divmod(cell, width)) for cell in robot.path.tolist()] for robot in plan.robots]
    areas = [[area.level, area.robot, area.cells.tolist()] for area in plan.areas]
    settings = None if plan.settings is None else names_of_0_3(plan.settings.to_json())
    failures = [] if plan.failures.is_plain else [names_of_0_3(plan.failures.to_json())]
    begun = [] if plan.state is None else [plan.state.to_json()]
    return hashlib.sha256(canonical([paths, areas, settings, *failures, *begun]).encode()).hexdigest()


def canonical(value: object) -> str:
    """JSON with sorted keys and no spaces: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def format_label(value: Label) -> str:
    """A label's value as text."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def naming(error: InputError, case: str) -> InputError:
    """The error with the case in its source, of the same type."""
    if case in error.source:
        return error
    source = f"{case}: {error.source}" if error.source else case
    return type(error)(error.problem, source=source, expected=error.expected, fix=error.fix)


# The unit of work: one team, its models and the wanted rollout ids of each. A pure function.
#
# A task carries all inputs of its results and no settings of the machine: any order, process or machine gives the same
# counts.

ONCE_UNDER_WAY: dict[str, Any] = {
    "policy": DEFAULT, **dict.fromkeys(("risk_cap", "robot_value", "range", "recharge", "max_steps", "deadline")),
    **{name: getattr(Settings(), name) for name in BEARING},
}  # fmt: skip
"""Settings, at their defaults, that the areas at t = 0 do not depend on."""


@dataclass(frozen=True, eq=False)
class RunRequest:
    """Rollout ids of one model to simulate: `key` of the run (`run_key`), the model, and the ids."""

    key: str
    model: RolloutChoices
    ids: Ranges


@dataclass(frozen=True, eq=False)
class Task:
    """The team of a case, and its wanted rollouts; `ticket` identifies the task for its sender."""

    case: Case
    team: Team
    wanted: tuple[RunRequest, ...]
    ticket: int = 0


@dataclass(frozen=True, eq=False)
class RunResult:
    """The results of a task for one run.

    Attributes:
        key: of the run. what: its labels. facts: known without rollouts (`facts_of`).
        tallies: one for each aligned block of ids that was simulated, or part of a block.
    """

    key: str
    what: dict[str, Label]
    facts: Json
    tallies: tuple[Tally, ...]


Stream = Callable[[Iterable[Task]], Iterator[tuple[Task, list[RunResult]]]]
"""Runs tasks, taken from the iterable when a worker is free; yields each with its results, in any order."""


def run_task(task: Task) -> list[RunResult]:
    """Plan once, compute the tables once, and simulate every model's ids on one thread. Raises InputError."""
    try:
        closed = any(wanted.model.loop == "closed" for wanted in task.wanted)
        loops = _prepared(task.team, closed)
        return [_tasks_run(wanted, task, loops) for wanted in task.wanted]
    except InputError as error:
        raise naming(error, task.case.name) from error


def run_tasks(tasks: list[Task]) -> list[list[RunResult]]:
    """`run_task` for each task in order."""
    return [run_task(task) for task in tasks]


def _tasks_run(wanted: RunRequest, task: Task, loops: _Loops) -> RunResult:
    from planner.rollouts.engine import run_with_threshold_sums

    engine = loops.of(wanted.model)
    tallies = tuple(
        run_with_threshold_sums(engine, wanted.model.seed, start, stop - start)[0]
        if wanted.model.loop == "closed"
        else engine.tally(start, stop - start)
        for start, stop in cut(wanted.ids, BLOCK)
    )
    return RunResult(wanted.key, labels_of(task.case, task.team, wanted.model), loops.facts, tallies)


class _Loops:
    """The models of one plan, ready to simulate; they share the closed loop's tables.

    If these tables are needed anyway, the compiled simulator computes the nominal run too.
    """

    def __init__(self, team: Team, closed: bool) -> None:
        self._team = team
        self._closed: ClosedLoop | None = None
        known = team.world.draws is None  # the compiled nominal run needs a known true map
        if closed and known and team.plan is None and team.settings.plan_for == "closed_loop":
            from planner.rollouts.closed_loop import with_nominal_run

            # Teams that differ only in these settings share the allocation.
            alike = replace(team, settings=replace(team.settings, **ONCE_UNDER_WAY))
            problem, begun = _allocated(alike)
            own = problem if team.settings == alike.settings else None
            begun = replace(begun, settings=team.settings)
            self._closed = self._compiled(begun, own)
            self._plan = with_nominal_run(begun, self._closed)
        else:
            self._plan = team.build()
        self.facts = facts_of(team, self._plan, None if self._closed is None else self._closed.max_steps)

    def of(self, model: RolloutChoices) -> Engine:
        """The engine of a model, on one thread."""
        from planner.rollouts.engine import closed_loop_engine, open_loop_engine
        from planner.rollouts.open_loop import compile_plan

        world = self._team.world
        if model.loop == "open":
            return open_loop_engine(compile_plan(self._plan, world), model.seed, "numba", 1)
        return closed_loop_engine(self.closed(model), model.seed, "numba", threads=1)

    def closed(self, model: RolloutChoices) -> ClosedLoop:
        """The closed loop of a model."""
        if self._closed is None:
            self._closed = self._compiled(self._plan)
        loop = self._closed
        if model.first_only:
            loop = loop.again(identity=f"{loop.identity}!first_visit", first_only=True)
        return loop

    def _compiled(self, plan: Plan, problem: Problem | None = None) -> ClosedLoop:
        from planner.rollouts.closed_loop import compile_closed_loop

        kept = _of_world(self._team.world.sha256).pairs
        return compile_closed_loop(plan, self._team.world, kept=kept, problem=problem)


_prepared = lru_cache(maxsize=1)(_Loops)
"""Plan, facts and tables. The last team's are cached, for a run that is split into several tasks."""


@lru_cache(maxsize=1)
def _allocated(team: Team) -> tuple[Problem, Plan]:
    """The plan before its nominal run. The last one is cached, for other settings of a team on the same map."""
    from planner.make_plan import allocated

    kept = _of_world(team.world.sha256)
    kept.problem, plan = allocated(team.world, team.starts, team.settings, before=kept.problem)
    return kept.problem, plan


@dataclass
class _Kept:
    """Data that teams in one world share: distance tables, and the problem of the last team."""

    pairs: AllPairs
    problem: Problem | None = None


@lru_cache(maxsize=1)
def _of_world(world: str) -> _Kept:
    """The shared data of a world, by its hash; the last world's is cached."""
    from planner.rollouts.tables import AllPairs

    return _Kept(AllPairs())


def facts_of(team: Team, plan: Plan, most: int | None = None) -> Json:
    """Facts of a team's plan that need no rollouts, as JSON.

    Args:
        most: T_max, if it is known.

    Returns:
        `exact`: expectations of the open loop, in cells, steps and robots; None: unknown. `ideal_team`: upper bound in
        cells (docs/spec.md section 7); None: not valid for the failure model, or threats move. `rules`: the latest
        version of this release. `longest`: upper bound of a rollout's steps in either loop. `deadline`: only if it, not
        the step limit, ends rollouts. Stores of earlier releases lack the last three.
    """
    from analysis.theory.bounds import ideal_team
    from analysis.theory.exact import open_loop_exact
    from analysis.theory.verdicts import longest_run

    world, robots = team.world, len(team.starts)
    accessible = world.accessible(team.starts)
    threat = np.sort(world.met[accessible].astype(np.float64))
    exact = open_loop_exact(plan, world)
    values = {
        "visited": exact.visited, "survived": exact.survived, "time": exact.mean_time,
        "alive": float(exact.survival.sum()),
    }  # fmt: skip
    ideal = plan.failure_model.is_plain and world.uncertainty is None
    return {
        "shape": list(world.shape),
        "world": world.randomness_sha256,
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
        "nominal": {"outcome": plan.outcome, "time": plan.time, "shares": plan.shares},
        **({"deadline": plan.settings.deadline} if plan.settings and plan.ends_by_deadline else {}),
    }


# Tasks on a dask.distributed cluster: tcp:// without authentication, tls:// with dask's own configuration.
#
# Any process that can reach a scheduler at tcp:// can run code as its workers do and read their data. tls:// needs a
# key signed by the cluster's authority (`distributed.comm.tls` in dask's configuration, docs/sweeps.md).
#
# Tasks are pure, so a lost worker costs only its tasks: the scheduler gives them to another. Results return to the
# client, which writes the store; the cluster stores nothing.

CONNECT_SECONDS = 6.0
"""Time limit for a scheduler's response."""
WORKER_SECONDS = 60.0
"""Time limit for the arrival of the first worker."""
LOOK_SECONDS = 2.0
"""Interval at which the number of workers is updated."""


@contextmanager
def on_cluster(scheduler: str | Client) -> Iterator[Stream]:
    """A stream on the scheduler at this address, or of this client, which stays open. Raises UsageError."""
    try:
        from distributed import Client
    except ImportError:
        fix = 'pip install "mrac-jax[dask]", or use ' + argument("processes")
        raise UsageError("dask.distributed is not installed", fix=fix) from None
    named, quiet = f"{argument('scheduler')} {scheduler}", logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # dask logs arriving and leaving workers as errors
    try:
        if isinstance(scheduler, str):
            _check_scheduler(scheduler, named)
            opened: Any = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        elif not isinstance(scheduler, Client) or scheduler.asynchronous or scheduler.status != "running":
            expected = "the address of a dask scheduler, or a dask.distributed Client that is open and not asynchronous"
            raise UsageError(named, expected=expected)
        else:
            opened = nullcontext(scheduler)
        with opened as client:
            address = client.scheduler.address
            try:
                client.wait_for_workers(1, timeout=WORKER_SECONDS)
            except TimeoutError:
                raise UsageError(f"{named} has no workers", fix=f"start some with `dask worker {address}`") from None
            yield lambda tasks: _stream(client, tasks, address)
    finally:
        logging.disable(quiet)


def _check_scheduler(address: str, named: str) -> None:
    """Raise UsageError unless a scheduler responds at this address."""
    try:
        with ThreadPoolExecutor(1) as thread:  # this thread may have a running loop, as in a notebook
            kind = thread.submit(asyncio.run, asyncio.wait_for(_kind(address), CONNECT_SECONDS)).result()
        problem = "" if kind == "Scheduler" else f"a dask {kind}"
    except Exception as error:  # missing key files; a server of another kind may respond with anything
        problem = f"no scheduler responds ({type(error).__name__}: {error})"
    if problem:
        keys = "the keys distributed.comm.tls.ca-file, .client.key and .client.cert in dask's configuration"
        expected = f"tcp://host:8786, or tls://host:8786 with {keys}"
        fix = f"start one with `dask scheduler` (docs/sweeps.md), or use {argument('processes')}"
        raise UsageError(f"{named}: {problem}", expected=expected, fix=fix)


async def _kind(address: str) -> str:
    """The type of a dask server. A Client could ask too, but without a response it blocks for long."""
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, connection_args=Security().get_connection_args("client")) as server:
        return str((await server.identity())["type"])


def _stream(client: Client, tasks: Iterable[Task], where: str) -> Iterator[tuple[Task, list[RunResult]]]:
    """Submit tasks while workers are free, and yield results as they arrive."""
    from distributed import CancelledError, as_completed
    from distributed.scheduler import KilledWorker

    source, done = iter(tasks), as_completed(loop=client.loop)
    running: dict[str, tuple[Future, Task]] = {}
    room, looked = 0, 0.0
    try:
        while True:
            if time.monotonic() - looked > LOOK_SECONDS:
                room, looked = AHEAD * max(1, sum(client.ncores().values())), time.monotonic()
            while len(running) < room:
                task = next(source, None)
                if task is None:
                    break
                future = client.submit(run_task, task, pure=False)
                running[future.key] = future, task
                done.add(future)
            if not running:
                return
            future = next(done)
            _, task = running.pop(future.key)
            try:
                results = future.result()
            except KilledWorker:
                fix = "give the workers more memory, or use fewer of them"
                raise UsageError(f"{where}: several workers were lost at {task.case.name}", fix=fix) from None
            except (CancelledError, OSError) as error:
                fix = "finished results are in the store: run the same command again to continue"
                raise UsageError(f"{where} was lost ({type(error).__name__})", fix=fix) from None
            future.release()
            yield task, results
    finally:  # a given client stays open, so its tasks must be cancelled
        client.cancel([future for future, _ in running.values()])
