"""A worker's side of `analysis.utils.pool`: task after task from its pipe, until the parent is gone or kills it."""

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
    """Take the function, say hello, then answer tasks, on the pipe with this file number."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(number,), daemon=True).start()
    pipe = Connection(number)
    with suppress(EOFError, OSError):
        function = pipe.recv()
        pipe.send_bytes(b"")
        gc.set_threshold(50_000)  # each collection looks at all that was imported: 6 % of short tasks
        while True:
            pipe.send_bytes(_answer(function, pipe))


def _answer(function: Any, pipe: Connection) -> Any:
    """The pickled answer to the next task: what the function returns, or the exception that it raises."""
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
    """The other end of the pipe is closed when the parent ends, however it does: so does this process, at once."""
    watch = select.poll()
    watch.register(number, 0)
    watch.poll()
    os._exit(1)
