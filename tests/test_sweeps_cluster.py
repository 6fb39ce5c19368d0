"""dask.distributed as the engine: the same counts, workers that are killed, a scheduler that is not there."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_sweeps_engine import contents, jobs_of, swept

from analysis.sweeps import cluster
from analysis.sweeps.engine import Done, run_cases
from analysis.sweeps.store.store import Store
from planner.errors import UsageError

distributed = pytest.importorskip("distributed")


def children(parent: int) -> list[int]:
    """All processes below this one."""
    found = subprocess.run(["pgrep", "-P", str(parent)], capture_output=True, text=True).stdout.split()
    return [each for child in map(int, found) for each in (child, *children(child))]


def workers_now() -> list[int]:
    """The processes of a local cluster's workers."""
    found = []
    for pid in children(os.getpid()):
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if b"spawn_main" in words:
            found.append(pid)
    return found


def test_two_workers_count_what_one_process_does_and_a_killed_one_costs_its_task() -> None:
    right = swept(jobs_of(maps=20), processes=1)
    killed: list[int] = []

    def kill_one(step: Done) -> None:
        if step.jobs == 4:
            killed.append(workers_now()[-1])
            os.kill(killed[0], signal.SIGKILL)

    with Store.memory() as store:
        done = run_cases(jobs_of(maps=20), store, workers=2, progress=kill_one)
        assert done.jobs == 40 and len(killed) == 1
        assert contents(store) == right


@pytest.fixture
def scheduler() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The address of a scheduler of its own with two workers, all of them processes that can be killed."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    begin = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    host, port = address.removeprefix("tcp://").split(":")
    running = [subprocess.Popen([*begin, "scheduler", "--host", host, "--port", port, "--no-dashboard"], **quiet)]  # type: ignore[call-overload]
    for _ in range(2):
        arguments = ["worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        running.append(subprocess.Popen([*begin, *arguments], **quiet))  # type: ignore[call-overload]
    patience = time.monotonic() + 30
    while time.monotonic() < patience:
        with socket.socket() as probe:
            if probe.connect_ex((host, int(port))) == 0:
                break
        time.sleep(0.1)
    yield address, running
    for process in running:
        process.kill()
        process.wait()


def test_a_scheduler_elsewhere(scheduler: tuple[str, list[subprocess.Popen[bytes]]]) -> None:
    """Its workers may be killed; when the scheduler itself goes, what was done is kept and the error is clear."""
    address, running = scheduler
    right = swept(jobs_of(maps=12), processes=1)

    def kill_worker(step: Done) -> None:
        if step.jobs == 3:
            running[1].kill()

    with Store.memory() as store:
        run_cases(jobs_of(maps=12), store, scheduler=address, progress=kill_worker)
        assert contents(store) == right

    def kill_scheduler(step: Done) -> None:
        if step.jobs == 3:
            running[0].kill()

    with Store.memory() as store:
        with pytest.raises(UsageError, match=r"was lost.*run the same command again"):
            run_cases(jobs_of(maps=40), store, scheduler=address, progress=kill_scheduler)
        assert len(store) >= 9


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody there, or somebody else: told within the time to connect (6 s), here a quarter of it."""
    assert cluster.CONNECT_SECONDS <= 6
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1.5)
    with socket.socket() as silent:  # takes calls and never answers
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        addresses = [f"tcp://127.0.0.1:{silent.getsockname()[1]}", "tcp://127.0.0.1:9", "no address at all"]
        for address in addresses:
            clock = time.monotonic()
            with Store.memory() as store, pytest.raises(UsageError, match=r"--scheduler .*(no scheduler|an address)"):
                run_cases(jobs_of(), store, scheduler=address)
            assert time.monotonic() - clock < 4


@pytest.mark.slow
def test_client_killed_takes_its_cluster_with_it(tmp_path: Path) -> None:
    script = tmp_path / "sweep.py"
    script.write_text(
        "from test_sweeps_engine import *\n"
        "import sys\n"
        "if __name__ == '__main__':\n"
        "    run_cases(jobs_of(maps=400), Store.open(sys.argv[1]), workers=2)\n"
    )
    folder = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{folder}:{folder.parent}"}
    running = subprocess.Popen([sys.executable, str(script), str(tmp_path / "a.db")], env=environment)
    time.sleep(8)
    below = children(running.pid)
    running.kill()
    running.wait()
    assert len(below) >= 2
    patience = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in below) and time.monotonic() < patience:
        time.sleep(0.1)
    assert not [pid for pid in below if Path(f"/proc/{pid}").exists()]
    with Store.open(tmp_path / "a.db") as store:
        right = swept(jobs_of(maps=400), processes=2)
        assert all(right[key] == value for key, value in contents(store).items())
