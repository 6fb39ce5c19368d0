"""Runs cases into a store: skips what it has, keeps a few tasks in flight, and writes each result as it comes.

Only this process writes the store; workers are handed tasks and hand back counts. Whoever is killed, the store holds
whole results, and the same call again does what is missing. Memory does not grow with the number of cases: jobs are
taken from the iterable one by one.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING

from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import (
    RULES,
    Case,
    Label,
    Places,
    RunResult,
    Stream,
    Task,
    Team,
    Wanted,
    canonical,
    labels_of,
    run_key,
    run_task,
    run_tasks,
)
from analysis.sweeps.store import Run, Store
from analysis.sweeps.store_files import cut
from analysis.utils.pool import Pool, wanted_processes
from planner.arguments import BLOCK, MOST_ROLLOUTS
from planner.errors import UsageError
from planner.formatting import counted
from planner.world.features import BEFORE, NOW, RELEASES

if TYPE_CHECKING:
    from distributed import Client

SHARE = 16_384
"""Rollouts of a model in one task on a map of at most 400 cells; fewer on larger ones, where each takes longer."""
LEAST_SHARE = 64
BATCH, FEW = 12, 4_096
"""Tasks that a process is handed at a time, at most, and rollouts on 400 cells in all of them: a task of few takes
less time than a process's answer to it, and teams in one world hand that over once."""


@dataclass(frozen=True)
class Job:
    """A case with its models, and the first `rollouts` ids of each; `tag` is whoever asks's own.

    `exact_seconds`: of looking for the closed loops' exact values, about, which rows then go by (`tasks.exact_means`).
    """

    case: Case
    models: tuple[RolloutChoices, ...]
    rollouts: int
    tag: int = 0
    exact_seconds: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.rollouts <= MOST_ROLLOUTS:
            raise UsageError(f"{self.rollouts} rollouts", expected=f"1 to {MOST_ROLLOUTS}")


@dataclass(frozen=True)
class Done:
    """Where a sweep stands, and the job that has just been finished.

    Attributes:
        jobs: finished, of `total` (0: not known). job: the last one; keys: of its runs, one a model.
        rollouts: run by now. seconds: since the start.
    """

    jobs: int
    total: int
    job: Job
    keys: tuple[str, ...]
    rollouts: int
    seconds: float


@dataclass(frozen=True)
class Finished:
    """How a sweep ended: jobs finished, rollouts run and reused, seconds; `partial`: interrupted.

    `earlier`: runs that the store holds by the rules of an earlier release too, which are left alone.
    """

    jobs: int
    rollouts: int
    reused: int
    seconds: float
    partial: bool = False
    earlier: int = 0

    @property
    def said(self) -> str:
        """In a line."""
        return f"{self.seconds:.0f} s: {counted(self.rollouts, 'rollout')} run, {self.reused:,} from the store"


class Swept(Answer):
    """An answer that a sweep gave; `finished`: how it ended."""

    finished: Finished

    @property
    def partial(self) -> bool:  # type: ignore[override]
        """It was interrupted."""
        return self.finished.partial


def run_cases(
    jobs: Iterable[Job],
    store: Store,
    *,
    processes: int | None = None,
    scheduler: str | Client | None = None,
    total: int = 0,
    progress: Callable[[Done], None] | None = None,
) -> Finished:
    """Run every job's missing ids into the store. No count depends on how: the same ids give the same tallies.

    Args:
        jobs: taken one by one, so it may be endless as long as somebody interrupts. store: where results go.
        processes: of this machine (None: one a core; 1: this process).
        scheduler: a dask.distributed scheduler to run on instead: its address, or an open client of it.
        total: number of jobs, for `progress`, if it is known.
        progress: called after every job.

    An interruption (KeyboardInterrupt) ends it; what was finished is in the store and the answer says `partial`.
    Raises InputError naming the case, StoreError, UsageError for a cluster that is not there.
    """
    run = _Run(store, total, progress)
    try:
        with _stream(processes, scheduler, total) as stream:
            todo: Iterable[Job] = jobs
            while todo:
                run.again = []
                for task, results in stream(run.tasks(todo)):
                    run.take(task, results)
                todo = run.again
    except KeyboardInterrupt:
        return run.finished(partial=True)
    return run.finished()


