"""Entry point of the console command: from its first moment to its last an interrupt is one line and status 130."""

from __future__ import annotations

import signal
import sys

INTERRUPTED = 130


def main() -> None:
    """Run the command line of this process and exit with its status."""
    try:
        from analysis.cli.interrupts import keep_interrupts

        keep_interrupts()
        from analysis.cli.app import run

        status = run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)  # noqa: T201
        status = INTERRUPTED
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the answer is out: its status stands
    sys.exit(status)
