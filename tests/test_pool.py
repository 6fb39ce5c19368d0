"""The pool of processes: killed, stopped and interrupted at random moments it loses nothing and never hangs."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pool_tasks
import pytest

from analysis.utils import pool
from analysis.utils.pool import Pool
from planner.errors import UsageError

SIZES = (3_000, 30_000, 300_000)
MOMENTS = ("busy", "starting", "idle", "closing")
FOLDER = Path(__file__).parent


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    """What hangs is interrupted."""
    timer = threading.Timer(400, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    yield
    timer.cancel()


def kill(pid: int, number: int = signal.SIGKILL) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


class Killer:
    """Kills a process of a pool, from another thread where the moment is one of the pool's own."""

    def __init__(self, processes: Callable[[], list[int]], draw: random.Random) -> None:
        self.processes, self.draw, self.kills = processes, draw, 0
        self.thread: threading.Thread | None = None

    def now(self) -> None:
        found = self.processes()
        self.kills += bool(found) and kill(self.draw.choice(found))

    def soon(self, moment: str) -> None:
        """At a random moment of the next tasks: any, or a few milliseconds after a process was begun."""
        self.thread = threading.Thread(target=self._soon, args=(moment, set(self.processes())))
        self.thread.start()

    def _soon(self, moment: str, known: set[int]) -> None:
        if moment == "starting":
            patience = time.monotonic() + 5
            while not (begun := set(self.processes()) - known) and time.monotonic() < patience:
                time.sleep(0.0005)
            time.sleep(self.draw.uniform(0, 0.05))
            self.kills += sum(kill(pid) for pid in begun)
            return
        time.sleep(self.draw.uniform(0, 0.03 if moment == "busy" else 0.002))
        self.now()

    def wait(self) -> None:
        if self.thread is not None:
            self.thread.join()
            self.thread = None


@pytest.mark.parametrize(("kills", "seed"), [(12, 1), pytest.param(200, 2, marks=pytest.mark.slow)])
def test_kills_at_random_moments(kills: int, seed: int) -> None:
    """Rounds of tasks, each with a kill; every answer comes once, and is the right one. A fourth are of the ends."""
    draw, done, rounds = random.Random(seed), 0, 0
    while done < kills:
        size = SIZES[rounds % 3]
        rounds += 1
        with Pool(partial(pool_tasks.answer, size), 2) as workers:
            killer = Killer(workers.processes, draw)
            for moment in MOMENTS[:3]:
                if moment == "starting":
                    killer.now()  # so that the next task begins a process
                if moment == "idle":
                    killer.now()
                else:
                    killer.soon(moment)
                tasks = [draw.randrange(10**9) for _ in range(8)]
                found = list(workers.run(tasks))
                killer.wait()
                assert sorted(task for task, _ in found) == sorted(tasks)
                assert all(made == pool_tasks.answer(size, task) for task, made in found)
            killer.soon("closing")
        killer.wait()
        assert not workers.processes()
        done += killer.kills


