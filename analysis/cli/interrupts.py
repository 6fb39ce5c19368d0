"""Interrupts that are not lost.

Python raises KeyboardInterrupt between any two steps of the main thread. Where that is within a callback of the garbage
collector (JAX registers one that runs at every collection), within a `__del__`, or in one that compiled code calls,
nobody can catch it: it goes to `sys.unraisablehook`, which prints it, and the program runs on. Here it is sent again, a
moment later and as often as it takes, until it is raised where it ends what runs. Native code that looks for a fitting
overload makes a TypeError of it: so whoever gets an error can ask whether an interrupt came before.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType

AGAIN_SECONDS = 0.02


def keep_interrupts(own: signal.Signals) -> threading.Event:
    """From now on, send interrupts again that were raised where nothing can catch them, in place of printing them.

    SIGTERM, which all threads block, is one too; SIGINT is none where the process was told to ignore it. Both are sent
    by the signal `own`. What is returned is set once one came.
    """
    others, came = sys.unraisablehook, threading.Event()

    def handler(number: int, frame: FrameType | None) -> None:
        came.set()
        signal.default_int_handler(number, frame)

    def hook(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            others(lost)
            return
        timer = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), own))
        timer.daemon = True
        timer.start()

    def pass_on() -> None:
        while True:
            signal.sigwait({signal.SIGTERM})
            os.kill(os.getpid(), own)

    sys.unraisablehook, waits = hook, hasattr(signal, "sigwait")  # not on Windows
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    signal.signal(own if waits else signal.SIGTERM, handler)
    if waits:
        threading.Thread(target=pass_on, daemon=True).start()
    return came
