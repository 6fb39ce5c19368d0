"""The worker process of `analysis.utils.pool`: it runs tasks from its pipe until the parent ends or kills it."""

from __future__ import annotations

import gc
import os
import select
import signal
import threading
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any


def work(number: int) -> None:
    """Receive the function, acknowledge it, then answer tasks, on the pipe with this file descriptor."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(number,), daemon=True).start()
    pipe = Connection(number)
    with suppress(EOFError, OSError):
        function = pipe.recv()
        pipe.send_bytes(b"")
        gc.set_threshold(50_000)  # a collection scans all imported modules: 6 % of short tasks
        while True:
            pipe.send_bytes(_answer(function, pipe))


def _answer(function: Any, pipe: Connection) -> Any:
    """The pickled answer to the next task: the value of the function, or its exception."""
    task = pipe.recv_bytes()
    try:
        return ForkingPickler.dumps(function(ForkingPickler.loads(task)))
    except Exception as error:
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        try:
            return ForkingPickler.dumps(error)
        except Exception:
            return ForkingPickler.dumps(RuntimeError(traceback.format_exc()))


def _end_with_parent(number: int) -> None:
    """End this process when the parent ends: the other end of the pipe is then closed."""
    watch = select.poll()
    watch.register(number, 0)
    watch.poll()
    os._exit(1)
