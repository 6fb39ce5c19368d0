"""What a sweep runs: a case (world, team, plan), a model (how it is rolled out), and the key of the two together.

The key of a run is a hash of content: the threats, the starts, what the plan follows from, the model, its seed and the
version of the rules that it follows. Names of files, labels, the number of rollouts, the engine, and the machine are
not in it.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator
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
from analysis.utils.progress import run_loop
from planner.arguments import BLOCK, argument, is_whole
from planner.errors import InputError, UsageError
from planner.files import Json
from planner.plan.plan import Plan
from planner.plan_team import plan_team, read_plan_on
from planner.policies import DEFAULT
from planner.renamed import names_of_0_3
from planner.settings import BEARING, Choices, Settings
from planner.tally import Tally
from planner.world.features import BEFORE, NOW, RELEASES, as_before, rules_of
from planner.world.generate import PAPER_LEVELS, Kind, ThreatPattern, random_world
from planner.world.keys import Key
from planner.world.levels import check_same_team, place_starts
from planner.world.scenario import read_on, read_scenario
from planner.world.world import World, check_starts

if TYPE_CHECKING:
    from distributed import Client, Future

    from planner.mrac.problem import Problem
    from planner.rollouts.engine import Engine
    from planner.rollouts.loop import ClosedLoop
    from planner.rollouts.tables import AllPairs

# The worlds of a sweep: the paper's random ones, and those that a scenario describes. Hashable; made when needed.

MOST_MAPS = 1_000_000
"""Random maps of one run."""
BESIDE = ("prior_map", "sensor_range", "moving_threats", "phases", "plan_on", "latent_hazard", "map_uncertainty")
"""Keys of a scenario that a random map may have: what robots know of it, and how its threats change."""


def check_maps(maps: int, seed: int) -> None:
    """Raise UsageError unless the seeds `seed .. seed + maps - 1` are those of random maps."""
    if not is_whole(maps, 1, MOST_MAPS):
        raise UsageError(argument("maps", maps), expected=f"1 to {MOST_MAPS}")
    if not 0 <= seed <= 2**64 - maps:
        raise UsageError(argument("seed", seed), expected=f"0 to 2**64 - {maps}")


@dataclass(frozen=True)
class Generated:
    """One of the paper's random worlds (SPEC section 8), told or not; `seed` is the world's.

    Attributes:
        kind, areas, threat_levels, seed: as of `planner.world.generate.ThreatPattern`. size: rows, columns.
        ratio, obstacles: fractions of all cells that are dangerous, and that are obstacles.
        unsaid: keys of a scenario, those of BESIDE, as canonical JSON.
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
    """A world that a scenario describes.

    Attributes:
        scenario: the scenario file's keys as canonical JSON. source: the file that relative paths start from, and that
            messages name.
    """

    scenario: str
    source: str

    def world(self) -> World:
        """The world, with what the scenario says of its team. Raises InputError."""
        source = Path(self.source)
        return read_scenario(Key(json.loads(self.scenario), "", source), source)


RULES = "rules"
"""The label of runs whose rules an earlier release had otherwise (`planner.world.features`), and of those of that
release."""
REMEMBERED = 4
"""Worlds that `Places` keeps: the next case is mostly another team in the same one."""
Label = str | int | float | bool | None


@dataclass(frozen=True)
class Case:
    """World, team and plan.

    Attributes:
        world: where. robots: how many, placed by the start rule; None: as many as the scenario says, else 1.
        starts: (row, col) of each robot, instead of `robots`; None: the scenario's, else the start rule's.
        choices: the planner's settings, those that are given. plan: a plan file to run instead of planning.
        labels: what the results are found by, (name, value); no part of the case's identity.
    """

    world: Generated | Written
    robots: int | None = None
    starts: tuple[tuple[int, int], ...] | None = None
    choices: Choices = Choices()  # noqa: RUF009 (frozen)
    plan: str | None = None
    labels: tuple[tuple[str, Label], ...] = field(default=(), compare=False)

    @property
    def name(self) -> str:
        """The labels, as messages name the case."""
        return " ".join(f"{name}={value}" for name, value in self.labels) or "case"


