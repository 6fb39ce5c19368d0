"""Event loops that an interrupt ends."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Coroutine
from types import FrameType
from typing import Any, TypeVar

Result = TypeVar("Result")
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR2") if hasattr(signal, name)]
"""Signals that end a program which handles them (`analysis.cli.interrupts`)."""


def run_loop(main: Coroutine[Any, Any, Result]) -> Result:
    """`asyncio.run`, where an interrupt cancels `main`, whoever handles interrupts, and KeyboardInterrupt follows.

    Elsewhere it is raised between any two steps of Python. A loop that has just taken out what it runs next loses it
    so, and its task, that was to go on by it, is waited for for ever. asyncio sees to that for Python's own handler
    alone.
    """
    came = False

    def cancel(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True
        loop.call_soon_threadsafe(task.cancel)

    ours = threading.current_thread() is threading.main_thread()
    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        task = loop.create_task(main)
        kept = {one: signal.signal(one, cancel) for one in ENDING if ours and callable(signal.getsignal(one))}
        try:
            return loop.run_until_complete(task)
        finally:
            for one, handler in kept.items():
                signal.signal(one, handler)
            if came:  # whatever became of the task: it may have ended before it could be cancelled
                raise KeyboardInterrupt
