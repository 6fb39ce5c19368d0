"""Interrupts that are not lost.

Python raises KeyboardInterrupt between any two steps of the main thread. Where that is within a callback of the garbage
collector (JAX registers one that runs at every collection), within a `__del__`, or in one that compiled code calls,
nobody can catch it: it goes to `sys.unraisablehook`, which prints it, and the program runs on. Here it is sent again, a
moment later and as often as it takes, until it is raised where it ends what runs.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

AGAIN_SECONDS = 0.02


def keep_interrupts() -> None:
    """From now on, send interrupts again that were raised where nothing can catch them, in place of printing them."""
    others = sys.unraisablehook

    def hook(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            others(lost)
            return
        timer = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), signal.SIGINT))
        timer.daemon = True
        timer.start()

    sys.unraisablehook = hook
