"""Tasks on a dask.distributed cluster that runs elsewhere: tcp:// as it is, tls:// by dask's own configuration.

Whoever can reach a scheduler at tcp:// can run code as its workers and read what they send; at tls:// it takes a key
that the cluster's authority has signed (`distributed.comm.tls` in dask's configuration, docs/sweeps.md).

Tasks are pure, so a worker that is lost costs its tasks alone: the scheduler gives them to another. Results come back
to the client, which writes the store; nothing is kept on the cluster.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from analysis.kit.loops import run_loop
from analysis.kit.pool import AHEAD
from analysis.sweeps.tasks import RunResult, Stream, Task, run_task
from planner.arguments import argument
from planner.errors import UsageError

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_SECONDS = 6.0
"""How long a scheduler has to answer."""
WORKER_SECONDS = 60.0
"""How long the first worker may take to come."""
LOOK_SECONDS = 2.0
"""How often the number of workers is asked for: they may come and go."""


@contextmanager
def on_cluster(scheduler: str | Client) -> Iterator[Stream]:
    """A stream on the scheduler at this address, or of this client, which stays open. Raises UsageError."""
    try:
        from distributed import Client
    except ImportError:
        fix = 'pip install "mrac-jax[dask]", or use ' + argument("processes")
        raise UsageError("dask.distributed is not installed", fix=fix) from None
    named, quiet = f"{argument('scheduler')} {scheduler}", logging.root.manager.disable
    logging.disable(logging.CRITICAL)  # workers that come and go are no news for whoever waits for a result
    try:
        if isinstance(scheduler, str):
            _check_scheduler(scheduler, named)
            opened: Any = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        else:
            _check_client(scheduler, Client, named)
            opened = nullcontext(scheduler)
        with opened as client:
            address = client.scheduler.address
            try:
                client.wait_for_workers(1, timeout=WORKER_SECONDS)
            except TimeoutError:
                raise UsageError(f"{named} has no workers", fix=f"start some with `dask worker {address}`") from None
            yield lambda tasks: _stream(client, tasks, address)
    finally:
        logging.disable(quiet)


def _check_client(given: object, kind: type, named: str) -> None:
    """Raise UsageError unless `given` is an open client whose calls wait for their answer."""
    expected = "the address of a dask scheduler, or a dask.distributed Client that is open and not asynchronous"
    if not isinstance(given, kind):
        raise UsageError(named, expected=expected)
    client: Any = given
    if client.asynchronous or client.status != "running":
        raise UsageError(f"{named}, {'asynchronous' if client.asynchronous else client.status}", expected=expected)


def _check_scheduler(scheduler: str, named: str) -> None:
    """Raise UsageError unless a scheduler answers at this address."""
    if scheduler.startswith("tls://"):
        _check_keys(named)
    try:
        answers = _run(asyncio.wait_for(_identity(scheduler), CONNECT_SECONDS))
    except Exception as error:  # whatever listens there may say anything
        fix = f"start one with `dask scheduler`, or use {argument('processes')}"
        expected = "an address, as tls://host:8786 or tcp://host:8786"
        problem = f"{named}: no scheduler answers ({type(error).__name__})"
        raise UsageError(problem, expected=expected, fix=fix) from None
    if answers != "Scheduler":
        raise UsageError(f"{named} is a dask {answers}", expected="the address of a scheduler")


def _run(main: Coroutine[Any, Any, str]) -> str:
    """`run_loop`, in another thread where this one has a loop already, as a notebook's has."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return run_loop(main)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(run_loop, main).result()


def _check_keys(named: str) -> None:
    """Raise UsageError unless dask's configuration names files to meet a tls:// scheduler with."""
    from distributed.security import Security

    try:
        ready, problem = Security().get_connection_args("client").get("ssl_context") is not None, "no key is named"
    except OSError as error:  # of the files, or what is in them
        ready, problem = False, " ".join(str(error).split())
    if not ready:
        raise UsageError(
            f"{named}: {problem}",
            expected="distributed.comm.tls.ca-file, .client.key and .client.cert in dask's configuration",
            fix="see docs/sweeps.md",
        )


async def _identity(address: str) -> str:
    """What a dask server says that it is. A Client asks too, but one that gets no answer lingers for long."""
    from distributed.core import connect
    from distributed.security import Security

    comm = await connect(address, timeout=CONNECT_SECONDS, **Security().get_connection_args("client"))
    try:
        await comm.write({"op": "identity", "reply": True})
        return str((await comm.read())["type"])
    finally:
        comm.abort()


def _stream(client: Client, tasks: Iterable[Task], where: str) -> Iterator[tuple[Task, list[RunResult]]]:
    """Tasks as there is room for them, results as they come."""
    from distributed import CancelledError, as_completed
    from distributed.scheduler import KilledWorker

    source, done = iter(tasks), as_completed(loop=client.loop)
    running: dict[str, tuple[Future, Task]] = {}
    room, looked = 0, 0.0
    try:
        while True:
            if time.monotonic() - looked > LOOK_SECONDS:
                room, looked = AHEAD * max(1, sum(client.ncores().values())), time.monotonic()
            while len(running) < room:
                task = next(source, None)
                if task is None:
                    break
                future = client.submit(run_task, task, pure=False)
                running[future.key] = future, task
                done.add(future)
            if not running:
                return
            future = next(done)
            _, task = running.pop(future.key)
            try:
                results = future.result()
            except KilledWorker:
                fix = "give the workers more memory, or use fewer of them"
                raise UsageError(f"{where}: worker after worker was lost at {task.case.name}", fix=fix) from None
            except (CancelledError, OSError) as error:
                fix = "what was done is in the store: run the same command again to go on"
                raise UsageError(f"{where} was lost ({type(error).__name__})", fix=fix) from None
            future.release()
            yield task, results
    finally:  # of a client that stays open, too
        client.cancel([future for future, _ in running.values()])
