"""Runs cases into a store: skips stored rollouts, keeps a few tasks in flight, and stores each result as it arrives.

Only this process writes the store; workers receive tasks and return counts. After a kill the store holds complete
results, and the same call continues. Memory does not grow with the number of cases: jobs are taken one by one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING

from analysis.report.result import Result
from analysis.sampling import RolloutChoices
from analysis.sweeps import cases
from analysis.sweeps.store import Run, Store
from analysis.sweeps.store_files import cut
from analysis.utils.pool import Pool, wanted_processes
from planner.arguments import BLOCK, MOST_ROLLOUTS
from planner.errors import UsageError
from planner.formatting import counted

if TYPE_CHECKING:
    from distributed import Client

SHARE = 16_384
"""Rollouts of a model in one task on a map of at most 400 cells; fewer on larger maps, where each takes longer."""
LEAST_SHARE = 64
BATCH, FEW = 12, 4_096
"""Largest number of tasks in one message to a process, and of rollouts on 400 cells in all of them: small tasks take
less time than their message, and teams in one world then share its data."""


@dataclass(frozen=True)
class Job:
    """A case with its models, and the first `rollouts` ids of each; `tag` is the caller's."""

    case: cases.Case
    models: tuple[RolloutChoices, ...]
    rollouts: int
    tag: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.rollouts <= MOST_ROLLOUTS:
            raise UsageError(f"{self.rollouts} rollouts", expected=f"1 to {MOST_ROLLOUTS}")


@dataclass(frozen=True)
class Done:
    """Progress of a sweep, and the job that has just been finished.

    Attributes:
        jobs: finished, of `total` (0: unknown). job: the last one; keys: of its runs, one for each model.
        rollouts: simulated so far. seconds: since the start.
    """

    jobs: int
    total: int
    job: Job
    keys: tuple[str, ...]
    rollouts: int
    seconds: float


@dataclass(frozen=True)
class Finished:
    """Summary of a sweep: jobs finished, rollouts simulated and reused, seconds; `partial`: interrupted."""

    jobs: int
    rollouts: int
    reused: int
    seconds: float
    partial: bool = False
    json_keys = "seconds rollouts_run=rollouts rollouts_reused=reused"

    @property
    def description(self) -> str:
        """One line for reports."""
        return f"{self.seconds:.0f} s: {counted(self.rollouts, 'rollout')} run, {self.reused:,} from the store"