def check_where(processes: int | None, scheduler: str | Client | None) -> None:
    """Raise UsageError where `run_cases` cannot run: for whoever makes a store for what it gives."""
    wanted_processes(processes, 0)
    if scheduler is not None:
        with _stream(processes, scheduler, 0):
            pass


@contextmanager
def _stream(processes: int | None, scheduler: str | Client | None, total: int) -> Iterator[Stream]:
    """What runs tasks: a cluster, this process, or so many of this machine."""
    if scheduler is not None:
        from analysis.sweeps.cases import on_cluster

        if processes is not None:
            raise UsageError("processes and scheduler are given", expected="one of them")
        with on_cluster(scheduler) as stream:
            yield stream
        return
    count = wanted_processes(processes, total)
    if count == 1:
        yield lambda tasks: ((task, run_task(task)) for task in tasks)
        return
    with Pool(run_tasks, count, name=lambda batch: batch[0].case.name) as pool:
        yield lambda tasks: (
            pair for few, answers in pool.run(_batches(tasks)) for pair in zip(few, answers, strict=True)
        )


def _batches(tasks: Iterable[Task]) -> Iterator[list[Task]]:
    """The tasks in their order, BATCH at a time or FEW rollouts."""
    batch, load = list[Task](), 0
    for task in tasks:
        rollouts = sum(stop - start for wanted in task.wanted for start, stop in wanted.ids)
        more = rollouts * max(400, task.team.world.threat.size) // 400
        if batch and (len(batch) == BATCH or load + more > FEW):
            yield batch
            batch, load = [], 0
        batch.append(task)
        load += more
    if batch:
        yield batch


@dataclass
class _Open:
    """A job of which tasks are still out."""

    job: Job
    keys: tuple[str, ...]
    left: int
    lost: bool = False


@dataclass
class _Run:
    """The state of one call of `run_cases`."""

    store: Store
    total: int
    progress: Callable[[Done], None] | None
    clock: float = field(default_factory=time.perf_counter)
    again: list[Job] = field(default_factory=list)
    out: dict[int, _Open] = field(default_factory=dict)
    places: Places = field(default_factory=Places)
    ticket: int = 0
    jobs: int = 0
    rollouts: int = 0
    reused: int = 0
    earlier: int = 0

    def tasks(self, jobs: Iterable[Job]) -> Iterator[Task]:
        """The tasks of one job after the other; a job that lacks nothing is finished on the spot."""
        for job in jobs:
            team = self.places.team(job.case)
            wanted = [self._wanted(job, team, model) for model in job.models]
            keys = tuple(each.key for each in wanted)
            split = _split([each for each in wanted if each.ids], share_of(team))
            if not split:
                self._finish(job, keys)
                continue
            self.ticket += 1
            ticket = self.ticket
            self.out[ticket] = _Open(job, keys, len(split))
            for part in split:
                yield Task(job.case, team, part, ticket)

    def _wanted(self, job: Job, team: Team, model: RolloutChoices) -> Wanted:
        key, before = run_key(team, model), self.places.earlier_key(job.case, team, model)
        if before is not None and self.store.held(before):
            self.earlier += 1
            self.store.label(before, {RULES: RELEASES[BEFORE]})
        missing = self.store.missing(key, 0, job.rollouts)
        held = job.rollouts - sum(stop - start for start, stop in missing)
        if held:
            self.reused += held
            self.store.label(key, labels_of(job.case, team, model))
        return Wanted(key, model, missing, job.exact_seconds)

    def take(self, task: Task, results: list[RunResult]) -> None:
        """Keep a task's results; finish its job when it was the last one."""
        opened = self.out[task.ticket]
        opened.lost |= bool(self.store.add(results))
        opened.left -= 1
        self.rollouts += sum(tally.rollouts for result in results for tally in result.tallies)
        if opened.left:
            return
        del self.out[task.ticket]
        if opened.lost:
            self.again.append(opened.job)
        else:
            self._finish(opened.job, opened.keys)

    def _finish(self, job: Job, keys: tuple[str, ...]) -> None:
        self.jobs += 1
        if self.progress is not None:
            seconds = time.perf_counter() - self.clock
            self.progress(Done(self.jobs, self.total, job, keys, self.rollouts, seconds))

    def finished(self, partial: bool = False) -> Finished:
        """How it ended."""
        seconds = time.perf_counter() - self.clock
        return Finished(self.jobs, self.rollouts, self.reused, seconds, partial, self.earlier)


