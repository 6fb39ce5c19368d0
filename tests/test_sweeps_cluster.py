"""dask.distributed as the engine: the same counts, workers that are killed, a scheduler that is not there."""

from __future__ import annotations

import os
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
from analysis.sweeps.store import Store
from planner.errors import UsageError

distributed = pytest.importorskip("distributed")


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
