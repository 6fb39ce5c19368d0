"""The command line: `mrac-jax`, or `python -m mrac_jax`.

The folder that holds our three packages comes first on this process's path, and so on that of the workers it starts,
before anything else is imported: a `planner.py` or `analysis/` of the user's own on PYTHONPATH changes nothing. From
the first moment to the last an interrupt is one line and status 130; so is SIGTERM, with which schedulers of jobs
begin.

SIGTERM is blocked in all threads, but one that waits for it and interrupts the main one: METIS, while it runs, takes it
for an error of its own and jumps, in whatever thread got it; most such processes crashed.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from pathlib import Path

INTERRUPTED = 130
NOT_CAUGHT = 1
"""The status of an error that has a traceback."""


def main() -> None:
    """Run the command line of this process and exit with its status."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    ended = [NOT_CAUGHT]
    atexit.register(_leave, ended)
    if hasattr(signal, "sigwait"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        threading.Thread(target=_interrupt_on_sigterm, daemon=True).start()
    else:  # Windows
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    came = threading.Event()
    try:
        from analysis.cli.interrupts import keep_interrupts

        came = keep_interrupts()
        from analysis.cli.app import run

        status = run()
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, Exception) and not came.is_set():
            raise
        print("interrupted", file=sys.stderr)  # noqa: T201
        status = INTERRUPTED
    for number in (signal.SIGINT, signal.SIGTERM):  # the answer is out: its status stands
        signal.signal(number, signal.SIG_IGN)
    # Where code that is text (a dataclass is) was interrupted, `python -m` ends by the signal, whatever the status; the
    # next such code makes it forget.
    exec("")
    ended[0] = status
    sys.exit(status)


def _leave(ended: list[int]) -> None:
    """End the process here, as the last that is done at its end: to take Python itself down takes half a second more.

    Where what was printed cannot be written Python says so.
    """
    with contextlib.suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(ended[0])


def _interrupt_on_sigterm() -> None:
    while True:
        signal.sigwait({signal.SIGTERM})
        os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    main()