def share_of(team: Team) -> int:
    """Rollouts of a model in one task: whole blocks where rollouts are quick. No count depends on it."""
    share = SHARE * 400 // max(400, team.world.threat.size)
    return share // BLOCK * BLOCK if share >= BLOCK else max(share, LEAST_SHARE)


def _split(wanted: list[Wanted], share: int) -> list[tuple[Wanted, ...]]:
    """The wanted ids in tasks of at most `share` a model, cut at multiples of `share`."""
    tasks: dict[int, list[Wanted]] = {}
    for each in wanted:
        for number, ids in groupby(cut(each.ids, share), lambda part: part[0] // share):
            tasks.setdefault(number, []).append(replace(each, ids=tuple(ids)))
    return [tuple(tasks[number]) for number in sorted(tasks)]


# Runs of a store that follow rules which a later release changed (`planner.world.features`): told apart, and never
# mixed.
#
# Runs by the rules of release 0.4, where an earlier release had others, have the label RULES. A sweep gives this label
# to
# the earlier runs that it leaves alone, and so it is with other runs of the same setting, which differ in the map
# alone.

MAP_LABELS = ("map", "rollout_seed")
"""Labels that tell the maps of a setting apart; all others tell settings apart."""
EARLIER, LATEST = RELEASES[BEFORE], RELEASES[NOW]
DETECTOR = re.compile(r"~[0-9a-f]+\[.+\]")
"""In the identity of a world whose robots have a detector."""
CHANGES = "?"
"""In the identity of a world whose threats change, move, or are in doubt."""


def setting_of(what: Mapping[str, Label]) -> str:
    """What all maps of a run's setting share."""
    return canonical({name: value for name, value in what.items() if name not in (*MAP_LABELS, RULES)})


class Older:
    """What is known of a store's runs by earlier rules. `settings`: those of which it has runs by the latest rules."""

    def __init__(self, store: Store) -> None:
        self.settings = {setting_of(what) for what in store.labels() if what.get(RULES) == LATEST}

    def labelled(self, run: Run) -> Run:
        """The run with the label EARLIER, if that is what it is."""
        if RULES in run.what or setting_of(run.what) not in self.settings:
            return run
        return replace(run, what=run.what | {RULES: EARLIER})


def is_older(run: Run, store: Store, homes: dict[str, bool]) -> bool | None:
    """Whether a run without the label RULES follows rules that release 0.4 changed; None: it may.

    `homes`: by setting whether robots come home, of settings that were asked about: a block is read for the first.
    """
    what, world = run.what, str(run.facts["world"])
    if what.get("loop") == "closed":
        if DETECTOR.search(world) or what.get("return_to") is not None:
            return True
        setting = setting_of(what)
        if setting not in homes:
            tally = store.tally(run.key)
            homes[setting] = tally is not None and len(tally.home) > 0
        if homes[setting]:
            return True
    told = what.get("plan_on")
    if what.get("phases") is not None:
        return told in (None, "now")
    if what.get("moving_threats") is not None:
        return told is None
    in_doubt = any(what.get(name) is not None for name in ("latent_hazard", "map_uncertainty"))
    return None if CHANGES in world and not in_doubt else False


def older_note(sure: int, unsure: int) -> list[str]:
    """What is to be said of so many runs that follow, and that may follow, rules which release 0.4 changed."""
    if not sure + unsure:
        return []
    follow = "follows" if sure == 1 else "follow"
    parts = [f"{counted(sure, 'run')} {follow} rules that release 0.4 changed"] if sure else []
    parts += [f"{counted(unsure, 'run')} may, if threats change with time or `plan_on` is left out"] if unsure else []
    changed = "phases, detectors, return home, moving threats"
    return [f"{', and '.join(parts)} ({changed}): run the sweep again to renew them"]