class Swept(Result):
    """A result of a sweep; `finished`: its summary."""

    finished: Finished
    json_keys = "*finished"

    @property
    def partial(self) -> bool:  # type: ignore[override]
        """Whether it was interrupted."""
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
    """Simulate every job's missing ids into the store. Counts do not depend on processes, batches or order.

    Args:
        jobs: taken one by one; the iterable may be endless if the caller interrupts. store: for the results.
        processes: on this machine (None: one for each core; 1: this process).
        scheduler: a dask.distributed scheduler instead: its address, or an open client.
        total: number of jobs, for `progress`, if it is known.
        progress: called after every job.

    Returns:
        The summary. After an interruption (KeyboardInterrupt) it is `partial`; finished results are stored.

    Raises:
        InputError: names the case. StoreError. UsageError: a cluster that does not respond.
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
    """Raise UsageError if `run_cases` cannot run, before a store is created for it."""
    wanted_processes(processes, 0)
    if scheduler is not None:
        with _stream(processes, scheduler, 0):
            pass


@contextmanager
def _stream(processes: int | None, scheduler: str | Client | None, total: int) -> Iterator[cases.Stream]:
    """The stream of tasks: on a cluster, in this process, or in several processes of this machine."""
    if scheduler is not None:
        if processes is not None:
            raise UsageError("processes and scheduler are given", expected="one of them")
        with cases.on_cluster(scheduler) as stream:
            yield stream
        return
    count = wanted_processes(processes, total)
    if count == 1:
        yield lambda tasks: ((task, cases.run_task(task)) for task in tasks)
        return
    with Pool(cases.run_tasks, count, name=lambda batch: batch[0].case.name) as pool:
        yield lambda tasks: (
            pair for few, answers in pool.run(_batches(tasks)) for pair in zip(few, answers, strict=True)
        )


def _batches(tasks: Iterable[cases.Task]) -> Iterator[list[cases.Task]]:
    """The tasks in order, in batches of at most BATCH tasks or FEW rollouts."""
    batch, load = list[cases.Task](), 0
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
    """A job with unfinished tasks."""

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
    places: cases.Places = field(default_factory=cases.Places)
    ticket: int = 0
    jobs: int = 0
    rollouts: int = 0
    reused: int = 0

    def tasks(self, jobs: Iterable[Job]) -> Iterator[cases.Task]:
        """The tasks of one job after the other; a job without missing ids is finished at once."""
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
                yield cases.Task(job.case, team, part, ticket)

    def _wanted(self, job: Job, team: cases.Team, model: RolloutChoices) -> cases.RunRequest:
        key = cases.run_key(team, model)
        missing = self.store.missing(key, 0, job.rollouts)
        held = job.rollouts - sum(stop - start for start, stop in missing)
        if held:
            self.reused += held
            self.store.label(key, cases.labels_of(job.case, team, model))
        return cases.RunRequest(key, model, missing)

    def take(self, task: cases.Task, results: list[cases.RunResult]) -> None:
        """Store a task's results; finish its job after its last task."""
        opened = self.out[task.ticket]
        # Another process may have stored overlapping ids meanwhile: the job then runs again.
        opened.lost |= bool(self.store.add(results))
        opened.left -= 1
        self.rollouts += sum(tally.rollouts for result in results for tally in result.tallies)
        # A job is finished only after its last task.
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
        """The summary."""
        seconds = time.perf_counter() - self.clock
        return Finished(self.jobs, self.rollouts, self.reused, seconds, partial)


def share_of(team: cases.Team) -> int:
    """Rollouts of a model in one task: whole blocks if rollouts are fast. Counts do not depend on it."""
    share = SHARE * 400 // max(400, team.world.threat.size)
    # Whole blocks avoid a merge of two parts of one block in the store.
    return share // BLOCK * BLOCK if share >= BLOCK else max(share, LEAST_SHARE)


def _split(wanted: list[cases.RunRequest], share: int) -> list[tuple[cases.RunRequest, ...]]:
    """The wanted ids in tasks of at most `share` for each model, cut at multiples of `share`."""
    tasks: dict[int, list[cases.RunRequest]] = {}
    for each in wanted:
        for number, ids in groupby(cut(each.ids, share), lambda part: part[0] // share):
            tasks.setdefault(number, []).append(replace(each, ids=tuple(ids)))
    return [tuple(tasks[number]) for number in sorted(tasks)]


# Runs whose simulation rules a later release changed (`planner.world.scenario_features`) are never mixed with others.
#
# Runs that follow rules changed in 0.4 have the label RULES. `results` infers the label of earlier runs of the same
# setting, which differ only in the map.

MAP_LABELS = ("map", "rollout_seed")
"""Labels that distinguish maps of one setting; all others distinguish settings."""
EARLIER = "before 0.4"
"""The label RULES of earlier runs."""


def setting_of(what: Mapping[str, cases.Label]) -> str:
    """Identity of a run's setting, common to all maps."""
    return cases.canonical({name: value for name, value in what.items() if name not in (*MAP_LABELS, cases.RULES)})


def runs_by_rules(store: Store) -> Iterator[Run]:
    """All runs; those by earlier rules than others of their setting get the label EARLIER."""
    latest = {setting_of(what) for what in store.labels() if what.get(cases.RULES) == cases.LATEST}
    for run in store.runs():
        is_earlier = cases.RULES not in run.what and setting_of(run.what) in latest
        yield replace(run, what=run.what | {cases.RULES: EARLIER}) if is_earlier else run
