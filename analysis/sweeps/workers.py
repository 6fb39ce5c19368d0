"""Where tasks run on this machine: in this process, or in processes that end with it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process

from analysis.sweeps.tasks import RunResult, Task, run_task
from mrac_jax.open_loop.counts import available_cores
from planner.errors import UsageError

Stream = Callable[[Iterable[Task]], Iterator[tuple[Task, list[RunResult]]]]
"""Runs tasks, taken from the iterable as there is room; yields each with its results, in any order."""
MOST_PROCESSES = 1024
AHEAD = 3
"""Tasks in flight for each process."""
MOST_DEATHS = 3
"""How often in a row processes may end before a task is done."""


def wanted_processes(processes: int | None, total: int) -> int:
    """How many processes to use for `total` jobs (0: not known). Raises UsageError."""
    if processes is not None and not 1 <= processes <= MOST_PROCESSES:
        raise UsageError(f"--processes {processes}", expected=f"1 to {MOST_PROCESSES}")
    count = processes or available_cores()
    return min(count, total) if total and processes is None else count


def in_process(tasks: Iterable[Task]) -> Iterator[tuple[Task, list[RunResult]]]:
    """One after the other, in this process."""
    for task in tasks:
        yield task, run_task(task)


@contextmanager
def in_processes(count: int) -> Iterator[Stream]:
    """On `count` fresh processes (a fork would copy locks). One that is killed costs what was in flight."""
    pools = [_pool(count)]

    def stream(tasks: Iterable[Task]) -> Iterator[tuple[Task, list[RunResult]]]:
        source, running, deaths = iter(tasks), {}, 0
        while True:
            lost: list[Task] = []
            for task in source:
                running[_submit(pools, task)] = task
                if len(running) >= AHEAD * count:
                    break
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    results = future.result()
                except BrokenProcessPool:
                    lost.append(task)
                    continue
                deaths = 0
                yield task, results
            if lost:
                deaths += 1
                lost += running.values()
                if deaths > MOST_DEATHS:
                    problem = f"processes were killed {deaths} times in a row, at {lost[0].name}"
                    raise UsageError(problem, fix="use fewer --processes if memory is short")
                _replace(pools, count)
                running = {_submit(pools, task): task for task in lost}

    try:
        yield stream
    finally:
        pools[-1].shutdown(wait=True, cancel_futures=True)


def _submit(pools: list[ProcessPoolExecutor], task: Task) -> Future[list[RunResult]]:
    try:
        with deaf_children():  # a process is started with the task that it is needed for
            return pools[-1].submit(run_task, task)
    except BrokenProcessPool as error:  # those in flight will say so too; this one joins them
        future: Future[list[RunResult]] = Future()
        future.set_exception(error)
        return future


def _replace(pools: list[ProcessPoolExecutor], count: int) -> None:
    pools[-1].shutdown(wait=False, cancel_futures=True)
    pools[:] = [_pool(count)]


def _pool(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=follow_the_parent)


@contextmanager
def deaf_children() -> Iterator[None]:
    """Processes started in here never hear an interrupt from the terminal, not even while they import."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def follow_the_parent() -> None:
    """In a worker: interrupts are the parent's to handle, and if it is killed the worker ends too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def end_with_it() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()