@dataclass(frozen=True, eq=False)
class Team:
    """A case made ready for planning. `starts` is int64 `[K, 2]`; `plan`: from a file, else None."""

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    plan: Plan | None = None

    @cached_property
    def identity(self) -> str:
        """Hash of all that its plan follows from."""
        said = {
            "shape": list(self.world.shape),
            "world": self.world.luck_sha256,
            "starts": self.starts.tolist(),
            "plan": names_of_0_3(self.settings.to_json()) if self.plan is None else _plan_hash(self.plan),
        }
        return hashlib.sha256(canonical(said).encode()).hexdigest()

    def build(self) -> Plan:
        """Its plan. Raises InputError."""
        return plan_team(self.world, self.starts, self.settings) if self.plan is None else self.plan


def labels_of(case: Case, team: Team, model: RolloutChoices) -> dict[str, Label]:
    """What a run is found by: the case's labels, the number of robots, how it is rolled out."""
    checks = "first_visit" if model.first_only else "every_visit"
    drawn: dict[str, Label] = {"loop": model.loop, "threat_checks": checks}
    told = dict(case.labels) | {"robots": len(team.starts)} | drawn | {"rollout_seed": model.seed}
    rules = _rules(team, model)
    return told if rules == BEFORE else told | {RULES: RELEASES[rules]}


def generated_case(
    kind: Kind = "contiguous",
    ratio: float = 0.25,
    robots: int = 1,
    seed: int = 0,
    size: tuple[int, int] = (20, 20),
    *,
    choices: Choices | None = None,
) -> Case:
    """The team of `robots` on the paper's random world with this seed."""
    labels = (("kind", kind), ("ratio", ratio), ("robots", robots), ("map", seed))
    return Case(Generated(kind, ratio, seed, size), robots, choices=choices or Choices(), labels=labels)


class Places:
    """Makes teams of cases; keeps the last few worlds, so that a world's teams follow each other at no cost."""

    def __init__(self) -> None:
        self._world = lru_cache(REMEMBERED)(lambda where: where.world())
        self._plan = lru_cache(REMEMBERED)(lambda path, where: read_plan_on(path, self._world(where)))

    def team(self, case: Case) -> Team:
        """The case's world, starts and settings. Raises InputError naming the case."""
        return self._checked(case, lambda world: world)

    def earlier_key(self, case: Case, team: Team, model: RolloutChoices) -> str | None:
        """The key of the run as releases before 0.4 made it; None where their rules for it are today's.

        `team`: the case's.
        """
        if _rules(team, model) == BEFORE:
            return None
        return run_key(self._checked(case, as_before), model, BEFORE)

    def _checked(self, case: Case, of: Callable[[World], World]) -> Team:
        try:
            team = self._team(case, of)
            team.world.check_alike("a sweep")
            team.settings.check_alike("a sweep")
            team.settings.check_team(len(team.starts))
            return team
        except InputError as error:
            raise naming(error, case.name) from error

    def _team(self, case: Case, of: Callable[[World], World]) -> Team:
        world: World = of(self._world(case.world))
        if case.plan is not None:
            return self._planned(case)
        if case.starts is not None:
            if case.robots not in (None, len(case.starts)):
                raise UsageError(f"{case.robots} robots and {len(case.starts)} starts", fix="leave robots out")
            starts = check_starts(np.array(case.starts), world.threat, case.name)
        elif world.starts is not None:
            if case.robots is None or case.robots > len(world.starts):
                check_same_team(case.robots, world.starts, world.source)
            starts = world.starts[: case.robots]  # as `size` has it
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
        return Team(world, plan.starts, plan.settings or Settings(), plan)


def _rules(team: Team, model: RolloutChoices) -> int:
    return rules_of(team.world, team.settings, closed=model.loop == "closed")


def run_key(team: Team, model: RolloutChoices, rules: int | None = None) -> str:
    """The identity of a run: sha256, as 64 hex digits, of all that its rollouts follow from. Cheap: nothing planned.

    `rules`: the version that it follows; None: today's for such a team (`planner.world.features.rules_of`), so that
    runs which
    no change of the rules concerns keep their keys.
    """
    drawn = {"loop": model.loop, "first_only": model.first_only, "seed": model.seed, "mode": "tolerance"}
    said = {"semantics": rules or _rules(team, model), "team": team.identity, "model": drawn}
    return hashlib.sha256(canonical(said).encode()).hexdigest()


