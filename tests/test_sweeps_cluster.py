"""dask.distributed as the engine: the same counts, workers that are killed, a scheduler that is not there."""

import asyncio
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_sweeps_engine import contents, jobs_of, swept

import mrac_jax as mrac
from analysis.sweeps import cases as cluster
from analysis.sweeps.engine import Done, run_cases
from analysis.sweeps.store import Store
from planner.errors import UsageError

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")


def begin_cluster(protocol: str, *flags: str) -> tuple[str, list[subprocess.Popen[bytes]]]:
    """The address of a scheduler of its own with two workers, all of them processes that can be killed."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        host, port = probe.getsockname()
    address = f"{protocol}://{host}:{port}"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    begin = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    words = ["scheduler", "--host", f"{protocol}://{host}", "--port", str(port), "--no-dashboard", *flags]
    running = [subprocess.Popen([*begin, *words], **quiet)]  # type: ignore[call-overload]
    for _ in range(2):
        arguments = ["worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", *flags]
        running.append(subprocess.Popen([*begin, *arguments], **quiet))  # type: ignore[call-overload]
    patience = time.monotonic() + 30
    while time.monotonic() < patience:
        with socket.socket() as probe:
            if probe.connect_ex((host, port)) == 0:
                break
        time.sleep(0.1)
    return address, running


def end_cluster(running: list[subprocess.Popen[bytes]]) -> None:
    for process in running:
        process.kill()
        process.wait()


@pytest.fixture
def scheduler() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    address, running = begin_cluster("tcp")
    yield address, running
    end_cluster(running)


def key_files(authority: str | None, cert: str | None, key: str | None) -> dict[str, str | None]:
    """Dask's configuration of a client."""
    tls = "distributed.comm.tls"
    return {f"{tls}.ca-file": authority, f"{tls}.client.cert": cert, f"{tls}.client.key": key}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes the keys")
def test_a_scheduler_that_asks_for_a_key(tmp_path: Path) -> None:
    """tls:// with the keys that dask's configuration names; without them, an error that says so."""
    cert, key = str(tmp_path / "cert.pem"), str(tmp_path / "key.pem")
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", cert, "-days", "2"]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([*make, *names], check=True, capture_output=True)
    address, running = begin_cluster("tls", "--tls-ca-file", cert, "--tls-cert", cert, "--tls-key", key)
    try:
        with dask.config.set(key_files(cert, cert, key)):
            assert swept(jobs_of(maps=2), scheduler=address) == swept(jobs_of(maps=2), processes=1)
        with pytest.raises(UsageError, match="no scheduler responds"):
            swept(jobs_of(), scheduler=address.replace("tls", "tcp"))
    finally:
        end_cluster(running)


def test_tls_without_keys_says_what_is_missing(tmp_path: Path) -> None:
    none = str(tmp_path / "none.pem")
    for files, said in ((key_files(None, None, None), "TLS"), (key_files(none, none, none), "No such file")):
        told = pytest.raises(UsageError, match=rf"tls://127.0.0.1:9: no scheduler .*{said}.*client.key")
        with dask.config.set(files), told:
            swept(jobs_of(), scheduler="tls://127.0.0.1:9")


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """A scheduler and its worker in this process."""
    how = {"processes": False, "protocol": "tcp", "dashboard_address": None}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, **how) as cluster:
        yield cluster


def test_a_scheduler_and_its_worker_in_this_process(local: Any) -> None:
    """By its address, and by a client, which stays open."""
    right = swept(jobs_of(maps=2), processes=1)
    with distributed.Client(local, set_as_default=False) as client:
        for scheduler in (local.scheduler_address, client, client):
            assert swept(jobs_of(maps=2), scheduler=scheduler) == right
    for wrong in (client, 3):
        with pytest.raises(UsageError, match="expected the address of a dask scheduler, or a"):
            swept(jobs_of(maps=2), scheduler=wrong)


def test_a_sweep_in_python_takes_a_scheduler(tmp_path: Path, local: Any) -> None:
    """An address, in a notebook's thread with its own loop too, or a client: the same bytes as without."""
    (tmp_path / "s.yaml").write_text(
        "base: {kind: contiguous, size: 6x7}\nmaps: 2\nrollouts: 20\nsweep: {robots: [1, 2]}\n"
    )

    def rows(name: str, **how: Any) -> bytes:
        files = mrac.sweep(tmp_path / "s.yaml", tmp_path / f"{name}.store", progress=False, **how).save(tmp_path / name)
        return next(file.read_bytes() for file in files if file.suffix == ".csv")

    async def in_a_loop() -> bytes:
        return rows("loop", scheduler=local.scheduler_address)

    with distributed.Client(local, set_as_default=False) as client:
        assert rows("here", processes=1) == rows("client", scheduler=client) == asyncio.run(in_a_loop())


@pytest.mark.slow
def test_a_scheduler_elsewhere(scheduler: tuple[str, list[subprocess.Popen[bytes]]]) -> None:
    """Its workers may be killed; when the scheduler itself goes, what was done is kept and the error is clear."""
    address, running = scheduler
    right = swept(jobs_of(maps=12), processes=1)

    def kill_worker(step: Done) -> None:
        if step.jobs == 3:
            running[1].kill()

    with Store() as store:
        run_cases(jobs_of(maps=12), store, scheduler=address, progress=kill_worker)
        assert contents(store) == right

    def kill_scheduler(step: Done) -> None:
        if step.jobs == 3:
            running[0].kill()

    with Store() as store:
        with pytest.raises(UsageError, match=r"was lost.*run the same command again"):
            run_cases(jobs_of(maps=40), store, scheduler=address, progress=kill_scheduler)
        assert len(store) >= 9


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody there, or somebody else: told within the time to connect (6 s), here a twelfth of it."""
    assert cluster.CONNECT_SECONDS <= 6
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    with socket.socket() as silent:  # takes calls and never answers
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        addresses = [f"tcp://127.0.0.1:{silent.getsockname()[1]}", "tcp://127.0.0.1:9", "no address at all"]
        for address in addresses:
            clock = time.monotonic()
            with pytest.raises(UsageError, match=r"^scheduler .*(no scheduler|an address)"):
                swept(jobs_of(), scheduler=address)
            assert time.monotonic() - clock < 4
