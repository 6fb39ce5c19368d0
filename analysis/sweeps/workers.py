"""Where tasks of a sweep run on this machine: in this process, or in a pool of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from analysis.kit.pool import Pool
from analysis.sweeps.tasks import RunResult, Task, run_task

Stream = Callable[[Iterable[Task]], Iterator[tuple[Task, list[RunResult]]]]
"""Runs tasks, taken from the iterable as there is room; yields each with its results, in any order."""


@contextmanager
def on_this_machine(count: int) -> Iterator[Stream]:
    """A stream in this process for a `count` of 1, else in so many processes."""
    if count == 1:
        yield lambda tasks: ((task, run_task(task)) for task in tasks)
        return
    with Pool(run_task, count, name=lambda task: task.name) as pool:
        yield pool.run