def _plan_hash(plan: Plan) -> str:
    """Of a plan file: its paths, and for one of ours the allocation and the settings that the closed loop goes by, and
    the state that it goes on from."""
    width = plan.shape[1]
    paths = [[list(divmod(cell, width)) for cell in robot.path.tolist()] for robot in plan.robots]
    areas = [[area.level, area.robot, area.cells.tolist()] for area in plan.areas]
    settings = None if plan.settings is None else names_of_0_3(plan.settings.to_json())
    bears = [] if plan.bears.is_plain else [names_of_0_3(plan.bears.to_json())]
    begun = [] if plan.state is None else [plan.state.to_json()]
    return hashlib.sha256(canonical([paths, areas, settings, *bears, *begun]).encode()).hexdigest()


def canonical(value: object) -> str:
    """JSON with sorted keys and no blanks: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def shown(value: Label) -> str:
    """A label's value as text."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def naming(error: InputError, case: str) -> InputError:
    """The same error, of the same kind, naming the case first."""
    if case in error.source:
        return error
    source = f"{case}: {error.source}" if error.source else case
    return type(error)(error.problem, source=source, expected=error.expected, fix=error.fix)


# The unit of work: one team with its models and the rollout ids wanted of each; a pure function, wherever it runs.
#
# A task carries all that its results depend on, and no settings of the machine: run twice, in another
# order, by another process or on another machine, it gives the same counts.

