"""One board at a time, in a thread of its own: the newest wins, older ones end where they are."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

from planner.errors import MracError
from planner.files import Json

LOG = logging.getLogger("mrac_jax")
GRACE_SECONDS = 2.0
"""How long an answer may take to end where the program ends: code that is being compiled cannot be stopped."""
SUPERSEDED = {"superseded": True}
"""The last line of a board in whose place another came."""
Tell = Callable[[Json | None], None]
"""Takes a line of the answer; None: it is over."""
Work = Callable[[Any, Callable[[], None]], Iterator[Json]]
"""`work(board, go_on)`: the lines; it calls `go_on`, which raises where another board has come."""


class Superseded(Exception):
    """Nobody waits for this answer any more."""


class Job:
    """A board that waits for its answer, or is being answered."""

    def __init__(self, board: Any, tell: Tell) -> None:
        self.board, self.tell, self._over = board, tell, False

    def end(self) -> None:
        """Nobody waits for it any more."""
        self._over = True

    def go_on(self) -> None:
        """Raise Superseded if that is so."""
        if self._over:
            raise Superseded


class Latest:
    """Answers boards with `work`, at most one at a time; one more waits, and a newer one takes its place."""

    def __init__(self, work: Work) -> None:
        self._work, self._jobs = work, SimpleQueue[Job | None]()
        self._newest: Job | None = None
        self.begun = 0
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._thread.start()

    def submit(self, board: Any, tell: Tell) -> Job:
        """Answer this board next; `tell` is called from the thread. To be called from one thread alone."""
        job = Job(board, tell)
        old, self._newest = self._newest, job
        if old is not None:
            old.end()
        with suppress(Empty):
            waited = self._jobs.get_nowait()  # whoever takes it out answers it
            if waited is not None:
                waited.tell(SUPERSEDED)
                waited.tell(None)
        self._jobs.put(job)
        return job

    def close(self) -> None:
        """End the thread, at its next step; a daemon, it ends with the program in any case."""
        if self._newest is not None:
            self._newest.end()
        self._jobs.put(None)
        self._thread.join(GRACE_SECONDS)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._answer(job)

    def _answer(self, job: Job) -> None:
        self.begun += 1
        try:
            job.go_on()
            for line in self._work(job.board, job.go_on):
                job.tell(line)
                job.go_on()
        except Superseded:
            job.tell(SUPERSEDED)
        except MracError as error:
            job.tell({"error": str(error)})
        except Exception as error:  # a fault of ours: the page hears of it, and the next stroke is answered
            LOG.exception("studio")
            job.tell({"error": f"a fault of mrac-jax ({type(error).__name__}): please report what the terminal says"})
        finally:
            job.tell(None)
