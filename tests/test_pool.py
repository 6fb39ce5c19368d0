"""The pool of processes: killed and interrupted at random moments it loses nothing and never hangs."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pool_tasks
import pytest

from analysis.utils import pool
from analysis.utils.pool import Pool
from planner.errors import UsageError

SIZES = (3_000, 30_000, 300_000)
FOLDER = Path(__file__).parent


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    """What hangs is interrupted."""
    timer = threading.Timer(400, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    yield
    timer.cancel()


def below(parent: int) -> list[int]:
    """Processes of this parent, whichever of its threads began them (Linux)."""
    found = list[int]()
    for one in Path(f"/proc/{parent}/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            found += map(int, one.read_text().split())
    return found


def workers() -> list[int]:
    return below(os.getpid())


def kill(pid: int, number: int = signal.SIGKILL) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(("kills", "seed"), [(12, 1), pytest.param(200, 2, marks=pytest.mark.slow)])
def test_kills_at_random_moments(kills: int, seed: int) -> None:
    """While processes start, work, are idle, or are ended: every answer comes once, and is the right one."""
    draw, done = random.Random(seed), list[bool]()
    while sum(done) < kills:
        size, timers = draw.choice(SIZES), []
        with Pool(partial(pool_tasks.answer, size), 2) as running:
            for _ in range(3):
                now = threading.Timer(draw.uniform(0, 0.2), lambda: done.extend(map(kill, workers()[:1])))
                timers.append(now)
                now.start()
                tasks = [draw.randrange(10**9) for _ in range(8)]
                found = list(running.run(tasks))
                assert sorted(task for task, _ in found) == sorted(tasks)
                assert all(made == pool_tasks.answer(size, task) for task, made in found)
                time.sleep(draw.uniform(0, 0.1))
        assert not workers()
        for timer in timers:
            timer.join()


def test_half_an_answer_is_no_answer() -> None:
    """A process that is stopped in the middle of a long answer, and then killed: what hangs the pool of the library."""
    with Pool(partial(pool_tasks.answer, 5_000_000), 2) as running:
        answers = running.run(range(6))
        first = [next(answers)]
        for _ in range(3):
            pid = workers()[0]
            kill(pid, signal.SIGSTOP)
            first.append(next(answers))  # the other's
            kill(pid)
        found = [*first, *answers]
        assert sorted(task for task, _ in found) == list(range(6))


def test_a_task_that_ends_its_process_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with Pool(pool_tasks.die, 2, name=lambda number: f"case {number}") as running:
        assert sorted(running.run([2, 4])) == [(2, None), (4, None)]
        with pytest.raises(UsageError, match=r"4 processes ended at case 7; use fewer processes"):
            list(running.run([2, 7, 4]))
        assert sorted(running.run([8, 10])) == [(8, None), (10, None)]
    monkeypatch.setattr(pool, "BEGIN", "raise SystemExit({})")
    with Pool(pool_tasks.die, 2) as running, pytest.raises(UsageError, match="4 processes ended at 2"):
        list(running.run([2]))


def test_errors_and_answers_that_cannot_be_pickled() -> None:
    with Pool(pool_tasks.fail, 1) as running:
        with pytest.raises(ValueError, match="no zero") as caught:
            list(running.run([0]))
        assert "in a worker process" in caught.value.__notes__[0]
        for task, said in ((1, r"Odd|more"), (2, "lambda"), (lambda: 3, "pickle")):
            with pytest.raises(Exception, match=said):
                list(running.run([task]))  # type: ignore[list-item]


SCRIPT = """
import sys
sys.path.insert(0, {folder!r})
import pool_tasks
from analysis.utils.pool import Pool
print("begun", flush=True)
try:
    with Pool(pool_tasks.{function}, 2) as running:
        print("open", flush=True)
        for task in running.run([{task}] * 50):
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
    assert [running.stdout.readline() for _ in range(2)] == ["begun\n", "open\n"]
    return running


def two_below(parent: int) -> list[int]:
    """The two processes of this parent, as soon as there are two."""
    patience = time.monotonic() + 60
    while len(children := below(parent)) < 2 and time.monotonic() < patience:
        time.sleep(0.01)
    assert len(children) == 2
    return children


def none_left(pids: list[int], seconds: float) -> bool:
    patience = time.monotonic() + seconds
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < patience:
        time.sleep(0.01)
    return not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.mark.parametrize(
    ("numbers", "seed", "span"), [(range(1, 3), 3, 0.3), pytest.param(range(100), 4, 0.5, marks=pytest.mark.slow)]
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
        said = running.communicate(timeout=60)[0]
        assert time.monotonic() - clock < 5  # measured: 0.1 s on a quiet machine
        assert said == "interrupted\n" or number % 4 > 1, said
        assert none_left(children, 5)


@pytest.mark.parametrize("function", ["spin", pytest.param("pause", marks=pytest.mark.slow)])
def test_no_process_outlives_a_parent_that_is_killed(function: str) -> None:
    running = begin(function, 99999)
    children = two_below(running.pid)
    time.sleep(0.3)
    running.kill()
    running.communicate()
    assert none_left(children, 10)
