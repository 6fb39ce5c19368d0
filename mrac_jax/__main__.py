"""The command line: `mrac-jax`, or `python -m mrac_jax`.

The folder that holds our three packages comes first on this process's path, and so on that of the workers it starts,
before anything else is imported: a `planner.py` or `analysis/` of the user's own on PYTHONPATH changes nothing. From
the first moment to the last an interrupt is one line and status 130; so is SIGTERM, with which schedulers of jobs
begin.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path

INTERRUPTED = 130


def main() -> None:
    """Run the command line of this process and exit with its status."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from analysis.cli.interrupts import keep_interrupts

        keep_interrupts()
        from analysis.cli.app import run

        status = run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)  # noqa: T201
        status = INTERRUPTED
    for number in (signal.SIGINT, signal.SIGTERM):  # the answer is out: its status stands
        signal.signal(number, signal.SIG_IGN)
    # Where code that is text (a dataclass is) was interrupted, `python -m` ends by the signal, whatever the status; the
    # next such code makes it forget.
    exec("")
    sys.exit(status)


if __name__ == "__main__":
    main()
