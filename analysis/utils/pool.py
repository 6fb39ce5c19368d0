"""A pool of processes that run one function on many tasks, and that may be killed at any moment.

Each worker is one process, one pipe and one thread of this process. The thread sends one task, waits for its answer,
and starts another process if the pipe ends without one. A worker that is killed, in the middle of its answer, while it
starts, idle or at the end, breaks only its own pipe and loses only the task in flight, which the next process runs
again. (`concurrent.futures.ProcessPoolExecutor` has one pipe for all answers. In Python 3.11 it hung at two of three
kills in the middle of an answer; it runs the user's script again in every process, and an interrupt leaves its
semaphores.)

Interrupts are raised in the main thread, which neither starts processes nor talks to them, so that none is lost in
between. Each worker is a process group, so that Ctrl-C of a terminal reaches only the parent. Workers end with the
pool, by SIGKILL, and with the parent: they see that their pipe is closed.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeAlias, TypeVar

from planner.arguments import whole
from planner.errors import UsageError

MOST_PROCESSES = 1024
AHEAD = 3
"""Tasks taken from the iterable for each worker: one in flight, the others waiting."""
MOST_DEATHS = 4
"""Most processes that one task may end."""
PATIENCE = 1.0
"""Longest wait in seconds: an interrupt that comes just before a wait does not end it."""
BEGIN = "from analysis.utils.pool import work; work({})"

Given = TypeVar("Given")
Made = TypeVar("Made")
Todo: TypeAlias = "SimpleQueue[tuple[SimpleQueue[Any], Any] | None]"
"""Tasks, each with the queue for its answer."""


def wanted_processes(processes: int | None, total: int) -> int:
    """The number of processes for `total` tasks (0: unknown). Raises UsageError."""
    from planner.rollouts.open_loop import available_cores  # slow to import, and no worker needs it

    whole(1, MOST_PROCESSES).check("processes", processes, optional=True)
    count = processes or available_cores()
    return min(count, total) if total and processes is None else count


class Pool(Generic[Given, Made]):
    """`count` processes that run `function`; a context manager. `name`: name of a task in messages.

    `function`, tasks and answers are pickled. Processes are started fresh (a fork would copy locks), each with its
    first task.
    """

    def __init__(self, function: Callable[[Given], Made], count: int, name: Callable[[Given], str] = str) -> None:
        self._todo: Todo = SimpleQueue()
        pickled = ForkingPickler.dumps(function)
        self._workers = [_Worker(pickled, self._todo, name) for _ in range(count)]

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

    def run(self, tasks: Iterable[Given]) -> Iterator[tuple[Given, Made]]:
        """Yield each task with its answer, in any order; tasks are taken as workers become free.

        Raises the exception of the function, and UsageError for a task whose process ends repeatedly.
        """
        source, done, running = iter(tasks), SimpleQueue[tuple[Given, bool, Any]](), 0
        while True:
            # Few tasks are taken ahead, because the iterable may be long.
            for task in islice(source, AHEAD * len(self._workers) - running):
                self._todo.put((done, task))
                running += 1
            if not running:
                return
            try:
                task, failed, answer = done.get(timeout=PATIENCE)
            except Empty:
                continue
            running -= 1
            if failed:
                raise answer
            yield task, answer


def answers(
    function: Callable[[Given], Made], tasks: Iterable[Given], count: int, name: Callable[[Given], str] = str
) -> Iterator[tuple[Given, Made]]:
    """Each task with its answer, in any order, from `count` processes; 1: in order, in this process. As `Pool.run`."""
    if count == 1:
        yield from ((task, function(task)) for task in tasks)
        return
    with Pool(function, count, name) as pool:
        yield from pool.run(tasks)


class _Worker(threading.Thread):
    """The thread of one worker, and its current process.

    It is a daemon: those of `concurrent.futures` are joined at the end of Python, whatever an interrupt has left.
    """

    def __init__(self, function: Any, todo: Todo, name: Callable[[Any], str]) -> None:
        super().__init__(daemon=True)
        self._function, self._todo, self._called, self._ended = function, todo, name, False
        self._process: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        """Run tasks until there is None."""
        while (asked := self._todo.get()) is not None and not self._ended:
            done, task = asked
            done.put((task, *self._answer(task)))
        self._leave()

    def _answer(self, task: Any) -> tuple[bool, Any]:
        """(False, value) or (True, exception) of the function for a task. A process that is killed is replaced."""
        for _ in range(MOST_DEATHS):
            try:
                if self._process is None:
                    self._begin()
                self._pipe.send(task)
                answer: tuple[bool, Any] = self._pipe.recv()
                return answer
            except (EOFError, OSError):
                self._leave()
                if self._ended:
                    break
            except Exception as error:  # the task or the answer cannot be pickled
                return True, error
        problem = f"{MOST_DEATHS} processes ended at {self._called(task)}"
        return True, UsageError(problem, fix="use fewer processes if memory is short")

    def _begin(self) -> None:
        """Start a process, and send it the function."""
        self._pipe, theirs = Pipe()
        # The parent's copy of the child's end is closed, so that the death of the child ends the pipe.
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", BEGIN.format(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path)},
                pass_fds=[theirs.fileno()],
                process_group=0,
            )
        if self._ended:  # `end` sets this before it looks for a process
            self._process.kill()
        self._pipe.send_bytes(self._function)

    def _leave(self) -> None:
        """End the process, if there is one, and close its pipe."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._pipe.close()

    def end(self) -> None:
        """Kill the process; its thread finds the pipe closed, and starts no other."""
        self._ended = True
        if (process := self._process) is not None:
            process.kill()


# In the worker process.


def work(number: int) -> None:
    """Receive the function, then answer tasks, on the pipe with this file descriptor."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(number,), daemon=True).start()
    pipe = Connection(number)
    with suppress(EOFError, OSError):
        function = pipe.recv()
        gc.set_threshold(50_000)  # a collection scans all imported modules: 6 % of short tasks
        while True:
            pipe.send_bytes(_answer(function, pipe.recv_bytes()))


def _answer(function: Any, task: bytes) -> Any:
    """The pickled answer to a task: whether it failed, and its value or exception."""
    try:
        return ForkingPickler.dumps((False, function(ForkingPickler.loads(task))))
    except Exception as error:
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        try:
            return ForkingPickler.dumps((True, error))
        except Exception:
            return ForkingPickler.dumps((True, RuntimeError(traceback.format_exc())))


def _end_with_parent(number: int) -> None:
    """End this process when the parent ends: the other end of the pipe is then closed."""
    watch = select.poll()
    watch.register(number, 0)
    watch.poll()
    os._exit(1)
