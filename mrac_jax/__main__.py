"""The command line: `mrac-jax`, or `python -m mrac_jax`.

The folder that holds our three packages comes first on this process's path, and so on that of the workers it starts,
before anything else is imported: a `planner.py` or `analysis/` of the user's own on PYTHONPATH changes nothing. From
the first moment to the last an interrupt is one line and status 130; so is SIGTERM, with which schedulers of jobs
begin.

SIGTERM is blocked in all threads, and waited for in one of its own (`analysis.cli.console`): METIS, while it runs,
takes it for an error of its own and jumps, in whatever thread got it; most such processes crashed.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
from pathlib import Path

INTERRUPTED = 130
OWN = getattr(signal, "SIGUSR2", signal.SIGINT)
"""By what this process interrupts itself: shells tell what they begin in the background to ignore SIGINT."""


def main() -> None:
    """Run the command line of this process and exit with its status."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    ended, came = list[int](), None
    atexit.register(_leave, ended)
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        from analysis.cli.console import keep_interrupts

        came = keep_interrupts(OWN)
        from analysis.cli.app import run

        status = run()
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, Exception) and not (came and came.is_set()):
            raise
        print("interrupted", file=sys.stderr)  # noqa: T201
        status = INTERRUPTED
    for number in (signal.SIGINT, signal.SIGTERM, OWN):  # the answer is out: its status stands
        signal.signal(number, signal.SIG_IGN)
    # Where code that is text (a dataclass is) was interrupted, `python -m` ends by the signal, whatever the status; the
    # next such code makes it forget.
    exec("")
    ended.append(status)
    sys.exit(status)


def _leave(ended: list[int]) -> None:
    """End the process here, as the last that is done at its end: to take Python itself down takes half a second more.

    Errors that have a traceback end as ever, and so does what was printed but cannot be written: Python says so.
    """
    with contextlib.suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # closed by who began the process
                stream.flush()
        if ended:
            os._exit(ended[0])


if __name__ == "__main__":
    main()