ONCE_UNDER_WAY: dict[str, Any] = {
    "policy": DEFAULT, **dict.fromkeys(("risk_cap", "robot_value", "range", "recharge", "max_steps", "deadline")),
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
        return [_tasks_run(wanted, task, loops) for wanted in task.wanted]
    except InputError as error:
        raise naming(error, task.case.name) from error


def run_tasks(tasks: list[Task]) -> list[list[RunResult]]:
    """`run_task` of one after the other."""
    return [run_task(task) for task in tasks]


def _tasks_run(wanted: Wanted, task: Task, loops: _Loops) -> RunResult:
    from planner.rollouts.engine import run_by_luck

    engine = loops.of(wanted.model)
    controlled = wanted.model.loop == "closed"
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
        if closed and known and team.plan is None and team.settings.plan_for == "closed_loop":
            from planner.rollouts.closed_loop import with_nominal_run

            alike = replace(team, settings=replace(team.settings, **ONCE_UNDER_WAY))
            problem, begun = _allocated(_Same(alike.identity, alike))
            own = problem if team.settings == alike.settings else None
            begun = replace(begun, settings=team.settings)
            self._closed = self._compiled(begun, own)
            self._plan = with_nominal_run(begun, self._closed)
        else:
            self._plan = team.build()
        self.facts = facts_of(team, self._plan, None if self._closed is None else self._closed.max_steps)

    def of(self, model: RolloutChoices) -> Engine:
        """What rolls a model out, on one thread."""
        from planner.rollouts.engine import closed_loop_engine, open_loop_engine
        from planner.rollouts.open_loop import compile_plan

        world = self._team.world
        if model.loop == "open":
            return open_loop_engine(compile_plan(self._plan, world), model.seed, "numba", 1)
        return closed_loop_engine(self.closed(model), model.seed, "numba", threads=1)

    def closed(self, model: RolloutChoices) -> ClosedLoop:
        """A model's closed loop."""
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
    from planner.make_plan import allocated

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
    from planner.rollouts.tables import AllPairs

    return _Kept(AllPairs())


def exact_means(loop: ClosedLoop, seconds: float) -> Json | None:
    """Means of the figures of a closed loop, cells, steps, robots and a chance; None where its tree is too dear."""
    from analysis.estimators.trial import Known, tree_of

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
    from analysis.theory.verdicts import longest_run

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


# Tasks on a dask.distributed cluster that runs elsewhere: tcp:// as it is, tls:// by dask's own configuration.
#
# Whoever can reach a scheduler at tcp:// can run code as its workers and read what they send; at tls:// it takes a key
# that the cluster's authority has signed (`distributed.comm.tls` in dask's configuration, docs/sweeps.md).
#
# Tasks are pure, so a worker that is lost costs its tasks alone: the scheduler gives them to another. Results come back
# to the client, which writes the store; nothing is kept on the cluster.

CONNECT_SECONDS = 6.0
"""How long a scheduler has to answer."""
WORKER_SECONDS = 60.0
"""How long the first worker may take to come."""
LOOK_SECONDS = 2.0
"""How often the number of workers is asked for: they may come and go."""


@contextmanager
def on_cluster(scheduler: str | Client) -> Iterator[Stream]:
    """A stream on the scheduler at this address, or of this client, which stays open. Raises UsageError."""
    try:
        from distributed import Client
    except ImportError:
        fix = 'pip install "mrac-jax[dask]", or use ' + argument("processes")
        raise UsageError("dask.distributed is not installed", fix=fix) from None
    named, quiet = f"{argument('scheduler')} {scheduler}", logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # workers that come and go are no news for whoever waits for a result
    try:
        if isinstance(scheduler, str):
            _check_scheduler(scheduler, named)
            opened: Any = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        else:
            _check_client(scheduler, Client, named)
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


def _check_client(given: object, kind: type, named: str) -> None:
    """Raise UsageError unless `given` is an open client whose calls wait for their answer."""
    expected = "the address of a dask scheduler, or a dask.distributed Client that is open and not asynchronous"
    if not isinstance(given, kind):
        raise UsageError(named, expected=expected)
    client: Any = given
    if client.asynchronous or client.status != "running":
        raise UsageError(f"{named}, {'asynchronous' if client.asynchronous else client.status}", expected=expected)


def _check_scheduler(scheduler: str, named: str) -> None:
    """Raise UsageError unless a scheduler answers at this address."""
    if scheduler.startswith("tls://"):
        _check_keys(named)
    try:
        answers = _cluster_run(asyncio.wait_for(_identity(scheduler), CONNECT_SECONDS))
    except Exception as error:  # whatever listens there may say anything
        fix = f"start one with `dask scheduler`, or use {argument('processes')}"
        expected = "an address, as tls://host:8786 or tcp://host:8786"
        problem = f"{named}: no scheduler answers ({type(error).__name__})"
        raise UsageError(problem, expected=expected, fix=fix) from None
    if answers != "Scheduler":
        raise UsageError(f"{named} is a dask {answers}", expected="the address of a scheduler")


def _cluster_run(main: Coroutine[Any, Any, str]) -> str:
    """`run_loop`, in another thread where this one has a loop already, as a notebook's has."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return run_loop(main)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(run_loop, main).result()


def _check_keys(named: str) -> None:
    """Raise UsageError unless dask's configuration names files to meet a tls:// scheduler with."""
    from distributed.security import Security

    try:
        ready, problem = Security().get_connection_args("client").get("ssl_context") is not None, "no key is named"
    except OSError as error:  # of the files, or what is in them
        ready, problem = False, " ".join(str(error).split())
    if not ready:
        raise UsageError(
            f"{named}: {problem}",
            expected="distributed.comm.tls.ca-file, .client.key and .client.cert in dask's configuration",
            fix="see docs/sweeps.md",
        )


async def _identity(address: str) -> str:
    """What a dask server says that it is. A Client asks too, but one that gets no answer lingers for long."""
    from distributed.core import connect
    from distributed.security import Security

    comm = await connect(address, timeout=CONNECT_SECONDS, **Security().get_connection_args("client"))
    try:
        await comm.write({"op": "identity", "reply": True})
        return str((await comm.read())["type"])
    finally:
        comm.abort()


def _stream(client: Client, tasks: Iterable[Task], where: str) -> Iterator[tuple[Task, list[RunResult]]]:
    """Tasks as there is room for them, results as they come."""
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
                raise UsageError(f"{where}: worker after worker was lost at {task.case.name}", fix=fix) from None
            except (CancelledError, OSError) as error:
                fix = "what was done is in the store: run the same command again to go on"
                raise UsageError(f"{where} was lost ({type(error).__name__})", fix=fix) from None
            future.release()
            yield task, results
    finally:  # of a client that stays open, too
        client.cancel([future for future, _ in running.values()])
