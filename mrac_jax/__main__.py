"""The command line: `mrac-jax`, or `python -m mrac_jax`.

The folder of the three packages comes first on the path of this process and of its workers, before any other import:
a user's `planner.py` or `analysis/` on PYTHONPATH has no effect. At any time an interrupt gives one line and status
130. So does SIGTERM, which job schedulers send first.

SIGTERM is blocked in all threads, and a separate thread waits for it (`analysis.cli.console`): METIS handles SIGTERM as
one of its errors and jumps, in the thread that received it; most such processes crashed.
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
"""Signal by which this process interrupts itself: shells make background processes ignore SIGINT."""


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
    for number in (signal.SIGINT, signal.SIGTERM, OWN):  # the answer is complete, so its status is kept
        signal.signal(number, signal.SIG_IGN)
    # If generated code (as of a dataclass) was interrupted, `python -m` ends by the signal, whatever the status; the
    # next generated code clears that state.
    exec("")
    ended.append(status)
    sys.exit(status)


def _leave(ended: list[int]) -> None:
    """End the process at once, as its last exit function: the shutdown of Python takes half a second more.

    Errors with a traceback, and output that cannot be flushed, take the usual shutdown, so that Python reports them.
    """
    with contextlib.suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # closed by the parent process
                stream.flush()
        if ended:
            os._exit(ended[0])


if __name__ == "__main__":
    main()
