"""A pool of processes that run one function on many tasks, and that may be killed at any moment.

Each worker is one process, one pipe and one thread of this process. The thread sends one task, waits for its answer,
and starts another process if the pipe ends without one. Workers share no lock and no queue. A worker that is killed, in
the middle of its answer, while it starts, idle or at the end, breaks only its own pipe and loses only the task in
flight, which the next process runs again. (`concurrent.futures` uses one pipe with one lock for all answers, and hangs
on half an answer; in tests loky hung too, and pebble gave up.)

Interrupts are raised in the main thread, which neither starts processes nor talks to them, so that none is lost in
between. Each worker is a process group, so that Ctrl-C of a terminal reaches only the parent. Workers end with the
pool, by SIGKILL, and with the parent (`analysis.utils.pool_worker`).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import count as numbers
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

from analysis.utils.notes import say
from planner.arguments import whole
from planner.errors import UsageError
from planner.rollouts.open_loop import available_cores

MOST_PROCESSES = 1024
AHEAD = 3
"""Tasks taken from the iterable for each worker: one in flight, the others waiting."""
MOST_DEATHS = 4
"""Most processes that one task may end."""
MOST_STARTS = 20
"""Most processes in a row that may end before they take a task."""
LOOK_SECONDS = 2.0
"""Interval of the search for stopped workers (SIGSTOP)."""
BEGIN = "from analysis.utils.pool_worker import work; work({})"

Given = TypeVar("Given")
Made = TypeVar("Made")


def wanted_processes(processes: int | None, total: int) -> int:
    """The number of processes for `total` tasks (0: unknown). Raises UsageError."""
    whole(1, MOST_PROCESSES).check("processes", processes, optional=True)
    count = processes or available_cores()
    return min(count, total) if total and processes is None else count


class Pool(Generic[Given, Made]):
    """`count` processes that run `function`; a context manager. `name`: name of a task in messages.

    `function`, tasks and answers are pickled. Processes are started fresh (a fork would copy locks), each with its
    first task.
    """

    def __init__(self, function: Callable[[Given], Made], count: int, name: Callable[[Given], str] = str) -> None:
        self._todo: SimpleQueue[tuple[int, Given] | None] = SimpleQueue()
        self._answers: SimpleQueue[tuple[int, Made | Exception]] = SimpleQueue()
        pickled = bytes(ForkingPickler.dumps(function))
        self._workers = [_Worker(pickled, self._todo, self._answers, name) for _ in range(count)]
        self._numbers, self._reported, self._looked = numbers(), set[int](), time.monotonic()

    def __enter__(self) -> Pool[Given, Made]:
        for worker in self._workers:
            worker.start()
        return self

    def __exit__(self, *error: object) -> None:
        """End the processes at once, in another thread, which a second interrupt cannot stop."""
        ending = threading.Thread(target=self._end, daemon=True)
        ending.start()
        ending.join()

    def _end(self) -> None:
        for worker in self._workers:
            worker.end()
            self._todo.put(None)
        for worker in self._workers:
            worker.join()

    def processes(self) -> list[int]:
        """The ids of the current processes."""
        return [pid for worker in self._workers if (pid := worker.pid) is not None]

    def run(self, tasks: Iterable[Given]) -> Iterator[tuple[Given, Made]]:
        """Yield each task with its answer, in any order; tasks are taken as workers become free.

        Raises the exception of the function, and UsageError for a task whose process ends repeatedly.
        """
        source, out = iter(tasks), dict[int, Given]()
        while True:
            # Few tasks are taken ahead, because the iterable may be long.
            while len(out) < AHEAD * len(self._workers):
                try:
                    task = next(source)
                except StopIteration:
                    break
                number = next(self._numbers)
                out[number] = task
                self._todo.put((number, task))
            if not out:
                return
            number, answer = self._next()
            if number not in out:  # from an earlier call that was abandoned
                continue
            task = out.pop(number)
            if isinstance(answer, Exception):
                raise answer
            yield task, answer

    def _next(self) -> tuple[int, Made | Exception]:
        while True:
            if time.monotonic() - self._looked > LOOK_SECONDS:
                self._looked = time.monotonic()
                self._report_stopped()
            try:
                return self._answers.get(timeout=LOOK_SECONDS)
            except Empty:
                continue

    def _report_stopped(self) -> None:
        """Report each stopped process once: it neither answers nor ends."""
        stopped = {pid for worker in self._workers if (pid := worker.stopped()) is not None}
        for pid in sorted(stopped - self._reported):
            ways = f"`kill -CONT {pid}` resumes it, `kill -KILL {pid}` moves its task to another"
            say([f"worker process {pid} is stopped, and its task waits: {ways}"])
        self._reported = stopped


def answers(
    function: Callable[[Given], Made], tasks: Iterable[Given], count: int, name: Callable[[Given], str] = str
) -> Iterator[tuple[Given, Made]]:
    """Each task with its answer, in any order, from `count` processes; 1: in order, in this process. As `Pool.run`."""
    if count == 1:
        yield from ((task, function(task)) for task in tasks)
        return
    with Pool(function, count, name) as pool:
        yield from pool.run(tasks)


class _Worker(threading.Thread, Generic[Given, Made]):
    """The thread of one worker, and its current process."""

    def __init__(
        self,
        function: bytes,
        todo: SimpleQueue[tuple[int, Given] | None],
        answers: SimpleQueue[tuple[int, Made | Exception]],
        name: Callable[[Given], str],
    ) -> None:
        super().__init__(daemon=True)
        self._function, self._todo, self._answers, self._called = function, todo, answers, name
        self._lock, self._ended, self._busy = threading.Lock(), False, False
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    def run(self) -> None:
        """Run tasks until there is None."""
        while (asked := self._todo.get()) is not None and not self._ended:
            number, task = asked
            self._busy = True
            self._answers.put((number, self._answer(task)))
            self._busy = False
        self._leave()

    def _answer(self, task: Given) -> Made | Exception:
        """The value or the exception of the function for a task. A process that is killed is replaced."""
        deaths = starts = 0
        while True:
            try:
                pipe = self._begun()
                pipe.send(task)
                starts = 0
            except (EOFError, OSError) as error:
                starts += 1
                self._leave()
                if self._ended or starts == MOST_STARTS:
                    fix = "use fewer processes if memory is short"
                    return UsageError(f"{starts} processes ended before they started to work ({error!r})", fix=fix)
                continue
            except Exception as error:
                return error
            try:
                made: Made | Exception = pipe.recv()
                return made
            except (EOFError, OSError):
                deaths += 1
                self._leave()
                if self._ended or deaths == MOST_DEATHS:
                    problem = f"processes were killed {deaths} times at {self._called(task)}"
                    return UsageError(problem, fix="use fewer processes if memory is short")
            except Exception as error:
                return error

    def _begun(self) -> Connection:
        """The pipe to a process that waits for a task."""
        if self._pipe is not None:
            return self._pipe
        ours, theirs = Pipe()
        # The parent's copy of the child's end is closed, so that the death of the child ends the pipe.
        with theirs, self._lock:
            if self._ended:
                raise EOFError
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", BEGIN.format(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path)},
                pass_fds=[theirs.fileno()],
                process_group=0,
            )
        self._pipe = ours
        ours.send_bytes(self._function)
        ours.recv_bytes()
        return ours

    def _leave(self) -> None:
        """End the process, if there is one, and close its pipe."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
        with self._lock:
            # `end` runs in another thread, and must not kill a process that was already replaced.
            process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def end(self) -> None:
        """Kill the process; its thread finds the pipe closed, and starts no other."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()

    @property
    def pid(self) -> int | None:
        """The process's id."""
        with self._lock:
            return None if self._process is None else self._process.pid

    def stopped(self) -> int | None:
        """The process's id if it has a task and is stopped (SIGSTOP)."""
        with self._lock:
            if self._process is None or not self._busy or not hasattr(os, "waitid"):
                return None
            try:
                # WNOWAIT leaves the state in place for the next query.
                found = os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
            except ChildProcessError:
                return None
            stops = (signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
            return self._process.pid if found is not None and found.si_status in stops else None