def test_half_an_answer_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is stopped in the middle of a long answer, and then killed: what hung the pool of the library."""
    monkeypatch.setattr(pool, "LOOK_SECONDS", 0.1)
    with Pool(partial(pool_tasks.answer, 5_000_000), 2) as workers:
        answers = workers.run(range(6))
        first = [next(answers)]
        for _ in range(3):
            pid = workers.processes()[0]
            kill(pid, signal.SIGSTOP)
            first.append(next(answers))  # the other's
            kill(pid)
        found = [*first, *answers]
        assert sorted(task for task, _ in found) == list(range(6))


def test_a_stopped_process_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(pool, "LOOK_SECONDS", 0.1)
    with Pool(pool_tasks.pause, 1) as workers:
        assert list(workers.run([0.0])) == [(0.0, 0.0)]
        (pid,) = workers.processes()
        kill(pid, signal.SIGSTOP)
        wake = threading.Timer(1.0, kill, (pid, signal.SIGCONT))
        wake.start()
        assert list(workers.run([0.01])) == [(0.01, 0.01)]
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and f"worker process {pid} is stopped" in said and f"kill -CONT {pid}" in said
        assert list(workers.run([0.3])) == [(0.3, 0.3)]  # it goes on: nothing is said of it
        assert capsys.readouterr().err == ""
        kill(pid, signal.SIGSTOP)
        threading.Timer(0.5, kill, (pid,)).start()  # killed instead: another takes the task
        assert list(workers.run([0.02])) == [(0.02, 0.02)]
        assert f"worker process {pid} is stopped" in capsys.readouterr().err


def test_a_task_that_ends_its_process_is_an_error() -> None:
    with Pool(pool_tasks.die, 2, name=lambda number: f"case {number}") as workers:
        assert sorted(workers.run([2, 4])) == [(2, None), (4, None)]
        with pytest.raises(UsageError, match=r"killed 4 times at case 7; use fewer processes"):
            list(workers.run([2, 7, 4]))
        assert sorted(workers.run([8, 10])) == [(8, None), (10, None)]


def test_processes_that_cannot_start_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "MOST_STARTS", 3)
    monkeypatch.setattr(pool, "BEGIN", "raise SystemExit({})")
    with Pool(pool_tasks.pause, 2) as workers, pytest.raises(UsageError, match="3 processes ended before"):
        list(workers.run([0.1]))


def test_errors_and_answers_that_cannot_be_pickled() -> None:
    with Pool(pool_tasks.fail, 1) as workers:
        with pytest.raises(ValueError, match="no zero") as caught:
            list(workers.run([0]))
        assert "in a worker process" in caught.value.__notes__[0]
        with pytest.raises(Exception, match=r"Odd|more"):
            list(workers.run([1]))
        with pytest.raises(Exception, match="lambda"):
            list(workers.run([2]))
        with pytest.raises(Exception, match="pickle"):
            list(workers.run([lambda: 3]))  # type: ignore[list-item]


SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
import pool_tasks
from analysis.utils.pool import Pool
print("begun", flush=True)
try:
    with Pool(pool_tasks.{function}, 2) as workers:
        print("open", flush=True)
        for task in workers.run([{task}] * 50):
            pass
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def begin(function: str, task: object) -> subprocess.Popen[str]:
    """A parent of two processes at tasks that never end; returns when it has opened its pool."""
    script = pool_tasks.ENDS_WITH_US + SCRIPT.format(folder=str(FOLDER), function=function, task=task)
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parent)}
    running = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, env=environment, text=True, start_new_session=True
    )
    assert running.stdout is not None
    assert [running.stdout.readline() for _ in range(2)] == ["begun\n", "open\n"]
    return running


def below(parent: int) -> list[int]:
    """Processes of this parent."""
    return [int(pid) for pid in subprocess.run(["pgrep", "-P", str(parent)], capture_output=True).stdout.split()]


def none_left(pids: list[int], seconds: float) -> bool:
    patience = time.monotonic() + seconds
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < patience:
        time.sleep(0.01)
    return not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.mark.parametrize(
    ("numbers", "seed", "span"),
    [(range(1, 3), 3, 0.3), pytest.param(range(100), 4, 0.5, marks=pytest.mark.slow)],
)
def test_ctrl_c_ends_it_whatever_the_tasks_are(numbers: range, seed: int, span: float) -> None:
    """Ctrl-C, for half of them twice, from the pool's first moment on."""
    draw = random.Random(seed)
    for number in numbers:
        running = begin(*(("spin", 1), ("pause", 99999.0))[number % 2])
        time.sleep(draw.uniform(0, span))
        children, clock = below(running.pid), time.monotonic()
        os.killpg(running.pid, signal.SIGINT)
        if number % 4 > 1:
            time.sleep(draw.uniform(0, 0.02))
            kill(running.pid, signal.SIGINT)
        running.wait(60)
        assert time.monotonic() - clock < 5  # measured: 0.1 s on a quiet machine
        assert running.stdout is not None
        said = running.stdout.read()
        running.stdout.close()
        assert said == "interrupted\n" or number % 4 > 1, said
        assert none_left(children, 5)


@pytest.mark.parametrize("function", ["spin", pytest.param("pause", marks=pytest.mark.slow)])
def test_no_process_outlives_a_parent_that_is_killed(function: str) -> None:
    running = begin(function, 99999)
    patience = time.monotonic() + 30
    while len(children := below(running.pid)) < 2 and time.monotonic() < patience:
        time.sleep(0.01)
    time.sleep(0.3)
    running.kill()
    running.wait()
    assert running.stdout is not None
    running.stdout.close()
    assert len(children) == 2 and none_left(children, 10)
